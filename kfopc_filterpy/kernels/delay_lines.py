"""Delay lines whose samples are contiguous, newest first, without a shift at every sample.

A line is filled from its end towards its start. At the start, the newest samples are copied back to the end.
"""

from __future__ import annotations

import numpy as np

from .compiling import inlined, part

START, TAPS, HEAD = 0, 1, 2  # a delay line's first two values, and the first index of its samples


def delay_line(taps: int) -> np.ndarray:
    """Return a silent delay line: its line[TAPS] = `taps` samples begin, newest first, at index line[START]."""
    line = np.zeros(HEAD + 4 * taps + 64)
    line[START], line[TAPS] = line.size - taps, taps
    return line


def refill(line: np.ndarray, samples: np.ndarray) -> None:
    """Replace the contents of the line by the newest of `samples`, (taps or more,), newest first."""
    taps = int(line[TAPS])
    line[START] = line.size - taps
    line[line.size - taps :] = samples[:taps]


@part()
def push(line, sample):
    """Add `sample` as the newest one."""
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
