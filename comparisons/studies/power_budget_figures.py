"""Figures of the study of the power budget."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from kfopc_filterpy.bench.registry import REGISTRY
from kfopc_filterpy.bench.report import FigureItem
from kfopc_filterpy.bench.tuning import BUDGET
from kfopc_filterpy.plot.style import MARK

from .styles import style as style_of

if TYPE_CHECKING:
    from .power_budget import Row

PANELS = {
    "Kalman filters": ("KF-OPC", "KF-OPC repaired", "KF-PB", "diagonal KF-OPC"),
    "FxLMS with a price": ("leaky FxLMS", "optimal leaky FxLMS", "MOV-FxLMS fixed", "MOV-FxLMS", "MOV-MFxLMS"),
    "FxLMS with an amplitude limit": ("two-gradient FxLMS", "re-scaling FxLMS", "clipping FxLMS"),
}


def budget_figures(rows: Sequence[Row]) -> list[FigureItem]:
    """A figure for each case: noise reduction above, output power below, one column for each family."""
    return [_case(rows, case) for case in dict.fromkeys(row.case for row in rows)]


def _case(rows: Sequence[Row], case: Any) -> FigureItem:
    from matplotlib.figure import Figure

    from .power_budget import BOUND, SCALED, mean_rows

    means = {name: own for (where, name), own in mean_rows(rows).items() if where == case}
    figure = Figure(figsize=(12.0, 6.6), layout="constrained")
    axes = figure.subplots(2, len(PANELS), sharex=True, sharey="row")
    for column, (family, names) in enumerate(PANELS.items()):
        above, below = axes[:, column]
        for label, dashes in ((BOUND, "-"), (SCALED, ":")):
            above.plot(*_line(means[label], "noise_reduction_db"), color="black", linestyle=dashes, label=label)
        for name in names:
            style = style_of(name) | {"markersize": 4}
            over = [row.share_db for row in means[name] if row.power > BUDGET]
            for ax, value in ((above, "noise_reduction_db"), (below, "power")):
                shares, values = _line(means[name], value)
                ax.plot(shares, values, label=name, **style)
                hollow = np.isin(shares, over)
                ax.plot(shares[hollow], values[hollow], **style | {"linestyle": "", "markerfacecolor": "white"})
        above.set_title(family, fontsize="medium")
        above.legend(fontsize="small", frameon=False)
        below.axhline(1.0, color=MARK, linewidth=1)
        below.set_xlabel("Rated power (dB over the unconstrained)")
        for ax in (above, below):
            ax.grid(True, alpha=0.3)
    unconstrained = max(row.noise_reduction_db for name in ("KF-ANC", "FxLMS") for row in means[name])
    axes[0, 0].set_ylim(0.0, 1.1 * max(unconstrained, means[BOUND][-1].noise_reduction_db))
    axes[1, 0].set_yscale("log")
    axes[1, 0].set_ylim(0.3, 30.0)
    axes[0, 0].set_ylabel("Noise reduction (dB)")
    axes[1, 0].set_ylabel("Output power / rated power")
    free = ", ".join(
        f"{name} {own[0].noise_reduction_db:.1f} dB"
        for name, own in means.items()
        if name in REGISTRY and not REGISTRY[name].keeps_budget
    )
    caption = (
        f"{case.noise.capitalize()}, {case.path}: noise reduction (above) and output power (below) against the rated power, "
        f"means over seeds; hollow where the power is above {BUDGET:g} of the rated one. Black: the power-constrained Wiener solution and the scaled one. Without a constraint: {free}."
    )
    return FigureItem(f"{case.path} {case.noise}".replace(" ", "-"), caption, figure)


def _line(rows: Sequence[Row], value: str) -> tuple[np.ndarray, np.ndarray]:
    return np.array([row.share_db for row in rows]), np.array([getattr(row, value) for row in rows])
