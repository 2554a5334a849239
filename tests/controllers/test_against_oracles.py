"""Every algorithm against its oracle in `tests/oracles`: plain numpy, written from the equations alone.

Control signals, errors, factors and final weights agree to 1e-9 of their largest value. They are not the same bits: the
sums over taps, channels and windows are added up in another order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.channels import random_paths, through
from oracles import lms, signals
from oracles.diagonal import DiagonalKalman as DiagonalOracle
from oracles.kalman import Kalman
from oracles.limiter import Limiter
from oracles.powers import Constraint
from oracles.rls import FxRLS

from kfopc_filterpy import (
    HardClipAmplifier,
    OutputLimiter,
    OutputPowerConstraint,
    Plant,
    SoftSaturationAmplifier,
    clipping_fx_lms,
    diagonal_kf,
    fx_lms,
    fx_nlms,
    fx_rls,
    kf_anc,
    kf_opc,
    leaky_fx_lms,
    mov_fx_lms,
    optimal_leaky_fx_lms,
    rescaling_fx_lms,
    simulate,
    two_gradient_fx_lms,
)
from kfopc_filterpy.paths import PathTolerance, guard_filter

FS = 16000.0
TOLERANCE = 1e-9  # of the largest value
UNCERTAINTY = PathTolerance(delay_samples=0.5, gain_db=1.0)
MEMORY_S = 0.01
POWERS: dict[str, Any] = {"fs": FS, "memory_s": MEMORY_S}


class Scene:
    """Paths and noises: one channel, or three microphones, two loudspeakers and two references."""

    def __init__(self, several: bool) -> None:
        self.one = not several
        K, J, I = (3, 2, 2) if several else (1, 1, 1)  # noqa: E741
        self.microphones, self.loudspeakers, self.references = K, J, I
        self.s = 0.3 * random_paths(K, J, 12, seed=1) + np.eye(K, J)[..., None] * np.eye(12)[2]
        self.s_hat = 0.9 * self.s[..., :9] + random_paths(K, J, 9, seed=2) / 20
        self.primary = random_paths(K, I, 20, seed=3, delay=5)

    def noises(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Coloured references, soft at first and then loud, and disturbances that they explain in part."""
        rng = np.random.default_rng(4)
        colours = np.eye(self.references)[..., None] * [1.0, 0.6, 0.3]
        x = through(colours, rng.standard_normal((self.references, n)))
        x[:, : n // 3] *= 0.05
        x[:, 3 * n // 4 :] *= 0.6
        return x, through(self.primary, x) + 0.02 * rng.standard_normal((self.microphones, n))

    def each(self, values: list[Any]) -> Any:
        """The values of the loudspeakers or microphones; of one channel, a number."""
        return values[0] if self.one else values


ONE, SEVERAL = Scene(several=False), Scene(several=True)


def assert_close(got: Any, expected: Any, what: str) -> None:
    got, expected = np.reshape(got, expected.shape), np.asarray(expected)
    largest = np.max(np.abs(expected))
    assert largest > 0, f"{what} is zero"
    worst = np.max(np.abs(got - expected)) / largest
    assert worst <= TOLERANCE, f"{what}: {worst:.2g} of the largest value"


def compare(
    scene: Scene, controller: Any, oracle: Any, n: int, *, amplifier: Any = None, played: Any = None, on: int = 0
) -> None:
    """Run both over the same noise and compare; `played` is what the oracle's loop has for the amplifier."""
    x, d = scene.noises(n)
    paths = scene.s[0, 0] if scene.one else scene.s
    own = (x[0], d[0]) if scene.one else (x, d)
    plant = Plant(paths, amplifier=amplifier, fs=FS)
    result = simulate(controller, own[0], plant, disturbance=own[1], switch_on_s=on / FS)
    amplifiers = None if played is None else [played] * scene.loudspeakers
    expected = signals.run(oracle, x, d, scene.s, amplifiers=amplifiers, on=on)
    assert result.diverged_at_s is None
    assert_close(result.control_signal, expected.y, "control signal")
    assert_close(result.error, expected.e, "error")
    assert_close(controller.weights, expected.w, "weights")
    if oracle.constraints:
        assert_close(result.constraint_factor, expected.alphas, "constraint factor")
        assert np.min(expected.alphas[:, n // 3 - 1 - on]) == 1.0  # the constraint acts, but not always
        assert np.max(np.min(expected.alphas[:, n // 3 - on :], axis=1)) < 1.0


# The settings of each algorithm: those of the package, and those of the oracle. Lists have a value of each loudspeaker.

RATED, A, LEAK, PENALTY = [0.1, 0.15], [0.25, 0.4], [0.3, 0.1], [0.4, 0.2]
MU = 1e-3
Algorithm = tuple[Callable[..., Any], Any, dict[str, Any], dict[str, Any]]

LMS: dict[str, Algorithm] = {
    "FxLMS": (fx_lms, lms.FxLMS, {"step_size": MU}, {"mu": MU}),
    "FxNLMS": (fx_nlms, lms.FxNLMS, {"step_size": 0.05, "regularization": 0.5}, {"mu": 0.05, "epsilon": 0.5}),
    "leaky": (leaky_fx_lms, lms.LeakyFxLMS, {"step_size": MU, "leak": LEAK}, {"mu": MU, "gamma": LEAK}),
    "optimal leaky": (optimal_leaky_fx_lms, lms.OptimalLeakyFxLMS, {"step_size": MU}, {"mu": MU}),
    "MOV": (mov_fx_lms, lms.MOVFxLMS, {"step_size": MU}, {"mu": MU}),
    "MOV fixed": (mov_fx_lms, lms.MOVFxLMS, {"step_size": MU, "penalty_factor": PENALTY}, {"mu": MU, "gamma": PENALTY}),
    "MOV modified": (mov_fx_lms, lms.MOVFxLMS, {"step_size": MU, "modified": True}, {"mu": MU, "modified": True}),
    "two-gradient": (
        two_gradient_fx_lms,
        lms.TwoGradientFxLMS,
        {"step_size": MU, "amplitude_limit": A, "output_step_size": 2 * MU},
        {"mu": MU, "A": A, "mu_y": 2 * MU},
    ),
    "clipping": (
        clipping_fx_lms,
        lms.ClippingFxLMS,
        {"step_size": MU / 4, "amplitude_limit": A},
        {"mu": MU / 4, "A": A},
    ),
    "re-scaling": (rescaling_fx_lms, lms.RescalingFxLMS, {"step_size": MU, "amplitude_limit": A}, {"mu": MU, "A": A}),
}

R, Q, P0, LAMBDA = 1e-6, [1e-2, 3e-2, 2e-2], 0.5, 0.9995
OURS: dict[str, Any] = {"state_noise": R, "measurement_noise": Q, "initial_variance": P0}
THEIRS: dict[str, Any] = {"r": R, "q": Q, "P0": P0}

ONE_NOISE: tuple[dict[str, Any], dict[str, Any]] = OURS | {"measurement_noise": Q[0]}, THEIRS | {"q": 3 * Q[:1]}

SEVERAL_KALMAN: dict[str, Algorithm] = {  # several channels, too
    "KF-ANC": (kf_anc, Kalman, OURS, THEIRS),
    "KF-OPC": (kf_opc, Kalman, OURS, THEIRS),
    "diagonal KF": (diagonal_kf, DiagonalOracle, *ONE_NOISE),
    "diagonal KF-OPC": (diagonal_kf, DiagonalOracle, *ONE_NOISE),
}
KALMAN: dict[str, Algorithm] = SEVERAL_KALMAN | {
    "FxRLS": (fx_rls, FxRLS, {"forgetting": LAMBDA}, {"forgetting": LAMBDA})
}
ALGORITHMS = LMS | KALMAN
WITH_POWERS = [name for name in ALGORITHMS if name.startswith(("optimal", "MOV")) or name.endswith("KF-OPC")]


def pair(name: str, scene: Scene, own: Any = None, known: Any = None, window: str = "exponential") -> tuple[Any, Any]:
    """The package's controller and the oracle; `own` and `known` are further settings of each."""
    make, oracle, ours, theirs = ALGORITHMS[name]
    ours = {key: scene.each(value) if isinstance(value, list) else value for key, value in ours.items()} | (own or {})
    theirs = {key: value[:1] if scene.one and isinstance(value, list) else value for key, value in theirs.items()}
    if name in WITH_POWERS:
        ours["constraint"] = scene.each([OutputPowerConstraint(p, window=window, **POWERS) for p in RATED])
        theirs["constraints"] = [Constraint(p, window=window, **POWERS) for p in RATED[: scene.loudspeakers]]
    if not scene.one:
        ours["n_references"] = scene.references
    controller = make(16, scene.s_hat[0, 0] if scene.one else scene.s_hat, **ours)
    channels = {"s_hat": scene.s_hat, "n_taps": 16, "n_references": scene.references}
    return controller, oracle(**channels, **theirs, **(known or {}))


def cases(*names: str) -> Any:
    """Each algorithm with one channel, and with several if it takes them; the parameters of a test."""
    scenes = {"one channel": ONE, "several": SEVERAL}
    return pytest.mark.parametrize(
        ("name", "scene"),
        [
            pytest.param(name, scene, id=f"{name}, {which}")
            for name in names
            for which, scene in scenes.items()
            if scene is ONE or name in LMS or name in SEVERAL_KALMAN
        ],
    )


@cases(*ALGORITHMS)
def test_every_algorithm(name: str, scene: Scene) -> None:
    compare(scene, *pair(name, scene), 4000 if scene.one else 3000)


@cases("FxLMS", "FxNLMS", "leaky", "MOV", "two-gradient", "re-scaling", "KF-OPC", "diagonal KF-OPC")
def test_with_a_guard(name: str, scene: Scene) -> None:
    W = guard_filter(UNCERTAINTY, scene.s_hat)
    controller, oracle = pair(name, scene, known={"guard": W})
    controller.secondary_path_uncertainty = UNCERTAINTY
    compare(scene, controller, oracle, 2000)


@cases("FxLMS", "MOV", "two-gradient", "re-scaling", "KF-ANC", "KF-OPC", "FxRLS")
def test_with_limiters(name: str, scene: Scene) -> None:
    """Limiters that act; the first of several has the longest window."""
    limits: list[tuple[float, Any]] = [
        (0.02, {"fs": FS, "window_s": 0.013, "amplitude_limit": 0.3}),
        (0.01, {"fs": FS, "window_s": 0.01}),
    ]
    own, theirs = ([make(p, **o) for p, o in limits[: scene.loudspeakers]] for make in (OutputLimiter, Limiter))
    compare(scene, *pair(name, scene, {"limiter": scene.each(own)}, {"limiters": theirs}), 2000)
    assert all(one.gain < 1.0 for one in theirs)


@cases(
    "FxLMS", "optimal leaky", "MOV", "MOV modified", "KF-OPC", "diagonal KF-OPC", "FxRLS"
)  # fmt: skip
def test_with_amplifiers_and_sliding_windows(name: str, scene: Scene) -> None:
    """The true amplifiers clip hard; a controller that estimates the disturbance takes them for soft ones."""
    own, known = {}, {}
    if name in WITH_POWERS or name in KALMAN:
        own = {"amplifier": SoftSaturationAmplifier(0.2, 1.5)}
        known = {"amplifiers": [signals.rapp(0.2, 1.5)] * scene.loudspeakers}
    both = pair(name, scene, own, known, window="sliding")
    compare(scene, *both, 2000, amplifier=HardClipAmplifier(0.15), played=signals.hard_clip(0.15))


@cases("KF-OPC", "diagonal KF-OPC", "FxRLS", "MOV")
def test_control_that_is_switched_on_later(name: str, scene: Scene) -> None:
    compare(scene, *pair(name, scene), 2000, on=400)


@pytest.mark.parametrize("name", ["KF-OPC", "diagonal KF-OPC"])
def test_a_loudspeaker_that_no_microphone_hears(name: str) -> None:
    """Its factor of zero does not count."""
    scene = Scene(several=True)
    scene.s_hat[:, 1] = 0.0
    controller, oracle = pair(name, scene)
    x, d = scene.noises(300)
    expected = signals.run(oracle, x, d, scene.s)
    result = simulate(controller, x, Plant(scene.s, fs=FS), disturbance=d)
    np.testing.assert_allclose(result.constraint_factor, expected.alphas, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(controller.weights, expected.w, rtol=0, atol=TOLERANCE)
    assert np.any(controller.weights != 0.0)


@pytest.mark.parametrize("limit", [{}, {"amplitude_limit": 0.5}], ids=["", "amplitude limit"])
@pytest.mark.parametrize("window_s", [0.01, 0.0005], ids=["160 samples", "8 samples"])
def test_limiter(limit: dict[str, float], window_s: float) -> None:
    """Noise, silence, a burst, a tone: after silence, the first loud samples spend the whole budget.

    A clipped sample is the root of what is left of the budget; when nothing is left, roundings of 1e-16 of the budget are
    left. So squares are compared, in units of the budget.
    """
    rng, n = np.random.default_rng(5), np.arange(3000)
    u = np.concatenate(
        [0.2 * rng.standard_normal(3000), np.zeros(500), 20.0 * rng.standard_normal(300), 0.5 * np.sin(0.3 * n)]
    )
    own, theirs = (make(0.04, fs=FS, window_s=window_s, **limit) for make in (OutputLimiter, Limiter))
    y, expected = own.process(u), np.array([theirs(v) for v in u])
    budget = 0.04 * round(window_s * FS)
    assert np.max(np.abs(y * np.abs(y) - expected * np.abs(expected))) < 1e-12 * budget
    clear = expected**2 > 1e-6 * budget
    assert_close(y[clear], expected[clear], "output")
    assert own.clipped > 0
    assert own.gain == pytest.approx(theirs.gain, rel=TOLERANCE)
