"""Means and intervals of a sweep's cells, and the tables that are written of them."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from kfopc_filterpy.bench import write_whole

from .grid import Grid

CONFIDENCE = 0.95
FORMATS = ("csv", "parquet")

Record = dict[str, Any]


def mean_and_interval(values: Iterable[float]) -> tuple[float, float, float, int]:
    """Return the mean, the lower and the upper end of its 95 % t-interval, and the number of the finite values.

    The interval is NaN for a single value, and all is NaN for none.

    Examples
    --------
    >>> mean, low, high, count = mean_and_interval([1.0, 2.0, 3.0])
    >>> print(f"{mean:.2f} ({low:.2f} to {high:.2f}) of {count}")  # 2 ± 4.303 / sqrt(3)
    2.00 (-0.48 to 4.48) of 3
    """
    finite = np.array([value for value in values if math.isfinite(value)])
    count = finite.size
    if count == 0:
        return math.nan, math.nan, math.nan, 0
    mean = float(np.mean(finite))
    if count == 1:
        return mean, math.nan, math.nan, 1
    half = float(student.ppf(0.5 + CONFIDENCE / 2, count - 1) * np.std(finite, ddof=1) / math.sqrt(count))
    return mean, mean - half, mean + half, count


def run_rows(grid: Grid, done: Mapping[int, Mapping[str, Any]]) -> list[Record]:
    """Return a row for each run: the axes, the seed, the figures."""
    return [run.values | {"seed": run.seed} | dict(done[run.index]) for run in grid.runs() if run.index in done]


def cell_rows(grid: Grid, done: Mapping[int, Mapping[str, Any]]) -> list[Record]:
    """Return a row for each cell: the axes, the runs and how many diverged, and mean and interval of each figure.

    Means are over the seeds that did not diverge.
    """
    names = figure_names(done)
    rows = []
    seeds = len(grid.seeds)
    for i, values in enumerate(grid.cells()):
        own = [done[index] for index in range(i * seeds, (i + 1) * seeds) if index in done]
        stable = [figures for figures in own if not figures["diverged"]]
        row: Record = values | {"runs": len(own), "diverged": len(own) - len(stable)}
        for name in names:
            figures = mean_and_interval(one.get(name, math.nan) for one in (own if name == "diverged_at_s" else stable))
            row |= dict(zip((f"{name}_mean", f"{name}_low", f"{name}_high", f"{name}_n"), figures, strict=True))
        rows.append(row)
    return rows


def figure_names(done: Mapping[int, Mapping[str, Any]]) -> list[str]:
    """Return the names of the figures of all runs, in the order of the first run that has one."""
    return list(dict.fromkeys(name for index in sorted(done) for name in done[index] if name != "diverged"))


def write_table(rows: Sequence[Record], path_without_suffix: Path, kind: str) -> Path:
    """Write rows as CSV (numbers in full precision, nothing for NaN) or as Parquet, whole or not at all."""
    path = path_without_suffix.with_name(f"{path_without_suffix.name}.{kind}")
    names = list(dict.fromkeys(name for row in rows for name in row))
    if kind == "parquet":
        _write_parquet(rows, names, path)
        return path
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([["" if _absent(row.get(name)) else row[name] for name in names] for row in rows])
    write_whole(path, text.getvalue())
    return path


def require_format(kind: str) -> None:
    """Raise an error if a format is unknown or cannot be written here."""
    if kind not in FORMATS:
        raise ValueError(f"format must be one of {', '.join(FORMATS)}, got {kind!r}")
    if kind == "parquet" and find_spec("pyarrow") is None:
        raise ModuleNotFoundError(
            'Parquet needs the extra parquet: python -m pip install -c constraints.txt -e ".[parquet]"; or take csv'
        )


def _write_parquet(rows: Sequence[Record], names: Sequence[str], path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    columns = {name: [None if _absent(row.get(name)) else row[name] for row in rows] for name in names}
    partial = path.with_name(f".{path.name}.partial")
    try:
        parquet.write_table(pyarrow.table({name: _of_one_type(own) for name, own in columns.items()}), partial)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _of_one_type(column: list[Any]) -> list[Any]:
    """Return the column as it is, its numbers as floats if some are, or all as strings if the types differ."""
    kinds = {type(value) for value in column if value is not None}
    if len(kinds) <= 1:
        return column
    cast: Any = float if kinds == {int, float} else str
    return [None if value is None else cast(value) for value in column]


def _absent(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))
