"""Study: noise reduction and output power against the rated power, every algorithm and the bound."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult
from kfopc_filterpy.plot import curve_style

from .. import bench
from ..bench import Claim, FigureItem, Parameter, Runs, Scene, StudyReport, Table, Tuned, algorithms
from . import report_parts as parts
from .cases import SWITCH_ON_S, Case, bounds_db, grid_runs, make_case, noises, plants
from .rows import WindowRow, column, figures_of, grouped, worst_claim

SHARES_DB = (-20.0, -15.0, -12.0, -9.0, -6.0, -3.0, 0.0)  # rated power over the unconstrained control power
DURATION_S = 8.0
SHOWN_DB = -6.0  # in the table that fits a screen
N_TAPS = 160
SEEDS = (1, 2)  # tuned on all of them
CASES = (
    Case("duct", "band noise"),
    Case("duct", "compressor"),
    Case("measured duct", "compressor"),
    Case("measured duct", "motor"),
)
BOUND, RECORD, SCALED = "bound", "bound of the record", "scaled Wiener"  # the first, of each second if that varies
PANELS = {
    "Kalman filters": ("KF-OPC", "KF-PB", "diagonal KF-OPC"),
    "FxLMS with a price": (
        *("leaky FxLMS", "optimal leaky FxLMS"),
        *("MOV-FxLMS fixed", "MOV-FxLMS by variance", "MOV-FxLMS", "MOV-MFxLMS"),
    ),
    "FxLMS with an amplitude limit": ("two-gradient FxLMS", "re-scaling FxLMS", "clipping FxLMS"),
    "FxLMS in the frequency domain": ("power-limited FxLMS",),
}

TunedAt = Mapping[float, Mapping[str, Tuned]]  # by rated power and algorithm
Means = Mapping[tuple[Case, str], "list[BudgetRow]"]  # by case and algorithm, in the order of the rated power


@dataclass(frozen=True, kw_only=True)
class BudgetRow(WindowRow):
    """One run at one rated power."""

    share_db: float
    seed: int

    def __str__(self) -> str:
        return f"{self.case}, {self.share_db:g} dB"


def cases() -> list[Case]:
    """Return the cases whose paths and noise are at hand."""
    at_hand, made = plants(), noises()
    return [case for case in CASES if case.path in at_hand and case.noise in made]


def planned_runs() -> int:
    """Return the number of runs: those of the grids, and the jobs that measure."""
    once = grid_runs(name for name, own in algorithms().items() if not own.sees_budget)
    each = grid_runs(name for name, own in algorithms().items() if own.sees_budget)
    return len(cases()) * len(SEEDS) * (once + len(SHARES_DB) * each + 1 + len(SHARES_DB))


def main(runs: Runs) -> StudyReport:
    """Run the study on the cases at hand."""
    rows: list[BudgetRow] = []
    tuned: dict[Case, TunedAt] = {}
    for case in cases():
        plant, noise = plants()[case.path], noises()[case.noise]
        scenes = {seed: make_case(plant, noise(DURATION_S + SWITCH_ON_S, seed), n_taps=N_TAPS) for seed in SEEDS}
        signals: Any = {
            name: [getattr(scene, name)[0] for scene in scenes.values()] for name in ("references", "disturbances")
        }
        joined = replace(scenes[SEEDS[0]], **signals, seeds=list(SEEDS))  # one scene with the noises of all seeds
        tuned[case] = _tune(runs, joined)
        rows += _measure(runs, case, scenes, joined, tuned[case])
    means = mean_rows(rows)
    return parts.report_of_rows(
        rows,
        name="rated-powers",
        title="What a rated power buys",
        summary=(
            "Noise reduction and output power of every algorithm, each at its best setting for each rated power, and of "
            "the power-constrained Wiener solution. If the level varies, `bound` keeps the rated power in each second, and "
            "`bound of the record` over the record. The rated power is in dB over what full control would need."
        ),
        parameters=_parameters(tuned),
        claims=_claims(means),
        figures=[_figure(means, case) for case in tuned],
        notes=_notes(tuned),
        tables=[_table_at(means, SHOWN_DB), _table(means)],
    )


# ---- Runs


def _rated(scene: Scene, share_db: float) -> Scene:
    """Return the scene, whose unconstrained control power is 1, with a rated power."""
    return replace(scene, rated_power=10 ** (share_db / 10))


def _tune(runs: Runs, scene: Scene) -> TunedAt:
    """Return the best settings at each rated power. Runs that do not see the rated power serve for all of them."""
    once = {name: own.grid for name, own in algorithms().items() if not own.sees_budget}
    trials = bench.try_settings(runs, scene, once, len(SEEDS))
    return {
        share_db: bench.tune(runs, _rated(scene, share_db), list(algorithms()), len(SEEDS), trials=trials)
        for share_db in SHARES_DB
    }


def _measure(runs: Runs, case: Case, scenes: Mapping[int, Scene], joined: Scene, tuned: TunedAt) -> list[BudgetRow]:
    """Return rows of every algorithm, the bound and the scaled Wiener solution; those without a budget run once a seed.

    They run in the joined scene, in which they were tuned: its first noise sets the units of the settings.
    """

    def run(seed: int, share_db: float, name: str) -> SimulationResult | None:
        setting = tuned[share_db][name].setting
        return bench.run_setting(_rated(joined, share_db), name, setting, joined.seeds.index(seed))

    def row(seed: int, share_db: float, name: str, result: SimulationResult | None) -> BudgetRow:
        own = case.place | {"share_db": share_db, "seed": seed, "setting": tuned[share_db][name].setting}
        return BudgetRow(**own, algorithm=name, **figures_of(result, 10 ** (share_db / 10)))

    def job(at: tuple[int, float | None]) -> list[BudgetRow]:
        seed, share_db = at
        free = [name for name, own in algorithms().items() if not own.keeps_budget]
        if share_db is None:  # one run of each serves for all rated powers
            results = {name: run(seed, SHARES_DB[0], name) for name in free}
            return [row(seed, share, name, result) for name, result in results.items() for share in SHARES_DB]
        own = [name for name in tuned[share_db] if name not in free]
        bounds = _bounds(case, _rated(scenes[seed], share_db), seed, share_db)
        return bounds + [row(seed, share_db, name, run(seed, share_db, name)) for name in own]

    jobs = [(seed, share_db) for seed in scenes for share_db in (None, *SHARES_DB)]
    return [row for rows in runs.map(job, jobs) for row in rows]


def _bounds(case: Case, scene: Scene, seed: int, share_db: float) -> list[BudgetRow]:
    place = case.place | {"share_db": share_db, "seed": seed, "power": min(1.0 / scene.rated_power, 1.0)}
    bound, scaled = bounds_db(scene, case.stationary)
    record = bound if case.stationary else bounds_db(scene, True)[0]
    return [
        BudgetRow(**place, algorithm=label, noise_reduction_db=reached)
        for label, reached in ((BOUND, bound), (RECORD, record), (SCALED, scaled))
    ]


# ---- Claims and notes


def mean_rows(rows: Sequence[BudgetRow]) -> Means:
    """Return means over seeds by case and algorithm, in the order of the rated power; of windows the worst."""
    means: dict[tuple[Case, str], list[BudgetRow]] = {}
    for (case, name, _), own in grouped(
        sorted(rows, key=lambda row: row.share_db), "case", "algorithm", "share_db"
    ).items():
        mean: dict[str, Any] = {figure: float(column(own, figure).mean()) for figure in ("noise_reduction_db", "power")}
        row = replace(own[0], **mean, worst_window=float(column(own, "worst_window").max()))
        means.setdefault((case, name), []).append(row)
    return means


def _claims(means: Means) -> list[Claim]:
    own = [row for (_, name), rows in means.items() if name == "KF-PB" for row in rows]
    bound = {(row.case, row.share_db): row for (_, name), rows in means.items() if name == BOUND for row in rows}
    losses = {str(row): bound[row.case, row.share_db].noise_reduction_db - row.noise_reduction_db for row in own}
    behind = {str(row): _best_other_db(means, row) - row.noise_reduction_db for row in own}
    text = "Noise reduction of the best other method that keeps the budget less that of KF-PB (dB)"
    return [
        worst_claim(
            "Output power of KF-PB over the rated one, mean over seeds",
            {str(row): row.power for row in own},
            at_most=Tuned.BUDGET,
        ),
        worst_claim("Noise reduction of KF-PB below the bound (dB)", losses, at_most=1.0),
        worst_claim(text, behind, at_most=0.3),
    ]


def _best_other_db(means: Means, row: BudgetRow) -> float:
    """Return the noise reduction of the best other method that kept the budget in the case and at the rated power."""
    others = [
        other.noise_reduction_db
        for name, algorithm in algorithms().items()
        if algorithm.keeps_budget and name != row.algorithm
        for other in means[row.case, name]
        if other.share_db == row.share_db and other.power <= Tuned.BUDGET
    ]
    return max(others, default=-np.inf)


def _notes(tuned: Mapping[Case, TunedAt]) -> list[str]:
    notes = []
    if len(tuned) < len(CASES):
        notes.append("The measured duct was not at hand (KFOPC_DATA): its cases are left out.")
    for name, algorithm in algorithms().items():
        own = [best[name] for shares in tuned.values() for best in shares.values()]
        firsts = [best.setting[0] if isinstance(best.setting, tuple) else best.setting for best in own]
        unfinished = [mu for mu in firsts if algorithm.symbol == "mu" and mu <= min(algorithm.first)]
        if unfinished and algorithm.keeps_budget:
            where = f"{len(unfinished)} of {len(own)} points"
            notes.append(f"{name} has its grid's least step size in {where}: there it keeps its budget unconverged.")
    return notes


# ---- Tables and parameters


def _table_at(means: Means, share_db: float) -> Table:
    """Return a line for each algorithm, a column for each case, at one rated power."""
    found = list(dict.fromkeys(case for case, _ in means))
    lines: list[list[str | float]] = []
    for name in dict.fromkeys(name for _, name in means):
        rows = [next(row for row in means[case, name] if row.share_db == share_db) for case in found]
        lines.append([name, *(f"{row.noise_reduction_db:.1f} dB, {row.power:.2f}" for row in rows)])
    caption = (
        f"Noise reduction, and output power over the rated one, at a rated power of {share_db:g} dB; means over seeds"
    )
    return Table("at-one-rating", caption, ["algorithm", *map(str, found)], lines)


def _table(means: Means) -> Table:
    headings = ["paths", "noise", "algorithm"]
    headings += [f"{share:g} dB" for share in SHARES_DB] + [f"power at {share:g} dB" for share in SHARES_DB]
    return Table(
        "reduction",
        "Noise reduction in dB over the steady half and output power over the rated one, means over seeds",
        headings,
        [
            [case.path, case.noise, name, *column(own, "noise_reduction_db"), *column(own, "power")]
            for (case, name), own in means.items()
        ],
    )


def _parameters(tuned: Mapping[Case, TunedAt]) -> dict[str, Parameter]:
    registry = algorithms()
    settings = {
        # The grids of those that do not see the rated power serve for all of them.
        f"{case}, {share_db:g} dB": parts.tuned_in_words(
            {name: best for name, best in own.items() if registry[name].sees_budget or share_db == SHARES_DB[0]}
        )
        for case, shares in tuned.items()
        for share_db, own in shares.items()
    }
    return parts.case_parameters(Parameter(N_TAPS, "as in the constraint study")) | {
        "duration_s": Parameter(DURATION_S, "from switch-on on; the steady half counts"),
        "rated_power_db": Parameter(list(SHARES_DB), "over the unconstrained control power of each noise"),
        "seeds": Parameter(list(SEEDS), "of noise; of the recording, where it begins; tuned on all of them"),
        "settings": Parameter(settings, f"best and tried; for two settings a finer grid follows; {Tuned.RULE}"),
    }


# ---- Figures


def _figure(means: Means, case: Case) -> FigureItem:
    """Return noise reduction above and output power below against the rated power, a column for each family."""
    of = {name: own for (where, name), own in means.items() if where == case}
    # Of a noise that does not vary, the record has no bound of its own.
    bounds = {BOUND: "-", SCALED: ":"} if case.stationary else {BOUND: "-", RECORD: "--", SCALED: ":"}
    figure, axes = parts.new_figure((12.0, 6.6), 2, len(PANELS), sharex=True, sharey="row")
    for (above, below), (family, names) in zip(axes.T, PANELS.items(), strict=True):
        for label, dashes in bounds.items():
            above.plot(*_line(of[label], "noise_reduction_db"), color="black", linestyle=dashes, label=label)
        for name in names:
            style = curve_style(name) | {"markersize": 4}
            over = [row for row in of[name] if row.power > Tuned.BUDGET]
            for ax, value in ((above, "noise_reduction_db"), (below, "power")):
                ax.plot(*_line(of[name], value), label=name, **style)
                ax.plot(*_line(over, value), **style | {"linestyle": "", "markerfacecolor": "white"})
        above.set_title(family, fontsize="medium")
        # Below, where the powers leave room; above, it would cover curves.
        below.legend(*above.get_legend_handles_labels(), loc="upper right", fontsize="small", frameon=False)
        below.axhline(1.0, color=parts.MARK, linewidth=1)
        below.set_xlabel("Rated power (dB over the unconstrained)")
    free = {name: own[0] for name, own in of.items() if name in algorithms() and not algorithms()[name].keeps_budget}
    unconstrained = max(row.noise_reduction_db for name in ("KF-ANC", "FxLMS") for row in of[name])
    axes[0, 0].set_ylim(0.0, 1.1 * max(unconstrained, of[BOUND][-1].noise_reduction_db))
    axes[1, 0].set(yscale="log", ylim=(0.3, 30.0))
    axes[0, 0].set_ylabel("Noise reduction (dB)")
    axes[1, 0].set_ylabel("Output power / rated power")
    of_which = "" if case.stationary else " of each second, that of the whole record"
    caption = (
        f"{case.noise.capitalize()}, {case.path}: noise reduction (above) and output power (below) against the rated power, "
        f"means over seeds; hollow if the power is above {Tuned.BUDGET:g} of the rated one. Black: the power-constrained "
        f"Wiener solution{of_which} and the scaled one. Without a constraint: "
        + ", ".join(f"{name} {row.noise_reduction_db:.1f} dB" for name, row in free.items())
        + "."
    )
    return FigureItem(f"{case.path} {case.noise}".replace(" ", "-"), caption, figure)


def _line(rows: Sequence[BudgetRow], value: str) -> tuple[np.ndarray, np.ndarray]:
    return column(rows, "share_db"), column(rows, value)
