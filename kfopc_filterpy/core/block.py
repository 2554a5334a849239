"""A controller of the core: its plan, its block of memory, and the named fields of that block as numpy arrays."""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .library import Field, Library, at_cache_line, constant, fields_of, load

_STATE, _SETTING, _SCRATCH = range(3)
_PRECISIONS: dict[str, np.dtype[Any]] = {"double": np.dtype(np.float64), "float": np.dtype(np.float32)}
_VIEW_PLACES = 136  # of `anc_view` in anc.h
SLACK = 64  # of delay lines, see signals.c
_EACH = ("", "loudspeakers", "microphones")
_step = ctypes.PYFUNCTYPE  # keeps the interpreter's lock

LOUDEST, LOUDEST_LEARNT = constant("loudest"), constant("loudest_learnt")  # limits, see anc.h


def reasons(real: str = "double") -> tuple[str, ...]:
    """Return why a step was refused, by its answer (`anc_answer` in anc.h), for a type of numbers."""
    names = ("loudest", "loudest_reference", "loudest_learnt", "longest_step")
    loudest, reference, learnt, step = (f"1e{math.log10(constant(name, real)):.0f}" for name in names)
    return (
        "",
        f"the reference is too loud, above {reference} divided by the gain of the secondary path: scale the signals",
        f"the error is too loud, above {loudest}: scale the signals",
        f"the disturbance estimate e + s^ * y is too loud, above {loudest}, or {learnt} with an internal model: scale the "
        "signals",
        f"the step of the weights is too large, above {step}: use a smaller step size",
        "the covariance P is too large: S = x' P x' + q could overflow",
    )


REASONS = reasons()


class _Plan(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int32) for name in ("scenarios", "microphones", "loudspeakers", "references")),
        *((name, ctypes.c_int32) for name in ("taps", "path_taps", "guard_taps", "modelled")),
        *((name, ctypes.c_void_p) for name in ("power_windows", "limiter_windows", "path", "guard", "settings")),
    ]


class _Setting(ctypes.Structure):
    _fields_ = [
        ("name", ctypes.c_char_p),
        *((name, ctypes.c_double) for name in ("least", "most")),
        ("each", ctypes.c_int),
    ]


class _Algorithm(ctypes.Structure):
    _fields_ = [
        ("name", ctypes.c_char_p),
        ("settings", ctypes.POINTER(_Setting)),
        ("unfiltered", ctypes.c_int32),
        *((name, ctypes.c_void_p) for name in ("layout", "start", "control_signal", "update", "listen")),
    ]


class Setting(NamedTuple):
    """A setting of an algorithm: its name, and who has one of its own."""

    name: str
    each: str  # "" (one for all), "loudspeakers" or "microphones"


