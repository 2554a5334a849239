"""What every study shares: a scene to run controllers in, and the jobs that run there."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from kfopc_filterpy import (
    KalmanController,
    SimulationResult,
    clipped_fraction,
    convergence_time_s,
    noise_reduction_db,
    output_power,
    simulate,
    simulate_scenarios,
)
from kfopc_filterpy.bounds import measurement_noise_from_run, wiener_solution
from kfopc_filterpy.metrics import peak_control_signal
from kfopc_filterpy.paths import path_taps
from kfopc_filterpy.power.amplifiers import Amplifier
from kfopc_filterpy.signals import scaled_to_power

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
    unconstrained_power: float = 1.0  # output power that the noise asks for without a constraint
    wiener_control_power: float = 0.0
    wiener_noise_reduction_db: float = 0.0
    seeds: list[int] = field(default_factory=list)
    secondary_estimate: np.ndarray | None = None  # what controllers know of the secondary path; None: the path itself
    known_amplifier: Amplifier | None = None  # what controllers know of the amplifier; None: that it is linear

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
    def known_secondary(self) -> np.ndarray:
        """What controllers know of the secondary path."""
        return self.secondary if self.secondary_estimate is None else self.secondary_estimate

    @property
    def filtered_power(self) -> float:
        """Power of the filtered reference, which makes step sizes and state noises comparable."""
        x = self.references[0]
        return float(np.mean(np.convolve(x, self.known_secondary)[: x.size] ** 2))

    @property
    def secondary_gain(self) -> float:
        """Power gain G_s of the secondary path that controllers know, for the reference (eq. 11)."""
        return self.filtered_power / float(np.mean(self.references[0] ** 2))

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
        unconstrained_power=power_multiple * rated_power,
        wiener_control_power=power_multiple * rated_power,
        wiener_noise_reduction_db=wiener.noise_reduction_db,
        seeds=list(references),
    )


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
        "convergence_time_s": convergence_time_s(
            errors, disturbances, scene.fs, window_s=scene.nse_window_s, runs=True
        ),
        "diverged_at_s": min(diverged) if diverged else None,
    }
