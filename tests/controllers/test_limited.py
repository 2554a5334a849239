"""A limiter behind controllers: the loop with it, its bound there, and what the adaptation hears of it."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import numpy as np
import pytest
from helpers.comparing import assert_same_run
from helpers.controllers import short_blocks
from helpers.loop import AMPLIFIERS, FEEDBACK, FS, MEMORY_S, MU, P0, Q, R, S, noises
from helpers.naming import plain
from hypothesis import given, settings
from hypothesis import strategies as st

from kfopc_filterpy import (
    FxLMS,
    HardClipAmplifier,
    LimitedController,
    MOVFxLMS,
    OutputLimiter,
    OutputPowerConstraint,
    kf_anc,
    kf_opc,
    kf_opc_repaired,
    simulate,
    simulate_scenarios,
)
from kfopc_filterpy.controllers.core_controller import CoreController

N_TAPS, N = 10, 500
RATED_POWER, LIMITED_POWER = 0.3, 0.05
WINDOW = 80  # samples
KALMAN = ("KF-ANC", "KF-OPC", "KF-OPC repaired", "KF-PB")
NAMES = (*KALMAN, "FxLMS", "MOV-FxLMS")


def limiter(rated_power: float = LIMITED_POWER, **options: Any) -> OutputLimiter:
    return OutputLimiter(rated_power, **{"fs": FS, "window_s": WINDOW / FS} | options)


def controller(name: str, path: Any = S, **options: Any) -> CoreController:
    """A controller; the estimated path is the true one unless another is given."""
    if name == "FxLMS":
        return FxLMS(N_TAPS, path, step_size=MU, **options)
    constraint = OutputPowerConstraint(RATED_POWER, fs=FS, memory_s=MEMORY_S)
    if name == "MOV-FxLMS":
        return MOVFxLMS(N_TAPS, path, step_size=MU, constraint=constraint, **options)
    kalman = {"state_noise": R, "measurement_noise": Q, "initial_variance": P0, **options}
    if name == "KF-ANC":
        return kf_anc(N_TAPS, path, **kalman)
    if name == "KF-PB":
        return short_blocks(N_TAPS, path, rated_power=RATED_POWER, **options)
    make = kf_opc if name == "KF-OPC" else kf_opc_repaired
    return make(N_TAPS, path, constraint=constraint, **kalman)


def run(made: Any, *, n: int = N, seed: int = 3, **options: Any) -> Any:
    x, d, _ = noises(n, seed)
    return simulate(made, x, **{"disturbance": d, "secondary_path": S, "fs": FS} | options)


def worst_window(y: np.ndarray, samples: int = WINDOW) -> float:
    """Largest mean square over a window of so many samples, zeros before the first, each sum correctly rounded."""
    squares = [float(v) * float(v) for v in y]
    return max(math.fsum(squares[max(n + 1 - samples, 0) : n + 1]) for n in range(len(squares))) / samples


def assert_kept(y: np.ndarray, rated_power: float = LIMITED_POWER) -> None:
    """1e-9: the limiter's bound is exact, the oracle's squares round to 1e-16."""
    assert np.all(np.isfinite(y))
    assert worst_window(y) <= rated_power * (1 + 1e-9)


# ---- In the loop


@pytest.mark.parametrize("name", NAMES)
def test_what_fits_passes_as_if_there_were_no_limiter(name: str) -> None:
    """Its rated power is a hundred times the control signal's largest window."""
    options = {"record_weights_every": 1, "record_powers": True}
    free = run(controller(name), **options)
    limited = run(controller(name, limiter=limiter(100.0 * worst_window(free.control_signal))), **options)
    assert_same_run(free, limited)


# ---- The bound


