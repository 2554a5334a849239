"""What a sweep writes: means and intervals of its cells as tables and a figure."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import t as student

from kfopc_filterpy._writing import replacing, write_whole
from kfopc_filterpy.plot import curve_style

from ..studies.report_parts import MARK, new_figure
from .grid import AXES, Grid
from .scenario import Figures

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CONFIDENCE = 0.95
FORMATS = ("csv", "parquet")
LABELS = {"noise_reduction_db": "Noise reduction (dB)", "output_power_db": "Output power / unconstrained (dB)"}
# Beyond these a run was on its way to divergence and would leave the others no room. The tables have its figures.
LIMITS = {"noise_reduction_db": (-20.0, math.inf), "output_power_db": (-math.inf, 40.0)}
MOST_CURVES = 24  # that differ in colour and line; the tables hold all
LOGARITHMIC_FROM = 50.0  # ratio of the largest to the smallest positive value

Record = dict[str, Any]


# ---- Tables


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
    mean = float(np.mean(finite)) if count else math.nan
    half = math.nan
    if count > 1:
        half = float(student.ppf(0.5 + CONFIDENCE / 2, count - 1) * np.std(finite, ddof=1) / math.sqrt(count))
    return mean, mean - half, mean + half, count


def cell_rows(grid: Grid, figures: Sequence[Figures]) -> list[Record]:
    """Return a row for each cell: the axes, the runs and how many diverged, and mean and interval of each figure.

    Means are over the seeds that did not diverge.
    """
    rows, seeds, names = [], len(grid.seeds), figure_names(figures)
    for i, values in enumerate(grid.cells()):
        own = figures[i * seeds : (i + 1) * seeds]
        stable = [one for one in own if not one["diverged"]]
        row: Record = values | {"runs": seeds, "diverged": seeds - len(stable)}
        for name in names:
            over = own if name == "diverged_at_s" else stable
            statistics = mean_and_interval(one.get(name, math.nan) for one in over)
            row |= zip((f"{name}_mean", f"{name}_low", f"{name}_high", f"{name}_n"), statistics, strict=True)
        rows.append(row)
    return rows


def figure_names(figures: Sequence[Figures]) -> list[str]:
    """Return the names of the figures of all runs, in the order of the first run that has one."""
    return list(dict.fromkeys(name for one in figures for name in one if name != "diverged"))


def write_table(rows: Sequence[Record], path_without_suffix: Path, kind: str) -> Path:
    """Write rows as CSV, numbers in full precision and nothing for NaN, or as Parquet."""
    path = path_without_suffix.with_name(f"{path_without_suffix.name}.{kind}")
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(name for row in rows for name in row)), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: "" if value != value else value for name, value in row.items()})
    if kind == "csv":
        write_whole(path, text.getvalue())
    else:
        from pyarrow import csv as pyarrow_csv
        from pyarrow import parquet

        with replacing(path) as file:
            parquet.write_table(pyarrow_csv.read_csv(io.BytesIO(text.getvalue().encode())), file)
    return path


# ---- The figure


def swept_axis(grid: Grid) -> str:
    """Return the axis that the figure is drawn against: that of most numbers, or of most names if none has numbers."""
    return max(grid.swept or grid.axes, key=lambda name: (_is_numeric(grid.axes[name]), len(grid.axes[name])))


def sweep_figure(grid: Grid, cells: Sequence[Record], names: Sequence[str]) -> Figure:
    """Return a figure with a panel for each figure of merit, a curve for each combination of the other axes.

    A cross at the bottom marks a cell with runs that diverged: its mean is over the others, if any.
    """
    x = swept_axis(grid)
    curves: dict[str, list[Record]] = {}
    for cell in cells:
        others = {name: cell[name] for name in grid.swept if name != x}
        words = [value if isinstance(value, str) else f"{name}={value}" for name, value in others.items()]
        curves.setdefault(", ".join(words) or "mean", []).append(cell)
    figure, axes = new_figure((6.4, 1.2 + 2.7 * len(names)), len(names), sharex=True)
    panels = axes[:, 0]
    for ax, name in zip(panels, names, strict=True):
        for k, (label, own) in enumerate(islice(curves.items(), MOST_CURVES)):
            _curve(ax, own, name, x, curve_style(k) | {"label": label, "markersize": 4})
        ax.set_ylim(*np.clip(ax.get_ylim(), *LIMITS.get(name, (-math.inf, math.inf))))
        ax.set_ylabel(LABELS.get(name, name))
    if x == "rated_power_db":
        ends = [min(grid.axes[x]), max(grid.axes[x])]
        panels[-1].plot(ends, ends, color=MARK, linewidth=1, linestyle=":", label="rated power")
    if _is_numeric(grid.axes[x]) and 0 < LOGARITHMIC_FROM * min(grid.axes[x]) <= max(grid.axes[x]):
        panels[-1].set_xscale("log")
    panels[-1].set_xlabel(AXES[x].label if x in AXES else x)
    handles, labels = panels[-1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False, fontsize="small")
    return figure


def _curve(ax: Axes, cells: Sequence[Record], name: str, x: str, style: dict[str, Any]) -> None:
    if _is_numeric([cell[x] for cell in cells]):
        cells = sorted(cells, key=lambda cell: cell[x])
        places = [cell[x] for cell in cells]
    else:
        places, style = [str(cell[x]) for cell in cells], style | {"linestyle": "none"}
    mean, low, high = (np.array([cell[f"{name}_{end}"] for cell in cells]) for end in ("mean", "low", "high"))
    bars = np.nan_to_num([mean - low, high - mean])  # no interval, no bar
    ax.errorbar(places, mean, yerr=bars, capsize=2.5, elinewidth=1, **style)
    lost = [place for place, cell in zip(places, cells, strict=True) if cell["diverged"]]
    ax.plot(lost, [0.03] * len(lost), "x", color=style["color"], transform=ax.get_xaxis_transform())


def _is_numeric(values: Sequence[Any]) -> bool:
    return all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
