"""Text: columns of numbers, with or without a time column, and impulse responses exported by REW."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from itertools import chain, islice
from typing import NamedTuple

import numpy as np

from .content import LEAST_SURE_RATE, NO_SIGNAL, Content, agreed_rate, even_step, rate_of_step, rounding_of

_LONGEST_HEADER = 100  # lines
_LONGEST_STATEMENT = 500  # characters of a line, in which a rate or a unit is looked for
_END, _ENOUGH = 4096, 20  # bytes and lines at the end by which a file that was cut is recognised
_TEKTRONIX = re.compile(
    r'"?Record Length"?(,[^,]*){4}'
)  # its header has three columns, beside those of times and samples
_CLOCK = re.compile(r"\d:\d\d:\d\d")
_REW = "* Impulse Response data saved by REW"
_LEAST_RISES = 10  # of a column that is no signal, between values that repeat
_UTF16 = (b"\xff\xfe", b"\xfe\xff")
_SECONDS = {"s": 1.0, "m": 1e-3, "u": 1e-6, "n": 1e-9}  # by the first letter of the unit
# The first column's name, if any, and its unit: "Time (ms)", "t/s", "(µs)"; "\ufffd" is µ in another encoding.
_TIME_UNIT = re.compile(r"\W*?(?:\w+?[\s(\[/_]+)?(seconds?|sec|s|ms|msec|[uµμ\ufffd]s|usec|ns)(?!\w)")
# What a header says of rate and units: "Sample Rate: 48000 Hz", "fs [kHz];51,2", "Sample interval = 20 us"; "P (mPa)".
_AFTER = r"\b[^\w.+-]*(?:([kmu\u00b5\u03bcn]?)(hz|s)\b[^\w.+-]*)?(\d[\d.,]*(?:e[-+]?\d+)?)(?:\s*,?\s*([kmu\u00b5\u03bcn]?)(hz|s)\b)?"
_STATED = {
    "hz": re.compile(r"\b(?:sampl\w*[ _-]*(?:rate|freq\w*)|(f_?s|sr))" + _AFTER, re.IGNORECASE),
    "s": re.compile(r"\b(?:sampl\w*[ _-]*(?:interval|period)|(dt|delta_x))" + _AFTER, re.IGNORECASE),
}
_UNIT = re.compile(  # in brackets, alone, unless a name, or after the slash of "p/Pa"; "mPa/V" is of a path
    r"(?:[(\[]\s*|^\W*(?![ANg]\b)|^[^(\[]*?/\s*)([muk\u00b5\u03bc]?)([Pp]ascals?|Pa|[Vv]olts?|V|A|N|g|m/s(?:\u00b2|\^?2)?)"
    r"(?:/([muk\u00b5\u03bc]?)(Pa|V|A|N|W))?\s*[)\]]?\W*$"
)
PREFIXES = {"": 1.0, "k": 1e3, "m": 1e-3, "u": 1e-6, "\u00b5": 1e-6, "\u03bc": 1e-6, "n": 1e-9}
_FORTRAN = re.compile(r"(?<=[\d.])[dD](?=[-+]?\d)")  # 1.0D-03
_FIRST_NAME = re.compile(r"\A(?:[^,;\t]*[,;\t]|\s*\S+\s+)")  # of a heading
_FREQUENCY = re.compile(r"\W*(freq|hz\b|f\s*[(\[/]\s*hz)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"(?<=\d),(?=\d)")
_ONE_COMMA = re.compile(r"([+-]?\d+),(\d+)(e[+-]?\d+)?", re.IGNORECASE)  # two columns of whole numbers, or one number
_QUOTED = re.compile(r'"([^"]*)"')


class Table(NamedTuple):
    """Columns of numbers, (n_rows, n_columns), the lines above them, and the columns' headings if any."""

    header: list[str]
    columns: np.ndarray
    names: list[str]


