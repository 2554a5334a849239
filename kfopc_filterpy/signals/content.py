"""What every reader of a file hands on, and the limits that all of them share."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .._validate import require_existing

_SURE_RATE = 1e-4  # share within which the roundest rate is taken without a word
_LEAST_ROOM = 64 * 2**20  # bytes of float64 samples that any file may hold
NO_SIGNAL = 100  # rows: no signal rises for so long
LEAST_SURE_RATE = 300.0  # Hz; kHz that stand for Hz, or ms for s, give less: recorders sample at up to 262 kHz
_ROUNDED = 0.35  # share by which a step between times may differ: they are written with few digits
SAME_RATE = 1e-3  # share by which a rate may differ that is stated twice
# Rates of converters and analysers in Hz; of those that rounded times allow, one of these is likelier than another.
_COMMON_RATES = np.array(
    [8000, 11025, 12000, 12800, 16000, 22050, 24000, 25600, 32000, 44100, 48000, 51200, 64000, 65536, 88200, 96000,
     102400, 128000, 131072, 176400, 192000, 204800]
)  # fmt: skip
_LARGEST_EXPANSION = 100  # bytes of float64 samples for each byte of a larger file


class Content(NamedTuple):
    """Samples (..., n_samples) of a file; its sampling rate in Hz, unit and the time of its first sample if it has them.

    The unit has no prefix; channels in different ones have them in a row: "Pa, V".
    """

    samples: np.ndarray
    fs: float | None = None
    unit: str | None = None
    start_s: float = 0.0


def require_file(path: str | os.PathLike[str]) -> None:
    """Raise OSError if there is no such file or it may not be read, ValueError if it is empty, TypeError if it is no path."""
    if not isinstance(path, str | os.PathLike):
        raise TypeError(
            f"path must be the path of a file, got {type(path).__name__}: write it to a file, or pass Recording(samples, fs)"
        )
    require_existing(path)
    with open(path, "rb") as file:
        is_empty = not file.read(1)
    if is_empty:
        raise ValueError(f"{path} is empty (0 bytes): record or export it again")


def room_of(path: str | os.PathLike[str]) -> int:
    """Return how many bytes the samples of a file may take as float64."""
    return max(_LEAST_ROOM, _LARGEST_EXPANSION * Path(path).stat().st_size)


def require_room(path: str | os.PathLike[str], n_values: float, *, what: str = "it claims") -> None:
    """Raise ValueError if `n_values` float64 samples are more than a file of this size may become in memory."""
    if 8 * n_values > room_of(path):
        raise ValueError(
            f"{path} has {Path(path).stat().st_size} bytes, but {what} {n_values:.4g} samples: what takes more than "
            f"{_LEAST_ROOM // 2**20} MiB and {_LARGEST_EXPANSION} times the file is not read. If the file is right, "
            "store it uncompressed, or in parts"
        )


@contextmanager
def reading(path: str | os.PathLike[str], what: str) -> Iterator[None]:
    """Turn whatever a library raises for a damaged file into a ValueError that names the file.

    They raise nearly anything: zlib.error, struct.error, IndexError, KeyError, NotImplementedError, MemoryError.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # numbers up to 1e308, which are refused or taken
            yield
    except ModuleNotFoundError:
        raise
    except Exception as error:
        if isinstance(error, ValueError) and str(path) in str(error):
            raise
        reason = str(error) or type(error).__name__
        raise ValueError(f"{path} cannot be read as {what}: {reason}; is it damaged or cut short?") from error


def channels_first(array: np.ndarray) -> np.ndarray:
    """Return a table with its longer axis, time, last; (n, 1) and (1, n) become (n,)."""
    if array.ndim == 2:
        table = array.T if array.shape[0] > array.shape[1] else array
        return table[0] if len(table) == 1 else table
    return array.reshape(1) if array.ndim == 0 else array


def rate_of_step(step_s: float, path: str | os.PathLike[str], rounding: float = 0.0) -> float:
    """Return the sampling rate for a sample interval, which a text rounds: the roundest number of Hz within 1e-4 of it.

    `rounding` is the share by which the interval may be wrong. If that is more, it counts, and a warning says what is
    taken. Common rates come before round ones.
    """
    if not (math.isfinite(step_s) and step_s > 0):
        raise ValueError(f"{path} states a sample interval of {step_s:g} s, expected one above 0")
    rate = 1 / step_s
    if abs(rate - round(rate)) <= 1e-9 * rate:
        return float(round(rate))
    share = max(rounding, _SURE_RATE)
    candidates = [
        _COMMON_RATES[np.argmin(np.abs(_COMMON_RATES - rate))],
        *(n * round(rate / n) for n in (1000, 100, 25, 1)),
    ]
    taken = next((float(whole) for whole in candidates if abs(rate - whole) <= share * rate), rate)
    if abs(rate - taken) > _SURE_RATE * rate:
        warnings.warn(
            f"{path} has times of few digits, which allow {rate:.0f} Hz +- {rounding * rate:.0f} Hz: it is taken to be sampled "
            f"at {taken:g} Hz",
            stacklevel=2,
        )
    return taken


def agreed_rate(
    path: str | os.PathLike[str], stated: float | None, timed: float | None, rounding: float = 0.0
) -> float | None:
    """Return the rate that a file states, or else that of its times; both must agree as far as the times are known."""
    if stated and timed and abs(stated - timed) > max(SAME_RATE, rounding) * stated:
        raise ValueError(
            f"{path} states a sampling rate of {stated:g} Hz, but its times give {timed:g} Hz: correct one, or leave it out"
        )
    return stated or timed


def rounding_of(times: np.ndarray) -> float:
    """Return the last digit with which times were written, at most: 1e-5 for 0.00002 and 0.00005.

    0 if they have many.
    """
    for digits in range(10):
        scaled = times * 10.0**digits
        if np.all(np.abs(scaled - np.round(scaled)) < 1e-6):
            return 10.0**-digits
    return 0.0


def even_step(times: np.ndarray) -> float | None:
    """Return the step of times that rise in even steps but for rounding, or None."""
    steps, step = np.diff(times), (times[-1] - times[0]) / (len(times) - 1)
    drift = np.max(np.abs(times - times[0] - step * np.arange(len(times))))
    even = np.all(steps > 0) and np.max(np.abs(steps - step)) <= _ROUNDED * step and drift <= step
    if len(times) >= NO_SIGNAL and step > 0:
        even = even or drift <= min(rounding_of(times), step)  # each is rounded, and no more than that
    return float(step) if even else None
