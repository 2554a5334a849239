"""Study: how near KF-PB comes to the best use of a rated power, by class of noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from scipy.signal import fftconvolve

from kfopc_filterpy import Plant, mov_fx_lms
from kfopc_filterpy.controllers.kf_pb import DEFAULT_AVERAGING_S
from kfopc_filterpy.metrics import overshoot

from ..bench import Claim, Parameter, Runs, StudyReport, Table
from ..bench.tuning import BUDGET
from . import kf_pb_cases as cases
from .cases import FS, SENSOR_NOISE_DB
from .kf_pb_cases import CHANGING, STEADY, Rated, make_rated
from .report_parts import report_of_rows, without_measured
from .rows import column, grouped, select

STEPS = 10.0 ** np.arange(-3.5, 0.1, 0.5)  # of MOV-FxLMS, over the largest
PENALTIES = 10.0 ** np.arange(-2.5, 2.1, 0.5)  # over the gain of the secondary path


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


def jobs() -> list[tuple[str, str, float]]:
    """Return the cases."""
    return list(product(cases.all_plants(), cases.noises(), cases.SHARES))


def planned_runs() -> int:
    """Return the number of jobs, each of which makes several runs."""
    return len(jobs())


def main(runs: Runs) -> StudyReport:
    """Run the study on the plants and noises at hand."""
    plants = cases.all_plants()
    rows = list(runs.map(partial(class_row, plants), jobs()))
    return report_of_rows(
        rows,
        name="kf-pb",
        title="A rated power spent best",
        summary=(
            "KF-PB with its default settings, against the power-constrained Wiener solution of each second and the best "
            "MOV-FxLMS that keeps the rating over every 10 s. The "
            "bound keeps the rating in every second; power that moves from a soft second to a loud one can exceed it."
        ),
        parameters={
            "n_taps": Parameter(cases.N_TAPS, "of every algorithm and of the bound"),
            "duration_s": Parameter([cases.SILENT_S, cases.DURATION_S], "before and after the control is switched on"),
            "rated_shares": Parameter(list(cases.SHARES), "of the power for full control"),
            "mov_steps": Parameter(list(STEPS), "over the step that is about the largest stable one"),
            "mov_penalties": Parameter(list(PENALTIES), "over the gain of the path, and the one that adapts"),
            "sensor_noise_db": Parameter(SENSOR_NOISE_DB, "over the disturbance"),
            "seed": Parameter(cases.SEED, "of noise and sensor noise"),
        },
        claims=claims(rows),
        notes=without_measured(plants),
        tables=[class_table(rows)],
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


# ---- Findings and tables


def claims(rows: Sequence[ClassRow]) -> list[Claim]:
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
    return found


def class_table(rows: Sequence[ClassRow]) -> Table:
    """Return a line for each class."""
    headings = ["class", "cases", "power, most", "over bound, dB", "worst", "over MOV-FxLMS, dB", "worst"]
    headings += ["first second, dB", "power, most"]
    lines = []
    for (kind,), own in grouped(rows, "kind").items():
        bound, mov, first = (column(own, name) for name in ("over_bound_db", "over_mov_db", "first_second_db"))
        power, first_power = column(own, "power").max(), column(own, "first_power").max()
        figures = (power, bound.mean(), bound.min(), mov.mean(), mov.min(), first.mean(), first_power)
        lines.append([kind, len(own), *(round(float(figure), 2) + 0.0 for figure in figures)])
    return Table(
        "classes", "KF-PB by class of noise, means from the second second on, and power over 10 s", headings, lines
    )
