"""Re-scaling FxLMS: clips the control signal to an amplitude limit and scales the weights by the same ratio."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_positive
from ..kernels.vectors import at
from ..power.constraint import ConstraintState
from .channels import ChannelLines
from .fxlms import adapt_fxlms
from .lms import Limiters, LMSController
from .step import Lines, adapt, filter_output, output, weights_of


class RescalingState(NamedTuple):
    """State of `RescalingFxLMS`."""

    lines: Lines | ChannelLines
    weights: np.ndarray
    constraint: ConstraintState | tuple[ConstraintState, ...]
    step_size: float
    amplitude_limit: float | np.ndarray  # (J,)


@output.register(RescalingState)
def output_rescaled(state, j):
    """Return w'x clipped to the limit, and scale the weights likewise; pass Inf and NaN, which the loop detects."""
    y, limit = filter_output(state.lines, state.weights, j), at(state.amplitude_limit, j)
    if not limit < abs(y) < np.inf:
        return y
    ratio, w = limit / abs(y), weights_of(state.lines, state.weights, j)
    for i in range(w.size):
        w[i] *= ratio
    return limit if y > 0.0 else -limit


adapt.register(RescalingState)(adapt_fxlms)


class RescalingFxLMS(LMSController):
    r"""Re-scaling FxLMS: a control signal beyond the limit is clipped, and the weights are scaled by the same ratio.

    .. math:: \text{if } |w(n)^T x(n)| > A: \quad w(n) \leftarrow w(n) \frac{A}{|w(n)^T x(n)|}

    The step of `FxLMS` follows. Between two such samples the filter is linear. With several loudspeakers, each has its
    own limit, and only the control filters of a loudspeaker beyond it are scaled.

    Parameters
    ----------
    n_taps, secondary_path, step_size, n_references, limiter
        As for `FxLMS`.
    amplitude_limit : float or array_like, shape (J,)
        Amplitude limit A of each control signal, above zero; sqrt(2 rated_power) for a sine.

    Raises
    ------
    ValueError
        A step size or limit that is not positive and finite, fewer than one tap, a path that is not FIR.

    References
    ----------
    X. Qiu, C. H. Hansen, "A study of time-domain FXLMS algorithms with control output constraint", JASA 109(6), 2001.
    The text was not available; the equations are those given for it in later papers.

    Examples
    --------
    >>> from kfopc_filterpy import RescalingFxLMS
    >>> controller = RescalingFxLMS(1, secondary_path=[1.0], step_size=1.0, amplitude_limit=1.5)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)  # w = 2
    >>> controller.control_signal(1.0), float(controller.weights[0])
    (1.5, 1.5)
    """

    name = "re-scaling FxLMS"

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        step_size: float,
        amplitude_limit: float | Sequence[float] | np.ndarray,
        n_references: int = 1,
        limiter: Limiters = None,
    ) -> None:
        super().__init__(n_taps, secondary_path, n_references=n_references, limiter=limiter)
        step, limit = as_positive(step_size, "step_size"), self._each_loudspeaker(amplitude_limit, "amplitude_limit")
        self._state = RescalingState(*self._common(), step, limit)

    @property
    def amplitude_limit(self) -> Any:
        """Amplitude limit A of the control signal; with several channels (J,), a copy."""
        return copy(self._state.amplitude_limit)
