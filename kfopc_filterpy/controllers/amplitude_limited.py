"""FxLMS with a limit on the amplitude of the control signal: two gradients, re-scaling, clipping.

They keep a peak, not a power. A sine at the rated power peaks at sqrt(2 rated_power); noise at that amplitude limit
has a lower mean power while it is rarely held. Where it is held, never more than twice the rated one.
"""

from __future__ import annotations

from typing import Any

from .._validate import as_positive
from ..power.limiter import OutputLimiter
from .fxlms import LMSController
from .lms_rules import CLIPPING, FACTOR, RESCALING, TWO_GRADIENT, lms_settings


class _AmplitudeLimited(LMSController):
    """What the three share."""

    _rule: int

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        step_size: float,
        amplitude_limit: float,
        limiter: OutputLimiter | None = None,
    ) -> None:
        step_size = as_positive(step_size, "step_size")
        limit = as_positive(amplitude_limit, "amplitude_limit")
        settings = lms_settings(self._rule, step_size, limit=limit)
        super().__init__(n_taps, secondary_path, settings, limiter=limiter)

    @property
    def amplitude_limit(self) -> float:
        """Amplitude limit A of the control signal."""
        return self._limit


class TwoGradientFxLMS(_AmplitudeLimited):
    r"""Two-gradient-direction FxLMS: down the error within the limit, down the control power beyond it.

    .. math:: w(n+1) = w(n) + \begin{cases} \mu\, e(n)\, x'(n) & |y(n)| \le A \\
       -\mu_y\, y(n)\, x(n) & |y(n)| > A \end{cases}

    The control signal is not held: it settles where the two balance, above the limit, and the closer to it the larger
    mu_y is against mu. For a tone that the limit holds to a third, equal step sizes leave an amplitude of 1.2 A.

    Parameters
    ----------
    n_taps, secondary_path, step_size, limiter
        As for `FxLMS`.
    amplitude_limit : float
        Amplitude limit A, above zero; sqrt(2 rated_power) for a sine.
    output_step_size : float, optional
        Step size of the second direction, above zero; by default that of the first.

    Raises
    ------
    ValueError
        A step size or limit that is not positive and finite, fewer than one tap, a path that is no FIR path.

    References
    ----------
    D. Shi, W.-S. Gan, B. Lam, C. Shi, "Two-gradient direction FXLMS: an adaptive active noise control algorithm with
    output constraint", Mechanical Systems and Signal Processing 116, 2019: the text was not at hand, the equations are
    those by which later papers describe it.

    Examples
    --------
    >>> from kfopc_filterpy import TwoGradientFxLMS
    >>> controller = TwoGradientFxLMS(1, secondary_path=[1.0], step_size=0.01, amplitude_limit=1.0)
    >>> for _ in range(500):
    ...     error = 2.0 - controller.control_signal(1.0)
    ...     controller.update(error)
    >>> round(controller.control_signal(1.0), 1)
    1.0
    """

    name = "two-gradient FxLMS"
    _rule = TWO_GRADIENT

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        step_size: float,
        amplitude_limit: float,
        output_step_size: float | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        second = step_size if output_step_size is None else as_positive(output_step_size, "output_step_size")
        super().__init__(
            n_taps,
            secondary_path,
            step_size=step_size,
            amplitude_limit=amplitude_limit,
            limiter=limiter,
        )
        self._state.settings[FACTOR] = second

    @property
    def output_step_size(self) -> float:
        """Step size of the second direction."""
        return self._factor


class RescalingFxLMS(_AmplitudeLimited):
    r"""Re-scaling FxLMS: a control signal beyond the limit is held to it, and the weights are scaled along.

    .. math:: \text{where } |w(n)^T x(n)| > A: \quad w(n) \leftarrow w(n) \frac{A}{|w(n)^T x(n)|}

    then the step of `FxLMS`. The filter stays linear between two such samples.

    Parameters
    ----------
    n_taps, secondary_path, step_size, limiter
        As for `FxLMS`.
    amplitude_limit : float
        Amplitude limit A, above zero; sqrt(2 rated_power) for a sine.

    Raises
    ------
    ValueError
        A step size or limit that is not positive and finite, fewer than one tap, a path that is no FIR path.

    References
    ----------
    X. Qiu, C. H. Hansen, "A study of time-domain FXLMS algorithms with control output constraint", JASA 109(6), 2001:
    the text was not at hand, the equations are those by which later papers describe it.

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
    _rule = RESCALING


class ClippingFxLMS(_AmplitudeLimited):
    r"""Clipping FxLMS: the control signal is held to the limit, the weights go on as in `FxLMS`.

    The error then no longer falls with the weights, which keep growing while the noise asks for more than the limit:
    the control signal turns into a square wave. What the paper's introduction warns of; here to compare with.

    Parameters
    ----------
    n_taps, secondary_path, step_size, limiter
        As for `FxLMS`.
    amplitude_limit : float
        Amplitude limit A, above zero; sqrt(2 rated_power) for a sine.

    Raises
    ------
    ValueError
        A step size or limit that is not positive and finite, fewer than one tap, a path that is no FIR path.

    References
    ----------
    X. Qiu, C. H. Hansen, "A study of time-domain FXLMS algorithms with control output constraint", JASA 109(6), 2001:
    the text was not at hand, the equations are those by which later papers describe it.

    Examples
    --------
    >>> from kfopc_filterpy import ClippingFxLMS
    >>> controller = ClippingFxLMS(1, secondary_path=[1.0], step_size=1.0, amplitude_limit=1.5)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)
    >>> controller.control_signal(1.0), float(controller.weights[0])
    (1.5, 2.0)
    """

    name = "clipping FxLMS"
    _rule = CLIPPING
