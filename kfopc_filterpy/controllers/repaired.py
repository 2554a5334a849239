"""KF-OPC with the gain of its constraint repaired: three changes of eq. 11-13, which can be used alone or together.

Eq. 13 keeps the rated power if the secondary path is flat over the noise and the disturbance can be cancelled
completely. On other paths the control signal and the reference have different spectra. Therefore

- the gain `G_s` of the control signal is E[(s^ * y)^2] / E[y^2] and not E[x'^2] / E[x^2]: `of_control`;
- the remaining error shows in the measured output power, which can trim the factor: `trim_rate`;
- a factor on the measurement acts on y with the delay of the filter's memory; on the output it acts at once:
  `at_output`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_choice, as_positive
from ..bounds.settings import SuggestedSettings
from ..filters.kfopc import KFOPC
from ..filters.random_walk import RandomWalkKFOPC
from ..kernels.compiling import compiled, inlined
from ..kernels.covariance import Covariance
from ..kernels.delay_lines import latest, newest
from ..kernels.records import new_record
from ..kernels.vectors import dot
from ..power.amplifiers import Amplifier
from ..power.constraint import (
    ConstraintState,
    OutputPowerConstraint,
    commit_constraint,
    preview_constraint,
    squares_are_finite,
)
from ..power.limiter import OutputLimiter
from .base import constraint_for
from .kalman import KalmanController, at_suggested_rate, correct, suggested_constraint, with_suggested
from .step import Lines, adapt, disturbance_estimate, estimate_once, output

LARGEST_TRIM = math.log(10.0)
DEFAULT_TRIM_S = 1.0


class RepairedState(NamedTuple):
    """State of the repaired KF-OPC."""

    lines: Lines
    weights: np.ndarray
    constraint: ConstraintState
    gains: Covariance
    numbers: np.ndarray  # as of `KalmanState`
    repair: np.ndarray  # record: of_control, trim_rate (0: none), at_output; log of the trim, factor at the output


@output.register(RepairedState)
def output_repaired(state, j):
    """Return w'x times the factor at the output."""
    w = state.weights
    return state.repair[0].output_gain * dot(w, newest(state.lines.reference, w.size))


@adapt.register(RepairedState)
def adapt_repaired(state, error, control_signal):
    """Apply eq. 2-9 with the repaired factor."""
    d, h0, x = disturbance_estimate(state.lines, error), latest(state.lines.filtered), latest(state.lines.reference)
    if not squares_are_finite(d, h0, x):
        return False
    filtered, reference = gain_samples(state.repair, h0, x, error, d, control_signal)
    factor, _, _ = preview_constraint(state.constraint, d, filtered, reference)
    if not correct(state, d, measurement_factor(state.repair, factor) * d):
        return False
    commit_constraint(state.constraint, d, filtered, reference)
    advance_repair(state.repair, state.constraint, control_signal)
    return True


@compiled()
def gain_samples(repair, filtered, x, error, d, y):
    """Return the samples whose powers give G_s: x' and x (eq. 11), or s^ * y = d^ - e and y."""
    if repair[0].of_control == 0:
        return filtered, x
    return d - error, y


@compiled()
def measurement_factor(repair, factor):
    """Return the factor of the measurement (eq. 9)."""
    return 1.0 if repair[0].at_output != 0 else trimmed(repair, factor)


@inlined
def trimmed(repair, factor):
    """Return the factor with the trim, at most 1."""
    return min(factor * math.exp(repair[0].trim), 1.0)


@compiled()
def advance_repair(repair, constraint, y):
    """Record the factor used, and trim the next one by the power of y: up if it is below the rated power, else down.

    At a factor of 1 the trim does not rise, so that it does not wind up.
    """
    own, numbers = repair[0], constraint.numbers[0]
    numbers.factor = trimmed(repair, numbers.factor)
    change = own.trim_rate * (1.0 - y * y / numbers.rated_power)
    if change < 0.0 or numbers.factor < 1.0:
        own.trim = min(max(own.trim + change, -LARGEST_TRIM), LARGEST_TRIM)
    if own.at_output != 0:
        own.output_gain = numbers.factor


