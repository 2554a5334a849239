"""The rated power needed for a noise reduction, against the bound within that power."""

import numpy as np
import pytest
from helpers.channels import random_paths

from kfopc_filterpy import Plant, power_constrained_wiener
from kfopc_filterpy.bounds import required_rated_power

FS, TAPS, K, J = 1000.0, 8, 3, 2
PLANT = Plant(random_paths(K, J, 7, seed=0), random_paths(K, 2, 12, seed=1, delay=3), fs=FS)
RNG = np.random.default_rng(2)
X = np.array([np.convolve(row, [1.0, 0.7], "same") for row in RNG.standard_normal((2, 2500))])
D = PLANT.disturbance(X) + 0.1 * RNG.standard_normal((K, 2500))


def bound(rated_power):
    return power_constrained_wiener(X, PLANT, n_taps=TAPS, rated_power=rated_power, disturbance=D)


@pytest.mark.parametrize("proportions", [None, [1.0, 5.0]])
def test_a_budget_of_that_power_reaches_the_reduction_and_less_does_not(proportions):
    most = bound(1e6).unconstrained.noise_reduction_db
    wanted = np.array([[1e-3, 0.3 * most], [0.6 * most, 0.95 * most]])
    needed = required_rated_power(wanted, X, PLANT, n_taps=TAPS, disturbance=D, proportions=proportions)
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
    needed = required_rated_power(1.0, X[0], one_path, **given)
    assert needed.rated_power.shape == needed.penalty.shape == ()
    one = power_constrained_wiener(X[0], one_path, rated_power=float(needed.rated_power), **given).whole
    assert one.noise_reduction_db == pytest.approx(1.0, abs=1e-3)
    assert one.penalty == pytest.approx(float(needed.penalty), rel=1e-3)


def test_the_limits_of_a_budget():
    free = bound(1e6).unconstrained
    most = free.noise_reduction_db
    needed = required_rated_power([0.0, most, most + 1.0], X, PLANT, n_taps=TAPS, disturbance=D)
    assert needed.rated_power[0].tolist() == [0.0, 0.0]
    assert needed.rated_power[1].max() == pytest.approx(free.control_power.max(), rel=0.01)  # no rating binds
    assert np.isinf(needed.rated_power[2]).all()
    assert np.isnan(needed.penalty[2]).all()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"noise_reduction_db": -1.0}, "noise_reduction_db must not be negative"),
        ({"proportions": [1.0, 2.0, 3.0]}, "proportions must be one number or one for each of the 2 loudspeakers"),
        (
            {"plant": PLANT.changed_at(1.0, amplifier=np.tanh)},
            "required_rated_power needs a plant that does not change",
        ),
    ],
    ids=["negative", "three", "a changing plant"],
)
def test_a_budget_that_cannot_be_is_refused(changed, message):
    settings = {"noise_reduction_db": 1.0, "plant": PLANT, "disturbance": D} | changed
    with pytest.raises(ValueError, match=message):
        required_rated_power(reference=X, n_taps=TAPS, **settings)
