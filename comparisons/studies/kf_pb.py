"""Study: how near KF-PB comes to the best use of a rated power, by class of noise, and with a path that is wrong."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.signal import fftconvolve

from kfopc_filterpy import MOVFxLMS, kf_pb, noise_reduction_db, power_constrained_wiener, simulate
from kfopc_filterpy.bench import Claim, FigureItem, Parameter, Runs, StudyReport, Table
from kfopc_filterpy.controllers.power_budget import DEFAULT_AVERAGING_S
from kfopc_filterpy.metrics import overshoot
from kfopc_filterpy.paths import path_taps, perturbed_path
from kfopc_filterpy.signals import DataUnavailableError, load_measured_duct, load_measured_room, looped

from .cases import FS, SENSOR_NOISE_DB, Pair, made_noises, paths, with_jump
from .report_parts import MARK, new_figure, without_measured

N_TAPS = 256
SILENT_S, DURATION_S = 3.0, 20.0  # before and after the control is switched on
SHARES = (0.25, 0.1)  # rated power over the power that full control needs
SEED = 1
STEADY, CHANGING = "steady and recorded", "jumps, bursts, mixes"
STEPS = 10.0 ** np.arange(-3.5, 0.1, 0.5)  # of MOV-FxLMS, over the largest
PENALTIES = 10.0 ** np.arange(-2.5, 2.1, 0.5)  # over the gain of the secondary path
FAULTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "two samples late": lambda s: np.concatenate([np.zeros(2), s[:-2]]),
    "two samples early": lambda s: np.concatenate([s[2:], np.zeros(2)]),
    "3 dB louder": lambda s: 10**0.15 * s,
    "3 dB softer": lambda s: 10**-0.15 * s,
    "polarity": lambda s: -s,
    "another phase": lambda s: path_taps(perturbed_path(s, fs=FS, phase_deg=120.0))[: s.size],
}
PRIMARY: dict[str, Callable[[np.ndarray], np.ndarray]] = {  # what becomes of the disturbance
    "primary path, polarity": lambda d: -d,
    "primary path, five samples late": lambda d: np.concatenate([np.zeros(5), d[:-5]]),
}
JUMPS = {  # dB, from and to s after switch-on
    "12 dB louder from 8 s on": (12.0, 8.0, DURATION_S),
    "12 dB softer from 8 s on": (-12.0, 8.0, DURATION_S),
    "10 dB louder for 4 s": (10.0, 6.0, 10.0),
}
JUMP_S = 8.0  # of the fault, from switch-on on


@dataclass(frozen=True)
class ClassRow:
    """KF-PB, the bound of each second and the best MOV-FxLMS in one case, from the second second on."""

    kind: str
    path: str
    noise: str
    share: float
    noise_reduction_db: float
    bound_db: float
    mov_db: float
    power: float  # largest over any `DEFAULT_AVERAGING_S`, over the rated one
    first_second_db: float  # noise reduction less that of the bound
    first_power: float  # over the first second, over the rated one

    @property
    def over_bound_db(self) -> float:
        """Noise reduction beyond the bound of each second."""
        return self.noise_reduction_db - self.bound_db

    @property
    def over_mov_db(self) -> float:
        """Noise reduction beyond the best MOV-FxLMS that keeps the rating."""
        return self.noise_reduction_db - self.mov_db


@dataclass(frozen=True)
class FaultRow:
    """KF-PB on a secondary path that is not its estimate."""

    path: str
    noise: str
    fault: str
    begins: str  # "start" or "jump"
    alarms: int
    worst_second_db: float  # least noise reduction over any second
    lost_db: float  # from 2 s after the fault on, against KF-PB with the right estimate throughout


# ---- Cases


def noises() -> dict[str, tuple[str, Callable[[], np.ndarray]]]:
    """Return the class and the samples of each noise, recordings where they are at hand."""
    duration = SILENT_S + DURATION_S
    made: dict[str, Callable[[], np.ndarray]] = {
        name: partial(make, duration, SEED) for name, make in made_noises().items()
    }
    recorded = {name: partial(looped, samples, duration, fs=FS) for name, samples in recordings().items()}
    steady = {name: made[name] for name in ("compressor", "band noise")} | recorded
    some = list(steady)[::2]  # a made one, and a recorded one where it is at hand
    changing: dict[str, Callable[[], np.ndarray]] = {name: made[name] for name in ("bursts", "swelling band noise")}
    for words, (gain_db, begin_s, end_s) in JUMPS.items():
        changing |= {f"{name}, {words}": partial(jumping, steady[name], gain_db, begin_s, end_s) for name in some}
    changing["band noise, then compressor"] = lambda: mixed(steady["band noise"](), steady["compressor"]())
    return {name: (STEADY, make) for name, make in steady.items()} | {
        name: (CHANGING, make) for name, make in changing.items()
    }


@cache
def recordings() -> dict[str, np.ndarray]:
    """Return the recorded noises at hand."""
    found = {}
    for name in ("motor", "compressor"):
        try:
            noise = load_measured_duct(noise=name, allow_download=True).noise
        except DataUnavailableError:
            continue
        found[f"recorded {name}"] = noise - noise.mean()
    return found


def jumping(make: Callable[[], np.ndarray], gain_db: float, begin_s: float, end_s: float) -> np.ndarray:
    """Return a noise that is louder between two times after switch-on."""
    return with_jump(make(), gain_db, SILENT_S + begin_s, SILENT_S + end_s - 1 / FS)


def mixed(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return one noise, the other from 7 s after switch-on on, and both from 13 s on."""
    t = np.arange(one.size) / FS - SILENT_S
    return one / np.std(one) * ((t < 7) | (t >= 13)) + other / np.std(other) * (t >= 7)


