"""FxRLS against the batch least squares that it solves."""

from __future__ import annotations

import numpy as np
import pytest

from kfopc_filterpy import fx_rls, simulate

L = 6
PATH = np.array([0.0, 0.8, -0.3])


def signals(n: int = 300) -> tuple[np.ndarray, np.ndarray]:
    x, other = np.random.default_rng(5).standard_normal((2, n))
    return x, np.convolve(x, [0.0, 0.0, 1.2, 0.5])[:n] + 0.1 * other


def rows_of(signal: np.ndarray) -> np.ndarray:
    """(n, L) newest sample first."""
    padded = np.r_[np.zeros(L - 1), signal]
    return np.array([padded[n : n + L][::-1] for n in range(signal.size)])


@pytest.mark.parametrize("forgetting", [1.0, 0.99])
def test_the_weights_are_the_weighted_least_squares(forgetting: float) -> None:
    """Normal equations over all samples, with the start's lambda^n / variance on the diagonal: a dense solve."""
    x, d = signals()
    controller = fx_rls(L, PATH, forgetting=forgetting, initial_variance=2.0)
    simulate(controller, x, disturbance=d, secondary_path=PATH)
    H = rows_of(np.convolve(x, PATH)[: x.size])
    weight = forgetting ** np.arange(x.size - 1, -1, -1.0)
    normal = H.T @ (weight[:, None] * H) + forgetting**x.size / 2.0 * np.eye(L)
    np.testing.assert_allclose(controller.weights, np.linalg.solve(normal, H.T @ (weight * d)), rtol=0, atol=1e-10)
