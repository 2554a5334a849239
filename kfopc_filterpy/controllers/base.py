"""The controller protocol, and the base class of the built-in controllers."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any, Protocol, runtime_checkable

import numpy as np

from .._validate import as_count, as_number, as_signal
from ..kernels.delay_lines import delay_line, latest, newest
from ..kernels.holding import Held
from ..paths.models import is_system, path_taps, sampling_rate
from ..power.amplifiers import Amplifier, compiled_model
from ..power.constraint import ConstraintState, OutputPowerConstraint
from ..power.limiter import OutputLimiter
from .step import Lines, adapt_once, emit_once, estimate_once, listen

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
    """Interface that `simulate` drives, with two calls per sample. A user-defined controller needs nothing else.

    Optional attributes: `constraint_factor`, `disturbance_power` and `secondary_path_gain` are recorded if present, and
    `weights`, (L,), if requested. `name` names the result. `listen(references, errors)` follows the noise before the
    control is switched on.
    """

    def control_signal(self, reference: float) -> float:
        """Return the control signal y(n) for the newest reference sample x(n), from the weights of the last sample."""
        ...

    def update(self, error: float) -> None:
        """Adapt to the error e(n) = d(n) - (s * y_amp)(n) that this control signal left."""
        ...


def constraint_for(rated_power: float | None, constraint: OutputPowerConstraint | None) -> OutputPowerConstraint:
    """Return a new constraint for a controller: a copy of the one given, or one with default settings."""
    if (rated_power is None) == (constraint is None):
        raise ValueError("give either rated_power= or constraint=, an OutputPowerConstraint")
    if constraint is None:
        return OutputPowerConstraint(rated_power)  # type: ignore[arg-type]
    if not isinstance(constraint, OutputPowerConstraint):
        raise TypeError(f"constraint must be an OutputPowerConstraint or None, got {constraint!r}")
    return deepcopy(constraint)


def constraint_or_none(
    rated_power: float | None, constraint: OutputPowerConstraint | None
) -> OutputPowerConstraint | None:
    """Return `constraint_for`, or None if neither a rated power nor a constraint is given."""
    return None if rated_power is None and constraint is None else constraint_for(rated_power, constraint)


def require_rates(fs: float, rates: Mapping[str, float | None]) -> None:
    """Raise ValueError if a named part of a controller has another sample rate than the run's `fs` in Hz."""
    for name, rate in rates.items():
        if rate is not None and abs(rate - fs) > 1e-9 * fs:
            raise ValueError(
                f"fs is {fs:g} Hz but the controller's {name} is for {rate:g} Hz: make it with the fs of the run"
            )