def all_paths() -> dict[str, Pair]:
    """Return the pairs of paths of the studies, with one of the measured room if it is at hand."""
    try:
        room = load_measured_room(allow_download=True)
    except DataUnavailableError:
        return paths()
    return paths() | {"measured room": (room.primary[0, 0], room.secondary[0, 0])}


@dataclass(frozen=True)
class Rated:
    """A noise, its disturbance with sensor noise, the secondary path, and a rated power."""

    reference: np.ndarray
    disturbance: np.ndarray
    secondary: np.ndarray
    rated_power: float
    bound_error: np.ndarray  # of each second's own fixed filter within the rated power

    @property
    def after(self) -> np.ndarray:
        """The disturbance after switch-on."""
        return self.disturbance[round(SILENT_S * FS) :]

    def run(self, controller: Any) -> Any:
        """Return the run of a controller."""
        return simulate(
            controller,
            self.reference,
            disturbance=self.disturbance,
            secondary_path=self.secondary,
            fs=FS,
            switch_on_s=SILENT_S,
        )

    def reduction_db(self, error: np.ndarray, begin_s: float = 1.0, end_s: float = DURATION_S) -> float:
        """Return the noise reduction between two times after switch-on."""
        part = slice(round(begin_s * FS), round(end_s * FS))
        return noise_reduction_db(error[part], self.after[part], steady=1.0)

    def seconds_db(self, error: np.ndarray) -> np.ndarray:
        """Return the noise reduction of each second."""
        return np.array([self.reduction_db(error, second, second + 1) for second in range(int(DURATION_S))])


def make_rated(pair: Pair, noise: np.ndarray, share: float) -> Rated:
    """Return a case whose rated power is a share of what full control needs."""
    primary, secondary = pair
    x = noise / np.std(noise)
    d = fftconvolve(x, primary)[: x.size]
    d += 10 ** (SENSOR_NOISE_DB / 20) * np.std(d) * np.random.default_rng(SEED).standard_normal(d.size)
    needed = with_any_power(x, d, secondary, N_TAPS).control_power
    bound = fixed_filters(x, d, secondary, N_TAPS, rated_power=share * needed).per_second.error
    return Rated(x, d, secondary, share * needed, bound)


def with_any_power(x: np.ndarray, d: np.ndarray, secondary: np.ndarray, n_taps: int) -> Any:
    """Return the best fixed filter of a length for a reference and a disturbance, whatever power it takes."""
    ridge = 1e-4 * np.var(fftconvolve(x, secondary)[: x.size])
    solutions = fixed_filters(x, d, secondary, n_taps, rated_power=1e12, segment_s=DURATION_S, ridge=ridge)
    return solutions.unconstrained


