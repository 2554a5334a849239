"""The filtered-reference LMS without a constraint, with a fixed or a normalised step."""

from __future__ import annotations

from .._validate import as_positive
from ..plant import Secondary
from ..power.limiter import Limiters
from .core_controller import CoreController
from .making import controller_maker


@controller_maker
def fx_lms(
    n_taps: int,
    secondary: Secondary,
    *,
    step_size: float,
    n_references: int = 1,
    limiter: Limiters = None,
) -> CoreController:
    r"""Return FxLMS, filtered-reference LMS: :math:`w(n+1) = w(n) + \mu e(n) x'(n)`, without a constraint.

    With K microphones, J loudspeakers and I references it is the multiple-error LMS (MEFxLMS), which descends the
    gradient of the sum of the squared errors:

    .. math::

       w_{ji}(n+1) = w_{ji}(n) + \mu \sum_k e_k(n)\, x'_{kji}(n),

       x'_{kji} = \hat s_{kj} * x_i

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter, or of each of them.
    secondary : array_like, shape (n_taps,) or (K, J, n_taps), control system, Recording or Plant
        Estimated secondary path, or those from loudspeaker j to microphone k: taps, an FIR system, nested lists of
        systems, or those of a plant.
    step_size : float
        Step size mu, above zero. The notes have a rule of thumb.
    n_references : int, default 1
        Number of references I.
    limiter : OutputLimiter or sequence of J of them, optional
        Limiter of the control signal, or one for each loudspeaker, not shared with another controller. FxLMS adapts to
        the error alone: while the limiter acts, the error does not fall and the weights grow.

    Returns
    -------
    CoreController
        A controller named FxLMS.

    Raises
    ------
    ValueError
        A step size that is not positive and finite, fewer than one tap or reference, a path that is not FIR or has
        other axes.
    TypeError
        A limiter that is not an `OutputLimiter`, or not as many different ones as there are loudspeakers.

    Notes
    -----
    With a white reference, the step size is at most about :math:`2 / (P (L + \Delta))`: P is the mean square of x', summed
    over all its channels, and :math:`\Delta` the delay of the secondary path in samples (Elliott). In trials with up to 60
    samples of delay, FxLMS stayed stable to 0.8 times this bound behind a pure delay, and to 0.3 times behind decaying
    random taps. Noise in a low or narrow band allows less: a tone about :math:`2 \sin(\pi / (4 \Delta + 2)) / (P L)`
    (Kabal), and noise of 50 to 500 Hz at 16 kHz stayed stable to 0.3 times the bound of a tone. Start at a tenth of the
    bound that applies.

    If the secondary path has channel axes, (1, 1, taps) too, or if there are several references, all signals are
    arrays: ``control_signal`` takes (I,) and returns (J,), ``update`` takes (K,), `weights` is (J, I, L).

    References
    ----------
    D. Morgan, "An analysis of multiple correlation cancellation loops with a filter in the auxiliary path", IEEE
    Trans. ASSP 28(4), 1980. S. J. Elliott, I. M. Stothers, P. A. Nelson, "A multiple error LMS algorithm and its
    application to the active control of sound and vibration", IEEE Trans. ASSP 35(10), 1987. S. J. Elliott, "Signal
    processing for active control", 2001, chapter 3, and P. Kabal, "The stability of adaptive minimum mean square error
    equalizers using delayed adjustment", IEEE Trans. Communications 31(3), 1983, for the step size.

    Examples
    --------
    >>> from kfopc_filterpy import fx_lms
    >>> controller = fx_lms(4, [1.0], step_size=0.1)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)  # e = d: nothing is cancelled yet
    >>> float(controller.weights[0])  # 0.1 * 2 * 1
    0.2

    Two loudspeakers and one microphone, which hears the second one half as loud:

    >>> two = fx_lms(4, [[[1.0, 0.0], [0.5, 0.0]]], step_size=0.1)
    >>> two.control_signal([1.0])
    array([0., 0.])
    >>> two.update([2.0])
    >>> two.weights.shape  # loudspeakers, references, taps
    (2, 1, 4)
    >>> two.weights[:, 0, 0]  # 0.1 * 2 * 1 and 0.1 * 2 * 0.5
    array([0.2, 0.1])
    """
    return CoreController(
        "FxLMS",
        "fxlms",
        n_taps,
        secondary,
        settings={"step_size": step_size},
        n_references=n_references,
        limiter=limiter,
    )


@controller_maker
def fx_nlms(
    n_taps: int,
    secondary: Secondary,
    *,
    step_size: float,
    regularization: float | None = None,
    n_references: int = 1,
    limiter: Limiters = None,
) -> CoreController:
    r"""Return FxNLMS, normalised FxLMS: the step is divided by the energy of the filtered reference.

    .. math:: w(n+1) = w(n) + \mu \frac{e(n)\, x'(n)}{x'(n)^T x'(n)}

    One step size therefore suits soft and loud noise. In a quiet passage, the energy counts as at least a thousandth of
    the usual one; otherwise the weights would follow the noise of the microphones. The usual energy is that of the last
    thousand filter lengths. Weights that were learned from a reference 40 dB softer begin anew, as they hold little but
    that noise. With a regularization, neither holds. With several channels, the steps of all filters are divided by the
    same energy, that of all filtered references together. So their direction remains that of the multiple-error LMS:

    .. math:: w_{ji}(n+1) &= w_{ji}(n) \\ &\quad + \mu \frac{\sum_k e_k(n)\, x'_{kji}(n)}
       {\sum_{k,j,i} x'_{kji}(n)^T x'_{kji}(n)}

    Parameters
    ----------
    n_taps, secondary, n_references, limiter
        As for `fx_lms`.
    step_size : float
        Step size mu, above zero; below 2 for secondary paths without delay, and smaller for longer paths.
    regularization : float, optional
        Energy epsilon, above zero, that is added to the energy instead; in the unit of the squared filtered reference.

    Returns
    -------
    CoreController
        A controller named FxNLMS.

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
    >>> from kfopc_filterpy import fx_nlms
    >>> controller = fx_nlms(4, [1.0], step_size=0.5)
    >>> controller.control_signal(2.0)
    0.0
    >>> controller.update(4.0)
    >>> float(controller.weights[0])  # 0.5 * 4 * 2 / 2^2
    1.0
    """
    epsilon = 0.0 if regularization is None else as_positive(regularization, "regularization")
    return CoreController(
        "FxNLMS",
        "fxnlms",
        n_taps,
        secondary,
        settings={"step_size": step_size, "regularization": epsilon},
        n_references=n_references,
        limiter=limiter,
    )