class RepairedKFOPC(KalmanController):
    """KF-OPC whose constraint factor keeps the rated power on more paths than the published one.

    Made by `kf_opc_repaired`. The estimator has no constraint: the controller sets its factor.

    Parameters
    ----------
    estimator : RandomWalkKFOPC
        Filter without a rated power.
    secondary_path, amplifier, name, limiter
        As for `KalmanController`.
    constraint : OutputPowerConstraint
        Constraint that computes the powers and the factor. A copy is kept.
    gain_of, trim_s, factor_at
        As for `kf_opc_repaired`.

    Raises
    ------
    ValueError
        An estimator of another type or with a rated power; an unknown `gain_of` or `factor_at`; a `trim_s` that is not
        positive.

    Examples
    --------
    >>> from kfopc_filterpy import kf_opc_repaired
    >>> controller = kf_opc_repaired(8, [1.0], rated_power=0.5, state_noise=1e-6, measurement_noise=0.1)
    >>> type(controller).__name__, controller.rated_power
    ('RepairedKFOPC', 0.5)
    """

    estimator: RandomWalkKFOPC
    unshared = "repaired gain"

    def __init__(
        self,
        estimator: RandomWalkKFOPC,
        secondary_path: Any,
        constraint: OutputPowerConstraint,
        *,
        gain_of: str = "control",
        trim_s: float | None = DEFAULT_TRIM_S,
        factor_at: str = "output",
        amplifier: Amplifier | None = None,
        name: str | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        self.gain_of = as_choice(gain_of, "gain_of", ("reference", "control"))
        self.trim_s = None if trim_s is None else as_positive(trim_s, "trim_s", unit="s")
        self.factor_at = as_choice(factor_at, "factor_at", ("measurement", "output"))
        own = constraint_for(None, constraint)
        rate = 0.0 if self.trim_s is None else 1.0 / (self.trim_s * constraint.fs)
        self._repair = new_record(
            of_control=int(gain_of == "control"),
            trim_rate=rate,
            at_output=int(factor_at == "output"),
            trim=0.0,
            output_gain=1.0,
        )
        super().__init__(estimator, secondary_path, amplifier=amplifier, name=name, limiter=limiter)
        self._own_constraint = own

    def _require_filter(self, estimator: Any) -> None:
        if not isinstance(estimator, RandomWalkKFOPC) or estimator.rated_power is not None:
            raise ValueError("estimator must be a filter of KFOPC.random_walk without a rated power of its own")

    def _new_state(self, gains: Covariance, numbers: np.ndarray) -> Any:
        return RepairedState(*self._common(), gains, numbers, self._repair)

    def _usual_name(self) -> str:
        return "KF-OPC repaired"

    def _family(self) -> type[KalmanController]:
        return RepairedKFOPC

    def _read_rated_power(self) -> float:
        return self.constraint.rated_power

    def _take_rated_power(self, value: float) -> None:
        self.constraint.rated_power = value

    @property
    def constraint(self) -> OutputPowerConstraint:
        """Constraint that computes the powers and the factor."""
        return self._own_constraint

    @property
    def constraint_factor(self) -> float:
        """Constraint factor of the last sample, trimmed."""
        return self.constraint.factor

    def _update_through_estimator(self, error: float) -> None:
        d = estimate_once(self._state.lines, error)
        h = newest(self._state.lines.filtered, self.n_taps).reshape(1, -1).copy()
        seen = gain_samples(self._repair, h[0, 0], latest(self._state.lines.reference), error, d, self._y)
        factor = self.constraint.preview(d, *seen)  # raises if a square overflows, before anything changes
        self.estimator.constraint_factor = measurement_factor(self._repair, factor)
        self.estimator.predict()
        self.estimator.update(d, H=h)
        self.constraint.advance(d, *seen)
        advance_repair(self._repair, self.constraint.state, self._y)

    def after_compiled(self, state: Any, shared: bool = False) -> None:
        """Give the estimator the results in `state` and the last factor; see `KalmanController` for `shared`."""
        super().after_compiled(state, shared)
        self._hold_factor()

    def update(self, error: float) -> None:
        """Adapt to the error e(n) that the last control signal left."""
        super().update(error)
        self._hold_factor()

    def _hold_factor(self) -> None:
        self.estimator.constraint_factor = 1.0 if self.factor_at == "output" else self.constraint_factor


def kf_opc_repaired(
    n_taps: int | SuggestedSettings,
    secondary_path: Any,
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

    Returns
    -------
    RepairedKFOPC
        A controller named "KF-OPC repaired".

    Raises
    ------
    ValueError, TypeError
        Arguments that `KFOPC.random_walk` or `OutputPowerConstraint` refuses; neither suggested settings nor state noise
        and measurement noise; an unknown `gain_of` or `factor_at`; a `trim_s` that is not positive.

    Examples
    --------
    >>> from kfopc_filterpy import kf_opc_repaired
    >>> kf_opc_repaired(8, [1.0], rated_power=0.5, state_noise=1e-6, measurement_noise=0.1).factor_at
    'output'
    """
    own = suggested_constraint(n_taps, rated_power, constraint)
    noises = {"state_noise": state_noise, "measurement_noise": measurement_noise, "initial_variance": initial_variance}
    taps, settings = with_suggested(n_taps, noises)
    controller = RepairedKFOPC(
        KFOPC.random_walk(taps, **settings),
        secondary_path,
        own,
        gain_of=gain_of,
        trim_s=trim_s,
        factor_at=factor_at,
        amplifier=amplifier,
        limiter=limiter,
    )
    return at_suggested_rate(controller, n_taps)
