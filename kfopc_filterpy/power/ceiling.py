"""What more power would bring behind a limiter, and what it would cost.

A limiter plays g u instead of u, with a gain g <= 1 that is less than 1 while u is too loud. Let u be v' x with the
power-constrained control filter v, ``(R_x' + lambda R_x) v = R_x' w``, its power ``q = v' R_x v`` and the power of the
anti-noise ``a = v' R_x' v``. If g depends on the level of u only, the power of the error is, up to a constant,

    J = a E[p g^2] - 2 (v' R_x' w) E[p g],

where p is the recent power of u over its mean. While the limiter acts, it keeps p g^2 q constant, so g falls as
1/sqrt(q), and

    dJ/dq = (a/q - da/dq) E[p g (1 - g)] - lambda E[p; g = 1].

The second term is what more power gains: while the signal passes unchanged, each unit of additional power lowers the
error by lambda, the Lagrange multiplier. The first is what it loses: while the limiter acts, the output power stays the
same, but the filter uses it less well. Both expected values follow from the signals before and after the limiter. With
y = g u they are the mean of y (u - y), and the mean of u^2 over samples with y = u, each divided by q. So nothing need
be known about the limiter itself.

For a flat secondary path a/q = da/dq: nothing is lost, and the best filter behind a limiter is the unconstrained one.
"""

from __future__ import annotations

import numpy as np

from ..kernels.compiling import part
from ..kernels.toeplitz import solve_toeplitz, toeplitz_power, toeplitz_times
from ..kernels.vectors import dot
from .allocation import RIDGE


@part()
def balance_of_power(of_x, of_xf, weight, v, passed, taken):
    """Return what more power gains less what it loses, over their sum (-1 to 1; NaN if not known), and the power q.

    `passed` is the mean of u^2 over samples that a limiter leaves as they are, `taken` that of y (u - y).
    """
    power = toeplitz_power(of_x, v)
    driven, total, answer = np.empty(v.size), np.empty(v.size), np.empty(v.size)
    toeplitz_times(of_x, v, driven)
    for k in range(v.size):
        total[k] = of_xf[k] + weight * of_x[k]
    total[0] += RIDGE * of_xf[0]
    if not (weight < np.inf and solve_toeplitz(total, driven, answer)):
        return np.nan, power
    antinoise = toeplitz_power(of_xf, v)
    slope = power / dot(driven, answer) - weight  # da/dq: a change of lambda moves v by -answer, a and q with it
    loss = min(max(antinoise - power * slope, 0.0), antinoise) * max(taken, 0.0)
    gain = weight * power * passed
    if not (gain + loss > 0.0 and gain + loss < np.inf):
        return np.nan, power
    return (gain - loss) / (gain + loss), power
