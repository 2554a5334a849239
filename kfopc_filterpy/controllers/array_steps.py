r"""The gain of a Kalman filter without state noise in O(L), from how P changes while the row shifts by one sample.

With P in units of the measurement noise, u(n) = x'(n)^T the row, lambda the forgetting factor and
:math:`\gamma^{-1}(n) = 1 + \lambda^{-1} u(n) P(n-1) u(n)^T`, the rows share all but one sample, so

.. math:: \lambda^{-1} \left( \begin{bmatrix} P(n) & 0 \\ 0 & 0 \end{bmatrix} -
   \begin{bmatrix} 0 & 0 \\ 0 & P(n-1) \end{bmatrix} \right) = \bar L(n)\, \mathrm{diag}(1, -1)\, \bar L(n)^T

keeps the rank two that it has at the start for P(-1) = eta diag(lambda^2, ..., lambda^{L+1}). One orthogonal and one
hyperbolic rotation that zero the second and third entry of the first row below then step gain, gamma and L together:

.. math:: \begin{bmatrix} \gamma^{-1/2}(n) & \bar u(n+1) \bar L(n) \\
   \begin{bmatrix} 0 \\ g(n) \gamma^{-1/2}(n) \end{bmatrix} & \bar L(n) \end{bmatrix} \Theta =
   \begin{bmatrix} \gamma^{-1/2}(n+1) & 0 \\
   \begin{bmatrix} g(n+1) \gamma^{-1/2}(n+1) \\ 0 \end{bmatrix} & \lambda^{1/2} \bar L(n+1) \end{bmatrix}

with :math:`\bar u(n+1)` the L + 1 newest samples. For forgetting rounding grows with the factor 1/lambda a sample,
since what is forgotten of P is not forgotten of its errors.

References: R. Fraanje, A. H. Sayed, M. Verhaegen, N. J. Doelman, "A fast-array Kalman filter solution to active noise
control", Int. J. Adapt. Control Signal Process. 19, 2005; A. H. Sayed, Fundamentals of Adaptive Filtering, Wiley 2003,
ch. 14 (fast array RLS), from which the above follows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..kernels.compiling import part
from ..kernels.covariance import FAST

ROOT, AHEAD, BEHIND, FORGETTING = range(4)  # numbers: gamma^(-1/2), u_bar times the two columns of L, lambda


class FastArrayState(NamedTuple):
    """What `advance_fast_array` reads and advances."""

    gain: np.ndarray  # (L + 1,) g gamma^(-1/2), and 0
    ahead: np.ndarray  # (L + 1,) first column of L
    behind: np.ndarray  # (L + 1,) second column
    numbers: np.ndarray  # (4,)


def new_fast_array(n_taps: int, initial: float, forgetting: float) -> FastArrayState:
    """State before the first sample, for P = initial diag(lambda^2, ..., lambda^(L+1)), all samples so far zero."""
    gain, ahead, behind = (np.zeros(n_taps + 1) for _ in range(3))
    state = FastArrayState(gain, ahead, behind, np.array([1.0, 0.0, 0.0, forgetting]))
    state.ahead[0] = np.sqrt(initial * forgetting)
    state.behind[-1] = state.ahead[0] * forgetting ** (n_taps / 2)
    return state


@part(fastmath=FAST, forceinline=True)
def fast_array_holds(fast, row):
    """Whether the step for this row, the L + 1 newest samples, has a solution: rounding has not spoilt the array.

    True for a controller that has none.
    """
    if fast is None:
        return True
    ahead = behind = 0.0
    for i in range(row.size):
        ahead += row[i] * fast.ahead[i]
        behind += row[i] * fast.behind[i]
    fast.numbers[AHEAD], fast.numbers[BEHIND] = ahead, behind
    root = fast.numbers[ROOT]
    return behind * behind < root * root + ahead * ahead < np.inf


@part(fastmath=FAST, forceinline=True)
def correct_fast_array(fast, w, row, d):
    """The two rotations, then w += g (d - w' x'); False for a controller that has no fast array.

    `row` is the one that `fast_array_holds` was called with.
    """
    if fast is None:
        return False
    gain, first, second, numbers = fast.gain, fast.ahead, fast.behind, fast.numbers
    root = np.sqrt(numbers[ROOT] ** 2 + numbers[AHEAD] ** 2)
    c, s, t = numbers[ROOT] / root, numbers[AHEAD] / root, numbers[BEHIND] / root
    h = 1.0 / np.sqrt(1.0 - t * t)
    grow = 1.0 / np.sqrt(numbers[FORGETTING])
    for i in range(gain.size - 1, -1, -1):
        shifted = gain[i - 1] if i > 0 else 0.0
        rotated = c * shifted + s * first[i]
        first[i] = (c * first[i] - s * shifted) * grow
        gain[i] = h * (rotated - t * second[i])
        second[i] = h * (second[i] - t * rotated) * grow
    numbers[ROOT] = root / h
    residual = d
    for i in range(w.size):
        residual -= w[i] * row[i]
    step = residual / numbers[ROOT]
    for i in range(w.size):
        w[i] += gain[i] * step
    return True
