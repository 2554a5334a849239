"""The rule that tunes every algorithm: the lowest mean NSE over the whole run among settings that keep the budget."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from kfopc_filterpy import SimulationResult
from kfopc_filterpy.controllers import Controller
from kfopc_filterpy.verdict.runs import AllDivergedError

from .registry import REGISTRY, Setting, make_controller
from .scene import Outcome, Runs, Scene

BUDGET = 1.02  # a constrained method keeps its budget if its power is at most this multiple of the rated power
RULE = (
    "lowest mean NSE over the whole run, start included, among settings that do not diverge and, for constrained "
    f"methods, keep the budget to {100 * (BUDGET - 1):.0f} % over the steady half; a tie to 0.01 dB goes to the smaller"
)

Job = tuple[str, Setting, int]  # algorithm, setting, index of the seed


@dataclass(frozen=True)
class Trial:
    """One setting of one algorithm, means over the seeds.

    Parameters
    ----------
    setting : float or tuple of float
        The setting.
    mean_nse_db : float
        Mean normalised squared error over the whole run in dB; Inf if it diverged.
    output_power : float or ndarray, shape (J,)
        Output power over the steady half, of each loudspeaker if there are several; Inf if it diverged.
    diverged_at_s : float, optional
        First time in seconds at which a run diverged; 0 if the filter refused to continue.
    noise_reduction_db : float
        Noise reduction over the steady half in dB; NaN if it diverged.
    """

    setting: Setting
    mean_nse_db: float
    output_power: Any
    diverged_at_s: float | None = None
    noise_reduction_db: float = np.nan

    @property
    def diverged(self) -> bool:
        """Whether a run diverged."""
        return self.diverged_at_s is not None


@dataclass(frozen=True)
class Tuned:
    """The best setting of an algorithm, and all that were tried.

    ``Tuned.RULE`` states the rule in words; ``Tuned.BUDGET`` is the multiple of the rated power up to which a
    constrained method keeps its budget.

    Parameters
    ----------
    setting : float or tuple of float
        The best setting.
    within_budget : bool
        Whether any setting kept the budget.
    at_edge : bool
        Whether the best setting, or one of its two values, is the smallest or the largest that was tried.
    trials : list of Trial
        Everything that was tried.
    """

    BUDGET: ClassVar[float] = BUDGET
    RULE: ClassVar[str] = RULE

    setting: Setting
    within_budget: bool
    at_edge: bool
    trials: list[Trial]


def run_setting(
    scene: Scene, algorithm: str, setting: Setting, seed_index: int = 0, *, controller: Controller | None = None
) -> SimulationResult | None:
    """Run an algorithm in a scene.

    Parameters
    ----------
    scene : Scene
        The scene.
    algorithm : str
        Name in the registry, see `algorithms`.
    setting : float or tuple of float
        A setting from its grid, or one of the same kind.
    seed_index : int, default 0
        Index of the scene's seed.
    controller : Controller, optional
        Controller of this algorithm to run; by default a fresh one for the scene and the setting.

    Returns
    -------
    SimulationResult or None
        The result; None if the filter could not continue, see `may_refuse` of `Algorithm`.

    Examples
    --------
    >>> from comparisons.bench import make_scene, run_setting
    >>> from kfopc_filterpy import Plant
    >>> from kfopc_filterpy.signals import tone
    >>> plant = Plant([0, 1.0], [0, 0, 1.0], fs=8000)
    >>> scene = make_scene({0: tone(400.0, 1.0, fs=8000)}, plant, rated_power=1.0, power_multiple=2.0, n_taps=8)
    >>> run_setting(scene, "KF-OPC", 1e-6).algorithm
    'KF-OPC'
    """
    controller = make_controller(scene, algorithm, setting) if controller is None else controller
    try:
        return scene.run(controller, seed_index)
    except ValueError as error:
        during_the_run = any(note.startswith("in sample") for note in getattr(error, "__notes__", ()))
        if not (REGISTRY[algorithm].may_refuse and during_the_run):
            raise
        return None


def run_settings(
    runs: Runs,
    scene: Scene,
    jobs: Sequence[Job],
    measure: Callable[[SimulationResult | None], Outcome],
    planned: bool = True,
) -> list[Outcome]:
    """Return the result of `measure` for each run.

    With one channel, runs of algorithms that share gains are made together if their setting and noise are the same.

    Parameters
    ----------
    runs : Runs
        Runs the jobs.
    scene : Scene
        The scene.
    jobs : sequence of tuple
        Algorithm, setting and index of the seed of each run.
    measure : callable
        Function of a run's result, which is None if the filter could not continue.
    planned : bool, default True
        Whether the runs are among those that the progress bar counts.

    Returns
    -------
    list
        Outcomes in the order of the jobs.

    Examples
    --------
    >>> from comparisons.bench import Runs, make_scene, run_settings
    >>> from kfopc_filterpy import Plant
    >>> from kfopc_filterpy.signals import tone
    >>> plant = Plant([0, 1.0], [0, 0, 1.0], fs=8000)
    >>> scene = make_scene({0: tone(400.0, 1.0, fs=8000)}, plant, rated_power=1.0, power_multiple=2.0, n_taps=8)
    >>> run_settings(Runs(), scene, [("KF-ANC", 1e-6, 0), ("KF-OPC", 1e-6, 0)], lambda result: result.algorithm)
    ['KF-ANC', 'KF-OPC']
    """
    groups: dict[tuple[object, ...], list[Job]] = {}
    for job in jobs:
        together = REGISTRY[job[0]].shares_gains and scene.secondary.ndim == 1
        groups.setdefault(("together", *job[1:]) if together else job, []).append(job)

    def run(group: list[Job]) -> list[Outcome]:
        if len(group) == 1:
            return [measure(run_setting(scene, *group[0]))]
        controllers = [make_controller(scene, name, setting) for name, setting, _ in group]
        return [measure(result) for result in scene.run_together(controllers, group[0][2])]

    outcomes = runs.map(run, groups.values(), worth=len if planned else lambda group: 0)
    by_job = {
        job: o for group, own in zip(groups.values(), outcomes, strict=True) for job, o in zip(group, own, strict=True)
    }
    return [by_job[job] for job in jobs]


def try_settings(
    runs: Runs, scene: Scene, settings: Mapping[str, Sequence[Setting]], seeds: int = 1, planned: bool = True
) -> dict[str, list[Trial]]:
    """Return a trial of each setting of each algorithm.

    Parameters
    ----------
    runs : Runs
        Runs the jobs.
    scene : Scene
        The scene.
    settings : mapping of str to sequence
        Settings by the algorithm's name.
    seeds : int, default 1
        Number of the scene's seeds that are run, from the first one.
    planned : bool, default True
        Whether the runs are among those that the progress bar counts.

    Returns
    -------
    dict of str to list of Trial
        Trials by the algorithm's name, in the order of the settings.

    Examples
    --------
    >>> from comparisons.bench import Runs, make_scene, try_settings
    >>> from kfopc_filterpy import Plant
    >>> from kfopc_filterpy.signals import tone
    >>> plant = Plant([0, 1.0], [0, 0, 1.0], fs=8000)
    >>> scene = make_scene({0: tone(400.0, 1.0, fs=8000)}, plant, rated_power=1.0, power_multiple=2.0, n_taps=8)
    >>> trials = try_settings(Runs(), scene, {"FxLMS": [0.01, 0.1, 50.0]})["FxLMS"]
    >>> [trial.diverged for trial in trials]
    [False, False, True]
    """
    jobs = [(name, setting, k) for name, own in settings.items() for setting in own for k in range(seeds)]

    def measured(result: SimulationResult | None) -> Trial:
        if result is None or result.diverged_at_s is not None:
            return Trial(np.nan, np.inf, np.inf, 0.0 if result is None else result.diverged_at_s)
        # There is no NSE until the first sound has passed the primary path.
        nse = np.nanmean(result.nse_db(scene.nse_window_s))
        return Trial(np.nan, float(nse), result.output_power, None, result.noise_reduction_db)

    outcomes = dict(zip(jobs, run_settings(runs, scene, jobs, measured, planned), strict=True))
    return {
        name: [_mean(setting, [outcomes[name, setting, k] for k in range(seeds)]) for setting in own]
        for name, own in settings.items()
    }


def _mean(setting: Setting, trials: Sequence[Trial]) -> Trial:
    times = [trial.diverged_at_s for trial in trials if trial.diverged_at_s is not None]
    if times:
        return Trial(setting, np.inf, np.inf, min(times))
    nse, reduction = np.mean([(trial.mean_nse_db, trial.noise_reduction_db) for trial in trials], axis=0)
    power = np.mean([trial.output_power for trial in trials], axis=0)
    return Trial(setting, float(nse), power if np.ndim(power) else float(power), None, float(reduction))


def best_setting(scene: Scene, algorithm: str, trials: Sequence[Trial]) -> Tuned | None:
    """Return the best of some trials by the rule of all studies, see `tune`.

    Parameters
    ----------
    scene : Scene
        Scene that gives the rated power.
    algorithm : str
        Name in the registry, see `algorithms`.
    trials : sequence of Trial
        The trials to choose from.

    Returns
    -------
    Tuned or None
        The best setting; None if every setting diverged.

    Examples
    --------
    >>> from comparisons.bench import Trial, best_setting, make_scene
    >>> from kfopc_filterpy import Plant
    >>> from kfopc_filterpy.signals import tone
    >>> plant = Plant([0, 1.0], [0, 0, 1.0], fs=8000)
    >>> scene = make_scene({0: tone(400.0, 1.0, fs=8000)}, plant, rated_power=1.0, power_multiple=2.0, n_taps=8)
    >>> trials = [Trial(1e-6, -20.0, 1.5), Trial(1e-7, -15.0, 1.0)]
    >>> best_setting(scene, "KF-OPC", trials).setting, best_setting(scene, "KF-ANC", trials).setting
    (1e-07, 1e-06)
    """
    stable = [trial for trial in trials if not trial.diverged]
    if not stable:
        return None
    most = BUDGET * scene.rated_power if REGISTRY[algorithm].keeps_budget else np.inf
    kept = [trial for trial in stable if np.all(trial.output_power <= most)]
    best = min(kept or stable, key=lambda trial: (round(trial.mean_nse_db, 2), trial.setting))
    tried = np.array([np.atleast_1d(trial.setting) for trial in trials])
    least, largest = tried.min(axis=0), tried.max(axis=0)
    at_edge = ((best.setting == least) | (best.setting == largest)) & (least < largest)
    return Tuned(best.setting, bool(kept), bool(np.any(at_edge)), list(trials))


def tune(
    runs: Runs,
    scene: Scene,
    names: Sequence[str] | None = None,
    seeds: int = 1,
    *,
    trials: Mapping[str, Sequence[Trial]] | None = None,
) -> dict[str, Tuned]:
    """Return the best setting of each algorithm, by one rule for all.

    The best setting has the lowest mean NSE over the whole run, start included, among settings that do not diverge and,
    for constrained methods, keep the budget of each loudspeaker to within 2 % over the steady half. If no setting keeps
    it, the lowest mean NSE wins, and `within_budget` is False. If an algorithm has two settings, a finer grid is tried
    around the best pair. Mean NSEs that agree to 0.01 dB are a tie, which goes to the smaller setting.

    Parameters
    ----------
    runs : Runs
        Runs the jobs.
    scene : Scene
        The scene.
    names : sequence of str, optional
        Algorithms, see `algorithms`; by default those that the paper compares.
    seeds : int, default 1
        Number of the scene's seeds that are run, from the first one.
    trials : mapping of str to sequence of Trial, optional
        Trials of the grids by algorithm, if they have been made before.

    Returns
    -------
    dict of str to Tuned
        Best settings by the algorithm's name.

    Raises
    ------
    AllDivergedError
        An algorithm diverged at every setting of its grid.

    Examples
    --------
    >>> from comparisons.bench import Runs, make_scene, tune
    >>> from kfopc_filterpy import Plant
    >>> from kfopc_filterpy.signals import tone
    >>> plant = Plant([0, 1.0], [0, 0, 1.0], fs=8000)
    >>> scene = make_scene({0: tone(400.0, 1.0, fs=8000)}, plant, rated_power=1.0, power_multiple=2.0, n_taps=8)
    >>> best = tune(Runs(), scene, ["KF-PB"])["KF-PB"]
    >>> best.within_budget, len(best.trials)
    (True, 1)
    """
    if names is None:
        names = [name for name, algorithm in REGISTRY.items() if algorithm.of_paper]
    made = dict(trials or {})
    made |= try_settings(runs, scene, {name: REGISTRY[name].grid for name in names if name not in made}, seeds)
    tuned = {}
    for name in names:
        best = best_setting(scene, name, made[name])
        if best is None:
            raise AllDivergedError(f"{name} diverged at every setting tried: {[trial.setting for trial in made[name]]}")
        if finer := REGISTRY[name].finer(best.setting):
            near = try_settings(runs, scene, {name: finer}, seeds, planned=False)[name]
            best = best_setting(scene, name, [*made[name], *near]) or best
        tuned[name] = best
    return tuned
