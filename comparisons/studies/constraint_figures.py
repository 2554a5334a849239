"""Figures of the study of the constraint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from kfopc_filterpy.bench.report import FigureItem
from kfopc_filterpy.metrics import short_time_power
from kfopc_filterpy.plot.style import MARK, decibels, legend_above, line_style

from .constraint_cases import FS
from .constraint_runs import JUMP_S, SHARES, WINDOW_S, Course, Jump, Row

SHOWN = ("KF-OPC", "KF-OPC repaired", "KF-PB")
# One colour and marker for an algorithm in all figures.
STYLES = {"KF-OPC": (0, "o"), "KF-OPC repaired": (1, "s"), "KF-PB": (2, "D"), "KF-PB limited": (3, "^")}


def constraint_figures(rows: Sequence[Row], jumps: Sequence[Jump], course: Course) -> list[FigureItem]:
    """All of them."""
    shortest = min(row.duration_s for row in rows)
    shown = [row for row in rows if row.duration_s == shortest and row.share == SHARES[0]]
    part = f"rated power {100 * SHARES[0]:.0f} %, {shortest:g} s, all seeds"
    return [
        _by_case(
            "loss",
            f"Noise reduction below the bound, the power-constrained Wiener solution ({part}). KF-OPC can lie above it where "
            "it overspends.",
            shown,
            "Below the bound (dB)",
            lambda row: row.loss_db,
            mark=0.0,
        ),
        _by_case(
            "power",
            f"Output power over the rated one, mean of the steady half ({part}).",
            shown,
            "Output power / rated power",
            lambda row: row.power,
            mark=1.0,
        ),
        _by_case(
            "window",
            f"Largest mean power over {1e3 * WINDOW_S:g} ms over the rated power, with the limiter too ({part}).",
            shown,
            "Worst 100 ms / rated power",
            lambda row: row.worst_window,
            mark=1.0,
            names=("KF-OPC", "KF-PB", "KF-PB limited"),
            log=True,
        ),
        _course(course),
        _limiter(course),
        _jumps(jumps),
    ]


def _by_case(
    stem: str,
    caption: str,
    rows: Sequence[Row],
    label: str,
    value: Callable[[Row], float],
    *,
    mark: float,
    names: Sequence[str] = SHOWN,
    log: bool = False,
) -> FigureItem:
    """A column for each combination of paths and noise, a mark for each seed."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 4.4), layout="constrained")
    ax = figure.subplots()
    cases = list(dict.fromkeys(row.setting for row in rows))
    for k, name in enumerate(names):
        points = [
            (cases.index(row.setting) + 0.25 * (k - 0.5 * (len(names) - 1)), value(row))
            for row in rows
            if row.algorithm == name
        ]
        style, marker = STYLES[name]
        color = line_style(style)["color"]
        ax.plot(*zip(*points, strict=True), marker, color=color, markersize=4, alpha=0.8, label=name)
    ax.axhline(mark, color=MARK, linewidth=1)
    for i in range(1, len(cases)):
        ax.axvline(i - 0.5, color=MARK, linewidth=0.4 if cases[i].path == cases[i - 1].path else 1.5, alpha=0.5)
    ax.set_xticks(range(len(cases)), [case.noise for case in cases], rotation=40, ha="right", fontsize="small")
    ax.set_xlim(-0.5, len(cases) - 0.5)
    for path in dict.fromkeys(case.path for case in cases):
        own = [i for i, case in enumerate(cases) if case.path == path]
        ax.text(
            float(np.mean(own)), 0.99, path, ha="center", va="top", transform=ax.get_xaxis_transform(), fontsize="small"
        )
    if log:
        ax.set_yscale("log")
    low, high = ax.get_ylim()
    ax.set_ylim(low, high * (high / low) ** 0.1 if log else high + 0.12 * (high - low))
    ax.grid(True, axis="y", alpha=0.3)
    ax.set_ylabel(label)
    legend_above(ax)
    return FigureItem(stem, caption, figure)


