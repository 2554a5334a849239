"""The filtered-reference LMS without a constraint."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .._validate import as_positive
from ..power.constraint import ConstraintState
from .channels import ChannelLines
from .lms import Limiters, LMSController, change_weights
from .step import Lines, adapt, advance_powers


class FxLMSState(NamedTuple):
    """State of `FxLMS`."""

    lines: Lines | ChannelLines
    weights: np.ndarray
    constraint: ConstraintState | tuple[ConstraintState, ...]
    step_size: float


@adapt.register(FxLMSState)
def adapt_fxlms(state, error, control_signal):
    """Set w(n+1) = w(n) + mu e(n) x'(n)."""
    finite, _, _ = advance_powers(state.lines, state.constraint, error)
    if finite:
        change_weights(state.lines, state.weights, 1.0, state.step_size, error, 0.0)
    return finite


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
        Limiter of the control signal, not shared with another controller. FxLMS adapts to the error alone: while the
        limiter acts, the error does not fall and the weights grow.

    Raises
    ------
    ValueError
        A step size that is not positive and finite, fewer than one tap, a path that is not FIR.

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
    >>> controller.update(2.0)  # e = d: nothing is cancelled yet
    >>> float(controller.weights[0])  # 0.1 * 2 * 1
    0.2
    """

    name = "FxLMS"

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        step_size: float,
        n_references: int = 1,
        limiter: Limiters = None,
    ) -> None:
        super().__init__(n_taps, secondary_path, n_references=n_references, limiter=limiter)
        self._state = FxLMSState(*self._common(), as_positive(step_size, "step_size"))
