"""Samples that no microphone can have measured: they are found, replaced, and never adapted to."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..kernels.compiling import compiled
from ..kernels.records import new_record

GOOD, NOT_FINITE, CLIPPED, STUCK, OFFSET, REPEATED = range(6)
KINDS = ("good", "not finite", "clipped", "stuck", "offset", "repeated")
LARGEST = 1e100  # a larger value is no sound, and its square may overflow
OFFSET_SHARE = 0.5  # of the power: a microphone has no offset, and a low tone a far smaller one
LEAST_OFFSET = 0.01  # of full scale: converters have a small offset, which shows in silence


@compiled(nogil=True)
def inspect(samples, state, kinds):
    """Set the kind of each sample of one channel, and replace bad ones in place.

    A value that is not finite, or that is stuck, becomes 0. A clipped one is kept, because it is the best estimate
    there is. An offset is subtracted.
    """
    s = state[0]
    for n in range(samples.size):
        v = samples[n]
        kinds[n] = GOOD
        if not abs(v) <= LARGEST:
            kinds[n], samples[n] = NOT_FINITE, 0.0
            continue
        s.equal = s.equal + 1 if v == s.last else 0
        s.last = v
        if s.equal >= s.most_equal:
            kinds[n], samples[n] = STUCK, 0.0
        elif abs(v) >= s.full_scale:
            kinds[n] = CLIPPED
        else:
            s.mean += s.rate * (v - s.mean)
            s.power += s.rate * (v * v - s.power)
            if s.mean * s.mean > OFFSET_SHARE * s.power and abs(s.mean) >= s.least_offset:
                kinds[n], samples[n] = OFFSET, v - s.mean


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
        self._states = [
            new_record(
                last=np.nan,
                equal=0,
                most_equal=most_equal,
                mean=0.0,
                power=0.0,
                rate=rate,
                full_scale=full_scale,
                least_offset=LEAST_OFFSET * full_scale if np.isfinite(full_scale) else 0.0,
            )
            for _ in range(n_channels)
        ]

    def __call__(self, block: np.ndarray) -> np.ndarray:
        """Return the kind of each sample, (n_channels, n_samples), and replace bad ones in `block`, of that shape."""
        kinds = np.empty(block.shape, dtype=np.int64)
        for samples, state, kind in zip(block, self._states, kinds, strict=True):
            inspect(samples, state, kind)
        return kinds


def is_repeated(block: Any, last: Any) -> bool:
    """Return whether a block has exactly the samples of the last one, as after a fault of a sound driver.

    A block of equal samples says nothing about that.
    """
    same = last is not None and block.shape == last.shape and np.array_equal(block, last)
    return same and bool(np.any(block != block[:, :1]))
