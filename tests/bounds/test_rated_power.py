"""The rated power needed for a noise reduction, against a direct simulation of the scaled Wiener filter."""

import numpy as np
import pytest
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st

from kfopc_filterpy.bounds.rated_power import required_rated_power
from kfopc_filterpy.bounds.wiener import wiener_solution

POWERS = {"disturbance_power": 2.0, "antinoise_power": 1.9, "control_power": 5.0}


@given(factor=st.floats(0.0, 1.0))
def test_inverts_the_error_of_a_scaled_filter(factor):
    remaining = 2.0 - (2 * factor - factor**2) * 1.9
    wanted = -10 * np.log10(remaining / 2.0)
    needed = required_rated_power(max(wanted, 0.0), **POWERS)
    # Near factor 1 the error is flat in it: its root loses half of the digits.
    assert needed.constraint_factor == pytest.approx(factor, abs=1e-6)
    assert needed.rated_power == pytest.approx(factor**2 * 5.0, abs=1e-5)


def test_scaled_filter_reaches_the_reduction_at_that_power():
    rng = np.random.default_rng(0)
    x = rng.standard_normal(20_000)
    s = np.array([0.0, 0.7, 0.4])
    d = scipy.signal.lfilter([0, 0, 1.0, -0.4, 0.2], 1.0, x)
    best = wiener_solution(x, d, s, 16)
    needed = required_rated_power(
        [3.0, 6.0, 10.0],
        disturbance_power=best.disturbance_power,
        antinoise_power=best.antinoise_power,
        control_power=best.control_power,
    )
    start = 16 + 3 - 2
    for wanted, factor, power in zip([3.0, 6.0, 10.0], needed.constraint_factor, needed.rated_power, strict=True):
        y = scipy.signal.lfilter(factor * best.weights, 1.0, x)
        e = d - scipy.signal.lfilter(s, 1.0, y)
        assert np.mean(y[start:] ** 2) == pytest.approx(power, rel=1e-9)
        assert -10 * np.log10(np.mean(e[start:] ** 2) / np.mean(d[start:] ** 2)) == pytest.approx(wanted)


def test_limits_and_shapes():
    assert required_rated_power(0.0, **POWERS).rated_power == 0.0
    limit = -10 * np.log10(1 - 1.9 / 2.0)
    assert required_rated_power(limit, **POWERS).rated_power == pytest.approx(5.0, rel=1e-4)
    grid = required_rated_power([[1.0, 5.0], [10.0, 40.0]], **POWERS, beyond="inf")
    assert grid.rated_power.shape == grid.constraint_factor.shape == (2, 2)
    assert np.isinf(grid.rated_power[1, 1])
    assert grid.constraint_factor[1, 1] == 1.0
    assert np.all(np.diff(grid.rated_power.ravel()) > 0)


@pytest.mark.parametrize(
    ("wanted", "changes", "message"),
    [
        ([5.0, 20.0], {}, r"must not exceed what the Wiener filter attains, 13.01 dB, got 20 dB"),
        (-1.0, {}, "noise_reduction_db must not be negative"),
        (np.nan, {}, "noise_reduction_db must be finite"),
        (5.0, {"antinoise_power": 2.1}, "antinoise_power must not exceed disturbance_power"),
        (5.0, {"control_power": 0.0}, "control_power must be greater than 0"),
        (5.0, {"beyond": "nan"}, "beyond must be one of 'raise', 'inf'"),
    ],
)
def test_refuses(wanted, changes, message):
    with pytest.raises(ValueError, match=message):
        required_rated_power(wanted, **{**POWERS, **changes})
