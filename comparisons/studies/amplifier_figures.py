"""Figures of the study of the amplifier."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from kfopc_filterpy.bench.report import FigureItem
from kfopc_filterpy.plot.style import MARK

from .amplifier_runs import KNOWN, UNKNOWN, Row
from .styles import legend_of, style

TOP_DB = 20.0
LABELS = {
    "noise_reduction_db": "Noise reduction (dB)",
    "harmonics_db": "Harmonics over the disturbance (dB)",
    "coherence": "Coherence of anti-noise and disturbance",
    "power": "Output power / rated power",
}


def amplifier_figures(rows: Sequence[Row]) -> list[FigureItem]:
    """Noise reduction, distortion and output power against the overdrive, of each case."""
    items = []
    for case in dict.fromkeys((row.path, row.noise, row.amplifier) for row in rows):
        own = [row for row in rows if (row.path, row.noise, row.amplifier) == case]
        best = max((r.noise_reduction_db for r in own if r.noise_reduction_db > TOP_DB), default=0.0)
        cut = f" Off the scale at 0 dB: up to {best:.0f} dB." if best else ""
        items.append(
            FigureItem(
                " ".join(case).replace(" ", "-"),
                f"{case[0][0].upper()}{case[0][1:]}, {case[1]}, {case[2]}. Above: the disturbance estimate does not know the amplifier; "
                "below: it does, where it can. Black crosses: the filter overruns, or diverged where it lies on the axis. "
                f"Output power is before the amplifier.{cut}",
                _figure(own, "harmonics_db" if case[1] == "tone" else "coherence"),
            )
        )
    return items


def _figure(rows: Sequence[Row], distortion: str) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    shown = ("noise_reduction_db", distortion, "power")
    axes = figure.subplots(2, 3, sharex=True, sharey="col")
    reductions = [row.noise_reduction_db for row in rows if row.diverged_at_s is None]
    lowest, highest = min(reductions), max(reductions)
    for line, known in zip(axes, (UNKNOWN, KNOWN), strict=True):
        own = [row for row in rows if row.known == known]
        for ax, name in zip(line, shown, strict=True):
            for algorithm in dict.fromkeys(row.algorithm for row in own):
                _draw(ax, [row for row in own if row.algorithm == algorithm], name)
            ax.grid(True, alpha=0.3)
            ax.set_ylabel(f"amplifier {known}\n{LABELS[name]}" if ax is line[0] else LABELS[name])
        line[0].set_ylim(min(0.0, 1.1 * lowest), min(TOP_DB, 1.1 * highest))
        line[2].axhline(1.0, color=MARK, linewidth=1)
        line[2].set_yscale("log")
    for ax in axes[1]:
        ax.set_xlabel("Overdrive (dB)")
    legend_of(figure, [axes[0, 0]])
    return figure


def _draw(ax: Any, rows: Sequence[Row], figure: str) -> None:
    levels = np.array([row.overdrive_db for row in rows])
    values = np.array([getattr(row, figure) for row in rows])
    ax.plot(levels, values, label=rows[0].algorithm, linewidth=1.3, markersize=4.5, **style(rows[0].algorithm))
    over = np.array([row.overruns and row.diverged_at_s is None for row in rows])
    ax.plot(levels[over], values[over], "x", color="black", markersize=7, markeredgewidth=0.9)
    lost = levels[[row.diverged_at_s is not None for row in rows]]
    if lost.size:  # an empty line would have no place, which the layout cannot bear
        ax.plot(lost, np.zeros(lost.size), "x", color="black", transform=ax.get_xaxis_transform(), clip_on=False)
