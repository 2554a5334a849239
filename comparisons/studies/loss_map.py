"""Study: where the noise reduction is lost, from what the reference hears to KF-PB behind a limiter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from kfopc_filterpy import OutputLimiter, Plant

from ..bench import FigureItem, Parameter, Runs, StudyReport, Table
from . import kf_pb_cases as cases
from .cases import FS, SENSOR_NOISE_DB
from .kf_pb_cases import STEADY, fixed_filters, make_rated, with_any_power
from .report_parts import new_figure, report_of_rows, without_measured
from .rows import grouped

LONG = 4 * cases.N_TAPS  # taps that stand for a filter of any length
STAGES = {  # what each stage adds to the one before
    "causality": f"a causal filter of {LONG} taps, with any power",
    "length": f"a filter of {cases.N_TAPS} taps",
    "price": "the rated power is kept in every second, and each second has its own filter",
    "adaptation": "KF-PB with the exact path, within the rated power over 10 s",
    "path": "KF-PB with an estimate that is two samples early, which it verifies",
    "limiter": "the same behind a limiter that keeps the rated power in every 100 ms",
}


@dataclass(frozen=True)
class LossRow:
    """Noise reduction at each stage in one case, from the second second on."""

    path: str
    noise: str
    reduction_db: list[float]  # of `STAGES`
    window_bound_db: float  # of a fixed filter whose every 100 ms keeps the rated power

    @property
    def losses_db(self) -> np.ndarray:
        """Loss of each stage, that of the first relative to the sensor noise; a negative loss is a gain."""
        return -np.diff([-SENSOR_NOISE_DB, *self.reduction_db])


def loss_row(plants: dict[str, Plant], job: tuple[str, str]) -> LossRow:
    """Run every stage of a case."""
    path, noise = job
    case = make_rated(plants[path], cases.noises()[noise][1](), cases.SHARES[0])
    wrong = np.concatenate([case.secondary[2:], np.zeros(2)])
    controllers = [
        case.kf_pb(case.secondary, secondary_path_uncertainty=None),
        case.kf_pb(wrong),
        case.kf_pb(wrong, limiter=OutputLimiter(case.rated_power, fs=FS)),
    ]
    plant = (case.reference, case.disturbance, case.plant)
    errors = [*(with_any_power(*plant, n_taps).error for n_taps in (LONG, cases.N_TAPS)), case.bound_error]
    errors += [case.run(controller).error for controller in controllers]
    bound = fixed_filters(*plant, cases.N_TAPS, rated_power=case.rated_power)
    return LossRow(
        path, noise, [case.reduction_db(error) for error in errors], case.reduction_db(bound.within_windows().error)
    )


def jobs() -> list[tuple[str, str]]:
    """Return the cases: every plant with every steady noise at hand."""
    steady = [noise for noise, (kind, _) in cases.noises().items() if kind == STEADY]
    return [(path, noise) for path in cases.all_plants() for noise in steady]


def planned_runs() -> int:
    """Return the number of cases, each of which takes several runs."""
    return len(jobs())


def main(runs: Runs) -> StudyReport:
    """Run the study on the paths and noises at hand."""
    plants = cases.all_plants()
    rows = list(runs.map(partial(loss_row, plants), jobs()))
    return report_of_rows(
        rows,
        name="loss-map",
        title="Where the noise reduction is lost",
        summary=(
            f"The sensor noise would allow {-SENSOR_NOISE_DB:g} dB. Each stage is a step towards a real controller: "
            + "; ".join(f"{name}: {what}" for name, what in STAGES.items())
            + "."
        ),
        parameters={
            "n_taps": Parameter(cases.N_TAPS, "of the control filter"),
            "duration_s": Parameter([cases.SILENT_S, cases.DURATION_S], "before and after the control is switched on"),
            "rated_share": Parameter(cases.SHARES[0], "of the power that full control needs"),
            "sensor_noise_db": Parameter(SENSOR_NOISE_DB, "relative to the disturbance"),
            "seed": Parameter(cases.SEED, "of noise and sensor noise"),
        },
        figures=[loss_figure(rows)],
        notes=without_measured(plants),
        tables=[mean_table(rows), loss_table(rows)],
    )


def mean_table(rows: Sequence[LossRow]) -> Table:
    """Return a line for each plant: means over the noises."""
    return Table(
        "means",
        "Noise reduction lost at each stage and left, in dB, means over the noises; a negative loss is a gain",
        ["path", *STAGES, "left"],
        [
            [
                path,
                *np.mean([row.losses_db for row in own], axis=0),
                float(np.mean([row.reduction_db[-1] for row in own])),
            ]
            for (path,), own in grouped(rows, "path").items()
        ],
    )


def loss_table(rows: Sequence[LossRow]) -> Table:
    """Return a line for each case: the losses, and what is left."""
    headings = ["path", "noise", *(f"{name}, dB" for name in STAGES), "left, dB", "bound, 100 ms, dB"]
    return Table(
        "losses",
        "Noise reduction lost at each stage, in dB; a negative loss is a gain",
        headings,
        [[row.path, row.noise, *row.losses_db, row.reduction_db[-1], row.window_bound_db] for row in rows],
    )


def loss_figure(rows: Sequence[LossRow]) -> FigureItem:
    """Return a figure with a bar for each case, from the sensor noise down to what is left."""
    from matplotlib import colormaps

    figure, axes = new_figure((7.0, 1.2 + 0.32 * len(rows)), grid="")
    ax, names = axes[0, 0], [f"{row.path}, {row.noise}" for row in rows]
    left = np.array([row.reduction_db[-1] for row in rows])
    colours = iter(colormaps["cividis"](np.linspace(0.0, 1.0, 1 + len(STAGES))))  # told apart in grey, too
    ax.barh(names, left, color=next(colours), edgecolor="w", linewidth=0.4, label="left")
    for stage, name in reversed(list(enumerate(STAGES))):
        lost = np.maximum([row.losses_db[stage] for row in rows], 0.0)
        ax.barh(names, lost, left=left, color=next(colours), edgecolor="w", linewidth=0.4, label=name)
        left = left + lost
    ax.invert_yaxis()
    ax.margins(y=0.01)
    ax.set(xlabel="Noise reduction that is left, and what is lost (dB)", xlim=(0.0, 42.0))
    row = {"ncols": 1 + len(STAGES), "fontsize": "small", "handlelength": 1.0, "columnspacing": 1.2, "frameon": False}
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper center", **row)
    caption = "Noise reduction that is left behind a limiter, and what each stage loses; gains are not drawn."
    return FigureItem("losses", caption, figure)
