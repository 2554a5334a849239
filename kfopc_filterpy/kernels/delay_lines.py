"""Delay lines: the newest sample first and contiguous, no sample shifted on the way.

A line is written downwards, and its taps are moved to the end once every few lengths.
"""

from __future__ import annotations

import numpy as np

from .compiling import inlined, part

START, TAPS, HEAD = 0, 1, 2  # a delay line's first two values, and where its samples begin


def delay_line(taps: int) -> np.ndarray:
    """Return a silent delay line of `taps` samples: the newest is at index line[START], where that of line[TAPS] follow."""
    line = np.zeros(HEAD + 4 * taps + 64)
    line[START], line[TAPS] = line.size - taps, taps
    return line


def refill(line: np.ndarray, samples: np.ndarray) -> None:
    """Make `samples` (TAPS or more,), newest first, what the line holds."""
    taps = int(line[TAPS])
    line[START] = line.size - taps
    line[line.size - taps :] = samples[:taps]


@part()
def push(line, sample):
    """Make `sample` the newest one."""
    start = np.int64(line[START]) - 1
    if start < HEAD:
        kept = np.int64(line[TAPS]) - 1
        start = line.size - kept - 1
        for i in range(kept):
            line[start + 1 + i] = line[HEAD + i]
    line[start] = sample
    line[START] = start


@inlined
def newest(line, taps):
    """Return the newest `taps` samples, newest first, as a view."""
    start = np.int64(line[START])
    return line[start : start + taps]


@inlined
def latest(line):
    """Return the newest sample."""
    return line[np.int64(line[START])]
