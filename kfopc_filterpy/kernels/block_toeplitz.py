"""Symmetric block Toeplitz systems: products by FFT, and conjugate gradients with a circulant preconditioner.

The matrix has B x B blocks of n x n. Element (l, m) of block (a, b) is ``lags[l - m, a, b]``, where negative lags stand
at the end of the array, as in a discrete Fourier transform. A vector is an array (B, n).

References
----------
T. F. Chan, "An optimal circulant preconditioner for Toeplitz systems", SIAM J. Sci. Stat. Comput. 9(4), 1988.
R. H. Chan and M. K. Ng, "Conjugate gradient methods for Toeplitz systems", SIAM Review 38(3), 1996.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import fft

Operator = Callable[[np.ndarray], np.ndarray]


def circulant_spectrum(lags: np.ndarray, n: int) -> np.ndarray:
    """Return the spectrum, (2n/2 + 1, B, B), of the block circulant of size 2n that contains the matrix."""
    embedded = np.zeros((2 * n, *lags.shape[1:]))
    embedded[:n], embedded[n + 1 :] = lags[:n], lags[-(n - 1) :]
    return fft.rfft(embedded, axis=0)


def nearest_circulant_spectrum(lags: np.ndarray, n: int) -> np.ndarray:
    """Return the spectrum, (n/2 + 1, B, B), of the block circulant of size n that is nearest to the matrix.

    It is positive definite if the matrix is (T. F. Chan).
    """
    share = (np.arange(n) / n).reshape(-1, *(1,) * (lags.ndim - 1))
    nearest = (1.0 - share) * lags[:n]
    nearest[1:] += share[1:] * lags[-(n - 1) :]
    return fft.rfft(nearest, axis=0)


def hermitian(pairs: np.ndarray, blocks: int) -> np.ndarray:
    """Return spectra, (f, B, B), of which the pairs of `np.triu_indices` are given, (f, pairs)."""
    rows, columns = np.triu_indices(blocks)
    whole = np.empty((len(pairs), blocks, blocks), pairs.dtype)
    whole[:, columns, rows] = pairs.conj()
    whole[:, rows, columns] = pairs
    return whole


def toeplitz_product(spectrum: np.ndarray, n: int) -> Operator:
    """Return the product with the block Toeplitz matrix whose `circulant_spectrum` is given."""

    def product(v: np.ndarray) -> np.ndarray:
        transformed = fft.rfft(v, 2 * n).T[:, :, np.newaxis]
        return fft.irfft((spectrum @ transformed)[:, :, 0].T, 2 * n)[:, :n]

    return product


def toeplitz_energy(spectrum: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return v' T v of each of some vectors, (number, B, n), for the matrix T whose `circulant_spectrum` is given."""
    n = v.shape[-1]
    transformed = fft.rfft(v, 2 * n)
    density = np.einsum("jaf,fab,jbf->jf", transformed.conj(), spectrum, transformed, optimize=True).real
    density[:, 1:-1] *= 2.0  # the negative frequencies
    return density.sum(axis=1) / (2 * n)


def circulant_inverse(spectrum: np.ndarray, n: int) -> Operator:
    """Return the product with the inverse of a block circulant of size n."""
    inverse = np.linalg.inv(spectrum)

    def product(v: np.ndarray) -> np.ndarray:
        transformed = fft.rfft(v).T[:, :, np.newaxis]
        return fft.irfft((inverse @ transformed)[:, :, 0].T, n)

    return product


def conjugate_gradients(
    product: Operator, precondition: Operator, b: np.ndarray, x: np.ndarray, steps: int, *, axis: int | None = None
) -> np.ndarray:
    """Return `x` after some preconditioned steps towards the solution of ``product(x) = b``.

    With an axis, each vector along it is a system of its own, and the operators treat them alike.
    """

    def inner(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.sum(a * b, axis=axis, keepdims=True)

    residual = b - product(x)
    direction = preconditioned = precondition(residual)
    size = inner(residual, preconditioned)
    for _ in range(steps):
        if not np.any(size > 0.0):  # solved
            break
        moved = product(direction)
        step = _ratio(size, inner(direction, moved))
        x, residual = x + step * direction, residual - step * moved
        preconditioned = precondition(residual)
        size, before = inner(residual, preconditioned), size
        direction = preconditioned + _ratio(size, before) * direction
    return x


def _ratio(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    """Return ``above / below``, and 0 where a system is solved already."""
    return np.divide(above, below, out=np.zeros_like(above), where=below > 0.0)
