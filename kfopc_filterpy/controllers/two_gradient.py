"""Two-gradient FxLMS: it reduces the control power if the control signal exceeds an amplitude limit."""

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
