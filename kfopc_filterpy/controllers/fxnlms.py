"""FxLMS with a normalised step."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .._validate import as_positive
from ..kernels.delay_lines import newest
from ..kernels.vectors import dot
from ..power.constraint import ConstraintState
from ..power.limiter import OutputLimiter
from .lms import LMSController, change_weights
from .step import Lines, adapt, advance_powers


class FxNLMSState(NamedTuple):
    """State of `FxNLMS`."""

    lines: Lines
    weights: np.ndarray
    constraint: ConstraintState
    step_size: float
    regularization: float


@adapt.register(FxNLMSState)
def adapt_fxnlms(state, error, control_signal):
    """Set w(n+1) = w(n) + mu e(n) x'(n) / (epsilon + x'(n)'x'(n))."""
    finite, _, _ = advance_powers(state.lines, state.constraint, error)
    if finite:
        row = newest(state.lines.filtered, state.weights.size)
        energy = state.regularization + dot(row, row)
        change_weights(state.lines, state.weights, 1.0, 1.0, state.step_size * error / energy, 0.0)
    return finite


class FxNLMS(LMSController):
    r"""Normalised FxLMS: the step is divided by the energy of the filtered reference, without a constraint.

    .. math:: w(n+1) = w(n) + \mu \frac{e(n)\, x'(n)}{\epsilon + x'(n)^T x'(n)}

    One step size therefore suits soft and loud noise.

    Parameters
    ----------
    n_taps, secondary_path, limiter
        As for `FxLMS`.
    step_size : float
        Step size mu, above zero; below 2 for a secondary path without delay, and smaller for a longer path.
    regularization : float, default 1e-10
        Energy epsilon, above zero, that keeps the quotient finite while the reference is silent.

    Raises
    ------
    ValueError
        A step size or regularization that is not positive and finite, fewer than one tap, a path that is not FIR.

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
        super().__init__(n_taps, secondary_path, limiter=limiter)
        step, epsilon = as_positive(step_size, "step_size"), as_positive(regularization, "regularization")
        self._state = FxNLMSState(*self._common(), step, epsilon)

    @property
    def regularization(self) -> float:
        """Regularization epsilon."""
        return self._state.regularization
