"""The rated power needed for a noise reduction, against a direct simulation of the scaled Wiener filter."""

import numpy as np
import pytest
import scipy.signal
from helpers.channels import random_paths
from hypothesis import given
from hypothesis import strategies as st

from kfopc_filterpy import Plant, power_constrained_wiener
from kfopc_filterpy.bounds import budgeted_rated_power, required_rated_power
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
    plant = Plant(s, [0, 0, 1.0, -0.4, 0.2], fs=FS)
    best, d = wiener_solution(x, plant, n_taps=16), plant.disturbance(x)
    needed = required_rated_power([3.0, 6.0, 10.0], **{name: getattr(best, name) for name in POWERS})
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
        (5.0, {"antinoise_power": 2.1}, "antinoise_power must not exceed disturbance_power"),
    ],
)
def test_refuses(wanted, changes, message):
    with pytest.raises(ValueError, match=message):
        required_rated_power(wanted, **{**POWERS, **changes})


# ---- Several loudspeakers

FS, TAPS, K, J = 1000.0, 8, 3, 2
PLANT = Plant(random_paths(K, J, 7, seed=0), random_paths(K, 2, 12, seed=1, delay=3), fs=FS)
RNG = np.random.default_rng(2)
X = np.array([np.convolve(row, [1.0, 0.7], "same") for row in RNG.standard_normal((2, 2500))])
D = PLANT.disturbance(X) + 0.1 * RNG.standard_normal((K, 2500))


def bound(rated_power):
    return power_constrained_wiener(X, PLANT, n_taps=TAPS, rated_power=rated_power, disturbance=D)


def test_scaled_filters_of_several_loudspeakers_reach_the_reduction_at_those_powers():
    free = bound(1e6).unconstrained
    powers = {name: getattr(free, name) for name in POWERS}
    needed = required_rated_power([0.5, 1.5], **powers)
    assert needed.rated_power.shape == (2, J)
    assert required_rated_power(0.5, **powers).rated_power.shape == (J,)
    for wanted, rated, factor in zip([0.5, 1.5], needed.rated_power, needed.constraint_factor, strict=True):
        scaled = bound(rated).scaled
        assert scaled.noise_reduction_db == pytest.approx(wanted, abs=1e-6)
        assert scaled.constraint_factor == pytest.approx(factor, rel=1e-6)
        np.testing.assert_allclose(scaled.control_power, rated, rtol=1e-9)
    silent = required_rated_power(3.0, disturbance_power=2.0, antinoise_power=1.9, control_power=[5.0, 0.0])
    assert silent.rated_power[1] == 0.0 < silent.rated_power[0]
    out = required_rated_power([3.0, 40.0], **POWERS | {"control_power": [5.0, 0.0]}, beyond="inf")
    assert out.rated_power[1].tolist() == [np.inf, np.inf]


@pytest.mark.parametrize("proportions", [None, [1.0, 5.0]])
def test_a_budget_of_that_power_reaches_the_reduction_and_less_does_not(proportions):
    most = bound(1e6).unconstrained.noise_reduction_db
    wanted = np.array([[1e-3, 0.3 * most], [0.6 * most, 0.95 * most]])
    needed = budgeted_rated_power(wanted, X, PLANT, n_taps=TAPS, disturbance=D, proportions=proportions)
    assert needed.rated_power.shape == needed.control_power.shape == needed.penalty.shape == (2, 2, J)
    np.testing.assert_allclose(needed.rated_power[..., 1] / needed.rated_power[..., 0], (proportions or [1, 1])[1])
    for index in np.ndindex(2, 2):
        rated = needed.rated_power[index]
        reached = bound(rated).whole
        assert reached.noise_reduction_db == pytest.approx(wanted[index], abs=1e-4)
        np.testing.assert_allclose(reached.control_power, needed.control_power[index], rtol=1e-3)
        assert bound(0.9 * rated).whole.noise_reduction_db < wanted[index]
        assert bound(rated).scaled.noise_reduction_db < wanted[index]  # spent best is better than scaled


def test_a_budget_for_one_channel_is_the_single_channel_bounds():
    one_path, given = Plant(PLANT.secondary[0, 0], fs=FS), {"n_taps": TAPS, "disturbance": D[0]}
    needed = budgeted_rated_power(1.0, X[0], one_path, **given)
    assert needed.rated_power.shape == needed.penalty.shape == ()
    one = power_constrained_wiener(X[0], one_path, rated_power=float(needed.rated_power), **given).whole
    assert one.noise_reduction_db == pytest.approx(1.0, abs=1e-3)
    assert one.penalty == pytest.approx(float(needed.penalty), rel=1e-3)


def test_the_limits_of_a_budget():
    free = bound(1e6).unconstrained
    most = free.noise_reduction_db
    needed = budgeted_rated_power([0.0, most, most + 1.0], X, PLANT, n_taps=TAPS, disturbance=D, beyond="inf")
    assert needed.rated_power[0].tolist() == [0.0, 0.0]
    assert needed.rated_power[1].max() == pytest.approx(free.control_power.max(), rel=0.01)  # no rating binds
    assert np.isinf(needed.rated_power[2]).all()
    assert np.isnan(needed.penalty[2]).all()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"noise_reduction_db": 90.0}, "must not exceed what unlimited power attains, .* dB, got 90 dB; use longer"),
        ({"proportions": [1.0, 2.0, 3.0]}, "proportions must be one number or one for each of the 2 loudspeakers"),
        ({"beyond": "nan"}, "beyond must be one of"),
        (
            {"plant": PLANT.changed_at(1.0, amplifier=np.tanh)},
            "budgeted_rated_power needs a plant that does not change",
        ),
    ],
    ids=["far", "three", "beyond", "a changing plant"],
)
def test_a_budget_that_cannot_be_is_refused(changed, message):
    settings = {"noise_reduction_db": 1.0, "plant": PLANT, "disturbance": D} | changed
    with pytest.raises(ValueError, match=message):
        budgeted_rated_power(reference=X, n_taps=TAPS, **settings)


def test_powers_of_loudspeakers_that_cannot_be_are_refused():
    for powers in ([1.0, -1.0], [0.0, 0.0], [1.0, np.nan]):
        with pytest.raises(ValueError, match="control_power must"):
            required_rated_power(1.0, **POWERS | {"control_power": powers})
