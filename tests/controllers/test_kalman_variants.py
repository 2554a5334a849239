"""Other forms of the Kalman filter: FxRLS, and one with a diagonal covariance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import toeplitz

from kfopc_filterpy import Plant, diagonal_kf, fx_rls, simulate

L = 6
FS, PATH = 16000, np.array([0.0, 0.8, -0.3])


def signals(n: int = 400, seed: int = 5) -> tuple[np.ndarray, np.ndarray]:
    x, other = np.random.default_rng(seed).standard_normal((2, n))
    return x, np.convolve(x, [0.0, 0.0, 1.2, 0.5])[:n] + 0.1 * other


@pytest.mark.parametrize("forgetting", [1.0, 0.99])
def test_fxrls_is_the_weighted_least_squares(forgetting: float) -> None:
    """Normal equations over all samples, with the start's lambda^n / variance on the diagonal: a dense solve."""
    x, d = signals(300)
    controller = fx_rls(L, PATH, forgetting=forgetting, initial_variance=2.0)
    simulate(controller, x, Plant(PATH, fs=FS), disturbance=d)
    H = toeplitz(np.convolve(x, PATH)[: x.size], np.zeros(L))
    weight = forgetting ** np.arange(x.size - 1, -1, -1.0)
    normal = H.T @ (weight[:, None] * H) + forgetting**x.size / 2.0 * np.eye(L)
    np.testing.assert_allclose(controller.weights, np.linalg.solve(normal, H.T @ (weight * d)), rtol=0, atol=1e-10)


def test_diagonal_variances_stay_positive_and_a_silent_reference_tells_nothing() -> None:
    controller = diagonal_kf(L, PATH, state_noise=0.0, measurement_noise=0.0)
    result = simulate(controller, np.zeros(50), Plant(PATH, fs=FS), disturbance=np.ones(50))
    np.testing.assert_array_equal(result.error, np.ones(50))
    np.testing.assert_array_equal(controller.variances, np.ones(L))
    x, d = signals()
    simulate(controller, x, Plant(PATH, fs=FS), disturbance=d)
    assert np.all(controller.variances >= 0.0)
    controller.variances[:] = -1.0  # a copy
    assert np.all(controller.variances >= 0.0)
    assert np.all(np.isfinite(controller.weights))


def test_a_diagonal_step_that_would_be_too_large_is_left_out() -> None:
    """Without measurement noise, K = 1/x' for a first sample: a reference next to nothing asks for too much."""
    controller = diagonal_kf(2, [1.0], state_noise=0.0, measurement_noise=0.0)
    for x in (1e-160, 1e-60):  # of the first, even S underflows
        controller.control_signal(x)
        controller.update(1.0)
        assert (controller.weights[0], controller.variances[0]) == (0.0, 1.0)
    controller.control_signal(1e-40)
    controller.update(1.0)
    assert controller.weights[0] == pytest.approx(1e40)
