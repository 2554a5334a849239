"""Re-scaling FxLMS: clips the control signal to an amplitude limit and scales the weights by the same ratio."""

from __future__ import annotations

from .._types import PerLoudspeaker
from ..plant import Secondary
from ..power.limiter import Limiters
from .core_controller import CoreController
from .making import controller_maker


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
