r"""The Kalman filter without state noise, or with forgetting, in O(L) per sample.

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
sample, since the errors of P are not forgotten.

References: R. Fraanje, A. H. Sayed, M. Verhaegen, N. J. Doelman, "A fast-array Kalman filter solution to active noise
control", Int. J. Adapt. Control Signal Process. 19, 2005; A. H. Sayed, Fundamentals of Adaptive Filtering, Wiley 2003,
ch. 14 (fast array RLS), from which these equations follow.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .._validate import as_positive
from ..kernels.compiling import inlined, part
from ..kernels.delay_lines import latest, newest
from ..kernels.records import new_record
from ..kernels.vectors import FAST
from ..power.amplifiers import Amplifier
from ..power.constraint import ConstraintState, OutputPowerConstraint, advance_constraint, squares_are_finite
from ..power.limiter import OutputLimiter
from .base import FilteredReferenceController, constraint_or_none
from .step import Lines, adapt, disturbance_estimate, follow


class FastArray(NamedTuple):
    """The array that the rotations update."""

    gain: np.ndarray  # (L + 1,) g gamma^(-1/2), and 0
    first: np.ndarray  # (L + 1,) first column of L
    second: np.ndarray  # (L + 1,) second column
    numbers: (
        np.ndarray
    )  # record: root = gamma^(-1/2), ahead and behind = u_bar times the two columns, forgetting = lambda


class FastArrayState(NamedTuple):
    """State of `FastArrayKalman`."""

    lines: Lines
    weights: np.ndarray
    constraint: ConstraintState
    array: FastArray


def new_fast_array(n_taps: int, initial: float, forgetting: float) -> FastArray:
    """Return the array before the first sample, for P = initial diag(lambda^2, ..., lambda^(L+1)) and zeros so far."""
    gain, first, second = (np.zeros(n_taps + 1) for _ in range(3))
    first[0] = np.sqrt(initial * forgetting)
    second[-1] = first[0] * forgetting ** (n_taps / 2)
    return FastArray(gain, first, second, new_record(root=1.0, ahead=0.0, behind=0.0, forgetting=forgetting))


@adapt.register(FastArrayState)
def adapt_fast_array(state, error, control_signal):
    """Apply eq. 2-9 by the two rotations."""
    return rotate(state, error)


@follow.register(FastArrayState)
def follow_fast_array(state, error):
    """Adapt while listening: the gains must follow the filtered reference from the first sample on."""
    return rotate(state, error)


@inlined
def rotate(state, error):
    """Apply eq. 2-9 by the two rotations; return False, with nothing changed, if rounding has corrupted the array."""
    row = newest(state.lines.filtered, state.weights.size + 1)
    if not array_holds(state.array, row):
        return False
    d, x = disturbance_estimate(state.lines, error), latest(state.lines.reference)
    if not squares_are_finite(d, row[0], x):
        return False
    factor = advance_constraint(state.constraint, d, row[0], x)
    correct_by_rotations(state.array, state.weights, row, factor * d)
    return True


@part(fastmath=FAST)
def array_holds(array, row):
    """Return whether the step for `row`, the L + 1 newest samples, has a solution: rounding can corrupt the array.

    Also set the products of `row` and the two columns, which `correct_by_rotations` uses.
    """
    ahead = behind = 0.0
    for i in range(row.size):
        ahead += row[i] * array.first[i]
        behind += row[i] * array.second[i]
    numbers = array.numbers[0]
    numbers.ahead, numbers.behind = ahead, behind
    root = numbers.root
    return behind * behind < root * root + ahead * ahead < np.inf


@part(fastmath=FAST)
def correct_by_rotations(array, w, row, d):
    """Apply the two rotations, then w += g (d - w' x'); call `array_holds` with the same `row` first."""
    gain, first, second, numbers = array.gain, array.first, array.second, array.numbers[0]
    root = np.sqrt(numbers.root**2 + numbers.ahead**2)
    c, s, t = numbers.root / root, numbers.ahead / root, numbers.behind / root
    h = 1.0 / np.sqrt(1.0 - t * t)
    grow = 1.0 / np.sqrt(numbers.forgetting)
    for i in range(gain.size - 1, -1, -1):
        shifted = gain[i - 1] if i > 0 else 0.0
        rotated = c * shifted + s * first[i]
        first[i] = (c * first[i] - s * shifted) * grow
        gain[i] = h * (rotated - t * second[i])
        second[i] = h * (second[i] - t * rotated) * grow
    numbers.root = root / h
    residual = d
    for i in range(w.size):
        residual -= w[i] * row[i]
    step = residual / numbers.root
    for i in range(w.size):
        w[i] += gain[i] * step


class FastArrayKalman(FilteredReferenceController):
    r"""Fast-array Kalman filter: eq. 2-9 with r = 0 in O(L), using the shift of the filtered reference.

    With `forgetting` = 1 it is `kf_anc` with ``state_noise=0`` (or `kf_opc`, with a rated power), to rounding. Below 1
    it is `fx_rls` from P = `initial_variance` diag(lambda, ..., lambda^L), which the derivation requires. It has no
    state noise, which would break the structure that makes the filter fast. For a random walk that follows a changing
    path, use the O(L^2) filter.

    Rounding: without forgetting, the weights agree with those of the O(L^2) filter to about 1e-10 over a million
    samples, on white, coloured and band-limited noise. With forgetting, errors grow by 1/lambda per sample until the
    array is lost, after 10 to 20 memories of 1/(1 - lambda) samples: some ten seconds for lambda = 0.9999 at 16 kHz.
    `update` then raises ValueError, and the weights stay as they were.

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter.
    secondary_path : array_like or control.TransferFunction
        Estimated secondary path, taps or an FIR system.
    measurement_noise, initial_variance
        q and P(0|0) as for `kf_anc`, both above zero.
    forgetting : float, default 1
        Forgetting factor lambda, above 0 and at most 1.
    rated_power : float, optional
        Rated output power rho_o: the measurement is scaled by the constraint factor of eq. 13. By default there is no
        constraint.
    constraint : OutputPowerConstraint, optional
        Given instead of `rated_power`: a rated power with the settings of its power estimates. A copy is kept.
    amplifier : callable, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.
    limiter : OutputLimiter, optional
        Limiter of the control signal, not shared with another controller.

    Raises
    ------
    ValueError
        A variance or forgetting factor out of range, a rated power that is not positive and finite, both a rated power
        and a constraint, fewer than one tap, a path that is not FIR. In a run: an array that rounding has corrupted.
    TypeError
        An amplifier that is not one of the package's models.

    Notes
    -----
    The gains must follow the filtered reference from the first sample on. The filter therefore also adapts while it
    listens, before the control is switched on: it starts with weights learnt from the noise so far.

    References
    ----------
    R. Fraanje, A. H. Sayed, M. Verhaegen, N. J. Doelman, "A fast-array Kalman filter solution to active noise control",
    Int. J. Adapt. Control Signal Process. 19, 2005. The docstring of this module has the derivation.

    Examples
    --------
    >>> from kfopc_filterpy import FastArrayKalman
    >>> controller = FastArrayKalman(4, [1.0], measurement_noise=1.0)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)
    >>> round(float(controller.weights[0]), 12)  # K = 1 / (1 + 1)
    1.0
    """

    name = "fast-array KF"
    _refusal = (
        "the fast array is lost to rounding: nothing was changed, and this filter cannot go on. Use a forgetting factor "
        "closer to 1, or kf_anc, whose O(L^2) form does not lose its covariance"
    )

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        measurement_noise: float,
        initial_variance: float = 1.0,
        forgetting: float = 1.0,
        rated_power: float | None = None,
        constraint: OutputPowerConstraint | None = None,
        amplifier: Amplifier | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        q = as_positive(measurement_noise, "measurement_noise")
        variance = as_positive(initial_variance, "initial_variance")
        forgetting = as_positive(forgetting, "forgetting")
        if forgetting > 1.0:
            raise ValueError(f"forgetting must be 1 at most, got {forgetting:g}: 1 forgets nothing")
        own = constraint_or_none(rated_power, constraint)
        super().__init__(
            n_taps, secondary_path, amplifier=amplifier, constraint=own, limiter=limiter, filtered_taps=n_taps + 1
        )
        if own is not None:
            self.name = "fast-array KF-OPC"
        array = new_fast_array(self.n_taps, variance / (q * forgetting), forgetting)
        self._state = FastArrayState(*self._common(), array)

    @property
    def forgetting(self) -> float:
        """Forgetting factor lambda."""
        return float(self._state.array.numbers["forgetting"][0])

    def _filter_again(self) -> None:
        """Keep the filtered reference: the array needs each row to be the last one, shifted by a sample."""
