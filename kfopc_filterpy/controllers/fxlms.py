"""The filtered-reference LMS family: FxLMS and MOV-FxLMS."""

from __future__ import annotations

from typing import Any

from .._validate import as_positive
from ..amplifiers import Amplifier
from ..constraint import DEFAULT_FS, DEFAULT_MEMORY_S, OutputPowerConstraint
from ..limiter import OutputLimiter
from ..loop import LMS
from .base import FilteredReferenceController


class FxLMS(FilteredReferenceController):
    r"""Filtered-reference LMS, :math:`w(n+1) = w(n) + \mu e(n) x'(n)`, without a constraint.

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter.
    secondary_path : array_like or control.TransferFunction
        Estimated secondary path, taps or an FIR system.
    step_size : float
        Step size mu, above zero.
    limiter : OutputLimiter, optional
        Limiter of its own that the control signal goes through. FxLMS adapts to the error alone: while the limiter acts
        the error does not fall and the weights grow.

    Raises
    ------
    ValueError
        A step size that is not positive and finite, fewer than one tap, a path that is no FIR path.

    References
    ----------
    D. Morgan, "An analysis of multiple correlation cancellation loops with a filter in the auxiliary path", IEEE
    Trans. ASSP 28(4), 1980.

    Examples
    --------
    >>> from kfopc_filterpy import FxLMS
    >>> controller = FxLMS(4, secondary_path=[1.0], step_size=0.1)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)  # e = d, nothing was cancelled yet
    >>> float(controller.weights[0])  # 0.1 * 2 * 1
    0.2
    """

    name = "FxLMS"

    def __init__(
        self, n_taps: int, secondary_path: Any, *, step_size: float, limiter: OutputLimiter | None = None
    ) -> None:
        super().__init__(LMS, n_taps, secondary_path, [as_positive(step_size, "step_size")], limiter=limiter)

    @property
    def step_size(self) -> float:
        """Step size mu."""
        return float(self._state.settings[0])


class MOVFxLMS(FilteredReferenceController):
    r"""Minimum-output-variance FxLMS: the leak of FxLMS that keeps the control signal to its rated power.

    .. math:: w(n+1) = w(n) + \mu [e(n) x'(n) - \gamma y(n) x(n)], \qquad
       \gamma = \max\{G_s (\sqrt{\delta_d^2 / (\rho_o G_s)} - 1), 0\}

    so that :math:`G_s / (G_s + \gamma)` is the constraint factor of eq. 13 for a flat path. The powers are estimated
    as KF-OPC's are.

    Parameters
    ----------
    n_taps, secondary_path, step_size
        As for `FxLMS`.
    rated_power : float
        Rated output power rho_o.
    fs, power_memory, power_window, secondary_path_gain
        As `fs`, `memory`, `window`, `secondary_path_gain` of `OutputPowerConstraint`.
    amplifier : callable, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.
    limiter : OutputLimiter, optional
        As for `FxLMS`.

    Raises
    ------
    ValueError
        A step size, rated power, rate, memory or gain that is not positive and finite, another window, fewer than
        one tap, a path that is no FIR path.
    TypeError
        An amplifier that is none of the amplifier models.

    References
    ----------
    D. Shi, W.-S. Gan, B. Lam, S. Wen, X. Shen, "Optimal output-constrained active noise control based on inverse
    adaptive modeling leak factor estimate", IEEE/ACM TASLP 29, 2021.

    Examples
    --------
    >>> from kfopc_filterpy import MOVFxLMS
    >>> controller = MOVFxLMS(4, secondary_path=[1.0], step_size=0.1, rated_power=0.5)
    >>> controller.rated_power
    0.5
    """

    name = "MOV-FxLMS"

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        step_size: float,
        rated_power: float,
        fs: float = DEFAULT_FS,
        power_memory: float = DEFAULT_MEMORY_S,
        power_window: str = "exponential",
        secondary_path_gain: float | None = None,
        amplifier: Amplifier | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        constraint = OutputPowerConstraint(
            rated_power,
            secondary_path_gain=secondary_path_gain,
            fs=fs,
            memory=power_memory,
            window=power_window,
        )
        super().__init__(
            LMS, n_taps, secondary_path, [as_positive(step_size, "step_size")], amplifier, constraint, limiter
        )

    @property
    def step_size(self) -> float:
        """Step size mu."""
        return float(self._state.settings[0])

    @property
    def rated_power(self) -> float:
        """Rated output power."""
        return self.constraint.rated_power
