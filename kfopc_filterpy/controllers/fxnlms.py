"""FxLMS with a normalised step."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .._validate import as_positive
from ..kernels.compiling import by_type
from ..kernels.delay_lines import newest
from ..kernels.vectors import dot
from ..power.constraint import ConstraintState
from .channels import ChannelLines
from .lms import Limiters, LMSController, change_weights
from .step import Lines, adapt, advance_powers


class FxNLMSState(NamedTuple):
    """State of `FxNLMS`."""

    lines: Lines | ChannelLines
    weights: np.ndarray
    constraint: ConstraintState | tuple[ConstraintState, ...]
    step_size: float
    regularization: float


@adapt.register(FxNLMSState)
def adapt_fxnlms(state, error, control_signal):
    """Set w(n+1) = w(n) + mu e(n) x'(n) / (epsilon + x'(n)'x'(n)); several channels: see `FxNLMS` for the sums."""
    finite, _, _ = advance_powers(state.lines, state.constraint, error)
    if finite:
        energy = state.regularization + filtered_energy(state.lines, state.weights)
        change_weights(
            state.lines, state.weights, 1.0, 1.0, step_error(state.lines, error, state.step_size, energy), 0.0
        )
    return finite


@by_type
def filtered_energy(lines, weights):
    """Return x'(n)'x'(n)."""
    row = newest(lines.filtered, weights.size)
    return dot(row, row)


@filtered_energy.register(ChannelLines)
def channel_energy(lines, weights):
    """Return the sum of x'(n)'x'(n) over microphones, loudspeakers and references."""
    energy, filtered = 0.0, lines.filtered
    for k in range(filtered.shape[0]):
        for j in range(filtered.shape[1]):
            for i in range(filtered.shape[2]):
                row = newest(filtered[k, j, i], weights.shape[2])
                energy += dot(row, row)
    return energy


@by_type
def step_error(lines, error, step_size, energy):
    """Return mu e(n) / energy."""
    return step_size * error / energy


@step_error.register(ChannelLines)
def channel_step_errors(lines, error, step_size, energy):
    """Return mu e_k(n) / energy for each microphone, (K,)."""
    for k in range(error.size):
        lines.modified_error[k] = step_size * error[k] / energy
    return lines.modified_error


class FxNLMS(LMSController):
    r"""Normalised FxLMS: the step is divided by the energy of the filtered reference, without a constraint.

    .. math:: w(n+1) = w(n) + \mu \frac{e(n)\, x'(n)}{\epsilon + x'(n)^T x'(n)}

    One step size therefore suits soft and loud noise. With several channels, the steps of all filters are divided by
    the same energy, that of all filtered references together. So their direction remains that of the multiple-error
    LMS:

    .. math:: w_{ji}(n+1) = w_{ji}(n) + \mu \frac{\sum_k e_k(n)\, x'_{kji}(n)}
       {\epsilon + \sum_{k,j,i} x'_{kji}(n)^T x'_{kji}(n)}

    Parameters
    ----------
    n_taps, secondary_path, n_references, limiter
        As for `FxLMS`.
    step_size : float
        Step size mu, above zero; below 2 for secondary paths without delay, and smaller for longer paths.
    regularization : float, default 1e-10
        Energy epsilon, above zero, that keeps the quotient finite while the reference is silent.

    Raises
    ------
    ValueError
        A step size or regularization that is not positive and finite, fewer than one tap, a path that is not FIR.

    References
    ----------
    S. M. Kuo, D. R. Morgan, "Active noise control: a tutorial review", Proc. IEEE 87(6), 1999. For several channels,
    S. J. Elliott, Signal Processing for Active Control, Academic Press 2001, ch. 5. The energy of all channels is the
    trace of the matrix whose largest eigenvalue limits the step size there.

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
        n_references: int = 1,
        limiter: Limiters = None,
    ) -> None:
        super().__init__(n_taps, secondary_path, n_references=n_references, limiter=limiter)
        step, epsilon = as_positive(step_size, "step_size"), as_positive(regularization, "regularization")
        self._state = FxNLMSState(*self._common(), step, epsilon)

    @property
    def regularization(self) -> float:
        """Regularization epsilon."""
        return self._state.regularization

    def _takes_guard(self) -> bool:
        return False  # its step is scaled with the energy of x' alone
