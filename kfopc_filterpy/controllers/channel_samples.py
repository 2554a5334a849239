"""Samples of several channels: their checks, FIR filters between them, and amplifiers, one for each loudspeaker."""

from __future__ import annotations

from copy import copy
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_real_array
from ..core.block import LOUDEST_LEARNT
from ..power.amplifiers import Amplifiers, amplifier_of_each


def channel_sample(value: ArrayLike, size: int, name: str, what: str) -> np.ndarray:
    """Return a sample of each channel, (size,), finite; `what` names the channels in an error."""
    sample = as_real_array(value, name).reshape(-1)
    if sample.size != size:
        raise ValueError(f"{name} must have a value for each of the {size} {what}, got {sample.size}")
    for channel in np.flatnonzero(~np.isfinite(sample)):
        raise ValueError(f"{name} must be finite, but that of {what[:-1]} {channel} is {sample[channel]}")
    return np.ascontiguousarray(sample)


def require_moderate(signal: np.ndarray, name: str, most: float = LOUDEST_LEARNT) -> None:
    """Raise ValueError for samples from which a state could overflow."""
    if np.abs(signal).max() > most:
        raise ValueError(f"{name} must not be louder than {most:g}: scale the signals; nothing was changed")


def through(paths: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Return signals (inputs, taps - 1 + n) filtered by paths (outputs, inputs, taps), without the start."""
    rows = np.lib.stride_tricks.sliding_window_view(lines, paths.shape[2], axis=1)[..., ::-1]
    return np.tensordot(paths, rows, axes=((1, 2), (0, 2)))


class ChannelFilters:
    """FIR filters (outputs, inputs, taps) that are given a sample of all inputs at a time."""

    def __init__(self, taps: np.ndarray) -> None:
        self.n_outputs, self.n_inputs, n_taps = taps.shape
        self._taps = np.ascontiguousarray(np.moveaxis(taps, 2, 1).reshape(self.n_outputs, -1))
        self._line = np.zeros(n_taps * self.n_inputs)  # newest first, the inputs of a sample together

    def push(self, sample: np.ndarray) -> None:
        """Add the newest sample of the inputs."""
        self._line[sample.size :] = self._line[: self._line.size - sample.size]
        self.replace(sample)

    def replace(self, sample: np.ndarray) -> None:
        """Put another sample in the place of the newest one."""
        self._line[: sample.size] = sample[: self._line.size]

    def output(self) -> np.ndarray:
        """Return the sample of the outputs."""
        return self._taps @ self._line

    def branched(self) -> Self:
        """Return filters that go on from here by themselves: they have the line of now, and share the rest."""
        other = copy(self)
        other._line = self._line.copy()
        return other


class PlayedSound(ChannelFilters):
    """What loudspeakers with known amplifiers play, and what reaches the microphones of it."""

    def __init__(self, paths: np.ndarray, amplifier: Amplifiers) -> None:
        super().__init__(paths)
        self._amplifiers = None if amplifier is None else amplifier_of_each(amplifier, self.n_inputs)

    def play(self, control_signal: ArrayLike) -> np.ndarray:
        """Add a controller's newest control signal, and return it, (J,)."""
        y = np.asarray(control_signal, dtype=np.float64).reshape(-1)
        if y.size != self.n_inputs:
            raise ValueError(f"controller must return {self.n_inputs} control signals, got {y.size}")
        played = y
        if self._amplifiers is not None and np.isfinite(y).all():  # a divergence stays one
            each = zip(self._amplifiers, y.tolist(), strict=True)
            played = np.array([value if amplifier is None else amplifier(value) for amplifier, value in each])
        self.push(played)
        return y