class FilteredReferenceController:
    """Delay lines, powers and filtered reference that the built-in controllers share.

    A subclass sets `_state`, which begins with `_common()`, and registers the step for its type (see `step`).

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter.
    secondary_path : array_like or control.TransferFunction
        Estimated secondary path s^, taps or an FIR system.
    amplifier : callable, optional
        Known amplifier: the disturbance is then estimated with s^ * amplifier(y), not s^ * y as published.
    constraint : OutputPowerConstraint, optional
        Constraint that computes the powers and the factor; by default one whose factor is fixed at 1.
    limiter : OutputLimiter, optional
        Limiter of the control signal, see `limiter`.
    filtered_taps : int, optional
        Number of samples stored of the filtered reference; by default `n_taps`.
    """

    name = "controller"
    has_gains = False  # True if it has Kalman gains, which scenarios can share
    unshared = ""  # the part that prevents sharing, if any
    _refusal = OVERFLOW  # reason of a refused update if no square overflows
    _state: Any
    _holding: Held | None = None

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        amplifier: Amplifier | None = None,
        constraint: OutputPowerConstraint | None = None,
        limiter: OutputLimiter | None = None,
        filtered_taps: int | None = None,
    ) -> None:
        self.n_taps = as_count(n_taps, "n_taps")
        secondary = path_taps(secondary_path, name="secondary_path")
        model = compiled_model(amplifier)
        if model is None:
            raise TypeError(f"amplifier must be one of kfopc_filterpy's amplifier models or None, got {amplifier!r}")
        self._path_fs = sampling_rate(secondary_path, name="secondary_path") if is_system(secondary_path) else None
        self._constrained = constraint is not None
        self._own_constraint = constraint or OutputPowerConstraint(1.0)
        if constraint is None:
            self._own_constraint.factor = 1.0
        self._limiter = _checked_limiter(limiter)
        self._lines = Lines(
            secondary_estimate=secondary,
            reference=delay_line(max(self.n_taps, secondary.size)),
            filtered=delay_line(filtered_taps or self.n_taps),
            output=delay_line(secondary.size),
            amplifier=model,
            limiter=None if limiter is None else limiter.state,
        )
        self._y = 0.0

    def _common(self) -> tuple[Lines, np.ndarray, ConstraintState]:
        """Return the first fields of every state: lines, weights, constraint."""
        return self._lines, np.zeros(self.n_taps), self._own_constraint.state

    @property
    def limiter(self) -> OutputLimiter | None:
        """Limiter of the control signal, or None; can be assigned, but not shared with another controller.

        The disturbance is estimated from the output of the limiter, so the adaptation stays correct.
        """
        return self._limiter

    @limiter.setter
    def limiter(self, value: OutputLimiter | None) -> None:
        self._limiter = _checked_limiter(value)
        lines = self._state.lines._replace(limiter=None if value is None else value.state)
        self._state = self._state._replace(lines=lines)

    @property
    def weights(self) -> np.ndarray:
        """Control filter w, (L,), newest-sample tap first; a copy."""
        return self._state.weights.copy()

    @property
    def control_filter(self) -> np.ndarray:
        """Control filter that generates y, (L,); a copy."""
        return self.weights

    @property
    def rated_power(self) -> float | None:
        """Rated output power of the controller; None if it has no constraint."""
        return self._own_constraint.rated_power if self._constrained else None

    @property
    def constraint(self) -> OutputPowerConstraint:
        """Constraint that computes the powers and the factor; without a rated power its factor is fixed at 1."""
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
        """Running secondary-path gain (eq. 11); NaN until the reference has energy."""
        gain = self.constraint.secondary_path_gain
        return np.nan if gain is None else gain

    def __repr__(self) -> str:
        parts = [
            f"{self.n_taps} taps",
            *([] if self.rated_power is None else [f"rated power {self.rated_power:g}"]),
            f"constraint factor {self.constraint_factor:.3g}",
            *([] if self.limiter is None else [f"limiter of rated power {self.limiter.rated_power:g}"]),
        ]
        return f"<{self.name}: {', '.join(parts)}>"

    def control_signal(self, reference: float) -> float:
        """Return the control signal y(n) for the newest reference sample x(n), from the weights of the last sample."""
        self._y = emit_once.with_held(self._held(), as_number(reference, "reference"))
        return self._y

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for a copy, which holds a state of its own."""
        return {name: value for name, value in vars(self).items() if name != "_holding"}

    def _held(self) -> Held:
        """Return the state, held for compiled code."""
        if self._holding is None or self._holding.state is not self._state:
            self._holding = Held(self._state)
        return self._holding

    def update(self, error: float) -> None:
        """Adapt to the error e(n) that the last control signal left."""
        error = as_number(error, "error")
        if not adapt_once.with_held(self._held(), error, self._y):
            raise ValueError(self._reason(error))

    def _reason(self, error: float) -> str:
        """Return why an update was refused."""
        lines = self._state.lines
        values = np.array([estimate_once(lines, error), latest(lines.filtered), latest(lines.reference)])
        with np.errstate(over="ignore"):
            return self._refusal if np.isfinite(values**2).all() else OVERFLOW

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
        taken = listen(self._state, x, e)
        if taken < x.size:
            refused = ValueError(self._refusal)
            refused.add_note(f"in sample {taken} of those listened to")
            raise refused

    def _require_finite_squares(self, x: np.ndarray, e: np.ndarray) -> None:
        s, heard = self._lines.secondary_estimate, self._lines.reference
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
        """Sample rate in Hz of the power estimates."""
        return self.constraint.fs

    def require_sample_rate(self, fs: float) -> None:
        """Raise ValueError if the secondary path, power estimates or limiter are for another rate than `fs` in Hz."""
        require_rates(
            fs,
            {
                "secondary path": self._path_fs,
                "power memory": self._powers_fs if self.rated_power else None,
                "limiter": None if self.limiter is None else self.limiter.fs,
            },
        )

    def compiled_state(self, to_step: bool = True) -> Any:
        """Return the state for the compiled loop; None if Python must call the steps.

        `to_step` says if the caller will change the state, or only read it.
        """
        return self._state if calls_of(type(self)) == calls_of(FilteredReferenceController) else None

    def after_compiled(self, state: Any) -> None:
        """Adopt what the compiled loop changed in `state`, however many samples it ran."""


def calls_of(kind: type) -> tuple[Any, Any]:
    """Return a class's two methods per sample; if a subclass overrides one, Python must call it."""
    return kind.control_signal, kind.update  # type: ignore[attr-defined]


def _checked_limiter(limiter: OutputLimiter | None) -> OutputLimiter | None:
    if limiter is not None and not isinstance(limiter, OutputLimiter):
        raise TypeError(f"limiter must be an OutputLimiter or None, got {limiter!r}")
    return limiter
