"""What a controller is, and what the built-in ones share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np

from .._validate import as_count, as_number, as_signal
from ..kernels.block import OpenBlock
from ..kernels.covariance import new_covariance
from ..kernels.delay_lines import delay_line, latest, newest
from ..loop.run import (
    DISTURBANCE_IN,
    LISTENING,
    REFERENCE_IN,
    REFUSED,
    ROWS,
    STEP,
    ControllerState,
    Plant,
    adapt_lms,
    control_signal,
    disturbance_estimate,
    run,
    squares_are_finite,
)
from ..paths.models import is_system, path_taps, sampling_rate
from ..power.amplifiers import Amplifier, LinearAmplifier, compiled_parameters
from ..power.constraint import OutputPowerConstraint
from ..power.limiter import OutputLimiter

NO_SOLUTION = (
    "the update has no solution: S = x' P x' + q must be positive and finite; a silent reference with "
    "measurement_noise = 0 tells nothing: give measurement_noise > 0"
)


OVERFLOW = (
    "the disturbance estimate, the reference and the filtered reference must have finite squares, and one overflows: "
    "nothing was changed; scale the signals, or use a smaller step"
)


@runtime_checkable
class Controller(Protocol):
    """What `simulate` drives: two calls a sample. A user's own needs nothing else.

    Optional: `constraint_factor`, `disturbance_power` and `secondary_path_gain` are recorded where there are such
    attributes, `weights`, (L,), where they are asked for; `name` names the result; `listen(references, errors)` follows
    the noise before the control is switched on.
    """

    def control_signal(self, reference: float) -> float:
        """Control signal y(n) for the newest reference sample x(n), from the weights of the last sample."""
        ...

    def update(self, error: float) -> None:
        """Adapt to the error e(n) = d(n) - (s * y_amp)(n) that this control signal left."""
        ...


def constraint_or_none(rated_power: float | None = None, **settings: Any) -> OutputPowerConstraint:
    """Constraint of a rated power; without one the factor is held at 1, and the powers are still followed."""
    constraint = OutputPowerConstraint(1.0 if rated_power is None else rated_power, **settings)
    if rated_power is None:
        constraint.factor = 1.0
    return constraint


def require_rates(fs: float, rates: Mapping[str, float | None]) -> None:
    """Raise ValueError where a part of a controller, by its name, is of another sample rate than the run's `fs` in Hz."""
    for name, rate in rates.items():
        if rate is not None and abs(rate - fs) > 1e-9 * fs:
            raise ValueError(
                f"fs is {fs:g} Hz but the controller's {name} is for {rate:g} Hz: make it with the fs of the run"
            )


