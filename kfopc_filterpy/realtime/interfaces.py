"""Interfaces: where blocks of microphone signals come from, and where the control signals go."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from .._types import ChangingPaths, Seed
from .._validate import as_channels, as_choice, as_count, as_positive
from ..controllers.channel_samples import through
from ..loop.inputs import SensorNoise, channel_disturbances
from ..loop.schedule import Schedule, path_schedule, steps
from ..paths.path_matrix import is_path_matrix, path_matrix, secondary_paths
from ..power.amplifiers import Amplifiers, amplifier_of_each


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
    """A plant model that behaves like a sound card: blocks, and a delay between writing and playing.

    Paths may change during the run, as in `simulate`: give pairs (time in s, path).

    Parameters
    ----------
    reference : array_like, shape (n_samples,) or (I, n_samples), or None
        Reference x, the noise. Without a reference microphone, None: then give a `disturbance`.
    secondary_path : array_like or control.TransferFunction
        True secondary path s, or paths (K, J, n_taps), without the delay of the interface.
    primary_path : array_like or control.TransferFunction, optional
        Path from the reference to the error microphone, or paths (K, I, n_taps).
    disturbance : array_like, shape (n_samples,) or (K, n_samples), optional
        Disturbance d, in place of `primary_path`.
    fs : float, default 16000
        Sample rate in Hz.
    block : int, default 64
        Samples of a block.
    latency : int, optional
        Samples from a sample's reading to the playing of its control signal, at least a block; by default two blocks.
    amplifier : callable, optional
        Amplifier model or function of a sample, or a sequence with one for each loudspeaker; by default linear.
    feedback_path : array_like or control.TransferFunction, optional
        Acoustic feedback from the amplifier to the reference microphone, or paths (I, J, n_taps).
    crossfade_s : float, default 0
        Time in s from the beginning to the end of a change of a path; 0 switches at once.
    sensor_noise_std : float, default 0
        Standard deviation of white noise at each error microphone.
    rng : int or numpy.random.Generator, optional
        Seed of the sensor noise; required if there is any.
    clock : {"free", "real"}, default "free"
        Whether a block is there at once, or as in reality after its duration. With a real clock, blocks that are not
        fetched in time are lost.

    Attributes
    ----------
    total_secondary_path : ndarray, shape (latency + n_taps,) or (K, J, latency + n_taps)
        Secondary path at the beginning as a controller sees it, the delay of the interface included.
    disturbance : ndarray, shape (K, n_samples)
        Disturbance at the error microphones.

    Raises
    ------
    TypeError, ValueError
        Signals or paths that do not fit each other; a latency below a block; both or neither of `primary_path` and
        `disturbance`, or a primary path without a reference.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.realtime import SimulatedInterface
    >>> noise = np.random.default_rng(0).standard_normal(1000)
    >>> plant = SimulatedInterface(noise, [0.0, 0.8], primary_path=[0.0, 0.0, 0.5], block=50)
    >>> plant.start()
    >>> first = plant.read()
    >>> first.references.shape, first.errors.shape
    ((1, 50), (1, 50))
    >>> plant.total_secondary_path.shape  # 100 zeros, then the path
    (102,)
    """

    def __init__(
        self,
        reference: ArrayLike | None,
        secondary_path: ChangingPaths,
        *,
        primary_path: ChangingPaths | None = None,
        disturbance: ArrayLike | None = None,
        fs: float = 16000.0,
        block: int = 64,
        latency: int | None = None,
        amplifier: Amplifiers = None,
        feedback_path: ChangingPaths | None = None,
        crossfade_s: float = 0.0,
        sensor_noise_std: float = 0.0,
        rng: Seed | None = None,
        clock: str = "free",
    ) -> None:
        self.fs = as_positive(fs, "fs", unit="Hz")
        self.block = as_count(block, "block")
        self.latency = 2 * self.block if latency is None else as_count(latency, "latency")
        if self.latency < self.block:
            raise ValueError(f"latency must be at least a block, {self.block} samples, got {self.latency}")
        self.clock = as_choice(clock, "clock", ("free", "real"))
        self._sensor_noise = SensorNoise(sensor_noise_std, rng)
        if reference is not None:
            self._x = np.atleast_2d(as_channels(reference, "reference"))
        elif disturbance is not None:
            self._x = np.empty((0, as_channels(disturbance, "disturbance").shape[-1]))
        else:
            raise ValueError("without a reference give disturbance=, what the error microphones hear")
        self.n_references = len(self._x)

        def schedule(paths: Any, name: str, read: Callable[[Any], np.ndarray]) -> Schedule:
            return path_schedule(paths, name, read, self.n_samples, self.fs, crossfade_s)

        secondary = schedule(secondary_path, "secondary_path", lambda paths: secondary_paths(paths, fs=self.fs)[0])
        self.n_microphones, self.n_loudspeakers, _ = secondary.values[0].shape
        total = np.pad(secondary.values[0], ((0, 0), (0, 0), (self.latency, 0)))
        several = any(is_path_matrix(path) for _, path in steps(secondary_path, "secondary_path"))
        self.total_secondary_path = total if several else total[0, 0]
        self.disturbance = channel_disturbances(
            self._x, primary_path, disturbance, self.fs, self.n_microphones, crossfade_s
        )
        self._amplifiers = amplifier_of_each(amplifier, self.n_loudspeakers)
        self._secondary = _Paths(secondary)
        self._feedback = None
        if feedback_path is not None:
            self._feedback = _Paths(schedule(feedback_path, "feedback_path", self._read_feedback))
        self._queue = np.zeros((self.n_loudspeakers, self.latency))  # written, not yet played
        self._done, self._began = 0, 0.0
        self.blocks_can_repeat = False  # simulated noise may be exactly periodic

    def _read_feedback(self, paths: Any) -> np.ndarray:
        feedback, _ = path_matrix(paths, fs=self.fs, name="feedback_path")
        if feedback.shape[:2] != (self.n_references, self.n_loudspeakers):
            raise ValueError(
                f"feedback_path must lead from the {self.n_loudspeakers} loudspeakers to the {self.n_references} "
                f"references, got paths {feedback.shape}"
            )
        return feedback

    @property
    def n_samples(self) -> int:
        """Samples of the noise."""
        return self._x.shape[1]

    def start(self) -> None:
        """Start the clock."""
        self._began = time.perf_counter() - self._done / self.fs

    def read(self) -> Block | None:
        """Return the next block; None if less than a block of the noise is left."""
        lost = 0
        if self.clock == "real":
            wait = self._began + (self._done + self.block) / self.fs - time.perf_counter()
            if wait > 0:
                time.sleep(wait)
            while -wait > self.block / self.fs and self._advance() is not None:
                lost += self.block
                wait += self.block / self.fs
        heard = self._advance()
        return None if heard is None else Block(*heard, lost)

    def _advance(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return references and errors of the next block."""
        now = slice(self._done, self._done + self.block)
        if now.stop > self.n_samples:
            return None
        y = self._queue[:, : self.block]
        each = zip(self._amplifiers, y, strict=True)
        y = np.array([signal if amplifier is None else amplifier(signal) for amplifier, signal in each])
        e = self.disturbance[:, now] - self._secondary(y)
        e += self._sensor_noise.take(*e.shape)
        x = self._x[:, now] + (0.0 if self._feedback is None else self._feedback(y))
        self._queue = np.concatenate((self._queue[:, self.block :], np.zeros((len(y), self.block))), axis=1)
        self._done = now.stop
        return x, e

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
        heard = np.concatenate((self._line, signals), axis=1)
        parts, begin, n = [], 0, signals.shape[1]
        while begin < n:
            taps, until = self._schedule.at(self._done + begin)
            end = min(until - self._done, n)
            parts.append(through(taps, heard[:, begin : end + self._line.shape[1]]))
            begin = end
        self._line, self._done = heard[:, n:], self._done + n
        return np.concatenate(parts, axis=1)
