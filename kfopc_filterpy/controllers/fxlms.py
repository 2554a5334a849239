"""The filtered-reference LMS without a constraint: FxLMS, and FxNLMS with a normalised step."""

from __future__ import annotations

from typing import Any

from .._validate import as_positive
from ..loop.run import LMS
from ..power.amplifiers import Amplifier
from ..power.constraint import OutputPowerConstraint
from ..power.limiter import OutputLimiter
from .base import FilteredReferenceController
from .lms_rules import FACTOR, LIMIT, NORMALISED, PLAIN, STEP_SIZE, further_rules, lms_settings


class LMSController(FilteredReferenceController):
    """What the controllers of the LMS family share: the settings of their rule in `lms_rules`."""

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        settings: list[float],
        amplifier: Amplifier | None = None,
        constraint: OutputPowerConstraint | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        super().__init__(LMS, n_taps, secondary_path, settings, amplifier, constraint, limiter)
        self._state = self._state._replace(rules=further_rules(self._state.settings))

    @property
    def step_size(self) -> float:
        """Step size mu."""
        return float(self._state.settings[STEP_SIZE])

    @property
    def _factor(self) -> float:
        return float(self._state.settings[FACTOR])

    @property
    def _limit(self) -> float:
        return float(self._state.settings[LIMIT])


class FxLMS(LMSController):
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
        settings = lms_settings(PLAIN, as_positive(step_size, "step_size"))
        super().__init__(n_taps, secondary_path, settings, limiter=limiter)


class FxNLMS(LMSController):
    r"""Normalised FxLMS: the step is measured by the energy of the filtered reference, without a constraint.

    .. math:: w(n+1) = w(n) + \mu \frac{e(n)\, x'(n)}{\epsilon + x'(n)^T x'(n)}

    so that one step size serves soft and loud noise.

    Parameters
    ----------
    n_taps, secondary_path, limiter
        As for `FxLMS`.
    step_size : float
        Step size mu, above zero; below 2 for a secondary path of no delay, and the less the longer the path.
    regularization : float, default 1e-10
        Energy epsilon that keeps the quotient finite while the reference is silent, above zero.

    Raises
    ------
    ValueError
        A step size or regularization that is not positive and finite, fewer than one tap, a path that is no FIR path.

    References
    ----------
    S. M. Kuo, D. R. Morgan, "Active noise control: a tutorial review", Proc. IEEE 87(6), 1999.

    Examples
    --------
    >>> from kfopc_filterpy import FxNLMS
    >>> controller = FxNLMS(4, secondary_path=[1.0], step_size=0.5)
    >>> controller.control_signal(2.0)
    0.0
    >>> controller.update(4.0)
    >>> round(float(controller.weights[0]), 9)  # 0.5 * 4 * 2 / 2^2
    1.0
    """

    name = "FxNLMS"

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        step_size: float,
        regularization: float = 1e-10,
        limiter: OutputLimiter | None = None,
    ) -> None:
        epsilon = as_positive(regularization, "regularization")
        settings = lms_settings(NORMALISED, as_positive(step_size, "step_size"), factor=epsilon)
        super().__init__(n_taps, secondary_path, settings, limiter=limiter)

    @property
    def regularization(self) -> float:
        """Regularization epsilon."""
        return self._factor
