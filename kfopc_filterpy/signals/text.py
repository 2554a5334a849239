"""Text: columns of numbers, with or without a time column, and impulse responses exported by REW."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np

from .content import Content, rate_of_step

_LONGEST_HEADER = 100  # lines
_REW = "* Impulse Response data saved by REW"
_ROUNDED = 0.35  # share by which a step between times may differ: they are written with few digits
_NO_SIGNAL = 100  # rows: no signal rises for so long
_UTF16 = (b"\xff\xfe", b"\xfe\xff")


class _Layout(NamedTuple):
    """Which line is the first with numbers, what separates them, and whether decimals follow a comma."""

    first: int
    delimiter: str | None
    has_decimal_comma: bool


def read_text(path: str | os.PathLike[str]) -> Content:
    """Return the columns of a text file as channels; a first column of evenly rising times gives the rate."""
    head = [line for _, line in zip(range(_LONGEST_HEADER), _lines(path), strict=False)]
    if head and head[0].startswith(_REW):
        return _read_rew(path, head)
    layout = _layout(path, head)
    lines: Iterator[str] = islice(_lines(path), layout.first, None)
    if layout.has_decimal_comma:
        lines = (line.replace(",", ".") for line in lines)
    table = np.loadtxt(lines, delimiter=layout.delimiter, ndmin=2)
    return _without_time(path, table)


def _lines(path: str | os.PathLike[str]) -> Iterator[str]:
    with open(path, "rb") as file:
        encoding = "utf-16" if file.read(2) in _UTF16 else "utf-8-sig"
    # Names and units may be in any encoding. Damage within a number leaves no number.
    with open(path, encoding=encoding, errors="replace") as text:
        yield from text


def _layout(path: str | os.PathLike[str], head: list[str]) -> _Layout:
    for first, line in enumerate(head):
        for delimiter in (";", "\t", ",", None):
            comma = delimiter != "," and "," in line
            if (delimiter is None or delimiter in line) and _are_numbers(line, delimiter, comma):
                return _Layout(first, delimiter, comma)
    shown = next((line.strip() for line in head if line.strip()), "")[:60]
    raise ValueError(
        f"{path} is text that is no numbers: none in its first {len(head)} lines, which begin with {shown!r}; expected "
        "a column for each channel, at most 100 lines of header"
    )


def _are_numbers(line: str, delimiter: str | None, has_decimal_comma: bool) -> bool:
    fields = (line.replace(",", ".") if has_decimal_comma else line).strip().split(delimiter)
    try:
        return len([float(field) for field in fields]) > 0
    except ValueError:
        return False


def _without_time(path: str | os.PathLike[str], table: np.ndarray) -> Content:
    """Return the channels (rows are samples); leave out a column that counts samples or time, which gives the rate."""
    times = table[:, 0]
    steps = np.diff(times)
    if table.shape[1] < 2 or len(table) < 3 or not np.all(steps > 0):
        return Content(table)
    step = (times[-1] - times[0]) / (len(times) - 1)
    drift = np.max(np.abs(times - times[0] - step * np.arange(len(times))))
    if not (np.max(np.abs(steps - step)) <= _ROUNDED * step and drift <= step):
        if len(table) >= _NO_SIGNAL:
            raise ValueError(
                f"{path} has a first column that rises in uneven steps, from {steps.min():g} to {steps.max():g}: export it "
                "with a constant sampling rate, or without the times"
            )
        return Content(table)
    if step == 1:  # the number of each sample
        return Content(table[:, 1:])
    return Content(table[:, 1:], rate_of_step(step, path), start_s=float(times[0]))


def _read_rew(path: str | os.PathLike[str], head: list[str]) -> Content:
    """Return an impulse response that REW exported as text, with its normalisation undone."""
    starts = [index for index, line in enumerate(head) if line.startswith("* Data start")]
    header = "".join(head[: starts[0]]) if starts else ""
    values = dict(map(reversed, re.findall(r"^(\S+) // ([^(\n]*[^(\s])", header, flags=re.M)))
    needed = ("Response length", "Sample interval", "Start time")
    missing = [name for name in needed if name not in values]
    if missing:
        raise ValueError(f"{path} is an export of REW without {', '.join(missing)} in its header: export it again")
    if re.search(r"^\* IR is the min phase", header, flags=re.M):
        raise ValueError(
            f"{path} is REW's minimum-phase version, which has lost the path's delay: export the measured impulse response"
        )
    length, step, start = (float(values[name].replace(",", ".")) for name in needed)
    taps = np.loadtxt((line.replace(",", ".") for line in islice(_lines(path), starts[0] + 1, None)), ndmin=1)
    if taps.shape != (length,):
        raise ValueError(f"{path} is damaged or cut short: its header claims {length:g} samples, got {taps.shape}")
    if re.search(r"^\* IR is normalised", header, flags=re.M):
        if "Peak value before normalisation" not in values:
            raise ValueError(f"{path} is normalised, without the peak it had: export it again, not normalised")
        taps = taps * float(values["Peak value before normalisation"].replace(",", "."))
    return Content(taps, rate_of_step(step, path), start_s=start)
