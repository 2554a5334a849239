"""Study: how near KF-PB comes to the best use of a rated power, by class of noise, and with a path that is wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product

import numpy as np
from scipy.signal import fftconvolve

from kfopc_filterpy import Plant, mov_fx_lms, simulate
from kfopc_filterpy.controllers.kf_pb import DEFAULT_AVERAGING_S
from kfopc_filterpy.metrics import overshoot

from ..bench import Claim, FigureItem, Parameter, Runs, StudyReport, Table
from ..bench.tuning import BUDGET
from . import kf_pb_cases as cases
from .cases import FS, SENSOR_NOISE_DB
from .kf_pb_cases import CHANGING, FAULTS, STEADY, Rated, make_rated
from .report_parts import MARK, new_figure, report_of_rows, without_measured
from .rows import column, grouped, select, worst_claim

STEPS = 10.0 ** np.arange(-3.5, 0.1, 0.5)  # of MOV-FxLMS, over the largest
PENALTIES = 10.0 ** np.arange(-2.5, 2.1, 0.5)  # over the gain of the secondary path
PRIMARY: dict[str, Callable[[np.ndarray], np.ndarray]] = {  # what becomes of the disturbance
    "primary path, polarity": lambda d: -d,
    "primary path, five samples late": lambda d: np.concatenate([np.zeros(5), d[:-5]]),
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


def jobs() -> tuple[list[tuple[str, str, float]], list[tuple[str, str]]]:
    """Return the cases of the classes and those of the faults."""
    plants, made = cases.all_plants(), cases.noises()
    steady = [noise for noise, (kind, _) in made.items() if kind == STEADY]
    return list(product(plants, made, cases.SHARES)), list(product(plants, steady[::2]))


def planned_runs() -> int:
    """Return the number of jobs, each of which makes several runs."""
    classes, faults = jobs()
    return len(classes) + len(faults)


def main(runs: Runs) -> StudyReport:
    """Run the study on the plants and noises at hand."""
    plants = cases.all_plants()
    classes, faults = jobs()
    rows = list(runs.map(partial(class_row, plants), classes))
    wrong = [row for some in runs.map(partial(fault_rows, plants), faults) for row in some]
    return report_of_rows(
        rows,
        name="kf-pb",
        title="A rated power spent best",
        summary=(
            "KF-PB with its default settings, against the power-constrained Wiener solution of each second and the best "
            "MOV-FxLMS that keeps the rating over every 10 s; then with a secondary path that is not the estimate. The "
            "bound keeps the rating in every second; power that moves from a soft second to a loud one can exceed it."
        ),
        parameters={
            "n_taps": Parameter(cases.N_TAPS, "of every algorithm and of the bound"),
            "duration_s": Parameter([cases.SILENT_S, cases.DURATION_S], "before and after the control is switched on"),
            "rated_shares": Parameter(list(cases.SHARES), "of the power for full control; the faults have the first"),
            "mov_steps": Parameter(list(STEPS), "over the step that is about the largest stable one"),
            "mov_penalties": Parameter(list(PENALTIES), "over the gain of the path, and the one that adapts"),
            "sensor_noise_db": Parameter(SENSOR_NOISE_DB, "over the disturbance"),
            "seed": Parameter(cases.SEED, "of noise and sensor noise"),
        },
        extra={"faults": [asdict(row) for row in wrong]},
        claims=claims(rows, wrong),
        figures=[loss_figure(rows)],
        notes=without_measured(plants),
        tables=[class_table(rows), case_table(rows), fault_table(wrong)],
    )


# ---- Runs


def class_row(plants: dict[str, Plant], job: tuple[str, str, float]) -> ClassRow:
    """Run KF-PB with the exact path and its default settings, and MOV-FxLMS with those of its grid."""
    path, noise, share = job
    kind, make = cases.noises()[noise]
    case = make_rated(plants[path], make(), share)
    result = case.run(case.kf_pb(case.secondary))
    error, y = result.error, result.control_signal
    return ClassRow(
        kind,
        *job,
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
    gain, rated = np.var(filtered) / np.var(case.reference), case.rated_power
    best = -np.inf
    for step, penalty in product(STEPS / (cases.N_TAPS * np.var(filtered)), (None, *(gain * PENALTIES))):
        own = {"rated_power": rated} if penalty is None else {"penalty_factor": penalty}
        result = case.run(mov_fx_lms(cases.N_TAPS, case.plant, step_size=step, **own))
        if result.diverged_at_s is None:
            kept = overshoot(result.control_signal, rated, FS, window_s=DEFAULT_AVERAGING_S) <= BUDGET
            best = max(best, case.reduction_db(result.error)) if kept else best
    return best


def fault_rows(plants: dict[str, Plant], job: tuple[str, str]) -> list[FaultRow]:
    """Run KF-PB with every fault, from the start and as a jump."""
    path, noise = job
    case = make_rated(plants[path], cases.noises()[noise][1](), cases.SHARES[0])
    right, same = case.secondary, case.disturbance
    reference, _ = run_with_jump(case, right, right, same)
    runs = []
    for fault, change in FAULTS.items():
        runs += [(fault, "start", change(right), right, same), (fault, "jump", right, change(right), same)]
    runs += [(fault, "jump", right, right, change(same)) for fault, change in PRIMARY.items()]
    rows = []
    for fault, begins, *changed in runs:
        error, alarms = run_with_jump(case, *changed)
        seconds = [case.reduction_db(error, second, second + 1) for second in range(int(cases.DURATION_S))]
        after = 2.0 if begins == "start" else JUMP_S + 2.0
        lost = case.reduction_db(reference, after) - case.reduction_db(error, after)
        rows.append(FaultRow(path, noise, fault, begins, alarms, worst_second_db=float(np.min(seconds)), lost_db=lost))
    return rows


def run_with_jump(
    case: Rated, estimate: np.ndarray, later: np.ndarray, disturbance: np.ndarray
) -> tuple[np.ndarray, int]:
    """Return the error and the alarms of a run whose secondary path and disturbance become others at `JUMP_S`."""
    controller, jump_s = case.kf_pb(estimate), cases.SILENT_S + JUMP_S
    at = round(jump_s * FS)
    result = simulate(
        controller,
        case.reference,
        case.plant.changed_at(jump_s, secondary=later),
        disturbance=np.concatenate([case.disturbance[:at], disturbance[at:]]),
        switch_on_s=cases.SILENT_S,
    )
    return result.error, controller.alarms


# ---- Findings, tables, figure


def claims(rows: Sequence[ClassRow], wrong: Sequence[FaultRow]) -> list[Claim]:
    """Return what is asked of KF-PB, and what it reaches."""
    found = []
    for kind, power, below, within, behind in ((STEADY, 1.02, 1.0, 0.95, 0.0), (CHANGING, 1.05, 5.0, 1.0, 0.1)):
        own = select(rows, kind=kind)
        losses, ahead = column(own, "over_bound_db"), column(own, "over_mov_db")
        found += [
            Claim(f"Power over any 10 s over the rated one, {kind}", column(own, "power").max(), at_most=power),
            Claim(
                f"Share of the cases at most {below:g} dB below the bound of each second, {kind}",
                float(np.mean(losses >= -below)),
                at_least=within,
            ),
            Claim(
                f"Share of the cases 0.5 dB below the best MOV-FxLMS, {kind}",
                float(np.mean(ahead < -0.5)),
                at_most=behind,
            ),
        ]
    seconds = {_told(row): row.worst_second_db for row in wrong}
    lost = {_told(row): row.lost_db for row in wrong if row.fault != "3 dB louder"}
    return [
        *found,
        worst_claim("Least noise reduction over a second, with a wrong path (dB)", seconds, at_least=-1.0),
        worst_claim("Lost from 2 s after the fault on, against the right estimate (dB)", lost, at_most=1.0),
    ]


def _told(row: FaultRow) -> str:
    return f"{row.path}, {row.noise}, {row.fault}, {row.begins}"


def class_table(rows: Sequence[ClassRow]) -> Table:
    """Return a line for each class."""
    headings = ["class", "cases", "power over 10 s, most", "over the bound, mean dB", "worst dB"]
    headings += ["over MOV-FxLMS, mean dB", "worst dB", "first second, mean dB", "its power, most"]
    lines = []
    for (kind,), own in grouped(rows, "kind").items():
        bound, mov, first = (column(own, name) for name in ("over_bound_db", "over_mov_db", "first_second_db"))
        power, first_power = column(own, "power").max(), column(own, "first_power").max()
        lines.append(
            [kind, len(own), power, bound.mean(), bound.min(), mov.mean(), mov.min(), first.mean(), first_power]
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
    for key, own in grouped(rows, "fault", "begins").items():
        seconds, lost, alarms = (column(own, name) for name in ("worst_second_db", "lost_db", "alarms"))
        lines.append([*key, seconds.min(), lost.mean(), lost.max(), alarms.min(), alarms.max()])
    headings = ["fault", "from", "worst second dB", "lost after 2 s, mean dB", "most dB", "alarms, least", "most"]
    return Table("faults", "KF-PB with a secondary path that is not its estimate", headings, lines)


def loss_figure(rows: Sequence[ClassRow]) -> FigureItem:
    """Return a figure of all cases: noise reduction against the bound's."""
    figure, axes = new_figure((6.0, 5.0))
    ax = axes[0, 0]
    for kind, marker in ((STEADY, "o"), (CHANGING, "^")):
        own = select(rows, kind=kind)
        ax.plot(column(own, "bound_db"), column(own, "noise_reduction_db"), marker, label=kind, alpha=0.7)
    ends = [0.0, max(row.bound_db for row in rows)]
    ax.plot(ends, ends, color=MARK, linewidth=1)
    ax.set(xlabel="Bound of each second: noise reduction (dB)", ylabel="KF-PB: noise reduction (dB)")
    ax.legend()
    caption = "Noise reduction of KF-PB against that of the bound, which knows every second in advance."
    return FigureItem("bound", caption, figure)
