"""The third term of the budgets, R_Wx': against dense matrices of signals that were filtered by W."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.channels import constrained_filters, correlation, random_paths
from kfopc_filterpy.power.budget import allocate
from kfopc_filterpy.power.channels import RIDGE, ChannelBudget

from kfopc_filterpy.paths import PathTolerance, guard_filter, path_uncertainty
from kfopc_filterpy.power import PowerBudget

GUARD = guard_filter(path_uncertainty(PathTolerance(delay_samples=1.0), [1.0]), [1.0])
assert GUARD is not None
SECONDARY = np.array([0.0, 0.8, 0.5, -0.3])


def matrix_of(signals: list[np.ndarray], taps: int) -> np.ndarray:
    """The correlation matrix of each signal with zeros around it, summed."""
    total = np.zeros((taps, taps))
    for signal in signals:
        rows = np.array([np.concatenate([np.zeros(k), signal, np.zeros(taps - k)]) for k in range(taps)])
        total += rows @ rows.T
    return total


@pytest.mark.parametrize("rated_power", [1e6, 0.05])
def test_the_budget_of_one_loudspeaker_solves_the_dense_system(rated_power: float) -> None:
    """All samples are in one segment of the window."""
    taps, n_samples = 12, 2048
    x = np.random.default_rng(1).standard_normal(n_samples)
    filtered = np.convolve(x, SECONDARY)[:n_samples]
    w = np.random.default_rng(2).standard_normal(taps)
    budget = PowerBudget(taps, rated_power, fs=2000.0, memory_s=20.0, guard=GUARD)
    for reference, own in zip(x, filtered, strict=True):
        budget.advance(reference, own, w, 0.0 if rated_power > 1 else np.sqrt(rated_power))
    allocate(budget.state, w)
    R, guarded = matrix_of([filtered], taps), matrix_of([np.convolve(filtered, GUARD)], taps)
    of_x = matrix_of([x], taps)
    expected = np.linalg.solve(R + guarded + budget.power_weight * of_x, R @ w)
    np.testing.assert_allclose(budget.control_filter, expected, rtol=1e-5, atol=1e-5)  # the ridge is 1e-7
    unguarded = np.linalg.solve(R + budget.power_weight * of_x, R @ w)
    assert np.abs(unguarded - expected).max() > 0.01
    assert (budget.power_weight > 0.0) == (rated_power < 1.0)


def test_a_bad_guard_is_refused() -> None:
    for guard in ([np.nan], [[1.0]], []):
        with pytest.raises(ValueError, match="guard"):
            PowerBudget(4, 1.0, guard=guard)


def test_the_budget_of_several_loudspeakers_solves_the_dense_system() -> None:
    """The guarded correlation is that of the filtered references after W: two microphones stand for one with a guard."""
    K, J, taps, path, primary = 2, 2, 10, 6, 8
    secondary, p = random_paths(K, J, path, seed=2), random_paths(K, 1, primary, seed=3, delay=2)
    x = np.random.default_rng(4).standard_normal((1, 20000))
    rated = np.array([0.02, 0.001])
    budget = ChannelBudget(secondary, taps, primary, 1, rated, 100.0, GUARD)
    D = correlation(x, budget.n_lags)
    for _ in range(60):
        budget.solve(D, p)
    after = np.array([[np.convolve(s, GUARD) for s in row] for row in secondary])

    def dense(paths: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Sums over the taps of the paths of R_x at l + t - m - u."""
        steps = np.arange(taps)
        lag = steps[:, None] - steps[None, :]
        total = np.zeros((paths.shape[1], taps, others.shape[1], taps))
        for a in range(paths.shape[1]):
            for b in range(others.shape[1]):
                for k in range(len(paths)):
                    both = np.convolve(paths[k, a], others[k, b][::-1])  # at t - u = index - (size of others - 1)
                    for index, value in enumerate(both):
                        total[a, :, b] += value * D[np.abs(lag + index - (others.shape[2] - 1)), 0, 0]
        return total.reshape(paths.shape[1] * taps, -1)

    R = dense(secondary, secondary)
    steps, total = np.arange(taps), np.zeros((J, taps))
    for j in range(J):
        for k in range(K):
            for t in range(path):
                for u in range(primary):
                    total[j] += secondary[k, j, t] * p[k, 0, u] * D[np.abs(steps + t - u), 0, 0]
    of_x = D[np.abs(steps[:, None] - steps[None, :]), 0, 0]
    matrix = R + dense(after, after)
    w, _, power = constrained_filters(matrix, of_x, total.ravel(), rated, RIDGE)
    np.testing.assert_allclose(budget.weights.reshape(J, -1), w, rtol=1e-4, atol=1e-5 * np.abs(w).max())
    unguarded, _, _ = constrained_filters(R, of_x, total.ravel(), rated, RIDGE)
    assert np.abs(unguarded - w).max() > 0.01 * np.abs(w).max()
    assert np.all(power <= 1.001 * rated)