def fixed_filters(x: np.ndarray, d: np.ndarray, secondary: np.ndarray, n_taps: int, **settings: float) -> Any:
    """Return the power-constrained Wiener solutions."""
    with warnings.catch_warnings():
        # In directions without energy very large weights would do better, and no controller reaches them.
        warnings.simplefilter("ignore", np.exceptions.RankWarning)
        return power_constrained_wiener(x, d, secondary, n_taps, fs=FS, switch_on_s=SILENT_S, **settings)


# ---- Runs


def class_row(pairs: dict[str, Pair], job: tuple[str, str, float]) -> ClassRow:
    """Run KF-PB with the exact path and its default settings, and MOV-FxLMS with those of its grid."""
    path, noise, share = job
    kind, make = noises()[noise]
    case = make_rated(pairs[path], make(), share)
    result = case.run(kf_pb(N_TAPS, case.secondary, rated_power=case.rated_power, fs=FS))
    error, y = result.error, result.control_signal
    return ClassRow(
        kind,
        path,
        noise,
        share,
        noise_reduction_db=case.reduction_db(error),
        bound_db=case.reduction_db(case.bound_error),
        mov_db=best_mov_db(case),
        power=overshoot(y, case.rated_power, FS, window_s=DEFAULT_AVERAGING_S),
        first_second_db=case.reduction_db(error, 0.0, 1.0) - case.reduction_db(case.bound_error, 0.0, 1.0),
        first_power=float(np.mean(y[: round(FS)] ** 2)) / case.rated_power,
    )


def best_mov_db(case: Rated) -> float:
    """Return the noise reduction of the best MOV-FxLMS whose power over every `DEFAULT_AVERAGING_S` is within the rating."""
    filtered = fftconvolve(case.reference, case.secondary)[: case.reference.size]
    gain = np.var(filtered) / np.var(case.reference)
    best = -np.inf
    for step in STEPS / (N_TAPS * np.var(filtered)):
        for penalty in (None, *(gain * PENALTIES)):
            own = {} if penalty is None else {"penalty_factor": penalty}
            controller = MOVFxLMS(N_TAPS, case.secondary, step_size=step, rated_power=case.rated_power, **own)
            result = case.run(controller)
            if result.diverged_at_s is not None:
                continue
            if overshoot(result.control_signal, case.rated_power, FS, window_s=DEFAULT_AVERAGING_S) <= 1.0:
                best = max(best, case.reduction_db(result.error))
    return best


def fault_rows(pairs: dict[str, Pair], job: tuple[str, str]) -> list[FaultRow]:
    """Run KF-PB with every fault, from the start and as a jump."""
    path, noise = job
    case = make_rated(pairs[path], noises()[noise][1](), SHARES[0])
    right, same = case.secondary, case.disturbance
    reference, _ = run_with_jump(case, right, right, same)
    runs = [(fault, "start", change(right), right, same) for fault, change in FAULTS.items()]
    runs += [(fault, "jump", right, change(right), same) for fault, change in FAULTS.items()]
    runs += [(fault, "jump", right, right, change(same)) for fault, change in PRIMARY.items()]
    rows = []
    for fault, begins, estimate, later, disturbance in runs:
        error, alarms = run_with_jump(case, estimate, later, disturbance)
        after = 2.0 if begins == "start" else JUMP_S + 2.0
        rows.append(
            FaultRow(
                path,
                noise,
                fault,
                begins,
                alarms,
                worst_second_db=float(np.min(case.seconds_db(error))),
                lost_db=case.reduction_db(reference, after) - case.reduction_db(error, after),
            )
        )
    return rows


def run_with_jump(
    case: Rated, estimate: np.ndarray, later: np.ndarray, disturbance: np.ndarray
) -> tuple[np.ndarray, int]:
    """Return the error and the alarms of a run whose secondary path and disturbance become others at `JUMP_S`."""
    controller = kf_pb(N_TAPS, estimate, rated_power=case.rated_power, fs=FS)
    on, jump = round(SILENT_S * FS), round((SILENT_S + JUMP_S) * FS)
    controller.listen(case.reference[:on], case.disturbance[:on])
    line = np.zeros(case.secondary.size)
    errors = np.empty(case.reference.size - on)
    for n in range(on, case.reference.size):
        path, d = (case.secondary, case.disturbance[n]) if n < jump else (later, disturbance[n])
        line[1:] = line[:-1]
        line[0] = controller.control_signal(case.reference[n])
        errors[n - on] = d - path @ line
        controller.update(errors[n - on])
    return errors, controller.alarms


