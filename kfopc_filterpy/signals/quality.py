"""Remarks on recordings that can be used, but tell less than they seem to."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

SHORT_S, RECOMMENDED_S = 5.0, 10.0
CLIPPED_SHARE = 1e-4  # of the samples; fewer hardly matter
STEPS = 2.0  # smallest steps of the numbers: what clips comes from further away


def recording_remarks(samples: ArrayLike, fs: float, name: str) -> list[str]:
    """Return remarks on a recording, (n_samples,) or (n_channels, n_samples): that it is short or clipped, or has equal channels."""
    channels = np.atleast_2d(samples)
    remarks = clipping_remarks(channels, name)
    seconds = channels.shape[-1] / fs
    if seconds < SHORT_S:
        remarks.append(
            f"{name} lasts only {seconds:.3g} s, so a part of the result may be chance: record {RECOMMENDED_S:g} s or more."
        )
    remarks += [
        f"{name}, channels {i} and {k}, are the same signal: leave one of them out."
        for i, k in combinations(range(len(channels)), 2)
        if np.array_equal(channels[i], channels[k])
    ]
    return remarks


def clipping_remarks(samples: ArrayLike, name: str) -> list[str]:
    """Return a remark on each channel of a recording that is clipped."""
    channels = np.atleast_2d(samples)
    remarks = []
    for number, channel in enumerate(channels):
        share = _clipped_share(channel)
        if share:
            which = name if len(channels) == 1 else f"{name}, channel {number},"
            remarks.append(
                f"{which} is clipped: {100 * share:.2g} % of its samples stay at the highest or the lowest value. What "
                "was cut off is missing from every result: record again with less gain."
            )
    return remarks


def _clipped_share(channel: np.ndarray) -> float:
    """Return the share of the samples at an extreme value that the signal reaches in a step, and at which it stays.

    It stays if it is there for three samples and more. So it does at the peaks of a slow tone in whole numbers, too,
    but there the steps are the smallest that the numbers have.
    """
    values = np.unique(channel)
    if values.size < 3:
        return 0.0
    smallest_step, count = np.diff(values).min(), 0
    for extreme in (values[-1], values[0]):
        there = channel == extreme
        stays = np.mean(there[:-2] & there[1:-1] & there[2:]) > CLIPPED_SHARE
        steps = np.abs(channel[:-1] - extreme)[there[1:] & ~there[:-1]]
        if stays and np.median(steps) > STEPS * smallest_step:
            count += int(np.count_nonzero(there))
    return count / channel.size
