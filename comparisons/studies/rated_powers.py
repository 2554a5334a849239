"""Study: noise reduction and output power against the rated power, every algorithm and the bound."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult
from kfopc_filterpy.bench import (
    Claim,
    FigureItem,
    Parameter,
    Runs,
    Scene,
    StudyReport,
    Table,
    Tuned,
    algorithms,
    run_setting,
    try_settings,
    tune,
)
from kfopc_filterpy.plot import curve_style

from .cases import (
    FS,
    SWITCH_ON_S,
    Case,
    WindowRow,
    bounds_db,
    figures_of,
    grid_runs,
    make_case,
    noises,
    paths,
    record_bound_db,
)
from .report_parts import MARK, case_parameters, new_figure, tried

SHARES_DB = (-20.0, -15.0, -12.0, -9.0, -6.0, -3.0, 0.0)  # rated power over the unconstrained control power
DURATION_S = 8.0
N_TAPS = 160
SEEDS = (1, 2)  # tuned on all of them
CASES = (
    Case("duct", "band noise"),
    Case("duct", "compressor"),
    Case("measured duct", "compressor"),
    Case("measured duct", "motor"),
)
TARGETS_DB = (3.0, 6.0, 10.0)
BOUND, RECORD, SCALED = "bound", "bound of the record", "scaled Wiener"  # the first, of each second if that varies
PANELS = {
    "Kalman filters": ("KF-OPC", "KF-OPC repaired", "KF-PB", "diagonal KF-OPC"),
    "FxLMS with a price": (
        "leaky FxLMS",
        "optimal leaky FxLMS",
        "MOV-FxLMS fixed",
        "MOV-FxLMS by variance",
        "MOV-FxLMS",
        "MOV-MFxLMS",
    ),
    "FxLMS with an amplitude limit": ("two-gradient FxLMS", "re-scaling FxLMS", "clipping FxLMS"),
}

TunedAt = Mapping[float, Mapping[str, Tuned]]  # by rated power and algorithm


@dataclass(frozen=True, kw_only=True)
class BudgetRow(WindowRow):
    """One run at one rated power."""

    share_db: float
    seed: int


def cases() -> list[Case]:
    """Return the cases whose paths and noise are at hand."""
    pairs, made = paths(), noises()
    return [case for case in CASES if case.path in pairs and case.noise in made]


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
        pair, noise = paths()[case.path], noises()[case.noise]
        scenes = {seed: make_case(pair, noise(DURATION_S + SWITCH_ON_S, seed), n_taps=N_TAPS) for seed in SEEDS}
        joined = _joined(list(scenes.values()))
        tuned[case] = _tune(runs, joined)
        rows += _measure(runs, case, scenes, joined, tuned[case])
    return StudyReport(
        name="rated-powers",
        title="What a rated power buys",
        summary=(
            "Noise reduction and output power of every algorithm, each at its best setting for each rated power, and of "
            "the power-constrained Wiener solution, which no fixed filter of that length can pass within the rated power. "
            "If the level varies, `bound` keeps the rated power in each second, and `bound of the record` over the record. "
            "The rated power is in dB over what the unconstrained control filter of the noise would need."
        ),
        fs=FS,
        rated_power=1.0,
        parameters=_parameters(tuned),
        algorithms={},
        extra={"rows": [asdict(row) for row in rows]},
        claims=_claims(rows),
        figures=budget_figures(rows),
        notes=_notes(rows, tuned),
        tables=[_budget_table(rows), _sizing_table(rows), _tuning_table(tuned)],
        claims_heading="Aims",
    )


# ---- Runs


def _rated(scene: Scene, share_db: float) -> Scene:
    """Return the scene, whose unconstrained control power is 1, with a rated power."""
    return replace(scene, rated_power=10 ** (share_db / 10))


def _joined(scenes: Sequence[Scene]) -> Scene:
    """Return one scene with the noises of several."""
    return replace(
        scenes[0],
        references=[scene.references[0] for scene in scenes],
        disturbances=[scene.disturbances[0] for scene in scenes],
        seeds=list(SEEDS),
    )


def _tune(runs: Runs, scene: Scene) -> TunedAt:
    """Return the best settings at each rated power. Runs that do not see the rated power serve for all of them."""
    once = {name: own.grid for name, own in algorithms().items() if not own.sees_budget}
    seeds = len(scene.references)
    trials = try_settings(runs, scene, once, seeds)
    tuned = {}
    for share_db in SHARES_DB:
        rated = _rated(scene, share_db)
        tuned[share_db] = tune(runs, rated, list(algorithms()), seeds, trials=trials)
    return tuned


def _measure(runs: Runs, case: Case, scenes: Mapping[int, Scene], joined: Scene, tuned: TunedAt) -> list[BudgetRow]:
    """Return rows of every algorithm, the bound and the scaled Wiener solution; those without a budget run once a seed.

    They run in the joined scene, in which they were tuned: its first noise sets the units of the settings.
    """
    free = [name for name, own in algorithms().items() if not own.keeps_budget]

    def job(at: tuple[int, float | None]) -> list[BudgetRow]:
        seed, share_db = at
        if share_db is None:
            return _free_rows(case, joined, seed, {name: tuned[SHARES_DB[0]][name] for name in free})
        rated = _rated(joined, share_db)
        own = {name: best for name, best in tuned[share_db].items() if name not in free}
        return _bounds(case, _rated(scenes[seed], share_db), seed, share_db) + [
            _row(case, share_db, seed, (name, best), run_setting(rated, name, best.setting, joined.seeds.index(seed)))
            for name, best in own.items()
        ]

    jobs = [(seed, share_db) for seed in scenes for share_db in (None, *SHARES_DB)]
    return [row for rows in runs.map(job, jobs) for row in rows]


def _row(
    case: Case, share_db: float, seed: int, tuned: tuple[str, Tuned], result: SimulationResult | None
) -> BudgetRow:
    name, best = tuned
    place: dict[str, Any] = {"path": case.path, "noise": case.noise, "share_db": share_db, "seed": seed}
    figures = figures_of(result, 10 ** (share_db / 10))
    return BudgetRow(**place, algorithm=name, setting=best.setting, **figures)


def _free_rows(case: Case, scene: Scene, seed: int, tuned: Mapping[str, Tuned]) -> list[BudgetRow]:
    """Return rows of the algorithms without a constraint: one run each, against every rated power."""
    rows = []
    for name, best in tuned.items():
        result = run_setting(scene, name, best.setting, scene.seeds.index(seed))
        rows += [_row(case, share_db, seed, (name, best), result) for share_db in SHARES_DB]
    return rows


def _bounds(case: Case, scene: Scene, seed: int, share_db: float) -> list[BudgetRow]:
    place: dict[str, Any] = {"path": case.path, "noise": case.noise, "share_db": share_db, "seed": seed}
    power = min(1.0 / scene.rated_power, 1.0)
    bound, scaled = bounds_db(scene, case.stationary)
    record = bound if case.stationary else record_bound_db(scene)
    return [
        BudgetRow(**place, algorithm=label, noise_reduction_db=reached, power=power)
        for label, reached in ((BOUND, bound), (RECORD, record), (SCALED, scaled))
    ]


# ---- Claims and notes


def mean_rows(rows: Sequence[BudgetRow]) -> dict[tuple[Case, str], list[BudgetRow]]:
    """Return means over seeds by case and algorithm, in the order of the rated power; of windows the worst."""
    groups: dict[tuple[Case, str], dict[float, list[BudgetRow]]] = {}
    for row in rows:
        groups.setdefault((row.case, row.algorithm), {}).setdefault(row.share_db, []).append(row)
    return {
        key: [
            replace(
                own[share][0],
                noise_reduction_db=float(np.mean([row.noise_reduction_db for row in own[share]])),
                power=float(np.mean([row.power for row in own[share]])),
                worst_window=float(np.max([row.worst_window for row in own[share]])),
            )
            for share in sorted(own)
        ]
        for key, own in groups.items()
    }


def _claims(rows: Sequence[BudgetRow]) -> list[Claim]:
    means = mean_rows(rows)
    bound = {(row.case, row.share_db): row.noise_reduction_db for row in _all_of(means, BOUND)}
    kept = _all_of(means, "KF-PB")
    losses = [bound[row.case, row.share_db] - row.noise_reduction_db for row in kept]
    powers = [row.power for row in kept]
    ahead = []
    for row in kept:
        others = [
            other.noise_reduction_db
            for name, algorithm in algorithms().items()
            if algorithm.keeps_budget and name != "KF-PB"
            for other in means[row.case, name]
            if other.share_db == row.share_db and other.power <= Tuned.BUDGET
        ]
        ahead.append(row.noise_reduction_db - max(others, default=-np.inf))
    return [
        Claim(
            "KF-PB keeps the rated power to 2 %, mean over seeds, at every rated power and in every case",
            bool(np.max(powers) <= Tuned.BUDGET),
            f"{np.min(powers):.3f} to {np.max(powers):.3f} of it",
        ),
        Claim(
            "KF-PB reaches the bound to within 1 dB at every rated power and in every case",
            bool(np.max(losses) <= 1.0),
            f"{np.mean(losses):.2f} dB below it on average, {np.max(losses):.2f} dB at worst ({_where(kept[int(np.argmax(losses))])})",
        ),
        Claim(
            "No other method that keeps the budget reduces the noise by more than 0.3 dB more than KF-PB",
            bool(np.min(ahead) >= -0.3),
            f"KF-PB is {np.mean(ahead):+.2f} dB ahead of the best other on average, {np.min(ahead):+.2f} dB at worst "
            f"({_where(kept[int(np.argmin(ahead))])}), {np.max(ahead):+.2f} dB at best; {sum(np.array(ahead) > 0)} of {len(ahead)} ahead",
        ),
    ]


def _where(row: BudgetRow) -> str:
    return f"{row.case}, {row.share_db:g} dB"


def _all_of(means: Mapping[tuple[Case, str], list[BudgetRow]], name: str) -> list[BudgetRow]:
    return [row for (_, own), rows in means.items() if own == name for row in rows]


def _notes(rows: Sequence[BudgetRow], tuned: Mapping[Case, TunedAt]) -> list[str]:
    notes = []
    if len(tuned) < len(CASES):
        notes.append("The measured duct was not at hand (KFOPC_DATA): its cases are left out.")
    means = mean_rows(rows)
    for name, algorithm in algorithms().items():
        own = _all_of(means, name)
        over = [row.power for row in own if row.power > Tuned.BUDGET]
        if algorithm.keeps_budget and over:
            notes.append(
                f"{name} is above {Tuned.BUDGET:g} of its rated power in {len(over)} of {len(own)} points, up to {max(over):.2f} of it."
            )
        unfinished = [
            share for shares in tuned.values() for share, best in shares.items() if _slowest(name, best[name])
        ]
        if unfinished and algorithm.keeps_budget:
            notes.append(
                f"{name} has the least step size of its grid in {len(unfinished)} of {len(own)} points: there it keeps its budget "
                "by not having converged, no step size at which it has keeps it."
            )
        diverged = sum(np.isnan(row.power) for row in own)
        if diverged:
            notes.append(f"{name} diverged in {diverged} of {len(own)} points.")
    return notes


def _slowest(name: str, best: Tuned) -> bool:
    """Return whether the least step size that was tried is the best."""
    setting = best.setting[0] if isinstance(best.setting, tuple) else best.setting
    return algorithms()[name].symbol == "mu" and setting <= min(algorithms()[name].first)


# ---- Tables and parameters


def _budget_table(rows: Sequence[BudgetRow]) -> Table:
    """Return noise reduction and power at each rated power, a line for each case and algorithm."""
    headings = ["paths", "noise", "algorithm"]
    headings += [f"{share:g} dB" for share in SHARES_DB] + [f"power at {share:g} dB" for share in SHARES_DB]
    return Table(
        "reduction",
        "Noise reduction in dB over the steady half and output power over the rated one, means over seeds, at each rated "
        "power in dB over the unconstrained one",
        headings,
        [
            [case.path, case.noise, name, *(row.noise_reduction_db for row in own), *(row.power for row in own)]
            for (case, name), own in mean_rows(rows).items()
        ],
    )


def _sizing_table(rows: Sequence[BudgetRow]) -> Table:
    """Return the rated power that a noise reduction needs, which is what an engineer asks."""
    lines: list[list[str | float]] = []
    for (case, name), own in mean_rows(rows).items():
        if name in algorithms() and not algorithms()[name].keeps_budget:
            continue
        lines.append([case.path, case.noise, name, *(_needed(own, target) for target in TARGETS_DB)])
    return Table(
        "sizing",
        "Rated power, in dB over the unconstrained one, at which each reaches a noise reduction, between the rated powers "
        f"of the study by straight lines; only if the mean output power is at most {Tuned.BUDGET:g} of the rated one",
        ["paths", "noise", "algorithm", *(f"{target:g} dB" for target in TARGETS_DB)],
        lines,
    )


def _needed(rows: Sequence[BudgetRow], target_db: float) -> float | str:
    """Return the least rated power for a noise reduction: below the study's least, between two of them, or none."""
    kept = [row.power <= Tuned.BUDGET and np.isfinite(row.noise_reduction_db) for row in rows]
    if kept[0] and rows[0].noise_reduction_db >= target_db:
        return f"below {rows[0].share_db:g}"
    for (lower, upper), both in zip(pairwise(rows), pairwise(kept), strict=True):
        if all(both) and lower.noise_reduction_db < target_db <= upper.noise_reduction_db:
            part = (target_db - lower.noise_reduction_db) / (upper.noise_reduction_db - lower.noise_reduction_db)
            return lower.share_db + part * (upper.share_db - lower.share_db)
    return "not reached"


