"""Study: noises that jump or sweep, and a primary path that changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from kfopc_filterpy import noise_reduction_db, output_power
from kfopc_filterpy.metrics import convergence_time_s, nse_db, overshoot, short_time_power

from ..bench import Claim, FigureItem, Parameter, Runs, Scene, StudyReport, Table, Tuned, run_setting
from . import cases
from . import report_parts as parts
from . import tracking_events as events
from .cases import FS, WINDOW_S, ducts
from .rows import WindowRow, figure_table, select, table_of_cells, worst_claim
from .tracking_events import CHANGES, LOUDER, OVERDRIVE_DB, Event

ALGORITHMS = ("KF-ANC", "KF-OPC", "KF-PB", "FxRLS", "FxLMS", "MOV-FxLMS", "optimal leaky FxLMS")
CONSTRAINED = ("KF-OPC", "KF-PB", "MOV-FxLMS")
POINTS_A_SECOND = 200  # of the curves that are kept
POWERS = (0.02, 500.0)  # of the figures
NSE_DB = (-25.0, 12.0)


@dataclass(frozen=True, kw_only=True)
class TrackingRow(WindowRow):
    """An algorithm through an event; the noise reduction is over the whole run, the power over its steady half."""

    event: str
    mean_nse_db: float = np.nan
    settled_s: dict[str, float | None] = field(default_factory=dict)  # by stretch, see `_settling_table`


@dataclass(frozen=True)
class Course:
    """NSE in dB and output power over the rated one, over time, of all seeds together."""

    time_s: np.ndarray
    nse_db: np.ndarray
    power: np.ndarray


def planned_runs() -> int:
    """Return the number of runs of the study; an algorithm's runs of one event on all seeds count as one."""
    return len(events.jobs(ducts())) * (cases.grid_runs(ALGORITHMS) + len(ALGORITHMS))


def main(runs: Runs) -> StudyReport:
    """Run the study on all ducts at hand."""
    plants = ducts()
    rows: list[TrackingRow] = []
    courses: dict[str, dict[str, dict[str, Course]]] = {}  # by event, path and algorithm
    tuned, first = {}, {}
    for event, path in events.jobs(plants):
        scenes = events.scenes_of(event, plants[path])
        best = cases.tune_all(runs, scenes[0], cases.grids(ALGORITHMS))  # on the first seed
        outcomes = runs.map(partial(run_event, event, path, scenes, best), ALGORITHMS)
        rows += [row for row, _ in outcomes]
        own = {row.algorithm: course for row, course in outcomes if course is not None}
        courses.setdefault(event.name, {})[path] = own
        first[f"{event.name}, {path}"] = scenes[0]
        tuned[f"{event.name}, {path}"] = parts.tuned_in_words(best)
    return parts.report_of_rows(
        rows,
        name="tracking",
        title="Noises and paths that change",
        summary=(
            "Band noise that is 20 dB louder or softer for a while, a primary path that changes, and sweeps. The usual noise "
            f"asks for {OVERDRIVE_DB:g} dB more than the rated power. Settings are tuned on the run itself, event included."
        ),
        rated_power=1.0 / 10 ** (OVERDRIVE_DB / 10),
        parameters=parts.driven_parameters(
            [events.JUMP_RUN_S, events.CHANGE_RUN_S, events.SWEEP_S, events.SWEEPS * events.SWEEP_S], OVERDRIVE_DB
        )
        | {
            "seeds": Parameter(
                list(events.SEEDS), "of noise and sensor noise, pooled; the first is tuned on; sweeps have one"
            ),
            "jump_s": Parameter(list(events.JUMP_S), "from switch-on on; the steady half comes after"),
            "change_s": Parameter(
                events.CHANGE_S, "from switch-on on; what is on its way then arrives by the new path"
            ),
            "changes": Parameter(
                {
                    "delay": f"{events.DELAY_SAMPLES} samples more",
                    "longer duct": f"{events.OTHER_LENGTH_M:g} m",
                    "sign": "-1",
                },
                "of the primary path",
            ),
            "sweep": Parameter(
                [*events.CHIRP_HZ, events.SWEEP_S],
                "Hz and s, linear, from a standing start; the sweeps follow on each other",
            ),
            "settings": Parameter(tuned, "best and tried of each event"),
        },
        claims=claims(rows),
        figures=[_figure(event, courses[event.name]) for event in events.all_events()],
        notes=[
            *parts.without_measured(plants),
            "An algorithm that reduces the noise by little is soon back within 3 dB of its steady NSE: compare settling "
            "times only together with the noise reduction. During a jump of +20 dB the budget allows less than 1 dB, so "
            "the constrained algorithms count as settled whatever they do.",
            parts.ceilings_note(first),
        ],
        tables=[
            figure_table(stem, caption, rows, figure, {"event": "event", "paths": "path"}, ALGORITHMS)
            for stem, caption, figure in (
                ("reduction", "Noise reduction over the whole run in dB", "noise_reduction_db"),
                ("worst", "Largest output power over 100 ms over the rated power", "worst_window"),
                ("power", "Output power of the steady half over the rated power", "power"),
            )
        ]
        + [_settling_table(rows)],
    )


# ---- Runs


