"""Least squares of a signal on the delays of another, by the covariance method: on the samples at hand, not biased.

The fit of a path and the Wiener control filter are both of this kind.
"""

from __future__ import annotations

import numpy as np

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
    return np.correlate(regressor, output, mode="valid")[::-1] / output.size


def correlation_matrix(signal: np.ndarray, n_taps: int, start: int) -> np.ndarray:
    """Return the mean of ``signal[n - i] * signal[n - j]`` over n >= start, shape (n_taps, n_taps).

    Each row follows from the one above by the products that enter and leave the window.
    """
    count = signal.size - start
    matrix = np.zeros((n_taps, n_taps))
    matrix[0] = cross_correlation(signal[start:], signal[start - n_taps + 1 :])
    entering = signal[start - n_taps + 1 : start][::-1]  # signal[start - 1], signal[start - 2], ...
    leaving = signal[::-1][: n_taps - 1]  # signal[-1], signal[-2], ...
    for i in range(n_taps - 1):
        change = entering[i] * entering[i:] - leaving[i] * leaving[i:]
        matrix[i + 1, i + 1 :] = matrix[i, i:-1] + change / count
    return np.triu(matrix) + np.triu(matrix, 1).T


def cross_correlation_matrix(
    first: np.ndarray, second: np.ndarray, n_taps: int, start: int, n_second: int | None = None
) -> np.ndarray:
    """Return the mean of ``first[n - i] * second[n - j]`` over n >= start, shape (n_taps, n_second or n_taps).

    As in `correlation_matrix`, each entry follows from the one above it to the left.
    """
    count, n_second = first.size - start, n_taps if n_second is None else n_second
    matrix = np.empty((n_taps, n_second))
    matrix[0] = cross_correlation(first[start:], second[start - n_second + 1 :])
    matrix[:, 0] = cross_correlation(second[start:], first[start - n_taps + 1 :])
    entering = [signal[start - taps + 1 : start][::-1] for signal, taps in ((first, n_taps), (second, n_second))]
    leaving = [signal[::-1][: taps - 1] for signal, taps in ((first, n_taps), (second, n_second))]
    for i in range(n_taps - 1):
        change = entering[0][i] * entering[1] - leaving[0][i] * leaving[1]
        matrix[i + 1, 1:] = matrix[i, :-1] + change / count
    return matrix


def minimum_norm_solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a symmetric positive semidefinite system, leaving out directions without energy.

    `right` is (n,), or (n_systems, n) for several right sides; the solution has its shape.
    """
    values, vectors = np.linalg.eigh(matrix)
    kept = values > RANK_TOLERANCE * values[-1]
    solved = [vectors[:, kept] @ ((vectors[:, kept].T @ b) / values[kept]) for b in np.atleast_2d(right)]
    return np.reshape(solved, right.shape)
