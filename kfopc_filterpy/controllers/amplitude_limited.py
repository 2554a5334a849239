"""FxLMS within an amplitude limit: with two gradients, with weights that are scaled, or clipped."""

from __future__ import annotations

from .._types import PerLoudspeaker
from ..plant import Secondary
from ..power.limiter import Limiters
from .core_controller import CoreController
from .making import controller_maker


@controller_maker
def two_gradient_fx_lms(
    n_taps: int,
    secondary: Secondary,
    *,
    step_size: float,
    amplitude_limit: PerLoudspeaker,
    output_step_size: float | None = None,
    n_references: int = 1,
    limiter: Limiters = None,
) -> CoreController:
    r"""Return two-gradient-direction FxLMS, which reduces the error within the limit and the control power beyond it.

    .. math:: w(n+1) &= w(n) \\ &\quad + \begin{cases} \mu\, e(n)\, x'(n) & |y(n)| \le A \\
       -\mu_y\, y(n)\, x(n) & |y(n)| > A \end{cases}

    The control signal is not clipped. It settles above the limit, at the balance of the two directions, and closer to
    the limit the larger mu_y / mu is. For a tone that needs three times the limit, equal step sizes give an amplitude
    of 1.2 A. With several loudspeakers, each chooses its direction by its own control signal and limit; the direction
    within the limit is that of the multiple-error LMS (see `fx_lms`).

    Parameters
    ----------
    n_taps, secondary, step_size, n_references, limiter
        As for `fx_lms`.
    amplitude_limit : float or array_like, shape (J,)
        Amplitude limit A of each control signal, above zero; sqrt(2 rated_power) for a sine.
    output_step_size : float, optional
        Step size of the second direction, above zero; by default that of the first.

    Returns
    -------
    CoreController
        A controller named two-gradient FxLMS.

    Raises
    ------
    ValueError
        A step size or limit that is not positive and finite, fewer than one tap, a path that is not FIR.

    References
    ----------
    D. Shi, W.-S. Gan, B. Lam, C. Shi, "Two-gradient direction FXLMS: an adaptive active noise control algorithm with
    output constraint", Mechanical Systems and Signal Processing 116, 2019. The text was not available; the equations
    are those given for it in later papers.

    Examples
    --------
    >>> from kfopc_filterpy import two_gradient_fx_lms
    >>> controller = two_gradient_fx_lms(1, [1.0], step_size=0.01, amplitude_limit=1.0)
    >>> for _ in range(500):
    ...     error = 2.0 - controller.control_signal(1.0)
    ...     controller.update(error)
    >>> round(controller.control_signal(1.0), 1)
    1.0
    """
    second = step_size if output_step_size is None else output_step_size
    return CoreController(
        "two-gradient FxLMS",
        "two_gradient",
        n_taps,
        secondary,
        settings={"step_size": step_size, "amplitude_limit": amplitude_limit, "output_step_size": second},
        n_references=n_references,
        limiter=limiter,
    )


@controller_maker
def rescaling_fx_lms(
    n_taps: int,
    secondary: Secondary,
    *,
    step_size: float,
    amplitude_limit: PerLoudspeaker,
    n_references: int = 1,
    limiter: Limiters = None,
) -> CoreController:
    r"""Return re-scaling FxLMS: a control signal beyond the limit is clipped, and the weights are scaled likewise.

    .. math:: \text{if } |w(n)^T x(n)| > A: \\ w(n) \leftarrow w(n) \frac{A}{|w(n)^T x(n)|}

    The step of `fx_lms` follows. Between two such samples the filter is linear. With several loudspeakers, each has its
    own limit, and only the control filters of a loudspeaker beyond it are scaled.

    Parameters
    ----------
    n_taps, secondary, step_size, n_references, limiter
        As for `fx_lms`.
    amplitude_limit : float or array_like, shape (J,)
        Amplitude limit A of each control signal, above zero; sqrt(2 rated_power) for a sine.

    Returns
    -------
    CoreController
        A controller named re-scaling FxLMS.

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
    >>> from kfopc_filterpy import rescaling_fx_lms
    >>> controller = rescaling_fx_lms(1, [1.0], step_size=1.0, amplitude_limit=1.5)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)  # w = 2
    >>> controller.control_signal(1.0), float(controller.weights[0])
    (1.5, 1.5)
    """
    return CoreController(
        "re-scaling FxLMS",
        "rescaling",
        n_taps,
        secondary,
        settings={"step_size": step_size, "amplitude_limit": amplitude_limit},
        n_references=n_references,
        limiter=limiter,
    )


@controller_maker
def clipping_fx_lms(
    n_taps: int,
    secondary: Secondary,
    *,
    step_size: float,
    amplitude_limit: PerLoudspeaker,
    n_references: int = 1,
    limiter: Limiters = None,
) -> CoreController:
    r"""Return clipping FxLMS: the control signal is clipped to the limit, the weights adapt as in `fx_lms`.

    With several loudspeakers, each control signal is clipped to its own limit.

    While the noise needs more than the limit, the error no longer falls, the weights keep growing and the control
    signal becomes a square wave. The paper's introduction warns of this; the algorithm is here for comparison.

    Parameters
    ----------
    n_taps, secondary, step_size, n_references, limiter
        As for `fx_lms`.
    amplitude_limit : float or array_like, shape (J,)
        Amplitude limit A of each control signal, above zero; sqrt(2 rated_power) for a sine.

    Returns
    -------
    CoreController
        A controller named clipping FxLMS.

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
    >>> from kfopc_filterpy import clipping_fx_lms
    >>> controller = clipping_fx_lms(1, [1.0], step_size=1.0, amplitude_limit=1.5)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)
    >>> controller.control_signal(1.0), float(controller.weights[0])
    (1.5, 2.0)
    """
    return CoreController(
        "clipping FxLMS",
        "clipping",
        n_taps,
        secondary,
        settings={"step_size": step_size, "amplitude_limit": amplitude_limit},
        n_references=n_references,
        limiter=limiter,
    )
