"""Block Toeplitz systems against dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kfopc_filterpy.kernels.block_toeplitz import (
    circulant_inverse,
    circulant_spectrum,
    conjugate_gradients,
    hermitian,
    nearest_circulant_spectrum,
    toeplitz_energy,
    toeplitz_product,
)


def lags_of(blocks: int, n: int, size: int, seed: int) -> np.ndarray:
    """The correlation of signals that a random filter has mixed: positive definite, negative lags at the end."""
    h = np.random.default_rng(seed).standard_normal((5, blocks, blocks))
    both = sum(np.eye(size)[(m - k) % size][:, None, None] * (h[k].T @ h[m]) for k in range(5) for m in range(5))
    assert n + 5 <= size // 2
    return np.asarray(both) + np.eye(size)[0][:, None, None] * 0.1 * np.eye(blocks)


def dense(lags: np.ndarray, n: int) -> np.ndarray:
    blocks = lags.shape[1]
    difference = np.arange(n)[:, None] - np.arange(n)[None, :]
    return lags[difference].transpose(2, 0, 3, 1).reshape(blocks * n, blocks * n)


@given(blocks=st.integers(1, 4), n=st.integers(2, 12), seed=st.integers(0, 1000))
def test_the_product_is_that_of_the_dense_matrix(blocks: int, n: int, seed: int) -> None:
    lags = lags_of(blocks, n, 64, seed)
    v = np.random.default_rng(seed).standard_normal((blocks, n))
    product = toeplitz_product(circulant_spectrum(lags, n), n)(v)
    np.testing.assert_allclose(product.ravel(), dense(lags, n) @ v.ravel(), atol=1e-11)


@given(blocks=st.integers(1, 4), n=st.integers(2, 12), seed=st.integers(0, 1000))
def test_half_of_the_pairs_tell_the_whole_spectrum(blocks: int, n: int, seed: int) -> None:
    lags = lags_of(blocks, n, 64, seed)
    pairs = lags[:, *np.triu_indices(blocks)]
    for spectrum in (circulant_spectrum, nearest_circulant_spectrum):
        np.testing.assert_allclose(hermitian(spectrum(pairs, n), blocks), spectrum(lags, n), atol=1e-11)


@given(number=st.integers(1, 3), blocks=st.integers(1, 4), n=st.integers(2, 12), seed=st.integers(0, 1000))
def test_the_energy_is_the_quadratic_form_of_the_dense_matrix(number: int, blocks: int, n: int, seed: int) -> None:
    lags = lags_of(blocks, n, 64, seed)
    v = np.random.default_rng(seed).standard_normal((number, blocks, n))
    flat = v.reshape(number, -1)
    expected = np.einsum("ja,ab,jb->j", flat, dense(lags, n), flat)
    np.testing.assert_allclose(toeplitz_energy(circulant_spectrum(lags, n), v), expected, rtol=1e-10)


@pytest.mark.parametrize("n", [7, 16])
def test_the_preconditioner_is_the_nearest_circulant_inverted(n: int) -> None:
    """Nearest in the Frobenius norm: each diagonal of a block is the mean along its wrapped diagonal (T. F. Chan)."""
    lags, blocks = lags_of(3, n, 64, 1), 3
    matrix = dense(lags, n).reshape(blocks, n, blocks, n)
    nearest = np.empty_like(matrix)
    for k in range(n):
        rows = np.arange(n)
        mean = matrix[:, rows, :, (rows - k) % n].mean(axis=0)
        nearest[:, rows, :, (rows - k) % n] = mean
    v = np.random.default_rng(0).standard_normal((blocks, n))
    found = circulant_inverse(nearest_circulant_spectrum(lags, n), n)(v)
    expected = np.linalg.solve(nearest.reshape(blocks * n, -1), v.ravel())
    np.testing.assert_allclose(found.ravel(), expected, rtol=1e-9, atol=1e-11)


def test_conjugate_gradients_solve_the_dense_system() -> None:
    lags, n = lags_of(3, 16, 64, 2), 16
    b = np.random.default_rng(3).standard_normal((3, n))
    product = toeplitz_product(circulant_spectrum(lags, n), n)
    inverse = circulant_inverse(nearest_circulant_spectrum(lags, n), n)
    x = conjugate_gradients(product, inverse, b, np.zeros((3, n)), 60)
    np.testing.assert_allclose(x.ravel(), np.linalg.solve(dense(lags, n), b.ravel()), rtol=1e-8, atol=1e-10)
    np.testing.assert_array_equal(conjugate_gradients(product, inverse, 0.0 * b, 0.0 * x, 5), 0.0)  # nothing to do
    few = conjugate_gradients(product, inverse, b, np.zeros((3, n)), 3)
    plain = conjugate_gradients(product, lambda v: v, b, np.zeros((3, n)), 3)
    assert np.abs(few - x).max() < np.abs(plain - x).max()  # the preconditioner earns its place
