"""The controller protocol, and the base class of the built-in controllers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from copy import deepcopy
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from .._validate import as_channels, as_count, as_positive, as_signal, per_loudspeaker
from ..checkpoint import Checkpointed
from ..core.run_loop import REFUSED_REFERENCE, Steps, process
from ..paths.models import is_system, path_taps, sampling_rate
from ..paths.path_matrix import is_path_matrix, secondary_paths
from ..paths.uncertainty import as_uncertainty, guard_filter
from ..power.amplifiers import Amplifier
from ..power.constraint import DEFAULT_FS, OutputPowerConstraint
from ..power.limiter import OutputLimiter
from .processing import (
    BlockProcessing,
    RefusedUpdate,
    adapt_flags,
    block_signal,
    output_array,
    require_channels,
    require_one_length,
)

NO_SOLUTION = "the update has no solution: the covariance P is too large, S = x' P x' + q could overflow"


OVERFLOW = (
    "the disturbance estimate, the reference and the filtered reference must have finite squares, and one overflows: "
    "nothing was changed; scale the signals, or use a smaller step"
)


LONGEST_CALL = 1600  # samples between two opportunities to interrupt a block: 0.1 s at 16 kHz

Constraints = OutputPowerConstraint | tuple[OutputPowerConstraint, ...]


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


def constraint_for(rated_power: Any, constraint: Any, fs: float = DEFAULT_FS) -> Any:
    """Return a new constraint for a controller: a copy of the one given, or one with default settings for the rate `fs`.

    Several rated powers or constraints, one for each loudspeaker, give a tuple.
    """
    if (rated_power is None) == (constraint is None):
        raise ValueError("give either rated_power= or constraint=, an OutputPowerConstraint")
    if isinstance(constraint, list | tuple):
        return tuple(constraint_for(None, one) for one in constraint)
    if constraint is None:
        if np.ndim(rated_power) == 1:
            return tuple(OutputPowerConstraint(power, fs=fs) for power in rated_power)
        return OutputPowerConstraint(rated_power, fs=fs)
    if not isinstance(constraint, OutputPowerConstraint):
        raise TypeError(f"constraint must be an OutputPowerConstraint or None, got {constraint!r}")
    return deepcopy(constraint)


def constraint_or_none(rated_power: Any, constraint: Any) -> Any:
    """Return `constraint_for`, or None if neither a rated power nor a constraint is given."""
    return None if rated_power is None and constraint is None else constraint_for(rated_power, constraint)


def require_rates(fs: float, rates: Mapping[str, float | None]) -> None:
    """Raise ValueError if a named part of a controller has another sample rate than the run's `fs` in Hz."""
    for name, rate in rates.items():
        if rate is not None and abs(rate - fs) > 1e-9 * fs:
            raise ValueError(
                f"fs is {fs:g} Hz but the controller's {name} is for {rate:g} Hz: make it with the fs of the run"
            )


def listening(controller: Any) -> Any:
    """Return a controller, or raise ValueError if it cannot follow the noise before the control is switched on."""
    if not hasattr(controller, "listen"):
        raise ValueError("switch_on_s needs a controller with a method listen(references, errors)")
    return controller


def passed_on(name: str, doc: str) -> Any:
    """Return a property of a wrapper that reads and assigns the attribute of this name of its controller."""

    def read(wrapper: Any) -> Any:
        return getattr(wrapper.controller, name)

    def assign(wrapper: Any, value: Any) -> None:
        wrapper._pass_on(name, value)

    return property(read, assign, doc=doc)


