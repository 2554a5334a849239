"""Clipping FxLMS: the control signal is clipped, the adaptation is that of FxLMS."""

from __future__ import annotations

from .._types import PerLoudspeaker
from ..plant import Secondary
from ..power.limiter import Limiters
from .core_controller import CoreController
from .making import controller_maker


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