class _Layout(NamedTuple):
    """Which line is the first with numbers, what separates them, and how they are written."""

    first: int
    delimiter: str | None
    has_decimal_comma: bool
    has_empty_column: bool

    def plain(self, line: str) -> str:
        """Return a line without quotes, decimal commas and separators around it; a comma within quotes is decimal."""
        if '"' in line:
            line = _QUOTED.sub(lambda quoted: _DECIMAL_COMMA.sub(".", quoted[1].lstrip()), line)
        line = line.rstrip()
        line = _DECIMAL_COMMA.sub(".", line) if self.has_decimal_comma else line
        line = _FORTRAN.sub("e", line)
        line = line.lstrip(self.delimiter) if self.has_empty_column else line
        return line.rstrip(self.delimiter) if self.delimiter else line


def read_text(path: str | os.PathLike[str]) -> Content:
    """Return the columns of a text file as channels; a first column of evenly rising times gives the rate."""
    head = list(islice(_lines(path), _LONGEST_HEADER))
    if head and head[0].startswith(_REW):
        return _read_rew(path, head)
    table = _read_table(path)
    content = without_time(path, table)
    rounding = rounding_of(table.columns[:, 0]) / (np.ptp(table.columns[:, 0]) or 1.0)
    return content._replace(fs=agreed_rate(path, stated_rate(path, table.header), content.fs, rounding))


def stated_rate(path: str | os.PathLike[str], header: list[str]) -> float | None:
    """Return the rate in Hz that a header names, None if it names none."""
    for kind, stated in _STATED.items():
        for found in filter(None, (stated.search(line[:_LONGEST_STATEMENT]) for line in header)):
            short, before, unit_before, number, after, unit_after = found.groups()
            plain = number.replace(",", "" if re.fullmatch(r"\d+(,\d{3})+", number) else ".").rstrip(".")
            value = float(plain) * PREFIXES[(before or after or "").lower()]
            unit = (unit_before or unit_after or kind).lower()
            if unit == kind and not (short and kind == "hz" and value < LEAST_SURE_RATE):  # "FS: 10 V" is full scale
                return value if kind == "hz" else rate_of_step(value, path)
    return None


def unit_of(heading: str) -> tuple[float, str] | None:
    """Return the factor to a unit without prefix, and the unit, at the end of a heading: 1e-3 and "Pa" for "p (mPa)"."""
    found = _UNIT.search(heading[:_LONGEST_STATEMENT])
    if found is None:
        return None
    unit = re.sub("^[Vv]olts?$", "V", re.sub("^[Pp]ascals?$", "Pa", found[2])) + (f"/{found[4]}" if found[4] else "")
    return PREFIXES[found[1]] / PREFIXES[found[3] or ""], unit


def _units(names: list[str]) -> tuple[np.ndarray, str | None]:
    """Return the factors of columns to units without prefix, and the units, by the columns' headings."""
    found = [unit_of(name) for name in names]
    factors = np.array([one[0] if one else 1.0 for one in found] or [1.0])
    units = [one[1] if one else "1" for one in found]
    return factors, ", ".join(units[: 1 if len(set(units)) == 1 else None]) if any(found) else None


def _read_table(path: str | os.PathLike[str]) -> Table:
    """Return the columns of a text file in any layout."""
    head = list(islice(_lines(path), _LONGEST_HEADER))
    layout = _layout(path, head)
    header = [line for line in head[: layout.first] if line.strip()]
    if layout.delimiter == "," and _ONE_COMMA.fullmatch(layout.plain(head[layout.first]).strip()):
        heading = header[-1].strip() if header else ""
        if _is_decimal(path, heading, islice(_lines(path), layout.first, None)):
            layout = layout._replace(delimiter=None, has_decimal_comma=True)
    _require_line_end(path)
    rows = (
        layout.plain(line) for line in islice(_lines(path), layout.first, None) if not _is_comment(line, layout, path)
    )
    try:
        columns = np.loadtxt(rows, delimiter=layout.delimiter, comments=None, ndmin=2)
    except ValueError as error:
        what = str(error).partition("; use `usecols`")[0]
        raise ValueError(
            f"{path} is damaged or cut short, or has an empty field: from line {layout.first + 1} on, {what}"
        ) from error
    n_names = len(header[-1].split(",")) if header and layout.delimiter == "," else 0
    if n_names > 1 and 2 * n_names == columns.shape[1] and not np.any(columns % 1):  # "t,p" above "0,125,0,5"
        raise _ambiguous(path)
    names = layout.plain(header[-1]).split(layout.delimiter) if header and columns.shape[1] > 1 else header[-1:]
    return Table(header, columns, names if len(names) == columns.shape[1] else [])


