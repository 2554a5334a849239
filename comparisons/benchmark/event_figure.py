"""The figure of the events: what is heard around each of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kfopc_filterpy.metrics import nse_db
from kfopc_filterpy.plot import curve_style

from ..bench import run_setting
from ..bench.changes import CHANGES
from ..studies.report_parts import legend_of, new_figure
from .tasks import JUDGED, Task

SHOWN = ("MOV-FxLMS", "KF-OPC", "KF-PB")
COLUMNS, WINDOW_S, STEP_S = 2, 0.1, 0.01
LIMITS_DB = (-10.0, 42.0)


def event_figure(outcomes: Sequence[Mapping[str, Any]]) -> Any:
    """Return a panel for each task in which something changes: noise reduction over time; None without such a task."""
    chosen = [outcome for outcome in outcomes if outcome["task"].change is not CHANGES["nothing"]]
    if not chosen:
        return None
    rows = -(-len(chosen) // COLUMNS)
    figure, axes = new_figure((7.0, 0.7 + 1.6 * rows), rows, COLUMNS, sharex=True, sharey=True)
    for ax, outcome in zip(axes.flat, chosen, strict=False):
        task, settings = outcome["task"], {one.entry: one.setting for one in outcome["scores"] if not one.failed}
        after_s = task.changed_at_s + task.change.lasting_s
        bound = task.bound(after_s).per_second.error
        begin = round(after_s * task.fs)
        noise = task.sensor_noise_std * np.random.default_rng(0).standard_normal(bound.size)
        ax.plot(*curve(task, bound + noise, begin), color="0.75", linewidth=4, label="bound")
        for name in SHOWN:
            run = run_setting(task, name, settings[name], JUDGED) if name in settings else None
            if run is not None:
                ax.plot(*curve(task, run.error), **curve_style(name) | {"marker": "", "linewidth": 1.2}, label=name)
        ax.axvline(0.0, color="0.4", linewidth=0.8)
        ax.set_title(task.title.rpartition(": ")[2], fontsize="small")
        ax.set(ylim=LIMITS_DB)
    for ax in axes.flat[len(chosen) :]:
        ax.axis("off")
    legend_of(figure, axes.flat)
    figure.supxlabel("Time from the change (s)")
    figure.supylabel("Noise reduction (dB)")
    return figure


def curve(task: Task, error: np.ndarray, begin: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return times from the change, and the noise reduction in a window that ends then, of an error from a sample on."""
    d = task.disturbances[JUDGED][begin : begin + error.size]
    steps = slice(round(WINDOW_S * task.fs) - 1, None, round(STEP_S * task.fs))
    t = (begin + np.arange(error.size)) / task.fs - task.changed_at_s
    return t[steps], -nse_db(error, d, task.fs, WINDOW_S)[steps]
