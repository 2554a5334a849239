"""Study: noises that jump or sweep, and a primary path that changes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial

import numpy as np

from kfopc_filterpy import SimulationResult
from kfopc_filterpy.bench.registry import POWER_MEMORY_S
from kfopc_filterpy.bench.report import Parameter, Sound, StudyReport, Table, Verdict
from kfopc_filterpy.bench.scene import Runs, Scene
from kfopc_filterpy.bench.tuning import Tuned
from kfopc_filterpy.power.budget import DEFAULT_CORRELATION_MEMORY_S

from .cases import FS, ceilings_note, grids, paths, shared_parameters, tuned_in_words, without_measured
from .tracking_figures import tracking_figures
from .tracking_runs import (
    ALGORITHMS,
    CHANGE_RUN_S,
    CHANGE_S,
    CHIRP_HZ,
    DELAY_SAMPLES,
    JUMP_RUN_S,
    JUMP_S,
    OTHER_LENGTH_M,
    OVERDRIVE_DB,
    SEEDS,
    START_SHARES,
    SWEEP_S,
    SWEEPS,
    Course,
    Event,
    Row,
    events,
    jobs,
    run_event,
    run_start,
    scenes_of,
    tune_event,
)

CONSTRAINED = ("KF-OPC", "KF-PB", "MOV-FxLMS")
CHANGES = ("sign", "delay", "longer duct")
ONE_SWEEP = "one sweep"
HEARD = {"sign": ("KF-ANC", "KF-PB", "FxLMS"), "sweeps": ("KF-ANC", "KF-PB", "FxLMS")}


def planned_runs() -> int:
    """Runs of the study; an algorithm's runs of one event on all seeds count as one."""
    places = jobs(paths())
    starts = len(START_SHARES) * sum(event.name == ONE_SWEEP for event, _ in places)
    return len(places) * (sum(len(own) for own in grids(ALGORITHMS).values()) + len(ALGORITHMS)) + starts


def main(runs: Runs) -> StudyReport:
    """Run the study on all paths at hand."""
    pairs = paths()
    rows: list[Row] = []
    courses: dict[tuple[str, str], dict[str, Course]] = {}
    tuned, sounds, starts, first = {}, [], {}, {}
    for event, path in jobs(pairs):
        scenes = scenes_of(event, pairs[path])
        first[f"{event.name}, {path}"] = scenes[0]
        best = tune_event(runs, scenes)
        outcomes = _run_all(runs, event, path, scenes, best)
        rows += [row for row, _, _ in outcomes]
        courses[event.name, path] = {row.algorithm: course for row, course, _ in outcomes if course is not None}
        tuned[f"{event.name}, {path}"] = tuned_in_words(best)
        if event.name == ONE_SWEEP:
            starts[path] = runs.map(partial(run_start, scenes[0]), START_SHARES)
        if path == next(iter(pairs)):
            heard = {row.algorithm: result for row, _, result in outcomes if result is not None}
            sounds += sounds_of(event, heard)
    return StudyReport(
        name="tracking",
        title="Noises and paths that change",
        summary=(
            "Band noise that is 20 dB louder or softer for a while, a primary path that changes, and sweeps. The usual noise "
            f"asks for {OVERDRIVE_DB:g} dB more than the rated power. Settings are tuned on the run itself, event included."
        ),
        fs=FS,
        rated_power=1.0 / 10 ** (OVERDRIVE_DB / 10),
        parameters=shared_parameters([JUMP_RUN_S, CHANGE_RUN_S, SWEEP_S, SWEEPS * SWEEP_S], OVERDRIVE_DB)
        | {
            "seeds": Parameter(
                list(SEEDS), "of noise and sensor noise, pooled; the first is tuned on; sweeps have one"
            ),
            "jump_s": Parameter(list(JUMP_S), "from switch-on on; the steady half comes after"),
            "change_s": Parameter(CHANGE_S, "from switch-on on; what is on its way then arrives by the new path"),
            "changes": Parameter(
                {"delay": f"{DELAY_SAMPLES} samples more", "longer duct": f"{OTHER_LENGTH_M:g} m", "sign": "-1"},
                "of the primary path",
            ),
            "sweep": Parameter(
                [*CHIRP_HZ, SWEEP_S], "Hz and s, linear, from a standing start; the sweeps follow on each other"
            ),
            "settings": Parameter(tuned, "best and tried of each event"),
        },
        algorithms={},
        extra={"rows": [asdict(row) for row in rows], "one_sweep_from_less_initial_variance_db": starts},
        verdicts=verdicts(rows),
        figures=tracking_figures(courses, {event.name: event.shown_window_s for event in events()}),
        sounds=sounds,
        notes=[*_notes(pairs, rows), *_sweep_notes(rows, starts), ceilings_note(first)],
        tables=[*event_tables(rows), _settling_table(rows)],
        claims="Findings",
    )


