"""Every controller of the package, made with the options that change what it keeps, for tests that hold for all."""

from __future__ import annotations

from typing import Any
from unittest import mock

import numpy as np
from filterpy.kalman import KalmanFilter

from helpers.channels import random_paths
from helpers.loop import AMPLIFIERS, FS, MEMORY_S, MU, N_TAPS, P0, S_HAT, Q, R
from kfopc_filterpy import (
    KFOPC,
    HardClipAmplifier,
    KalmanController,
    LimitedController,
    OutputLimiter,
    OutputPowerConstraint,
    clipping_fx_lms,
    diagonal_kf,
    frequency_domain_fx_lms,
    fx_lms,
    fx_nlms,
    fx_rls,
    kf_anc,
    kf_opc,
    kf_pb,
    leaky_fx_lms,
    mov_fx_lms,
    optimal_leaky_fx_lms,
    rescaling_fx_lms,
    two_gradient_fx_lms,
)
from kfopc_filterpy.controllers import FeedbackNeutralizer, KalmanObserver, VirtualMicrophones, with_internal_model
from kfopc_filterpy.paths import PathTolerance

KALMAN: dict[str, Any] = {"state_noise": R, "measurement_noise": Q, "initial_variance": P0}


def constraint(**settings: Any) -> OutputPowerConstraint:
    return OutputPowerConstraint(0.3, **{"fs": FS, "memory_s": MEMORY_S} | settings)


def short_blocks(taps: int, path: Any, **settings: Any) -> Any:
    """Return KF-PB with blocks of 16 samples, of which a short run has many, and an averaging time of 20 blocks."""
    with mock.patch("kfopc_filterpy.controllers.kf_pb.BLOCK_S", 16 / FS):
        return kf_pb(taps, path, **{"fs": FS, "averaging_s": 320 / FS} | settings)


MAKERS: dict[str, Any] = {
    "KF-ANC": lambda s=S_HAT, **o: kf_anc(N_TAPS, s, **KALMAN, **o),
    "KF-OPC": lambda s=S_HAT, **o: kf_opc(N_TAPS, s, constraint=constraint(), **KALMAN, **o),
    "KF-OPC, sliding": lambda s=S_HAT, **o: kf_opc(N_TAPS, s, constraint=constraint(window="sliding"), **KALMAN, **o),
    "KF-PB": lambda s=S_HAT, **o: short_blocks(N_TAPS, s, rated_power=0.3, **o),
    "fxRLS": lambda s=S_HAT, **o: fx_rls(N_TAPS, s, forgetting=0.999, **o),
    "diagonal KF": lambda s=S_HAT, **o: diagonal_kf(N_TAPS, s, **KALMAN, **o),
    "diagonal KF-OPC": lambda s=S_HAT, **o: diagonal_kf(N_TAPS, s, constraint=constraint(), **KALMAN, **o),
    "FxLMS": lambda s=S_HAT, **o: fx_lms(N_TAPS, s, step_size=MU, **o),
    "FxNLMS": lambda s=S_HAT, **o: fx_nlms(N_TAPS, s, step_size=0.1, **o),
    "leaky": lambda s=S_HAT, **o: leaky_fx_lms(N_TAPS, s, step_size=MU, leak=0.3, **o),
    "optimal leaky": lambda s=S_HAT, **o: optimal_leaky_fx_lms(N_TAPS, s, step_size=MU, constraint=constraint(), **o),
    "MOV": lambda s=S_HAT, **o: mov_fx_lms(N_TAPS, s, step_size=MU, constraint=constraint(), **o),
    "MOV, modified": lambda s=S_HAT, **o: mov_fx_lms(
        N_TAPS, s, step_size=MU, constraint=constraint(), modified=True, **o
    ),
    "two-gradient": lambda s=S_HAT, **o: two_gradient_fx_lms(N_TAPS, s, step_size=MU, amplitude_limit=0.5, **o),
    "re-scaling": lambda s=S_HAT, **o: rescaling_fx_lms(N_TAPS, s, step_size=MU, amplitude_limit=0.5, **o),
    "clipping": lambda s=S_HAT, **o: clipping_fx_lms(N_TAPS, s, step_size=MU, amplitude_limit=0.5, **o),
}
KNOWS_AN_AMPLIFIER = [
    name
    for name in MAKERS
    if not name.startswith(("FxLMS", "FxNLMS", "leaky", "two-gradient", "re-scaling", "clipping"))
]
VARIANTS = [(name, "plain") for name in MAKERS]
# The limiter acts on what they emit, alike for all; these adapt to it in different ways. Each is compiled anew for it.
LIMITED = ("KF-ANC", "KF-OPC", "KF-PB", "FxLMS", "MOV", "two-gradient", "re-scaling", "clipping")
VARIANTS += [(name, "limiter") for name in LIMITED]
VARIANTS += [(name, "known amplifier") for name in KNOWS_AN_AMPLIFIER]


