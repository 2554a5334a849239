"""Clipping FxLMS: the control signal is clipped, the adaptation is that of FxLMS."""

from __future__ import annotations

from .._types import PathModels, PerLoudspeaker
from ..power.limiter import Limiters
from .core_controller import CoreController, setting


class ClippingFxLMS(CoreController):
    r"""Clipping FxLMS: the control signal is clipped to the limit, the weights adapt as in `FxLMS`.

    With several loudspeakers, each control signal is clipped to its own limit.

    While the noise needs more than the limit, the error no longer falls, the weights keep growing and the control
    signal becomes a square wave. The paper's introduction warns of this; the algorithm is here for comparison.

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
    >>> from kfopc_filterpy import ClippingFxLMS
    >>> controller = ClippingFxLMS(1, secondary_path=[1.0], step_size=1.0, amplitude_limit=1.5)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)
    >>> controller.control_signal(1.0), float(controller.weights[0])
    (1.5, 2.0)
    """

    name = "clipping FxLMS"
    algorithm = "clipping"
    step_size = setting("Step size mu.")
    amplitude_limit = setting("Amplitude limit A of the control signal; with several channels (J,), a copy.")

    def __init__(
        self,
        n_taps: int,
        secondary_path: PathModels,
        *,
        step_size: float,
        amplitude_limit: PerLoudspeaker,
        n_references: int = 1,
        limiter: Limiters = None,
    ) -> None:
        settings = {"step_size": step_size, "amplitude_limit": amplitude_limit}
        super().__init__(n_taps, secondary_path, settings=settings, n_references=n_references, limiter=limiter)