class Algorithm:
    """An algorithm of the core.

    Parameters
    ----------
    name : str
        Name in C, without the prefix ``anc_``.
    real : {"double", "float"}
        Type of the core's numbers.

    Raises
    ------
    ValueError
        If the core has no algorithm of that name.
    """

    def __init__(self, name: str, real: str = "double") -> None:
        self.name, self.real, self.precision = name, real, _PRECISIONS[real]
        self.library: Library = load(real)
        try:
            self._struct = _Algorithm.in_dll(self.library.held, f"anc_{name}")
        except ValueError:
            raise ValueError(f"the core has no algorithm anc_{name}") from None
        self.pointer = ctypes.addressof(self._struct)
        self.settings: list[Setting] = Algorithm(name).settings if real == "float" else self._settings()

    def _settings(self) -> list[Setting]:
        """Return the settings of the table; one for float has other sizes than `_Setting`."""
        settings: list[Setting] = []
        while (one := self._struct.settings[len(settings)]).name is not None:
            settings.append(Setting(one.name.decode(), _EACH[one.each]))
        return settings

    @property
    def steps(self) -> tuple[int, int, int]:
        """Addresses of the functions `control_signal`, `update` and `anc_take_error`."""
        take_error = ctypes.cast(self.library.held.anc_take_error, ctypes.c_void_p).value
        return self._struct.control_signal, self._struct.update, take_error or 0

    def shapes(self, shape: Shape) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the fields of a block, by name."""
        arrays = {name: np.array(getattr(shape, name), np.int32) for name in ("power_windows", "limiter_windows")}
        return {field.name: field.shape for field in self.fields(_plan_of(shape, arrays))}

    def fields(self, plan: _Plan) -> list[Field]:
        """Return the fields of the block of a plan."""
        return fields_of(self.library.held.anc_describe, self.pointer, ctypes.byref(plan))


@dataclass(frozen=True)
class Shape:
    """The numbers that decide the size of a block; see `anc_plan` in anc.h."""

    microphones: int
    loudspeakers: int
    references: int
    taps: int
    path_taps: int
    guard_taps: int = 0
    power_windows: tuple[int, ...] = ()  # of every loudspeaker of every scenario
    limiter_windows: tuple[int, ...] = ()
    scenarios: int = 1
    modelled: int = 0  # 1: the last of the references, one for each microphone, come from the internal model

    def count(self, each: str) -> int:
        """Return the number of "loudspeakers" or "microphones", 1 for ""."""
        return getattr(self, each) if each else 1


def _plan_of(shape: Shape, arrays: dict[str, np.ndarray]) -> _Plan:
    counts = {name: value for name, value in asdict(shape).items() if isinstance(value, int)}
    pointers = {name: array.ctypes.data if array.size else None for name, array in arrays.items()}
    return _Plan(**counts, **pointers)


class InUse:
    """A context that refuses to be entered by a second thread."""

    def __init__(self) -> None:
        lock = threading.RLock()
        self._acquire, self.leave = lock.acquire, lock.release

    def enter(self) -> None:
        """Enter, or raise RuntimeError if another thread has."""
        if not self._acquire(False):
            raise RuntimeError("this controller is in use by another thread: give each thread a controller of its own")

    def __enter__(self) -> None:
        self.enter()

    def __exit__(self, *_: object) -> None:
        self.leave()


class Block:
    """A controller's memory. A copy of `memory` is a copy of the controller; `copy.deepcopy` makes one.

    Parameters
    ----------
    algorithm : Algorithm
        Its steps.
    shape : Shape
        Its size.
    path : ndarray, shape (K, J, M)
        Estimated secondary paths.
    settings : mapping of str to float or sequence of J or K
        Settings, by name.
    guard : ndarray, shape (G,), optional
        Filter W, with guard_taps.

    Attributes
    ----------
    fields : dict of ndarray
        Views of the memory, by name, four axes each; see `layout_signals` in signals.c.
    states : list of str
        Names of those that a step changes and a next one needs.
    scratch : list of str
        Names of those that no next step needs.
    """

    def __init__(
        self,
        algorithm: Algorithm,
        shape: Shape,
        *,
        path: NDArray[np.float64] | None = None,
        settings: Mapping[str, Any] | None = None,
        guard: NDArray[np.float64] | None = None,
    ) -> None:
        self.algorithm, self.shape = algorithm, shape
        self._open(path, settings, guard)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy, a pickle or a file has: the plan, the settings, the memory, and where its fields are."""
        with self.in_use:
            return {
                "algorithm": self.algorithm.name,
                "real": self.algorithm.real,
                "shape": asdict(self.shape),
                "settings": {name: self.fields[name].ravel().tolist() for name, _ in self.algorithm.settings},
                "layout": self._layout,
                "memory": self.saved(),
            }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Go on from what `__getstate__` returned, if the core still lays out the fields like that."""
        self.algorithm, self.shape = Algorithm(state["algorithm"], state["real"]), Shape(**state["shape"])
        self._open(None, state["settings"], None, state)

    def _open(self, path: Any, settings: Any, guard: Any, state: Mapping[str, Any] | None = None) -> None:
        """Open the memory: fresh, or with the layout and the bytes of a state."""
        algorithm, shape = self.algorithm, self.shape
        keep = self._plan_arrays(path, settings, guard)
        self._require_sizes(keep, state is None)
        self.in_use = InUse()
        self.enter, self.leave = self.in_use.enter, self.in_use.leave
        self._library: Any = algorithm.library.held
        plan = _plan_of(shape, keep)
        described = algorithm.pointer, ctypes.byref(plan)
        size = self._library.anc_size(*described)
        if not size:
            raise ValueError(f"a controller of this size cannot be made: {shape}")
        layout = algorithm.fields(plan)
        self._layout = {name: [role, kind, offset, *axes] for name, role, kind, offset, axes in layout}
        self.memory = at_cache_line(size)
        if state is not None:
            if state["layout"] != self._layout or state["memory"].shape != (size,):
                raise ValueError(
                    f"the core lays out the fields of {algorithm.name} in another way than when it was saved"
                )
            self.memory[:] = state["memory"]
        self._view = (ctypes.c_void_p * _VIEW_PLACES)()
        self.address = ctypes.addressof(self._view)
        if not self._library.anc_open(*described, self._view, self.memory.ctypes.data, size, state is None):
            raise ValueError(f"a setting or a path of {algorithm.name} is out of its range: {settings}")
        self._name_fields(layout)
        self._bind_steps()

    def _name_fields(self, layout: list[Field]) -> None:
        self.fields: dict[str, NDArray[Any]] = {}
        names: dict[int, list[str]] = {_STATE: [], _SETTING: [], _SCRATCH: []}
        for name, role, kind, offset, axes in layout:
            dtype = (self.algorithm.precision, np.dtype(np.int32))[kind]
            self.fields[name] = np.frombuffer(self.memory, dtype, int(np.prod(axes)), offset).reshape(axes)
            names[role].append(name)
        self.states, self.scratch = names[_STATE], names[_SCRATCH]

    def _bind_steps(self) -> None:
        """Make the arrays of a sample, and the steps' functions, whose arguments are always the same."""
        shape, pointer = self.shape, ctypes.c_void_p
        given = shape.references - shape.modelled * shape.microphones
        counts = (given, shape.scenarios * shape.loudspeakers, shape.scenarios * shape.microphones)
        self.reference, self.control_signal, self.error = (np.zeros(n, self.algorithm.precision) for n in counts)
        control, update, take_error = self.algorithm.steps
        self._control = _step(ctypes.c_int, pointer, pointer, pointer)(control)
        self._update, self._take_error = (_step(ctypes.c_int, pointer, pointer)(one) for one in (update, take_error))
        x, y, e = (array.ctypes.data for array in (self.reference, self.control_signal, self.error))
        self._emitted, self._updated = (self.address, x, y), (self.address, e)

    def _plan_arrays(self, path: Any, settings: Any, guard: Any) -> dict[str, np.ndarray]:
        """Return the arrays that a plan points to."""
        shape, numbers, real = self.shape, dict(settings or {}), self.algorithm.precision
        own = self.algorithm.settings if numbers else []
        values = [np.broadcast_to(numbers.pop(name), shape.count(each)) for name, each in own]
        if numbers:
            raise TypeError(f"{self.algorithm.name} has no setting {', '.join(numbers)}")
        return {
            "power_windows": np.array(shape.power_windows, np.int32),
            "limiter_windows": np.array(shape.limiter_windows, np.int32),
            "path": np.array([] if path is None else path, real, order="C"),
            "guard": np.array([] if guard is None else guard, real),
            "settings": np.concatenate([*values, np.zeros(1)]).astype(real) if settings else np.array([]),
        }

    def _require_sizes(self, arrays: Mapping[str, np.ndarray], fresh: bool) -> None:
        """Raise ValueError if the core would see another shape, or read beyond an array."""
        shape, loudspeakers = self.shape, self.shape.scenarios * self.shape.loudspeakers
        if any(value >= 2**31 for value in asdict(shape).values() if isinstance(value, int)):
            raise ValueError(f"a controller of this size cannot be made: {shape}")
        sizes: dict[str, tuple[int, ...]] = dict.fromkeys(("power_windows", "limiter_windows"), (0, loudspeakers))
        if fresh:
            if self.algorithm.settings and not arrays["settings"].size:
                raise ValueError(
                    f"{self.algorithm.name} needs its settings {[name for name, _ in self.algorithm.settings]}"
                )
            sizes |= {"path": (shape.microphones * shape.loudspeakers * shape.path_taps,), "guard": (shape.guard_taps,)}
        for name, expected in sizes.items():
            if arrays[name].size not in expected:
                raise ValueError(f"{name} of {arrays[name].size} numbers does not fit {shape}")

    def saved(self) -> NDArray[np.uint8]:
        """Return a copy of the memory, with zeros for what no next step needs: equal states have equal bytes."""
        memory = self.memory.copy()
        for field in map(self.fields.__getitem__, self.scratch):
            begin = field.ctypes.data - self.memory.ctypes.data
            memory[begin : begin + field.nbytes] = 0
        return memory

    def latest(self, name: str) -> NDArray[np.float64]:
        """Return a field, or of delay lines the samples that they keep, newest first; a view."""
        field = self.fields[name]
        if f"{name}_at" not in self.fields:
            return field
        at, taps = self.fields[f"{name}_at"].item(), (field.shape[-1] - SLACK) // 2  # as `layout_lines` makes them
        return field[..., at : at + taps]

    def fresh(self, shape: Shape, guard: NDArray[np.float64] | None = None) -> Block:
        """Return a block that has heard nothing, with the secondary path and the settings of this one."""
        own = {name: self.fields[name].ravel() for name, _ in self.algorithm.settings}
        settings = {name: own[name] if each else own[name][0] for name, each in self.algorithm.settings}
        return Block(self.algorithm, shape, path=self.fields["secondary_path"][0], settings=settings, guard=guard)

    def remade(self, shape: Shape, guard: NDArray[np.float64] | None = None) -> Block:
        """Return a block of another shape that goes on from this one: fields of the same name and shape are copied."""
        other = self.fresh(shape, guard)
        for name, field in self.fields.items():
            if other.fields[name].shape == field.shape and name != "guard":
                other.fields[name][:] = field
        return other

    def with_guard(self, guard: NDArray[np.float64] | None) -> Block:
        """Return a block with another guard, or none, that has heard what this one has."""
        other = self.remade(replace(self.shape, guard_taps=0 if guard is None else guard.size), guard)
        other.refilter()
        return other

    def emit(self) -> int:
        """Take `reference`, set `control_signal`, and return the answer, 0 if all is well; enter `in_use` before."""
        return self._control(*self._emitted)

    def update(self) -> int:
        """Adapt to `error` and return the answer, 0 if all is well; enter `in_use` before."""
        return self._update(*self._updated)

    def take_error(self) -> int:
        """Take `error` without adapting to it, and return the answer, 0 if all is well; enter `in_use` before."""
        return self._take_error(*self._updated)

    def listen(
        self, references: NDArray[np.float64], errors: NDArray[np.float64], adapting: NDArray[np.bool_]
    ) -> tuple[int, int]:
        """Follow (n, I) and (n, K) while the loudspeakers are silent.

        Return the number of samples before a refusal, and the answer, 0 if all is well.
        """
        arrays, answer = [np.ascontiguousarray(array) for array in (references, errors, adapting)], ctypes.c_int32()
        signals = (array.ctypes.data for array in arrays)
        with self.in_use:
            listen = self._library.anc_listen
            done = listen(self.algorithm.pointer, self._view, *signals, len(arrays[0]), ctypes.byref(answer))
        return done, answer.value

    def refilter(self) -> None:
        """Filter the stored references again, after the path or the guard has changed."""
        self._library.anc_refilter(self._view)
