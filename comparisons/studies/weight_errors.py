"""The error of a control filter's weights over time, and when it becomes small."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.linalg import toeplitz

from .cases import FS
from .report_parts import MARK, thin_style

WEIGHTS_EVERY = 4  # samples: 0.25 ms


def weight_error(weights: np.ndarray, filtered: np.ndarray) -> np.ndarray:
    """Return the error of each row of weights, as a share of the power of the anti-noise.

    It is E[(x'^T (w - w_o))^2] / E[(x'^T w_o)^2], with the mean over the steady half as the algorithm's own solution w_o
    and the autocorrelation of the filtered reference: of the anti-noise, the part that is still missing. The NSE would
    compare an algorithm that settles at -6 dB with one that settles at -60 dB.
    """
    n_taps = weights.shape[1]
    spectrum = np.abs(np.fft.rfft(filtered, 2 * filtered.size)) ** 2
    correlation = toeplitz(np.fft.irfft(spectrum)[:n_taps])
    own = weights[len(weights) // 2 :].mean(axis=0)
    away = weights - own
    return np.einsum("ni,ni->n", away @ correlation, away) / (own @ correlation @ own)


def settled_after_s(curve: np.ndarray, level_db: float) -> float | None:
    """Return the time after which a curve of weight errors stays below a level; None if not for the steady half."""
    above = np.flatnonzero(~(curve <= 10 ** (level_db / 10)))
    start = int(above[-1]) + 1 if above.size else 0
    return start * WEIGHTS_EVERY / FS if start <= curve.size // 2 else None


def first_below_s(curve: np.ndarray, level_db: float) -> float | None:
    """Return the time at which a curve of weight errors first comes below a level; None if it does not."""
    below = np.flatnonzero(curve <= 10 ** (level_db / 10))
    return float(below[0] * WEIGHTS_EVERY / FS) if below.size else None


def draw_weight_errors(ax: Any, curves: Mapping[str, np.ndarray], level_db: float) -> None:
    """Draw the first half second of the curves of some algorithms, and a level."""
    for name, curve in curves.items():
        start = curve[: int(0.5 * FS / WEIGHTS_EVERY)]
        time_ms = 1e3 * np.arange(start.size) * WEIGHTS_EVERY / FS
        ax.semilogx(time_ms[1:], 10 * np.log10(start[1:]), **thin_style(name), label=name)
    ax.axhline(level_db, color=MARK, linestyle=":")
    ax.set(xlabel="Time (ms)", ylabel="Weight error (dB)")
    ax.legend()
