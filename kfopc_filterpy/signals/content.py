"""What every reader of a file hands on, and the limits and choices that all of them share."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

_SURE_RATE = 1e-4  # share within which the roundest rate is taken without a word
_LEAST_ROOM = 64 * 2**20  # bytes of float64 samples that any file may hold
NO_SIGNAL = 100  # rows: no signal rises for so long
LEAST_SURE_RATE = 300.0  # Hz; kHz that stand for Hz, or ms for s, give less: recorders sample at up to 262 kHz
_ROUNDED = 0.35  # share by which a step between times may differ: they are written with few digits
MOST_VARIABLES, LISTED = 1000, 20  # that a file may hold; that a message names
_SAME_RATE = 1e-3  # share by which a rate may differ that is stated twice
# Rates of converters and analysers in Hz; of those that rounded times allow, one of these is likelier than another.
_COMMON_RATES = np.array(
    [8000, 11025, 12000, 12800, 16000, 22050, 24000, 25600, 32000, 44100, 48000, 51200, 64000, 65536, 88200, 96000,
     102400, 128000, 131072, 176400, 192000, 204800]
)  # fmt: skip
_LARGEST_EXPANSION = 100  # bytes of float64 samples for each byte of a larger file
_STEP_NAMES = ("tinterval", "dt", "ts", "delta_t", "sample_interval", "sampling_interval")  # of a sample interval in s
_TIME_NAMES = ("t", "time", "tout")  # of the times of all samples in s
_RATE_NAMES = ("fs", "f_s", "sr", "samplerate", "sample_rate", "samplingrate", "sampling_rate", "sampling_frequency")


class Content(NamedTuple):
    """Samples (..., n_samples) of a file; its sampling rate in Hz, unit and the time of its first sample if it has them.

    The unit has no prefix; channels in different ones have them in a row: "Pa, V".
    """

    samples: np.ndarray
    fs: float | None = None
    unit: str | None = None
    start_s: float = 0.0


def require_file(path: str | os.PathLike[str]) -> None:
    """Raise OSError if there is no such file or it may not be read, ValueError if it is empty."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path} does not exist or is not a file; the current folder is {Path.cwd()}")
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
    if stated and timed and abs(stated - timed) > max(_SAME_RATE, rounding) * stated:
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


def require_few(path: str | os.PathLike[str], n_variables: int) -> None:
    """Raise ValueError if a file has more variables than any recording: each is compared with each."""
    if n_variables > MOST_VARIABLES:
        raise ValueError(
            f"{path} holds {n_variables} variables, at most {MOST_VARIABLES} are read: save the signal in a file of its own"
        )


def chosen_variable(
    path: str | os.PathLike[str],
    shapes: Mapping[str, tuple[int, ...]],
    read: Callable[[str], np.ndarray],
    variable: str | None,
    others: Mapping[str, str],
) -> Content:
    """Return the variable that is named, or else the only one with several values, and the rate stored beside it.

    `shapes` has the arrays of real numbers, `others` what the rest is.
    """
    require_few(path, len(shapes) + len(others))
    name = _name_of(path, shapes, variable, others)
    require_room(path, math.prod(shapes[name]))
    samples = np.asarray(read(name))
    what = f"variable {name!r} of {path}"
    if samples.dtype.kind not in "fiub":
        raise ValueError(f"{what} must hold real numbers, got {samples.dtype}")
    if samples.shape != shapes[name]:
        raise ValueError(f"{what} has shape {samples.shape}, but its header claims {shapes[name]}: the file is damaged")
    if samples.size == 0:
        raise ValueError(f"{what} is empty, shape {samples.shape}: expected at least one sample")
    fs, start_s = _rate_and_start(path, name, shapes, read)
    return Content(samples, fs, start_s=start_s)


def _rate_and_start(
    path: str | os.PathLike[str], name: str, shapes: Mapping[str, tuple[int, ...]], read: Callable[[str], np.ndarray]
) -> tuple[float | None, float]:
    """Return the sampling rate in Hz, if one is stored beside a variable, and the time of the first sample in s.

    The fields of the variable's own struct come before those of the structs around it, and variables outside.
    """
    folders = name.split(".")[:-1]
    for inside in [".".join(folders[:n]) for n in range(len(folders), -1, -1)]:  # Simulink: a.signals.values, a.time
        numbers: dict[str, list[float]] = {}
        times: list[np.ndarray] = []
        for key, shape in shapes.items():
            place, _, own = key.rpartition(".")
            if place == inside and math.prod(shape) == 1:
                numbers.setdefault(own.lower(), []).append(float(np.asarray(read(key)).reshape(())))
            elif place == inside and key != name and _are_times(key, shape, shapes[name]):
                times.append(np.ravel(read(key)).astype(np.float64))
        starts = [start for start in numbers.get("tstart", []) if math.isfinite(start)]
        rates = [rate for own in _RATE_NAMES for rate in numbers.get(own, [])]
        rates += [rate_of_step(step, path) for own in _STEP_NAMES for step in numbers.get(own, [])]
        for one in times:
            step = even_step(one)
            if step is None:
                raise ValueError(f"{path} has times in uneven steps: export it with a constant sampling rate")
            rates.append(rate_of_step(step, path, rounding_of(one) / np.ptp(one)))
            starts.append(float(one[0]))
        if rates and max(rates) > (1 + _SAME_RATE) * min(rates):
            raise ValueError(
                f"{path} states several sampling rates beside {name!r}, {sorted(rates)} Hz: leave only one"
            )
        if rates:
            return rates[0], starts[0] if starts else 0.0
    return None, 0.0


def _are_times(name: str, shape: tuple[int, ...], signal: tuple[int, ...]) -> bool:
    """Return whether a variable holds the times of a signal's samples, by its name and its shape."""
    return (
        name.rpartition(".")[2].lower() in _TIME_NAMES and math.prod(shape) == max(shape, default=0) == max(signal) > 2
    )


def _name_of(
    path: str | os.PathLike[str],
    shapes: Mapping[str, tuple[int, ...]],
    variable: str | None,
    others: Mapping[str, str],
) -> str:
    listed = [f"{name} {shape}" for name, shape in sorted(shapes.items())]
    more = f" and {len(listed) - LISTED} more" if len(listed) > LISTED else ""
    there = ", ".join(listed[:LISTED]) + more or "no array of real numbers"
    if variable is None:
        names = [
            name
            for name, shape in shapes.items()
            if math.prod(shape) > 1
            and not any(_are_times(name, shape, other) for key, other in shapes.items() if key != name)
        ]
        if len(names) == 1:
            return names[0]
        if len(shapes) == 1 and not others:
            return next(iter(shapes))
        few = "several variables" if names else "no signal"
        rest = "" if names else "".join(f", {name} ({kind})" for name, kind in sorted(others.items()))
        example = min(names or others or shapes)
        raise ValueError(
            f"{path} holds {few}: {there}{rest}; choose one with the option variable (in a command also "
            f"{Path(path).name}:{example})"
        )
    if variable in others:
        raise ValueError(f"variable {variable!r} of {path} must hold real numbers, got {others[variable]}")
    if variable not in shapes:
        raise ValueError(f"variable {variable!r} is not in {path}; it holds: {there}")
    return variable