def jobs() -> tuple[list[tuple[str, str, float]], list[tuple[str, str]]]:
    """Return the cases of the classes and those of the faults."""
    pairs, made = all_paths(), noises()
    classes = [(path, noise, share) for path in pairs for noise in made for share in SHARES]
    steady = [noise for noise, (kind, _) in made.items() if kind == STEADY]
    faults = [(path, noise) for path in pairs for noise in steady[::2]]
    return classes, faults


def planned_runs() -> int:
    """Return the number of jobs, each of which makes several runs."""
    classes, faults = jobs()
    return len(classes) + len(faults)


def main(runs: Runs) -> StudyReport:
    """Run the study on the paths and noises at hand."""
    pairs = all_paths()
    classes, faults = jobs()
    rows = list(runs.map(partial(class_row, pairs), classes))
    wrong = [row for some in runs.map(partial(fault_rows, pairs), faults) for row in some]
    return StudyReport(
        name="kf-pb",
        title="A rated power spent best",
        summary=(
            "KF-PB with its default settings, against the power-constrained Wiener solution of each second and the best "
            "MOV-FxLMS that keeps the rating over every 10 s; then with a secondary path that is not the estimate. The "
            "bound keeps the rating in every second; power that moves from a soft second to a loud one can exceed it."
        ),
        fs=FS,
        rated_power=1.0,
        parameters={
            "n_taps": Parameter(N_TAPS, "of every algorithm and of the bound"),
            "duration_s": Parameter([SILENT_S, DURATION_S], "before and after the control is switched on"),
            "rated_shares": Parameter(list(SHARES), "of the power that full control needs; the faults have the first"),
            "mov_steps": Parameter(list(STEPS), "over the step that is about the largest stable one"),
            "mov_penalties": Parameter(list(PENALTIES), "over the gain of the path, and the one that adapts"),
            "sensor_noise_db": Parameter(SENSOR_NOISE_DB, "over the disturbance"),
            "seed": Parameter(SEED, "of noise and sensor noise"),
        },
        algorithms={},
        extra={"rows": [asdict(row) for row in rows], "faults": [asdict(row) for row in wrong]},
        claims=claims(rows, wrong),
        figures=[loss_figure(rows)],
        notes=without_measured(pairs),
        tables=[class_table(rows), case_table(rows), fault_table(wrong)],
        claims_heading="Findings",
    )


# ---- Findings, tables, figure


def of_class(rows: Iterable[ClassRow], kind: str) -> list[ClassRow]:
    """Return the rows of a class."""
    return [row for row in rows if row.kind == kind]


def claims(rows: Sequence[ClassRow], wrong: Sequence[FaultRow]) -> list[Claim]:
    """Return what is asked of KF-PB, and what it reaches."""
    found = []
    for kind, power, worst, within, behind in ((STEADY, 1.02, -1.0, 0.95, 0.0), (CHANGING, 1.05, -5.0, 1.0, 0.1)):
        own = of_class(rows, kind)
        powers, losses, ahead = (
            np.array([getattr(row, name) for row in own]) for name in ("power", "over_bound_db", "over_mov_db")
        )
        found += [
            Claim(
                f"Power over any 10 s at most {power:g} of the rating, {kind}",
                bool(powers.max() <= power),
                f"{powers.max():.3f}",
            ),
            Claim(
                f"At most {-worst:g} dB below the bound of each second in {100 * within:g} % of the cases, {kind}",
                bool(np.mean(losses >= worst) >= within),
                f"{100 * np.mean(losses >= worst):.0f} %; {losses.mean():+.2f} dB on average, {losses.min():+.2f} dB at worst",
            ),
            Claim(
                f"0.5 dB below the best MOV-FxLMS in at most {100 * behind:g} % of the cases, {kind}",
                bool(np.mean(ahead < -0.5) <= behind),
                f"{100 * np.mean(ahead < -0.5):.0f} %; {ahead.mean():+.2f} dB on average, {ahead.min():+.2f} dB at worst",
            ),
        ]
    worst_second = min(wrong, key=lambda row: row.worst_second_db)
    lost = np.array([row.lost_db for row in wrong if row.fault != "3 dB louder"])
    return [
        *found,
        Claim(
            "With a wrong path, no second is more than 1 dB louder than without control",
            worst_second.worst_second_db >= -1.0,
            f"{worst_second.worst_second_db:+.1f} dB ({worst_second.path}, {worst_second.noise}, {worst_second.fault}, {worst_second.begins})",
        ),
        Claim(
            "From 2 s after the fault on, at most 1 dB is lost against the right estimate",
            bool(np.mean(lost <= 1.0) == 1.0),
            f"in {100 * np.mean(lost <= 1.0):.0f} % of {lost.size} runs; {lost.mean():+.2f} dB on average",
        ),
    ]


