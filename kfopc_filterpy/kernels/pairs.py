r"""Eq. 4-8 two samples at a time, where the second row is known with the first: the same filter, to rounding.

With P the covariance before two samples of rows h and f, the random walk (eq. 1) and one downdate (eq. 8) make the
directions g_k = S_k K_k

.. math:: g_1 = P h + r h, \qquad g_2 = P f + 2 r f - g_1 (g_1' f) / S_1

and the covariance after both P + 2 r I - g_1 g_1'/S_1 - g_2 g_2'/S_2. As in `kernels.project_covariance` the downdates
are paid in the pass that forms the next products: a pass for two samples, so that each element of the triangle is read
and written half as often, and seven operations serve where twice four would.

The triangle is read in whole vectors of eight. Hence the 8 x 8 blocks on its diagonal are kept in full (both halves
follow from the same operations, and are the same to the bit).
"""

from __future__ import annotations

import numpy as np

from .compiling import compiled, part
from .covariance import CANCELLATION, DIAGONAL, FAST, INVERSE_S, LAST_INVERSE_S, SCALE

VECTOR = 8  # a power of two; rows of float64 are padded to it
# Rows of the memory that `take_pairs` works in.
FIRST, SECOND, PRODUCT, SECOND_PRODUCT, PAST, SECOND_PAST, SILENT = range(7)
WORK = 7


@compiled(nogil=True)
def take_pairs(cov, rows, state_noise, measurement_noise, work, directions, S):
    """Take rows (m, n or more) two by two into a settled `cov`; `directions` and `S` are left as by `Block`.

    Returns how many were taken: a last odd one is not, and none from a pair on whose variance exceeds the noise so far
    that the downdate would cost digits of P, or that has no solution.
    """
    T, n, noise = cov.triangle, cov.product.size, measurement_noise
    first, second, Ph, Pf = work[FIRST], work[SECOND], work[PRODUCT], work[SECOND_PRODUCT]
    complete_diagonal_blocks(T, n)
    for i in range(first.size):
        first[i] = second[i] = 0.0
    diagonal, taken, owing = 0.0, 0, False
    for k in range(0, len(rows) - 1, 2):
        h, f, g, e = rows[k], rows[k + 1], directions[k], directions[k + 1]
        downdate_and_project(T, n, work, diagonal, h, f)
        owing = False
        variance, before, covariance = directions_alone(g, e, h, f, Ph, Pf, state_noise)
        S1, most = variance + noise, CANCELLATION * noise
        if not (0.0 < S1 <= most and before + noise <= most):
            break
        S2 = second_direction(e, g, f, covariance / S1) + noise
        if not S2 > 0.0:
            break
        S[k], S[k + 1] = S1, S2
        scale_both(first, second, g, e, 1.0 / np.sqrt(S1), 1.0 / np.sqrt(S2))
        diagonal, taken, owing = 2.0 * state_noise, k + 2, True
    if owing:
        downdate_and_project(T, n, work, diagonal, work[SILENT], work[SILENT])
    if taken:
        for i in range(n):
            cov.gain_direction[i] = directions[taken - 1, i]
        cov.owed[LAST_INVERSE_S] = 1.0 / S[taken - 1]
    cov.owed[SCALE], cov.owed[DIAGONAL], cov.owed[INVERSE_S] = 1.0, 0.0, 0.0
    return taken


@part(fastmath=FAST, forceinline=True, disjoint=True)
def directions_alone(g, e, h, f, Ph, Pf, state_noise):
    """The directions as each would be without the other; h'g, f'e and f'g."""
    hg = fe = fg = 0.0
    for i in range(g.size):
        g[i], e[i] = Ph[i] + state_noise * h[i], Pf[i] + 2.0 * state_noise * f[i]
        hg += h[i] * g[i]
        fe += f[i] * e[i]
        fg += f[i] * g[i]
    return hg, fe, fg


@part(fastmath=FAST, forceinline=True, disjoint=True)
def second_direction(e, g, f, share):
    """e less its share of g; f'e."""
    fe = 0.0
    for i in range(e.size):
        e[i] -= share * g[i]
        fe += f[i] * e[i]
    return fe


