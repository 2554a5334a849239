"""Eq. 10-13: running powers and the constraint factor, against sums taken afresh at every sample.

The tolerances are relative and a few thousand roundings (1e-12): a window holds up to some hundred squares,
summed in another order here.
"""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
from oracles.powers import Constraint as Oracle

from kfopc_filterpy import OutputPowerConstraint

FS = 1000.0
CLOSE = 1e-12


def constraint(samples: float, window: str = "exponential", **kwargs: float) -> OutputPowerConstraint:
    """A constraint whose memory is `samples` samples."""
    return OutputPowerConstraint(kwargs.pop("rated_power", 1.0), fs=FS, memory_s=samples / FS, window=window, **kwargs)


def signals(n: int, seed: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Disturbance, filtered reference, reference."""
    rng = np.random.default_rng(seed)
    return 3.0 * rng.normal(size=n), 0.5 * rng.normal(size=n), rng.normal(size=n)


@pytest.mark.parametrize("window", ["exponential", "sliding"])
@pytest.mark.parametrize("samples", [1, 7, 50])
def test_powers_gain_and_factor_follow_eq_10_to_13(window: str, samples: int) -> None:
    ours = constraint(samples, window, rated_power=0.8)
    oracle = Oracle(0.8, fs=FS, memory_s=samples / FS, window=window)
    for d, xf, x in zip(*signals(160), strict=True):
        assert ours.advance(d, xf, x) == pytest.approx(oracle.take(d**2, xf**2, x**2), rel=CLOSE)
        assert ours.disturbance_power == pytest.approx(oracle.disturbance_power, rel=CLOSE)
        assert ours.secondary_path_gain == pytest.approx(oracle.gain, rel=CLOSE)
        assert ours.factor == pytest.approx(oracle.alpha, rel=CLOSE)


def test_the_sliding_window_keeps_no_rounding() -> None:
    """Loud, then 300 dB softer: once the loud part has left the window nothing of it remains.

    A running sum with the oldest square taken off it would keep 1e30 * 1e-16.
    """
    samples, switch = 100, 1037
    x = np.random.default_rng(1).normal(size=switch + 3 * samples)
    x[:switch] *= 1e15
    ours = constraint(samples, "sliding", secondary_path_gain=1.0)
    for n in range(x.size):
        ours.advance(x[n])
        if n >= switch:
            assert ours.disturbance_power == pytest.approx(np.mean(x[n + 1 - samples : n + 1] ** 2), rel=CLOSE)


@pytest.mark.parametrize("window", ["exponential", "sliding"])
def test_preview_is_advance_without_the_change(window: str) -> None:
    ours = constraint(5, window)
    for d, xf, x in zip(*signals(30), strict=True):
        before = pickle.dumps(ours)
        expected = ours.preview(d, xf, x)
        assert pickle.dumps(ours) == before
        assert ours.advance(d, xf, x) == expected
    assert pickle.dumps(ours) != before


def test_no_disturbance_gives_1() -> None:
    ours = constraint(10, secondary_path_gain=1e-6)
    assert ours.advance(0.0) == 1.0
    assert ours.disturbance_power == 0.0
    assert ours.advance(1e-200) == 1.0  # its square is no normal number
    assert constraint(10, window="sliding", secondary_path_gain=1e-320).advance(1e-155) == 1.0  # nor has a ratio digits
    assert ours.advance(1.0) == pytest.approx(math.sqrt(1e-6 * 3), rel=CLOSE)
    ours.disturbance_power = 0.0
    assert ours.advance(1.0) == 1.0


def test_a_silent_reference_gives_the_last_gain_or_1() -> None:
    ours = constraint(3, "sliding")
    assert ours.secondary_path_gain is None
    assert ours.advance(10.0, 0.0, 0.0) == 1.0  # no gain known yet
    ours.advance(10.0, 2.0, 4.0)
    assert ours.secondary_path_gain == 0.25
    for _ in range(5):  # the reference leaves the window
        factor = ours.advance(10.0, 0.0, 0.0)
    assert ours.secondary_path_gain == 0.25
    assert factor == pytest.approx(math.sqrt(0.25 / 100.0), rel=CLOSE)
    ours.advance(10.0, 3.0, 1.0)
    assert ours.secondary_path_gain == 9.0


def test_a_sample_without_reference_leaves_the_powers_of_the_reference() -> None:
    ours, other = constraint(4), constraint(4)
    for c in (ours, other):
        c.advance(1.0, 2.0, 4.0)
    ours.secondary_path_gain = 7.0
    ours.advance(5.0, 9.0)
    ours.secondary_path_gain = None
    other.advance(5.0, 0.5, 1.0)
    ours.advance(1.0, 0.5, 1.0)
    gain = ours.secondary_path_gain
    assert gain == other.secondary_path_gain
    ours.factor = 0.5
    ours.advance(3.0)
    assert ours.secondary_path_gain == gain


def test_what_is_supplied_takes_part_until_it_is_taken_back() -> None:
    ours, untouched = constraint(10), constraint(10)
    d, xf, x = signals(30)
    for n in range(10):
        ours.advance(d[n], xf[n], x[n])
        untouched.advance(d[n], xf[n], x[n])
    ours.disturbance_power, ours.secondary_path_gain = 16.0, 4.0
    assert ours.advance(d[10], xf[10], x[10]) == 0.5
    assert (ours.disturbance_power, ours.secondary_path_gain) == (16.0, 4.0)
    ours.factor = 0.125
    assert ours.factor == ours.advance(d[11], xf[11], x[11]) == 0.125
    ours.factor = ours.disturbance_power = ours.secondary_path_gain = None
    for n in (10, 11, 12):
        untouched.advance(d[n], xf[n], x[n])
    assert ours.advance(d[12], xf[12], x[12]) == untouched.factor  # the powers went on all the while
    assert ours.disturbance_power == untouched.disturbance_power
    assert ours.secondary_path_gain == untouched.secondary_path_gain


def test_a_reference_is_needed_unless_the_gain_or_the_factor_is_supplied() -> None:
    ours = constraint(10)
    for method in (ours.advance, ours.preview):
        with pytest.raises(ValueError, match=r"reference=.*secondary_path_gain"):
            method(1.0, 1.0)
    ours.factor = 0.5
    assert ours.advance(1.0) == 0.5
    ours.factor, ours.secondary_path_gain = None, 1.0
    ours.advance(1.0)


@pytest.mark.parametrize(("bad", "position"), [(math.nan, 0), (math.inf, 1), (1e200, 0), ([1.0, 2.0], 2), (None, 0)])
def test_a_bad_sample_changes_nothing(bad: object, position: int) -> None:
    ours = constraint(10)
    ours.advance(1.0, 2.0, 3.0)
    before = pickle.dumps(ours)
    sample: list = [1.0, 2.0, 3.0]
    sample[position] = bad
    with pytest.raises((ValueError, TypeError), match=r"measurement|reference"):
        ours.advance(*sample)
    assert pickle.dumps(ours) == before


@pytest.mark.parametrize(
    "kwargs",
    [{"rated_power": 0.0}, {"secondary_path_gain": -1.0}, {"fs": 0.0}, {"memory_s": math.inf}, {"window": "hann"}],
)
def test_settings_out_of_range(kwargs: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        OutputPowerConstraint(**{"rated_power": 1.0, "fs": FS} | kwargs)


@pytest.mark.parametrize("name", ["factor", "disturbance_power", "secondary_path_gain", "rated_power"])
def test_assignments_out_of_range(name: str) -> None:
    ours = constraint(10, secondary_path_gain=1.0)
    before = pickle.dumps(ours)
    with pytest.raises(ValueError, match=name):
        setattr(ours, name, -0.1)
    assert pickle.dumps(ours) == before


def test_the_memory_is_in_seconds() -> None:
    """The same signal, held twice as long at twice the rate, leaves the same power."""
    powers = []
    for fs in (8000.0, 16000.0):
        ours = OutputPowerConstraint(1.0, secondary_path_gain=1.0, fs=fs, memory_s=0.01)
        for level, seconds in ((2.0, 0.2), (1.0, 0.01)):
            for _ in range(round(seconds * fs)):
                ours.advance(level)
        powers.append(ours.disturbance_power)
    assert powers[0] == pytest.approx(powers[1], rel=CLOSE)
    assert powers[0] == pytest.approx(1.0 + 3.0 * math.exp(-1.0), rel=CLOSE)
