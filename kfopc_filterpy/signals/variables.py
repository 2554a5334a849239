"""Variables of .mat and .npz files: which one is the signal, and what those beside it say of its rate and unit."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from .content import SAME_RATE, Content, even_step, rate_of_step, require_room, rounding_of
from .text import PREFIXES, stated_rate, unit_of

MOST_VARIABLES, LISTED = 1000, 20  # that a file may hold; that a message names
_TEXTS = ("text", "cell")
# Names in lower case of what stands beside a signal; a unit at the end of a name, as in "fs_kHz", counts.
_RATE = re.compile(r"(?:f_?s|s_?r(?:ate)?|fsample|samp\w*?_?(?:rate|freq(?:uency)?))(?:_?(k?)hz)?")
_STEP = re.compile(r"(?:tinterval|dt|ts|delta_?t|samp\w*?_?(?:interval|period))(?:_?([mun]?)s)?")
_TIMES = re.compile(r"(?:t|time|tout)(?:_?([mun]?)s)?")


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
    fs, start_s = _rate_and_start(path, name, shapes, read, others)
    factors, unit = _units(path, name, samples.shape, read, others)
    return Content(samples * factors if unit else samples, fs, unit, start_s)


def _around(name: str, keys: Mapping[str, object]) -> Iterator[list[tuple[str, str]]]:
    """Yield the variables beside a variable and their own names in lower case: in its struct, then in those around it."""
    folders = name.split(".")[:-1]
    for inside in [".".join(folders[:n]) for n in range(len(folders), -1, -1)]:  # Simulink: a.signals.values, a.time
        beside = [(key, *key.rpartition(".")[::2]) for key in keys if key != name]
        yield [(key, own.lower()) for key, place, own in beside if place == inside]


def _texts(read: Callable[[str], np.ndarray], key: str) -> list[str]:
    """Return the text of a variable, or the texts of a cell; HDF5 has the characters as numbers."""
    value = np.asarray(read(key))
    if value.dtype.kind == "u":
        return ["".join(map(chr, value.ravel()))]
    parts = [np.ravel(one)[:1].astype(str) for one in np.ravel(value)]
    return [str(part[0]).strip() for part in parts if part.size]


def _units(
    path: str | os.PathLike[str],
    name: str,
    shape: tuple[int, ...],
    read: Callable[[str], np.ndarray],
    others: Mapping[str, str],
) -> tuple[np.ndarray, str | None]:
    """Return the factors of a variable to its unit without prefix, and the unit that a text beside it states, if any."""
    own_name = name.rpartition(".")[2].lower()
    names = [prefix + ending for prefix in (f"{own_name}_", "", "y_") for ending in ("unit", "units")]
    for beside in _around(name, others):
        there = {own: key for key, own in beside if others[key] in _TEXTS}
        key = next((there[one] for one in names if one in there), "")
        texts = [text for text in _texts(read, key) if text] if key else []
        if not texts:
            continue
        factors, units = zip(*(unit_of(f"({text})") or (1.0, text) for text in texts), strict=True)
        if len(set(units)) == len(set(factors)) == 1:
            return np.array(factors[0]), units[0]
        if len(units) != min(shape):
            raise ValueError(f"{path} states {len(units)} units in {key!r}, {texts}, for {min(shape)} channel(s)")
        return np.expand_dims(factors, 1 if np.argmin(shape) == 0 else 0), ", ".join(units)
    return np.array(1.0), None


def _rate_and_start(
    path: str | os.PathLike[str],
    name: str,
    shapes: Mapping[str, tuple[int, ...]],
    read: Callable[[str], np.ndarray],
    others: Mapping[str, str],
) -> tuple[float | None, float]:
    """Return the sampling rate in Hz, if one is stored beside a variable, and the time of the first sample in s."""
    for beside in _around(name, {**shapes, **others}):
        rates: list[float | None] = []
        starts: list[float] = []
        for key, own in beside:
            rate, step, time = _RATE.fullmatch(own), _STEP.fullmatch(own), _TIMES.fullmatch(own)
            if key in shapes and math.prod(shapes[key]) == 1:
                number = float(np.asarray(read(key)).reshape(()))
                rates += [number * PREFIXES[rate[1] or ""]] if rate else []
                rates += [rate_of_step(number * PREFIXES[step[1] or ""], path)] if step else []
                starts += [number] if own == "tstart" and math.isfinite(number) else []
            elif others.get(key) in _TEXTS and (rate or step):
                what = "rate" if rate else "interval"
                rates += [stated_rate(path, [f"sampling {what}: {text}"]) for text in _texts(read, key)]
            elif time and _are_times(key, shapes.get(key, ()), shapes[name]):
                times = np.ravel(read(key)).astype(np.float64) * PREFIXES[time[1] or ""]
                if (interval := even_step(times)) is None:
                    raise ValueError(f"{path} has times in uneven steps: export it with a constant sampling rate")
                rates.append(rate_of_step(interval, path, rounding_of(times) / np.ptp(times)))
                starts.append(float(times[0]))
        stated = sorted(filter(None, rates))
        if stated and stated[-1] - stated[0] > SAME_RATE * abs(stated[0]):
            raise ValueError(f"{path} states several sampling rates beside {name!r}, {stated} Hz: leave only one")
        if stated:
            return stated[0], starts[0] if starts else 0.0
    return None, 0.0


def _are_times(name: str, shape: tuple[int, ...], signal: tuple[int, ...]) -> bool:
    """Return whether a variable holds the times of a signal's samples, by its name and its shape."""
    is_named = _TIMES.fullmatch(name.rpartition(".")[2].lower()) is not None
    return is_named and math.prod(shape) == max(shape, default=0) == max(signal) > 2


def _name_of(
    path: str | os.PathLike[str], shapes: Mapping[str, tuple[int, ...]], variable: str | None, others: Mapping[str, str]
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
