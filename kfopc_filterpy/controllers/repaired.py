"""KF-OPC with the gain of its constraint repaired: three changes of eq. 11-13, which can be used alone or together.

Eq. 13 keeps the rated power if the secondary path is flat over the noise and the disturbance can be cancelled
completely. On other paths the control signal and the reference have different spectra. Therefore

- the gain `G_s` of the control signal is E[(s^ * y)^2] / E[y^2] and not E[x'^2] / E[x^2]: `of_control`;
- the remaining error shows in the measured output power, which can trim the factor: `trim_rate`;
- a factor on the measurement acts on y with the delay of the filter's memory; on the output it acts at once:
  `at_output`.
"""

from __future__ import annotations

from typing import Any

from .._types import PathModels
from .._validate import as_choice, as_nonnegative, as_positive
from ..bounds.settings import SuggestedSettings
from ..power.amplifiers import Amplifier
from ..power.constraint import OutputPowerConstraint
from ..power.limiter import OutputLimiter
from .direct import DirectKalman
from .kalman import suggested_constraint, with_suggested

DEFAULT_TRIM_S = 1.0


class RepairedKFOPC(DirectKalman):
    """KF-OPC whose constraint factor keeps the rated power on more paths than the published one.

    Made by `kf_opc_repaired`.

    Parameters
    ----------
    n_taps, secondary_path, state_noise, measurement_noise, initial_variance, amplifier, limiter
        As for `DirectKalman`, for one channel.
    constraint : OutputPowerConstraint
        Constraint that computes the powers and the factor. A copy is kept.
    gain_of, trim_s, factor_at
        As for `kf_opc_repaired`.

    Raises
    ------
    ValueError
        An unknown `gain_of` or `factor_at`; a `trim_s` that is not positive; what `DirectKalman` refuses.

    Examples
    --------
    >>> from kfopc_filterpy import kf_opc_repaired
    >>> controller = kf_opc_repaired(8, [1.0], rated_power=0.5, state_noise=1e-6, measurement_noise=0.1)
    >>> type(controller).__name__, controller.rated_power
    ('RepairedKFOPC', 0.5)
    """

    algorithm = "repaired"
    checks = dict.fromkeys((*DirectKalman.checks, "of_control", "trim_rate", "at_output"), as_nonnegative)

    def __init__(
        self,
        n_taps: int,
        secondary_path: PathModels,
        *,
        constraint: OutputPowerConstraint,
        gain_of: str = "control",
        trim_s: float | None = DEFAULT_TRIM_S,
        factor_at: str = "output",
        **settings: Any,
    ) -> None:
        self.gain_of = as_choice(gain_of, "gain_of", ("reference", "control"))
        self.trim_s = None if trim_s is None else as_positive(trim_s, "trim_s", unit="s")
        self.factor_at = as_choice(factor_at, "factor_at", ("measurement", "output"))
        super().__init__(
            n_taps,
            secondary_path,
            n_references=None,
            constraint=constraint,
            name="KF-OPC repaired",
            of_control=float(gain_of == "control"),
            trim_rate=0.0 if self.trim_s is None else 1.0 / (self.trim_s * constraint.fs),
            at_output=float(factor_at == "output"),
            **settings,
        )


def kf_opc_repaired(
    n_taps: int | SuggestedSettings,
    secondary_path: PathModels,
    *,
    rated_power: float | None = None,
    constraint: OutputPowerConstraint | None = None,
    state_noise: float | None = None,
    measurement_noise: float | None = None,
    initial_variance: float | None = None,
    gain_of: str = "control",
    trim_s: float | None = DEFAULT_TRIM_S,
    factor_at: str = "output",
    amplifier: Amplifier | None = None,
    limiter: OutputLimiter | None = None,
    fs: float | None = None,
) -> RepairedKFOPC:
    r"""Return KF-OPC with its gain repaired, so that eq. 13 also keeps the rated power on paths that are not flat.

    Three repairs can be used alone or together. With ``gain_of="reference", trim_s=None, factor_at="measurement"`` it
    is KF-OPC as published. It still scales the whole control filter, which is a poor use of the power if the secondary
    path is not flat: `kf_pb` achieves more noise reduction.

    Parameters
    ----------
    n_taps, secondary_path, state_noise, measurement_noise, initial_variance, amplifier, limiter
        As for `kf_anc`.
    rated_power : float, optional
        Rated output power.
    constraint : OutputPowerConstraint, optional
        Given instead of `rated_power`: a rated power with the settings of its power estimates. A copy is kept.
    gain_of : {"control", "reference"}, default "control"
        Signal whose gain through the secondary path is G_s: the control signal, :math:`E[(\hat s * y)^2] / E[y^2]`, or
        the reference, :math:`E[x'^2] / E[x^2]` (eq. 11).
    trim_s : float or None, default 1
        Integration time in seconds of a closed loop that trims the factor until the measured output power is the rated
        power; the loop settles in half of this time. None: no trim.
    factor_at : {"output", "measurement"}, default "output"
        Signal that the factor is applied to: the control signal, on which it acts at once, or the measurement (eq. 9),
        on which it acts as fast as the filter adapts.
    fs : float, optional
        As for `kf_opc`.

    Returns
    -------
    RepairedKFOPC
        A controller named "KF-OPC repaired".

    Raises
    ------
    ValueError, TypeError
        Arguments that `DirectKalman` or `OutputPowerConstraint` refuses; neither suggested settings nor state noise
        and measurement noise; an unknown `gain_of` or `factor_at`; a `trim_s` that is not positive.

    Examples
    --------
    >>> from kfopc_filterpy import kf_opc_repaired
    >>> kf_opc_repaired(8, [1.0], rated_power=0.5, state_noise=1e-6, measurement_noise=0.1).factor_at
    'output'
    """
    return with_suggested(
        RepairedKFOPC,
        n_taps,
        secondary_path,
        {"state_noise": state_noise, "measurement_noise": measurement_noise, "initial_variance": initial_variance},
        constraint=suggested_constraint(n_taps, rated_power, constraint, fs),
        gain_of=gain_of,
        trim_s=trim_s,
        factor_at=factor_at,
        amplifier=amplifier,
        limiter=limiter,
    )
