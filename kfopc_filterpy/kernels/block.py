r"""Eq. 2-8 for a block of m samples at a time, in matrix products: the same filter as sample by sample, to rounding.

With P the covariance before the block and h_k the filtered-reference row of its k-th sample, the random walk (eq. 1)
makes the covariance of the state after the block with the k-th measurement, and of two measurements,

.. math:: c_k = (P + k r I) h_k, \qquad \Sigma_{kl} = h_k' c_l + q \delta_{kl} \quad (l \le k).

The Cholesky factor of Sigma = L L' takes the measurements in their order, so that L_kk^2 is the innovation variance S_k
of eq. 7, and the columns g_k of G = C L'^-1 are K_k sqrt(S_k) with the gain K_k of eq. 6. The covariance after the block
is P + m r I - G G'. That is one symmetric product, one small factorisation and one downdate of rank m: 3 L^2 flops a
sample as sample by sample, but each element of P is read and written once a block, not once a sample.

`Block` takes all rows at once: where the reference is known ahead. `CausalBlock` needs each row only
when its sample comes: what it can multiply before it does at the block's beginning, and downdates P at its end, so that
a sample within costs 3 L m flops on average and the change of blocks a burst of 3 L^2 m.
Fading memory is left to the steps of `kernels`; so are the samples whose variance before the block exceeds q so far that
the downdate would cost digits of P, and a block whose Sigma has no Cholesky factor.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg.blas import dgemm, dsymm, dsyrk, dtrsm
from scipy.linalg.lapack import dpotrf

from .compiling import compiled, part
from .covariance import (
    CANCELLATION,
    FAST,
    LAST_INVERSE_S,
    Covariance,
    aligned_zeros,
    copy_into,
    correct_weights,
    correction_is_finite,
    dot,
    downdate_carefully,
    downdate_covariance,
    predict_covariance,
    project_covariance,
)
from .pairs import WORK, take_pairs

STEPS = 16  # samples taken one by one after a pair that could not be
AHEAD, COLUMNS, SCALED = 0, 1, 2  # of a CausalBlock: P h_k as far as h_k is known; columns of P; K_k sqrt(S_k)


def settle(cov: Covariance) -> None:
    """Pay what is owed: P, in float64, is the triangle."""
    scale, diagonal, inverse_S, _ = cov.owed
    if scale != 1.0 or diagonal or inverse_S:
        G = np.zeros((len(cov.triangle), 1), order="F")
        G[: cov.product.size, 0] = np.sqrt(scale * inverse_S) * cov.gain_direction
        downdate_by_columns(cov, G, diagonal, scale)
        cov.owed[:3] = 1.0, 0.0, 0.0


class Block:
    """A block of samples whose rows are all known.

    `rows` (m, n or more) takes the filtered-reference rows and is zero past their n taps; `directions`, of its shape,
    is where the gain directions g_k = S_k K_k are left.
    """

    def __init__(self, n_taps: int, size: int) -> None:
        self.rows, self.directions = aligned_zeros(2, size, n_taps)
        self._covariance = np.zeros((size, size), order="F")
        self._work = aligned_zeros(WORK, n_taps)

    def advance(
        self, cov: Covariance, state_noise: float, measurement_noise: float, alpha_sq: float = 1.0
    ) -> np.ndarray:
        """Take `cov` past the block; returns S_k (m,), NaN from a sample on that has no solution."""
        settle(cov)
        S = self._in_products(cov, state_noise, measurement_noise) if alpha_sq == 1.0 else None
        return self.advance_by_steps(cov, state_noise, measurement_noise, alpha_sq) if S is None else S

    def advance_by_steps(
        self, cov: Covariance, state_noise: float, measurement_noise: float, alpha_sq: float = 1.0
    ) -> np.ndarray:
        """`advance`, sample by sample."""
        S = np.full(len(self.rows), np.nan)
        _steps(cov, self.rows, state_noise, measurement_noise, alpha_sq, self.directions, S)
        return S

    def advance_in_pairs(
        self, cov: Covariance, state_noise: float, measurement_noise: float, alpha_sq: float = 1.0
    ) -> np.ndarray:
        """`advance`, two samples at a time (see `pairs`), and by steps where it must."""
        if alpha_sq != 1.0 or cov.triangle.dtype != np.float64:
            return self.advance_by_steps(cov, state_noise, measurement_noise, alpha_sq)
        S, size = np.full(len(self.rows), np.nan), len(self.rows)
        first = 0
        while True:
            settle(cov)
            rows, directions = self.rows[first:], self.directions[first:]
            first += take_pairs(cov, rows, state_noise, measurement_noise, self._work, directions, S[first:])
            end = min(first + STEPS, size)
            steps = slice(first, end)
            _steps(cov, self.rows[steps], state_noise, measurement_noise, alpha_sq, self.directions[steps], S[steps])
            first = end
            if first == size or np.isnan(S[first - 1]):
                return S

    def _in_products(self, cov: Covariance, state_noise: float, measurement_noise: float) -> np.ndarray | None:
        """None, with nothing changed, where Sigma has no Cholesky factor or its variances exceed q too far."""
        P, H, C = cov.triangle.T, self.rows.T, self.directions.T  # BLAS counts by columns
        C = dsymm(1.0, P, H, c=C, overwrite_c=1)
        _add_random_walk(self.directions, self.rows, state_noise)
        covariance = dgemm(1.0, H, C, trans_a=1, c=self._covariance, overwrite_c=1)
        np.fill_diagonal(covariance, covariance.diagonal() + measurement_noise)
        # What the whole block takes from a variance, not only what its last sample does, costs digits.
        if not covariance.diagonal().max() <= CANCELLATION * measurement_noise:
            return None
        L, failed = dpotrf(covariance, lower=1, clean=0, overwrite_a=1)
        if failed:
            return None
        root = L.diagonal().copy()
        S = root**2
        G = dtrsm(1.0, L, C, side=1, lower=1, trans_a=1, overwrite_b=1)
        downdate_by_columns(cov, G, len(S) * state_noise)
        self.directions *= root[:, None]
        cov.gain_direction[:] = self.directions[-1, : cov.product.size]
        cov.owed[LAST_INVERSE_S] = 1.0 / S[-1]
        return S


@compiled(fastmath=FAST)
def _add_random_walk(products, rows, state_noise):
    for k in range(len(rows)):
        correct_weights(products[k], rows[k], (k + 1) * state_noise)


@compiled(nogil=True)
def _steps(cov, rows, state_noise, measurement_noise, alpha_sq, directions, S):
    n = cov.product.size
    for k in range(len(rows)):
        h = rows[k, :n]
        predict_covariance(cov, alpha_sq, state_noise)
        variance = project_covariance(cov, h) + measurement_noise
        if not 0.0 < variance < np.inf:
            return
        S[k] = variance
        if variance / measurement_noise > CANCELLATION and downdate_carefully(cov, h, measurement_noise):
            S[k] = 1.0 / cov.owed[LAST_INVERSE_S]
        else:
            downdate_covariance(cov, variance)
        copy_into(directions[k], cov.gain_direction)


def downdate_by_columns(cov: Covariance, G: np.ndarray, diagonal: float, scale: float = 1.0) -> None:
    """The triangle T, in float64, to scale T + diagonal I - G G'; G (n or more, m) by columns."""
    dsyrk(-1.0, G, beta=scale, c=cov.triangle.T, overwrite_c=1)
    diagonal_of = np.einsum("ii->i", cov.triangle)  # a view
    diagonal_of[: cov.product.size] += diagonal


