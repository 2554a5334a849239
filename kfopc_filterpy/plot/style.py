"""What the figures share: colours, axes in Hz and dB, legends."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .._types import NumberOrArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

# Colour, line style and marker of each algorithm. The first seven have Okabe and Ito's colours, which colour-blind
# readers tell apart; line styles and markers serve prints in grey.
_DASHED = (0, (5, 2))
STYLES: dict[str, tuple[str, Any, str]] = {
    "KF-OPC": ("#0072B2", "-", "o"),
    "KF-ANC": ("#D55E00", (0, (5, 2.5)), "s"),
    "MOV-FxLMS": ("#009E73", (0, (5, 3, 1, 3)), "^"),
    "FxLMS": ("#CC79A7", ":", "D"),
    "KF-PB": ("#E69F00", "-", "v"),
    "FxRLS": ("#56B4E9", "-", "P"),
    "optimal leaky FxLMS": ("#000000", _DASHED, "X"),
    "re-scaling FxLMS": ("#8C564B", _DASHED, "<"),
    "two-gradient FxLMS": ("#7F7F7F", _DASHED, ">"),
    "clipping FxLMS": ("#B8A000", _DASHED, "h"),
    "diagonal KF": ("#882255", "-", "d"),
    "diagonal KF-OPC": ("#44AA99", "-", "8"),
    "FxNLMS": ("#AA4499", _DASHED, "*"),
    "leaky FxLMS": ("#999933", _DASHED, "1"),
    "MOV-FxLMS fixed": ("#117733", _DASHED, "2"),
    "MOV-FxLMS by variance": ("#661100", _DASHED, "4"),
    "MOV-MFxLMS": ("#88CCEE", _DASHED, "3"),
    "frequency-domain FxLMS": ("#CC6677", "-", "H"),
    "power-limited FxLMS": ("#DDAA33", "-", "H"),
}
UNLISTED = ("#000000", ":", "x")  # an algorithm that is not in the table
COLOURS = 6  # curves without an algorithm take the colours and markers of the first so many rows
LINES = ("-", "--", "-.", ":")
MARK = "0.35"


def curve_style(curve: str | int) -> dict[str, Any]:
    """Return the colour, line style and marker of an algorithm's curve, or of the i-th other curve.

    An algorithm has the same style in every figure of the package and of the studies.

    Parameters
    ----------
    curve : str or int
        Name of an algorithm, such as "KF-OPC", or the number of the curve, from 0. The numbers
        repeat six colours and four line styles. An algorithm without a style of its own is drawn black and dotted.

    Returns
    -------
    dict
        ``color``, ``linestyle`` and ``marker``, as matplotlib's ``plot`` takes them.

    Examples
    --------
    >>> from kfopc_filterpy.plot import curve_style
    >>> curve_style("KF-OPC")
    {'color': '#0072B2', 'linestyle': '-', 'marker': 'o'}
    >>> curve_style(1)
    {'color': '#D55E00', 'linestyle': '--', 'marker': 's'}
    """
    if isinstance(curve, str):
        colour, line, marker = STYLES.get(curve, UNLISTED)
    else:
        colour, _, marker = list(STYLES.values())[curve % COLOURS]
        line = LINES[curve % COLOURS % len(LINES)]
    return {"color": colour, "linestyle": line, "marker": marker}


def new_axes(ax: Any, rows: int = 1) -> Any:
    """Return `ax`, or `rows` new axes one above the other."""
    if ax is None:
        import matplotlib.pyplot as plt

        return plt.subplots(rows, 1, figsize=(6.4, 2.4 + 1.6 * rows), sharex=True, layout="constrained")[1]
    if rows > 1 and np.size(ax) != rows:
        raise ValueError(f"ax must be {rows} axes, one above the other, got {np.size(ax)}; leave it out for new")
    return ax


def line_style(i: int) -> dict[str, Any]:
    """Return the colour and line style of the i-th curve, without a marker."""
    return {key: value for key, value in curve_style(i).items() if key != "marker"}


def frequency_axis(ax: Axes, frequencies: np.ndarray) -> Axes:
    """Make a logarithmic axis in Hz with ticks at 1, 2 and 5 written out, and return the axes as `labelled` does."""
    from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

    ax.set_xscale("log")
    ax.set_xlim(frequencies[frequencies > 0].min(), frequencies.max())
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(EngFormatter(sep=""))
    ax.xaxis.set_minor_formatter(NullFormatter())
    return labelled(ax, xlabel="Frequency (Hz)")


def plain_log(axis: Axis) -> None:
    """Write the ticks of a logarithmic axis out: 0.1, 1, 10, 100."""
    from matplotlib.ticker import NullFormatter, StrMethodFormatter

    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def phase_axis(ax: Axes, label: str) -> None:
    """Make an axis in degrees with about six ticks at multiples of 15, 45, 90 or 180 degrees, or of turns."""
    from matplotlib.ticker import MultipleLocator

    low, high = ax.get_ylim()
    turns = 360.0 * np.ceil((high - low) / (6 * 360))
    step = next((step for step in (15.0, 45.0, 90.0, 180.0) if high - low <= 6 * step), turns)
    ax.yaxis.set_major_locator(MultipleLocator(step))
    ax.set_ylabel(label)


def labelled(ax: Axes, **labels: str) -> Axes:
    """Give axes their labels, a grid and a legend above them, where it covers no curve; return them."""
    ax.set(**labels)
    ax.grid(True, alpha=0.3)
    entries = ax.get_legend_handles_labels()[1]
    # One row where it fits the width, for a longer one would squeeze the axes.
    width = sum(len(entry) + 6 for entry in entries)
    columns = len(entries) if width <= 75 else 2
    place: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": columns}
    ax.legend(**place, frameon=False, fontsize="small")
    return ax


def decibels(power: ArrayLike) -> NumberOrArray:
    """Return a power in dB, at least -300 dB."""
    return 10 * np.log10(np.maximum(power, 1e-30))
