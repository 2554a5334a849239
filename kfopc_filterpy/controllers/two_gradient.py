"""Two-gradient FxLMS: it reduces the control power if the control signal exceeds an amplitude limit."""

from __future__ import annotations

from .._types import PathModels, PerLoudspeaker
from ..power.limiter import Limiters
from .core_controller import CoreController, setting


class TwoGradientFxLMS(CoreController):
    r"""Two-gradient-direction FxLMS: it reduces the error within the limit and the control power beyond it.

    .. math:: w(n+1) &= w(n) \\ &\quad + \begin{cases} \mu\, e(n)\, x'(n) & |y(n)| \le A \\
       -\mu_y\, y(n)\, x(n) & |y(n)| > A \end{cases}

    The control signal is not clipped. It settles above the limit, at the balance of the two directions, and closer to
    the limit the larger mu_y / mu is. For a tone that needs three times the limit, equal step sizes give an amplitude
    of 1.2 A. With several loudspeakers, each chooses its direction by its own control signal and limit; the direction
    within the limit is that of the multiple-error LMS (see `FxLMS`).

    Parameters
    ----------
    n_taps, secondary_path, step_size, n_references, limiter
        As for `FxLMS`.
    amplitude_limit : float or array_like, shape (J,)
        Amplitude limit A of each control signal, above zero; sqrt(2 rated_power) for a sine.
    output_step_size : float, optional
        Step size of the second direction, above zero; by default that of the first.

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
    >>> from kfopc_filterpy import TwoGradientFxLMS
    >>> controller = TwoGradientFxLMS(1, secondary_path=[1.0], step_size=0.01, amplitude_limit=1.0)
    >>> for _ in range(500):
    ...     error = 2.0 - controller.control_signal(1.0)
    ...     controller.update(error)
    >>> round(controller.control_signal(1.0), 1)
    1.0
    """

    name = "two-gradient FxLMS"
    algorithm = "two_gradient"
    step_size = setting("Step size mu.")
    amplitude_limit = setting("Amplitude limit A of the control signal; with several channels (J,), a copy.")
    output_step_size = setting("Step size of the second direction.")

    def __init__(
        self,
        n_taps: int,
        secondary_path: PathModels,
        *,
        step_size: float,
        amplitude_limit: PerLoudspeaker,
        output_step_size: float | None = None,
        n_references: int = 1,
        limiter: Limiters = None,
    ) -> None:
        settings = {
            "step_size": step_size,
            "amplitude_limit": amplitude_limit,
            "output_step_size": step_size if output_step_size is None else output_step_size,
        }
        super().__init__(n_taps, secondary_path, settings=settings, n_references=n_references, limiter=limiter)