def _run_all(
    runs: Runs, event: Event, path: str, scenes: Sequence[Scene], best: Mapping[str, Tuned | None]
) -> list[tuple[Row, Course | None, SimulationResult | None]]:
    return runs.map(lambda name: run_event(event, path, scenes, name, best[name]), ALGORITHMS)


def sounds_of(event: Event, heard: dict[str, SimulationResult]) -> list[Sound]:
    """Disturbance and residuals of the events worth hearing."""
    names = [name for name in HEARD.get(event.name, ()) if name in heard]
    if not names:
        return []
    sounds = [
        Sound(f"{event.name}-disturbance", f"{event.name}: disturbance, control off", heard[names[0]].disturbance)
    ]
    return sounds + [
        Sound(f"{event.name}-{name.lower()}", f"{event.name}: residual of {name}", heard[name].error) for name in names
    ]


def verdicts(rows: Sequence[Row]) -> list[Verdict]:
    """The findings, each on all events and paths."""
    return [_mean_nse(rows), _sooner(rows), _jump(rows), _change(rows), _back(rows)]


def _by(rows: Iterable[Row], algorithm: str) -> dict[tuple[str, str], Row]:
    return {(row.event, row.path): row for row in rows if row.algorithm == algorithm}


def _mean_nse(rows: Sequence[Row]) -> Verdict:
    ours, theirs = _by(rows, "KF-ANC"), _by(rows, "FxLMS")
    leads = {key: theirs[key].mean_nse_db - row.mean_nse_db for key, row in ours.items()}
    least = min(leads, key=lambda key: leads[key])
    return Verdict(
        "The mean NSE over the whole run of KF-ANC is below that of FxLMS, through every event",
        all(lead > 0.0 for lead in leads.values()),
        f"by {np.mean(list(leads.values())):.1f} dB on average, by {leads[least]:.2f} dB at least ({', '.join(least)})",
    )


def _sooner(rows: Sequence[Row]) -> Verdict:
    ours, theirs = _by(rows, "KF-ANC"), _by(rows, "FxLMS")
    times = {
        key: (_time(row, "changed"), _time(theirs[key], "changed")) for key, row in ours.items() if key[0] in CHANGES
    }
    return Verdict(
        "After a change of the primary path KF-ANC is back within 3 dB of its steady NSE sooner than FxLMS",
        all(one < other for one, other in times.values()),
        "KF-ANC and FxLMS: "
        + "; ".join(f"{_ms(one)} and {_ms(other)} ({', '.join(key)})" for key, (one, other) in times.items()),
    )


def _time(row: Row, stretch: str) -> float:
    time = row.settled_s[stretch]
    return np.inf if time is None else time


def _ms(time_s: float) -> str:
    return "not at all" if np.isinf(time_s) else f"{1e3 * time_s:.0f} ms"


def _jump(rows: Sequence[Row]) -> Verdict:
    worst = {
        (r.algorithm, r.path): r.worst_window for r in rows if r.event == "20 dB louder" and r.algorithm in CONSTRAINED
    }
    return Verdict(
        "Through a jump of +20 dB no algorithm's constraint holds: each spends more than ten times its rated power over "
        "some 100 ms",
        all(power > 10.0 for power in worst.values()),
        "worst 100 ms over the rated power: "
        + ", ".join(f"{name} {power:.0f} ({path})" for (name, path), power in worst.items()),
    )


def _change(rows: Sequence[Row]) -> Verdict:
    own = [row for row in rows if row.event in CHANGES and row.algorithm in CONSTRAINED]
    worst = max(own, key=lambda row: row.stretch_worst_window["changed"])
    before = _by(rows, "KF-ANC")
    unconstrained = max(row.stretch_worst_window["changed"] for (event, _), row in before.items() if event in CHANGES)
    return Verdict(
        "A change of the primary path takes no constrained algorithm above twice its rated power over any 100 ms",
        bool(worst.stretch_worst_window["changed"] <= 2.0),
        f"{worst.stretch_worst_window['changed']:.2f} of it at worst ({worst.algorithm}, {worst.event}, {worst.path}); KF-ANC, "
        f"which has no constraint, {unconstrained:.2f}",
    )