def _lines(path: str | os.PathLike[str]) -> Iterator[str]:
    with open(path, "rb") as file:
        encoding = "utf-16" if file.read(2) in _UTF16 else "utf-8-sig"
    # Names and units may be in any encoding. Damage within a number leaves no number.
    with open(path, encoding=encoding, errors="replace") as text:
        first = text.readline()
        is_beside = _TEKTRONIX.match(first)
        for line in chain((first,), text):
            yield line.split(",", 3)[-1] if is_beside else line


def _layout(path: str | os.PathLike[str], head: list[str]) -> _Layout:
    if any("\0" in line for line in head):
        raise ValueError(f"{path} is neither text nor of a kind that is read: export it as WAV, text, .mat or .npy")
    for first, line in enumerate(head):
        for delimiter in (";", "\t", ",", None):
            is_empty = delimiter is not None and all(one.startswith(delimiter) for one in head[first : first + 2])
            layout = _Layout(first, delimiter, delimiter != ",", is_empty)
            if (delimiter is None or delimiter in line) and _are_numbers(layout.plain(line), delimiter):
                return layout
    shown = next((line.strip() for line in head if line.strip()), "")[:60]
    gaps = [n for n, line in enumerate(head, 1) if re.search(r"\d *([,;\t]) *\1 *[-+.\d]", line)]
    raise ValueError(
        f"{path} is text that is no numbers: none in its first {len(head)} lines, which begin with {shown!r}; expected "
        "a column for each channel, at most 100 lines of header"
        + (f"; line {gaps[0]} has an empty field: fill it, or leave out its column" if gaps else "")
        + (
            "; times of day (hh:mm:ss) are not read: export seconds, or leave them out"
            if _CLOCK.search(head[-1])
            else ""
        )
    )


def _are_numbers(line: str, delimiter: str | None) -> bool:
    try:
        return len([float(field) for field in line.strip().split(delimiter)]) > 0
    except ValueError:
        return False


def _is_comment(line: str, layout: _Layout, path: str | os.PathLike[str]) -> bool:
    """Return whether a "#" begins a line, and no numbers follow: "1.#INF" is no 1, and "#3" may be one."""
    if not line.startswith("#"):
        return False
    if _are_numbers(layout.plain(line[1:]), layout.delimiter):
        raise ValueError(f"{path} has the line {line.strip()!r} among its numbers: leave out the line, or the #")
    return True


def _require_line_end(path: str | os.PathLike[str]) -> None:
    """Raise ValueError if a file ends within its last number: without a line end, and shorter than all before."""
    with open(path, "rb") as file:
        file.seek(max(file.seek(0, os.SEEK_END) - _END, 0))
        before, _, last = file.read().rpartition(b"\n")
    lengths = [len(line.rstrip(b"\r")) for line in before.split(b"\n")[1:]]
    if last.strip(b"\0 \r\t") and len(lengths) >= _ENOUGH and len(last) < min(lengths):
        raise ValueError(
            f"{path} ends within a line, {last.decode(errors='replace')!r}, which is shorter than those before: was it cut? If "
            "it is complete, end it as a line"
        )


def _is_decimal(path: str | os.PathLike[str], names: str, lines: Iterator[str]) -> bool:
    """Return whether the only comma of each line is a decimal comma; it separates whole numbers otherwise."""
    decimal = bool(names) and "," not in names and names[0] not in "#%*"  # a heading of one column
    count, rises, before = 0, True, None
    for line in lines:
        if not line.strip():
            continue
        found = _ONE_COMMA.fullmatch(line.strip())
        if found is None:  # a point, a sign, another comma
            return False
        whole, rest, exponent = found.groups()
        decimal = decimal or whole.startswith("-0") or (rest[0] == "0" and len(rest) > 1) or exponent is not None
        rises = rises and before in (None, int(whole) - 1)
        count, before = count + 1, int(whole)
    separated = "," in names or (rises and count > 2)
    if decimal == separated:
        raise _ambiguous(path)
    return decimal


