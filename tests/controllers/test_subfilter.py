"""A bank of sub-filters mixed by a small Kalman filter, against batch least squares and the bound."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from kfopc_filterpy import (
    LimitedController,
    OutputLimiter,
    noise_reduction_db,
    output_power,
    power_constrained_wiener,
    simulate,
)
from kfopc_filterpy.bounds import wiener_solution
from kfopc_filterpy.controllers import Controller, SubfilterKalman, band_subfilters

FS, L = 2000.0, 32
PRIMARY, SECONDARY = np.r_[np.zeros(8), 0.8, -0.4, 0.2], np.array([0.0, 0.0, 1.0, 0.3])
NOISES: dict[str, Any] = {"state_noise": 1e-8, "measurement_noise": 1e-3}


def white(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(n)


def broadband() -> np.ndarray:
    x = white(8000)
    return wiener_solution(x, np.convolve(PRIMARY, x)[: x.size], SECONDARY, L).weights


def run(controller: Controller, x: np.ndarray, **options: Any) -> Any:
    return simulate(controller, x, primary_path=PRIMARY, secondary_path=SECONDARY, fs=FS, **options)


@pytest.mark.parametrize(("taps", "n_bands"), [(32, 15), (33, 15), (32, 17), (5, 1)])
def test_the_bands_sum_to_the_filter_and_do_not_overlap(taps: int, n_bands: int) -> None:
    w = white(taps)
    bank = band_subfilters(w, n_bands)
    np.testing.assert_allclose(bank.sum(axis=0), w, atol=1e-12)
    heard = np.abs(np.fft.rfft(bank)) > 1e-9
    assert np.array_equal(heard.sum(axis=0), np.ones(taps // 2 + 1))


def test_the_gains_are_those_of_batch_least_squares() -> None:
    """Without state noise, a Kalman filter is regularised least squares: (sum h h' / q + I / P0) g = sum h d / q."""
    bank, x, q = band_subfilters(broadband(), 5), white(600, 1), 1e-2
    given = bank.copy()
    controller = SubfilterKalman(given, SECONDARY, state_noise=0.0, measurement_noise=q, initial_variance=2.0, fs=FS)
    given[:] = 0.0  # the controller has its own
    result = run(controller, x)
    rows = np.array([np.convolve(np.convolve(w, SECONDARY), x)[: x.size] for w in bank])
    expected = np.linalg.solve(rows @ rows.T / q + np.eye(5) / 2.0, rows @ result.disturbance / q)
    np.testing.assert_allclose(controller.gains, expected, rtol=1e-9)  # rounding of 600 steps
    np.testing.assert_allclose(controller.weights, expected @ bank, atol=1e-9)


def test_for_the_noise_of_the_design_all_gains_go_to_one_within_50_ms() -> None:
    controller = SubfilterKalman(band_subfilters(broadband()), SECONDARY, fs=FS, **NOISES)
    result = run(controller, white(4000, 2))
    np.testing.assert_allclose(controller.gains, 1.0, atol=0.02)  # q leaves sqrt(q / 4000) of the noise, and r a little
    assert noise_reduction_db(result.error[100:], result.disturbance[100:], steady=1.0) > 20.0


def test_the_rated_power_is_kept_and_spent_as_the_bound_spends_it() -> None:
    """With a sub-filter for each bin the bank can form what the bound needs, but for phases."""
    x, bank = white(6000, 3), band_subfilters(broadband(), L // 2 + 1)
    free = run(SubfilterKalman(bank, SECONDARY, fs=FS, **NOISES), x)
    rated = 0.05 * output_power(free.control_signal)
    controller = SubfilterKalman(bank, SECONDARY, rated_power=rated, fs=FS, **NOISES)
    result = run(controller, x)
    assert output_power(result.control_signal) == pytest.approx(rated, rel=0.02)
    best = power_constrained_wiener(x, result.disturbance, SECONDARY, L, rated, fs=FS).whole.noise_reduction_db
    assert best - 0.3 < noise_reduction_db(result.error, result.disturbance) < best + 0.1


def test_the_gains_are_learned_from_what_a_limiter_lets_through() -> None:
    """With the signal before the limiter, the disturbance would look louder than it is."""
    free, controller = (SubfilterKalman(band_subfilters(broadband()), SECONDARY, fs=FS, **NOISES) for _ in range(2))
    x = white(4000, 2)
    rated = 0.1 * output_power(run(free, x).control_signal)
    run(LimitedController(controller, OutputLimiter(rated, fs=FS)), x)
    np.testing.assert_allclose(controller.gains, 1.0, atol=0.02)


def test_an_ample_rated_power_changes_nothing() -> None:
    x, bank = white(2000, 4), band_subfilters(broadband())
    free, ample = (
        run(SubfilterKalman(bank, SECONDARY, rated_power=power, fs=FS, **NOISES), x, switch_on_s=0.1)
        for power in (None, 1e3)
    )
    np.testing.assert_array_equal(free.control_signal, ample.control_signal)


def test_another_sample_rate_and_too_many_bands_are_refused() -> None:
    controller = SubfilterKalman(band_subfilters(broadband(), 5), SECONDARY, rated_power=0.1, fs=FS, **NOISES)
    with pytest.raises(ValueError, match="make it with the fs of the run"):
        simulate(controller, white(9), disturbance=white(9), secondary_path=SECONDARY, fs=2 * FS)
    with pytest.raises(ValueError, match="n_bands must be at most 17"):
        band_subfilters(broadband(), 18)