def _tuning_table(tuned: Mapping[Case, TunedAt]) -> Table:
    lines: list[list[str | float]] = []
    for case, share_db, name, best in _searches(tuned):
        first, second = best.setting if isinstance(best.setting, tuple) else (best.setting, np.nan)
        kept, edge = ("yes" if said else "no" for said in (best.within_budget, best.at_edge))
        diverged = sum(trial.diverged for trial in best.trials)
        lines.append([case.path, case.noise, share_db, name, first, second, kept, edge, len(best.trials), diverged])
    headings = ["paths", "noise", "rated dB", "algorithm", "setting", "second", "kept the budget", "at an edge"]
    caption = "The setting of each algorithm at each rated power, tuned on all seeds"
    return Table("tuning", caption, [*headings, "tried", "diverged"], lines)


def _searches(tuned: Mapping[Case, TunedAt]) -> list[tuple[Case, float, str, Tuned]]:
    """Return the winner of each search with its case, rated power and algorithm."""
    return [
        (case, share_db, name, best)
        for case, shares in tuned.items()
        for share_db, own in shares.items()
        for name, best in own.items()
    ]


def _parameters(tuned: Mapping[Case, TunedAt]) -> dict[str, Parameter]:
    registry = algorithms()
    trials = {
        f"{case}, {share_db:g} dB, {name}": tried(best.trials, digits=5)
        for case, share_db, name, best in _searches(tuned)
        if registry[name].sees_budget or share_db == SHARES_DB[0]  # the others' grids serve for all rated powers
    }
    return case_parameters(Parameter(N_TAPS, "as in the constraint study")) | {
        "duration_s": Parameter(DURATION_S, "from switch-on on; the steady half counts"),
        "rated_power_db": Parameter(list(SHARES_DB), "over the unconstrained control power of each noise"),
        "seeds": Parameter(list(SEEDS), "of noise; of the recording, where it begins; tuned on all of them"),
        "settings": Parameter(
            {name: [own.kind, own.second_kind] for name, own in registry.items()}, "what the settings of each are"
        ),
        "grids": Parameter(
            {name: [list(own.first), list(own.second)] for name, own in registry.items()},
            "for two settings a finer grid follows around the best",
        ),
        "trials": Parameter(trials, f"setting, mean NSE in dB, output power; {Tuned.RULE}"),
    }


