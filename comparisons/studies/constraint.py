"""Study: the rated power kept on real paths, and the noise reduction it can buy."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from typing import Any

import numpy as np

from kfopc_filterpy import (
    HardClipAmplifier,
    OutputLimiter,
    SimulationResult,
    convergence_time_s,
    noise_reduction_db,
)
from kfopc_filterpy.bench import (
    Claim,
    FigureItem,
    Parameter,
    Runs,
    Scene,
    StudyReport,
    Table,
    Tuned,
    make_controller,
    tune,
)
from kfopc_filterpy.controllers.power_budget import DEFAULT_AVERAGING_S
from kfopc_filterpy.metrics import overshoot, short_time_power
from kfopc_filterpy.paths import path_taps, perturbed_path
from kfopc_filterpy.plot import curve_style

from .cases import (
    FS,
    SWITCH_ON_S,
    WINDOW_S,
    Case,
    Pair,
    WindowRow,
    bounds_db,
    decibels,
    figures_of,
    grid_runs,
    make_case,
    noises,
    paths,
    with_jump,
)
from .report_parts import MARK, case_parameters, cell, legend_of, new_figure

N_TAPS = 160
DURATIONS_S = (8.0, 60.0)  # the first is short: it is tuned on, and convergence is measured on it
SEEDS = (1, 2, 3, 4)
SHARES = (0.25, 0.10)  # rated power over the unconstrained control power
TUNED = ("KF-OPC", "KF-OPC repaired", "KF-PB")
LIMITED = ("KF-OPC", "KF-PB")  # also run behind the limiter
CLIPPED_NOISES = ("tone", "band noise")
JUMPS_DB = (20.0, -20.0)
JUMP_S = (6.0, 7.0)  # of a run of JUMP_RUN_S, from switch-on on
JUMP_RUN_S = 18.0
BACK_S = 8.0  # after which what the jump overspent is repaid, and all is to be as without the jump
LONGEST_KEPT_S = 10.0  # a run whose signals are kept for its convergence time
COURSE_S = 30.0

Settled = Mapping[str, Mapping[str, float | None]]  # convergence times by case and algorithm
Signals = dict[str, tuple[np.ndarray, np.ndarray]]  # error and disturbance by algorithm


@dataclass(frozen=True, kw_only=True)
class ConstraintRow(WindowRow):
    """One run of a case."""

    share: float
    duration_s: float
    seed: int
    bound_db: float  # over the record for a stationary noise, of each second for another
    scaled_db: float  # what scaling the Wiener control filter reaches

    @property
    def loss_db(self) -> float:
        """Noise reduction below the bound."""
        return self.bound_db - self.noise_reduction_db

    @property
    def place(self) -> str:
        """Where it was run, in words."""
        return f"{self.case}, {100 * self.share:.0f} %, {self.duration_s:g} s, seed {self.seed}"


@dataclass(frozen=True, kw_only=True)
class ClippedRow(WindowRow):
    """A run with an amplifier that clips at the peak of a sine of rated power."""

    known: str  # what the disturbance estimate knows of the amplifier


@dataclass(frozen=True)
class Jump:
    """A second of another level, against the same run without it."""

    case: Case
    share: float
    jump_db: float
    loss_db: float  # noise reduction without the jump minus that with it, over 0.5 s from BACK_S after it on
    weight_db: float  # lambda with the jump over that without, there
    power_in_jump: float  # over the rated power
    worst_window_limited: float
    time_s: np.ndarray
    power_weight: np.ndarray


@dataclass(frozen=True)
class Course:
    """Runs of a noise that swells, for the figures of what happens over time."""

    case: Case
    rated_power: float
    results: dict[str, SimulationResult]


def planned_runs() -> int:
    """Return the number of jobs of the study."""
    pairs = paths()
    everything = all_cases(pairs, noises())
    jumps = sum(case.stationary for case in everything)
    runs = len(everything) * (grid_runs(TUNED) + len(DURATIONS_S) * len(SEEDS))
    return runs + jumps + len(pairs) * len(CLIPPED_NOISES) + 1


def all_cases(pairs: Iterable[str], made: Iterable[str]) -> list[Case]:
    """Return all combinations of paths and noises."""
    made = list(made)
    return [Case(path, noise) for path in pairs for noise in made]


def main(runs: Runs) -> StudyReport:
    """Run the study on all paths and noises at hand; the first seed and duration are what settings are tuned on."""
    pairs, made = paths(), noises()
    everything = all_cases(pairs, made)

    def scene(case: Case, duration_s: float, seed: int) -> Scene:
        noise = made[case.noise](duration_s + SWITCH_ON_S, seed)
        return make_case(pairs[case.path], noise, n_taps=N_TAPS)

    def first(case: Case) -> Scene:
        return scene(case, DURATIONS_S[0], SEEDS[0])

    tuned = {case: tune(runs, replace(first(case), rated_power=SHARES[0]), TUNED) for case in everything}
    jobs = [(case, duration, seed) for case in everything for duration in DURATIONS_S for seed in SEEDS]
    outcomes = runs.map(lambda job: run_case(scene(*job), *job, tuned[job[0]]), jobs)
    rows = [row for own, _ in outcomes for row in own]
    stationary = [case for case in everything if case.stationary]
    settled = {
        str(case): convergence_times(
            [kept for job, (_, kept) in zip(jobs, outcomes, strict=True) if job[:2] == (case, DURATIONS_S[0])]
        )
        for case in stationary
    }
    jumps = _joined(runs.map(lambda case: run_jumps(pairs[case.path], made[case.noise], case, tuned[case]), stationary))
    clipping = all_cases(pairs, CLIPPED_NOISES)
    clipped = _joined(runs.map(lambda case: run_amplifiers(first(case), case, tuned[case]), clipping))
    varying = Case("measured duct", "motor") if "motor" in made else Case("duct", "swelling band noise")
    (course,) = runs.map(lambda case: run_course(scene(case, COURSE_S, SEEDS[0]), case, tuned[case]), [varying])
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
        parameters=_parameters(tuned),
        algorithms={},
        extra={"rows": [asdict(row) for row in rows], "convergence_s": settled},
        claims=_claims(rows, jumps, clipped, settled),
        figures=constraint_figures(rows, jumps, course),
        notes=_notes(made, rows),
        tables=[
            _summary_table(rows),
            _power_table(rows),
            _limiter_table(rows),
            _jump_table(jumps),
            _amplifier_table(clipped),
        ],
        claims_heading="Aims",
    )


def _joined(lists: Iterable[list[Any]]) -> list[Any]:
    return list(chain.from_iterable(lists))


# ---- Runs


def _controller(
    scene: Scene, algorithm: str, tuned: Mapping[str, Tuned], *, limited: bool = False, amplifier: Any = None
) -> Any:
    """Return a fresh controller; KF-ANC has the setting of KF-OPC."""
    setting = tuned["KF-OPC" if algorithm == "KF-ANC" else algorithm].setting
    controller = make_controller(scene, algorithm, setting, amplifier=amplifier)
    if limited:
        controller.limiter = OutputLimiter(scene.rated_power, fs=FS, window_s=WINDOW_S)
    return controller


def run_case(
    scene: Scene, case: Case, duration_s: float, seed: int, tuned: Mapping[str, Tuned]
) -> tuple[list[ConstraintRow], Signals]:
    """Run all algorithms on one noise, with each rated power; short runs leave signals for `convergence_times`."""
    rows: list[ConstraintRow] = []
    kept: dict[str, SimulationResult] = {}
    for share in SHARES:
        rated = replace(scene, rated_power=share)
        anc, opc = rated.run_together([_controller(rated, name, tuned) for name in ("KF-ANC", "KF-OPC")])
        results = {"KF-OPC": opc}
        results |= {name: rated.run(_controller(rated, name, tuned)) for name in TUNED[1:]}
        results |= {f"{name} limited": rated.run(_controller(rated, name, tuned, limited=True)) for name in LIMITED}
        bound, scaled = bounds_db(rated, case.stationary)
        place: dict[str, Any] = {"path": case.path, "noise": case.noise, "share": share, "duration_s": duration_s}
        place |= {"seed": seed, "bound_db": bound, "scaled_db": scaled}
        rows += [
            ConstraintRow(
                **place,
                algorithm=name,
                setting=tuned[name.removesuffix(" limited")].setting,
                **figures_of(result, share),
            )
            for name, result in results.items()
        ]
        if duration_s <= LONGEST_KEPT_S and not kept:  # longer ones would fill the memory
            kept = {"KF-ANC": anc, "KF-PB": results["KF-PB"]}
    return rows, {name: (result.error, result.disturbance) for name, result in kept.items()}


def convergence_times(kept: Sequence[Signals]) -> dict[str, float | None]:
    """Return convergence times in seconds of the runs that `run_case` kept, the NSE over 50 ms pooled over seeds."""
    times: dict[str, float | None] = {}
    for name in ("KF-ANC", "KF-PB"):
        errors, disturbances = (np.array([one[name][i] for one in kept]) for i in (0, 1))
        times[name] = convergence_time_s(errors, disturbances, FS, window_s=0.05, runs=True)
    return times


def run_jumps(pair: Pair, noise: Any, case: Case, tuned: Mapping[str, Tuned]) -> list[Jump]:
    """Run KF-PB through a second that is 20 dB louder or softer."""
    steady = noise(JUMP_RUN_S + SWITCH_ON_S, 1)
    scene = make_case(pair, steady, n_taps=N_TAPS)
    jumps = []
    for share in SHARES:
        rated = replace(scene, rated_power=share)
        without = rated.run(_controller(rated, "KF-PB", tuned), record_powers=True)
        for gain_db in JUMPS_DB:
            begin, end = (t + SWITCH_ON_S for t in JUMP_S)
            x = with_jump(rated.references[0], gain_db, begin, end)
            d = np.convolve(x, pair[0])[: x.size]
            jumped = replace(rated, references=[x], disturbances=[d])
            result = jumped.run(_controller(rated, "KF-PB", tuned), record_powers=True)
            limited = jumped.run(_controller(rated, "KF-PB", tuned, limited=True))
            after = slice(round((JUMP_S[1] + BACK_S) * FS), round((JUMP_S[1] + BACK_S + 0.5) * FS))
            within = slice(round(JUMP_S[0] * FS), round(JUMP_S[1] * FS))
            jumps.append(
                Jump(
                    case,
                    share,
                    gain_db,
                    _reduction(without, after) - _reduction(result, after),
                    _decibels(_mean_weight(result, after), _mean_weight(without, after)),
                    float(np.mean(result.control_signal[within] ** 2)) / rated.rated_power,
                    overshoot(limited.control_signal, rated.rated_power, FS, window_s=WINDOW_S),
                    result.time_s[:: round(FS / 100)],
                    _weights(result)[:: round(FS / 100)],
                )
            )
    return jumps


def _weights(result: SimulationResult) -> np.ndarray:
    assert result.power_weight is not None
    return result.power_weight


def _mean_weight(result: SimulationResult, part: slice) -> float:
    return float(np.mean(_weights(result)[part]))


def _decibels(one: float, other: float) -> float:
    """Return a ratio in dB, 0 if both are 0."""
    return float(decibels(one) - decibels(other))


def _reduction(result: SimulationResult, part: slice) -> float:
    return noise_reduction_db(result.error[part], result.disturbance[part], steady=1.0)


def run_amplifiers(scene: Scene, case: Case, tuned: Mapping[str, Tuned]) -> list[ClippedRow]:
    """Run Kalman controllers with a clipping amplifier that the disturbance estimate knows, does not, or knows wrongly."""
    rated = replace(scene, rated_power=SHARES[0])
    limit = rated.amplitude_limit
    known = {
        "unknown": None,
        "known": HardClipAmplifier(limit),
        "limit 20 % too high": HardClipAmplifier(1.2 * limit),
        "limit 20 % too low": HardClipAmplifier(0.8 * limit),
    }
    rows = []
    for algorithm in ("KF-ANC", "KF-OPC", "KF-PB"):
        for name, model in known.items():
            controller = _controller(rated, algorithm, tuned, amplifier=model)
            rows.append(_clipped(rated, case, algorithm, name, controller))
    wrong = replace(rated, secondary=path_taps(perturbed_path(rated.secondary, fs=FS, gain_db=6.0, phase_deg=45.0)))
    for algorithm in LIMITED:
        controller = _controller(wrong, algorithm, tuned, limited=True)
        rows.append(_clipped(rated, case, f"{algorithm} limited", "path 6 dB, 45° off", controller))
    return rows


def _clipped(scene: Scene, case: Case, algorithm: str, known: str, controller: Any) -> ClippedRow:
    result = replace(scene, amplifier=HardClipAmplifier(scene.amplitude_limit)).run(controller)
    figures = figures_of(result, scene.rated_power)
    return ClippedRow(path=case.path, noise=case.noise, algorithm=algorithm, known=known, **figures)


def run_course(scene: Scene, case: Case, tuned: Mapping[str, Tuned]) -> Course:
    """Run KF-OPC, KF-PB and KF-PB behind the limiter over half a minute."""
    rated = replace(scene, rated_power=SHARES[0])
    results = {name: rated.run(_controller(rated, name, tuned), record_powers=True) for name in TUNED}
    limited = rated.run(_controller(rated, "KF-PB", tuned, limited=True))
    return Course(case, rated.rated_power, results | {"KF-PB limited": limited})


# ---- Claims and notes


def _claims(
    rows: Sequence[ConstraintRow], jumps: Sequence[Jump], clipped: Sequence[ClippedRow], settled: Settled
) -> list[Claim]:
    return [
        _steady_claim([row for row in rows if row.case.stationary and row.algorithm == "KF-PB"]),
        _varying_claim([row for row in rows if not row.case.stationary and row.algorithm == "KF-PB"]),
        _jump_claim(jumps),
        _guarantee_claim(rows, jumps, clipped),
        *_transparency_claims(rows),
        _convergence_claim(settled),
    ]


def _steady_claim(rows: Sequence[ConstraintRow]) -> Claim:
    powers, losses = [row.power for row in rows], [row.loss_db for row in rows]
    return Claim(
        "KF-PB on stationary noise: output power 0.97 to 1.02 of the rated one, and noise reduction within 0.5 dB of the "
        "power-constrained Wiener solution, in every run",
        bool(np.min(powers) >= 0.97 and np.max(powers) <= 1.02 and np.max(losses) <= 0.5),
        f"{len(rows)} runs: output power {np.min(powers):.3f} to {np.max(powers):.3f}, {np.mean(losses):.2f} dB below the bound "
        f"on average and {_worst(rows)} at worst",
    )


def _varying_claim(rows: Sequence[ConstraintRow]) -> Claim:
    longest = max(row.duration_s for row in rows)
    long = [row for row in rows if row.duration_s == longest]
    powers, losses = [row.power for row in long], [row.loss_db for row in long]
    return Claim(
        f"KF-PB on swelling and bursty noise: output power at most 1.05 of the rated one, and noise reduction within 1 dB "
        f"of each second's own power-constrained Wiener solution, in every run of {longest:g} s, over several averaging times",
        bool(np.max(powers) <= 1.05 and np.max(losses) <= 1.0),
        f"{len(long)} runs: output power {np.min(powers):.3f} to {np.max(powers):.3f}, {np.mean(losses):.2f} dB below the bound "
        f"on average and {_worst(long)} at worst; shorter runs included, {_worst(rows)} at worst",
    )


def _worst(rows: Sequence[ConstraintRow]) -> str:
    row = max(rows, key=lambda row: np.inf if np.isnan(row.loss_db) else row.loss_db)
    return f"{row.loss_db:.2f} dB ({row.place})"


def _jump_claim(jumps: Sequence[Jump]) -> Claim:
    loss, weight = (float(np.max(np.abs([getattr(jump, name) for jump in jumps]))) for name in ("loss_db", "weight_db"))
    return Claim(
        f"{BACK_S:g} seconds after a jump of ±{max(JUMPS_DB):g} dB, one second long, noise reduction and lambda are those without "
        "the jump, to 1 dB",
        loss <= 1.0 and weight <= 1.0,
        f"{len(jumps)} runs: noise reduction off by {loss:.2f} dB and lambda by {weight:.2f} dB at most",
    )


def _guarantee_claim(rows: Sequence[ConstraintRow], jumps: Sequence[Jump], clipped: Sequence[ClippedRow]) -> Claim:
    worst = [row.worst_window for row in rows if row.algorithm.endswith("limited")]
    worst += [jump.worst_window_limited for jump in jumps]
    worst += [run.worst_window for run in clipped if run.algorithm.endswith("limited")]
    return Claim(
        f"With the limiter no window of {1e3 * WINDOW_S:g} ms is above the rated power: level jumps, a wrong secondary path "
        "and a clipping amplifier included",
        bool(np.max(worst) <= 1 + 1e-9),
        f"{len(worst)} runs: {np.max(worst):.9f} of the rated power at most",
    )


def _transparency_claims(rows: Sequence[ConstraintRow]) -> list[Claim]:
    ours, theirs = (
        {row.place: row for row in rows if row.algorithm == f"{name} limited"} for name in ("KF-PB", "KF-OPC")
    )
    gains = {place: row.noise_reduction_db - theirs[place].noise_reduction_db for place, row in ours.items()}
    least = min(gains, key=lambda place: -np.inf if np.isnan(gains[place]) else gains[place])
    tones = [row.loss_db for row in ours.values() if row.noise == "tone"]
    return [
        Claim(
            "Behind the limiter KF-PB reduces the noise by at most 0.3 dB less than KF-OPC behind it, in every run",
            gains[least] >= -0.3,
            f"{np.mean(list(gains.values())):+.2f} dB on average, {gains[least]:+.2f} dB at worst ({least})",
        ),
        Claim(
            "Behind the limiter a tone is reduced to within 0.5 dB of the bound",
            bool(np.max(tones) <= 0.5),
            f"{len(tones)} runs: {np.max(tones):.2f} dB below it at most",
        ),
    ]


def _convergence_claim(settled: Settled) -> Claim:
    ratios = {name: _ratio(own["KF-PB"], own["KF-ANC"]) for name, own in settled.items()}
    slowest = max(ratios, key=lambda name: ratios[name])
    return Claim(
        "KF-PB converges no slower than 1.5 times KF-ANC's time",
        ratios[slowest] <= 1.5,
        f"{np.mean(list(ratios.values())):.2f} times on average, {ratios[slowest]:.2f} at most ({slowest}); NSE over 50 ms, "
        "pooled over seeds",
    )


def _ratio(ours: float | None, theirs: float | None) -> float:
    """Return the ratio of two convergence times: 0 if theirs does not settle, infinite if only ours does not."""
    mine, other = (np.inf if time is None or np.isnan(time) else time for time in (ours, theirs))
    if other == np.inf:
        return 0.0 if mine < np.inf else 1.0
    return mine / other if other > 0.0 else (0.0 if mine == 0.0 else np.inf)


def _notes(made: Iterable[str], rows: Sequence[ConstraintRow]) -> list[str]:
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


# ---- Tables and parameters


def _summary_table(rows: Sequence[ConstraintRow]) -> Table:
    """Return what all runs together say of each algorithm."""
    groups = {
        f"{kind} noise": [row for row in rows if row.case.stationary == stationary]
        for kind, stationary in (("stationary", True), ("varying", False))
    }
    return Table(
        "summary",
        "All runs: output power over the rated one, noise reduction below the bound in dB, and largest mean power over "
        f"{1e3 * WINDOW_S:g} ms over the rated one",
        ["algorithm", "noise", "runs", "power", "below, mean", "below, worst", "runs > 1 dB below", "worst window"],
        [_summary_cells(name, kind, own) for name in TUNED for kind, own in groups.items() if own],
    )


def _summary_cells(algorithm: str, kind: str, rows: Sequence[ConstraintRow]) -> list[str | float]:
    own = [row for row in rows if row.algorithm == algorithm]
    losses = np.array([row.loss_db for row in own])
    worst = float(np.max([row.worst_window for row in own]))
    below = [float(np.mean(losses)), float(np.max(losses)), int(np.sum(losses > 1.0))]
    return [algorithm, kind, len(own), _range(own), *below, worst]


def _power_table(rows: Sequence[ConstraintRow]) -> Table:
    return _case_table(
        "power",
        "Noise reduction over the steady half (mean over seeds), output power over the rated one (least and largest of the "
        "seeds) and largest mean power over 100 ms over the rated one. Bound: the power-constrained Wiener solution over "
        "the record (tone, compressor, band noise) or of each second (motor, bursts, swelling band noise)",
        rows,
        {name: name for name in TUNED},
    )


def _limiter_table(rows: Sequence[ConstraintRow]) -> Table:
    return _case_table("limiter", "The same behind the limiter", rows, {name: f"{name} limited" for name in LIMITED})


def _case_table(stem: str, caption: str, rows: Sequence[ConstraintRow], shown: Mapping[str, str]) -> Table:
    """Return a line for each case; `shown` are algorithms by the name in the heading."""
    headings = ["paths", "noise", "rated power", "duration", "bound dB", "scaled Wiener dB"]
    for name in shown:
        headings += [f"{name} dB", "power", "worst 100 ms"]
    lines = []
    for own in _cases(rows):
        figures = [_cells([row for row in own if row.algorithm == algorithm]) for algorithm in shown.values()]
        lines.append([*_case_cells(own), *_joined(figures)])
    return Table(stem, caption, headings, lines)


def _cases(rows: Sequence[ConstraintRow]) -> list[list[ConstraintRow]]:
    """Return the rows of each combination of paths, noise, rated power and duration."""
    cases: dict[Any, list[ConstraintRow]] = {}
    for row in rows:
        cases.setdefault((row.case, row.share, row.duration_s), []).append(row)
    return [cases[key] for key in sorted(cases, key=lambda key: (key[2], key[0].path, key[0].noise, -key[1]))]


def _case_cells(rows: Sequence[ConstraintRow]) -> list[str | float]:
    row = rows[0]
    bound, scaled = (float(np.mean([getattr(r, name) for r in rows])) for name in ("bound_db", "scaled_db"))
    return [row.path, row.noise, f"{100 * row.share:.0f} %", f"{row.duration_s:g} s", bound, scaled]


def _cells(rows: Sequence[ConstraintRow]) -> list[str | float]:
    reduction = float(np.mean([row.noise_reduction_db for row in rows]))
    return [reduction, _range(rows), max(row.worst_window for row in rows)]


def _range(rows: Sequence[ConstraintRow]) -> str:
    """Return the least and the largest output power."""
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
                *(jump.case.path, jump.case.noise, f"{100 * jump.share:.0f} %", jump.jump_db, jump.loss_db),
                *(jump.weight_db, jump.power_in_jump, jump.worst_window_limited),
            ]
            for jump in jumps
        ],
    )


def _amplifier_table(clipped: Sequence[ClippedRow]) -> Table:
    return Table(
        "amplifier",
        "An amplifier that clips at the peak of a sine of rated power (25 %), and what the disturbance estimate knows of it",
        ["paths", "noise", "algorithm", "amplifier or path", "noise reduction dB", "power", "worst 100 ms"],
        [
            [
                run.path,
                run.noise,
                run.algorithm,
                run.known,
                cell(run, "noise_reduction_db"),
                run.power,
                run.worst_window,
            ]
            for run in clipped
        ],
    )


def _parameters(tuned: Mapping[Case, Mapping[str, Tuned]]) -> dict[str, Parameter]:
    return case_parameters(Parameter(N_TAPS, "the aim's own")) | {
        "rated_power": Parameter(list(SHARES), "shares of the unconstrained control power of each noise"),
        "durations_s": Parameter(list(DURATIONS_S), "from switch-on on; the steady half counts"),
        "seeds": Parameter(list(SEEDS), "of noise; of a tone, its phase; of the recording, where it begins"),
        "limiter_window_s": Parameter(WINDOW_S, "default of OutputLimiter"),
        "KF-PB averaging_s": Parameter(DEFAULT_AVERAGING_S, "default of kf_pb"),
        "r E[x'^2]/q": Parameter(
            {str(case): {name: own[name].setting for name in TUNED} for case, own in tuned.items()},
            f"tuned on the first seed, {DURATIONS_S[0]:g} s, 25 %: {Tuned.RULE}",
        ),
    }


# ---- Figures


def constraint_figures(rows: Sequence[ConstraintRow], jumps: Sequence[Jump], course: Course) -> list[FigureItem]:
    """Return all figures."""
    shortest = min(row.duration_s for row in rows)
    shown = [row for row in rows if row.duration_s == shortest and row.share == SHARES[0]]
    part = f"rated power {100 * SHARES[0]:.0f} %, {shortest:g} s, all seeds"
    behind = ("KF-OPC", "KF-PB", "KF-PB limited")
    return [
        FigureItem(
            "loss",
            f"Noise reduction below the bound, the power-constrained Wiener solution ({part}). KF-OPC can lie above it if "
            "it overspends.",
            _by_case(shown, "Below the bound (dB)", lambda row: row.loss_db, mark=0.0),
        ),
        FigureItem(
            "power",
            f"Output power over the rated one, mean of the steady half ({part}).",
            _by_case(shown, "Output power / rated power", lambda row: row.power),
        ),
        FigureItem(
            "window",
            f"Largest mean power over {1e3 * WINDOW_S:g} ms over the rated power, with the limiter too ({part}).",
            _by_case(shown, "Worst 100 ms / rated power", lambda row: row.worst_window, names=behind, log=True),
        ),
        _course(course),
        _limiter(course),
        _jumps(jumps),
    ]


def _by_case(
    rows: Sequence[ConstraintRow],
    label: str,
    value: Callable[[ConstraintRow], float],
    *,
    mark: float = 1.0,
    names: Sequence[str] = TUNED,
    log: bool = False,
) -> Any:
    """Draw a column for each combination of paths and noise, and a mark for each seed."""
    figure, ((ax,),) = new_figure((10.5, 4.4))
    cases = list(dict.fromkeys(row.case for row in rows))
    for k, name in enumerate(names):
        points = [
            (cases.index(row.case) + 0.25 * (k - 0.5 * (len(names) - 1)), value(row))
            for row in rows
            if row.algorithm == name
        ]
        ax.plot(*zip(*points, strict=True), **_style(name) | {"linestyle": ""}, markersize=4, alpha=0.8, label=name)
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
    legend_of(figure, [ax])
    return figure


def _course(course: Course) -> FigureItem:
    figure, ((power,), (level,), (weight,)) = new_figure((9.0, 7.0), 3, sharex=True)
    every = round(FS / 50)
    first = next(iter(course.results.values()))
    time = first.time_s[::every]
    level.plot(time, decibels(short_time_power(first.disturbance, FS, 0.5))[::every], color=MARK, label="disturbance")
    for name in TUNED:
        result = course.results[name]
        share = short_time_power(result.control_signal, FS, 1.0) / course.rated_power
        power.plot(time, share[::every], label=name, **_line(name))
        level.plot(time, decibels(short_time_power(result.error, FS, 0.5))[::every], label=name, **_line(name))
    power.axhline(1.0, color=MARK, linewidth=1)
    power.set_ylabel("Output power over 1 s\n/ rated power")
    level.set_ylabel("Power over 0.5 s (dB)")
    weights = course.results["KF-PB"].power_weight
    assert weights is not None
    weight.plot(time, weights[::every], **_line("KF-PB"))
    weight.set_ylabel("λ of KF-PB")
    weight.set_xlabel("Time (s)")
    weight.set_xlim(0, time[-1])
    legend_of(figure, [power])
    for ax in (power, level, weight):
        ax.grid(True, alpha=0.3)
    return FigureItem(
        "course",
        f"{course.case.noise.capitalize()}, {course.case.path}: output power, disturbance (grey) and errors, and λ, which "
        "follows the noise's level.",
        figure,
    )


def _limiter(course: Course) -> FigureItem:
    figure, ((ax,),) = new_figure((9.0, 4.0))
    part = slice(round(10 * FS), round(14 * FS))
    for name, label in {"KF-PB": "without limiter", "KF-PB limited": "with limiter"}.items():
        result = course.results[name]
        short = short_time_power(result.control_signal, FS, WINDOW_S) / course.rated_power
        ax.plot(result.time_s[part][::16], short[part][::16], label=f"KF-PB {label}", **_line(name))
    ax.axhline(1.0, color=MARK, linewidth=1)
    ax.set_xlabel("Time (s)")
    ax.set_ylabel(f"Power over {1e3 * WINDOW_S:g} ms / rated power")
    ax.set_ylim(bottom=0)
    ax.set_xlim(10, 14)
    ax.grid(True, alpha=0.3)
    legend_of(figure, [ax])
    return FigureItem(
        "limiter", f"{course.case.noise.capitalize()}, {course.case.path}: what the limiter does.", figure
    )


def _jumps(jumps: Sequence[Jump]) -> FigureItem:
    figure, (axes,) = new_figure((10.5, 3.8), 1, 2, sharey=True)
    for ax, gain_db in zip(axes, dict.fromkeys(jump.jump_db for jump in jumps), strict=True):
        own = [jump for jump in jumps if jump.jump_db == gain_db and jump.share == SHARES[0]]
        places = list(dict.fromkeys(jump.case.path for jump in own))
        for jump in own:
            style = curve_style(places.index(jump.case.path)) | {"marker": ""}
            label = jump.case.path if jump is next(j for j in own if j.case.path == jump.case.path) else None
            ax.semilogy(jump.time_s, np.maximum(jump.power_weight, 1e-4), linewidth=1, label=label, **style)
        ax.axvspan(*JUMP_S, color=MARK, alpha=0.15)
        ax.set_xlim(JUMP_S[0] - 2, JUMP_S[1] + BACK_S)
        ax.set_ylim(1e-3, None)
        ax.set_xlabel("Time (s)")
        ax.set_title(f"{gain_db:+g} dB for a second", fontsize="medium")
        ax.grid(True, alpha=0.3)
    axes[0].set_ylabel("λ of KF-PB")
    axes[0].legend(frameon=False, fontsize="small")
    return FigureItem(
        "jumps", "λ through a second of another level (grey): tone, compressor and band noise on each path.", figure
    )


def _style(name: str) -> dict[str, Any]:
    return curve_style(3 if name == "KF-PB limited" else name)


def _line(name: str) -> dict[str, Any]:
    return _style(name) | {"marker": ""}
