"""The rule that tunes every algorithm: the lowest mean NSE over the whole run among settings that keep the budget."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from kfopc_filterpy import KalmanController, SimulationResult, nse_db, output_power

from .registry import ALGORITHMS, KALMAN, REGISTRY, Setting, grid, make_controller
from .scene import Outcome, Runs, Scene

BUDGET = 1.02  # a constrained method keeps its budget with up to this share of the rated power
RULE = (
    "lowest mean NSE over the whole run, start included, among settings that do not diverge and, for constrained "
    f"methods, keep the budget to {100 * (BUDGET - 1):.0f} % over the steady half; a tie to 0.01 dB goes to the smaller"
)

Job = tuple[str, Setting, int]


def unless_refused(algorithm: str, run: Callable[[], SimulationResult]) -> SimulationResult | None:
    """Result of a run; None where the filter finds in its midst that it cannot go on, for the algorithms that may."""
    try:
        return run()
    except ValueError as error:
        in_its_midst = any(note.startswith("in sample") for note in getattr(error, "__notes__", ()))
        if not (REGISTRY[algorithm].may_refuse and in_its_midst):
            raise
        return None


def run_setting(scene: Scene, algorithm: str, setting: Setting, seed_index: int = 0) -> SimulationResult | None:
    """Run of an algorithm in a scene, see `unless_refused`."""
    controller = make_controller(scene, algorithm, setting)
    return unless_refused(algorithm, lambda: scene.run(controller, seed_index))


def went_through(result: SimulationResult | None) -> SimulationResult:
    """The result of a run of an algorithm that never refuses."""
    assert result is not None
    return result


def run_settings(
    runs: Runs,
    scene: Scene,
    jobs: Sequence[Job],
    measure: Callable[[SimulationResult | None], Outcome],
    planned: bool = True,
) -> list[Outcome]:
    """What `measure` makes of a run of each (algorithm, setting, index of the seed), see `run_setting`.

    Kalman filters of one setting on one noise differ in the constraint only: they share their gains. `planned` is
    whether they are among the runs that the progress bar counts.
    """
    groups: dict[tuple[object, ...], list[Job]] = {}
    for job in jobs:
        groups.setdefault(("Kalman", *job[1:]) if job[0] in KALMAN else job, []).append(job)

    def run(group: list[Job]) -> list[Outcome]:
        if len(group) == 1:
            return [measure(run_setting(scene, *group[0]))]
        controllers = [make_controller(scene, name, setting) for name, setting, _ in group]
        kalman = [c for c in controllers if isinstance(c, KalmanController)]
        return [measure(result) for result in scene.run_together(kalman, group[0][2])]

    outcomes = runs.map(run, groups.values(), worth=len if planned else lambda group: 0)
    by_job = {
        job: o for group, own in zip(groups.values(), outcomes, strict=True) for job, o in zip(group, own, strict=True)
    }
    return [by_job[job] for job in jobs]


def tuning_runs(algorithms: Sequence[str] = ALGORITHMS, seeds: int = 1) -> int:
    """Runs that `tune` takes; those around the best of a grid of two settings are not counted, being as many as chance
    has it.
    """
    return seeds * sum(len(grid(name)) for name in algorithms)


@dataclass(frozen=True)
class Trial:
    """One setting of one algorithm: mean NSE over the whole run in dB, output power over the steady half."""

    setting: Setting
    mean_nse_db: float
    output_power: float
    diverged: bool


@dataclass(frozen=True)
class Tuned:
    """The best setting of an algorithm, and all that were tried."""

    setting: Setting
    within_budget: bool
    at_edge: bool
    trials: list[Trial]


def tune(runs: Runs, scene: Scene, algorithms: Sequence[str] = ALGORITHMS, seeds: int = 1) -> dict[str, Tuned]:
    """Best setting of each algorithm, one rule for all.

    The lowest mean NSE over the whole run, start included, among settings that do not diverge and, for constrained
    methods, keep the budget to 2 % over the steady half. Where no setting keeps it, the lowest mean NSE, and
    `within_budget` is False. Mean NSEs that agree to 0.01 dB are a tie, which goes to the smaller setting.
    """
    trials = try_settings(runs, scene, {name: grid(name) for name in algorithms}, seeds)
    return {name: refine(runs, scene, name, trials[name], seeds) for name in algorithms}


def try_settings(
    runs: Runs, scene: Scene, settings: dict[str, list[Setting]], seeds: int = 1, planned: bool = True
) -> dict[str, list[Trial]]:
    """A trial of each setting of each algorithm, means over seeds."""
    jobs = [(name, setting, k) for name, own in settings.items() for setting in own for k in range(seeds)]

    def trial(result: SimulationResult | None) -> tuple[float, float, bool]:
        if result is None or result.diverged_at_s is not None:
            return np.inf, np.inf, True
        nse = nse_db(result.error, result.disturbance, scene.fs, scene.nse_window_s)
        return float(np.mean(nse)), output_power(result.control_signal), False

    outcomes = dict(zip(jobs, run_settings(runs, scene, jobs, trial, planned), strict=True))
    trials: dict[str, list[Trial]] = {name: [] for name in settings}
    for name, own in settings.items():
        for setting in own:
            rows = [outcomes[name, setting, k] for k in range(seeds)]
            means = np.mean([row[:2] for row in rows], axis=0)
            trials[name].append(Trial(setting, float(means[0]), float(means[1]), any(row[2] for row in rows)))
    return trials


def refine(runs: Runs, scene: Scene, algorithm: str, trials: list[Trial], seeds: int = 1) -> Tuned:
    """The best of a grid, or of the finer one around it where the algorithm has two settings."""
    rated_power = scene.rated_power if REGISTRY[algorithm].keeps_budget else np.inf
    best = _best(trials, rated_power, algorithm)
    finer = REGISTRY[algorithm].finer(best.setting)
    if not finer:
        return best
    own = try_settings(runs, scene, {algorithm: finer}, seeds, planned=False)[algorithm]
    return _best([*trials, *own], rated_power, algorithm)


class AllDivergedError(RuntimeError):
    """No setting that was tried is stable."""


def _best(trials: list[Trial], rated_power: float, name: str) -> Tuned:
    stable = [t for t in trials if not t.diverged]
    if not stable:
        raise AllDivergedError(f"{name} diverged at every setting tried: {[t.setting for t in trials]}")
    kept = [t for t in stable if t.output_power <= BUDGET * rated_power]
    best = min(kept or stable, key=lambda t: (round(t.mean_nse_db, 2), t.setting))  # a tie: the smaller setting
    return Tuned(best.setting, bool(kept), _at_edge(best.setting, trials), trials)


def _at_edge(setting: Setting, trials: list[Trial]) -> bool:
    """Whether the setting, or one of its two, is the least or the largest that was tried."""
    tried = np.array([np.atleast_1d(t.setting) for t in trials])
    own = np.atleast_1d(setting)
    return bool(np.any((own == tried.min(axis=0)) | (own == tried.max(axis=0))))
