"""The Kalman filter without state noise, or with forgetting, at O(L) a sample."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._validate import as_positive
from ..kernels.delay_lines import delay_line
from ..loop.run import LMS, ControllerState
from ..power.amplifiers import Amplifier
from ..power.constraint import DEFAULT_FS, DEFAULT_MEMORY_S
from ..power.limiter import OutputLimiter
from .array_steps import FORGETTING, new_fast_array
from .base import FilteredReferenceController, constraint_or_none
from .lms_rules import PLAIN, lms_settings


class FastArrayKalman(FilteredReferenceController):
    r"""Fast-array Kalman filter: eq. 2-9 with r = 0 in O(L), by the shift of the filtered reference.

    With `forgetting` = 1 it is `kf_anc` with ``state_noise=0`` (or `kf_opc`, with a rated power), to rounding; below 1 it
    is `fx_rls` from P = `initial_variance` diag(lambda, ..., lambda^L), the start that its derivation needs. State noise
    breaks what makes it fast: a random walk that must follow a changing path is what the O(L^2) filter is for.

    Rounding: without forgetting the weights agree with the O(L^2) filter's to some 1e-10 over a million samples, on white,
    coloured and band-limited noise. With forgetting an error grows by 1/lambda a sample, until the array is lost after 10
    to 20 memories of 1/(1 - lambda) samples: some ten seconds for lambda = 0.9999 at 16 kHz. `update` then refuses and
    says so; the weights stay as they were.

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
        Rated output power rho_o: the measurement is scaled by the constraint factor of eq. 13. By default no constraint.
    fs, power_memory, power_window, secondary_path_gain
        As `fs`, `memory`, `window`, `secondary_path_gain` of `OutputPowerConstraint`.
    amplifier : callable, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.
    limiter : OutputLimiter, optional
        Limiter of its own that the control signal goes through.

    Raises
    ------
    ValueError
        A variance or forgetting factor out of range, a rated power, rate, memory or gain that is not positive and finite,
        another window, fewer than one tap, a path that is no FIR path. In a run: an array that rounding has spoilt.
    TypeError
        An amplifier that is none of the amplifier models.

    Notes
    -----
    The gains must follow the filtered reference from silence on. While it listens, before the control is switched on,
    the filter therefore learns: its weights are those of the noise heard when it starts.

    References
    ----------
    R. Fraanje, A. H. Sayed, M. Verhaegen, N. J. Doelman, "A fast-array Kalman filter solution to active noise control",
    Int. J. Adapt. Control Signal Process. 19, 2005; derived in `kfopc_filterpy.controllers.array_steps`.

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
        "closer to 1, or kf_anc, whose O(L^2) form does not lose its covariance so"
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
        fs: float = DEFAULT_FS,
        power_memory: float = DEFAULT_MEMORY_S,
        power_window: str = "exponential",
        secondary_path_gain: float | None = None,
        amplifier: Amplifier | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        q = as_positive(measurement_noise, "measurement_noise")
        variance = as_positive(initial_variance, "initial_variance")
        forgetting = as_positive(forgetting, "forgetting")
        if forgetting > 1.0:
            raise ValueError(f"forgetting must be 1 at most, got {forgetting:g}: 1 forgets nothing")
        constraint = constraint_or_none(
            rated_power, secondary_path_gain=secondary_path_gain, fs=fs, memory=power_memory, window=power_window
        )
        self._constrained = rated_power is not None
        if self._constrained:
            self.name = "fast-array KF-OPC"
        super().__init__(LMS, n_taps, secondary_path, lms_settings(PLAIN, 0.0), amplifier, constraint, limiter)
        taps = self._state.weights.size
        self._state = self._state._replace(
            filtered=delay_line(taps + 1), fast_array=new_fast_array(taps, variance / (q * forgetting), forgetting)
        )

    @property
    def forgetting(self) -> float:
        """Forgetting factor lambda."""
        assert self._state.fast_array is not None
        return float(self._state.fast_array.numbers[FORGETTING])

    @property
    def rated_power(self) -> float | None:
        """Rated output power; None without a constraint."""
        return self.constraint.rated_power if self._constrained else None

    def _silent_state(self) -> ControllerState:
        """While it listens only the loudspeaker is silent."""
        return self._state._replace(control_filter=np.zeros(self._state.weights.size))
