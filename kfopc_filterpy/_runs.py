"""Runs as arrays, and ratios of powers: shared by the figures of merit in time and in frequency."""

from __future__ import annotations

from typing import Any

import numpy as np

from ._validate import as_number, as_positive


def as_runs(value: Any, name: str) -> np.ndarray:
    """Return `value` as float64 (n_runs, n_samples); NaN is let through, as diverged runs end in it."""
    if np.iscomplexobj(value):
        raise TypeError(f"{name} must be an array of real numbers, got complex ones")
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be an array of real numbers, got {type(value).__name__}") from error
    if array.ndim not in (1, 2):
        raise ValueError(f"{name} must be (n_samples,) or (n_runs, n_samples), got shape {array.shape}")
    if array.size == 0:
        raise ValueError(f"{name} must have at least one sample, got shape {array.shape}")
    if np.any(np.isinf(array)):
        raise ValueError(f"{name} must hold finite numbers, or NaN after a divergence, but holds Inf")
    return np.atleast_2d(array)


def as_pair(first: Any, first_name: str, second: Any, second_name: str) -> tuple[np.ndarray, np.ndarray]:
    """Two signals of one run, of the same shape."""
    one, two = as_runs(first, first_name), as_runs(second, second_name)
    if one.shape != two.shape:
        raise ValueError(f"{first_name} and {second_name} must have one shape, got {one.shape} and {two.shape}")
    return one, two


def steady_part(runs: np.ndarray, steady: float) -> np.ndarray:
    """The last `steady` portion of each run, at least one sample."""
    portion = as_number(steady, "steady")
    if not 0 < portion <= 1:
        raise ValueError(f"steady must be a portion above 0 and at most 1, got {portion:g}")
    n_samples = runs.shape[1]
    return runs[:, min(int(n_samples * (1 - portion)), n_samples - 1) :]


def window_length(window_s: float, fs: float, name: str = "window_s") -> int:
    """Length of a window in samples."""
    rate = as_positive(fs, "fs", unit="Hz")
    length = round(as_positive(window_s, name, unit="s") * rate)
    if length < 1:
        raise ValueError(f"{name} must be at least one sample, {1 / rate:g} s, got {window_s:g} s")
    return length


def ratio(numerator: Any, denominator: Any) -> np.ndarray:
    """Quotient, NaN where the denominator is zero, without warnings."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.asarray(denominator) == 0, np.nan, np.divide(numerator, denominator))


def ratio_db(numerator: Any, denominator: Any) -> np.ndarray:
    """Ratio of powers in dB, NaN where the denominator is zero, without warnings."""
    with np.errstate(divide="ignore"):
        return 10 * np.log10(ratio(numerator, denominator))
