"""Compiled arithmetic of the Kalman filter: pure functions of arrays that know no paths or controllers.

The covariance is stored as the lower triangle of a square array, plus changes that are still pending (`owed`)::

    P = scale (T - g g' / S) + diagonal I

``T`` is the stored triangle, ``g`` and ``S`` are the last gain direction and innovation variance (eq. 8), ``scale`` is
filterpy's fading memory squared and ``diagonal`` the state noise of eq. 4. Pending changes are applied in the same pass
that computes ``P x'`` for the next sample, so each element of the triangle is read and written once per sample. P is
symmetric because each element is stored only once.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .compiling import by_type, compiled, inlined, part
from .records import new_record
from .vectors import FAST, copy_into, dot

# Above this ratio of S to the measurement noise, the downdate cancels so many digits of P that it is computed in twice
# the precision. This happens in the first samples after a large initial variance.
CANCELLATION = 1e3
# In roundings of the largest variance: an h'P h below the first is nothing but rounding (of a unit h), and from then on,
# in float32 always, the second is the least state noise. See `blurred`.
BLUR, FLOOR = 16.0, 2.0
LINE = 64  # bytes in a cache line
SPLIT = 134217729.0  # 2**27 + 1 cuts a float64 into two halves whose products are exact


class Covariance(NamedTuple):
    """State covariance: P = scale (T - inverse_S g g') + diagonal I."""

    triangle: np.ndarray  # (n or more, n or more), lower triangle T valid; rows begin at cache lines
    gain_direction: np.ndarray  # (n,), g = P x' of the last update
    product: np.ndarray  # (n,), P x' of the current pass
    owed: np.ndarray  # record, see `new_covariance`


def aligned_zeros(*shape: int, dtype: Any = np.float64) -> np.ndarray:
    """Return zeros whose rows begin at cache lines (last dimension rounded up): a quarter faster from 128 taps on."""
    *rows, columns = shape
    line = LINE // np.dtype(dtype).itemsize
    padded = (*rows, -(-columns // line) * line)
    memory = np.zeros(int(np.prod(padded)) + line, dtype)
    start = -(memory.ctypes.data // memory.itemsize) % line
    return memory[start : memory.size - line + start].reshape(padded)


def new_covariance(P: np.ndarray, dtype: Any = np.float64) -> Covariance:
    """Return the covariance state of a full symmetric array (n, n); the upper triangle is not read."""
    n = P.shape[0]
    if not np.abs(P).max() < float(np.finfo(dtype).max):
        raise ValueError(f"P must be below {np.finfo(dtype).max:.2g}, the largest {np.dtype(dtype).name}")
    triangle = aligned_zeros(n, n, dtype=dtype)
    triangle[:, :n] = P
    gain_direction, product = (aligned_zeros(n, dtype=dtype)[:n] for _ in range(2))
    largest = float(np.max(np.diagonal(P)))
    owed = new_record(
        scale=1.0,
        diagonal=0.0,
        inverse_S=0.0,  # 0 if no downdate is pending
        last_inverse_S=0.0,  # of the last update
        largest=largest,  # variance at the start
        bound=largest,  # the largest variance now is no larger
        floored=float(np.dtype(dtype) == np.float32),  # 1 if `FLOOR` applies; without it float32 soon spoils P
    )
    return Covariance(triangle, gain_direction, product, owed)


def copy_covariance(cov: Covariance) -> Covariance:
    """Return an independent copy of a covariance state (a plain array copy might not begin at a cache line)."""
    n = cov.product.size
    other = new_covariance(cov.triangle[:n, :n], cov.triangle.dtype)
    other.gain_direction[:], other.product[:] = cov.gain_direction, cov.product
    other.owed[:] = cov.owed
    return other


@inlined
def predict_covariance(cov, alpha_sq, state_noise):
    """Record eq. 4, P(n|n-1) = alpha^2 P(n-1|n-1) + r I, as pending for the next pass."""
    owed = cov.owed[0]
    owed.scale *= alpha_sq
    owed.diagonal = alpha_sq * owed.diagonal + state_noise


@part(fastmath=FAST)
def scale_triangle(T, n, scale):
    """Scale the lower triangle."""
    for i in range(n):
        for j in range(i + 1):
            T[i, j] *= scale


@part(fastmath=FAST)
def project_triangle(T, g, h, Ph, scale, diagonal, weight):
    """Set T to scale T - weight g g' + diagonal I in the lower triangle, and Ph to T h in the same pass; return h'T h.

    Rows are processed in pairs, so that each load of `g`, `h` and `Ph` serves two elements. Elements are indexed as
    T[i, j], because numba would count references to a row that is extracted as an array.
    """
    n = h.size
    if scale != 1.0:  # only with a fading memory; in the loop below it would always cost a multiplication
        scale_triangle(T, n, scale)
    zero = T.dtype.type(0.0)
    odd = n % 2
    if odd == 1:  # the first row has no partner
        T[0, 0] += diagonal - weight * g[0] * g[0]
        Ph[0] = T[0, 0] * h[0]
    for i in range(odd, n, 2):
        k = i + 1
        gi, gk, hi, hk = weight * g[i], weight * g[k], h[i], h[k]
        sum_i = sum_k = zero
        for j in range(i):
            pi = T[i, j] - gi * g[j]
            pk = T[k, j] - gk * g[j]
            T[i, j] = pi
            T[k, j] = pk
            sum_i += pi * h[j]
            sum_k += pk * h[j]
            Ph[j] += pi * hi + pk * hk
        pii = T[i, i] - gi * g[i] + diagonal
        pki = T[k, i] - gk * g[i]
        pkk = T[k, k] - gk * g[k] + diagonal
        T[i, i] = pii
        T[k, i] = pki
        T[k, k] = pkk
        Ph[i] = sum_i + pii * hi + pki * hk
        Ph[k] = sum_k + pki * hi + pkk * hk
    return dot(h, Ph)


@inlined
def project_covariance(cov, row):
    """Apply the pending changes to the triangle and set ``cov.product = P h`` in the same pass; return h'P h.

    The value of P does not change, unless it is lost in rounding (see `blurred`).
    """
    owed, number = cov.owed[0], cov.triangle.dtype.type  # a float64 factor would make float32 arithmetic float64
    T, eps = cov.triangle, float(np.finfo(cov.triangle.dtype).eps)
    if owed.floored != 0.0:
        least = FLOOR * eps * min(largest_variance(T, cov.product.size), owed.largest)
        owed.diagonal = max(owed.diagonal, least)
    owed.bound = owed.scale * owed.bound + owed.diagonal
    scale, diagonal, weight = number(owed.scale), number(owed.diagonal), number(owed.scale * owed.inverse_S)
    owed.scale, owed.diagonal, owed.inverse_S = 1.0, 0.0, 0.0
    h = np.asarray(row, cov.triangle.dtype)
    variance = project_triangle(T, cov.gain_direction, h, cov.product, scale, diagonal, weight)
    blur = BLUR * eps * dot(h, h)
    return blurred(T, owed, h, cov.product, variance, blur) if variance < blur * owed.bound else variance


@part()
def blurred(T, owed, h, Ph, variance, blur):
    """Return an h'P h that seems to be lost in the rounding of P, raised if it is negative; see to it that P recovers.

    If P is large along some directions and the reference shows others only, what P should be there falls below the last
    digit of its elements, and rounding may make it negative. Left alone, each sample would shrink 1/P there as if that
    were true, until S turns negative. So from then on, P gets as much state noise as its largest element is rounded by.
    A P whose h'P h is above its rounding never gets any.
    """
    owed.bound = largest_variance(T, h.size)
    if variance < blur * owed.bound:
        owed.floored = 1.0
    return lift(T, h, Ph, variance) if variance < 0.0 else variance


@part()
def largest_variance(T, n):
    """Return the largest element on the diagonal."""
    largest = T[0, 0]
    for i in range(1, n):
        largest = max(largest, T[i, i])
    return largest


@part()
def lift(T, h, Ph, variance):
    """Raise the diagonal of a T whose h'T h is negative, so that it is positive, and Ph with it; return h'T h."""
    amount = T.dtype.type(-2.0 * variance / dot(h, h) + np.finfo(T.dtype).eps * largest_variance(T, h.size))
    for i in range(h.size):
        T[i, i] += amount
        Ph[i] += amount * h[i]
    return dot(h, Ph)


@inlined
def downdate_covariance(cov, S):
    """Record eq. 8, P(n|n) = P(n|n-1) - g g'/S with g = P(n|n-1) x', as pending for the next pass."""
    copy_into(cov.gain_direction, cov.product)
    owed = cov.owed[0]
    owed.inverse_S = owed.last_inverse_S = 1.0 / S


@part()
def two_sum(a, b):
    """Return a + b as the rounded sum and its rounding error (Knuth)."""
    total = a + b
    rest = total - a
    return total, (a - (total - rest)) + (b - rest)


@part()
def two_product(a, b):
    """Return a b as the rounded product and its rounding error (Dekker)."""
    product = a * b
    cut = SPLIT * a
    a_high = cut - (cut - a)
    cut = SPLIT * b
    b_high = cut - (cut - b)
    a_low, b_low = a - a_high, b - b_high
    return product, ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low


@part()
def add_product(total, rest, a, b):
    """Return (total + rest) + a b in twice the precision (Ogita, Rump and Oishi's Dot2)."""
    product, product_rest = two_product(a, b)
    total, sum_rest = two_sum(total, product)
    return total, rest + (product_rest + sum_rest)


@part()
def downdate_carefully(cov, h, noise):
    """Apply eq. 8 at once, in twice the precision; return False, with nothing changed, if it overflows.

    `project_covariance` must come first.
    """
    T, n = cov.triangle, h.size
    g, g_low, k, k_low = np.empty(n), np.empty(n), np.empty(n), np.empty(n)  # direction, and the gain g/S
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
    owed = cov.owed[0]
    owed.inverse_S, owed.last_inverse_S = 0.0, 1.0 / S
    return True


@part(fastmath=FAST)
def correct_weights(w, gain_direction, innovation_over_S):
    """Apply eq. 5, w(n|n) = w(n|n-1) + K (d - x'w), with K = g/S."""
    for i in range(w.size):
        w[i] += gain_direction[i] * innovation_over_S


@part(fastmath=FAST)
def correction_is_finite(w, gain_direction, innovation_over_S):
    """Return whether `correct_weights` would leave finite weights."""
    total = 0.0
    for i in range(w.size):
        total += abs(w[i] + gain_direction[i] * innovation_over_S)
    return np.isfinite(total)


@inlined
def update_weights(cov, w, h, scaled_measurement, S, noise):
    """Apply eq. 9 and 8 after `project_covariance`: correct `w` in place, downdate P, return the innovation.

    `noise` is the measurement noise in S: if S is far larger, the downdate is computed in twice the precision.
    If the innovation or a weight would not be finite, return NaN and change nothing.
    """
    y = scaled_measurement - dot(h, w)
    if not correction_is_finite(w, cov.product, y / S):
        return np.nan
    if not (S / noise > CANCELLATION and downdate_carefully(cov, h, noise)):
        downdate_covariance(cov, S)
    correct_weights(w, cov.gain_direction, y / S)
    return y


@by_type
def kalman_step(gains, w, h, scaled_measurement, state_noise, noise, alpha_sq):
    """Process one sample (eq. 2-9): predict, correct the weights `w` in place, return the innovation and S.

    If the step has no solution, the innovation is NaN and nothing has changed. `gains` is the covariance, or another
    source of gains with a registered body.
    """
    owed = gains.owed[0]
    scale, diagonal, inverse_S, bound = owed.scale, owed.diagonal, owed.inverse_S, owed.bound
    predict_covariance(gains, alpha_sq, state_noise)
    S = project_covariance(gains, h) + noise
    y = np.nan
    if 0.0 < S < np.inf:
        y = update_weights(gains, w, h, scaled_measurement, S, noise)
    if not np.isfinite(y):
        take_back(gains, scale, diagonal, inverse_S, alpha_sq, state_noise)
        owed.bound = bound
    return y, S


@part()
def take_back(cov, scale, diagonal, inverse_S, alpha_sq, state_noise):
    """Undo, up to rounding, the prediction and projection of a step that cannot be completed."""
    T, g = cov.triangle, cov.gain_direction
    for i in range(g.size):
        T[i, i] -= alpha_sq * diagonal + state_noise
        for j in range(i + 1):
            T[i, j] = T[i, j] / (alpha_sq * scale) + inverse_S * g[i] * g[j]
    owed = cov.owed[0]
    owed.scale, owed.diagonal, owed.inverse_S = scale, diagonal, inverse_S


def full_covariance(T: np.ndarray, g: np.ndarray, scale: float, diagonal: float, weight: float) -> np.ndarray:
    """Return the full symmetric array scale T + weight g g' + diagonal I."""
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
    """Return P as a new full symmetric array (n, n)."""
    scale, diagonal, inverse_S, *_ = cov.owed.item()
    return full_covariance(cov.triangle, cov.gain_direction, scale, diagonal, -scale * inverse_S)
