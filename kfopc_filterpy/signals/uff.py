"""Universal File Format (UFF), data set 58: functions at nodal degrees of freedom."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from .._validate import optional_module
from .content import Content, rate_of_step

_IN_TIME = {0: "general", 1: "time response", 25: "FIR filter"}  # function types whose samples may be in time
_PADDED = re.compile(rb"^((?: *[-+]?\d\.\d+[eE][-+]\d+)+) +(?=\r?$)", re.MULTILINE)  # a row of numbers, then blanks
_LONGEST_ROW = 6  # numbers
_BINARY = re.compile(rb"^    58b", re.MULTILINE)


def read_uff(path: str | os.PathLike[str]) -> Content:
    """Return the time signals of a UFF file, one channel for each data set 58, and their rate and unit."""
    pyuff = optional_module("pyuff", "formats", f"{path} is a UFF file, which")
    content = Path(path).read_bytes()
    if _PADDED.search(content) is None or _BINARY.search(content):
        return _from_pyuff(path, pyuff.UFF(os.fspath(path)))
    # pyuff takes the blanks after the last number for numbers, and reads only files.
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "unpadded.uff"
        copy.write_bytes(_PADDED.sub(rb"\1", content))
        return _from_pyuff(path, pyuff.UFF(str(copy)))


def _from_pyuff(path: str | os.PathLike[str], file: Any) -> Content:
    wanted = [index for index, kind in enumerate(file.get_set_types()) if kind == 58]
    if not wanted:
        raise ValueError(f"{path} has no whole data set 58: it is cut short, or holds something else than signals")
    headers = [file.read_sets(index, header_only=True) for index in wanted]
    in_time = [index for index, header in zip(wanted, headers, strict=True) if header["func_type"] in _IN_TIME]
    if not in_time:
        kinds = sorted({header["func_type"] for header in headers})
        raise ValueError(
            f"{path} holds no signal in time, function type 1, but the types {kinds} (4 is a frequency response): export "
            "time signals or impulse responses"
        )
    sets = [file.read_sets(index) for index in in_time]
    for one in sets:
        surplus = one["data"][one["num_pts"] :]
        if surplus.size < _LONGEST_ROW and not np.any(surplus):  # some writers fill the last row with zeros
            one["data"] = one["data"][: one["num_pts"]]
        _require_even(path, one)
    grids = {(one["data"].size, one["abscissa_inc"], one["abscissa_min"]) for one in sets}
    if len(grids) != 1:
        sizes = ", ".join(f"{size} samples each {step:g} s from {start:g} s" for size, step, start in sorted(grids))
        raise ValueError(f"{path} holds signals of different lengths or rates, {sizes}: export one file for each")
    ((_, step, start),) = grids
    units = {str(one.get("ordinate_axis_units_lab", "")).strip() for one in sets} - {"", "NONE", "None"}
    samples = np.array([one["data"] for one in sets])
    unit = units.pop() if len(units) == 1 else None
    return Content(samples[0] if len(samples) == 1 else samples, rate_of_step(step, path), unit, start)


def _require_even(path: str | os.PathLike[str], one: dict[str, Any]) -> None:
    if one["ord_data_type"] not in (2, 4):
        raise ValueError(f"{path} must hold real numbers, got complex ones (ordinate type {one['ord_data_type']})")
    if one["abscissa_spacing"] != 1:
        raise ValueError(f"{path} must be sampled evenly, got uneven spacing: export it with a constant sampling rate")
    if one["data"].size != one["num_pts"]:
        raise ValueError(
            f"{path} is damaged or cut short: its header claims {one['num_pts']} samples, {one['data'].size} could be read"
        )
    if one["data"].size == 0:
        raise ValueError(f"{path} holds no samples (zero points)")