def made(name: str, variant: str) -> Any:
    """Return a controller of one channel."""
    options: dict[str, Any] = {}
    if variant == "limiter":
        options["limiter"] = OutputLimiter(0.05, fs=FS, window_s=0.01)
    if variant == "known amplifier":
        options["amplifier"] = AMPLIFIERS["soft"][0]
    return MAKERS[name](**options)


# Several channels. A name begins with that of the public function or class.

K, J, I, L = 3, 2, 2, 5  # microphones, loudspeakers, references, taps  # noqa: E741
PATHS = random_paths(K, J, 4, seed=1)
MANY: dict[str, Any] = {"n_references": I}


def constraints() -> list[OutputPowerConstraint]:
    return [OutputPowerConstraint(power, fs=FS, memory_s=MEMORY_S) for power in (0.02, 0.05)]


def limiters() -> list[OutputLimiter]:
    return [OutputLimiter(power, fs=FS, window_s=0.01) for power in (0.01, 0.02)]


SEVERAL: dict[str, Any] = {
    "kf_anc": lambda s=PATHS: kf_anc(L, s, **KALMAN, **MANY),
    "kf_opc": lambda s=PATHS: kf_opc(L, s, constraint=constraints(), limiter=limiters(), **KALMAN, **MANY),
    "kf_pb": lambda s=PATHS: short_blocks(L, s, rated_power=[0.02, 0.05], **MANY),
    "kf_pb, exact path": lambda s=PATHS: short_blocks(
        L, s, rated_power=0.05, secondary_path_uncertainty=None, limiter=limiters(), **MANY
    ),
    "DiagonalKalman": lambda s=PATHS: diagonal_kf(L, s, constraint=constraints(), limiter=limiters(), **KALMAN, **MANY),
    "FxLMS": lambda s=PATHS: fx_lms(L, s, step_size=MU, limiter=limiters(), **MANY),
    "FxNLMS": lambda s=PATHS: fx_nlms(L, s, step_size=0.1, **MANY),
    "LeakyFxLMS": lambda s=PATHS: leaky_fx_lms(L, s, step_size=MU, leak=[0.3, 0.1], **MANY),
    "OptimalLeakyFxLMS": lambda s=PATHS: optimal_leaky_fx_lms(L, s, step_size=MU, constraint=constraints(), **MANY),
    "MOVFxLMS": lambda s=PATHS: mov_fx_lms(L, s, step_size=MU, constraint=constraints(), modified=True, **MANY),
    "TwoGradientFxLMS": lambda s=PATHS: two_gradient_fx_lms(L, s, step_size=MU, amplitude_limit=0.5, **MANY),
    "RescalingFxLMS": lambda s=PATHS: rescaling_fx_lms(L, s, step_size=MU, amplitude_limit=[0.1, 0.5], **MANY),
    "ClippingFxLMS": lambda s=PATHS: clipping_fx_lms(L, s, step_size=MU, amplitude_limit=0.5, **MANY),
}

# Controllers that adapt once per block. Runs of 300 samples end within one.

IN_BLOCKS: dict[str, Any] = {
    "frequency domain": lambda s=S_HAT: frequency_domain_fx_lms(N_TAPS, s, step_size=0.2, block_size=7),
    "block LMS": lambda s=S_HAT: frequency_domain_fx_lms(N_TAPS, s, step_size=MU, block_size=14, forgetting=None),
    "frequency domain, many": lambda: frequency_domain_fx_lms(
        L, PATHS, step_size=0.1, block_size=7, partition_size=14, **MANY
    ),
}

# Controllers around something: around another controller, or a filter of somebody else.


class OwnFilter(KalmanFilter):
    """A user's filter."""

    def update(self, z: Any, R: Any = None, H: Any = None) -> None:
        super().update(0.9 * z, R, H)


class OwnController:
    """A user's controller: FxLMS with a path that only delays, in the arrays that a user would take."""

    n_taps = 6

    def __init__(self) -> None:
        self.weights, self.x = np.zeros(6), [0.0] * 8
        self.count, self.emissions = 0, []
        self.secondary = np.array([0.0, 1.0])

    def control_signal(self, reference: float) -> float:
        self.x = [float(reference), *self.x[:-1]]
        return float(self.weights @ self.x[:6])

    def emitted(self, control_signal: float) -> None:
        self.emissions = [*self.emissions[-4:], control_signal]

    def update(self, error: float) -> None:
        self.weights = self.weights + 0.01 * float(error) * np.array(self.x[1:7])
        self.count += 1

    def listen(self, references: Any, errors: Any) -> None:
        self.x = [*references[:-9:-1], *self.x][:8]

    def state(self) -> dict[str, Any]:
        return vars(self)

    def restore(self, state: dict[str, Any]) -> None:
        vars(self).update(state)


