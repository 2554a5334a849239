"""What changes in a run: values and the times from which they hold, switched or cross-faded."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np

from .._validate import as_nonnegative, as_number

NEVER = 2**63 - 1


@dataclass(frozen=True)
class Schedule:
    """Values, and the samples at which they begin to replace the one before; `fade` samples later they have replaced it.

    Values that are cross-faded are numbers, or arrays of one shape.
    """

    begins: list[int]
    values: list[Any]
    fade: int

    def at(self, n: int) -> tuple[Any, int]:
        """Return the value at sample n, and the first sample after it that may have another one."""
        i = bisect_right(self.begins, n) - 1
        done = n - self.begins[i]
        if i and done < self.fade:
            share = done / self.fade
            return (1.0 - share) * self.values[i - 1] + share * self.values[i], n + 1
        return self.values[i], self.begins[i + 1] if i + 1 < len(self.begins) else NEVER

    def parts(self, n_samples: int) -> Iterator[tuple[Any, slice, np.ndarray]]:
        """Yield each value, the samples in which it has a share of the whole, and its share in each of them."""
        ends = [min(begin + self.fade, n_samples) for begin in self.begins[1:]] + [n_samples]
        for i, (value, begin, end) in enumerate(zip(self.values, self.begins, ends, strict=True)):
            n = np.arange(begin, end)
            yield value, slice(begin, end), self._risen(i, n) - self._risen(i + 1, n)

    def _risen(self, i: int, n: np.ndarray) -> np.ndarray:
        """Return the share, 0 to 1, by which value i and those after it have replaced those before it."""
        if i in (0, len(self.begins)):
            return np.full(n.size, float(i == 0))
        if self.fade == 0:
            return (n >= self.begins[i]).astype(float)
        return np.clip((n - self.begins[i]) / self.fade, 0.0, 1.0)


def steps(value: Any, name: str, *, of_numbers: bool = False) -> list[Any]:
    """Return pairs (time in s, value) as they are, and a value that does not change as a pair with time 0.

    Only such a pair has one number and one thing that is no number: paths and lists of amplifiers have none. Levels are
    numbers themselves, so for them (`of_numbers`) any two numbers are a pair.
    """

    def is_pair(entry: Any) -> bool:
        return (
            isinstance(entry, list | tuple)
            and len(entry) == 2
            and (of_numbers or isinstance(entry[0], Real) != isinstance(entry[1], Real))
        )

    pairs = [is_pair(entry) for entry in value] if isinstance(value, list | tuple) else []
    if not any(pairs) and not is_pair(value):
        return [(0.0, value)]
    if not all(pairs):
        raise ValueError(
            f"{name} must be one value, or a list of pairs (time in s, value): not a mixture of both, nor a pair without "
            "a list around it"
        )
    return list(value)


def as_schedule(
    value: Any,
    name: str,
    read: Callable[[Any], Any],
    n_samples: int,
    fs: float,
    crossfade_s: float = 0.0,
    *,
    of_numbers: bool = False,
) -> Schedule:
    """Return the schedule of one value, or of pairs (time in s, value); `read` checks and converts a value."""
    pairs = steps(value, name, of_numbers=of_numbers)
    times = [as_number(time, f"a time of {name}", unit="s") for time, _ in pairs]
    begins = [round(min(max(time * fs, -1.0), n_samples)) for time in times]
    if begins[0] != 0:
        raise ValueError(f"{name} must begin with a value for the time 0 s, got one for {times[0]:g} s")
    gaps = np.diff(begins)
    if np.any(gaps <= 0) or begins[-1] >= n_samples:
        raise ValueError(
            f"{name} must have times that rise, by a sample at least, within the run of {n_samples / fs:g} s, got {times}"
        )
    fade = round(min(as_nonnegative(crossfade_s, "crossfade_s", unit="s") * fs, n_samples + 2))
    longest = min(gaps[1:].tolist(), default=n_samples)
    if len(pairs) > 1 and fade > longest + 1:  # two times in s that are rounded may be a sample nearer
        raise ValueError(
            f"crossfade_s must be at most {longest / fs:g} s, the shortest time between two changes of {name} or the "
            f"length of the run, got {crossfade_s:g} s"
        )
    return Schedule(begins, [read(value) for _, value in pairs], min(fade, longest))


def path_schedule(
    paths: Any, name: str, read: Callable[[Any], np.ndarray], n_samples: int, fs: float, crossfade_s: float = 0.0
) -> Schedule:
    """Return the schedule of a path, or of paths; the taps of all are filled with zeros to the longest."""
    schedule = as_schedule(paths, name, read, n_samples, fs, crossfade_s)
    if len({taps.shape[:-1] for taps in schedule.values}) > 1:
        shapes = " and ".join(str(taps.shape) for taps in schedule.values)
        raise ValueError(f"{name} must have the same numbers of channels at all times, got taps {shapes}")
    longest = max(taps.shape[-1] for taps in schedule.values)
    padded = [np.pad(taps, [(0, 0)] * (taps.ndim - 1) + [(0, longest - taps.shape[-1])]) for taps in schedule.values]
    return replace(schedule, values=padded)
