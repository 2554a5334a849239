"""Re-scaling FxLMS: clips the control signal to an amplitude limit and scales the weights by the same ratio."""

from __future__ import annotations

from .clipping import ClippingFxLMS


class RescalingFxLMS(ClippingFxLMS):
    r"""Re-scaling FxLMS: a control signal beyond the limit is clipped, and the weights are scaled by the same ratio.

    .. math:: \text{if } |w(n)^T x(n)| > A: \\ w(n) \leftarrow w(n) \frac{A}{|w(n)^T x(n)|}

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
    algorithm = "rescaling"
