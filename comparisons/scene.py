"""What every study shares: a scene to run controllers in, the four algorithms, and the rule that tunes them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from kfopc_filterpy import (
    FxLMS,
    KalmanController,
    MOVFxLMS,
    SimulationResult,
    clipped_fraction,
    convergence_time_s,
    kf_anc,
    kf_opc,
    kf_opc_repaired,
    kf_pb,
    measurement_noise_from_run,
    noise_reduction_db,
    nse_db,
    output_power,
    path_taps,
    peak_control_signal,
    scaled_to_power,
    simulate,
    simulate_scenarios,
    wiener_solution,
)
from kfopc_filterpy.amplifiers import Amplifier
from kfopc_filterpy.controllers.base import FilteredReferenceController

ALGORITHMS = ("KF-ANC", "KF-OPC", "FxLMS", "MOV-FxLMS")
KALMAN = ("KF-ANC", "KF-OPC")
BUDGETED = ("KF-OPC repaired", "KF-PB")  # Kalman filters whose runs share no gains
CONSTRAINED = ("KF-OPC", "MOV-FxLMS", *BUDGETED)
BUDGET = 1.02  # a constrained method keeps its budget with up to this share of the rated power
# r E[x'^2] / q: the filter forgets over about its inverse square root in samples, 0.6 s to 6 ms at 16 kHz. Less state
# noise is no random walk any more but recursive least squares that never forgets, which a stationary noise would always
# favour; the tonal study shows what it changes.
STATE_NOISE_GRID = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4)
STEP_SIZE_GRID = tuple((2.0 ** -np.arange(1.0, 15.0)).tolist())
POWER_MEMORY_S = 0.5
SENSOR_NOISE_SEED = 1000  # plus the seed of the noise

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


class Runs:
    """Runs jobs on all cores (the compiled loop releases the interpreter), with one progress bar for all."""

    def __init__(self, bar: Any = None) -> None:
        self.bar = bar
        self.done = 0
        self._pool = ThreadPoolExecutor(max_workers=os.cpu_count())

    def map(
        self, job: Callable[[Item], Outcome], items: Iterable[Item], worth: Callable[[Item], int] = lambda item: 1
    ) -> list[Outcome]:
        """Outcomes of `job` in the order of `items`, each of which is worth some runs of those planned."""
        items, outcomes = list(items), []
        for item, outcome in zip(items, self._pool.map(job, items), strict=True):
            outcomes.append(outcome)
            self.done += worth(item)
            if self.bar is not None:
                self.bar.update(worth(item))
        return outcomes


@dataclass(frozen=True)
class Scene:
    """Noise, paths and amplifier of a study; one reference and disturbance a seed, of equal lengths.

    The noise has been running for `switch_on_s` when the control is switched on.
    """

    fs: float
    secondary: np.ndarray
    references: list[np.ndarray]
    disturbances: list[np.ndarray]
    rated_power: float
    n_taps: int
    sensor_noise_std: float
    switch_on_s: float
    nse_window_s: float
    amplifier: Amplifier | None = None
    measurement_noise: float = 0.0
    initial_variance: float = 0.0
    wiener_control_power: float = 0.0
    wiener_noise_reduction_db: float = 0.0
    seeds: list[int] = field(default_factory=list)

    @property
    def amplitude_limit(self) -> float:
        """Peak of a sine at rated power, the amplitude limit of the clipping amplifiers."""
        return float(np.sqrt(2 * self.rated_power))

    @property
    def settled(self) -> tuple[np.ndarray, np.ndarray]:
        """First reference and disturbance from switch-on on, where the primary path's start-up is over."""
        start = int(self.switch_on_s * self.fs)
        return self.references[0][start:], self.disturbances[0][start:]

    @property
    def filtered_power(self) -> float:
        """Power of the filtered reference, which makes step sizes and state noises comparable."""
        x = self.references[0]
        return float(np.mean(np.convolve(x, self.secondary)[: x.size] ** 2))

    def run(self, controller: Any, seed_index: int = 0, **options: Any) -> SimulationResult:
        """Run a controller on the noise of one seed."""
        return simulate(
            controller, self.references[seed_index], amplifier=self.amplifier, **self._options(seed_index), **options
        )

    def run_together(
        self, controllers: Sequence[KalmanController], seed_index: int = 0, **options: Any
    ) -> list[SimulationResult]:
        """Run Kalman controllers that share their gains on the noise of one seed."""
        options = {"amplifier": self.amplifier} | self._options(seed_index) | options
        return simulate_scenarios(controllers, self.references[seed_index], **options)

    def _options(self, seed_index: int) -> dict[str, Any]:
        return {
            "disturbance": self.disturbances[seed_index],
            "secondary_path": self.secondary,
            "fs": self.fs,
            "rated_power": self.rated_power,
            "sensor_noise_std": self.sensor_noise_std,
            "rng": SENSOR_NOISE_SEED + self.seeds[seed_index],
            "switch_on_s": self.switch_on_s,
        }


