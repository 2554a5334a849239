"""Least squares of a signal on the delays of another, by the covariance method: on the samples at hand, not biased.

The fit of a path and the Wiener control filter are both of this kind.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.signal import correlate, fftconvolve

# Eigenvalues of a correlation matrix below this share of the largest count as zero. Such directions of the weights
# get no weight, which is the solution of minimum norm; for a tone only two directions remain. The entries of the matrix
# are right to about 1e-15 of the largest eigenvalue, so one 1e-11 times as large has about four digits. A larger
# tolerance would leave out directions that can be told, and so worsen the fit to narrow-band signals.
RANK_TOLERANCE = 1e-11

LARGEST_MATRIX = 16_384  # rows, which take 2 GiB, and its decomposition as much again
_PRECISION, _MOST_STEPS = 1e-9, 20_000  # of the iteration, relative to its beginning


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

    `signals` are (C, n_samples), or (n_samples,) for C = 1. Each row of a block is computed from the one above by
    adding the products that enter the window and subtracting those that leave it.
    """
    signals = np.atleast_2d(signals)
    n_signals, length = signals.shape
    if n_signals * n_taps > LARGEST_MATRIX:
        raise ValueError(
            f"{n_signals * n_taps} weights need a matrix of {8 * (n_signals * n_taps) ** 2 / 2**30:.3g} GiB, but at most "
            f"{LARGEST_MATRIX} weights are solved for: take fewer taps, or a lower sampling rate"
        )
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


def ridge_solve(signals: np.ndarray, right: np.ndarray, ridges: np.ndarray) -> np.ndarray:
    """Return the solution of ``correlation_matrix(signals, n_taps) + ridges`` without that matrix.

    Conjugate gradients multiply by the matrix as two convolutions. The Toeplitz matrix that it would be if the signals
    were periodic, one for each signal, is the preconditioner. If the samples are four times as many as the taps, 10 to
    100 steps suffice for noise; if they are twice as many, thousands are taken.

    Parameters
    ----------
    signals : ndarray, shape (C, n_samples)
    right : ndarray, shape (n_systems, C n_taps)
    ridges : ndarray, shape (C,)
        What is added to the diagonal for each signal, above 0.

    Returns
    -------
    ndarray, shape (n_systems, C n_taps)

    Raises
    ------
    ValueError
        If the iteration does not end.
    """
    from scipy.sparse.linalg import LinearOperator, cg

    n_signals, length = signals.shape
    n_weights, n_taps = right.shape[1], right.shape[1] // n_signals

    def multiplied(weights: np.ndarray) -> np.ndarray:
        filters = weights.reshape(n_signals, n_taps)
        output = fftconvolve(signals, filters, "valid", axes=1).sum(axis=0)
        back = fftconvolve(signals, output[np.newaxis, ::-1], "valid", axes=1)[:, ::-1] / output.size
        return (back + ridges[:, np.newaxis] * filters).ravel()

    size = next_fast_len(length + n_taps, real=True)
    lags = irfft(np.abs(rfft(signals, size)) ** 2, size)[:, :n_taps] / length * (1 - np.arange(n_taps) / n_taps)
    density = rfft(np.concatenate([lags, np.zeros((n_signals, 1)), lags[:, :0:-1]], axis=1)).real
    density = np.maximum(density, 0.0) + ridges[:, np.newaxis]

    def approximately_solved(weights: np.ndarray) -> np.ndarray:
        spectra = rfft(weights.reshape(n_signals, n_taps), 2 * n_taps)
        return irfft(spectra / density, 2 * n_taps)[:, :n_taps].ravel()

    matrix, preconditioner = (
        LinearOperator((n_weights, n_weights), matvec=of, dtype=float) for of in (multiplied, approximately_solved)
    )
    solved = [cg(matrix, b, rtol=_PRECISION, maxiter=_MOST_STEPS, M=preconditioner) for b in right]
    if any(reason for _, reason in solved):
        raise ValueError(f"{n_weights} weights were not found in {_MOST_STEPS} steps: fit fewer taps, or record longer")
    return np.array([weights for weights, _ in solved])
