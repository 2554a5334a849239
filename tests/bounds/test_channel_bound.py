"""The bound for several loudspeakers: against dense sums over delayed signals, and one channel of today."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.channels import constrained_filters, dense_systems, random_paths, through

from kfopc_filterpy import Plant, power_constrained_wiener

FS, K, J, REFERENCES, TAPS = 1000.0, 3, 2, 2, 10
SECONDARY = random_paths(K, J, 7, seed=0)
PRIMARY = random_paths(K, REFERENCES, 12, seed=1, delay=3)
PLANT = Plant(SECONDARY, fs=FS)  # without the primary path: the disturbance has noise of its own


def signals(n_samples: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    x = np.array([np.convolve(row, [1.0, 0.7], "same") for row in rng.standard_normal((REFERENCES, n_samples))])
    return x, through(PRIMARY, x) + 0.1 * rng.standard_normal((K, n_samples))


def test_the_bound_meets_dense_solves_and_every_budget() -> None:
    x, d = signals()
    R, of_x, r = dense_systems(x, d, SECONDARY, TAPS, 0)
    free = np.linalg.solve(R, r).reshape(J, -1)
    wanted = np.einsum("ja,ab,jb->j", free, of_x, free)
    rated = np.array([0.3 * wanted[0], 4.0 * wanted[1]])  # the second does not bind
    bound = power_constrained_wiener(x, PLANT, n_taps=TAPS, rated_power=rated, disturbance=d)
    w, penalty, power = constrained_filters(R, of_x, r, rated, ridge=1e-12)
    np.testing.assert_allclose(bound.unconstrained.weights.reshape(J, -1), free, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(bound.whole.weights.reshape(J, -1), w, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(bound.whole.penalty, penalty, rtol=1e-3, atol=1e-7 * penalty.max())
    np.testing.assert_allclose(bound.whole.control_power, power, rtol=1e-4)
    assert bound.whole.control_power[0] == pytest.approx(rated[0], rel=1e-4)
    assert bound.whole.penalty[1] == 0.0
    error = d - bound.whole.stretch.antinoise(bound.whole.weights)
    expected = -10 * np.log10(np.mean(error**2) / np.mean(d**2))
    assert bound.whole.noise_reduction_db == pytest.approx(expected, abs=1e-9)
    assert bound.scaled.constraint_factor == pytest.approx(np.sqrt(0.3), rel=1e-6)
    assert bound.unconstrained.noise_reduction_db > bound.whole.noise_reduction_db > bound.scaled.noise_reduction_db


@pytest.mark.parametrize("share", [1e-8, 0.99])
def test_the_powers_are_met_however_tight_they_are(share: float) -> None:
    """With the optimality conditions of the problem, from dense sums: a gradient of zero, and what binds used up."""
    x, d = signals()
    R, of_x, r = dense_systems(x, d, SECONDARY, TAPS, 0)
    free = np.linalg.solve(R, r).reshape(J, -1)
    rated = share * np.einsum("ja,ab,jb->j", free, of_x, free)
    bound = power_constrained_wiener(x, PLANT, n_taps=TAPS, rated_power=rated, disturbance=d).whole
    w = bound.weights.reshape(J, -1)
    left = R @ w.ravel() + np.ravel(bound.penalty[:, np.newaxis] * (w @ of_x)) - r
    assert np.linalg.norm(left) < 1e-7 * np.linalg.norm(r)
    assert np.all(bound.penalty > 0)
    np.testing.assert_allclose(np.einsum("ja,ab,jb->j", w, of_x, w), rated, rtol=2e-5)


@pytest.mark.parametrize("difference", [0.0, 1e-5, 1e-3])
def test_loudspeakers_that_are_alike_keep_their_powers(difference: float) -> None:
    """The free solution then has powers that mean nothing, up to a million times what the bound spends."""
    x, d = signals()
    alike = np.stack([SECONDARY[:, 0], SECONDARY[:, 0] + difference * SECONDARY[:, 1]], axis=1)
    one = power_constrained_wiener(
        x, Plant(SECONDARY[:, :1], fs=FS), n_taps=TAPS, rated_power=0.02, disturbance=d
    ).whole
    two = power_constrained_wiener(x, Plant(alike, fs=FS), n_taps=TAPS, rated_power=0.01, disturbance=d).whole
    assert np.all(two.control_power < 0.01 * 1.001)
    assert two.noise_reduction_db > one.noise_reduction_db  # 0.01 from each of two is as loud as 0.04 from one
    if difference == 0.0:
        np.testing.assert_allclose(two.weights[0], two.weights[1], rtol=1e-4, atol=1e-8)


def test_each_second_keeps_its_budgets() -> None:
    x, d = signals()
    x, d = x * np.repeat([1.0, 3.0, 0.1], 1000), d * np.repeat([1.0, 3.0, 0.1], 1000)
    bound = power_constrained_wiener(x, PLANT, n_taps=TAPS, rated_power=0.05, disturbance=d)
    assert bound.per_second.control_power.shape == (3, J)
    assert np.all(bound.per_second.control_power <= 0.05 * (1 + 1e-4))
    assert bound.per_second.control_signal.shape == (J, 3000)
    assert bound.per_second.error.shape == (K, 3000)
    reductions = bound.noise_reduction_over(1.0)
    assert reductions["unconstrained"] > reductions["per_second"] > reductions["scaled_per_second"]


def test_one_channel_as_a_matrix_is_the_bound_of_one_channel() -> None:
    """To 1e-4: the ridge in place of the eigenvalue cut, and the tolerance to which the budget is met."""
    x, d = signals()
    one = power_constrained_wiener(x[0], Plant(SECONDARY[0, 0], fs=FS), n_taps=TAPS, rated_power=0.02, disturbance=d[0])
    matrix = power_constrained_wiener(
        x[:1], Plant(SECONDARY[:1, :1], fs=FS), n_taps=TAPS, rated_power=0.02, disturbance=d[:1]
    )
    np.testing.assert_allclose(matrix.whole.weights.ravel(), one.whole.weights, rtol=1e-3, atol=1e-5)
    assert matrix.whole.noise_reduction_db == pytest.approx(one.whole.noise_reduction_db, abs=1e-4)


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"rated_power": [1.0, 2.0, 3.0]}, "one for each of the 2 loudspeakers"),
        ({"disturbance": np.ones((2, 3000))}, r"\(K microphones, n_samples\) = \(3, 3000\)"),
        ({"disturbance": np.zeros((K, 3000))}, "silent"),
        ({"plant": Plant(0.0 * SECONDARY, fs=FS)}, "silent"),
        ({"plant": PLANT.changed_at(1.0, secondary=-SECONDARY)}, "needs a plant that does not change"),
        ({"disturbance": None}, "the disturbance is unknown: make the plant with a primary path"),
    ],
    ids=["powers", "microphones", "silent disturbance", "silent paths", "a changing plant", "no disturbance"],
)
def test_what_does_not_fit_is_refused(changed: dict, match: str) -> None:
    x, d = signals()
    given = {"reference": x, "plant": PLANT, "disturbance": d, "rated_power": 1.0} | changed
    with pytest.raises(ValueError, match=match):
        power_constrained_wiener(**given, n_taps=TAPS)


def test_the_disturbance_is_that_of_the_primary_path_unless_one_is_given() -> None:
    x, _ = signals()
    plant = Plant(SECONDARY, PRIMARY, fs=FS)
    own = power_constrained_wiener(x, plant, n_taps=TAPS, rated_power=0.05)
    given = power_constrained_wiener(x, PLANT, n_taps=TAPS, rated_power=0.05, disturbance=plant.disturbance(x))
    np.testing.assert_array_equal(own.whole.weights, given.whole.weights)
    other = power_constrained_wiener(x, plant, n_taps=TAPS, rated_power=0.05, disturbance=2.0 * plant.disturbance(x))
    assert other.whole.disturbance_power == pytest.approx(4.0 * own.whole.disturbance_power, rel=1e-12)


@pytest.mark.parametrize("gain", [1e-3, 1e3])
def test_loudspeakers_of_unlike_gains_meet_the_optimality_conditions(gain: float) -> None:
    """A gain is a change of units: the same noise reduction and share of the powers, in other units."""
    x, d = signals()
    gains, rated = np.r_[gain, np.ones(J - 1)], np.full(J, 0.05)
    usual = power_constrained_wiener(x, PLANT, n_taps=TAPS, rated_power=rated, disturbance=d).whole
    other = power_constrained_wiener(
        x, Plant(SECONDARY * gains[:, np.newaxis], fs=FS), n_taps=TAPS, rated_power=rated / gains**2, disturbance=d
    ).whole
    assert other.noise_reduction_db == pytest.approx(usual.noise_reduction_db, abs=1e-3)
    np.testing.assert_allclose(other.control_power * gains**2, usual.control_power, rtol=1e-3)
