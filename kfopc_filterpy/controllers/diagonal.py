"""The Kalman filter with the diagonal of its covariance alone: O(L) a sample."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._validate import as_nonnegative
from ..loop.run import LMS
from ..power.amplifiers import Amplifier
from ..power.constraint import DEFAULT_FS, DEFAULT_MEMORY_S
from ..power.limiter import OutputLimiter
from .base import FilteredReferenceController, constraint_or_none
from .lms_rules import MEASUREMENT_NOISE, PLAIN, STATE_NOISE, lms_settings


class DiagonalKalman(FilteredReferenceController):
    r"""Reduced-complexity Kalman filter: eq. 2-9 with P held to its diagonal p, an NLMS with a step for each tap.

    .. math:: p \leftarrow p + r, \quad S = \sum_i p_i x_i'^2 + q, \quad K_i = p_i x'_i / S, \quad
       w \leftarrow w + K (\alpha \hat d - w^T x'), \quad p_i \leftarrow (1 - K_i x'_i) p_i

    What it leaves out is what neighbouring taps of a coloured reference tell of each other, so it converges as NLMS does,
    slower than the full filter the narrower the band; on a white reference it comes near it after a dozen samples a tap.

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter.
    secondary_path : array_like or control.TransferFunction
        Estimated secondary path, taps or an FIR system.
    state_noise, measurement_noise, initial_variance
        r, q and P(0|0) as for `kf_anc`.
    rated_power : float, optional
        Rated output power rho_o: the measurement is scaled by the constraint factor alpha of eq. 13. By default no
        constraint, alpha = 1.
    fs, power_memory, power_window, secondary_path_gain
        As `fs`, `memory`, `window`, `secondary_path_gain` of `OutputPowerConstraint`.
    amplifier : callable, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.
    limiter : OutputLimiter, optional
        Limiter of its own that the control signal goes through.

    Attributes
    ----------
    variances : ndarray
        (L,) diagonal of P; a copy.

    Raises
    ------
    ValueError
        A variance that is negative or not finite, a rated power, rate, memory or gain that is not positive and finite,
        another window, fewer than one tap, a path that is no FIR path.
    TypeError
        An amplifier that is none of the amplifier models.

    References
    ----------
    After J. Fabry, S. Liebich, P. Vary, P. Jax, "Active noise control with reduced-complexity Kalman filter", IWAENC 2018,
    whose text was not at hand: derived here from eq. 2-9.

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
        fs: float = DEFAULT_FS,
        power_memory: float = DEFAULT_MEMORY_S,
        power_window: str = "exponential",
        secondary_path_gain: float | None = None,
        amplifier: Amplifier | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        r, q = as_nonnegative(state_noise, "state_noise"), as_nonnegative(measurement_noise, "measurement_noise")
        variance = as_nonnegative(initial_variance, "initial_variance")
        constraint = constraint_or_none(
            rated_power, secondary_path_gain=secondary_path_gain, fs=fs, memory=power_memory, window=power_window
        )
        self._constrained = rated_power is not None
        if self._constrained:
            self.name = "diagonal KF-OPC"
        settings = lms_settings(PLAIN, 0.0)
        settings[STATE_NOISE], settings[MEASUREMENT_NOISE] = r, q
        super().__init__(LMS, n_taps, secondary_path, settings, amplifier, constraint, limiter)
        self._state = self._state._replace(variances=np.full(self._state.weights.size, variance))

    @property
    def state_noise(self) -> float:
        """State noise variance r."""
        return float(self._state.settings[STATE_NOISE])

    @property
    def measurement_noise(self) -> float:
        """Measurement noise variance q."""
        return float(self._state.settings[MEASUREMENT_NOISE])

    @property
    def rated_power(self) -> float | None:
        """Rated output power; None without a constraint."""
        return self.constraint.rated_power if self._constrained else None

    @property
    def variances(self) -> np.ndarray:
        """Diagonal of P, (L,); a copy."""
        assert self._state.variances is not None
        return self._state.variances.copy()
