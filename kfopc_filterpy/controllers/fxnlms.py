"""FxLMS with a normalised step."""

from __future__ import annotations

from typing import ClassVar

from .._types import PathModels
from .._validate import as_nonnegative, as_positive
from ..power.limiter import Limiters
from .core_controller import CoreController, setting


class FxNLMS(CoreController):
    r"""Normalised FxLMS: the step is divided by the energy of the filtered reference, without a constraint.

    .. math:: w(n+1) = w(n) + \mu \frac{e(n)\, x'(n)}{x'(n)^T x'(n)}

    One step size therefore suits soft and loud noise. In a quiet passage, the energy counts as at least a thousandth of
    the usual one; otherwise the weights would follow the noise of the microphones. The usual energy is that of the last
    thousand filter lengths. With several channels, the steps of all filters are divided by the same energy, that of all
    filtered references together. So their direction remains that of the multiple-error LMS:

    .. math:: w_{ji}(n+1) &= w_{ji}(n) \\ &\quad + \mu \frac{\sum_k e_k(n)\, x'_{kji}(n)}
       {\sum_{k,j,i} x'_{kji}(n)^T x'_{kji}(n)}

    Parameters
    ----------
    n_taps, secondary_path, n_references, limiter
        As for `FxLMS`.
    step_size : float
        Step size mu, above zero; below 2 for secondary paths without delay, and smaller for longer paths.
    regularization : float, optional
        Energy epsilon, above zero, that is added to the energy instead; in the unit of the squared filtered reference.

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
    >>> from kfopc_filterpy import FxNLMS
    >>> controller = FxNLMS(4, secondary_path=[1.0], step_size=0.5)
    >>> controller.control_signal(2.0)
    0.0
    >>> controller.update(4.0)
    >>> float(controller.weights[0])  # 0.5 * 4 * 2 / 2^2
    1.0
    """

    name = "FxNLMS"
    algorithm = "fxnlms"
    checks: ClassVar = {"regularization": as_nonnegative}
    step_size = setting("Step size mu.")

    def __init__(
        self,
        n_taps: int,
        secondary_path: PathModels,
        *,
        step_size: float,
        regularization: float | None = None,
        n_references: int = 1,
        limiter: Limiters = None,
    ) -> None:
        epsilon = 0.0 if regularization is None else as_positive(regularization, "regularization")
        settings = {"step_size": step_size, "regularization": epsilon}
        super().__init__(n_taps, secondary_path, settings=settings, n_references=n_references, limiter=limiter)

    @property
    def regularization(self) -> float | None:
        """Regularization epsilon, or None."""
        return self._of_setting("regularization") or None
