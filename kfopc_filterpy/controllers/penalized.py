"""FxLMS with a price on what it puts out: on the weights (leaky FxLMS), on the control signal (MOV-FxLMS).

A fixed price is chosen beforehand; one for a rated power follows the powers that KF-OPC's constraint keeps (eq. 10-11).
"""

from __future__ import annotations

import math
from typing import Any

from .._validate import as_nonnegative, as_positive
from ..power.amplifiers import Amplifier
from ..power.constraint import DEFAULT_FS, DEFAULT_MEMORY_S, OutputPowerConstraint
from ..power.limiter import OutputLimiter
from .fxlms import LMSController
from .lms_rules import (
    FACTOR,
    LEAK,
    MODIFIED,
    PENALTY,
    RATED_LEAK,
    RATED_PENALTY,
    RULE,
    further_rules,
    lms_settings,
)


def penalty_factor(rated_power: float, *, disturbance_power: float, secondary_path_gain: float) -> float:
    r"""Penalty factor of MOV-FxLMS that a rated output power asks for.

    .. math:: \gamma = \max\{\sqrt{G_s \delta_d^2 / \rho_o} - G_s,\ 0\}

    With it the solution of MOV-FxLMS is the unconstrained one times :math:`G_s / (G_s + \gamma)`, which is the
    constraint factor of eq. 13, where the secondary path has the same gain at all frequencies of the noise.

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
        Penalty factor, 0 where the rated power is enough.

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


def leak_factor(
    rated_power: float, *, disturbance_power: float, secondary_path_gain: float, reference_power: float
) -> float:
    r"""Leak of leaky FxLMS that a rated output power asks for, :math:`E[x^2]` times `penalty_factor`.

    The leak is a price on :math:`w^T w`, and :math:`E[y^2] = E[x^2] w^T w` for a white reference. For a tone seen by L
    taps the price that keeps the rated power is L/2 times as high: this one then spends more.

    Parameters
    ----------
    rated_power, disturbance_power, secondary_path_gain
        As for `penalty_factor`.
    reference_power : float
        Power of the reference.

    Returns
    -------
    float
        Leak gamma, in the unit of the squared reference; 0 where the rated power is enough.

    Raises
    ------
    ValueError
        As for `penalty_factor`; a reference power that is negative or not finite.

    References
    ----------
    D. Shi, B. Lam, W.-S. Gan, S. Wen, "Optimal leak factor selection for the output-constrained leaky filtered-input
    least mean square algorithm", IEEE Signal Processing Letters 26(5), 2019. Derived here from the fixed point
    :math:`(R_{x'} + \gamma I) w = r` for a white reference.

    Examples
    --------
    >>> from kfopc_filterpy.controllers import leak_factor
    >>> leak_factor(0.25, disturbance_power=4.0, secondary_path_gain=1.0, reference_power=2.0)
    6.0
    """
    gamma = penalty_factor(rated_power, disturbance_power=disturbance_power, secondary_path_gain=secondary_path_gain)
    return as_nonnegative(reference_power, "reference_power") * gamma


class LeakyFxLMS(LMSController):
    r"""Leaky FxLMS, :math:`w(n+1) = (1 - \mu\gamma) w(n) + \mu e(n) x'(n)`, with a leak chosen beforehand.

    It settles about :math:`(R_{x'} + \gamma I) w = r`, the least :math:`E[e^2] + \gamma w^T w`.

    Parameters
    ----------
    n_taps, secondary_path, step_size, limiter
        As for `FxLMS`.
    leak : float
        Leak gamma, zero or above, in the unit of the squared reference; `leak_factor` gives the one for a rated power.

    Raises
    ------
    ValueError
        A step size that is not positive and finite, a leak that is negative, not finite or takes more than the whole
        weight in a sample, fewer than one tap, a path that is no FIR path.

    References
    ----------
    O. J. Tobias, R. Seara, "Leaky-FXLMS algorithm: stochastic analysis for Gaussian data and secondary path modeling
    error", IEEE Trans. Speech and Audio Processing 13(6), 2005.

    Examples
    --------
    >>> from kfopc_filterpy import LeakyFxLMS
    >>> controller = LeakyFxLMS(1, secondary_path=[1.0], step_size=0.1, leak=1.0)
    >>> for _ in range(200):
    ...     error = 2.0 - controller.control_signal(1.0)
    ...     controller.update(error)
    >>> round(float(controller.weights[0]), 6)  # (1 + leak) w = 2
    1.0
    """

    name = "leaky FxLMS"

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        step_size: float,
        leak: float,
        limiter: OutputLimiter | None = None,
    ) -> None:
        step_size, leak = as_positive(step_size, "step_size"), as_nonnegative(leak, "leak")
        if step_size * leak > 1.0:
            raise ValueError(
                f"step_size * leak must be 1 at most, got {step_size * leak:g}: a sample would take more than the weight"
            )
        super().__init__(n_taps, secondary_path, lms_settings(LEAK, step_size, factor=leak), limiter=limiter)

    @property
    def leak(self) -> float:
        """Leak gamma."""
        return self._factor


class _RatedLMS(LMSController):
    """What the two with a price for a rated power share."""

    _rule: int

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        step_size: float,
        rated_power: float,
        fs: float = DEFAULT_FS,
        power_memory: float = DEFAULT_MEMORY_S,
        power_window: str = "exponential",
        secondary_path_gain: float | None = None,
        amplifier: Amplifier | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        constraint = OutputPowerConstraint(
            rated_power, secondary_path_gain=secondary_path_gain, fs=fs, memory=power_memory, window=power_window
        )
        settings = lms_settings(self._rule, as_positive(step_size, "step_size"))
        super().__init__(n_taps, secondary_path, settings, amplifier, constraint, limiter)

    @property
    def rated_power(self) -> float:
        """Rated output power."""
        return self.constraint.rated_power


class OptimalLeakyFxLMS(_RatedLMS):
    r"""Leaky FxLMS with the leak that the rated power asks for, followed online.

    .. math:: \gamma(n) = E[x^2] \max\{\sqrt{G_s \delta_d^2 / \rho_o} - G_s,\ 0\}

    as `leak_factor`, from running powers as KF-OPC's.

    Parameters
    ----------
    n_taps, secondary_path, step_size
        As for `FxLMS`.
    rated_power : float
        Rated output power rho_o.
    fs, power_memory, power_window, secondary_path_gain
        As `fs`, `memory`, `window`, `secondary_path_gain` of `OutputPowerConstraint`.
    amplifier : callable, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.
    limiter : OutputLimiter, optional
        As for `FxLMS`.

    Raises
    ------
    ValueError
        A step size, rated power, rate, memory or gain that is not positive and finite, another window, fewer than
        one tap, a path that is no FIR path.
    TypeError
        An amplifier that is none of the amplifier models.

    References
    ----------
    As for `leak_factor`; there it is known beforehand.

    Examples
    --------
    >>> from kfopc_filterpy import OptimalLeakyFxLMS
    >>> OptimalLeakyFxLMS(4, secondary_path=[1.0], step_size=0.1, rated_power=0.5).rated_power
    0.5
    """

    name = "optimal leaky FxLMS"
    _rule = RATED_LEAK


class MOVFxLMS(_RatedLMS):
    r"""Minimum-output-variance FxLMS: FxLMS with a price on the control power that keeps it to its rated power.

    .. math:: w(n+1) = w(n) + \mu [e(n) x'(n) - \gamma y(n) x(n)], \qquad
       \gamma = \max\{G_s (\sqrt{\delta_d^2 / (\rho_o G_s)} - 1), 0\}

    so that :math:`G_s / (G_s + \gamma)` is the constraint factor of eq. 13 for a flat path. The powers are estimated
    as KF-OPC's are, so the penalty varies with the noise (Lai et al. 2023); `penalty_factor` holds one chosen
    beforehand (Shi et al. 2021). It settles about :math:`(R_{x'} + \gamma R_x) w = r`.

    Parameters
    ----------
    n_taps, secondary_path, step_size
        As for `FxLMS`.
    rated_power : float
        Rated output power rho_o.
    fs, power_memory, power_window, secondary_path_gain
        As `fs`, `memory`, `window`, `secondary_path_gain` of `OutputPowerConstraint`.
    amplifier : callable, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.
    limiter : OutputLimiter, optional
        As for `FxLMS`.
    penalty_factor : float, optional
        Penalty factor gamma to hold, zero or above; the function `penalty_factor` gives the one for a rated power. By
        default it follows the running powers.
    modified : bool, default False
        Adapt to ``d^ - w' x'`` in place of the error, the modified structure of Lai et al.: the delay of the secondary
        path no longer bounds the step size. The controller is then named MOV-MFxLMS.

    Raises
    ------
    ValueError
        A step size, rated power, rate, memory or gain that is not positive and finite, a penalty factor that is
        negative or not finite, another window, fewer than one tap, a path that is no FIR path.
    TypeError
        An amplifier that is none of the amplifier models.

    References
    ----------
    D. Shi, W.-S. Gan, B. Lam, S. Wen, X. Shen, "Optimal output-constrained active noise control based on inverse
    adaptive modeling leak factor estimate", IEEE/ACM TASLP 29, 2021. C. K. Lai, D. Shi, B. Lam, W.-S. Gan,
    "MOV-modified-FxLMS algorithm with variable penalty factor in a practical power output constrained active control
    system", IEEE Signal Processing Letters 30, 2023.

    Examples
    --------
    >>> from kfopc_filterpy import MOVFxLMS
    >>> controller = MOVFxLMS(4, secondary_path=[1.0], step_size=0.1, rated_power=0.5)
    >>> controller.rated_power
    0.5
    """

    name = "MOV-FxLMS"
    _rule = RATED_PENALTY

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        step_size: float,
        rated_power: float,
        fs: float = DEFAULT_FS,
        power_memory: float = DEFAULT_MEMORY_S,
        power_window: str = "exponential",
        secondary_path_gain: float | None = None,
        amplifier: Amplifier | None = None,
        limiter: OutputLimiter | None = None,
        penalty_factor: float | None = None,
        modified: bool = False,
    ) -> None:
        super().__init__(
            n_taps,
            secondary_path,
            step_size=step_size,
            rated_power=rated_power,
            fs=fs,
            power_memory=power_memory,
            power_window=power_window,
            secondary_path_gain=secondary_path_gain,
            amplifier=amplifier,
            limiter=limiter,
        )
        settings = self._state.settings
        if penalty_factor is not None:
            settings[RULE], settings[FACTOR] = PENALTY, as_nonnegative(penalty_factor, "penalty_factor")
        if modified:
            settings[MODIFIED], self.name = True, "MOV-MFxLMS"
        self._state = self._state._replace(rules=further_rules(settings))

    @property
    def modified(self) -> bool:
        """Whether it adapts to ``d^ - w' x'`` in place of the error."""
        return bool(self._state.settings[MODIFIED])
