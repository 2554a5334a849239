"""The Kalman filter with only the diagonal of its covariance, in O(L) per sample."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .._validate import as_nonnegative
from ..kernels.compiling import part
from ..kernels.delay_lines import newest
from ..kernels.vectors import FAST
from ..power.amplifiers import Amplifier
from ..power.constraint import ConstraintState, OutputPowerConstraint
from ..power.limiter import OutputLimiter
from .base import constraint_or_none
from .compiled_controller import CompiledController
from .step import Lines, adapt, advance_powers


class DiagonalState(NamedTuple):
    """State of `DiagonalKalman`."""

    lines: Lines
    weights: np.ndarray
    constraint: ConstraintState
    variances: np.ndarray  # (L,) of the weights
    state_noise: float
    measurement_noise: float


@adapt.register(DiagonalState)
def adapt_diagonal(state, error, control_signal):
    """Apply eq. 2-9 with P reduced to its diagonal."""
    finite, d, factor = advance_powers(state.lines, state.constraint, error)
    if finite:
        row = newest(state.lines.filtered, state.weights.size)
        correct_diagonal(state.variances, state.weights, row, factor * d, state.state_noise, state.measurement_noise)
        observe_guarded(state.lines.guard, state.variances, state.weights, state.measurement_noise)
    return finite


@part()
def observe_guarded(guard, variances, w, noise):
    """Correct w as if w'x'' with x'' = W * x' had been measured as zero, if there is a guard."""
    if guard is not None:
        correct_diagonal(variances, w, newest(guard.filtered, w.size), 0.0, 0.0, noise)


@part(fastmath=FAST)
def correct_diagonal(variances, w, row, d, state_noise, measurement_noise):
    """Apply eq. 3-8 with P = diag(p): p += r, S = sum p x'^2 + q, K = p x' / S, w += K (d - w'x'), p -= K x' p."""
    S, residual = measurement_noise, d
    for i in range(w.size):
        variances[i] += state_noise
        S += variances[i] * row[i] * row[i]
        residual -= w[i] * row[i]
    if S > 0.0:  # S = 0 if q = 0 and the reference is silent: there is nothing to correct
        for i in range(w.size):
            gain = variances[i] * row[i] / S
            w[i] += gain * residual
            variances[i] *= max(1.0 - gain * row[i], 0.0)  # rounding of S can make the product exceed 1


class DiagonalKalman(CompiledController):
    r"""Reduced-complexity Kalman filter: eq. 2-9 with P reduced to its diagonal p, an NLMS with a step for each tap.

    .. math:: p \leftarrow p + r, \quad S = \sum_i p_i x_i'^2 + q, \quad K_i = p_i x'_i / S, \quad
       w \leftarrow w + K (\alpha \hat d - w^T x'), \quad p_i \leftarrow (1 - K_i x'_i) p_i

    It ignores the correlation between neighbouring taps of a coloured reference. It therefore converges like NLMS: the
    narrower the band, the slower it is than the full filter. On a white reference it comes close to the full filter
    after a dozen samples per tap.

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter.
    secondary_path : array_like or control.TransferFunction
        Estimated secondary path, taps or an FIR system.
    state_noise, measurement_noise, initial_variance
        r, q and P(0|0) as for `kf_anc`.
    rated_power : float, optional
        Rated output power rho_o: the measurement is scaled by the constraint factor alpha of eq. 13. By default there
        is no constraint, alpha = 1.
    constraint : OutputPowerConstraint, optional
        Given instead of `rated_power`: a rated power with the settings of its power estimates. A copy is kept.
    amplifier : callable, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.
    limiter : OutputLimiter, optional
        Limiter of the control signal, not shared with another controller.

    Attributes
    ----------
    variances : ndarray
        (L,) diagonal of P; a copy.

    Raises
    ------
    ValueError
        A variance that is negative or not finite, a rated power that is not positive and finite, both a rated power and
        a constraint, fewer than one tap, a path that is not FIR.
    TypeError
        An amplifier that is not one of the package's models.

    References
    ----------
    After J. Fabry, S. Liebich, P. Vary, P. Jax, "Active noise control with reduced-complexity Kalman filter", IWAENC
    2018. The text was not available; the equations are derived from eq. 2-9.

    Examples
    --------
    >>> from kfopc_filterpy import DiagonalKalman
    >>> controller = DiagonalKalman(4, [1.0], state_noise=0.0, measurement_noise=1.0)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)
    >>> float(controller.weights[0]), float(controller.variances[0])  # K = 1 / (1 + 1)
    (1.0, 0.5)
    """

    name = "diagonal KF"

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        state_noise: float,
        measurement_noise: float,
        initial_variance: float = 1.0,
        rated_power: float | None = None,
        constraint: OutputPowerConstraint | None = None,
        amplifier: Amplifier | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        r, q = as_nonnegative(state_noise, "state_noise"), as_nonnegative(measurement_noise, "measurement_noise")
        variance = as_nonnegative(initial_variance, "initial_variance")
        own = constraint_or_none(rated_power, constraint)
        super().__init__(n_taps, secondary_path, amplifier=amplifier, constraint=own, limiter=limiter)
        if own is not None:
            self.name = "diagonal KF-OPC"
        self._state = DiagonalState(*self._common(), np.full(self.n_taps, variance), r, q)

    @property
    def state_noise(self) -> float:
        """State noise variance r."""
        return self._state.state_noise

    @property
    def measurement_noise(self) -> float:
        """Measurement noise variance q."""
        return self._state.measurement_noise

    @property
    def variances(self) -> np.ndarray:
        """Diagonal of P, (L,); a copy."""
        return self._state.variances.copy()

    def _takes_guard(self) -> bool:
        return True

    def _after_new_path(self, before: np.ndarray) -> None:
        """Let the variances grow by that which the new path gives to the weights."""
        self._state.variances[:] += self._variance_by_new_path(before)
