"""Each rival against its closed form: least squares, the best filter, or the power-constrained Wiener solution."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from comparisons.rivals import (
    FastArrayKalman,
    FrequencyDomainKalman,
    ImprovedMOV,
    PowerLimitedFxLMS,
    SubbandFxLMS,
    SubfilterKalman,
)
from comparisons.rivals.subfilters import band_subfilters
from kfopc_filterpy import Plant, noise_reduction_db, output_power, power_constrained_wiener, simulate
from kfopc_filterpy.bounds import wiener_solution

FS, L = 8000.0, 32
SECONDARY = np.array([0.0, 0.0, 0.8, 0.3, -0.2])
PLANT = Plant(SECONDARY, fs=FS)
PRIMARY = np.concatenate((np.zeros(6), 0.8 ** np.arange(20.0) * np.cos(np.arange(20.0))))


def coloured(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return a reference with a peak 20 dB high, and the disturbance with some noise of its own."""
    rng = np.random.default_rng(seed)
    x = lfilter([1.0], [1.0, -1.3, 0.7], rng.standard_normal(n))
    x /= np.std(x)
    return x, lfilter(PRIMARY, [1.0], x) + 0.02 * rng.standard_normal(n)


def run(controller: Any, x: np.ndarray, d: np.ndarray) -> Any:
    return simulate(controller, x, PLANT, disturbance=d)


@pytest.mark.parametrize("forgetting", [1.0, 0.999])
def test_the_fast_array_is_the_weighted_least_squares(forgetting: float) -> None:
    """Normal equations with P(0)^-1 = diag(1/lambda, ..., 1/lambda^L) / P0, all weighted by lambda^n: a dense solve.

    To 1e-8: without forgetting rounding errors stay near 1e-12, with 0.999 they grow by 1/lambda, 7 times in 2000 samples.
    """
    x, d = coloured(2000)
    controller = FastArrayKalman(L, SECONDARY, forgetting=forgetting, initial_variance=10.0)
    run(controller, x, d)
    H = toeplitz(np.convolve(x, SECONDARY)[: x.size], np.zeros(L))
    weight = forgetting ** np.arange(x.size - 1, -1, -1.0)
    start = forgetting ** (x.size - 1.0 - np.arange(L)) / 10.0
    normal = H.T @ (weight[:, None] * H) + np.diag(start)
    np.testing.assert_allclose(controller.weights, np.linalg.solve(normal, H.T @ (weight * d)), rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("controller", "loss_db"),
    [
        pytest.param(FrequencyDomainKalman(L, SECONDARY, block_size=8, transition=1.0 - 1e-6), 1.0, id="Kalman"),
        pytest.param(SubbandFxLMS(L, SECONDARY, step_size=0.02, n_bands=16), 8.0, id="subbands"),
    ],
)
def test_it_settles_near_the_best_filter(controller: Any, loss_db: float) -> None:
    x, d = coloured(48000)
    result = run(controller, x, d)
    best = wiener_solution(x, PLANT, n_taps=L, disturbance=d).noise_reduction_db
    assert best - loss_db < noise_reduction_db(result.error, d) < best + 0.1


def test_a_band_that_only_delays_is_stacked_into_a_delay() -> None:
    """w_b = 1 at the tap k of every band is a delay of k M/2 samples."""
    controller = SubbandFxLMS(64, [1.0], step_size=0.0, n_bands=16)
    controller.w_bands[3] = 1.0
    controller.adapt(np.zeros(9), np.zeros(9))
    np.testing.assert_allclose(controller.weights, np.eye(64)[3 * 8], rtol=0, atol=1e-12)


def test_power_limited_fxlms_settles_at_the_power_constrained_wiener_solution() -> None:
    x, d = coloured(48000)
    rated = 0.25 * wiener_solution(x, PLANT, n_taps=L, disturbance=d).control_power
    result = run(PowerLimitedFxLMS(L, SECONDARY, step_size=0.1, block_size=16, rated_power=rated), x, d)
    bound = power_constrained_wiener(
        x, PLANT, n_taps=L, rated_power=rated, switch_on_s=x.size / FS / 2, disturbance=d
    ).whole
    assert output_power(result.control_signal) == pytest.approx(rated, rel=0.02)
    assert noise_reduction_db(result.error, d) == pytest.approx(bound.noise_reduction_db, abs=0.1)


