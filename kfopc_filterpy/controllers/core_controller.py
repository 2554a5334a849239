"""Controllers of the core: their signals, weights and powers are in one block of memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from .._validate import as_number, as_positive, per_channel
from ..core.block import Algorithm, Block, Shape, reason_of
from ..core.own import load_algorithm as load_algorithm
from ..core.run_loop import Steps
from ..power.amplifiers import Amplifier, amplifier_models
from ..power.constraint import NUMBERS
from ..power.limiter import OutputLimiter
from .base import LONGEST_CALL, FilteredReferenceController, Looped, calls_of, refused_while_listening
from .channel_samples import channel_sample

# What a run records of each loudspeaker, by its name in the constraint's numbers.
RECORDED = {"constraint_factor": "factor", "disturbance_power": "power", "secondary_path_gain": "gain"}

Limiters = OutputLimiter | Sequence[OutputLimiter] | None


class CoreController(FilteredReferenceController):
    """Base class of the controllers whose algorithm is in the core, for one channel and several.

    A subclass names its `algorithm` in C, the `checks` of its settings, and hands these over by their names in C. For an
    algorithm of your own see `load_algorithm`.

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter, or of each of them.
    secondary_path : array_like, shape (taps,) or (K, J, taps), or control system
        Estimated secondary path, taps or an FIR system; with channel axes, those from loudspeaker j to microphone k.
    settings : mapping
        Settings of the algorithm, as a user gave them: a number each, or also (J,) or (K,) where each
        loudspeaker or microphone has its own.
    n_references : int, default 1
        Number of references I; None: the algorithm takes one channel only.
    multichannel : bool, optional
        Whether signals have a channel axis; by default if the secondary path has channel axes or there are several
        references.
    amplifier : callable or sequence of J of them, optional
        Known amplifier: the disturbance is then estimated with s^ * amplifier(y), not s^ * y.
    constraint : OutputPowerConstraint or tuple of J of them, optional
        Constraint that computes the powers and the factor; by default one whose factor is fixed at 1.
    limiter : OutputLimiter or sequence of J of them, optional
        Limiter of the control signal, not shared with another controller.

    Attributes
    ----------
    algorithm : str or Algorithm
        Name of an algorithm of the core, or what `load_algorithm` returns. An attribute of the class.
    checks : mapping of str to callable
        Functions of a value and its name that return a setting as a float, or raise ValueError; settings without one
        must be positive. An attribute of the class.

    Raises
    ------
    ValueError
        A setting that its check refuses or that is out of the range that the C file states, fewer than one tap or
        reference, a path that is not FIR.
    TypeError
        A setting that the algorithm does not have, or a limiter that is not an `OutputLimiter`.

    Examples
    --------
    >>> from kfopc_filterpy.controllers import CoreController
    >>> class PlainFxLMS(CoreController):
    ...     name, algorithm = "plain FxLMS", "fxlms"
    ...
    ...     def __init__(self, n_taps, secondary_path, *, step_size):
    ...         super().__init__(n_taps, secondary_path, settings={"step_size": step_size})
    >>> controller = PlainFxLMS(4, secondary_path=[1.0], step_size=0.1)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)  # e = d: nothing is cancelled yet
    >>> float(controller.weights[0])  # 0.1 * 2 * 1
    0.2
    """

    algorithm: str | Algorithm
    checks: ClassVar[Mapping[str, Callable[[Any, str], float]]] = {}  # of settings that need not be positive
    _block: Block | None = None

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        settings: Mapping[str, Any],
        n_references: int | None = 1,
        multichannel: bool | None = None,
        amplifier: Amplifier | Sequence[Amplifier] | None = None,
        constraint: Any = None,
        limiter: Limiters = None,
    ) -> None:
        self._settings = dict(settings)
        super().__init__(
            n_taps,
            secondary_path,
            n_references=n_references,
            multichannel=multichannel,
            amplifier=amplifier,
            constraint=constraint,
            limiter=limiter,
        )

    def _begin(self, secondary: np.ndarray, amplifier: Any) -> None:
        models = amplifier_models(amplifier, self.n_loudspeakers)
        algorithm = self._algorithm()
        block = Block(
            algorithm,
            self._needed_shape(secondary.shape[-1], guard_taps=0),
            path=secondary.reshape(self.n_microphones, self.n_loudspeakers, -1),
            settings=self._checked_settings({one.name: one.each for one in algorithm.settings}),
        )
        block.fields["amplifier"][0, 0] = models.view(np.float64).reshape(self.n_loudspeakers, -1)
        self._use_block(block)

    def _checked_settings(self, each: Mapping[str, str]) -> dict[str, Any]:
        """Return the settings, checked; `each` says which of them every loudspeaker or microphone has."""
        if set(self._settings) != set(each):
            raise TypeError(f"{self.name} has the settings {sorted(each)}, got {sorted(self._settings)}")
        checked: dict[str, Any] = {}
        for name, value in self._settings.items():
            check = self.checks.get(name, as_positive)
            if each[name] and self.multichannel:
                count = getattr(self, f"n_{each[name]}")
                checked[name] = per_channel(value, count, each[name], name, check)
            else:
                checked[name] = check(value, name)
        return checked

    def _algorithm(self) -> Algorithm:
        return Algorithm(self.algorithm) if isinstance(self.algorithm, str) else self.algorithm

    def _needed_shape(self, path_taps: int, guard_taps: int) -> Shape:
        """Return the shape of a block for the present limiter and constraint."""
        return Shape(
            self.n_microphones,
            self.n_loudspeakers,
            self.n_references,
            self.n_taps,
            path_taps,
            guard_taps,
            tuple(one.state.window.shape[1] for one in self._each(self._own_constraint)),
            tuple(one.state.laps.shape[1] - 1 for one in self._each(self._limiter)),
        )

    @staticmethod
    def _each(value: Any) -> tuple[Any, ...]:
        """Return the limiters or constraints of the loudspeakers."""
        return () if value is None else value if isinstance(value, tuple) else (value,)

    def _use_block(self, block: Block) -> None:
        """Go on in a block, into which the constraints and limiters move."""
        self._memory, self._shape = block.memory, block.shape
        fields = block.fields
        for j, constraint in enumerate(self._each(self._own_constraint)):
            window = _rows(fields["power_window"][0, j], block.shape.power_windows[j])
            constraint.live_in(fields["powers"][0, j], window, fields["constraint"][0, 0, j])
        for j, limiter in enumerate(self._each(self._limiter)):
            limiter.live_in(fields["limiter"][0, 0, j], _rows(fields["laps"][0, j], block.shape.limiter_windows[j] + 1))
        self._block = block

    def _opened(self) -> Block:
        """Return the block; that of a copy, or of a controller from a file, is opened when it is first used."""
        if self._block is None:
            self._use_block(Block(self._algorithm(), self._shape, memory=self._memory))
        return self._block  # type: ignore[return-value]

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for a copy or a file: the memory and the shape stand for the block."""
        return {name: value for name, value in vars(self).items() if name != "_block"}

    # Assignments.

    def _estimated_path(self) -> np.ndarray:
        path = self._opened().fields["secondary_path"][0]
        return path if self.multichannel else path[0, 0]

    def _filter_again(self) -> None:
        self._opened().refilter()

    def _use_guard(self, taps: np.ndarray | None) -> None:
        self._use_block(self._opened().with_guard(taps))

    def _takes_guard(self) -> bool:
        return True

    def _use_limiter(self, before: Any) -> None:
        block = self._opened()
        for limiter in self._each(before):
            limiter.move_out()
        guard = block.fields["guard"].ravel()
        self._use_block(
            block.remade(self._needed_shape(block.shape.path_taps, guard.size), guard if guard.size else None)
        )

    # What is used and seen.

    def _of_setting(self, name: str) -> Any:
        """Return a setting: a number, or with several channels (J,) or (K,) where each has its own."""
        values = self._opened().fields[name].ravel()
        each = any(one.each for one in self._algorithm().settings if one.name == name)
        return values.copy() if each and self.multichannel else float(values[0])

    @property
    def weights(self) -> np.ndarray:
        """Control filter w, (L,), or with several channels (J, I, L), newest-sample tap first; a copy."""
        return self._weights().copy()

    def _weights(self) -> np.ndarray:
        weights = self._opened().fields["weights"][0]
        return weights if self.multichannel else weights[0, 0]

    @property
    def constraint(self) -> Any:
        """Constraint that computes the powers and the factor; without a rated power its factor is fixed at 1.

        With several channels it is a tuple, one for each loudspeaker.
        """
        self._opened()
        return self._own_constraint

    @property
    def limiter(self) -> Any:
        """Limiter of the control signal, or None, see `FilteredReferenceController.limiter`."""
        self._opened()
        return self._limiter

    @limiter.setter
    def limiter(self, value: Any) -> None:
        FilteredReferenceController.limiter.fset(self, value)  # type: ignore[attr-defined]

    def control_signal(self, reference: Any) -> Any:
        """Return the control signal y(n) for the newest reference sample x(n), from the weights of the last sample.

        With several channels, x(n) is (I,) and y(n) is (J,).
        """
        block = self._opened()
        if self.multichannel:
            block.reference[:] = channel_sample(reference, self.n_references, "reference", "references")
        else:
            block.reference[0] = as_number(reference, "reference")
        if answer := block.emit():
            raise ValueError(f"{reason_of(answer)}; nothing was changed")
        return block.control_signal.copy() if self.multichannel else float(block.control_signal[0])

    def update(self, error: Any) -> None:
        """Adapt to the error e(n), with several channels (K,), that the last control signal left."""
        block = self._opened()
        if self.multichannel:
            block.error[:] = channel_sample(error, self.n_microphones, "error", "microphones")
        else:
            block.error[0] = as_number(error, "error")
        if answer := block.update():
            raise ValueError(f"{reason_of(answer)}; nothing was changed")

    def _listen(self, references: np.ndarray, errors: np.ndarray, adapting: np.ndarray) -> int:
        block = self._opened()
        x, e = (signal.reshape(len(signal), -1) for signal in (references, errors))
        for begin in range(0, len(x), LONGEST_CALL):
            part = slice(begin, begin + LONGEST_CALL)
            done, answer = block.listen(x[part], e[part], adapting[part])
            if answer:
                raise refused_while_listening(reason_of(answer), begin + done)
        return len(x)

    def looped(self) -> Looped | None:
        """Return what the core's loop needs to run this controller; None if Python must call the steps."""
        if calls_of(type(self)) != calls_of(CoreController):
            return None
        block = self._opened()
        constraint = block.fields["constraint"][0, 0].view(NUMBERS)[:, 0]
        return Looped(
            Steps(block.address, *block.algorithm.steps),
            self._weights(),
            {name: constraint[field] for name, field in RECORDED.items()},
            in_use=block.in_use,
            owner=block,
        )


def _rows(room: np.ndarray, length: int) -> np.ndarray:
    """Return three rows of a length at the start of the room for three of the longest."""
    return room.reshape(-1)[: 3 * length].reshape(3, length)