def make_scene(
    references: Mapping[int, np.ndarray],
    primary: Any,
    secondary: Any,
    *,
    fs: float,
    rated_power: float,
    power_multiple: float,
    n_taps: int,
    switch_on_s: float = 0.5,
    sensor_noise_db: float = -60.0,
    nse_window_s: float = 0.005,
    amplifier: Amplifier | None = None,
) -> Scene:
    """Scale the references and derive what a scene needs from them.

    `references` maps seeds to noises. They get the power at which the unconstrained Wiener control filter of the
    first needs `power_multiple` times the rated power. q is the estimate of eq. 7 from the first noise without
    control; P0 is what the Wiener control power is worth a tap, control power / (n_taps reference power).
    """
    s, p = path_taps(secondary, fs=fs), path_taps(primary, fs=fs)
    first = next(iter(references.values()))
    settled = slice(int(switch_on_s * fs), None)  # the primary path's start-up is over
    d = np.convolve(first, p)[: first.size]
    wiener = wiener_solution(first[settled], d[settled], s, n_taps)
    power = float(np.mean(first**2)) * power_multiple * rated_power / wiener.control_power
    scaled = [scaled_to_power(x, power) for x in references.values()]
    disturbances = [np.convolve(x, p)[: x.size] for x in scaled]
    std = float(np.sqrt(np.mean(disturbances[0][settled] ** 2)) * 10 ** (sensor_noise_db / 20))
    recorded = disturbances[0][settled]
    recorded = recorded + std * np.random.default_rng(0).standard_normal(recorded.size)
    return Scene(
        fs=fs,
        secondary=s,
        references=scaled,
        disturbances=disturbances,
        rated_power=rated_power,
        n_taps=n_taps,
        sensor_noise_std=std,
        switch_on_s=switch_on_s,
        nse_window_s=nse_window_s,
        amplifier=amplifier,
        measurement_noise=measurement_noise_from_run(scaled[0][settled], recorded, s, n_taps),
        initial_variance=power_multiple * rated_power / (n_taps * power),
        wiener_control_power=power_multiple * rated_power,
        wiener_noise_reduction_db=wiener.noise_reduction_db,
        seeds=list(references),
    )


def make_controller(
    scene: Scene, algorithm: str, setting: float, *, amplifier: Amplifier | None = None
) -> FilteredReferenceController:
    """A fresh controller. `setting` is r E[x'^2] / q for the Kalman filters, mu L E[x'^2] for the LMS family.

    `amplifier` is the one that a Kalman filter's disturbance estimate knows.
    """
    scaled = setting_value(scene, algorithm, setting)
    if algorithm in (*KALMAN, *BUDGETED):
        kalman: dict[str, Any] = {
            "state_noise": scaled,
            "measurement_noise": scene.measurement_noise,
            "initial_variance": scene.initial_variance,
            "amplifier": amplifier,
        }
        if algorithm == "KF-ANC":
            return kf_anc(scene.n_taps, scene.secondary, **kalman)
        kalman |= {"rated_power": scene.rated_power, "fs": scene.fs}
        if algorithm == "KF-PB":
            return kf_pb(scene.n_taps, scene.secondary, **kalman)
        make = kf_opc if algorithm == "KF-OPC" else kf_opc_repaired
        return make(scene.n_taps, scene.secondary, power_memory=POWER_MEMORY_S, **kalman)
    if algorithm == "FxLMS":
        return FxLMS(scene.n_taps, scene.secondary, step_size=scaled)
    return MOVFxLMS(
        scene.n_taps,
        scene.secondary,
        step_size=scaled,
        rated_power=scene.rated_power,
        fs=scene.fs,
        power_memory=POWER_MEMORY_S,
    )


def setting_value(scene: Scene, algorithm: str, setting: float) -> float:
    """State noise r or step size mu of a setting, in the scene's units."""
    if algorithm in (*KALMAN, *BUDGETED):
        return setting * scene.measurement_noise / scene.filtered_power
    return setting / (scene.n_taps * scene.filtered_power)