class OpenBlock(NamedTuple):
    """What a `CausalBlock` has so far."""

    arrays: np.ndarray  # (3, m, n or more): AHEAD, COLUMNS, SCALED
    taken: np.ndarray  # (2,) rows taken, and how many can be: 0 while no block is open


class CausalBlock:
    """A block whose rows come one at a time, each a tapped delay line's next: at most `size` of them.

    `open` before the first sample, `project_in_block` and `update_in_block` for each, `close` when no more come.
    """

    def __init__(self, n_taps: int, size: int) -> None:
        self.size = size
        self.state = OpenBlock(aligned_zeros(3, size, n_taps), np.zeros(2, dtype=np.int64))

    def open(self, cov: Covariance, newest: np.ndarray) -> None:
        """Begin; `newest` (n - 1 or more,) are the samples that the first row will hold after its own, newest first."""
        settle(cov)
        (arrays, taken), n, m, P = self.state, cov.product.size, self.size, cov.triangle
        known = arrays[SCALED]
        line = np.concatenate((np.zeros(m), newest[: n - 1]))  # the newest k + 1 samples of row k are still to come
        known[:, :n] = sliding_window_view(line, n)[::-1]
        dsymm(1.0, P.T, known.T, c=arrays[AHEAD].T, overwrite_c=1)
        k = min(m, n)
        columns = arrays[COLUMNS, :k]
        columns[:, :n] = P[:n, :k].T
        corner = np.tril(P[:k, :k], -1)
        columns[:, :k] = P[:k, :k] * np.tri(k) + corner.T
        taken[:] = 0, m

    def close(self, cov: Covariance, state_noise: float) -> None:
        """End, where one is open: P is that of the last sample taken."""
        arrays, taken = self.state
        k = int(taken[0])
        if k:
            downdate_by_columns(cov, arrays[SCALED, :k].T, k * state_noise)
        taken[:] = 0


@part(fastmath=FAST)
def project_in_block(cov, block, h, state_noise):
    """`kernels.project_covariance` of the block's next row, after its prediction; and h'P h before the block."""
    c, n, k = cov.product, h.size, block.taken[0]
    ahead, columns, scaled = block.arrays[AHEAD, k], block.arrays[COLUMNS], block.arrays[SCALED]
    for i in range(n):
        c[i] = ahead[i] + (k + 1) * state_noise * h[i]
    for j in range(min(k + 1, n)):
        correct_weights(c, columns[j], h[j])
    before = dot(h, c)
    for j in range(k):
        correct_weights(c, scaled[j], -dot(h, scaled[j]))
    return dot(h, c), before


@part()
def update_in_block(cov, block, w, h, scaled_measurement, S):
    """`kernels.update_weights` after `project_in_block`: the downdate waits for the end of the block."""
    y = scaled_measurement - dot(h, w)
    if not correction_is_finite(w, cov.product, y / S):
        return np.nan
    copy_into(cov.gain_direction, cov.product)
    cov.owed[LAST_INVERSE_S] = 1.0 / S
    scaled, scale = block.arrays[SCALED, block.taken[0]], 1.0 / np.sqrt(S)
    for i in range(w.size):
        scaled[i] = scale * cov.product[i]
    block.taken[0] += 1
    correct_weights(w, cov.gain_direction, y / S)
    return y


@part(fastmath=FAST)
def leave_block(cov, block, state_noise):
    """Take the block's samples into P: no more will be taken before the next is opened."""
    T, taken = cov.triangle, block.taken
    for k in range(taken[0]):
        scaled = block.arrays[SCALED, k]
        for i in range(cov.product.size):
            g = scaled[i]
            for j in range(i + 1):
                T[i, j] -= g * scaled[j]
    for i in range(cov.product.size):
        T[i, i] += taken[0] * state_noise
    taken[0] = taken[1] = 0