def _mean_power(signal: np.ndarray, window_s: float) -> np.ndarray:
    """Mean square over the window that ends at each sample."""
    return short_time_power(signal, FS, window_s)


def _course(course: Course) -> FigureItem:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    power, level, weight = figure.subplots(3, 1, sharex=True)
    every = round(FS / 50)
    first = next(iter(course.results.values()))
    time = first.time_s[::every]
    level.plot(time, decibels(_mean_power(first.disturbance, 0.5))[::every], color=MARK, label="disturbance")
    for k, name in enumerate(SHOWN):
        result = course.results[name]
        power.plot(
            time, (_mean_power(result.control_signal, 1.0) / course.rated_power)[::every], label=name, **line_style(k)
        )
        level.plot(time, decibels(_mean_power(result.error, 0.5))[::every], label=name, **line_style(k))
    power.axhline(1.0, color=MARK, linewidth=1)
    power.set_ylabel("Output power over 1 s\n/ rated power")
    level.set_ylabel("Power over 0.5 s (dB)")
    weights = course.results["KF-PB"].power_weight
    assert weights is not None
    weight.plot(time, weights[::every], **line_style(2))
    weight.set_ylabel("λ of KF-PB")
    weight.set_xlabel("Time (s)")
    weight.set_xlim(0, time[-1])
    legend_above(power)
    for ax in (power, level, weight):
        ax.grid(True, alpha=0.3)
    return FigureItem(
        "course",
        f"{course.setting.noise.capitalize()}, {course.setting.path}: output power, disturbance (grey) and errors, and λ, which "
        "follows the noise's level.",
        figure,
    )


def _limiter(course: Course) -> FigureItem:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    ax = figure.subplots()
    part = slice(round(10 * FS), round(14 * FS))
    for name, label in {"KF-PB": "without limiter", "KF-PB limited": "with limiter"}.items():
        result = course.results[name]
        short = _mean_power(result.control_signal, WINDOW_S) / course.rated_power
        ax.plot(result.time_s[part][::16], short[part][::16], label=f"KF-PB {label}", **line_style(STYLES[name][0]))
    ax.axhline(1.0, color=MARK, linewidth=1)
    ax.set_xlabel("Time (s)")
    ax.set_ylabel(f"Power over {1e3 * WINDOW_S:g} ms / rated power")
    ax.set_ylim(bottom=0)
    ax.set_xlim(10, 14)
    ax.grid(True, alpha=0.3)
    legend_above(ax)
    return FigureItem(
        "limiter", f"{course.setting.noise.capitalize()}, {course.setting.path}: what the limiter does.", figure
    )


def _jumps(jumps: Sequence[Jump]) -> FigureItem:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 3.8), layout="constrained")
    axes: Any = figure.subplots(1, 2, sharey=True)
    for ax, gain_db in zip(axes, dict.fromkeys(jump.jump_db for jump in jumps), strict=True):
        own = [jump for jump in jumps if jump.jump_db == gain_db and jump.share == SHARES[0]]
        paths = list(dict.fromkeys(jump.setting.path for jump in own))
        for jump in own:
            style = line_style(paths.index(jump.setting.path))
            label = jump.setting.path if jump is next(j for j in own if j.setting.path == jump.setting.path) else None
            ax.semilogy(jump.time_s, np.maximum(jump.power_weight, 1e-4), linewidth=1, label=label, **style)
        ax.axvspan(*JUMP_S, color=MARK, alpha=0.15)
        ax.set_xlim(JUMP_S[0] - 2, JUMP_S[1] + 4)
        ax.set_ylim(1e-3, None)
        ax.set_xlabel("Time (s)")
        ax.set_title(f"{gain_db:+g} dB for a second", fontsize="medium")
        ax.grid(True, alpha=0.3)
    axes[0].set_ylabel("λ of KF-PB")
    axes[0].legend(frameon=False, fontsize="small")
    return FigureItem(
        "jumps", "λ through a second of another level (grey): tone, compressor and band noise on each path.", figure
    )
