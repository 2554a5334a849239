"""Study: an amplifier that saturates, and a noise that asks for more than it has."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict

import numpy as np

from kfopc_filterpy.bench.report import Parameter, StudyReport, Table, Verdict
from kfopc_filterpy.bench.scene import Runs, Scene

from .amplifier_figures import amplifier_figures
from .amplifier_runs import (
    ALGORITHMS,
    DURATION_S,
    KNOWN,
    LIMIT_SHARES,
    OVERDRIVES_DB,
    OVERRUN,
    UNKNOWN,
    Row,
    cases,
    run_case,
    runs_of_a_case,
)
from .cases import (
    FS,
    ceilings_note,
    make_case,
    noise_of,
    paths,
    shared_parameters,
    tuned_in_words,
    with_overdrive,
    without_measured,
)

KEEPS_POWER = ("KF-OPC", "KF-PB")
CLEANER_DB = 40.0  # as in the tonal study


def planned_runs() -> int:
    """Runs of the study."""
    return len(cases(list(paths()))) * runs_of_a_case()


def main(runs: Runs) -> StudyReport:
    """Run the study on all paths at hand."""
    pairs = paths()
    rows: list[Row] = []
    tuned = {}
    for case in cases(list(pairs)):
        own, best = run_case(runs, case, pairs[case.path])
        rows += own
        tuned[f"{case.path}, {case.noise}, {case.amplifier}"] = {at: tuned_in_words(one) for at, one in best.items()}
    return StudyReport(
        name="amplifier",
        title="An amplifier that saturates",
        summary=(
            "A tone and a band noise that ask for up to 20 dB more than the rated power, and an amplifier that puts out "
            "sqrt(2 rated power) at most, the peak of a sine of rated power: a hard clip, and a soft saturation (Rapp, p = 2). "
            "Settings are tuned anew at every overdrive."
        ),
        fs=FS,
        rated_power=1.0,
        parameters=shared_parameters(DURATION_S, list(OVERDRIVES_DB))
        | {
            "amplitude_limits": Parameter(
                list(LIMIT_SHARES),
                "A^2 of the peak-limited algorithms over the amplifier's: up to the amplifier's own; tuned with the step size",
            ),
            "overrun": Parameter(
                OVERRUN, "power that the last weights ask for over what cancels the noise with a linear amplifier"
            ),
            "settings": Parameter(tuned, "best and tried at each overdrive, without and with the amplifier known"),
        },
        algorithms={},
        extra={"rows": [asdict(row) for row in rows]},
        verdicts=verdicts(rows),
        figures=amplifier_figures(rows),
        notes=[*_notes(pairs, rows), ceilings_note(_scenes(pairs))],
        tables=[
            _table(rows, "reduction", "noise_reduction_db", "Noise reduction over the steady half in dB (! overruns)"),
            _table(
                rows,
                "harmonics",
                "harmonics_db",
                "Harmonics of a tone: 2f to 10f in the error over f in the disturbance, dB",
            ),
            _table(rows, "coherence", "coherence", "Coherence of anti-noise and disturbance over the band of a noise"),
            _table(rows, "power", "power", "Output power before the amplifier over the rated power"),
            _table(rows, "asked", "asked_power", "Power that the last weights ask for over what cancels the noise"),
        ],
        claims="Findings",
    )


def _scenes(pairs: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, Scene]:
    """Every noise at every overdrive."""
    made: dict[str, Scene] = {}
    for path, noise in dict.fromkeys((case.path, case.noise) for case in cases(list(pairs))):
        scene = make_case(pairs[path], noise_of(noise, DURATION_S), 0.0)
        made |= {f"{path}, {noise}, {level:g} dB": with_overdrive(scene, level) for level in OVERDRIVES_DB}
    return made


def verdicts(rows: Sequence[Row]) -> list[Verdict]:
    """The findings, each on all cases."""
    return [
        _overruns(rows, "KF-ANC"),
        _overruns(rows, "clipping FxLMS"),
        _known(rows),
        _clean(rows),
        _power(rows),
        _ordering(rows),
    ]


def _of(rows: Iterable[Row], algorithm: str, *, noise: str | None = None, known: str = UNKNOWN) -> list[Row]:
    return [r for r in rows if r.algorithm == algorithm and r.known == known and noise in (None, r.noise)]


def _overruns(rows: Sequence[Row], algorithm: str) -> Verdict:
    driven = [row for row in _of(rows, algorithm, noise="tone") if row.overdrive_db >= 5.0]
    over = [row for row in driven if row.overruns]
    away = [row for row in driven if row.diverged_at_s is not None]
    asked = [row.asked_power for row in driven if row.diverged_at_s is None]
    growth = [row.weight_growth for row in driven if row.diverged_at_s is None]
    return Verdict(
        f"A tone of 5 dB of overdrive or more makes {algorithm} overrun, with both amplifiers, where it does not know them",
        len(over) == len(driven) > 0,
        f"{len(over)} of {len(driven)} runs; their weights end up asking for {_span(asked)} times the power that cancels the "
        f"tone, and grow {_span(growth)} times over the second half; {len(away)} passed 1e6 times the rated amplitude in "
        f"{DURATION_S:g} s",
    )


def _span(values: Sequence[float]) -> str:
    return f"{np.min(values):.3g} to {np.max(values):.3g}" if values else "(none)"


def _known(rows: Sequence[Row]) -> Verdict:
    own = _of(rows, "KF-ANC", known=KNOWN)
    asked = [row.asked_power for row in own if row.diverged_at_s is None]
    over = [row for row in own if row.overruns]
    return Verdict(
        "With the amplifier known to its disturbance estimate KF-ANC overruns nowhere",
        not over,
        f"{len(over)} of {len(own)} runs overrun; weights ask for {_span(asked)} times the power that cancels the noise",
    )


def _clean(rows: Sequence[Row]) -> Verdict:
    free = {_place(row): row.harmonics_db for row in _of(rows, "KF-ANC", noise="tone") if row.overdrive_db > 0.0}
    below = {
        (name, *_place(row)): _ahead(-row.harmonics_db, -free[_place(row)])
        for name in KEEPS_POWER
        for row in _of(rows, name, noise="tone")
        if row.overdrive_db > 0.0 and row.amplifier == "hard clip"
    }
    least = min(below, key=lambda key: below[key])
    return Verdict(
        f"With a hard clip the harmonics of {' and '.join(KEEPS_POWER)} are {CLEANER_DB:g} dB below those of KF-ANC at every "
        "overdrive",
        below[least] >= CLEANER_DB,
        f"by {below[least]:.1f} dB at least ({', '.join(map(str, least))} dB), by {max(below.values()):.1f} dB at most",
    )


def _ahead(own: float, other: float) -> float:
    """How far one figure is ahead of another; NaN, of a run that diverged, is behind all."""
    if np.isnan(own):
        return -np.inf
    return np.inf if np.isnan(other) else own - other


def _place(row: Row) -> tuple[str, str, float]:
    return row.path, row.amplifier, row.overdrive_db


def _power(rows: Sequence[Row]) -> Verdict:
    powers = {name: [row.power for row in _of(rows, name)] for name in KEEPS_POWER}
    away = any(np.isnan(own).any() for own in powers.values())
    return Verdict(
        "KF-OPC and KF-PB keep their rated power to 2 % at every overdrive, although they do not know the amplifier",
        not away and all(max(own) <= 1.02 for own in powers.values()),
        "output power over the rated one: " + ", ".join(f"{name} {_span(own)}" for name, own in powers.items()),
    )


def _ordering(rows: Sequence[Row]) -> Verdict:
    free = {(_place(r), r.noise): r.noise_reduction_db for r in _of(rows, "KF-ANC")}
    leads = {
        key: _ahead(r.noise_reduction_db, free[key])
        for r in _of(rows, "KF-OPC")
        if r.overdrive_db > 0.0
        for key in [(_place(r), r.noise)]
    }
    behind: dict[str, set[float]] = {}
    for (place, noise), lead in leads.items():
        if not lead > 0.0:
            behind.setdefault(noise, set()).add(place[2])
    where = [f"{noise} at {', '.join(f'{level:g}' for level in sorted(own))} dB" for noise, own in behind.items()]
    return Verdict(
        "KF-OPC reduces the noise more than KF-ANC at every overdrive",
        not behind,
        f"by {max(leads.values()):+.1f} dB at best and {min(leads.values()):+.1f} dB at worst"
        + (f"; somewhere not: {'; '.join(where)}" if where else ""),
    )


def _notes(pairs: Iterable[str], rows: Sequence[Row]) -> list[str]:
    over = sorted({row.algorithm for row in rows if not row.within_budget and row.setting is not None})
    notes = without_measured(pairs)
    if over:
        notes.append(
            f"{', '.join(over)}: somewhere no setting tried kept the output power to 2 %; the one of lowest mean NSE is shown."
        )
    return [
        *notes,
        "Why KF-ANC overruns: its estimate d^ = e + s^*y counts on an anti-noise that the amplifier never put out, so that "
        "the estimated disturbance grows with the control signal, and the control signal with it. With s^*amp(y) in its "
        "place the estimate is the disturbance itself, and the filter asks for what a linear amplifier would need: it "
        "still overdrives the amplifier, but it does not run away.",
        "The weights grow for as long as the run lasts, so the powers asked for are those of this duration.",
        "Far overdriven, a square wave of the amplifier's limit has a fundamental 4/pi as large (2.1 dB) as the sine at "
        "rated power: that is why an overrunning filter can leave less of a tone, and its harmonics with it.",
        "Harmonics near -63 dB are the sensor noise under them, 40 dB below the disturbance in all: a tone that is not "
        "clipped has none of its own.",
        "A hard clip spares a sine at rated power; a soft saturation bends it too, so harmonics remain with every "
        "algorithm that uses its rated power.",
        "The peak-limited algorithms were tuned with the amplifier's limit and with the one at which a square wave keeps the "
        "rated power; noise at such a limit has less mean power than the rated one.",
    ]


def _table(rows: Sequence[Row], stem: str, figure: str, caption: str) -> Table:
    """A line for each case, overdrive and knowledge of the amplifier, a column for each algorithm."""
    lines: dict[tuple[str | float, ...], dict[str, str | float]] = {}
    for row in rows:
        if {"harmonics": "tone", "coherence": "band noise"}.get(stem, row.noise) == row.noise:
            key = (row.path, row.noise, row.amplifier, row.known, row.overdrive_db)
            value = "diverged" if row.diverged_at_s is not None else getattr(row, figure)
            mark = stem == "reduction" and row.overruns and row.diverged_at_s is None
            lines.setdefault(key, {})[row.algorithm] = f"{value:.4g} !" if mark else value
    return Table(
        stem,
        caption,
        ["paths", "noise", "amplifier", "to the estimate", "overdrive dB", *ALGORITHMS],
        [[*key, *(own.get(name, "") for name in ALGORITHMS)] for key, own in lines.items()],
    )
