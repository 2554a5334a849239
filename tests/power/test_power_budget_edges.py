"""Where a power budget was once led astray: awkward spectra, failed searches, overflow, filterpy's further calls."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from filterpy.common import Saver
from helpers.compiled import from_python
from helpers.power_budget import correlation, made, signals, step, within

from kfopc_filterpy import bandpass_path
from kfopc_filterpy.filters import PowerBudgetKalmanFilter
from kfopc_filterpy.kernels import toeplitz
from kfopc_filterpy.paths import duct_paths, path_taps
from kfopc_filterpy.power import PowerBudget
from kfopc_filterpy.power.allocation import POWER_TOLERANCE
from kfopc_filterpy.signals import band_limited_noise

toeplitz_power = from_python(toeplitz.toeplitz_power)


def test_two_tones_heard_20_db_apart():
    n, k = 64, np.arange(64)
    low, high = np.cos(np.outer(2 * np.pi * np.array([4, 22]) / n, k))
    of_x, of_xf, w = 0.5 * (low + high), 0.5 * (low + 0.01 * high), (low + high) / n
    weight, _ = within(of_x, of_xf, w, toeplitz_power(of_x, w) / 2.0)
    assert math.isfinite(weight)  # not scaled, whose error is 30 times the least


@pytest.mark.parametrize("n", [16, 64, 128])
@pytest.mark.parametrize("path", ["duct", "band-pass"])
@pytest.mark.parametrize("band", [(20.0, 7900.0), (50.0, 7000.0), (200.0, 2000.0)])
def test_lambda_is_found_on_real_paths(n, path, band):
    s = path_taps(duct_paths().secondary if path == "duct" else bandpass_path(32))
    failed = []
    for seed in range(3):
        x = band_limited_noise(band, 1.0, fs=16000.0, rng=seed)
        xf = np.convolve(x, s)[: x.size]
        rng = np.random.default_rng(seed)
        p = np.zeros(200)
        p[40:] = rng.standard_normal(160) * np.exp(-np.arange(160) / 15)
        d = np.convolve(x, p)[: x.size]
        of_x, of_xf = correlation(x, n), correlation(xf, n)
        cross = np.array([xf[: x.size - k] @ d[k:] for k in range(n)]) / x.size
        wiener = np.linalg.solve(scipy.linalg.toeplitz(of_xf) + 1e-6 * of_xf[0] * np.eye(n), cross)
        for w in (wiener, rng.standard_normal(n)):
            for overdrive in (1.05, 1.5, 4.0, 30.0):
                power = toeplitz_power(of_x, w) / overdrive
                for start in (0.0, 1e-4, 1e4):  # of of_xf/of_x: where the last lambda may have been
                    weight, v = within(of_x, of_xf, w, power, start * of_xf[0] / of_x[0])
                    kept = abs(toeplitz_power(of_x, v) / power - 1) <= POWER_TOLERANCE * 1.001
                    if not (math.isfinite(weight) and kept):
                        failed.append((seed, overdrive, start))
    assert not failed


def test_after_a_fallback_it_is_solved_again():
    of_x, of_xf, w = np.array([1.0, 0.0]), np.array([1.0, 0.5]), np.array([2.0, 1.0])
    weight, _ = within(of_x, of_xf, w, 1.0, weight=math.inf)
    assert math.isfinite(weight)


def test_a_filter_that_begins_with_weights_is_solved_for_once_the_path_is_filled():
    budget, rng = PowerBudget(2, 1.0), np.random.default_rng(0)
    for n, x in enumerate(rng.standard_normal(20_000)):
        budget.control_signal(x)
        budget.advance(x, 0.0 if n < 10 else x, [2.0, 1.0])  # a secondary path of ten samples' delay
    assert math.isfinite(budget.power_weight)


def test_a_batch_is_the_steps():
    x, _, filtered, d = signals(200)
    zs = [None if n == 77 else float(z) for n, z in enumerate(d)]
    ours, stepped = made(), made()
    savers = [Saver(ours), Saver(stepped)]
    means = ours.batch_filter(zs, Hs=list(filtered), references=x, saver=savers[0])[0]
    for n, z in enumerate(zs):
        step(stepped, z, filtered[n], reference=x[n])
        savers[1].save()
    for saver in savers:
        saver.to_array()
    for name in ("x", "P", "control_filter", "power_weight", "rated_power"):
        np.testing.assert_array_equal(getattr(savers[0], name), getattr(savers[1], name), err_msg=name)
    np.testing.assert_array_equal(means, savers[0].x)
    before = {name: np.copy(getattr(ours, name)) for name in ("x", "P", "control_filter", "power_weight")}
    account = ours.budget.account_s
    with pytest.raises(ValueError, match="z must be finite"):
        ours.batch_filter([1.0, math.nan], Hs=list(filtered[:2]), references=x[:2])
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(ours, name), value, err_msg=name)
    assert ours.budget.account_s == account


def test_weights_that_overflow_do_not_poison():
    budget, rng = PowerBudget(2, 1.0), np.random.default_rng(0)
    signal = np.convolve(rng.standard_normal(3000), [1.0, 0.9])
    for n, x in enumerate(signal):
        try:
            budget.control_signal(x)
            budget.advance(x, x, [1e200, -1e200] if 1500 <= n < 1700 else [2.0, 0.0])
        except ValueError:
            pass  # to refuse them would do as well
    assert np.isfinite(budget.account_s)
    assert np.all(np.isfinite(budget.control_filter))


@pytest.mark.parametrize("H", [[], np.zeros((0, 2))])
def test_an_empty_row_is_refused_as_by_the_other_filters(H):
    kf = PowerBudgetKalmanFilter(2, state_noise=1e-6, measurement_noise=0.1, rated_power=1.0)
    with pytest.raises(ValueError, match="must have"):
        kf.update(1.0, H=H, reference=1.0)


def test_update_correlated_reaches_the_control_filter():
    kf = PowerBudgetKalmanFilter(2, state_noise=1e-6, measurement_noise=0.1, rated_power=1e6)
    kf.M = np.zeros((2, 1))
    for _ in range(10):
        kf.predict()
        kf.update_correlated(1.0, H=np.array([[1.0, 0.0]]), reference=1.0)
    assert np.linalg.norm(kf.control_filter) > 0


def test_the_disturbance_power_of_a_budget():
    kf = PowerBudgetKalmanFilter(2, state_noise=1e-6, measurement_noise=0.1, rated_power=1.0)
    with pytest.raises(ValueError, match="budget"):  # "... set rated_power first"
        kf.disturbance_power = 1.0


@pytest.mark.parametrize("scale", [1e154, 1e80, 1e-170])
def test_levels_whose_squares_leave_the_range_are_forgotten(scale: float) -> None:
    budget = PowerBudget(2, 1.0, fs=1000.0, memory_s=0.1, averaging_s=0.3)
    for n, x in enumerate(np.random.default_rng(0).uniform(-1, 1, 1500)):
        budget.advance(x, (scale if 500 <= n < 600 else 1.0) * x, [2.0, 1.0])
    assert np.all(np.isfinite(budget.control_filter))
    assert 0.0 < budget.power_weight < np.inf
    assert abs(budget.account_s) < 0.1
