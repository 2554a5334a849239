"""Interfaces: where blocks of microphone signals come from, and where the control signals go."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from .._types import Seed
from .._validate import as_count
from ..controllers.channel_samples import through
from ..loop.inputs import SensorNoise
from ..plant import Plant, Schedule, as_plant, checked_signals, schedule_of
from ..power.amplifiers import amplified_signal


class Block(NamedTuple):
    """Signals of the microphones over one block."""

    references: np.ndarray  # (I, n_samples)
    errors: np.ndarray  # (K, n_samples)
    lost: int = 0  # samples that were lost before this block


@runtime_checkable
class Interface(Protocol):
    """Describe what `run` needs: sample rate and counts, and four methods.

    Signals have a channel axis, also for one channel. `full_scale`, the magnitude at which the converters of the
    microphones clip, is used if it is there; so is `dry`, the number of blocks that came too late for the output since
    the interface was made, which `start` does not reset.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.realtime import Block, Interface
    >>> class Silence:
    ...     fs, block = 8000.0, 16
    ...     n_references = n_microphones = n_loudspeakers = 1
    ...     def start(self):
    ...         pass
    ...     def read(self):
    ...         return Block(np.zeros((1, 16)), np.zeros((1, 16)))
    ...     def write(self, control_signals):
    ...         pass
    ...     def stop(self):
    ...         pass
    >>> isinstance(Silence(), Interface)
    True
    """

    fs: float
    block: int
    n_references: int
    n_microphones: int
    n_loudspeakers: int

    def start(self) -> None:
        """Open the streams."""

    def read(self) -> Block | None:
        """Return the next block, as soon as it has been heard; None at the end."""

    def write(self, control_signals: np.ndarray) -> None:
        """Play `control_signals`, (J, n_samples), those of the block that was read last."""

    def stop(self) -> None:
        """Close the streams."""


class SimulatedInterface:
    """A plant that behaves like a sound card: blocks, and a delay between writing and playing.

    Parameters
    ----------
    reference : array_like, shape (n_samples,) or (I, n_samples), or None
        Reference x, the noise. Without a reference microphone, None: then give a `disturbance`.
    plant : Plant
        Plant without the delay of the interface. It may change during the run, see `Plant.changed_at`.
    disturbance : array_like, shape (n_samples,) or (K, n_samples), optional
        Disturbance d, in place of the plant's primary path.
    block : int, default 64
        Samples of a block.
    latency : int, optional
        Samples from a sample's reading to the playing of its control signal, at least a block; by default two blocks.
    rng : int or numpy.random.Generator, optional
        Seed of the sensor noise; required if there is any.

    Attributes
    ----------
    disturbance : ndarray, shape (K, n_samples)
        Disturbance at the error microphones.

    Raises
    ------
    TypeError, ValueError
        Signals that do not fit the plant; a latency below a block; neither a primary path nor a disturbance.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import Plant
    >>> from kfopc_filterpy.realtime import SimulatedInterface
    >>> noise = np.random.default_rng(0).standard_normal(1000)
    >>> interface = SimulatedInterface(noise, Plant([0.0, 0.8], [0.0, 0.0, 0.5], fs=16000), block=50)
    >>> interface.start()
    >>> first = interface.read()
    >>> first.references.shape, first.errors.shape
    ((1, 50), (1, 50))
    """

    def __init__(
        self,
        reference: ArrayLike | None,
        plant: Plant,
        *,
        disturbance: ArrayLike | None = None,
        block: int = 64,
        latency: int | None = None,
        rng: Seed | None = None,
    ) -> None:
        self.fs = as_plant(plant).fs
        self.block = as_count(block, "block")
        self.latency = 2 * self.block if latency is None else as_count(latency, "latency")
        if self.latency < self.block:
            raise ValueError(f"latency must be at least a block, {self.block} samples, got {self.latency}")
        self._sensor_noise = SensorNoise(plant.sensor_noise_std, rng)
        self._x, self.disturbance = checked_signals(plant, reference, disturbance)
        self.n_references = len(self._x)
        self.n_microphones, self.n_loudspeakers = plant.n_microphones, plant.n_loudspeakers
        self._amplifiers = schedule_of(plant, "amplifier")
        self._secondary = _Paths(schedule_of(plant, "secondary"))
        feedback = schedule_of(plant, "feedback")
        self._feedback = None if feedback.values[0] is None else _Paths(feedback)
        self._queue = np.zeros((self.n_loudspeakers, self.latency))  # written, not yet played
        self._done = 0
        self.blocks_can_repeat = False  # simulated noise may be exactly periodic

    def start(self) -> None:
        """Do nothing: the next block is there at once."""

    def read(self) -> Block | None:
        """Return the next block; None if less than a block of the noise is left."""
        now = slice(self._done, self._done + self.block)
        if now.stop > self._x.shape[1]:
            return None
        y = self._amplified(self._queue[:, : self.block])
        e = self.disturbance[:, now] - self._secondary(y)
        e += self._sensor_noise.take(*e.shape)
        x = self._x[:, now] + (0.0 if self._feedback is None else self._feedback(y))
        self._queue = np.concatenate((self._queue[:, self.block :], np.zeros((len(y), self.block))), axis=1)
        self._done = now.stop
        return Block(x, e)

    def _amplified(self, y: np.ndarray) -> np.ndarray:
        """Return the block `y`, (J, n), after the amplifiers, which are switched at the sample, as in `simulate`."""
        played = [
            np.array([amplified_signal(*each) for each in zip(amplifiers, y[:, part], strict=True)])
            for amplifiers, part in self._amplifiers.values_in(self._done, y.shape[1])
        ]
        return np.concatenate(played, axis=1)

    def write(self, control_signals: np.ndarray) -> None:
        """Play `control_signals`, (J, n_samples), those of the block that was read last, `latency` samples after it."""
        # The block that was read last has been taken from the queue already, so its place is one block earlier.
        end = self.latency
        self._queue[:, end - self.block : end] = control_signals

    def stop(self) -> None:
        """Stop; `start` goes on from here."""


class _Paths:
    """Paths (outputs, inputs, taps) that may change, through which signals pass block by block."""

    def __init__(self, schedule: Schedule) -> None:
        self._schedule, self._done = schedule, 0
        _, n_inputs, n_taps = schedule.values[0].shape
        self._line = np.zeros((n_inputs, n_taps - 1))

    def __call__(self, signals: np.ndarray) -> np.ndarray:
        """Return the outputs, (outputs, n), of the next block, (inputs, n)."""
        heard, n = np.concatenate((self._line, signals), axis=1), signals.shape[1]
        parts = [
            through(taps, heard[:, part.start : part.stop + self._line.shape[1]])
            for taps, part in self._schedule.values_in(self._done, n)
        ]
        self._line, self._done = heard[:, n:], self._done + n
        return np.concatenate(parts, axis=1)
