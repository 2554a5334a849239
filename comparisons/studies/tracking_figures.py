"""Figures of the study of tracking."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from kfopc_filterpy.bench.report import FigureItem
from kfopc_filterpy.plot.style import MARK

from .styles import curve_style, legend_of
from .tracking_runs import Course

POWERS = (0.02, 500.0)
NSE_DB = (-25.0, 12.0)


def tracking_figures(
    courses: Mapping[tuple[str, str], Mapping[str, Course]], windows: Mapping[str, float]
) -> list[FigureItem]:
    """NSE and output power over time of each event, a column for each path; `windows` are those of the NSE in s."""
    items = []
    for event in dict.fromkeys(event for event, _ in courses):
        own = {path: courses[event, path] for other, path in courses if other == event}
        items.append(
            FigureItem(
                event.lower().replace(" ", "-"),
                f"{event[0].upper()}{event[1:]}: normalised squared error over {1e3 * windows[event]:g} ms and output power over "
                "the rated one, of all seeds together.",
                _figure(own),
            )
        )
    return items


def _figure(courses: Mapping[str, Mapping[str, Course]]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5 if len(courses) > 1 else 7.5, 5.6), layout="constrained")
    axes = figure.subplots(2, len(courses), sharex=True, sharey="row", squeeze=False)
    highest = max(float(np.nanmax(course.power)) for own in courses.values() for course in own.values())
    for (nse, power), (path, own) in zip(axes.T, courses.items(), strict=True):
        for k, (name, course) in enumerate(own.items()):
            above = 3.0 - 0.1 * k  # the first in front
            nse.plot(course.time_s, np.clip(course.nse_db, *NSE_DB), label=name, zorder=above, **curve_style(name))
            power.plot(course.time_s, course.power, zorder=above, **curve_style(name))
            nse.set_xlim(0, course.time_s[-1])
        nse.set_title(path, fontsize="medium")
        nse.axhline(0.0, color=MARK, linewidth=1)
        power.axhline(1.0, color=MARK, linewidth=1)
        power.set_yscale("log")
        power.set_ylim(POWERS[0], min(POWERS[1], 1.5 * highest))
        power.set_xlabel("Time (s)")
        for ax in (nse, power):
            ax.grid(True, alpha=0.3)
    axes[0, 0].set_ylabel("Normalised squared error (dB)")
    axes[1, 0].set_ylabel("Output power / rated power")
    legend_of(figure, axes[0])
    return figure