class WrappedController(BlockProcessing, Checkpointed):
    """Base class of a controller that wraps another one and passes on its attributes."""

    secondary_path = passed_on("secondary_path", "Estimated secondary path of the inner controller; can be assigned.")
    secondary_path_uncertainty = passed_on(
        "secondary_path_uncertainty", "Uncertainty of that path; can be assigned if the inner controller's can."
    )
    rated_power = passed_on("rated_power", "Rated power of the inner controller; can be assigned if that has one.")
    limiter = passed_on("limiter", "Limiter of the inner controller; can be assigned if the inner controller's can.")

    def __init__(self, controller: Controller) -> None:
        if isinstance(controller, type) or not isinstance(controller, Controller):
            raise TypeError(f"controller must have control_signal(reference) and update(error), got {controller!r}")
        self.controller = controller

    def __getattr__(self, name: str) -> Any:
        """Return any other attribute of the inner controller, except special methods such as those for copies."""
        if name == "controller" or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.controller, name)

    def _pass_on(self, name: str, value: Any) -> None:
        """Assign an attribute of the inner controller; a wrapper that knows the value itself extends this."""
        if not hasattr(self.controller, name):
            raise AttributeError(f"{type(self.controller).__name__} has no {name} that could be assigned")
        setattr(self.controller, name, value)

    def require_sample_rate(self, fs: float) -> None:
        """Raise ValueError if a part of the wrapper or the controller is for another sample rate than `fs` in Hz."""
        require_rates(fs, self._rates())
        inner = getattr(self.controller, "require_sample_rate", None)
        if inner is not None:
            inner(fs)

    def _rates(self) -> dict[str, float | None]:
        """Return the sample rates in Hz of the wrapper's own parts, by name; None for a part without one."""
        return {}


class Looped(NamedTuple):
    """A controller as the core's loop sees it."""

    steps: Steps
    control_filter: np.ndarray  # (J, I, L) or (L,): the next control signal's
    recorded: dict[str, np.ndarray]  # constraint_factor and others, (J,) or (1,), as of the last sample
    in_use: AbstractContextManager[Any] = nullcontext()
    owner: Any = None  # what must exist meanwhile


