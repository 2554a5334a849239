"""Leaky FxLMS: FxLMS with a penalty on the weights, fixed or adapted to a rated power."""

from __future__ import annotations

import numpy as np

from .._types import PerLoudspeaker
from ..plant import Secondary
from ..power.amplifiers import Amplifiers
from ..power.constraint import Constraints
from ..power.limiter import Limiters
from .core_controller import CoreController
from .making import controller_maker, require_rated_power


@controller_maker
def leaky_fx_lms(
    n_taps: int,
    secondary: Secondary,
    *,
    step_size: float,
    leak: PerLoudspeaker,
    n_references: int = 1,
    limiter: Limiters = None,
) -> CoreController:
    r"""Return leaky FxLMS, :math:`w(n+1) = (1 - \mu\gamma) w(n) + \mu e(n) x'(n)`, with a fixed leak.

    The weights settle at about :math:`(R_{x'} + \gamma I) w = r`, which minimises :math:`E[e^2] + \gamma w^T w`. With
    several channels this is :math:`\sum_k E[e_k^2] + \sum_j \gamma_j \sum_i w_{ji}^T w_{ji}`, and a leak also keeps
    the weights finite where loudspeakers are interchangeable.

    Parameters
    ----------
    n_taps, secondary, step_size, n_references, limiter
        As for `fx_lms`.
    leak : float or array_like, shape (J,)
        Leak gamma, or that of each loudspeaker, zero or above, in the unit of the squared reference.

    Returns
    -------
    CoreController
        A controller named leaky FxLMS.

    Raises
    ------
    ValueError
        A step size that is not positive and finite, a leak that is negative or not finite, a product of both above 1,
        fewer than one tap, a path that is not FIR.

    References
    ----------
    O. J. Tobias, R. Seara, "Leaky-FXLMS algorithm: stochastic analysis for Gaussian data and secondary path modeling
    error", IEEE Trans. Speech and Audio Processing 13(6), 2005.

    Examples
    --------
    >>> from kfopc_filterpy import leaky_fx_lms
    >>> controller = leaky_fx_lms(1, [1.0], step_size=0.1, leak=1.0)
    >>> for _ in range(200):
    ...     error = 2.0 - controller.control_signal(1.0)
    ...     controller.update(error)
    >>> round(float(controller.weights[0]), 6)  # (1 + leak) w = 2
    1.0
    """
    controller = CoreController(
        "leaky FxLMS",
        "leaky",
        n_taps,
        secondary,
        settings={"step_size": step_size, "leak": leak},
        n_references=n_references,
        limiter=limiter,
    )
    most = float(np.max(controller.step_size * controller.leak))
    if most > 1.0:
        raise ValueError(f"step_size * leak must be 1 at most, got {most:g}: a sample would take more than the weight")
    return controller


@controller_maker
def optimal_leaky_fx_lms(
    n_taps: int,
    secondary: Secondary,
    *,
    step_size: float,
    rated_power: PerLoudspeaker | None = None,
    constraint: Constraints = None,
    fs: float | None = None,
    amplifier: Amplifiers = None,
    n_references: int = 1,
    limiter: Limiters = None,
) -> CoreController:
    r"""Return leaky FxLMS with the leak for a rated power, computed online.

    .. math:: \gamma(n) = E[x^2] \max\{\sqrt{G_s \delta_d^2 / \rho_o} - G_s,\ 0\}

    The leak penalises :math:`w^T w`, and :math:`E[y^2] = E[x^2] w^T w` for a white reference: for a tone, this leak
    exceeds the rated power. The powers are estimated as in KF-OPC. With several loudspeakers, each has its own gamma,
    from the sums stated in `mov_fx_lms`.

    Parameters
    ----------
    n_taps, secondary, step_size, n_references
        As for `fx_lms`.
    rated_power : float or array_like, shape (J,), optional
        Rated output power rho_o, or that of each loudspeaker.
    constraint : OutputPowerConstraint or sequence of J of them, optional
        Given instead of `rated_power`: a rated power with the settings of its power estimates. A copy is kept.
    fs : float, optional
        Sample rate in Hz of the power estimates; a system, a recording or a plant as `secondary` brings it.
    amplifier : amplifier model or sequence of J of them, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.
    limiter : OutputLimiter, optional
        As for `fx_lms`.

    Returns
    -------
    CoreController
        A controller named optimal leaky FxLMS.

    Raises
    ------
    ValueError
        A step size or rated power that is not positive and finite, neither or both of `rated_power` and `constraint`,
        fewer than one tap, a path that is not FIR.
    TypeError
        An amplifier that is not one of the package's models.

    References
    ----------
    D. Shi, B. Lam, W.-S. Gan, S. Wen, "Optimal leak factor selection for the output-constrained leaky filtered-input
    least mean square algorithm", IEEE Signal Processing Letters 26(5), 2019. Derived here from the fixed point
    :math:`(R_{x'} + \gamma I) w = r` for a white reference.

    Examples
    --------
    >>> from kfopc_filterpy import optimal_leaky_fx_lms
    >>> optimal_leaky_fx_lms(4, [1.0], step_size=0.1, rated_power=0.5, fs=16000).rated_power
    0.5
    """
    require_rated_power(rated_power, constraint)
    return CoreController(
        "optimal leaky FxLMS",
        "optimal_leaky",
        n_taps,
        secondary,
        settings={"step_size": step_size},
        n_references=n_references,
        amplifier=amplifier,
        rated_power=rated_power,
        constraint=constraint,
        fs=fs,
        limiter=limiter,
    )
