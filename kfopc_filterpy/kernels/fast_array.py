r"""The fast array: gains of a Kalman filter without state noise, or with forgetting, in O(L) per sample.

It uses the shift of the row by one sample at a time. Let P be in units of the measurement noise, u(n) = x'(n)^T the
row, lambda the forgetting factor and :math:`\gamma^{-1}(n) = 1 + \lambda^{-1} u(n) P(n-1) u(n)^T`. Successive rows
share all but one sample, so

.. math:: \lambda^{-1} \left( \begin{bmatrix} P(n) & 0 \\ 0 & 0 \end{bmatrix} -
   \begin{bmatrix} 0 & 0 \\ 0 & P(n-1) \end{bmatrix} \right) = \bar L(n)\, \mathrm{diag}(1, -1)\, \bar L(n)^T

keeps its rank of two, which it has at the start if P(-1) = eta diag(lambda^2, ..., lambda^{L+1}). One orthogonal and
one hyperbolic rotation, which zero the second and third entry of the first row below, then update gain, gamma and L
together:

.. math:: \begin{bmatrix} \gamma^{-1/2}(n) & \bar u(n+1) \bar L(n) \\
   \begin{bmatrix} 0 \\ g(n) \gamma^{-1/2}(n) \end{bmatrix} & \bar L(n) \end{bmatrix} \Theta =
   \begin{bmatrix} \gamma^{-1/2}(n+1) & 0 \\
   \begin{bmatrix} g(n+1) \gamma^{-1/2}(n+1) \\ 0 \end{bmatrix} & \lambda^{1/2} \bar L(n+1) \end{bmatrix}

with :math:`\bar u(n+1)` the L + 1 newest samples. With forgetting, rounding errors grow by the factor 1/lambda per
sample, since the errors of P are not forgotten. Without it they grow slowly, but if P(-1) is large, the rotations cancel
its digits. The last entry of the rotated gain column is zero in exact arithmetic, so it shows how far an array has gone
astray (`stray`).

An array can also begin in the middle of a signal if it takes the samples before as zeros: :math:`\bar u` then has fewer
entries than L + 1 at first, and the structure holds. `FastArray.numbers.heard` counts the samples since the start.

References: R. Fraanje, A. H. Sayed, M. Verhaegen, N. J. Doelman, "A fast-array Kalman filter solution to active noise
control", Int. J. Adapt. Control Signal Process. 19, 2005; A. H. Sayed, Fundamentals of Adaptive Filtering, Wiley 2003,
ch. 14 (fast array RLS), from which these equations follow.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .compiling import part
from .records import new_record
from .vectors import FAST

UNUSABLE = 0.1  # stray beyond which an array is lost


class FastArray(NamedTuple):
    """The array that the rotations update."""

    gain: np.ndarray  # (L + 1,) g gamma^(-1/2), and a last entry that is zero but for rounding
    first: np.ndarray  # (L + 1,) first column of L
    second: np.ndarray  # (L + 1,) second column
    numbers: np.ndarray  # record, see `new_fast_array`


def new_fast_array(n_taps: int, initial: float, forgetting: float = 1.0, largest_stray: float = UNUSABLE) -> FastArray:
    """Return the array before the first sample, for P = initial diag(lambda^2, ..., lambda^(L+1)) and zeros so far."""
    gain, first, second = (np.zeros(n_taps + 1) for _ in range(3))
    first[0] = np.sqrt(initial * forgetting)
    second[-1] = first[0] * forgetting ** (n_taps / 2)
    numbers = new_record(
        root=1.0,  # gamma^(-1/2)
        ahead=0.0,  # u_bar times the first column
        behind=0.0,  # u_bar times the second column
        forgetting=forgetting,  # lambda
        energy=0.0,  # squared norm of the gain column
        largest_stray=largest_stray,
        heard=0,  # samples since the start
        trusted=0,  # samples at the start that leave the weights as they are
    )
    return FastArray(gain, first, second, numbers)


@part()
def restart_array(array, initial):
    """Begin again with P = initial I at weights that are known: the row's samples so far count as zeros.

    The first L - 1 rows are incomplete, and what is measured does not belong to them. They leave the weights as they are:
    they count as measurements that the weights explain, so that P is complete when the first full row is due.
    """
    numbers = array.numbers[0]
    for i in range(array.gain.size):
        array.gain[i] = array.first[i] = array.second[i] = 0.0
    array.first[0] = array.second[-1] = np.sqrt(initial)
    numbers.root, numbers.energy = 1.0, 0.0
    numbers.heard, numbers.trusted = 0, array.gain.size - 2


@part(fastmath=FAST)
def array_holds(array, row):
    """Return whether the step for `row`, the L + 1 newest samples, has a solution: rounding can corrupt the array.

    Also set the products of `row` and the two columns, which `correct_by_rotations` uses.
    """
    numbers = array.numbers[0]
    ahead = behind = 0.0
    for i in range(min(numbers.heard + 1, row.size)):
        ahead += row[i] * array.first[i]
        behind += row[i] * array.second[i]
    numbers.ahead, numbers.behind = ahead, behind
    root, last, largest = numbers.root, array.gain[-1], numbers.largest_stray
    return last * last <= largest * largest * numbers.energy and behind * behind < root * root + ahead * ahead < np.inf


@part(fastmath=FAST)
def rotate_array(array):
    """Apply the two rotations; call `array_holds` with the row first."""
    gain, first, second, numbers = array.gain, array.first, array.second, array.numbers[0]
    root = np.sqrt(numbers.root**2 + numbers.ahead**2)
    c, s, t = numbers.root / root, numbers.ahead / root, numbers.behind / root
    h = 1.0 / np.sqrt(1.0 - t * t)
    grow = 1.0 / np.sqrt(numbers.forgetting)
    energy = 0.0
    for i in range(gain.size - 1, -1, -1):
        shifted = gain[i - 1] if i > 0 else 0.0
        rotated = c * shifted + s * first[i]
        first[i] = (c * first[i] - s * shifted) * grow
        gain[i] = h * (rotated - t * second[i])
        second[i] = h * (second[i] - t * rotated) * grow
        energy += gain[i] * gain[i]
    numbers.root, numbers.energy = root / h, energy
    numbers.heard += 1


@part(fastmath=FAST)
def correct_by_rotations(array, w, row, d):
    """Apply the two rotations, then w += g (d - w' x'); call `array_holds` with the same `row` first."""
    rotate_array(array)
    gain, numbers = array.gain, array.numbers[0]
    if numbers.heard <= numbers.trusted:
        return
    residual = d
    for i in range(w.size):
        residual -= w[i] * row[i]
    step = residual / numbers.root
    for i in range(w.size):
        w[i] += gain[i] * step


def stray(array: FastArray) -> float:
    """Return the last entry of the gain column relative to the column: 0 but for rounding."""
    energy = float(array.numbers["energy"][0])
    return abs(float(array.gain[-1])) / energy**0.5 if energy > 0.0 else 0.0