# ---- Figures


def budget_figures(rows: Sequence[BudgetRow]) -> list[FigureItem]:
    """Return a figure for each case: noise reduction above, output power below, a column for each family."""
    return [_case(rows, case) for case in dict.fromkeys(row.case for row in rows)]


def _case(rows: Sequence[BudgetRow], case: Case) -> FigureItem:
    means = {name: own for (where, name), own in mean_rows(rows).items() if where == case}
    figure, axes = new_figure((12.0, 6.6), 2, len(PANELS), sharex=True, sharey="row")
    for column, (family, names) in enumerate(PANELS.items()):
        above, below = axes[:, column]
        for label, dashes in _bound_lines(case):
            above.plot(*_line(means[label], "noise_reduction_db"), color="black", linestyle=dashes, label=label)
        for name in names:
            style = curve_style(name) | {"markersize": 4}
            over = [row.share_db for row in means[name] if row.power > Tuned.BUDGET]
            for ax, value in ((above, "noise_reduction_db"), (below, "power")):
                shares, values = _line(means[name], value)
                ax.plot(shares, values, label=name, **style)
                hollow = np.isin(shares, over)
                ax.plot(shares[hollow], values[hollow], **style | {"linestyle": "", "markerfacecolor": "white"})
        above.set_title(family, fontsize="medium")
        # Below, where the powers leave room; above, it would cover curves.
        below.legend(*above.get_legend_handles_labels(), loc="upper right", fontsize="small", frameon=False)
        below.axhline(1.0, color=MARK, linewidth=1)
        below.set_xlabel("Rated power (dB over the unconstrained)")
        for ax in (above, below):
            ax.grid(True, alpha=0.3)
    unconstrained = max(row.noise_reduction_db for name in ("KF-ANC", "FxLMS") for row in means[name])
    axes[0, 0].set_ylim(0.0, 1.1 * max(unconstrained, means[BOUND][-1].noise_reduction_db))
    axes[1, 0].set_yscale("log")
    axes[1, 0].set_ylim(0.3, 30.0)
    axes[0, 0].set_ylabel("Noise reduction (dB)")
    axes[1, 0].set_ylabel("Output power / rated power")
    free = ", ".join(
        f"{name} {own[0].noise_reduction_db:.1f} dB"
        for name, own in means.items()
        if name in algorithms() and not algorithms()[name].keeps_budget
    )
    of_which = "" if case.stationary else " of each second, that of the whole record"
    caption = (
        f"{case.noise.capitalize()}, {case.path}: noise reduction (above) and output power (below) against the rated power, "
        f"means over seeds; hollow if the power is above {Tuned.BUDGET:g} of the rated one. Black: the power-constrained Wiener solution{of_which} and the scaled one. Without a constraint: {free}."
    )
    return FigureItem(f"{case.path} {case.noise}".replace(" ", "-"), caption, figure)


def _bound_lines(case: Case) -> list[tuple[str, str]]:
    """Return the bounds to draw and their dashes; of a noise that does not vary, the record has no bound of its own."""
    return [(BOUND, "-"), *([] if case.stationary else [(RECORD, "--")]), (SCALED, ":")]


def _line(rows: Sequence[BudgetRow], value: str) -> tuple[np.ndarray, np.ndarray]:
    return np.array([row.share_db for row in rows]), np.array([getattr(row, value) for row in rows])
