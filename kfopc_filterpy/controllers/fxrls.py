"""Filtered-reference RLS: least squares with exponential forgetting, which is a Kalman filter with fading memory."""

from __future__ import annotations

from .._validate import as_positive
from ..plant import Secondary
from ..power.amplifiers import Amplifier
from ..power.limiter import OutputLimiter
from .base import as_forgetting
from .kalman import KalmanInCore, kalman_settings
from .making import controller_maker


@controller_maker
def fx_rls(
    n_taps: int,
    secondary: Secondary,
    *,
    forgetting: float = 0.9999,
    initial_variance: float = 1.0,
    amplifier: Amplifier | None = None,
    limiter: OutputLimiter | None = None,
) -> KalmanInCore:
    r"""Return FxRLS, which minimises :math:`\sum_k \lambda^{n-k} (\hat d(k) - w^T x'(k))^2` without a constraint.

    .. math::

       K = \frac{P x'}{\lambda + x'^T P x'},

       w \leftarrow w + K (\hat d - x'^T w),

       P \leftarrow (P - K x'^T P) / \lambda

    P starts at `initial_variance` I. This is the Kalman filter with r = 0, q = 1 and filterpy's fading memory
    :math:`\alpha^2 = 1/\lambda`, and is computed as such.

    Parameters
    ----------
    n_taps, secondary, amplifier, limiter
        As for `kf_anc`.
    forgetting : float, default 0.9999
        Forgetting factor lambda, above 0 and at most 1; the memory is about 1/(1 - lambda) samples.
    initial_variance : float, default 1
        Initial P over the variance of the measurement noise, in the unit of w^2/d^2; large for a fast start.

    Returns
    -------
    CoreController
        A controller named FxRLS.

    Raises
    ------
    ValueError
        A forgetting factor outside (0, 1], secondary paths of several channels, or arguments that `kf_anc` refuses. In
        a run: a P that is too large.

    Notes
    -----
    Band-limited noise and tones do not excite all directions of the control filter, and silence excites none. In the
    others P grows by 1/lambda per sample, up to 10^4 times the usual variance along :math:`x'`. From then on, state
    noise of the same size along :math:`x'` takes the place of forgetting: the filter follows changes, and P stays
    bounded. Before the first sound, P grows up to 10^6 times `initial_variance`. A reference :math:`x'` whose energy
    over the taps is below 10^-10 / `initial_variance` counts as silence.

    References
    ----------
    S. M. Kuo, D. R. Morgan, Active Noise Control Systems, Wiley 1996, sec. 5.5 (RLS in place of LMS); S. Haykin,
    Adaptive Filter Theory, 4th ed., table 9.1.

    Examples
    --------
    >>> from kfopc_filterpy import fx_rls
    >>> controller = fx_rls(1, [1.0], forgetting=0.5)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(3.0)
    >>> round(float(controller.weights[0]), 6)  # K = 1 / (0.5 + 1)
    2.0
    """
    return KalmanInCore(
        "FxRLS",
        "kalman",
        n_taps,
        secondary,
        settings=kalman_settings(
            state_noise=0.0,
            measurement_noise=1.0,
            initial_variance=as_positive(initial_variance, "initial_variance"),
            fading=1.0 / as_forgetting(forgetting),
        ),
        n_references=None,  # with several channels every microphone would need a covariance of its own
        amplifier=amplifier,
        limiter=limiter,
    )
