"""MOV-FxLMS: FxLMS with a penalty on the control power, fixed or adapted to a rated power."""

from __future__ import annotations

import math
from typing import Any

from .._types import PerLoudspeaker
from .._validate import as_choice, as_nonnegative, as_positive
from ..plant import Secondary
from ..power.amplifiers import Amplifiers
from ..power.constraint import Constraints
from ..power.limiter import Limiters
from .core_controller import CoreController
from .making import controller_maker, require_rated_power


def penalty_factor(rated_power: float, *, disturbance_power: float, secondary_path_gain: float) -> float:
    r"""Return the penalty factor of MOV-FxLMS for a rated output power.

    .. math:: \gamma = \max\{\sqrt{G_s \delta_d^2 / \rho_o} - G_s,\ 0\}

    If the secondary path has the same gain at all frequencies of the noise, the solution of MOV-FxLMS is then the
    unconstrained one times :math:`G_s / (G_s + \gamma)`, which is the constraint factor of eq. 13.

    Parameters
    ----------
    rated_power : float
        Rated output power rho_o, the mean square of the control signal.
    disturbance_power : float
        Power of the disturbance.
    secondary_path_gain : float
        Power gain G_s of the secondary path for the noise, E[x'^2]/E[x^2].

    Returns
    -------
    float
        Penalty factor, 0 if the rated power is enough.

    Raises
    ------
    ValueError
        A rated power or gain that is not positive and finite, a disturbance power that is negative or not finite.

    References
    ----------
    D. Shi, W.-S. Gan, B. Lam, X. Shen, "Optimal penalty factor for the MOV-FxLMS algorithm in active noise control
    system", IEEE Signal Processing Letters 29, 2022.

    Examples
    --------
    >>> from kfopc_filterpy.controllers import penalty_factor
    >>> penalty_factor(0.25, disturbance_power=4.0, secondary_path_gain=1.0)  # a quarter of the amplitude is left
    3.0
    """
    rated_power = as_positive(rated_power, "rated_power")
    gain = as_positive(secondary_path_gain, "secondary_path_gain")
    power = as_nonnegative(disturbance_power, "disturbance_power")
    return max(math.sqrt(gain) * math.sqrt(power / rated_power) - gain, 0.0)


@controller_maker
def mov_fx_lms(
    n_taps: int,
    secondary: Secondary,
    *,
    step_size: float,
    rated_power: PerLoudspeaker | None = None,
    constraint: Constraints = None,
    fs: float | None = None,
    amplifier: Amplifiers = None,
    penalty_factor: PerLoudspeaker | None = None,
    modified: bool = False,
    n_references: int = 1,
    limiter: Limiters = None,
) -> CoreController:
    r"""Return MOV-FxLMS, minimum-output-variance FxLMS: a penalty keeps the control power within the rated power.

    .. math::

       w \leftarrow w + \mu\, (e x' - \gamma y x),

       \gamma = G_s \max\{\sqrt{\delta_d^2 / (\rho_o G_s)} - 1,\ 0\}

    For a flat path, :math:`G_s / (G_s + \gamma)` is then the constraint factor of eq. 13. The powers are estimated as
    in KF-OPC, so the penalty varies with the noise (Lai et al. 2023); the argument `penalty_factor` fixes it (Shi et
    al. 2021). The weights settle at about :math:`(R_{x'} + \gamma R_x) w = r`.

    With several channels, loudspeaker j has the penalty gamma_j, from its own rated power, the disturbance power
    :math:`\sum_k E[d_k^2]` and the gain :math:`G_j = \sum_{ki} E[x'^2_{kji}] / \sum_i E[x_i^2]`. This extension is ours.
    It assumes that the loudspeaker has to cancel the whole disturbance alone, so several loudspeakers that share the
    work usually stay well below their rated powers.

    Parameters
    ----------
    n_taps, secondary, n_references
        As for `fx_lms`.
    step_size : float
        Step size mu, above zero. Start where `fx_lms` starts, times the constraint factor to be expected.
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
    penalty_factor : float or array_like, shape (J,), optional
        Fixed penalty factor gamma, or that of each loudspeaker, zero or above; the function `penalty_factor` computes
        it for a rated power. By default gamma follows the running powers.
    modified : bool, default False
        Adapt to ``d^ - w' x'`` instead of the error, in the modified structure of Lai et al. The delay of the secondary
        path then does not limit the step size. The controller is named MOV-MFxLMS.

    Returns
    -------
    CoreController
        A controller named MOV-FxLMS, or MOV-MFxLMS if it is modified.

    Raises
    ------
    ValueError
        A step size or rated power that is not positive and finite, neither or both of `rated_power` and `constraint`,
        a penalty factor that is negative or not finite, fewer than one tap, a path that is not FIR.
    TypeError
        An amplifier that is not one of the package's models.

    References
    ----------
    D. Shi, W.-S. Gan, B. Lam, S. Wen, X. Shen, "Optimal output-constrained active noise control based on inverse
    adaptive modeling leak factor estimate", IEEE/ACM TASLP 29, 2021. C. K. Lai, D. Shi, B. Lam, W.-S. Gan,
    "MOV-modified-FxLMS algorithm with variable penalty factor in a practical power output constrained active control
    system", IEEE Signal Processing Letters 30, 2023.

    Examples
    --------
    >>> from kfopc_filterpy import mov_fx_lms
    >>> controller = mov_fx_lms(4, [1.0], step_size=0.1, rated_power=0.5, fs=16000)
    >>> controller.rated_power
    0.5
    """
    changed = as_choice(modified, "modified", (True, False))
    settings: dict[str, Any] = {"step_size": step_size, "modified": float(changed)}
    if penalty_factor is None:
        require_rated_power(rated_power, constraint)
    else:
        settings["penalty_factor"] = penalty_factor
    return CoreController(
        "MOV-MFxLMS" if changed else "MOV-FxLMS",
        "mov" if penalty_factor is None else "mov_fixed",
        n_taps,
        secondary,
        settings=settings,
        n_references=n_references,
        amplifier=amplifier,
        rated_power=rated_power,
        constraint=constraint,
        fs=fs,
        limiter=limiter,
    )
