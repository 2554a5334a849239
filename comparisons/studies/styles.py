"""One colour, line and marker for an algorithm in all figures of the studies beyond the paper."""

from __future__ import annotations

from typing import Any

import numpy as np

from kfopc_filterpy.plot.results import STYLES

_DASHED = (0, (5, 2))
_MORE: dict[str, tuple[str, Any, str]] = {
    "KF-PB": ("#E69F00", "-", "v"),
    "FxRLS": ("#56B4E9", "-", "P"),
    "optimal leaky FxLMS": ("#000000", _DASHED, "X"),
    "re-scaling FxLMS": ("#8C564B", _DASHED, "<"),
    "two-gradient FxLMS": ("#7F7F7F", _DASHED, ">"),
    "clipping FxLMS": ("#B8A000", _DASHED, "h"),
    "KF-OPC repaired": ("#332288", "-", "p"),
    "diagonal KF": ("#882255", "-", "d"),
    "diagonal KF-OPC": ("#44AA99", "-", "8"),
    "FxNLMS": ("#AA4499", _DASHED, "*"),
    "leaky FxLMS": ("#999933", _DASHED, "1"),
    "MOV-FxLMS fixed": ("#117733", _DASHED, "2"),
    "MOV-MFxLMS": ("#88CCEE", _DASHED, "3"),
}


def style(algorithm: str) -> dict[str, Any]:
    """Colour, line style and marker of an algorithm of the registry."""
    if algorithm in STYLES:
        return {key: STYLES[algorithm][key] for key in ("color", "linestyle", "marker")}
    color, line, marker = _MORE[algorithm]
    return {"color": color, "linestyle": line, "marker": marker}


def curve_style(algorithm: str) -> dict[str, Any]:
    """The same for a curve of many points, which no marker could follow."""
    return {**style(algorithm), "linestyle": "-", "linewidth": 1.1, "marker": ""}


def legend_of(figure: Any, axes: Any) -> None:
    """One legend for all axes of a figure, above them, with each name once."""
    entries: dict[str, Any] = {}
    for ax in axes:
        entries |= {label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    room = 13.5 * figure.get_figwidth()  # characters of a row, the lines before the names included
    rows = int(np.ceil(sum(len(label) + 7 for label in entries) / room))
    columns = int(np.ceil(len(entries) / rows))
    figure.legend(entries.values(), entries, loc="outside upper center", ncols=columns, frameon=False, fontsize="small")
