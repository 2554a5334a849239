"""What fixed filters reach on the steady half of a record, for one channel or several."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from kfopc_filterpy import Plant
from kfopc_filterpy.bounds import required_rated_power
from kfopc_filterpy.bounds.wiener import (
    Record,
    constrained_weights,
    full_stretch,
    loss_db,
    reduction_db,
    warn_of_loss,
)

from .._types import NumberOrArray

LOOK_AHEAD = (1 / 16, 1 / 8, 1 / 4, 1 / 2)  # of the taps
CURVE = 2.0 ** np.arange(-6.0, 3.01, 0.125)  # rated powers of the figure, over the one that full control needs
NEARLY_FULL = 1.0 - 2.0 ** -np.arange(4.0, 9.0)  # there the curve turns sharply into the horizontal
CHANNEL_CURVE = CURVE[::4]  # a solution for several loudspeakers takes longer
LONGEST = 256
MOST_WEIGHTS = 1024  # of all control filters together, unless a length is given: the bounds solve for all at once


def longest_filter(n_filters: int) -> int:
    """Return the largest number of taps of each of `n_filters` control filters, if no length is given."""
    return min(LONGEST, max(MOST_WEIGHTS // n_filters, 1))


class FixedFilters:
    """What fixed filters reach on the steady half of a run.

    Parameters
    ----------
    x, d : ndarray, shape (n_samples,), or (I, n_samples) and (K, n_samples)
        Reference and disturbance.
    s : ndarray, shape (n_path,) or (K, J, n_path)
        Secondary path.
    n_taps : int
        Taps of a filter.
    fs : float
        Sample rate in Hz.
    late : int, default 0
        Samples by which the anti-noise is late: a look-ahead to be tried beside those of the filter's length.
    """

    def __init__(self, x: np.ndarray, d: np.ndarray, s: np.ndarray, n_taps: int, fs: float, late: int = 0) -> None:
        past = s.shape[-1] + n_taps - 2  # samples that fill the delay lines
        first = max(x.shape[-1] // 2 - past, 0)
        self.x, self.d, self.s, self.n_taps, self.fs = x[..., first:], d[..., first:], s, n_taps, fs
        self.several = s.ndim == 3
        self.stretch = full_stretch(self.x, self.d, s, n_taps)
        self.correlations: Any = self.stretch.correlations()
        self.free = self.stretch.solution(self.correlations.weights())
        self.filter_db = self.free.noise_reduction_db
        ahead = sorted({round(share * n_taps) for share in LOOK_AHEAD} | {min(late, x.shape[-1] // 4)} - {0})
        self.ahead = {samples: self._ahead_db(samples) for samples in ahead}
        self.time_db = max([self.filter_db, *self.ahead.values()])

    def _ahead_db(self, samples: int) -> float:
        """Return the noise reduction of a filter that knows the reference so many samples ahead."""
        own = self.stretch
        later = Record(
            own.x[..., samples:], own.filtered[..., samples:], own.d[..., : own.d.shape[-1] - samples], self.n_taps
        )
        return later.solution(replace(self.correlations, cross=later.cross()).weights()).noise_reduction_db

    def helpful_delay_s(self, want_db: float) -> float | None:
        """Return the shortest look-ahead, of those tried, that reaches a noise reduction; None if none does."""
        return next((samples / self.fs for samples, reached in self.ahead.items() if reached >= want_db), None)

    def within(self, rated_power: NumberOrArray) -> float:
        """Return the bound within the rated power, as a noise reduction in dB; warn if larger weights could do better.

        Of several channels that is not known.
        """
        own = self.correlations
        weights, penalty = constrained_weights(self.stretch, own, rated_power)
        losses = loss_db(self.stretch, own, weights, penalty), loss_db(self.stretch, own, self.free.weights)
        warn_of_loss(max(losses))
        return self.stretch.solution(weights).noise_reduction_db

    def needed(self, noise_reduction_db: float, rated_power: NumberOrArray) -> NumberOrArray:
        """Return the rated power with which the bound reaches a noise reduction; Inf if none does, 0 below 0 dB.

        Of several loudspeakers, the powers are in proportion to `rated_power`, (J,).
        """
        if noise_reduction_db <= 0:
            return np.zeros(np.shape(rated_power))[()]
        found = required_rated_power(
            noise_reduction_db,
            self.x,
            Plant(self.s, fs=self.fs),
            n_taps=self.n_taps,
            disturbance=self.d,
            proportions=rated_power if self.several else None,
        ).rated_power
        return found if self.several else float(found)

    def curve(self, rated_power: NumberOrArray) -> tuple[np.ndarray, np.ndarray]:
        """Return rated powers about the given one and the one that full control needs, and the bound for each.

        With several loudspeakers, they are multiples of all ratings.
        """
        unit, given, steps = (rated_power, 1.0, CHANNEL_CURVE) if self.several else (1.0, rated_power, CURVE)
        own, full = self.correlations, np.max(self.free.control_power / unit)
        powers = np.unique([*steps * full, *NEARLY_FULL * full, given, given / 2, given * 2])
        removed = np.array([own.antinoise(constrained_weights(self.stretch, own, one * unit)[0]) for one in powers])
        microphones = len(np.atleast_2d(self.d))
        left = self.free.disturbance_power - removed / microphones
        return powers, np.array([reduction_db(one, self.free.disturbance_power) for one in left])
