"""FxLMS with a normalised step."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .._validate import as_positive
from ..kernels.compiling import by_type, part
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
        change_weights(state.lines, state.weights, 1.0, state.step_size / energy, error, 0.0)
    return finite


@by_type
def filtered_energy(lines, weights):
    """Return x'(n)'x'(n), with a guard also that of x'' = W * x'."""
    row = newest(lines.filtered, weights.size)
    return dot(row, row) + guarded_energy(lines.guard, weights.size)


@part()
def guarded_energy(guard, taps):
    """Return x''(n)'x''(n), or 0 without a guard."""
    if guard is None:
        return 0.0
    row = newest(guard.filtered, taps)
    return dot(row, row)


@filtered_energy.register(ChannelLines)
def channel_energy(lines, weights):
    """Return the sum of both energies over microphones, loudspeakers and references."""
    taps = weights.shape[2]
    return energy_of_lines(lines.filtered, taps) + guarded_channel_energy(lines.guard, taps)


@part()
def guarded_channel_energy(guard, taps):
    """Return the sum of x''(n)'x''(n), or 0 without a guard."""
    return 0.0 if guard is None else energy_of_lines(guard.filtered, taps)


@part()
def energy_of_lines(lines, taps):
    """Return the energy of the newest samples of delay lines (K, J, I, size)."""
    energy = 0.0
    for k in range(lines.shape[0]):
        for j in range(lines.shape[1]):
            for i in range(lines.shape[2]):
                row = newest(lines[k, j, i], taps)
                energy += dot(row, row)
    return energy


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
