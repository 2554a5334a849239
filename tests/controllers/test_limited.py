"""A limiter behind controllers: the loop with it, its bound there, and what the adaptation hears of it."""

from __future__ import annotations

import math
import pickle
from typing import Any

import numpy as np
import pytest
from helpers.comparing import assert_same_run
from helpers.controllers import MAKERS
from helpers.loop import AMPLIFIERS, FEEDBACK, FS, S_HAT, N, noises
from hypothesis import given, settings
from hypothesis import strategies as st

from kfopc_filterpy import LimitedController, OutputLimiter, Plant, simulate

RATED_POWER, WINDOW = 0.05, 80  # of the limiter; the window in samples
NAMES = ("KF-ANC", "KF-OPC", "KF-PB", "FxLMS", "MOV")


def limiter(rated_power: float = RATED_POWER, **options: Any) -> OutputLimiter:
    return OutputLimiter(rated_power, **{"fs": FS, "window_s": WINDOW / FS} | options)


def run(made: Any, *, n: int = N, level: Any = 1.0, plant: Plant | None = None, **options: Any) -> Any:
    x, d, _ = noises(n)
    return simulate(made, level * x, plant or Plant(S_HAT, fs=FS), disturbance=level * d, **options)


def worst_window(y: np.ndarray, samples: int = WINDOW) -> float:
    """Largest mean square over a window of so many samples, zeros before the first, each sum correctly rounded."""
    squares = [float(v) * float(v) for v in y]
    return max(math.fsum(squares[max(n + 1 - samples, 0) : n + 1]) for n in range(len(squares))) / samples


def assert_kept(y: np.ndarray, rated_power: float = RATED_POWER) -> None:
    """1e-9: the limiter's bound is exact, the oracle's squares round to 1e-16."""
    assert np.all(np.isfinite(y))
    assert worst_window(y) <= rated_power * (1 + 1e-9)


# ---- The bound


@given(
    name=st.sampled_from(NAMES),
    decades=st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=6),
    error_of_the_path=st.sampled_from([1.0, -1.0, 0.1, 10.0]),
    rated=st.floats(-4.0, 2.0),
)
@settings(max_examples=40)
def test_no_window_is_above_the_rated_power_for_any_levels(
    name: str, decades: list[float], error_of_the_path: float, rated: float
) -> None:
    level = np.repeat(10.0 ** np.array(decades), -(-400 // len(decades)))[:400]
    made = MAKERS[name](limiter=limiter(10.0**rated))
    result = run(made, n=400, level=level, plant=Plant(error_of_the_path * S_HAT, fs=FS))
    assert_kept(result.control_signal, 10.0**rated)


@pytest.mark.parametrize("name", ["KF-OPC", "FxLMS"])
def test_windows_across_two_runs_keep_the_bound(name: str) -> None:
    """Of a limiter that is assigned, too; one that began anew would not: both runs fill their windows at the seam."""
    worst = {}
    for second in ("the same", "assigned", "begins anew"):
        made = MAKERS[name](limiter=limiter())
        y = [run(made).control_signal]
        if second == "assigned":
            made.limiter = limiter()
        if second == "begins anew":
            made.limiter.reset()
        worst[second] = worst_window(np.concatenate([*y, run(made, n=200, level=30.0).control_signal]))
    assert max(worst["the same"], worst["assigned"]) <= RATED_POWER * (1 + 1e-9)
    assert worst["begins anew"] > 1.2 * RATED_POWER


# ---- Assigned, removed, copied, refused


@pytest.mark.parametrize("name", ["KF-OPC", "KF-PB", "FxLMS"])
def test_a_limiter_can_be_assigned_and_removed(name: str) -> None:
    given_, removed = (MAKERS[name](limiter=limiter()) for _ in range(2))
    assigned, plain = (MAKERS[name]() for _ in range(2))
    own = limiter()
    assigned.limiter, removed.limiter = own, None
    assert (assigned.limiter, removed.limiter, plain.limiter) == (own, None, None)
    assert_same_run(run(given_), run(assigned))
    assert_same_run(run(plain), run(removed))
    assert own.gain == given_.limiter.gain < 1.0
    assigned.limiter = None
    before = pickle.dumps(own)
    run(assigned)
    assert pickle.dumps(own) == before  # it is out of the loop


def test_a_limiter_of_another_rate_is_refused_before_anything_changes() -> None:
    for made in (MAKERS["FxLMS"](limiter=limiter(fs=2 * FS)), LimitedController(Proportional(), limiter(fs=2 * FS))):
        before = pickle.dumps(made)
        with pytest.raises(ValueError, match="limiter is for 16000 Hz, but the run is at 8000 Hz: make it with"):
            run(made)
        assert pickle.dumps(made) == before


# ---- A user's own controller


class Own:
    """FxLMS, of which the wrapper sees two methods and `listen`."""

    def __init__(self) -> None:
        inner = MAKERS["FxLMS"]()
        self.control_signal, self.update, self.listen = inner.control_signal, inner.update, inner.listen


class Proportional:
    """A controller that does not adapt, with a gain for tests."""

    name, constraint_factor, gain = "proportional", 0.25, 10.0

    def __init__(self) -> None:
        self.played: list[float] = []

    def control_signal(self, reference: float) -> float:
        return self.gain * reference

    def update(self, error: float) -> None:
        pass

    def emitted(self, control_signal: float) -> None:
        self.played.append(control_signal)


def test_a_users_controller_is_limited_as_the_built_in_is() -> None:
    """FxLMS adapts to the error alone, so it need not be told: to the bit the one with a limiter of its own."""
    plant = Plant(S_HAT, feedback=FEEDBACK, amplifier=AMPLIFIERS["soft"][0], fs=FS)
    options: dict[str, Any] = {"plant": plant, "switch_on_s": 37 / FS}
    limited = LimitedController(Own(), limiter())
    result, built_in = run(limited, **options), run(MAKERS["FxLMS"](limiter=limiter()), **options)
    np.testing.assert_array_equal(result.control_signal, built_in.control_signal)
    np.testing.assert_array_equal(result.error, built_in.error)
    assert result.algorithm == "Own limited"
    assert limited.limiter.gain < 1.0


def test_a_users_controller_is_told_what_is_played_and_the_rest_is_its_own() -> None:
    limited = LimitedController(Proportional(), limiter())
    result = run(limited)
    assert_kept(result.control_signal)
    np.testing.assert_array_equal(limited.played, result.control_signal)
    assert result.algorithm == "proportional limited"
    np.testing.assert_array_equal(result.constraint_factor, np.full(N, 0.25))
    with pytest.raises(AttributeError, match=r"Proportional.* no attribute 'loudness'"):
        _ = limited.loudness
    with pytest.raises(ValueError, match="switch_on_s needs a controller with a method listen"):
        run(limited, switch_on_s=37 / FS)


@pytest.mark.parametrize(
    ("own", "limits", "error", "message"),
    [
        (Own(), 1.0, TypeError, r"^limiter must be an OutputLimiter, got 1\.0"),
        (Own, limiter(), TypeError, r"must have control_signal\(reference\) and update\(error\), got <class"),
        (MAKERS["FxLMS"](), limiter(), ValueError, "limiter of its own: set controller.limiter"),
    ],
)
def test_refusals_of_a_limited_controller(own: Any, limits: Any, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        LimitedController(own, limits)
