"""The power-constrained control filter for a Kalman filter's estimate, compiled.

The unconstrained control filter w contains all that matters of the disturbance: with the optimal ``w``, the error power
of any control filter v is ``E[e^2] = J + (v - w)' R_x' (v - w)``. Its minimum within ``v' R_x v <= rho`` is therefore
given by

    (R_x' + lambda R_x) v = R_x' w,    lambda >= 0 such that v' R_x v = rho,

the power-constrained Wiener solution, with the correlations R_x, R_x' of reference and filtered reference. Both are
Toeplitz here: they are the correlations of a stretch of signal with zeros around it. Being the Fourier transform of a
power spectrum, they are positive semidefinite to rounding.
"""

from __future__ import annotations

import math

import numpy as np

from ..kernels.compiling import part
from ..kernels.toeplitz import solve_toeplitz, toeplitz_power, toeplitz_times
from ..kernels.vectors import add_scaled, copy_into

RIDGE = 1e-7  # of R_x'[0], a penalty on v - w: it decides in the directions that no signal excites
POWER_TOLERANCE = 0.005  # relative error of the power that is solved for
TRIES = 20
NEAR = 1e-6  # a search starts from the last lambda if NEAR < lambda / gain < 1 / NEAR, with gain = E[x'^2]/E[x^2]


@part()
def constrained_filter(of_x, of_xf, w, power, weight, v):
    """Set v to the power-constrained filter and return lambda; the search starts from lambda = `weight`.

    `of_x`, `of_xf` are the first rows of R_x and R_x'. 1/sqrt(v' R_x v) grows with lambda and is nearly linear (exactly
    linear for a flat secondary path): this is the secular equation of trust-region methods (Hebden; More and Sorensen).
    It is solved by secants within a bracket (the Illinois rule). If that fails, the estimate is scaled, which always
    keeps the power, and lambda is infinite.
    """
    free = toeplitz_power(of_x, w)
    if free <= power:
        copy_into(v, w)
        return 0.0
    if not free < np.inf:
        return scaled_filter(w, 0.0, v)
    goal, at_low = 1.0 / math.sqrt(power), 1.0 / math.sqrt(free)
    scale = at_low / goal
    gain = of_xf[0] / of_x[0]
    if not (gain > 0.0 and gain < np.inf):
        return scaled_filter(w, scale, v)
    right, total = np.empty(w.size), np.empty(w.size)
    toeplitz_times(of_xf, w, right)
    add_scaled(right, RIDGE * of_xf[0], w, 0, w.size)
    low, high, at_high, moved = 0.0, np.inf, np.inf, 0
    if not (weight > NEAR * gain and weight < gain / NEAR):
        weight = gain * (1.0 / scale - 1.0)  # exact for a flat path
    for _ in range(TRIES):
        for k in range(w.size):
            total[k] = of_xf[k] + weight * of_x[k]
        total[0] += RIDGE * of_xf[0]
        if not solve_toeplitz(total, right, v):
            break
        reached = toeplitz_power(of_x, v)
        if not reached > 0.0:
            break
        if abs(reached - power) <= POWER_TOLERANCE * power:
            return weight
        at_weight = 1.0 / math.sqrt(reached)
        if at_weight < goal:
            if high == np.inf:
                slope = (at_weight - at_low) / (weight - low)
            elif moved < 0:
                at_high = 0.5 * (at_high + goal)  # Illinois: an end that stays twice is moved closer
            low, at_low, moved = weight, at_weight, -1
        else:
            if moved > 0:
                at_low = 0.5 * (at_low + goal)
            high, at_high, moved = weight, at_weight, 1
        if high < np.inf:
            slope = (at_high - at_low) / (high - low)
        weight = low + (goal - at_low) / slope if slope > 0.0 else 2.0 * low
        if not (weight > low and weight < high):
            weight = 0.5 * (low + high) if high < np.inf else 2.0 * low
    return scaled_filter(w, scale, v)


@part()
def guarded(of_xf, of_guard, w):
    """Return the first row of R_x' + R_Wx' and the filter v that minimises E[(d - v'x')^2] + E[(v'Wx')^2].

    With that row in place of R_x' and that filter in place of w, `constrained_filter` adds the rated power. `of_xf` has
    n_guard - 1 lags more than w has taps: R_Wx' is the correlation of x' after W, which depends on them. It is
    positive semidefinite as R_x' is, because the whole of W counts.
    """
    L = w.size
    sum_of_both, right, free = np.empty(L), np.empty(L), np.empty(L)
    for k in range(L):
        sum_of_both[k] = of_xf[k] + of_guard[0] * of_xf[k]
        for m in range(1, of_guard.size):
            sum_of_both[k] += of_guard[m] * (of_xf[k + m] + of_xf[abs(k - m)])
    toeplitz_times(of_xf[:L], w, right)
    add_scaled(right, RIDGE * of_xf[0], w, 0, L)
    sum_of_both[0] += RIDGE * of_xf[0]
    if not solve_toeplitz(sum_of_both, right, free):
        copy_into(free, w)
    sum_of_both[0] -= RIDGE * of_xf[0]
    return sum_of_both, free


@part()
def scaled_filter(w, factor, v):
    """Set v to `factor` times w, and return Inf, the lambda of a scaled estimate."""
    for i in range(w.size):
        v[i] = factor * w[i]
    return np.inf