@given(
    name=st.sampled_from(NAMES),
    seed=st.integers(0, 1000),
    decades=st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=6),
    estimate=st.sampled_from([1.0, -1.0, 0.1, 10.0]),
    rated=st.floats(-4.0, 2.0),
)
@settings(max_examples=40)
def test_no_window_is_above_the_rated_power_for_any_levels(
    name: str, seed: int, decades: list[float], estimate: float, rated: float
) -> None:
    x, d, _ = noises(400, seed)
    level = np.repeat(10.0 ** np.array(decades), -(-400 // len(decades)))[:400]
    made = controller(name, estimate * S, limiter=limiter(10.0**rated))
    result = simulate(made, level * x, disturbance=level * d, secondary_path=S, fs=FS)
    assert_kept(result.control_signal, 10.0**rated)


@pytest.mark.parametrize("name", ["KF-OPC", "FxLMS"])
def test_windows_across_two_runs_keep_the_bound(name: str) -> None:
    """A limiter that began anew with the second run would not: both runs fill their windows at the seam."""
    both = []
    for anew in (False, True):
        made = controller(name, limiter=limiter())
        first = run(made)
        if anew:
            made.limiter.reset()
        x, d, _ = noises(200)
        second = simulate(made, 30.0 * x, disturbance=30.0 * d, secondary_path=S, fs=FS)
        both.append(np.concatenate([first.control_signal, second.control_signal]))
    assert_kept(both[0])
    assert worst_window(both[1]) > 1.2 * LIMITED_POWER


# ---- What the adaptation hears


@pytest.mark.parametrize("name", ["KF-ANC", "KF-OPC"])
def test_the_weights_are_those_without_a_limiter(name: str) -> None:
    """With the exact path z, factor and H do not depend on what is played; to rounding, in a filter that contracts.

    A limiter outside spoils them. KF-OPC's the least: a d^ that is too small raises its factor.
    """
    options = {"record_powers": True}
    free, known, unaware = controller(name), controller(name, limiter=limiter()), controller(name)
    results = [run(free, **options), run(known, **options)]
    spoilt = run(unaware, amplifier=limiter(), record_powers=True)  # a user's own amplifier: any function of a sample
    assert np.max(np.abs(results[0].control_signal - results[1].control_signal)) > 0.2
    assert_kept(results[1].control_signal)
    assert_kept(spoilt.amplifier_output)
    scale = np.max(np.abs(free.weights))
    np.testing.assert_allclose(known.weights, free.weights, rtol=0, atol=1e-10 * scale)
    np.testing.assert_allclose(results[1].disturbance_power, results[0].disturbance_power, rtol=1e-10, atol=1e-12)
    assert np.max(np.abs(unaware.weights - free.weights)) > (0.003 if name == "KF-OPC" else 0.1) * scale


# ---- Assigned, removed, copied, refused


@pytest.mark.parametrize("name", ["KF-OPC", "KF-PB", "FxLMS"])
def test_a_limiter_can_be_assigned_and_removed(name: str) -> None:
    given_, assigned, removed, plain = (
        controller(name, limiter=limiter()), controller(name), controller(name, limiter=limiter()), controller(name)
    )  # fmt: skip
    assert plain.limiter is None
    own = limiter()
    assigned.limiter, removed.limiter = own, None
    assert assigned.limiter is own
    assert removed.limiter is None
    assert_same_run(run(given_), run(assigned))
    assert_same_run(run(plain), run(removed))
    assert own.gain == given_.limiter.gain < 1.0
    assigned.limiter = None
    before = pickle.dumps(own)
    run(assigned)
    assert pickle.dumps(own) == before  # it is out of the loop


@pytest.mark.parametrize("wrong", [1.0, "limiter", OutputLimiter, np.tanh, HardClipAmplifier(1.0)], ids=plain)
def test_what_is_no_limiter_is_refused(wrong: Any) -> None:
    made = controller("FxLMS", limiter=limiter())
    own = made.limiter
    with pytest.raises(TypeError, match=r"^limiter must be an OutputLimiter or None, got "):
        made.limiter = wrong
    assert made.limiter is own
    with pytest.raises(TypeError, match=r"^limiter must be an OutputLimiter or None, got "):
        controller("FxLMS", limiter=wrong)


def test_a_limiter_of_another_rate_is_refused_before_anything_changes() -> None:
    made = controller("FxLMS", limiter=limiter(fs=2 * FS))
    before = pickle.dumps(made)
    with pytest.raises(
        ValueError,
        match=r"^fs is 8000 Hz but the controller's limiter is for 16000 Hz: make it with the fs of the run$",
    ):
        run(made)
    assert pickle.dumps(made) == before
    made.limiter = limiter()
    assert run(made).error.size == N
    with pytest.raises(ValueError, match="limiter is for 16000 Hz"):
        run(LimitedController(Loud(), limiter(fs=2 * FS)))


def test_scenarios_agree_in_their_limiters_windows() -> None:
    x, d, _ = noises()
    two = [controller("KF-ANC"), controller("KF-OPC", limiter=limiter())]
    with pytest.raises(ValueError, match="must agree in the windows of their limiters to share gains"):
        simulate_scenarios(two, x, disturbance=d, secondary_path=S, fs=FS)
    two[1].limiter = None
    assert len(simulate_scenarios(two, x, disturbance=d, secondary_path=S, fs=FS)) == 2


# ---- A user's own controller


class Own:
    """LMS by hand, which keeps its estimate of the disturbance from what it believes was played."""

    name = "own LMS"

    def __init__(self) -> None:
        self.inner = FxLMS(N_TAPS, S, step_size=MU)
        self.played: list[float] = []
        self.estimates: list[float] = []

    @property
    def weights(self) -> np.ndarray:
        return self.inner.weights

    def control_signal(self, reference: float) -> float:
        self.played.append(10.0 * self.inner.control_signal(reference))
        return self.played[-1]

    def update(self, error: float) -> None:
        newest = self.played[: -S.size - 1 : -1]
        self.estimates.append(error + float(np.dot(S[: len(newest)], newest)))
        self.inner.update(error)


class Told(Own):
    """One that is told what the limiter let through."""

    constraint_factor = 0.25

    def emitted(self, control_signal: float) -> None:
        self.played[-1] = control_signal

    def listen(self, references: np.ndarray, errors: np.ndarray) -> None:
        self.inner.listen(references, errors)


def test_a_users_controller_is_limited_as_the_built_in_is() -> None:
    """FxLMS adapts to the error alone, so it need not be told: to the bit the one with a limiter of its own."""

    class Plain:
        def __init__(self) -> None:
            inner = FxLMS(N_TAPS, S, step_size=MU)
            self.control_signal, self.update, self.listen = inner.control_signal, inner.update, inner.listen

    options = {"feedback_path": FEEDBACK, "amplifier": AMPLIFIERS["soft"][0], "switch_on_s": 37 / FS}
    limited = LimitedController(Plain(), limiter())
    result, built_in = run(limited, **options), run(controller("FxLMS", limiter=limiter()), **options)
    np.testing.assert_array_equal(result.control_signal, built_in.control_signal)
    np.testing.assert_array_equal(result.error, built_in.error)
    assert result.algorithm == "Plain limited"
    assert limited.limiter.gain < 1.0


@pytest.mark.parametrize("make", [Own, Told])
def test_a_users_controller_with_a_limiter_keeps_the_bound(make: type) -> None:
    limited = LimitedController(make(), limiter())
    result = run(limited, record_weights_every=100)
    assert_kept(result.control_signal)
    assert limited.limiter.gain < 0.8
    assert result.algorithm == "own LMS limited"
    assert result.weights.shape == (5, N_TAPS)
    assert np.all(np.any(result.weights[1:] != 0, axis=1))  # after sample 0 it has heard nothing yet
    heard = np.array(limited.estimates) - result.disturbance
    if make is Told:  # rounding of sums over five taps
        np.testing.assert_allclose(heard, 0.0, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(limited.played, result.control_signal)
    else:
        assert np.mean(heard**2) > 0.1 * np.mean(result.disturbance**2)


def test_everything_else_is_the_users_controllers() -> None:
    own, told = LimitedController(Own(), limiter()), LimitedController(Told(), limiter())
    assert told.constraint_factor == 0.25
    np.testing.assert_array_equal(run(told, switch_on_s=37 / FS).constraint_factor, np.full(N - 37, 0.25))
    assert np.all(np.isnan(run(own, n=20).constraint_factor))
    with pytest.raises(AttributeError, match=r"Own.* no attribute 'loudness'"):
        _ = own.loudness
    with pytest.raises(ValueError, match=r"switch_on_s needs a controller with a method listen"):
        run(own, switch_on_s=37 / FS)


@pytest.mark.parametrize(
    ("own", "limits", "error", "message"),
    [
        (Own(), 1.0, TypeError, r"^limiter must be an OutputLimiter, got 1\.0"),
        (
            Own,
            limiter(),
            TypeError,
            r"^controller must have control_signal\(reference\) and update\(error\), got <class",
        ),
        (controller("FxLMS"), limiter(), ValueError, r"limiter of its own: set controller\.limiter, or pass limiter="),
    ],
)
def test_refusals_of_a_limited_controller(own: Any, limits: Any, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        LimitedController(own, limits)


class Loud:
    """Has special methods of its own, which are not the limited controller's."""

    def control_signal(self, reference: float) -> float:
        return 10.0 * reference

    def update(self, error: float) -> None:
        pass

    def __deepcopy__(self, memo: Any) -> Loud:
        return Loud()

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)


@pytest.mark.parametrize(
    "copied",
    [copy.copy, copy.deepcopy, lambda made: pickle.loads(pickle.dumps(made))],
    ids=["copy", "deepcopy", "pickle"],
)
def test_a_copy_is_limited_too(copied: Any) -> None:
    other = copied(LimitedController(Loud(), OutputLimiter(1.0, amplitude_limit=2.0)))
    assert isinstance(other, LimitedController)
    assert other.control_signal(1.0) == 2.0


def test_nan_is_a_divergence_as_without_the_limiter() -> None:
    class Diverging(Loud):
        def control_signal(self, reference: float) -> float:
            return math.nan

    for made in (Diverging(), LimitedController(Diverging(), limiter())):
        assert run(made, n=20).diverged_at_s == 0.0