def run_event(
    event: Event, path: str, scenes: Sequence[Scene], tuned: Mapping[str, Tuned | None], algorithm: str
) -> tuple[TrackingRow, Course | None]:
    """Run the best setting of an algorithm on every seed."""
    best = tuned[algorithm]
    place: dict[str, Any] = {"path": path, "noise": event.noise, "event": event.name, "algorithm": algorithm}
    results = [] if best is None else [run_setting(scene, algorithm, best.setting) for scene in scenes]
    kept = [result for result in results if result is not None]
    if best is None or len(kept) < len(scenes):
        return TrackingRow(**place, settled_s=dict.fromkeys(event.stretches), diverged_at_s=0.0), None
    e, d, y = (np.array([getattr(r, name) for r in kept]) for name in ("error", "disturbance", "control_signal"))
    rated = scenes[0].rated_power
    stretches = {name: slice(*(round(t * FS) for t in span)) for name, span in event.stretches.items()}
    row = TrackingRow(
        **place,
        setting=best.setting,
        mean_nse_db=float(np.nanmean(nse_db(e, d, FS, event.nse_window_s, runs=True))),
        noise_reduction_db=noise_reduction_db(e, d, steady=1.0, runs=True),
        power=output_power(y, runs=True) / rated,
        worst_window=overshoot(y, rated, FS, window_s=WINDOW_S, runs=True),
        settled_s={name: _settled(e[:, part], d[:, part], event.nse_window_s) for name, part in stretches.items()},
        diverged_at_s=min((r.diverged_at_s for r in kept if r.diverged_at_s is not None), default=None),
    )
    return row, _course(e, d, y, rated, event)


def _settled(e: np.ndarray, d: np.ndarray, window_s: float) -> float | None:
    time = convergence_time_s(e, d, FS, window_s=window_s, runs=True)
    return None if np.isnan(time) else time


def _course(e: np.ndarray, d: np.ndarray, y: np.ndarray, rated_power: float, event: Event) -> Course:
    every = max(1, round(FS / POINTS_A_SECOND * min(1.0, e.shape[1] / FS)))
    nse = nse_db(e, d, FS, event.shown_window_s, runs=True)
    power = short_time_power(y, FS, min(WINDOW_S, 0.1 * e.shape[1] / FS), runs=True) / rated_power
    points = np.arange(every - 1, nse.size, every)
    return Course((points + 1) / FS, nse[points], power[points])


# ---- Claims


def claims(rows: Sequence[TrackingRow]) -> list[Claim]:
    """Return the findings, each on all events and paths."""
    anc, lms = ({(row.event, row.path): row for row in select(rows, algorithm=name)} for name in ("KF-ANC", "FxLMS"))
    behind = {", ".join(key): row.mean_nse_db - lms[key].mean_nse_db for key, row in anc.items()}
    changed = {key: _time(row, "changed") - _time(lms[key], "changed") for key, row in anc.items() if key[0] in CHANGES}
    louder = select(rows, event=LOUDER)
    spent = {f"{row.algorithm}, {row.path}": row.worst_window for row in louder if row.algorithm in CONSTRAINED}

    def back(name: str) -> dict[str, float]:
        return {row.path: _time(row, "back") for row in select(louder, algorithm=name)}

    text = "Time until {} is back after a noise that was 20 dB louder (s)"
    return [
        worst_claim("Mean NSE of KF-ANC over the whole run less that of FxLMS (dB)", behind, at_most=0.0),
        worst_claim(
            "Time of KF-ANC to settle after a change of the primary path less that of FxLMS (s)",
            {", ".join(key): later for key, later in changed.items()},
            at_most=0.0,
        ),
        worst_claim("Power over the worst 100 ms over the rated one, through a jump of +20 dB", spent, at_least=10.0),
        worst_claim(text.format("KF-OPC"), back("KF-OPC"), at_least=1.0),
        *(worst_claim(text.format(name), back(name), at_most=0.2) for name in ("KF-ANC", "KF-PB")),
    ]


def _time(row: TrackingRow, stretch: str) -> float:
    time = row.settled_s[stretch]
    return np.inf if time is None else time


# ---- Tables and figures


def _settling_table(rows: Sequence[TrackingRow]) -> Table:
    times = [
        ((row.event, stretch, row.path), row.algorithm, "does not settle" if time is None else time)
        for row in rows
        for stretch, time in row.settled_s.items()
    ]
    caption = (
        "Time in s from the start of each stretch until the NSE (50 ms, all seeds) stays within 3 dB of its value in the "
        "stretch's second half"
    )
    return table_of_cells("settling", caption, ["event", "stretch", "paths"], ALGORITHMS, times)


def _figure(event: Event, courses: Mapping[str, Mapping[str, Course]]) -> FigureItem:
    """Return a figure of NSE and output power over time, a column for each path."""
    size = (10.5 if len(courses) > 1 else 7.5, 5.6)
    figure, axes = parts.new_figure(size, 2, len(courses), sharex=True, sharey="row")
    highest = max(float(np.nanmax(course.power)) for own in courses.values() for course in own.values())
    for (nse, power), (path, own) in zip(axes.T, courses.items(), strict=True):
        for k, (name, course) in enumerate(own.items()):
            style = parts.thin_style(name) | {"zorder": 3.0 - 0.1 * k}  # the first in front
            nse.plot(course.time_s, np.clip(course.nse_db, *NSE_DB), label=name, **style)
            power.plot(course.time_s, course.power, **style)
            nse.set_xlim(0, course.time_s[-1])
        nse.set_title(path, fontsize="medium")
        nse.axhline(0.0, color=parts.MARK, linewidth=1)
        power.axhline(1.0, color=parts.MARK, linewidth=1)
        power.set(yscale="log", ylim=(POWERS[0], min(POWERS[1], 1.5 * highest)), xlabel="Time (s)")
    axes[0, 0].set_ylabel("Normalised squared error (dB)")
    axes[1, 0].set_ylabel("Output power / rated power")
    parts.legend_of(figure, axes[0])
    return FigureItem(
        event.name.lower().replace(" ", "-"),
        f"{event.name[0].upper()}{event.name[1:]}: normalised squared error over {1e3 * event.shown_window_s:g} ms and output "
        "power over the rated one, of all seeds together.",
        figure,
    )
