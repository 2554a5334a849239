"""Figures of the study of mismatch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from kfopc_filterpy.bench.report import FigureItem
from kfopc_filterpy.plot.style import MARK

from .mismatch_runs import ALGORITHMS, AMOUNTS, EXACT, UNITS, WRONG, Row
from .styles import legend_of, style

BOTTOM_DB = -7.0
POWERS = (0.05, 20.0)


def mismatch_figures(rows: Sequence[Row]) -> list[FigureItem]:
    """Noise reduction of each case, and output power."""
    items = []
    for path, noise in dict.fromkeys((row.path, row.noise) for row in rows):
        own = [row for row in rows if (row.path, row.noise) == (path, noise)]
        stem = f"{path} {noise}".replace(" ", "-")
        items.append(
            FigureItem(
                f"reduction-{stem}",
                f"Noise reduction against what is wrong with the secondary path known to the controllers ({path}, {noise}). "
                f"Above: settings tuned with the exact path; below: with the wrong one. Crosses: diverged, or below {BOTTOM_DB:g} dB.",
                _reductions(own),
            )
        )
        items.append(
            FigureItem(
                f"power-{stem}",
                f"Output power over the rated one, settings tuned with the exact path ({path}, {noise}). Crosses: "
                f"diverged, or above {POWERS[1]:g} times.",
                _powers(own),
            )
        )
    return items


def _reductions(rows: Sequence[Row]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 6.4), layout="constrained")
    axes = figure.subplots(2, len(AMOUNTS), sharey=True, sharex="col")
    top = 1.05 * max(row.noise_reduction_db for row in rows if row.diverged_at_s is None) + 1.0
    for line, tuned_with in zip(axes, (EXACT, WRONG), strict=True):
        for ax, kind in zip(line, AMOUNTS, strict=True):
            own = [row for row in rows if (row.kind, row.tuned_with) == (kind, tuned_with)]
            for k, name in enumerate(ALGORITHMS):
                _draw(ax, [row for row in own if row.algorithm == name], "noise_reduction_db", k)
            ax.axhline(0.0, color=MARK, linewidth=1)
            ax.set_ylim(BOTTOM_DB - 3.5, top)
            _mismatch_axis(ax, kind)
        line[0].set_ylabel(f"Noise reduction (dB)\ntuned with the {tuned_with}")
    for ax in axes[0]:
        ax.set_xlabel("")
    legend_of(figure, axes.flat)
    return figure


def _powers(rows: Sequence[Row]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 4.0), layout="constrained")
    axes = figure.subplots(1, len(AMOUNTS), sharey=True)
    for ax, kind in zip(axes, AMOUNTS, strict=True):
        own = [row for row in rows if (row.kind, row.tuned_with) == (kind, EXACT)]
        for k, name in enumerate(ALGORITHMS):
            _draw(ax, [row for row in own if row.algorithm == name], "power", k)
        ax.axhline(1.0, color=MARK, linewidth=1)
        ax.set_yscale("log")
        ax.set_ylim(POWERS[0], 4 * POWERS[1])
        _mismatch_axis(ax, kind)
    axes[0].set_ylabel("Output power / rated power")
    legend_of(figure, axes)
    return figure


def _draw(ax: Any, rows: Sequence[Row], figure: str, k: int) -> None:
    """A curve as far as it lies on the scale, and a cross at its edge for each amount at which it does not."""
    amounts = np.array([row.amount for row in rows])
    values = np.array([getattr(row, figure) for row in rows], dtype=np.float64)
    inside = values >= BOTTOM_DB if figure == "noise_reduction_db" else values <= POWERS[1]  # NaN is outside
    own = style(rows[0].algorithm)
    ax.plot(amounts, np.where(inside, values, np.nan), label=rows[0].algorithm, linewidth=1.4, markersize=4.5, **own)
    edge = BOTTOM_DB - 0.45 * (k + 1) if figure == "noise_reduction_db" else POWERS[1] * 1.2 ** (k + 1)
    ax.plot(amounts[~inside], np.full(int(np.sum(~inside)), edge), "x", color=own["color"], markersize=5)


def _mismatch_axis(ax: Any, kind: str) -> None:
    labels = {"phase": "Phase error", "gain": "Gain error", "delay": "Delay error"}
    ax.set_xticks(AMOUNTS[kind])
    ax.tick_params(axis="x", labelsize="small")
    ax.set_xlabel(f"{labels[kind]} ({UNITS[kind]})")
    if kind == "phase":
        ax.axvline(90.0, color=MARK, linewidth=1, linestyle=":")
    ax.grid(True, alpha=0.3)
