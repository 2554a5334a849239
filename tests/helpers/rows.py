"""Rows of observations for filters."""

import numpy as np


def rows_of(kind: str, n: int, steps: int, rng: np.random.Generator) -> np.ndarray:
    """Observation rows (steps, n): unrelated ones, or a delay line fed with a signal, newest sample first."""
    if kind == "unrelated":
        return rng.normal(size=(steps, n))
    signal = rng.normal(size=steps + n)
    if kind == "low-passed line":
        signal = np.convolve(signal, np.hanning(12))[: steps + n]
    if kind == "tonal line":
        signal = np.sin(0.2 * np.arange(steps + n)) + 1e-4 * signal
    return np.array([signal[k + n - 1 :: -1][:n] for k in range(steps)])
