"""Least squares of a signal on the delays of another, by the covariance method: on the samples at hand, not biased.

The fit of a path and the Wiener control filter are both of this kind.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import correlate

# Eigenvalues of a correlation matrix below this share of the largest count as zero. Such directions of the weights
# get no weight, which is the solution of minimum norm; for a tone only two directions remain. The entries of the matrix
# are right to about 1e-15 of the largest eigenvalue, so one 1e-11 times as large has about four digits. A larger
# tolerance would leave out directions that can be told, and so worsen the fit to narrow-band signals.
RANK_TOLERANCE = 1e-11


def cross_correlation(output: np.ndarray, regressor: np.ndarray) -> np.ndarray:
    """Return the mean of the products of `output` and each delay of `regressor`, which begins that many samples early.

    Parameters
    ----------
    output : ndarray, shape (n_samples,)
    regressor : ndarray, shape (n_samples + n_taps - 1,)

    Returns
    -------
    ndarray, shape (n_taps,)
    """
    return correlate(regressor, output, mode="valid")[::-1] / output.size


def correlation_matrix(signals: np.ndarray, n_taps: int) -> np.ndarray:
    """Return the mean of ``signals[a, n - i] * signals[b, n - j]`` over n >= n_taps - 1, (C n_taps, C n_taps).

    `signals` are (C, n_samples), or (n_samples,) for C = 1. Each row of a block is computed from the one above by adding the
    products that enter the window and subtracting those that leave it.
    """
    signals = np.atleast_2d(signals)
    n_signals, length = signals.shape
    blocks = np.empty((n_signals, n_signals, n_taps, n_taps))
    for a, now in enumerate(signals[:, n_taps - 1 :]):
        for b, signal in enumerate(signals):
            blocks[a, b, 0] = cross_correlation(now, signal)
    blocks[:, :, :, 0] = blocks[:, :, 0, :].swapaxes(0, 1)
    entering = signals[:, : n_taps - 1][:, ::-1]  # the samples before the window, newest first
    leaving = signals[:, ::-1][:, : n_taps - 1]  # the last samples, newest first
    for i in range(n_taps - 1):
        change = entering[:, i, None, None] * entering - leaving[:, i, None, None] * leaving
        blocks[:, :, i + 1, 1:] = blocks[:, :, i, :-1] + change / (length - n_taps + 1)
    return blocks.swapaxes(1, 2).reshape(n_signals * n_taps, -1)


def minimum_norm_solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a symmetric positive semidefinite system, leaving out directions without energy.

    `right` is (n,), or (n_systems, n) for several right sides; the solution has its shape.
    """
    values, vectors = np.linalg.eigh(matrix)
    kept = values > RANK_TOLERANCE * values[-1]
    solved = [vectors[:, kept] @ ((vectors[:, kept].T @ b) / values[kept]) for b in np.atleast_2d(right)]
    return np.reshape(solved, right.shape)
