"""Compiled arithmetic of symmetric Toeplitz matrices, given by their first row."""

from __future__ import annotations

import numpy as np

from .compiling import compiled, part
from .vectors import FAST, dot


@part(fastmath=FAST)
def toeplitz_times(t, w, out):
    """Set out = T w."""
    n = w.size
    for i in range(n):
        out[i] = t[0] * w[i]
    for k in range(1, n):
        for i in range(n - k):
            out[i] += t[k] * w[i + k]
            out[i + k] += t[k] * w[i]


@part(fastmath=FAST)
def toeplitz_power(t, w):
    """Return w' T w, from the autocorrelation of w, which costs half as much as T w."""
    n = w.size
    power = t[0] * dot(w, w)
    for k in range(1, n):
        lagged = 0.0
        for i in range(n - k):
            lagged += w[i] * w[i + k]
        power += 2.0 * t[k] * lagged
    return power


@compiled(fastmath=FAST)
def solve_toeplitz(t, b, v):
    """Set v to the solution of T v = b by Levinson's recursion; return False if T is not positive definite.

    The backward predictor is the forward one reversed. It has its own array, so that it is read in memory order and
    moves by one place per order without being copied.
    """
    n = v.size
    reversed_t = t[::-1].copy()
    forward, backward = np.zeros(n), np.zeros(2 * n)
    error = t[0]
    if not error > 0.0:
        return False
    forward[0] = backward[n - 1] = 1.0
    v[0] = b[0] / error
    for m in range(1, n):
        ahead = reversed_t[n - 1 - m :]  # t[m - i] at i
        back = backward[n - 1 - m :]  # the backward predictor of the last order, shifted by one place
        reflection, rest = 0.0, b[m]
        for i in range(m):
            reflection += forward[i] * ahead[i]
            rest -= v[i] * ahead[i]
        reflection /= -error
        error *= 1.0 - reflection * reflection
        if not error > 0.0:
            return False
        for i in range(m + 1):
            f, g = forward[i], back[i]
            forward[i], back[i] = f + reflection * g, g + reflection * f
        v[m] = 0.0
        step = rest / error
        for i in range(m + 1):
            v[i] += step * back[i]
    return True
