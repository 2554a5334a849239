"""Study: the rated power kept on real paths, and the noise reduction it can buy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from kfopc_filterpy.bench.registry import STATE_NOISE_GRID
from kfopc_filterpy.bench.report import Parameter, StudyReport, Table, Verdict
from kfopc_filterpy.bench.scene import Runs, Scene
from kfopc_filterpy.bench.tuning import RULE, Tuned, tune
from kfopc_filterpy.power.budget import DEFAULT_CORRELATION_MEMORY_S, DEFAULT_CREDIT_S

from .constraint_cases import (
    FS,
    N_TAPS,
    SENSOR_NOISE_DB,
    SWITCH_ON_S,
    Setting,
    make_case,
    noises,
    paths,
    settings,
)
from .constraint_figures import constraint_figures
from .constraint_runs import (
    BACK_S,
    JUMPS_DB,
    LIMITED,
    SHARES,
    WINDOW_S,
    Clipped,
    Jump,
    Row,
    convergence_times,
    run_amplifiers,
    run_case,
    run_course,
    run_jumps,
    with_rated_power,
)

DURATIONS_S = (8.0, 60.0)  # the first is short: it is tuned on, and convergence is measured on it
SEEDS = (1, 2, 3, 4)
TUNED = ("KF-OPC", "KF-OPC repaired", "KF-PB")
CLIPPED_NOISES = ("tone", "band noise")

Settled = Mapping[str, Mapping[str, float | None]]


def planned_runs() -> int:
    """Jobs of the study."""
    pairs, made = paths(), noises()
    everything = settings(pairs, made)
    tuning = len(everything) * len(TUNED) * len(STATE_NOISE_GRID)
    cases = len(everything) * len(DURATIONS_S) * len(SEEDS)
    jumps = sum(setting.stationary for setting in everything)
    return tuning + cases + jumps + len(pairs) * len(CLIPPED_NOISES) + 1


def main(runs: Runs) -> StudyReport:
    """Run the study on all paths and noises at hand."""
    return constraint_study(runs, SEEDS, DURATIONS_S)


def constraint_study(runs: Runs, seeds: Sequence[int], durations_s: Sequence[float]) -> StudyReport:
    """The study with some seeds and durations; the first of each is what settings are tuned on."""
    pairs, made = paths(), noises()
    everything = settings(pairs, made)

    def case(setting: Setting, duration_s: float, seed: int) -> Scene:
        return make_case(pairs[setting.path], made[setting.noise](duration_s + SWITCH_ON_S, seed))

    tuned = {
        setting: tune(runs, with_rated_power(case(setting, durations_s[0], seeds[0]), SHARES[0]), TUNED)
        for setting in everything
    }
    jobs = [(setting, duration, seed) for setting in everything for duration in durations_s for seed in seeds]
    outcomes = runs.map(lambda job: run_case(case(*job), *job, tuned[job[0]]), jobs)
    rows = [row for own, _ in outcomes for row in own]
    stationary = [setting for setting in everything if setting.stationary]
    settled = {
        f"{setting.path}, {setting.noise}": convergence_times(
            [kept for job, (_, kept) in zip(jobs, outcomes, strict=True) if job[:2] == (setting, durations_s[0])]
        )
        for setting in stationary
    }
    jumps = _joined(runs.map(lambda s: run_jumps(pairs[s.path], made[s.noise], s, tuned[s]), stationary))
    clipping = [Setting(path, noise) for path in pairs for noise in CLIPPED_NOISES]
    clipped = _joined(runs.map(lambda s: run_amplifiers(case(s, durations_s[0], seeds[0]), s, tuned[s]), clipping))
    varying = Setting("measured duct", "motor") if "motor" in made else Setting("duct", "swelling band noise")
    course = runs.map(lambda s: run_course(case(s, 30.0, seeds[0]), s, tuned[s]), [varying])[0]
    return StudyReport(
        name="constraint",
        title="The constraint that holds",
        summary=(
            "The power-budgeted Kalman filter (KF-PB) and KF-OPC, as published and with its gain repaired, against the "
            "power-constrained Wiener solution, on modelled and real paths. The rated power is a share of what the "
            "unconstrained control filter of each noise would need."
        ),
        fs=FS,
        rated_power=SHARES[0],
        parameters=_parameters(seeds, durations_s, tuned),
        algorithms={},
        extra={"rows": [asdict(row) for row in rows], "convergence_s": settled},
        verdicts=_claims(rows, jumps, clipped, settled),
        figures=constraint_figures(rows, jumps, course),
        notes=_notes(made, rows),
        tables=[
            _summary_table(rows),
            _power_table(rows),
            _limiter_table(rows),
            _jump_table(jumps),
            _amplifier_table(clipped),
        ],
        claims="Aims",
    )


def _joined(lists: Iterable[list[Any]]) -> list[Any]:
    return [item for own in lists for item in own]


def _claims(rows: Sequence[Row], jumps: Sequence[Jump], clipped: Sequence[Clipped], settled: Settled) -> list[Verdict]:
    return [
        _steady_claim([row for row in rows if row.setting.stationary and row.algorithm == "KF-PB"]),
        _varying_claim([row for row in rows if not row.setting.stationary and row.algorithm == "KF-PB"]),
        _jump_claim(jumps),
        _guarantee_claim(rows, jumps, clipped),
        *_transparency_claims(rows),
        _convergence_claim(settled),
    ]


def _steady_claim(rows: Sequence[Row]) -> Verdict:
    powers, losses = [row.power for row in rows], [row.loss_db for row in rows]
    return Verdict(
        "KF-PB on stationary noise: output power 0.97 to 1.02 of the rated one, and noise reduction within 0.5 dB of the "
        "power-constrained Wiener solution, in every run",
        bool(np.min(powers) >= 0.97 and np.max(powers) <= 1.02 and np.max(losses) <= 0.5),
        f"{len(rows)} runs: output power {np.min(powers):.3f} to {np.max(powers):.3f}, {np.mean(losses):.2f} dB below the bound "
        f"on average and {_worst(rows)} at worst",
    )


def _varying_claim(rows: Sequence[Row]) -> Verdict:
    powers, losses = [row.power for row in rows], [row.loss_db for row in rows]
    return Verdict(
        "KF-PB on swelling and bursty noise: output power at most 1.05 of the rated one, and noise reduction within 1 dB "
        "of each second's own power-constrained Wiener solution, in every run",
        bool(np.max(powers) <= 1.05 and np.max(losses) <= 1.0),
        f"{len(rows)} runs: output power {np.min(powers):.3f} to {np.max(powers):.3f}, {np.mean(losses):.2f} dB below the bound "
        f"on average and {_worst(rows)} at worst",
    )


def _worst(rows: Sequence[Row]) -> str:
    row = max(rows, key=lambda row: np.inf if np.isnan(row.loss_db) else row.loss_db)
    return (
        f"{row.loss_db:.2f} dB ({row.setting.path}, {row.setting.noise}, {100 * row.share:.0f} %, {row.duration_s:g} s, "
        f"seed {row.seed})"
    )


def _jump_claim(jumps: Sequence[Jump]) -> Verdict:
    loss, weight = (float(np.max(np.abs([getattr(jump, name) for jump in jumps]))) for name in ("loss_db", "weight_db"))
    return Verdict(
        f"Two seconds after a jump of ±{max(JUMPS_DB):g} dB, one second long, noise reduction and lambda are those without "
        "the jump, to 1 dB",
        loss <= 1.0 and weight <= 1.0,
        f"{len(jumps)} runs: noise reduction off by {loss:.2f} dB and lambda by {weight:.2f} dB at most",
    )


def _guarantee_claim(rows: Sequence[Row], jumps: Sequence[Jump], clipped: Sequence[Clipped]) -> Verdict:
    worst = [row.worst_window for row in rows if row.algorithm.endswith("limited")]
    worst += [jump.worst_window_limited for jump in jumps]
    worst += [run.worst_window for run in clipped if run.algorithm.endswith("limited")]
    return Verdict(
        f"With the limiter no window of {1e3 * WINDOW_S:g} ms is above the rated power: level jumps, a wrong secondary path "
        "and a clipping amplifier included",
        bool(np.max(worst) <= 1 + 1e-9),
        f"{len(worst)} runs: {np.max(worst):.9f} of the rated power at most",
    )


def _transparency_claims(rows: Sequence[Row]) -> list[Verdict]:
    limited = {
        (r.setting, r.share, r.duration_s, r.seed, r.algorithm): r for r in rows if r.algorithm.endswith("limited")
    }
    gains = {
        key: row.noise_reduction_db - limited[*key[:-1], "KF-OPC limited"].noise_reduction_db
        for key, row in limited.items()
        if row.algorithm == "KF-PB limited"
    }
    least = min(gains, key=lambda key: -np.inf if np.isnan(gains[key]) else gains[key])
    tones = [row.loss_db for key, row in limited.items() if row.setting.noise == "tone" and key in gains]
    return [
        Verdict(
            "Behind the limiter KF-PB reduces the noise by at most 0.3 dB less than KF-OPC behind it, in every run",
            gains[least] >= -0.3,
            f"{np.mean(list(gains.values())):+.2f} dB on average, {gains[least]:+.2f} dB at worst ({least[0].path}, "
            f"{least[0].noise}, {100 * least[1]:.0f} %, {least[2]:g} s, seed {least[3]})",
        ),
        Verdict(
            "Behind the limiter a tone is reduced to within 0.5 dB of the bound",
            bool(np.max(tones) <= 0.5),
            f"{len(tones)} runs: {np.max(tones):.2f} dB below it at most",
        ),
    ]


def _convergence_claim(settled: Settled) -> Verdict:
    ratios = {name: _ratio(own["KF-PB"], own["KF-ANC"]) for name, own in settled.items()}
    slowest = max(ratios, key=lambda name: ratios[name])
    return Verdict(
        "KF-PB converges no slower than 1.5 times KF-ANC's time",
        ratios[slowest] <= 1.5,
        f"{np.mean(list(ratios.values())):.2f} times on average, {ratios[slowest]:.2f} at most ({slowest}); NSE over 50 ms, "
        "pooled over seeds",
    )


def _ratio(ours: float | None, theirs: float | None) -> float:
    """Of two convergence times: 0 where theirs does not settle, infinite where only ours does not."""
    mine, other = (np.inf if time is None or np.isnan(time) else time for time in (ours, theirs))
    if other == np.inf:
        return 0.0 if mine < np.inf else 1.0
    return mine / other if other > 0.0 else (0.0 if mine == 0.0 else np.inf)


def _summary_table(rows: Sequence[Row]) -> Table:
    """What all runs together say of each algorithm."""
    groups = {
        f"{kind} noise": [row for row in rows if row.setting.stationary == stationary]
        for kind, stationary in (("stationary", True), ("varying", False))
    }
    return Table(
        "summary",
        "All runs: output power over the rated one, noise reduction below the bound in dB, and largest mean power over "
        f"{1e3 * WINDOW_S:g} ms over the rated one",
        ["algorithm", "noise", "runs", "power", "below, mean", "below, worst", "runs > 1 dB below", "worst window"],
        [_summary_cells(name, kind, own) for name in TUNED for kind, own in groups.items() if own],
    )


def _summary_cells(algorithm: str, kind: str, rows: Sequence[Row]) -> list[str | float]:
    own = [row for row in rows if row.algorithm == algorithm]
    losses = np.array([row.loss_db for row in own])
    worst = float(np.max([row.worst_window for row in own]))
    below = [float(np.mean(losses)), float(np.max(losses)), int(np.sum(losses > 1.0))]
    return [algorithm, kind, len(own), _range(own), *below, worst]


def _power_table(rows: Sequence[Row]) -> Table:
    return _case_table(
        "power",
        "Noise reduction over the steady half (mean over seeds), output power over the rated one (least and largest of the "
        "seeds) and largest mean power over 100 ms over the rated one. Bound: the power-constrained Wiener solution over "
        "the record (tone, compressor, band noise) or of each second (motor, bursts, swelling band noise)",
        rows,
        {name: name for name in TUNED},
    )


def _limiter_table(rows: Sequence[Row]) -> Table:
    return _case_table("limiter", "The same behind the limiter", rows, {name: f"{name} limited" for name in LIMITED})


def _case_table(stem: str, caption: str, rows: Sequence[Row], shown: Mapping[str, str]) -> Table:
    """A line for each case; `shown` are algorithms by the name in the heading."""
    headings = ["paths", "noise", "rated power", "duration", "bound dB", "scaled Wiener dB"]
    for name in shown:
        headings += [f"{name} dB", "power", "worst 100 ms"]
    lines = []
    for own in _cases(rows):
        figures = [_cells([row for row in own if row.algorithm == algorithm]) for algorithm in shown.values()]
        lines.append([*_case_cells(own), *_joined(figures)])
    return Table(stem, caption, headings, lines)


def _cases(rows: Sequence[Row]) -> list[list[Row]]:
    """Rows of each combination of paths, noise, rated power and duration."""
    cases: dict[Any, list[Row]] = {}
    for row in rows:
        cases.setdefault((row.setting, row.share, row.duration_s), []).append(row)
    return [cases[key] for key in sorted(cases, key=lambda key: (key[2], key[0].path, key[0].noise, -key[1]))]


def _case_cells(rows: Sequence[Row]) -> list[str | float]:
    row = rows[0]
    bound, scaled = (float(np.mean([getattr(r, name) for r in rows])) for name in ("bound_db", "scaled_db"))
    return [row.setting.path, row.setting.noise, f"{100 * row.share:.0f} %", f"{row.duration_s:g} s", bound, scaled]


def _cells(rows: Sequence[Row]) -> list[str | float]:
    reduction = float(np.mean([row.noise_reduction_db for row in rows]))
    return [reduction, _range(rows), max(row.worst_window for row in rows)]


def _range(rows: Sequence[Row]) -> str:
    """Least and largest output power."""
    powers = [row.power for row in rows]
    return f"{np.min(powers):.2f}-{np.max(powers):.2f}"


def _jump_table(jumps: Sequence[Jump]) -> Table:
    return Table(
        "jumps",
        f"KF-PB after a second of another level, from {BACK_S:g} s after it on for 0.5 s: noise reduction lost and lambda "
        "gained against the run without it; its output power over the rated one in that second; and its largest over 100 ms "
        "behind the limiter",
        ["paths", "noise", "rated power", "jump dB", "lost dB", "lambda dB", "power in jump", "limited worst 100 ms"],
        [
            [
                jump.setting.path,
                jump.setting.noise,
                f"{100 * jump.share:.0f} %",
                jump.jump_db,
                jump.loss_db,
                jump.weight_db,
                jump.power_in_jump,
                jump.worst_window_limited,
            ]
            for jump in jumps
        ],
    )


def _amplifier_table(clipped: Sequence[Clipped]) -> Table:
    return Table(
        "amplifier",
        "An amplifier that clips at the peak of a sine of rated power (25 %), and what the disturbance estimate knows of it",
        ["paths", "noise", "algorithm", "amplifier or path", "noise reduction dB", "power", "worst 100 ms"],
        [
            [
                run.setting.path,
                run.setting.noise,
                run.algorithm,
                run.known,
                "diverged" if run.diverged_at_s is not None else run.noise_reduction_db,
                run.power,
                run.worst_window,
            ]
            for run in clipped
        ],
    )


def _parameters(
    seeds: Sequence[int], durations_s: Sequence[float], tuned: Mapping[Setting, Mapping[str, Tuned]]
) -> dict[str, Parameter]:
    parameters = {
        "fs_hz": Parameter(FS, "the rate of the measured duct"),
        "n_taps": Parameter(N_TAPS, "the aim's own"),
        "rated_power": Parameter(list(SHARES), "shares of the unconstrained control power of each noise"),
        "unconstrained_control_power": Parameter(
            1.0, "every noise is scaled to it: (R_x' + q/(N P0) I) w = r over the record"
        ),
        "durations_s": Parameter(list(durations_s), "from switch-on on; the steady half counts"),
        "switch_on_s": Parameter(SWITCH_ON_S, "the noise runs before"),
        "sensor_noise_db": Parameter(SENSOR_NOISE_DB, "below the disturbance"),
        "seeds": Parameter(list(seeds), "of noise; of a tone, its phase; of the recording, where it begins"),
        "limiter_window_s": Parameter(WINDOW_S, "default of OutputLimiter"),
        "KF-PB memory_s, credit_s": Parameter(
            [DEFAULT_CORRELATION_MEMORY_S, DEFAULT_CREDIT_S], "defaults of PowerBudget"
        ),
        "r E[x'^2]/q": Parameter(
            {f"{s.path}, {s.noise}": {name: own[name].setting for name in TUNED} for s, own in tuned.items()},
            f"tuned on the first seed, {durations_s[0]:g} s, 25 %: {RULE}",
        ),
    }
    return parameters


def _notes(made: Iterable[str], rows: Sequence[Row]) -> list[str]:
    notes = []
    if "motor" not in made:
        notes.append(
            "The measured duct and the motor recording were not at hand (KFOPC_DATA): those combinations are left out."
        )
    for name in ("KF-OPC", "KF-OPC repaired"):
        powers = [row.power for row in rows if row.algorithm == name]
        losses = [row.loss_db for row in rows if row.algorithm == name]
        notes.append(
            f"{name}: output power {np.min(powers):.2f} to {np.max(powers):.2f} of the rated one, {np.mean(losses):.2f} dB below "
            f"the bound on average, {np.max(losses):.2f} dB at worst."
        )
    return notes