def _ambiguous(path: str | os.PathLike[str]) -> ValueError:
    return ValueError(
        f"{path} has commas that may separate columns or be decimal commas: write decimals with a point or separate columns "
        "with a semicolon, and name the columns in the line above the numbers"
    )


def without_time(path: str | os.PathLike[str], table: Table) -> Content:
    """Return the channels (rows are samples); leave out a column that counts samples or time, which gives the rate."""
    header, columns, names = table
    factors, unit = _units(names)
    if columns.shape[1] < 2:
        return Content(columns * factors, None, unit)
    if any(map(_FREQUENCY.match, header[-1:])) or any("frequency step" in line.lower() for line in header):
        raise ValueError(
            f"{path} is a frequency response, its first column is a frequency in Hz ({header[-1].strip()!r}): export the "
            "impulse response (or the recording) instead"
        )
    times, steps = columns[:, 0], np.diff(columns[:, 0])
    without_first = Table([_FIRST_NAME.sub("", line, count=1) for line in header], columns[:, 1:], names[1:])
    if header and header[-1].startswith((",", ";", "\t")) and np.all(steps == 1):  # an index, which has no name
        return without_time(path, without_first)
    repeats = np.any(steps == 0) and np.sum(steps) >= _LEAST_RISES * np.max(steps)  # times with few digits
    if len(times) < 3 or not (np.all(steps > 0) or (np.all(steps >= 0) and repeats)):
        return Content(columns * factors, None, unit)
    step = even_step(times)
    if step is None:
        if len(times) >= NO_SIGNAL:
            raise ValueError(
                f"{path} has a first column that rises in uneven steps, from {steps.min():g} to {steps.max():g}: export it "
                "with a constant sampling rate and all digits of the times, or without the times; of a frequency response or a "
                "microphone's calibration file, export the impulse response"
            )
        return Content(columns * factors, None, unit)
    stated = (_TIME_UNIT.match(line[:_LONGEST_STATEMENT]) for line in reversed(header))
    units = [found[1] for found in stated if found]
    if step == 1 and not units:  # the number of each sample
        named = dict(zip(*(line.strip().split(",") for line in header[-2:]), strict=False)) if len(header) > 1 else {}
        if {"Start", "Increment"} <= named.keys():  # an oscilloscope of Rigol
            step_s, start_s = float(named["Increment"]), float(named["Start"])
            return Content(columns[:, 1:], rate_of_step(step_s, path), start_s=start_s)
        return without_time(path, without_first)
    if step > 1 and not units:
        raise ValueError(
            f"{path} has a first column that rises in steps of {step:g} without a unit: are they times? Name their unit "
            'in the line above the numbers, as in "Time (ms)", or leave out the column'
        )
    unit_s = _SECONDS.get(units[0][0], 1e-6) if units else 1.0
    factors, unit = _units(names[1:])
    fs = rate_of_step(step * unit_s, path, rounding_of(times) / np.ptp(times))
    return Content(columns[:, 1:] * factors, fs, unit, float(times[0] * unit_s))


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
    _require_line_end(path)
    taps = np.loadtxt((line.replace(",", ".") for line in islice(_lines(path), starts[0] + 1, None)), ndmin=1)
    if taps.shape != (length,):
        raise ValueError(f"{path} is damaged or cut short: its header claims {length:g} samples, got {taps.shape}")
    if re.search(r"^\* IR is normalised", header, flags=re.M):
        if "Peak value before normalisation" not in values:
            raise ValueError(f"{path} is normalised, without the peak it had: export it again, not normalised")
        taps = taps * float(values["Peak value before normalisation"].replace(",", "."))
    return Content(taps, rate_of_step(step, path), start_s=start)
