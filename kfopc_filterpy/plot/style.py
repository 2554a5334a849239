"""What the figures share: colours, axes in Hz and dB, legends."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours, told apart by colour-blind readers too; line styles for print in grey.
_STYLES = [
    {"color": color, "linestyle": style}
    for color, style in zip(
        ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"),
        ("-", "--", "-.", ":", "-", "--"),
        strict=True,
    )
]
MARK = "0.35"


def new_axes(ax: Any, rows: int = 1) -> Any:
    """Return `ax`, or `rows` new axes one above the other."""
    if ax is None:
        import matplotlib.pyplot as plt

        return plt.subplots(rows, 1, figsize=(6.4, 2.4 + 1.6 * rows), sharex=True, layout="constrained")[1]
    if rows > 1 and np.size(ax) != rows:
        raise ValueError(f"ax must be {rows} axes, one above the other, got {np.size(ax)}; leave it out for new")
    return ax


def line_style(i: int) -> dict[str, Any]:
    """Colour and line style of the i-th curve."""
    return _STYLES[i % len(_STYLES)]


def frequency_axis(ax: Axes, frequencies: np.ndarray, label: bool = True) -> None:
    """Logarithmic axis in Hz with ticks at 1, 2 and 5 written out."""
    from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

    ax.set_xscale("log")
    ax.set_xlim(frequencies[frequencies > 0].min(), frequencies.max())
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(EngFormatter(sep=""))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.grid(True, which="major", alpha=0.3)
    if label:
        ax.set_xlabel("Frequency (Hz)")


def legend_above(ax: Axes) -> None:
    """Legend above the axes, where it covers no curve."""
    labels = ax.get_legend_handles_labels()[1]
    # One row where it fits the width, for a longer one would squeeze the axes.
    width = sum(len(label) + 6 for label in labels)
    columns = len(labels) if width <= 75 else 2
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=columns, frameon=False, fontsize="small")


def level_axis(ax: Axes, powers: list[np.ndarray], label: str) -> None:
    """Axis in dB that ends 60 dB below the highest peak: the zeros beneath would take all the room."""
    peak = max(float(power.max()) for power in powers)
    ax.set_ylim(decibels(peak) - 60, decibels(peak) + 5)
    ax.set_ylabel(label)


def audible(response: np.ndarray) -> np.ndarray:
    """Where a response lies within 40 dB of its peak: beyond, phase and delay mean nothing."""
    magnitude = np.abs(response)
    return magnitude > 0.01 * magnitude.max()


def decibels(power: Any) -> Any:
    """Power in dB, floored at -300 dB."""
    return 10 * np.log10(np.maximum(power, 1e-30))
