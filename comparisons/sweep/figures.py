"""Figures of a sweep: noise reduction and output power against the swept axis, with intervals.

A cross at the foot of a panel marks a cell with runs that diverged: its mean is over the others, if any.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from kfopc_filterpy.plot import curve_style

from ..studies.report_parts import MARK
from .grid import AXES, Grid, Values
from .table import Record

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BUILT_IN_FIGURES = ("noise_reduction_db", "output_power_db")
LABELS = {"noise_reduction_db": "Noise reduction (dB)", "output_power_db": "Output power / unconstrained (dB)"}
# Beyond these a run was on its way to divergence and would leave the others no room. The tables have its figures.
LOWEST, HIGHEST = {"noise_reduction_db": -20.0}, {"output_power_db": 40.0}
SHIFT = 0.08  # of a curve's marks beside those of the one before, if the axis has names
MOST_FIGURES = 40
MOST_MARKS = 30  # of a curve
LOGARITHMIC_FROM = 50.0  # ratio of the largest to the smallest positive value


def swept_axis(grid: Grid, chosen: str | None = None) -> str:
    """Return the axis that figures are drawn against: the one chosen, or the numbers with most values, or the names.

    Raises
    ------
    ValueError
        There is no axis of the chosen name.
    """
    if chosen is not None:
        if chosen not in grid.axes:
            raise ValueError(f"no axis called {chosen}; there are {', '.join(grid.axes)}")
        return chosen
    swept = grid.swept or (["algorithm"] if "algorithm" in grid.axes else list(grid.axes))
    return max(swept, key=lambda name: (_is_numeric(grid.axes[name]), len(grid.axes[name])))


def sweep_figures(grid: Grid, cells: Sequence[Record], figures: Sequence[str], x: str) -> dict[str, Figure]:
    """Return figures by file name, one for each combination of the axes that are neither `x` nor the curves."""
    others = [name for name in grid.swept if name != x]
    curves = "algorithm" if "algorithm" in others else (others[0] if others else None)
    apart = [name for name in others if name != curves]
    groups: dict[tuple[Any, ...], list[Record]] = {}
    for row in cells:
        groups.setdefault(tuple(row[name] for name in apart), []).append(row)
    drawn = {}
    for key, rows in list(groups.items())[:MOST_FIGURES]:
        fixed = dict(zip(apart, key, strict=True))
        drawn[_file_name(x, fixed)] = _figure(grid, rows, figures, x, curves, fixed)
    return drawn


def _figure(
    grid: Grid, rows: Sequence[Record], figures: Sequence[str], x: str, curves: str | None, fixed: Values
) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 1.2 + 2.7 * len(figures)), layout="constrained")
    axes = figure.subplots(len(figures), 1, sharex=True, squeeze=False)[:, 0]
    for ax, name in zip(axes, figures, strict=True):
        _panel(ax, grid, rows, name, x, curves)
    axes[-1].set_xlabel(_label(x))
    if curves is not None:
        _legend_above(axes[0])
    if fixed:
        figure.suptitle(
            ", ".join(f"{_label(name)}: {_words(value)}" for name, value in fixed.items()), fontsize="medium"
        )
    return figure


def _legend_above(ax: Axes) -> None:
    """Draw a legend above an axes, below the figure's title: in one row if it fits, else in two columns."""
    labels = ax.get_legend_handles_labels()[1]
    columns = len(labels) if sum(len(label) + 6 for label in labels) <= 75 else 2
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=columns, frameon=False, fontsize="small")


def _panel(ax: Axes, grid: Grid, rows: Sequence[Record], name: str, x: str, curves: str | None) -> None:
    values, numeric = grid.axes[x], _is_numeric(grid.axes[x])
    order = grid.axes[curves] if curves else (None,)
    for k, curve in enumerate(order):
        own = sorted(
            (row for row in rows if curves is None or row[curves] == curve), key=lambda row: values.index(row[x])
        )
        own = sorted(own, key=lambda row: row[x]) if numeric else own
        shift = 0.0 if numeric else SHIFT * (k - 0.5 * (len(order) - 1))
        places = [row[x] if numeric else values.index(row[x]) + shift for row in own]
        mean, low, high = (np.array([row[f"{name}_{end}"] for row in own], float) for end in ("mean", "low", "high"))
        bars = np.nan_to_num([mean - low, high - mean])  # no interval, no bar
        style = curve_style(k) | {"markersize": 4, "markevery": 1 + len(own) // MOST_MARKS, "linewidth": 1.2}
        if not numeric:
            style["linestyle"] = "none"
        ax.errorbar(
            places,
            mean,
            yerr=bars,
            capsize=2.5 if len(own) <= MOST_MARKS else 0.0,
            elinewidth=1,
            label=_words(curve),
            **style,
        )
        lost = [place for place, row in zip(places, own, strict=True) if row["diverged"]]
        ax.plot(lost, [0.03] * len(lost), "x", color=style["color"], transform=ax.get_xaxis_transform(), label="_")
    if name == "output_power_db" and "rated_power_db" in grid.axes:
        _mark_rated_power(ax, grid, x)
    if numeric:
        _scale(ax, values)
    else:
        ax.set_xticks(range(len(values)), [_words(value) for value in values])
        ax.set_xlim(-0.5, len(values) - 0.5)
    bottom, top = ax.get_ylim()
    ax.set_ylim(max(bottom, LOWEST.get(name, bottom)), min(top, HIGHEST.get(name, top)))
    ax.set_ylabel(LABELS.get(name, name))
    ax.grid(True, alpha=0.3)


def _mark_rated_power(ax: Axes, grid: Grid, x: str) -> None:
    """Draw the rated power as a line, if it is the same for all that is drawn."""
    rated = grid.axes["rated_power_db"]
    style: Any = {"color": MARK, "linewidth": 1, "linestyle": ":", "zorder": 1}
    if x == "rated_power_db":
        ends = [min(rated), max(rated)]
        line = ax.plot(ends, ends, **style)[0]
    elif len(rated) == 1:
        line = ax.axhline(rated[0], **style)
    else:
        return
    ax.legend([line], ["rated power"], frameon=False, fontsize="small", loc="best")


def _scale(ax: Axes, values: Sequence[float]) -> None:
    """Set the limits from the grid, so that a value at which nothing was stable keeps its place."""
    smallest, largest = min(values), max(values)
    if smallest == largest:
        return
    if smallest > 0 and largest / smallest >= LOGARITHMIC_FROM:
        ax.set_xscale("log")
        margin = (largest / smallest) ** 0.05
        ax.set_xlim(smallest / margin, largest * margin)
    else:
        margin = 0.05 * (largest - smallest)
        ax.set_xlim(smallest - margin, largest + margin)


def _is_numeric(values: Sequence[Any]) -> bool:
    return all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)


def _label(name: str) -> str:
    return AXES[name].label if name in AXES else name


def _words(value: Any) -> str:
    if isinstance(value, float) and math.isfinite(value):
        return f"{value:g}"
    return str(value)


def _file_name(x: str, fixed: Values) -> str:
    """Return a name without suffix, dots (which would look like one) and slashes."""
    parts = [x, *(f"{name}={_words(value)}" for name, value in fixed.items())]
    return "--".join("".join(c if c.isalnum() or c in "=-_+" else "_" for c in part) for part in parts)
