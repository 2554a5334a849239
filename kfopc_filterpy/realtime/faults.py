"""Samples that no microphone can have measured: they are found, replaced, and never adapted to."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from ..core.block import LOUDEST

GOOD, NOT_FINITE, CLIPPED, STUCK, OFFSET, REPEATED = range(6)
KINDS = ("good", "not finite", "clipped", "stuck", "offset", "repeated")
LARGEST = LOUDEST  # a larger value is no sound, and its square may overflow
OFFSET_SHARE = 0.5  # of the power: a microphone has no offset, and a low tone a far smaller one
LEAST_OFFSET = 0.01  # of full scale: converters have a small offset, which shows in silence


class Inspector:
    """Finds bad samples in the blocks of several channels.

    Parameters
    ----------
    n_channels : int
        Number of channels.
    most_equal : int
        Number of equal samples in a row after which a channel is stuck.
    rate : float
        Reciprocal of the samples over which an offset is averaged.
    full_scale : float
        Value at which a converter clips; infinite if that is not known.
    """

    def __init__(self, n_channels: int, *, most_equal: int, rate: float, full_scale: float) -> None:
        self.most_equal, self.rate, self.full_scale = most_equal, rate, full_scale
        self.least_offset = LEAST_OFFSET * full_scale if np.isfinite(full_scale) else 0.0
        self._last = np.full(n_channels, np.nan)
        self._equal = np.zeros(n_channels, np.int64)  # samples that were equal to the one before, in a row
        self._means = np.zeros((n_channels, 2))  # of the signal and of its square

    def __call__(self, block: np.ndarray) -> np.ndarray:
        """Return the kind of each sample, (n_channels, n_samples), and replace bad ones in `block`, of that shape."""
        return np.array([self._inspect(channel, samples) for channel, samples in enumerate(block)]).reshape(block.shape)

    def _inspect(self, channel: int, samples: np.ndarray) -> np.ndarray:
        """Return the kind of each sample of one channel, and replace bad ones in place.

        A value that is not finite, or that is stuck, becomes 0. A clipped one is kept, because it is the best estimate
        there is. An offset is subtracted.
        """
        sound = np.abs(samples) <= LARGEST
        heard = samples[sound]
        kinds = np.where(np.abs(samples) >= self.full_scale, CLIPPED, GOOD)
        kinds[~sound] = NOT_FINITE
        if heard.size:
            kinds[np.flatnonzero(sound)[self._equal_before(channel, heard) >= self.most_equal]] = STUCK
        good = np.flatnonzero(kinds == GOOD)
        if good.size:
            v = samples[good]
            kept, mean = 1.0 - self.rate, self._means[channel]
            means, _ = lfilter([self.rate], [1.0, -kept], [v, v * v], zi=kept * mean[:, np.newaxis])
            mean[:] = means[:, -1]
            offset = (means[0] ** 2 > OFFSET_SHARE * means[1]) & (np.abs(means[0]) >= self.least_offset)
            kinds[good[offset]] = OFFSET
            samples[good[offset]] -= means[0, offset]
        samples[(kinds == NOT_FINITE) | (kinds == STUCK)] = 0.0
        return kinds

    def _equal_before(self, channel: int, heard: np.ndarray) -> np.ndarray:
        """Return how many samples before each one are equal to it, in a row."""
        n = np.arange(heard.size)
        differs = heard != np.concatenate([[self._last[channel]], heard[:-1]])
        begin = np.maximum.accumulate(np.where(differs, n, -1 - self._equal[channel]))
        equal = n - begin
        self._last[channel], self._equal[channel] = heard[-1], equal[-1]
        return equal


def is_repeated(block: np.ndarray, last: np.ndarray | None) -> bool:
    """Return whether a block has exactly the samples of the last one, as after a fault of a sound driver.

    A block of equal samples says nothing about that.
    """
    same = last is not None and block.shape == last.shape and np.array_equal(block, last)
    return same and bool(np.any(block != block[:, :1]))
