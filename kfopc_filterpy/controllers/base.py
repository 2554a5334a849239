"""The controller protocol, the base class of what wraps a controller, and what a limiter and a run ask of both."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from functools import wraps
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from .._types import NumberOrArray, PerLoudspeaker
from .._validate import as_positive, same_rate
from ..checkpoint import Checkpointed
from ..core.block import InUse
from ..core.run_loop import Steps
from ..power.constraint import Constraints, OutputPowerConstraint
from .making import require_rated_power
from .processing import BlockProcessing


@runtime_checkable
class Controller(Protocol):
    """Interface that `simulate` drives, with two calls per sample. A user-defined controller needs nothing else.

    Optional attributes: `constraint_factor`, `disturbance_power` and `secondary_path_gain` are recorded if present, and
    `weights`, (L,), if requested. `name` names the result. `listen(references, errors)` follows the noise before the
    control is switched on. If a controller has `n_references`, `n_loudspeakers` or `n_microphones`, a run with other
    numbers of channels is refused before it begins; otherwise the first sample shows the mismatch.
    """

    def control_signal(self, reference: NumberOrArray) -> NumberOrArray:
        """Return the control signal y(n) for the newest reference sample x(n), from the weights of the last sample."""
        ...

    def update(self, error: NumberOrArray) -> None:
        """Adapt to the error e(n) = d(n) - (s * y_amp)(n) that this control signal left."""
        ...


def constraint_for(
    rated_power: PerLoudspeaker | None, constraint: Constraints, fs: float | None, path_fs: float | None
) -> Any:
    """Return a new constraint for a controller: a copy of the one given, or one with default settings.

    Its sample rate is `fs`, or that of the path, in Hz. Several rated powers or constraints, one for each loudspeaker,
    give a tuple.
    """
    require_rated_power(rated_power, constraint)
    if constraint is None:
        rate, powers = as_run_rate(fs, path_fs), np.asarray(rated_power)
        if powers.ndim == 1:
            return tuple(OutputPowerConstraint(power, fs=rate) for power in powers)
        return OutputPowerConstraint(rated_power, fs=rate)  # type: ignore[arg-type]
    if fs is not None:
        raise ValueError("fs belongs to rated_power: a constraint has its own, OutputPowerConstraint(..., fs=...)")
    each = constraint if isinstance(constraint, list | tuple) else (constraint,)
    for one in each:
        if not isinstance(one, OutputPowerConstraint):
            raise TypeError(f"constraint must be an OutputPowerConstraint or None, got {one!r}")
    return deepcopy(tuple(each) if isinstance(constraint, list | tuple) else constraint)


def as_run_rate(fs: float | None, path_fs: float | None) -> float:
    """Return the sample rate in Hz of a law that depends on time: `fs`, or that of the secondary path."""
    if fs is None and path_fs is None:
        raise ValueError(
            "fs must be given, the sample rate in Hz: taps have none; or give a Plant, a system or a Recording as secondary"
        )
    if fs is None:
        return path_fs  # type: ignore[return-value]
    rate = as_positive(fs, "fs", unit="Hz")
    if path_fs is not None and not same_rate(path_fs, rate):
        raise ValueError(f"fs is {rate:g} Hz, but secondary brings {path_fs:g} Hz: leave out fs, or resample the path")
    return rate


def checked_controller(controller: Any) -> Any:
    """Return a controller, or raise TypeError if it is none."""
    if isinstance(controller, type) or not isinstance(controller, Controller):
        raise TypeError(f"controller must have control_signal(reference) and update(error), got {controller!r}")
    return controller


def differing_counts(controller: Any, **counts: int) -> Iterator[tuple[str, int]]:
    """Yield the numbers of channels that a controller states, by name, and that differ from these."""
    for name, count in counts.items():
        own = getattr(controller, name, count)
        if own != count:
            yield name, own


def as_forgetting(value: Any) -> float:
    """Return a forgetting factor, checked."""
    forgetting = as_positive(value, "forgetting")
    if forgetting > 1.0:
        raise ValueError(f"forgetting must be 1 at most, got {forgetting:g}: 1 forgets nothing")
    return forgetting


def require_rates(fs: float, rates: Mapping[str, float | None]) -> None:
    """Raise ValueError if a controller, or a named part of it, is for another sample rate than the run's `fs` in Hz."""
    for name, rate in rates.items():
        if rate is not None and not same_rate(rate, fs):
            raise ValueError(
                f"the {name} is for {rate:g} Hz, but the run is at {fs:g} Hz: make it with the fs of the run"
            )


def listening(controller: object) -> Any:
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


def _alone(step: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method of a wrapper that a second thread cannot enter."""

    @wraps(step)
    def guarded(wrapper: Any, *arguments: Any, **named: Any) -> Any:
        with wrapper.in_use:
            return step(wrapper, *arguments, **named)

    return guarded


class WrappedController(BlockProcessing, Checkpointed):
    """Base class of a controller that wraps another one and passes on its attributes."""

    secondary = passed_on("secondary", "Estimated secondary path of the inner controller; can be assigned.")
    secondary_path_uncertainty = passed_on(
        "secondary_path_uncertainty", "Uncertainty of that path; can be assigned if the inner controller's can."
    )
    rated_power = passed_on("rated_power", "Rated power of the inner controller; can be assigned if that has one.")
    limiter = passed_on("limiter", "Limiter of the inner controller; can be assigned if the inner controller's can.")

    def __init_subclass__(cls) -> None:
        """Refuse a second thread in the steps of every wrapper."""
        for name in {"control_signal", "update", "take_error", "listen"} & vars(cls).keys():
            setattr(cls, name, _alone(vars(cls)[name]))

    def __init__(self, controller: Controller, what: str) -> None:
        self.controller = checked_controller(controller)
        self.name = f"{getattr(controller, 'name', type(controller).__name__)} {what}"

    @property
    def in_use(self) -> InUse:
        """Context that refuses a second thread: the inner controller's, or the wrapper's own."""
        inner = getattr(self.controller, "in_use", None)
        return inner if isinstance(inner, InUse) else self.__dict__.setdefault("_in_use", InUse())

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the context, which belongs to the threads of this process."""
        return {name: value for name, value in vars(self).items() if name != "_in_use"}

    def __getattr__(self, name: str) -> Any:
        """Return any other attribute of the inner controller, except special methods such as those for copies."""
        if name == "controller" or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.controller, name)

    @_alone
    def update(self, error: NumberOrArray) -> None:
        """Pass the error e(n) to the controller's `update`."""
        self.controller.update(error)

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
    owner: Any = None  # what must exist meanwhile


def calls_of(kind: type) -> tuple[Any, Any]:
    """Return a class's two methods per sample; if a subclass overrides one, Python must call it."""
    return kind.control_signal, kind.update  # type: ignore[attr-defined]


def listed(values: ArrayLike, form: str) -> str:
    """Return a number, or several after each other, as text."""
    return ", ".join(format(value, form) for value in np.ravel(values))