@part(forceinline=True, disjoint=True)
def scale_both(first, second, g, e, a, b):
    """Directions whose squares are the downdates."""
    for i in range(g.size):
        first[i], second[i] = a * g[i], b * e[i]


@part(forceinline=True)
def complete_diagonal_blocks(T, n):
    """Make the blocks on the diagonal symmetric, from the lower triangle."""
    for i in range(n):
        for j in range(i & -VECTOR, i):
            T[j, i] = T[i, j]


@part(fastmath=FAST)
def downdate_and_project(T, n, work, diagonal, h, f):
    """T + diagonal I less the squares of work[FIRST] and work[SECOND]; of that, work[PRODUCT] = T h and the other T f.

    The elements left of the diagonal's blocks serve their own row (in sums over the columns) and that of their
    mirror image; within the blocks, being kept in full, the latter only: h counts in the former as far as the blocks
    before.
    """
    Ph, Pf, past_h, past_f = work[PRODUCT], work[SECOND_PRODUCT], work[PAST], work[SECOND_PAST]
    for i in range(h.size):
        Ph[i] = Pf[i] = past_h[i] = past_f[i] = 0.0
    for i in range(0, h.size, 4):
        T0, T1, T2, T3 = T[i], T[i + 1], T[i + 2], T[i + 3]
        for k in range(i, min(i + 4, n)):
            T[k, k] += diagonal
        begin = i & -VECTOR
        sums = take_four_rows(
            T0, T1, T2, T3, work[FIRST], work[SECOND], h, f, past_h, past_f, Ph, Pf, i, begin + VECTOR
        )
        a0, a1, a2, a3, b0, b1, b2, b3 = sums
        Ph[i], Ph[i + 1], Ph[i + 2], Ph[i + 3] = Ph[i] + a0, Ph[i + 1] + a1, Ph[i + 2] + a2, Ph[i + 3] + a3
        Pf[i], Pf[i + 1], Pf[i + 2], Pf[i + 3] = Pf[i] + b0, Pf[i + 1] + b1, Pf[i + 2] + b2, Pf[i + 3] + b3
        if begin != i:
            for j in range(begin, begin + VECTOR):
                past_h[j], past_f[j] = h[j], f[j]


@part(fastmath={"contract"}, forceinline=True)
def downdated(t, a, b, c, d):
    """t - a b - c d: as it stands, since with its terms in another order it would be symmetric to rounding only."""
    return t - a * b - c * d


@part(fastmath=FAST, forceinline=True, disjoint=True)
def take_four_rows(T0, T1, T2, T3, g, e, h, f, past_h, past_f, Ph, Pf, i, end):
    """Rows i to i + 3 of `downdate_and_project` up to column `end`; returns their sums over the columns."""
    g0, g1, g2, g3 = g[i], g[i + 1], g[i + 2], g[i + 3]
    e0, e1, e2, e3 = e[i], e[i + 1], e[i + 2], e[i + 3]
    h0, h1, h2, h3 = h[i], h[i + 1], h[i + 2], h[i + 3]
    f0, f1, f2, f3 = f[i], f[i + 1], f[i + 2], f[i + 3]
    a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = 0.0
    for j in range(end):
        p0 = downdated(T0[j], g0, g[j], e0, e[j])
        p1 = downdated(T1[j], g1, g[j], e1, e[j])
        p2 = downdated(T2[j], g2, g[j], e2, e[j])
        p3 = downdated(T3[j], g3, g[j], e3, e[j])
        T0[j], T1[j], T2[j], T3[j] = p0, p1, p2, p3
        a0 += p0 * past_h[j]
        a1 += p1 * past_h[j]
        a2 += p2 * past_h[j]
        a3 += p3 * past_h[j]
        b0 += p0 * past_f[j]
        b1 += p1 * past_f[j]
        b2 += p2 * past_f[j]
        b3 += p3 * past_f[j]
        Ph[j] += p0 * h0 + p1 * h1 + p2 * h2 + p3 * h3
        Pf[j] += p0 * f0 + p1 * f1 + p2 * f2 + p3 * f3
    return a0, a1, a2, a3, b0, b1, b2, b3