class FilteredReferenceController:
    """Delay lines and filtered reference that the built-in controllers share.

    Parameters
    ----------
    kind : int
        Family, `loop.KALMAN` or `loop.LMS`.
    n_taps : int
        Taps L of the control filter.
    secondary_path : array_like or control.TransferFunction
        Estimated secondary path s^, taps or an FIR system.
    amplifier : callable, optional
        Known amplifier: the disturbance is then estimated with s^ * amplifier(y), not s^ * y as published.
    constraint : OutputPowerConstraint, optional
        What keeps the powers and the factor; by default the powers are followed with the factor held at 1.
    limiter : OutputLimiter, optional
        What the control signal goes through, see `limiter`.
    """

    name = "controller"
    _refusal = OVERFLOW  # why an update is refused whose numbers are finite

    def __init__(
        self,
        kind: int,
        n_taps: int,
        secondary_path: Any,
        settings: list[float],
        amplifier: Amplifier | None = None,
        constraint: OutputPowerConstraint | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        n_taps = as_count(n_taps, "n_taps")
        secondary = path_taps(secondary_path, name="secondary_path")
        parameters = compiled_parameters(amplifier)
        if parameters is None:
            raise TypeError(f"amplifier must be one of kfopc_filterpy's amplifier models or None, got {amplifier!r}")
        self._path_fs = sampling_rate(secondary_path, name="secondary_path") if is_system(secondary_path) else None
        self._own_constraint = constraint or constraint_or_none()
        weights = np.zeros(n_taps)
        self._state = ControllerState(
            kind=kind,
            weights=weights,
            control_filter=weights,
            secondary_estimate=secondary,
            reference=delay_line(max(n_taps, secondary.size)),
            filtered=delay_line(n_taps),
            output=delay_line(secondary.size),
            amplifier=parameters,
            settings=np.array(settings, dtype=np.float64),
            covariance=new_covariance(np.zeros((1, 1))),
            constraint=self._own_constraint.state,
            last=np.zeros(3),
        )
        self._y = 0.0
        self.limiter = limiter

    @property
    def limiter(self) -> OutputLimiter | None:
        """Limiter that the control signal goes through, or None; can be assigned, an object of its own.

        The disturbance is estimated from what the limiter puts out, so that the adaptation stays right.
        """
        return self._limiter

    @limiter.setter
    def limiter(self, value: OutputLimiter | None) -> None:
        if value is not None and not isinstance(value, OutputLimiter):
            raise TypeError(f"limiter must be an OutputLimiter or None, got {value!r}")
        self._limiter = value
        self._state = self._state._replace(limiter=None if value is None else value.state)

    @property
    def weights(self) -> np.ndarray:
        """Control filter w, (L,), newest-sample tap first; a copy."""
        return self._state.weights.copy()

    @property
    def control_filter(self) -> np.ndarray:
        """Control filter that makes y, (L,); a copy."""
        return self._state.control_filter.copy()

    @property
    def rated_power(self) -> float | None:
        """Rated output power that the controller keeps to; None where it has no constraint."""
        return None

    @property
    def constraint(self) -> OutputPowerConstraint:
        """What keeps the powers and the factor; without a rated power it follows the powers, the factor held."""
        return self._own_constraint

    @property
    def constraint_factor(self) -> float:
        """Constraint factor of the last sample."""
        return self.constraint.factor

    @property
    def disturbance_power(self) -> float:
        """Running power of the disturbance estimate (eq. 10)."""
        return self.constraint.disturbance_power

    @property
    def secondary_path_gain(self) -> float:
        """Running secondary-path gain (eq. 11); NaN before any reference energy."""
        gain = self.constraint.secondary_path_gain
        return np.nan if gain is None else gain

    def control_signal(self, reference: float) -> float:
        """Control signal y(n) for the newest reference sample x(n), from the weights of the last sample."""
        self._y = float(control_signal(self._state, as_number(reference, "reference")))
        return self._y

    def update(self, error: float) -> None:
        """Adapt to the error e(n) that the last control signal left."""
        error = as_number(error, "error")
        if not adapt_lms(self._state, error, self._y):
            raise ValueError(self._refusal if self._squares_are_finite(error) else OVERFLOW)

    def _squares_are_finite(self, error: float) -> bool:
        state = self._state
        d = disturbance_estimate(state, error)
        return bool(squares_are_finite(d, latest(state.filtered), latest(state.reference)))

    def listen(self, references: np.ndarray, errors: np.ndarray) -> None:
        """Follow the noise before the control is switched on: delay lines and powers advance, the weights stay.

        Parameters
        ----------
        references, errors : ndarray
            (n_samples,) reference, and the error microphone's signal while the loudspeaker is silent.
        """
        x = as_signal(references, "references")
        e = as_signal(errors, "errors", length=x.size)
        self._require_finite_squares(x, e)
        silent = self._silent_state()
        nothing = Plant(np.zeros(1), np.zeros(0), delay_line(1), LinearAmplifier().parameters)
        for first in range(0, x.size, STEP):
            signals = np.zeros((ROWS, min(STEP, x.size - first)))
            signals[REFERENCE_IN], signals[DISTURBANCE_IN] = x[first : first + STEP], e[first : first + STEP]
            no_weights = np.empty((0, 0))
            status, done = run(silent, self.open_block, nothing, signals, no_weights, np.inf, 1, 0, 0, signals.shape[1])
            if status == REFUSED:
                refused = ValueError(self._refusal)
                refused.add_note(f"in sample {first + done} of those listened to")
                raise refused

    def _silent_state(self) -> ControllerState:
        """State for the compiled loop to listen with."""
        zeros = np.zeros(self._state.weights.size)
        return self._state._replace(kind=LISTENING, weights=zeros, control_filter=zeros)

    def _require_finite_squares(self, x: np.ndarray, e: np.ndarray) -> None:
        s, heard = self._state.secondary_estimate, self._state.reference
        before = newest(heard, s.size - 1)[::-1]
        with np.errstate(over="ignore", invalid="ignore"):
            filtered = np.convolve(np.concatenate((before, x)), s, mode="valid")
            fine = np.isfinite(x**2) & np.isfinite(e**2) & np.isfinite(filtered**2)
        if not fine.all():
            raise ValueError(
                f"references and errors must have finite squares: those of sample {int(fine.argmin())} overflow"
            )

    @property
    def _powers_fs(self) -> float:
        """Sample rate in Hz that the memory of the powers was made for."""
        return self.constraint.fs

    def require_sample_rate(self, fs: float) -> None:
        """Raise ValueError where the secondary path, the memory of the powers or the limiter is not for `fs` in Hz."""
        require_rates(
            fs,
            {
                "secondary path": self._path_fs,
                "power memory": self._powers_fs if self.rated_power else None,
                "limiter": None if self.limiter is None else self.limiter.fs,
            },
        )

    def steps_of(self, family: type) -> bool:
        """Whether the two calls a sample are those of `family`, which the compiled loop knows, and not a subclass's."""
        mine = type(self)
        return mine.control_signal is family.control_signal and mine.update is family.update  # type: ignore[attr-defined]

    def compiled_state(self) -> ControllerState | None:
        """State for the compiled loop, which advances it; None where only the steps above can run."""
        return self._state if self.steps_of(FilteredReferenceController) else None

    @property
    def open_block(self) -> OpenBlock | None:
        """Block under way, for the compiled loop; None for a controller that takes samples one by one."""
        return None

    def blocks(self, state: ControllerState, n_samples: int) -> Iterator[tuple[int, int]]:
        """Begin and end of the blocks that the loop may run on `state` without a pause; here all `n_samples`."""
        yield 0, n_samples

    def after_compiled(self, state: ControllerState) -> None:
        """Take back what the compiled loop advanced in `state`, however many samples it ran."""