class FilteredReferenceController(BlockProcessing, Checkpointed):
    """Channels, paths, limiter, constraint and blocks: what the built-in controllers share.

    Their signals are in a block of the core, see `core_controller.CoreController`.

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter.
    secondary_path : array_like or control.TransferFunction
        Estimated secondary path s^, taps or an FIR system; with several channels (K microphones, J loudspeakers, taps)
        or a matrix of systems.
    n_references : int, optional
        Number of references I of an algorithm that takes several channels. By default it takes one channel only.
    multichannel : bool, optional
        Whether signals have a channel axis; by default if the secondary path has channel axes or there are several
        references.
    amplifier : callable, optional
        Known amplifier: the disturbance is then estimated with s^ * amplifier(y), not s^ * y as published. With several
        channels also a sequence, one for each loudspeaker.
    constraint : OutputPowerConstraint, optional
        Constraint that computes the powers and the factor; by default one whose factor is fixed at 1. With several
        channels also a tuple, one for each loudspeaker.
    limiter : OutputLimiter, optional
        Limiter of the control signal, see `limiter`. With several channels a sequence, one for each loudspeaker.

    Attributes
    ----------
    multichannel : bool
        Whether references, errors, control signals, powers and factors are arrays with a value for each channel.
    n_microphones, n_loudspeakers, n_references : int
        K, J and I.
    """

    name = "controller"
    _uncertainty: Any = None  # as it was assigned

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        n_references: int | None = None,
        multichannel: bool | None = None,
        amplifier: Amplifier | Sequence[Amplifier] | None = None,
        constraint: Constraints | None = None,
        limiter: OutputLimiter | Sequence[OutputLimiter] | None = None,
    ) -> None:
        self.n_taps = as_count(n_taps, "n_taps")
        secondary = self._read_paths(secondary_path, n_references, multichannel)
        self._limiter = self._checked_limiter(limiter)
        self._constrained = constraint is not None
        self._own_constraint = self._checked_constraint(constraint)
        self._begin(secondary, amplifier)

    # What a subclass defines.

    def control_signal(self, reference: Any) -> Any:
        """Return the control signal y(n) for the newest reference sample x(n), from the weights of the last sample."""
        raise NotImplementedError

    def update(self, error: Any) -> None:
        """Adapt to the error e(n) that the last control signal left."""
        raise NotImplementedError

    def _begin(self, secondary: np.ndarray, amplifier: Any) -> None:
        """Make silent signals for checked paths, (n_path,) or (K, J, n_path)."""
        raise NotImplementedError

    def _estimated_path(self) -> np.ndarray:
        """Return the estimated secondary path where the steps find it: what is written into it, they use."""
        raise NotImplementedError

    def _filter_again(self) -> None:
        """Filter the stored references with the present estimate, and the results with the guard."""
        raise NotImplementedError

    def _use_guard(self, taps: np.ndarray | None) -> None:
        """Use a guard W, or none, and filter the stored references with it."""
        raise NotImplementedError

    def _use_limiter(self, before: Any) -> None:
        """Use the limiter, or limiters, that were just assigned in place of those `before`."""
        raise NotImplementedError

    def looped(self) -> Looped | None:
        """Return what the core's loop needs to run this controller; None if Python must call the steps."""
        raise NotImplementedError

    def _listen(self, references: np.ndarray, errors: np.ndarray, adapting: np.ndarray) -> int:
        """Follow signals (n_samples, channels), or (n_samples,); return the number of samples before a refusal."""
        raise NotImplementedError

    def _read_paths(self, paths: Any, n_references: int | None, multichannel: bool | None) -> np.ndarray:
        """Set the numbers of channels and return the taps of the secondary path."""
        several = is_path_matrix(paths)
        if several and n_references is None:
            raise ValueError(
                f"{type(self).__name__} takes one channel: secondary_path must be one-dimensional, (taps,), or a system "
                "of one input and one output. Controllers with the setting n_references take several channels, for "
                "example kf_anc, kf_opc, kf_pb and FxLMS"
            )
        self.n_references = 1 if n_references is None else as_count(n_references, "n_references")
        self.multichannel = several or self.n_references > 1 if multichannel is None else multichannel
        self.n_microphones, self.n_loudspeakers = 1, 1
        if self.multichannel:
            secondary, self._path_fs = secondary_paths(paths)
            self.n_microphones, self.n_loudspeakers, _ = secondary.shape
            return secondary
        secondary = path_taps(paths, name="secondary_path")
        self._path_fs = sampling_rate(paths, name="secondary_path") if is_system(paths) else None
        return secondary

    def _checked_limiter(self, limiter: Any) -> Any:
        """Return None, a limiter, or a tuple of limiters."""
        if limiter is None or (not self.multichannel and isinstance(limiter, OutputLimiter)):
            return limiter
        if not self.multichannel:
            raise TypeError(f"limiter must be an OutputLimiter or None, got {limiter!r}")
        limiters = tuple(limiter) if isinstance(limiter, Sequence) else ()
        different = len(limiters) == self.n_loudspeakers == len({id(one) for one in limiters})
        if not different or not all(isinstance(one, OutputLimiter) for one in limiters):
            raise TypeError(
                f"limiter must be {self.n_loudspeakers} different OutputLimiters, one for each loudspeaker, got {limiter!r}"
            )
        return limiters

    def _checked_constraint(self, constraint: Constraints | None) -> Any:
        """Return a constraint, or a tuple of them; without one given, its factor is fixed at 1."""
        own: Any = constraint
        if constraint is None:
            own = OutputPowerConstraint(1.0)
            own.factor = 1.0
        if not self.multichannel:
            if isinstance(own, tuple):
                raise ValueError(f"rated power and constraint must be one for one loudspeaker, got {len(own)}")
            return own
        each = own if isinstance(own, tuple) else tuple(deepcopy(own) for _ in range(self.n_loudspeakers))
        if len(each) != self.n_loudspeakers:
            raise ValueError(
                f"rated power and constraint must be one, or one for each of the {self.n_loudspeakers} loudspeakers, "
                f"got {len(each)}"
            )
        return each

    def _each_loudspeaker(self, value: Any, name: str, check: Callable[[Any, str], float] = as_positive) -> Any:
        """Return a checked number; with several channels (J,), from one number or one for each loudspeaker."""
        return per_loudspeaker(value, self.n_loudspeakers, name, check) if self.multichannel else check(value, name)

    @property
    def limiter(self) -> Any:
        """Limiter of the control signal, or None; can be assigned, but not shared with another controller.

        With several channels it is a tuple, one for each loudspeaker. The disturbance is estimated from the output of
        the limiter, so the adaptation stays correct.
        """
        return self._limiter

    @limiter.setter
    def limiter(self, value: OutputLimiter | Sequence[OutputLimiter] | None) -> None:
        before, self._limiter = self._limiter, self._checked_limiter(value)
        self._use_limiter(before)

    @property
    def secondary_path_uncertainty(self) -> Any:
        """Uncertainty of the secondary path as it was stated; None: the path is exact.

        Whatever `paths.path_uncertainty` takes can be assigned. The weights then minimise
        :math:`E[(d - w^T x')^2] + E[(w^T x'')^2]` with :math:`x'' = W * x'` and the filter W of `paths.guard_filter`: an
        LMS algorithm gets a leak shaped in frequency, which also limits its step size, and a Kalman filter gets a
        second observation. An uncertainty can be assigned for KF-ANC, KF-OPC, the diagonal Kalman filter and the LMS
        family, with one channel or several; not for the fast-array filter, which takes one observation. `kf_pb` takes
        it as a setting, which cannot be changed, and learns the path.
        """
        return deepcopy(self._uncertainty)

    @secondary_path_uncertainty.setter
    def secondary_path_uncertainty(self, value: Any) -> None:
        if not self._takes_guard():
            raise ValueError(
                f"no secondary_path_uncertainty can be assigned to {self.name}: make it with "
                "kf_pb(..., secondary_path_uncertainty=...), or use KF-ANC, KF-OPC, the diagonal Kalman filter or an LMS "
                "algorithm"
            )
        taps = guard_filter(value, self._estimated_path())
        self._uncertainty = as_uncertainty(value)
        self._use_guard(taps)

    def _takes_guard(self) -> bool:
        """Return whether the algorithm's step takes account of an uncertain secondary path."""
        return False

    @property
    def secondary_path(self) -> np.ndarray:
        """Estimated secondary path s^, (n_path,), or with several channels (K, J, n_path); a copy.

        A new estimate can be assigned between two samples, also during a run: taps or an FIR system, or paths with the
        same channels, no longer than the present estimate. The stored references are filtered again with it, so the
        next update knows only the new path. The weights stay, and the control signal does not jump. A Kalman filter's
        covariance grows, because its weights belong to the old path. Running powers forget the old path within their
        memory. KF-PB begins to learn the plant anew, around the new path.
        """
        return self._estimated_path().copy()

    @secondary_path.setter
    def secondary_path(self, path: Any) -> None:
        before, after = self.secondary_path, self._checked_estimate(path)
        guard_filter(self._uncertainty, after)  # raises if none can be made, before anything changes
        self._estimated_path()[:] = after
        if self._uncertainty is None or not self._takes_guard():
            self._filter_again()
        else:  # measured paths, for example, have another distance from the new path
            self.secondary_path_uncertainty = self._uncertainty
        self._after_new_path(before)

    def _checked_estimate(self, path: Any) -> np.ndarray:
        """Return the taps of a new estimate, filled with zeros to the length of the present one."""
        present = self._estimated_path().shape
        if self.multichannel:
            taps, rate = secondary_paths(path, name="secondary_path")
        else:
            taps = path_taps(path, name="secondary_path")
            rate = sampling_rate(path, name="secondary_path") if is_system(path) else None
        if taps.shape[:-1] != present[:-1]:
            raise ValueError(
                f"secondary_path must have the channels (microphones, loudspeakers) = {present[:-1]} of the present "
                f"estimate, got {taps.shape[:-1]}: make a new controller for other channels"
            )
        if taps.shape[-1] > present[-1]:
            raise ValueError(
                f"secondary_path must have at most the {present[-1]} taps of the present estimate, got "
                f"{taps.shape[-1]}: make the controller with an estimate filled with zeros to the longest path"
            )
        if self._path_fs is not None:
            require_rates(self._path_fs, {"new secondary path": rate})
        return np.pad(taps, [(0, 0)] * (taps.ndim - 1) + [(0, present[-1] - taps.shape[-1])])

    def _after_new_path(self, before: np.ndarray) -> None:
        """Adapt what the algorithm knows to the new estimate; `before` is the last one, of the same shape."""

    def _variance_by_new_path(self, before: np.ndarray) -> float:
        """Return the variance of each weight after a new path: they are wrong by the share by which the path changed."""
        after, w = self._estimated_path(), self.weights
        energy = max(np.sum(before**2), np.sum(after**2))
        return float(np.sum((after - before) ** 2) / energy * np.mean(w**2)) if energy > 0.0 else 0.0

    @property
    def weights(self) -> np.ndarray:
        """Control filter w, (L,), or with several channels (J, I, L), newest-sample tap first; a copy."""
        raise NotImplementedError

    @property
    def control_filter(self) -> np.ndarray:
        """Control filter that generates y, of the shape of `weights`; a copy."""
        return self.weights

    @property
    def rated_power(self) -> Any:
        """Rated output power of the controller, or of each loudspeaker, (J,); None if it has none.

        A controller that has a rated power takes another one at any time.
        """
        return self._read_rated_power()

    @rated_power.setter
    def rated_power(self, value: Any) -> None:
        if self.rated_power is None:
            raise ValueError(
                f"{self.name} has no rated power that could be changed; kf_opc, kf_pb and MOVFxLMS, for example, have one"
            )
        self._take_rated_power(self._each_loudspeaker(value, "rated_power"))

    def _read_rated_power(self) -> Any:
        return self._of_constraint("rated_power", self._own_constraint) if self._constrained else None

    def _take_rated_power(self, value: Any) -> None:
        """Use another rated power, a number or (J,)."""
        for constraint, power in zip(np.atleast_1d(self._own_constraint), np.atleast_1d(value), strict=True):
            constraint.rated_power = power

    @property
    def constraint(self) -> Any:
        """Constraint that computes the powers and the factor; without a rated power its factor is fixed at 1.

        With several channels it is a tuple, one for each loudspeaker.
        """
        return self._own_constraint

    @property
    def constraint_factor(self) -> Any:
        """Constraint factor of the last sample; with several channels (J,)."""
        return self._of_constraint("factor")

    @property
    def disturbance_power(self) -> Any:
        """Running power of the disturbance estimate (eq. 10); with several channels (J,), summed over microphones."""
        return self._of_constraint("disturbance_power")

    @property
    def secondary_path_gain(self) -> Any:
        """Running secondary-path gain (eq. 11); NaN until the reference has energy.

        With several channels (J,): E[x'^2] summed over microphones and references, over E[x^2] summed over references.
        """
        gain = self._of_constraint("secondary_path_gain")
        return np.array(gain, dtype=np.float64) if self.multichannel else np.nan if gain is None else gain

    def _of_constraint(self, name: str, constraint: Any = None) -> Any:
        """Return a number of the constraint, or of each of them, (J,)."""
        own = self.constraint if constraint is None else constraint
        return np.array([getattr(one, name) for one in own]) if isinstance(own, tuple) else getattr(own, name)

    def __repr__(self) -> str:
        limiters = [] if self.limiter is None else list(np.ravel(self.limiter))
        parts = [
            *(self._channel_counts() if self.multichannel else []),
            f"{self.n_taps} taps",
            *([] if self.rated_power is None else [f"rated power {listed(self.rated_power, 'g')}"]),
            f"constraint factor {listed(self.constraint_factor, '.3g')}",
            *([f"limiter of rated power {listed([one.rated_power for one in limiters], 'g')}"] if limiters else []),
        ]
        return f"<{self.name}: {', '.join(parts)}>"

    def _channel_counts(self) -> list[str]:
        counts = {
            "microphone": self.n_microphones,
            "loudspeaker": self.n_loudspeakers,
            "reference": self.n_references,
        }
        return [f"{count} {what}{'s' if count > 1 else ''}" for what, count in counts.items()]

    def process(self, references: Any, errors: Any, *, adapt: Any = True, out: np.ndarray | None = None) -> np.ndarray:
        """Return the control signals of a block of samples, and adapt to its errors; see `BlockProcessing.process`."""
        looped = self.looped()
        if looped is None:
            return super().process(references, errors, adapt=adapt, out=out)
        x = self._block_signal(references, "references", self.n_references)
        e = self._block_signal(errors, "errors", self.n_microphones)
        require_one_length(x, e)
        n_samples = x.shape[-1]
        flags = adapt_flags(adapt, n_samples)
        y = output_array(out, (self.n_loudspeakers, n_samples) if self.multichannel else x.shape)
        rows = [np.atleast_2d(signal) for signal in (x, e, y)]
        done = 0
        while done < n_samples:
            end = min(done + LONGEST_CALL, n_samples)
            with looped.in_use:
                status, done = process(looped.steps, rows[0], rows[1], rows[2], flags, done, end)
            if done < end:
                self._raise_refusal(x[..., done], e[..., done], done, status)
        return y

    def _block_signal(self, value: Any, name: str, n_channels: int) -> np.ndarray:
        """Return a block of samples, (n_samples,) or (n_channels, n_samples)."""
        signal = block_signal(value, name)
        require_channels(signal, name, self.multichannel, n_channels)
        return np.ascontiguousarray(signal)

    def _raise_refusal(self, reference: Any, error: Any, sample: int, status: int) -> None:
        """Raise `RefusedUpdate` with the reason that the step gives when it is called again: it has changed nothing."""
        try:
            if status == REFUSED_REFERENCE:
                self.control_signal(reference)
            self.update(error)
        except ValueError as reason:
            raise RefusedUpdate(str(reason), sample) from reason
        raise RefusedUpdate(NO_SOLUTION, sample)

    def listen(self, references: np.ndarray, errors: np.ndarray, *, adapt: Any = True) -> None:
        """Follow the noise before the control is switched on: delay lines and powers advance, the weights stay.

        Parameters
        ----------
        references : ndarray, shape (n_samples,) or (I, n_samples)
            Reference.
        errors : ndarray, shape (n_samples,) or (K, n_samples)
            Signals of the error microphones while the loudspeakers are silent.
        adapt : bool or ndarray of shape (n_samples,), default True
            Whether to follow a sample; the others only enter the delay lines.
        """
        if self.multichannel:
            x, e = self._channel_signals(references, errors)
        else:
            x = as_signal(references, "references")
            e = as_signal(errors, "errors", length=x.size)
        taken = self._listen(x, e, adapt_flags(adapt, len(x)))
        if taken < len(x):
            raise refused_while_listening(OVERFLOW, taken)

    def _channel_signals(self, references: Any, errors: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return references and errors with a sample in each row."""
        x, e = np.atleast_2d(as_channels(references, "references")), np.atleast_2d(as_channels(errors, "errors"))
        if (len(x), len(e)) != (self.n_references, self.n_microphones) or x.shape[1] != e.shape[1]:
            raise ValueError(
                f"references must be (I, n_samples) and errors (K microphones, n_samples) with I = {self.n_references}, "
                f"K = {self.n_microphones}, got {x.shape} and {e.shape}"
            )
        return np.ascontiguousarray(x.T), np.ascontiguousarray(e.T)

    @property
    def _powers_fs(self) -> float:
        """Sample rate in Hz of the power estimates."""
        return np.ravel(self.constraint)[0].fs

    def require_sample_rate(self, fs: float) -> None:
        """Raise ValueError if the secondary path, power estimates or limiter are for another rate than `fs` in Hz."""
        limiters = [] if self.limiter is None else list(np.ravel(self.limiter))
        named = {f"limiter {j}" if self.multichannel else "limiter": one.fs for j, one in enumerate(limiters)}
        require_rates(
            fs,
            {
                "secondary path": self._path_fs,
                "power memory": None if self.rated_power is None else self._powers_fs,
            }
            | named,
        )


def calls_of(kind: type) -> tuple[Any, Any]:
    """Return a class's two methods per sample; if a subclass overrides one, Python must call it."""
    return kind.control_signal, kind.update  # type: ignore[attr-defined]


def refused_while_listening(reason: str, sample: int) -> ValueError:
    """Return the error of a sample that was refused before the control was switched on."""
    refused = ValueError(reason)
    refused.add_note(f"in sample {sample} of those listened to")
    return refused


def listed(values: Any, form: str) -> str:
    """Return a number, or several after each other, as text."""
    return ", ".join(format(value, form) for value in np.ravel(values))
