"""A filter with a power budget and signals for it; correlations, and the control filter that they make."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg
from filterpy.kalman import KalmanFilter

from helpers.compiled import from_python
from kfopc_filterpy.filters import PowerBudgetKalmanFilter
from kfopc_filterpy.power import allocation

constrained_filter = from_python(allocation.constrained_filter)

N_TAPS = 8
SETTINGS: dict[str, Any] = {"state_noise": 1e-6, "measurement_noise": 0.05}
SECONDARY = np.array([0.0, 0.8, 0.3])


def made(n_taps: int = N_TAPS, **options: Any) -> PowerBudgetKalmanFilter:
    """A filter at 1 kHz with a window of 0.3 s."""
    return PowerBudgetKalmanFilter(n_taps, **SETTINGS | {"rated_power": 0.3, "fs": 1000.0, "memory_s": 0.3} | options)


def signals(n: int, n_taps: int = N_TAPS, silent: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Reference, its rows, rows of the filtered reference, disturbance; the reference falls silent at the end."""
    rng = np.random.default_rng(0)
    x = np.convolve(rng.standard_normal(n), [1.0, 0.5])[:n]
    x[n - silent :] = 0.0
    d = np.convolve(x, [0.0, 0.0, 0.0, 1.2, -0.7, 0.4])[:n] + 0.1 * rng.standard_normal(n)
    rows, filtered = (scipy.linalg.toeplitz(u, np.zeros(n_taps)) for u in (x, np.convolve(x, SECONDARY)[:n]))
    return x, rows, filtered, d


def step(kf: KalmanFilter, z: Any, h: np.ndarray, **options: Any) -> None:
    """Predict and update."""
    kf.predict()
    kf.update(z, H=h, **options)


def correlation(x: np.ndarray, n: int) -> np.ndarray:
    """Lags 0 to n - 1 of a stretch with zeros around it: a definite Toeplitz matrix's first row."""
    return np.correlate(x, x, mode="full")[x.size - 1 :][:n] / x.size


def within(
    of_x: np.ndarray, of_xf: np.ndarray, w: np.ndarray, power: float, weight: float = 0.0
) -> tuple[float, np.ndarray]:
    """lambda and the control filter within the power."""
    v = np.full(w.size, np.nan)
    return constrained_filter(of_x, of_xf, w, power, weight, v), v
