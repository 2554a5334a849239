"""Compiled arithmetic of the Kalman filter: pure functions of arrays that know no paths or controllers.

The covariance is kept as the lower triangle of a square array, with what the last step still owes it::

    P = scale (T - g g' / S) + diagonal I

``T`` is the stored triangle, ``g`` and ``S`` the last gain direction and innovation variance (eq. 8),
``scale`` filterpy's fading memory squared and ``diagonal`` the state noise of eq. 4. The debt is paid in the
same pass that forms ``P x'`` for the next sample, so each element of the triangle is read and written once a
sample, and P is symmetric because there is only one of each element.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba.extending import overload

from .compiling import OPTIONS, compiled, part

# No flag here lets the compiler assume that NaN or Inf do not occur: the checks for them must survive.
FAST = {"reassoc", "contract", "nsz"}

SCALE, DIAGONAL, INVERSE_S, LAST_INVERSE_S = 0, 1, 2, 3

# Where S exceeds the measurement noise by this much, the downdate cancels so many digits of P that it is done in
# twice the precision: the first samples after a large initial variance.
CANCELLATION = 1e3
LINE = 64  # bytes in a cache line
FIRST_COLUMN = np.int64(0)  # numpy's, since numba compiles a function anew for a plain one
SPLIT = 134217729.0  # 2**27 + 1 cuts a float64 into two halves whose products are exact


class Covariance(NamedTuple):
    """State covariance: P = scale (T - g g' inverse_s) + diagonal I."""

    triangle: np.ndarray  # (n or more, n or more), lower triangle T valid; rows begin at cache lines
    row: np.ndarray  # (n,) where x' is put into T's precision, if it is of another
    gain_direction: np.ndarray  # (n,), g = P x' of the last update
    product: np.ndarray  # (n,), P x' of the pass under way
    exact: np.ndarray  # (4, n) work of `downdate_carefully`
    owed: np.ndarray  # (4,): scale, diagonal, 1/S or 0 where the downdate was done at once; 1/S of the last update


def aligned_zeros(*shape: int, dtype: Any = np.float64) -> np.ndarray:
    """Zeros whose rows begin at cache lines, the last dimension rounded up to that: a quarter faster from 128 taps on."""
    *rows, columns = shape
    line = LINE // np.dtype(dtype).itemsize
    padded = (*rows, -(-columns // line) * line)
    memory = np.zeros(int(np.prod(padded)) + line, dtype)
    start = -(memory.ctypes.data // memory.itemsize) % line
    return memory[start : memory.size - line + start].reshape(padded)


def new_covariance(P: np.ndarray, dtype: Any = np.float64) -> Covariance:
    """Covariance state from a full symmetric array (n, n); the upper triangle is not read."""
    n, line = P.shape[0], LINE // np.dtype(dtype).itemsize
    if not np.abs(P).max() < float(np.finfo(dtype).max):
        raise ValueError(f"P must be below {np.finfo(dtype).max:.2g}, the largest {np.dtype(dtype).name}")
    triangle = aligned_zeros(-(-n // line) * line, n, dtype=dtype)  # square for BLAS, zero past n
    triangle[:n, :n] = P
    row, gain_direction, product = (aligned_zeros(n, dtype=dtype)[:n] for _ in range(3))
    return Covariance(triangle, row, gain_direction, product, np.zeros((4, n)), np.array([1.0, 0.0, 0.0, 0.0]))


def copy_covariance(cov: Covariance) -> Covariance:
    """A covariance state of its own (a plain copy of an array need not begin at a cache line)."""
    n = cov.product.size
    other = new_covariance(cov.triangle[:n, :n], cov.triangle.dtype)
    for mine, theirs in zip(other[1:], cov[1:], strict=True):
        mine[:] = theirs
    return other


@part(forceinline=True)
def copy_into(target, source):
    """target[:] = source, in a loop: numba compiles two seconds of error messages for the slice."""
    for i in range(source.size):
        target[i] = source[i]


def in_precision(row, h):
    """`h`, or where P is kept in another precision, a copy of it in `row`."""
    if row.dtype == h.dtype:
        return h
    row[:] = h
    return row


@overload(in_precision, jit_options=OPTIONS | {"cache": False})  # type: ignore[arg-type]
def _in_precision(row, h):
    if row.dtype == h.dtype:  # types: decided when it is compiled
        return lambda row, h: h

    def copied(row, h):
        copy_into(row, h)
        return row

    return copied


@part(forceinline=True)
def predict_covariance(cov, alpha_sq, state_noise):
    """Eq. 4, P(n|n-1) = alpha^2 P(n-1|n-1) + r I, noted and paid in the next pass."""
    cov.owed[SCALE] *= alpha_sq
    cov.owed[DIAGONAL] = alpha_sq * cov.owed[DIAGONAL] + state_noise


@part(fastmath=FAST, forceinline=True, disjoint=True)
def four_rows(T0, T1, T2, T3, g0, g1, g2, g3, g, h, Ph, scale, i):
    """Rows i to i + 3 of `project_covariance` up to column i."""
    h0, h1 = h[i], h[i + 1]
    h2, h3 = h[i + 2], h[i + 3]
    a0 = a1 = a2 = a3 = scale - scale  # zero in P's precision
    for j in range(i):
        p0 = scale * T0[j] - g0 * g[j]
        p1 = scale * T1[j] - g1 * g[j]
        p2 = scale * T2[j] - g2 * g[j]
        p3 = scale * T3[j] - g3 * g[j]
        T0[j] = p0
        T1[j] = p1
        T2[j] = p2
        T3[j] = p3
        a0 += p0 * h[j]
        a1 += p1 * h[j]
        a2 += p2 * h[j]
        a3 += p3 * h[j]
        Ph[j] += p0 * h0 + p1 * h1 + p2 * h2 + p3 * h3
    Ph[i] += a0
    Ph[i + 1] += a1
    Ph[i + 2] += a2
    Ph[i + 3] += a3


@part(fastmath=FAST, forceinline=True)
def row_end(T, g, h, Ph, scale, diagonal, gk, i, k):
    """Row k of `project_covariance` from column i to the diagonal."""
    hk, total = h[k], Ph[k]
    for j in range(i, k):
        p = scale * T[j] - gk * g[j]
        T[j] = p
        total += p * h[j]
        Ph[j] += p * hk
    p = scale * T[k] - gk * g[k] + diagonal
    T[k] = p
    Ph[k] = total + p * hk


@part(fastmath=FAST)
def project_covariance(cov, h):
    """Pay what is owed to the triangle and set ``cov.product = P h`` in the same pass; return h'P h.

    The value of P does not change. Four rows go together so that each load of ``g``, ``h`` and the running
    product serves four elements.
    """
    T, g, Ph, n = cov.triangle, cov.gain_direction, cov.product, h.size
    number = T.dtype.type  # a float64 factor would make float32 arithmetic float64
    scale, diagonal = number(cov.owed[SCALE]), number(cov.owed[DIAGONAL])
    weight = number(cov.owed[SCALE] * cov.owed[INVERSE_S])
    h = in_precision(cov.row, h)
    for i in range(n):
        Ph[i] = 0.0
    whole = n - n % 4
    for i in range(0, whole, 4):
        T0, T1, T2, T3 = T[i], T[i + 1], T[i + 2], T[i + 3]
        g0 = weight * g[i]
        g1 = weight * g[i + 1]
        g2 = weight * g[i + 2]
        g3 = weight * g[i + 3]
        four_rows(T0, T1, T2, T3, g0, g1, g2, g3, g, h, Ph, scale, i)
        row_end(T0, g, h, Ph, scale, diagonal, g0, i, i)
        row_end(T1, g, h, Ph, scale, diagonal, g1, i, i + 1)
        row_end(T2, g, h, Ph, scale, diagonal, g2, i, i + 2)
        row_end(T3, g, h, Ph, scale, diagonal, g3, i, i + 3)
    for k in range(whole, n):  # the last n % 4 rows
        row_end(T[k], g, h, Ph, scale, diagonal, weight * g[k], FIRST_COLUMN, k)
    cov.owed[SCALE], cov.owed[DIAGONAL], cov.owed[INVERSE_S] = 1.0, 0.0, 0.0
    return dot(h, Ph)


@part(forceinline=True)
def downdate_covariance(cov, S):
    """Eq. 8, P(n|n) = P(n|n-1) - g g'/S with g = P(n|n-1) x', noted and paid in the next pass."""
    copy_into(cov.gain_direction, cov.product)
    cov.owed[INVERSE_S] = cov.owed[LAST_INVERSE_S] = 1.0 / S


@part()
def two_sum(a, b):
    """a + b as the rounded sum and what rounding left (Knuth)."""
    total = a + b
    rest = total - a
    return total, (a - (total - rest)) + (b - rest)


@part()
def two_product(a, b):
    """a b as the rounded product and what rounding left (Dekker)."""
    product = a * b
    cut = SPLIT * a
    a_high = cut - (cut - a)
    cut = SPLIT * b
    b_high = cut - (cut - b)
    a_low, b_low = a - a_high, b - b_high
    return product, ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low


@part()
def add_product(total, rest, a, b):
    """(total + rest) + a b in twice the precision (Ogita, Rump and Oishi's Dot2)."""
    product, product_rest = two_product(a, b)
    total, sum_rest = two_sum(total, product)
    return total, rest + (product_rest + sum_rest)


@part()
def downdate_carefully(cov, h, noise):
    """Eq. 8 in twice the precision and at once, after `project_covariance`; False, undone, where it would overflow."""
    T, n = cov.triangle, h.size
    g, g_low, k, k_low = cov.exact[0], cov.exact[1], cov.exact[2], cov.exact[3]  # direction, and the gain g/S
    for i in range(n):
        g[i], g_low[i] = 0.0, 0.0
        for j in range(i):
            g[i], g_low[i] = add_product(g[i], g_low[i], T[i, j], h[j])
            g[j], g_low[j] = add_product(g[j], g_low[j], T[i, j], h[i])
        g[i], g_low[i] = add_product(g[i], g_low[i], T[i, i], h[i])
    S, S_low = noise, 0.0
    for i in range(n):
        S, S_low = add_product(S, S_low + h[i] * g_low[i], h[i], g[i])
    S, S_low = two_sum(S, S_low)
    size = S
    for i in range(n):
        k[i] = g[i] / S
        product, rest = two_product(k[i], S)
        k_low[i] = (((g[i] - product) - rest) + g_low[i] - k[i] * S_low) / S
        size += abs(g[i]) + abs(g_low[i]) + abs(k[i]) + abs(k_low[i])
    if not (S > 0.0 and size < 1e100):
        return False
    for i in range(n):
        for j in range(i + 1):
            product, rest = two_product(g[i], k[j])
            T[i, j] = (T[i, j] - product) - (rest + (g[i] * k_low[j] + g_low[i] * k[j]))
    copy_into(cov.gain_direction, g)
    cov.owed[INVERSE_S], cov.owed[LAST_INVERSE_S] = 0.0, 1.0 / S
    return True


def full_covariance(T: np.ndarray, g: np.ndarray, scale: float, diagonal: float, weight: float) -> np.ndarray:
    """Full symmetric array scale T + weight g g' + diagonal I."""
    P = np.empty((g.size, g.size))
    _fill(P, T, g, scale, diagonal, weight)
    return P


@compiled(fastmath=FAST)
def _fill(P, T, g, scale, diagonal, weight):
    for i in range(g.size):
        gi = weight * g[i]
        for j in range(i + 1):
            P[i, j] = scale * T[i, j] + gi * g[j]
            P[j, i] = P[i, j]
        P[i, i] += diagonal


def covariance_matrix(cov: Covariance) -> np.ndarray:
    """P as a full symmetric array (n, n) of its own."""
    scale, diagonal, inverse_S, _ = cov.owed.tolist()
    return full_covariance(cov.triangle, cov.gain_direction, scale, diagonal, -scale * inverse_S)


@part(fastmath=FAST, forceinline=True)
def dot(a, b):
    """Inner product of two vectors of the length of the first."""
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@part(fastmath=FAST, forceinline=True)
def correct_weights(w, gain_direction, innovation_over_S):
    """Eq. 5, w(n|n) = w(n|n-1) + K (d - x'w), with K = g/S."""
    for i in range(w.size):
        w[i] += gain_direction[i] * innovation_over_S


@part(fastmath=FAST, forceinline=True)
def correction_is_finite(w, gain_direction, innovation_over_S):
    """Whether `correct_weights` would leave finite weights."""
    total = 0.0
    for i in range(w.size):
        total += abs(w[i] + gain_direction[i] * innovation_over_S)
    return np.isfinite(total)


@part(forceinline=True)
def update_weights(cov, w, h, scaled_measurement, S, noise):
    """Eq. 9 and 8 after `project_covariance`: correct `w` in place, owe the downdate; return the innovation.

    `noise` is the measurement noise in S: where S is far larger, the downdate is done in twice the precision.
    Where the innovation or a weight would not be finite, NaN is returned with nothing changed.
    """
    y = scaled_measurement - dot(h, w)
    if not correction_is_finite(w, cov.product, y / S):
        return np.nan
    if not (S / noise > CANCELLATION and downdate_carefully(cov, h, noise)):
        downdate_covariance(cov, S)
    correct_weights(w, cov.gain_direction, y / S)
    return y