def run_settings(
    runs: Runs,
    scene: Scene,
    jobs: Sequence[tuple[str, float, int]],
    measure: Callable[[SimulationResult], Outcome],
) -> list[Outcome]:
    """What `measure` makes of a run of each (algorithm, setting, index of the seed).

    Kalman filters of one setting on one noise differ in the constraint only: they share their gains.
    """
    groups: dict[Any, list[tuple[str, float, int]]] = {}
    for job in jobs:
        groups.setdefault(("Kalman", *job[1:]) if job[0] in KALMAN else job, []).append(job)

    def run(group: list[tuple[str, float, int]]) -> list[Outcome]:
        controllers = [make_controller(scene, name, setting) for name, setting, _ in group]
        kalman = [c for c in controllers if isinstance(c, KalmanController)]
        if len(kalman) > 1:
            return [measure(result) for result in scene.run_together(kalman, group[0][2])]
        return [measure(scene.run(controllers[0], group[0][2]))]

    outcomes = runs.map(run, groups.values(), worth=len)
    by_job = {
        job: o for group, own in zip(groups.values(), outcomes, strict=True) for job, o in zip(group, own, strict=True)
    }
    return [by_job[job] for job in jobs]


def grid(algorithm: str) -> tuple[float, ...]:
    """Settings that are tried for an algorithm."""
    return STATE_NOISE_GRID if algorithm in (*KALMAN, *BUDGETED) else STEP_SIZE_GRID


def tuning_runs(algorithms: Sequence[str] = ALGORITHMS, seeds: int = 1) -> int:
    """Runs that `tune` takes."""
    return seeds * sum(len(grid(name)) for name in algorithms)


@dataclass(frozen=True)
class Trial:
    """One setting of one algorithm: mean NSE over the whole run in dB, output power over the steady half."""

    setting: float
    mean_nse_db: float
    output_power: float
    diverged: bool


@dataclass(frozen=True)
class Tuned:
    """The best setting of an algorithm, and all that were tried."""

    setting: float
    within_budget: bool
    at_edge: bool
    trials: list[Trial]


def tune(runs: Runs, scene: Scene, algorithms: Sequence[str] = ALGORITHMS, seeds: int = 1) -> dict[str, Tuned]:
    """Best setting of each algorithm, one rule for all.

    The lowest mean NSE over the whole run, start included, among settings that do not diverge and, for constrained
    methods, keep the budget to 2 % over the steady half. Where no setting keeps it, the lowest mean NSE, and
    `within_budget` is False. Mean NSEs that agree to 0.01 dB are a tie, which goes to the smaller setting.
    """
    jobs = [(name, setting, k) for name in algorithms for setting in grid(name) for k in range(seeds)]

    def trial(result: SimulationResult) -> tuple[float, float, bool]:
        if result.diverged_at_s is not None:
            return np.inf, np.inf, True
        nse = nse_db(result.error, result.disturbance, scene.fs, scene.nse_window_s)
        return float(np.mean(nse)), output_power(result.control_signal), False

    outcomes = dict(zip(jobs, run_settings(runs, scene, jobs, trial), strict=True))
    tuned = {}
    for name in algorithms:
        trials = []
        for setting in grid(name):
            rows = [outcomes[name, setting, k] for k in range(seeds)]
            means = np.mean([row[:2] for row in rows], axis=0)
            trials.append(Trial(setting, float(means[0]), float(means[1]), any(row[2] for row in rows)))
        tuned[name] = _best(trials, scene.rated_power if name in CONSTRAINED else np.inf, name)
    return tuned


def _best(trials: list[Trial], rated_power: float, name: str) -> Tuned:
    stable = [t for t in trials if not t.diverged]
    if not stable:
        raise RuntimeError(f"{name} diverged at every setting tried: {[t.setting for t in trials]}")
    kept = [t for t in stable if t.output_power <= BUDGET * rated_power]
    best = min(kept or stable, key=lambda t: (round(t.mean_nse_db, 2), t.setting))  # a tie: the smaller setting
    edges = (min(t.setting for t in trials), max(t.setting for t in trials))
    return Tuned(best.setting, bool(kept), best.setting in edges, trials)


def figures_of_merit(results: Sequence[SimulationResult], scene: Scene) -> dict[str, float | None]:
    """The figures of results.json of one algorithm: means over seeds, NSE pooled over seeds."""
    diverged = [r.diverged_at_s for r in results if r.diverged_at_s is not None]
    errors = np.array([r.error for r in results])
    disturbances = np.array([r.disturbance for r in results])
    return {
        "noise_reduction_db": float(np.mean([noise_reduction_db(r.error, r.disturbance) for r in results])),
        "output_power": float(np.mean([output_power(r.control_signal) for r in results])),
        "peak_control_signal": float(np.mean([peak_control_signal(r.control_signal) for r in results])),
        "clipped_fraction": float(
            np.mean([clipped_fraction(r.control_signal, scene.amplitude_limit) for r in results])
        ),
        "harmonics_db": None,
        "convergence_time_s": convergence_time_s(errors, disturbances, scene.fs, window_s=scene.nse_window_s),
        "diverged_at_s": min(diverged) if diverged else None,
    }