def class_table(rows: Sequence[ClassRow]) -> Table:
    """Return a line for each class."""
    headings = ["class", "cases", "power over 10 s, most", "over the bound, mean dB", "worst dB"]
    headings += ["over MOV-FxLMS, mean dB", "worst dB", "first second, mean dB", "its power, most"]
    lines = []
    for kind in (STEADY, CHANGING):
        own = of_class(rows, kind)
        bound, mov = ([getattr(row, name) for row in own] for name in ("over_bound_db", "over_mov_db"))
        first = [row.first_second_db for row in own]
        lines.append(
            [
                *(
                    kind,
                    len(own),
                    max(row.power for row in own),
                    float(np.mean(bound)),
                    min(bound),
                    float(np.mean(mov)),
                    min(mov),
                ),
                *(float(np.mean(first)), max(row.first_power for row in own)),
            ]
        )
    return Table("classes", "KF-PB by class of noise, from the second second on", headings, lines)


def case_table(rows: Sequence[ClassRow]) -> Table:
    """Return a line for each case."""
    names = ("path", "noise", "share", "noise_reduction_db", "bound_db", "mov_db", "power", "first_second_db")
    return Table(
        "cases",
        "Noise reduction in dB of KF-PB, of the bound of each second and of the best MOV-FxLMS",
        [name.replace("_", " ") for name in names],
        [[getattr(row, name) for name in names] for row in rows],
    )


def fault_table(rows: Sequence[FaultRow]) -> Table:
    """Return a line for each fault, over all cases."""
    lines = []
    for fault in (*FAULTS, *PRIMARY):
        for begins in ("start", "jump") if fault in FAULTS else ("jump",):
            own = [row for row in rows if (row.fault, row.begins) == (fault, begins)]
            lost = [row.lost_db for row in own]
            lines.append(
                [
                    *(fault, begins, min(row.worst_second_db for row in own), float(np.mean(lost)), max(lost)),
                    *(min(row.alarms for row in own), max(row.alarms for row in own)),
                ]
            )
    headings = ["fault", "from", "worst second dB", "lost after 2 s, mean dB", "most dB", "alarms, least", "most"]
    return Table("faults", "KF-PB with a secondary path that is not its estimate", headings, lines)


def loss_figure(rows: Sequence[ClassRow]) -> FigureItem:
    """Return a figure of all cases: noise reduction against the bound's."""
    figure, axes = new_figure((6.0, 5.0))
    ax = axes[0, 0]
    for kind, marker in ((STEADY, "o"), (CHANGING, "^")):
        own = of_class(rows, kind)
        ax.plot([row.bound_db for row in own], [row.noise_reduction_db for row in own], marker, label=kind, alpha=0.7)
    ends = [0.0, max(row.bound_db for row in rows)]
    ax.plot(ends, ends, color=MARK, linewidth=1)
    ax.set_xlabel("Bound of each second: noise reduction (dB)")
    ax.set_ylabel("KF-PB: noise reduction (dB)")
    ax.legend()
    ax.grid(True, alpha=0.3)
    caption = "Noise reduction of KF-PB against that of the bound, which knows every second in advance."
    return FigureItem("bound", caption, figure)