def _with(made: Any, **attributes: Any) -> Any:
    for name, value in attributes.items():
        setattr(made, name, value)
    return made


def _full(kind: type = KFOPC, **settings: Any) -> Any:
    return _with(kind(N_TAPS, 1, **settings), P=P0 * np.eye(N_TAPS), Q=R * np.eye(N_TAPS), R=Q * np.eye(1))


def _guarded(controller: Any) -> Any:
    return _with(controller, secondary_path_uncertainty=PathTolerance(delay_samples=0.5, gain_db=1.0))


def _observer() -> KalmanObserver:
    import control

    A = np.diag([0.5, 0.3, -0.2])
    model = control.StateSpace(A, np.ones((3, 1)), np.eye(3), np.ones((3, 1)), 1 / FS)
    return KalmanObserver(model, n_physical=2, sensor_noise_std=0.1)


AROUND: dict[str, Any] = {
    "filterpy's filter": lambda: KalmanController(_full(KalmanFilter), S_HAT),
    "filterpy's filter, pinv": lambda: KalmanController(
        _with(_full(KalmanFilter), inv=np.linalg.pinv, alpha=1.001), S_HAT
    ),
    "a user's filter": lambda: KalmanController(_full(OwnFilter), S_HAT),
    "KFOPC": lambda: KalmanController(_full(constraint=constraint()), S_HAT),
    "fading memory": lambda: KalmanController(
        _with(KFOPC.random_walk(N_TAPS, **KALMAN), alpha=1.001), S_HAT, name="faded"
    ),
    "KF-PB, exact path": lambda: short_blocks(N_TAPS, S_HAT, rated_power=0.3, secondary_path_uncertainty=None),
    "guarded KF-OPC": lambda: _guarded(kf_opc(N_TAPS, S_HAT, constraint=constraint(), **KALMAN)),
    "guarded FxLMS": lambda: _guarded(fx_lms(N_TAPS, S_HAT, step_size=MU)),
    "guarded FxLMS, many": lambda: _guarded(fx_lms(L, PATHS, step_size=MU, **MANY)),
    "guarded KF-ANC, many": lambda: _guarded(kf_anc(L, PATHS, **KALMAN, **MANY)),
    "LimitedController": lambda: LimitedController(OwnController(), OutputLimiter(0.02, fs=FS, window_s=0.01)),
    "FeedbackNeutralizer": lambda: FeedbackNeutralizer(MAKERS["FxLMS"](), [0.0, 0.1, 0.05]),
    "FeedbackNeutralizer, many": lambda: FeedbackNeutralizer(
        SEVERAL["kf_anc"](), random_paths(I, J, 3, seed=4), amplifier=HardClipAmplifier(0.7)
    ),
    "VirtualMicrophones": lambda: VirtualMicrophones(
        fx_lms(L, PATHS[2:], step_size=MU, **MANY), PATHS, random_paths(1, 2, 3, seed=5), physical=[0, 1]
    ),
    "VirtualMicrophones, KalmanObserver": lambda: VirtualMicrophones(
        kf_anc(L, PATHS[2:], **KALMAN, **MANY), PATHS, _observer(), physical=[0, 1]
    ),
}
OWN = (OwnFilter, OwnController)  # what loading them needs beyond the package

# With an internal model: feedback control has no reference, hybrid control has some, too.

INTERNAL: dict[str, Any] = {
    f"feedback {name}": lambda n=name: with_internal_model(MAKERS[n]()) for name in ("FxLMS", "KF-OPC", "KF-PB", "MOV")
}
INTERNAL |= {
    "feedback filterpy's": lambda: with_internal_model(
        KalmanController(KFOPC.random_walk(N_TAPS, constraint=constraint(), **KALMAN), S_HAT)
    ),
    "hybrid, many": lambda: with_internal_model(fx_lms(L, PATHS, step_size=MU, limiter=limiters(), n_references=I + K)),
}

ALL: dict[str, Any] = {f"{name} {variant}": lambda n=name, v=variant: made(n, v) for name, variant in VARIANTS}
ALL |= {f"{name} many": make for name, make in SEVERAL.items()} | IN_BLOCKS | AROUND | INTERNAL

FILTERS: dict[str, Any] = {
    "KFOPC": lambda: _full(rated_power=0.3, fs=FS),
    "KFOPC, plain": _full,
    "random walk": lambda: KFOPC.random_walk(N_TAPS, **KALMAN),
    "random walk, KF-OPC": lambda: KFOPC.random_walk(N_TAPS, constraint=constraint(), **KALMAN),
}