def _back(rows: Sequence[Row]) -> Verdict:
    times = {
        name: [_time(row, "back") for row in rows if row.event == "20 dB louder" and row.algorithm == name]
        for name in ("KF-ANC", "KF-OPC", "KF-PB")
    }
    return Verdict(
        "After a noise that was 20 dB louder the constrained Kalman filters need more than a second, KF-ANC less than 0.2 s",
        min(*times["KF-OPC"], *times["KF-PB"]) > 1.0 and max(times["KF-ANC"]) < 0.2,
        "; ".join(f"{name} {' and '.join(_ms(time) for time in own)}" for name, own in times.items()),
    )


def _notes(pairs: Iterable[str], rows: Sequence[Row]) -> list[str]:
    over = [
        f"{r.algorithm} ({r.event}, {r.path}: {r.power:.2f})"
        for r in rows
        if not r.within_budget and r.setting is not None
    ]
    notes = without_measured(pairs)
    if over:
        notes.append(f"Kept the budget to 2 % over the steady half at no setting: {', '.join(over)}.")
    return [
        *notes,
        "To be back within 3 dB of the steady NSE is easy for an algorithm that reduces the noise by little: the settling "
        "times of MOV-FxLMS and optimal leaky FxLMS compare with others' only beside their noise reduction. Within a jump "
        "of +20 dB, where the budget allows less than 1 dB, the constrained ones are settled whatever they do.",
        f"What holds the constrained algorithms back after a loud noise is its power in their memory. KF-OPC's fades with "
        f"{POWER_MEMORY_S:g} s: 20 dB take 4.6 times that to be forgotten. KF-PB's is a window of "
        f"{DEFAULT_CORRELATION_MEMORY_S:g} s, which believes on purpose that a noise has become softer only when the loud "
        "part has left it: it comes back at once then. The same memory lets them overspend at the jump itself, for an "
        "estimate of power follows behind the noise; only a limiter behind the filter holds from the first sample.",
        "Settings are tuned on the mean NSE over the whole run, which a change in the midst hardly moves: the Kalman "
        "filters get longer memories than would bring them back soonest.",
    ]


def _sweep_notes(rows: Sequence[Row], starts: Mapping[str, Sequence[float]]) -> list[str]:
    own = [row for row in rows if row.event == ONE_SWEEP]
    louder = [
        f"{row.algorithm} {row.noise_reduction_db:.1f} dB ({row.path})" for row in own if row.noise_reduction_db < 0
    ]
    notes = [
        f"One sweep starts from the initial variance P0 of a stationary noise. With {START_SHARES[1]:g} of it and the least "
        f"state noise of the grid, KF-ANC reduces it by {less:.1f} dB in place of {usual:.1f} dB ({path}): a filter that hardly "
        "knows its weights moves them far for each frequency that the sweep comes by, and is wrong at the next."
        for path, (usual, less) in starts.items()
    ]
    return notes + ([f"One sweep was left louder than it was by: {', '.join(louder)}."] if louder else [])


def event_tables(rows: Sequence[Row]) -> list[Table]:
    """A line for each event and path, a column for each algorithm."""
    captions = {
        "noise_reduction_db": ("reduction", "Noise reduction over the whole run in dB"),
        "mean_nse_db": ("nse", "Mean NSE over the whole run in dB, which settings are tuned for"),
        "worst_window": ("worst", "Largest output power over 100 ms over the rated power"),
        "power": ("power", "Output power of the steady half over the rated power"),
    }
    tables = []
    for figure, (stem, caption) in captions.items():
        lines: dict[tuple[str, str], list[str | float]] = {}
        for row in rows:
            line = lines.setdefault((row.event, row.path), [row.event, row.path])
            line.append(getattr(row, figure) if row.diverged_at_s is None else "diverged")
        tables.append(Table(stem, caption, ["event", "paths", *ALGORITHMS], list(lines.values())))
    return tables


def _settling_table(rows: Sequence[Row]) -> Table:
    lines: dict[tuple[str, str, str], list[str | float]] = {}
    for row in rows:
        for stretch, time in row.settled_s.items():
            line = lines.setdefault((row.event, stretch, row.path), [row.event, stretch, row.path])
            line.append("does not settle" if time is None else time)
    return Table(
        "settling",
        "Time in s from the start of each stretch until the NSE (50 ms, all seeds) stays within 3 dB of its value in the "
        "stretch's second half",
        ["event", "stretch", "paths", *ALGORITHMS],
        list(lines.values()),
    )