def test_improved_mov_identifies_the_path_and_scales_the_best_filter_on_a_flat_one() -> None:
    """With G_s the same at all frequencies (R_x' + gamma R_x) w = p gives sqrt(rho G_s / E[d^2]) times the best filter.

    To 3 %: the penalty factor follows powers over 1024 samples of white noise, and the step keeps the weights moving.
    """
    x, flat = np.random.default_rng(1).standard_normal(32000), [0.0, 0.8]
    d = lfilter(PRIMARY, [1.0], x)
    controller = ImprovedMOV(L, flat, step_size=1e-3, rated_power=0.5, primary=np.zeros(40))
    result = simulate(controller, x, Plant(flat, fs=FS), disturbance=d, switch_on_s=0.5)
    identified = np.pad(PRIMARY, (0, 40 - PRIMARY.size))
    np.testing.assert_allclose(controller.primary, identified, rtol=0, atol=1e-4)
    best = np.pad(PRIMARY[1:], (0, L - PRIMARY.size + 1)) / 0.8
    factor = np.sqrt(0.5 / np.sum(best**2))
    assert factor < 0.8
    np.testing.assert_allclose(controller.weights, factor * best, rtol=0, atol=0.03 * np.max(best))
    assert output_power(result.control_signal) == pytest.approx(0.5, rel=0.03)


def subfilter_run(rated_power: float) -> tuple[SubfilterKalman, Any, np.ndarray, np.ndarray]:
    """Return a run, and the outputs of its sub-filters before and after the secondary path, (n, C)."""
    x, d = coloured(24000)
    bank = band_subfilters(wiener_solution(x, PLANT, n_taps=L, disturbance=d).weights, 5)
    np.testing.assert_allclose(
        bank.sum(axis=0), wiener_solution(x, PLANT, n_taps=L, disturbance=d).weights, rtol=0, atol=1e-12
    )
    noises = {"state_noise": 0.0, "measurement_noise": 1e-3}
    controller = SubfilterKalman(L, SECONDARY, subfilters=bank, rated_power=rated_power, fs=FS, **noises)
    result = run(controller, x, d)
    outputs = np.array([lfilter(w, [1.0], x) for w in bank]).T
    return controller, result, outputs, lfilter(SECONDARY, [1.0], outputs, axis=0)


def test_gains_of_subfilters_are_least_squares() -> None:
    """P(0)^-1 = I and q = 1e-3; rounding leaves 1e-9 of the condition number's digits."""
    controller, result, _, filtered = subfilter_run(1e6)
    normal = filtered.T @ filtered + 1e-3 * np.eye(5)
    expected = np.linalg.solve(normal, filtered.T @ result.disturbance)
    np.testing.assert_allclose(controller.g, expected, rtol=0, atol=1e-9)


def test_gains_of_subfilters_within_a_rated_power_are_the_best_ones() -> None:
    """Of all gains with this power, on the means that the controller keeps; and the power is kept."""
    rated = 0.3
    controller, result, _, _ = subfilter_run(rated)
    reduced = controller.reduction @ controller.g
    assert reduced @ controller.R @ reduced == pytest.approx(rated, rel=1e-4)
    assert output_power(result.control_signal) == pytest.approx(rated, rel=0.05)

    def error(g: np.ndarray) -> float:
        return float((g - controller.g) @ controller.H @ (g - controller.g))

    rng = np.random.default_rng(0)
    for _ in range(200):
        other = reduced + 0.1 * rng.standard_normal(5)
        other *= np.sqrt(rated / (other @ controller.R @ other))
        assert error(other) > error(reduced) * (1 - 1e-4)
