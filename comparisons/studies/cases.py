"""Plants, noises, scenes, rows of results and tuning, shared by the studies beyond the paper and the sweeps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from kfopc_filterpy import Plant, SimulationResult, bandpass_path, power_constrained_wiener, signals
from kfopc_filterpy.bounds import PowerConstrainedWiener
from kfopc_filterpy.paths import duct_plant

from ..bench import Runs, Scene, Tuned, algorithms, make_controller, make_scene, run_settings
from ..bench.measured import DataUnavailableError, MeasuredDuct, load_measured_duct, load_measured_room
from ..bench.noises import bursty_noise, level_jump, looped, swelling
from ..bench.scene import louder, reachable_weights
from ..bench.tuning import best_setting, try_settings

FS = 16000.0
SWITCH_ON_S = 0.5
SENSOR_NOISE_DB = -40.0
TONE_HZ = 300.0
WIDE_BAND_HZ = (100.0, 1000.0)
SWING_DB, PERIOD_S = 6.0, 4.0
STATIONARY = ("tone", "compressor", "band noise")
WINDOW_S = 0.1  # of the largest short-time output power

# Of the studies that drive a noise some dB beyond the rated power: mismatch, tracking and the amplifier.
N_TAPS = 128
BAND_HZ = (200.0, 1000.0)
SEED = 1

PAPER = tuple(name for name, own in algorithms().items() if own.of_paper)  # algorithms that the paper compares

Setting = float | tuple[float, float]  # of an algorithm, as in the registry
Results = dict[str, list[Any]]  # of algorithms, a run for each seed
Noise = Callable[[float, int], np.ndarray]  # of a duration in s and a seed


@dataclass(frozen=True)
class Case:
    """Where an algorithm is run: paths and a noise by name, and an amplifier if it is not linear."""

    path: str
    noise: str
    amplifier: str = "linear"

    @property
    def stationary(self) -> bool:
        """Whether every second of the noise is as loud as the others."""
        return self.noise in STATIONARY

    @property
    def place(self) -> dict[str, Any]:
        """Paths and noise, as rows of results have them."""
        return {"path": self.path, "noise": self.noise}

    def __str__(self) -> str:
        return f"{self.path}, {self.noise}"


@dataclass(frozen=True)
class Setup:
    """What the paper leaves open: the rule's choice, or what its authors' published code has."""

    n_taps: int
    band_hz: tuple[float, float]  # of the band-pass paths
    primary_taps: int
    secondary_taps: int
    memory_s: float  # of the power estimates
    window: str
    source: str

    def plant(self, **options: Any) -> Plant:
        """Return the plant of the band-pass paths."""
        secondary, primary = (bandpass_path(n, self.band_hz, fs=FS) for n in (self.secondary_taps, self.primary_taps))
        return Plant(secondary, primary, **options)

    def scene(self, references: Mapping[int, np.ndarray], plant: Plant, **levels: Any) -> Scene:
        """Return a scene with these taps and power estimates."""
        scene = make_scene(references, plant, n_taps=self.n_taps, **levels)
        return replace(scene, power_memory_s=self.memory_s, power_window=self.window)


CHOSEN = Setup(128, (20.0, 5000.0), 128, 32, 0.5, "exponential", "the paper's")
AUTHORS = Setup(256, (80.0, 5000.0), 256, 128, 1024 / FS, "sliding", "those of the authors' code")


# ---- Plants and noises


def modelled_plants() -> dict[str, Plant]:
    """Return the models by name."""
    return {"band-pass": CHOSEN.plant(), "duct": duct_plant(fs=FS)}


def plants() -> dict[str, Plant]:
    """Return the plants by name, with the measured duct if it is at hand."""
    measured = measured_data()
    return modelled_plants() | ({} if measured is None else {"measured duct": of_unit_gain(measured)})


def of_unit_gain(measured: MeasuredDuct) -> Plant:
    """Return a measured duct, whose scale is arbitrary, with a secondary path of gain 1 for white noise."""
    scale = np.sqrt(np.sum(measured.secondary**2))
    return Plant(measured.secondary / scale, measured.primary / scale, fs=measured.fs)


def ducts() -> dict[str, Plant]:
    """Return the built-in duct, and the measured one if it is at hand."""
    return {name: plant for name, plant in plants().items() if name != "band-pass"}


def made_noises(band_hz: tuple[float, float] = WIDE_BAND_HZ) -> dict[str, Noise]:
    """Return the noises that are made and not recorded, by name."""

    def band_noise(duration: float, seed: int) -> np.ndarray:
        return signals.band_limited_noise(band_hz, duration, fs=FS, rng=seed)

    def swelling_band_noise(duration: float, seed: int) -> np.ndarray:
        steady = band_noise(duration, seed)
        return swelling(steady, fs=FS, swing_db=SWING_DB, period_s=PERIOD_S, phase_rad=float(seed))

    return {
        "tone": lambda duration, seed: signals.tone(TONE_HZ, duration, fs=FS, phase_rad=float(seed)),
        "compressor": lambda duration, seed: signals.compressor_noise(duration, fs=FS, rng=seed),
        "band noise": band_noise,
        "bursts": lambda duration, seed: bursty_noise(duration, fs=FS, rng=seed),
        "swelling band noise": swelling_band_noise,
    }


def noises() -> dict[str, Noise]:
    """Return the noises by name, with the motor recording if it is at hand."""
    made = made_noises()
    found = recordings("motor")
    if found:
        made["motor"] = lambda duration, seed: looped(found["motor"], duration, fs=FS, start_s=2.5 * seed)
    return made


@cache
def measured_data(noise: str = "motor") -> MeasuredDuct | None:
    """Return the measured duct and one of its recordings, or None if they are not available."""
    with suppress(DataUnavailableError):
        return load_measured_duct(noise)
    return None


def recordings(*names: str) -> dict[str, np.ndarray]:
    """Return those of some recordings that are available, with their means removed."""
    ducts = {name: measured_data(name) for name in names}
    return {name: duct.noise - duct.noise.mean() for name, duct in ducts.items() if duct is not None}


def measured_room() -> Plant | None:
    """Return the measured room, or None if it is not available."""
    with suppress(DataUnavailableError):
        return load_measured_room()
    return None


# ---- Scenes


def make_case(
    plant: Plant, noise: np.ndarray, *, n_taps: int, sensor_noise_db: float = SENSOR_NOISE_DB, seed: int = 0
) -> Scene:
    """Return the scene of one noise whose unconstrained control power is 1; the seed is of the sensor noise.

    That power is of the filter with which a Kalman filter without state noise would end, ``(R_x' + q/(N P0) I) w = r``
    over the record. Without the ridge, directions that the noise hardly excites could ask for any power.
    """
    scene = unit_scene(plant, noise, n_taps=n_taps, sensor_noise_db=sensor_noise_db, seed=seed)
    normal = louder(scene, 1.0 / np.sqrt(bound_of(scene).unconstrained.control_power))
    return replace(normal, unconstrained_power=1.0)


def unit_scene(plant: Plant, noise: np.ndarray, *, n_taps: int, sensor_noise_db: float, seed: int) -> Scene:
    """Return the scene of one noise, with a Wiener control power of 1 and a rated power of 1."""
    return make_scene(
        {seed: noise},
        plant,
        rated_power=1.0,
        power_multiple=1.0,
        n_taps=n_taps,
        switch_on_s=SWITCH_ON_S,
        sensor_noise_db=sensor_noise_db,
        nse_window_s=0.05,
    )


def noise_of(name: str, duration_s: float, seed: int = SEED) -> np.ndarray:
    """Return a noise of the driven studies, with as much before it as runs before the control is switched on."""
    return made_noises(BAND_HZ)[name](duration_s + SWITCH_ON_S, seed)


def driven_case(plant: Plant, noise: np.ndarray, overdrive_db: float) -> Scene:
    """Return the scene of a noise whose unconstrained control power, 1, is so many dB above the rated one."""
    return with_overdrive(make_case(plant, noise, n_taps=N_TAPS), overdrive_db)


def jumping(scene: Scene, plant: Plant, span_s: tuple[float, float], gain_db: float) -> Scene:
    """Return a scene of one seed whose noise is louder between two times of the record."""
    begin_s, end_s = span_s
    raised = level_jump(scene.references[0], begin_s, gain_db, fs=FS)
    return heard_on(scene, plant, level_jump(raised, end_s, -gain_db, fs=FS))


def heard_on(scene: Scene, plant: Plant, x: np.ndarray) -> Scene:
    """Return a scene of one seed with another noise, which reaches the microphone as on a plant."""
    return replace(scene, references=[x], disturbances=[plant.disturbance(x)])


def with_overdrive(scene: Scene, overdrive_db: float) -> Scene:
    """Return the scene with a rated power so many dB below the unconstrained control power."""
    return replace(scene, rated_power=scene.unconstrained_power / 10 ** (overdrive_db / 10))


def bound_of(scene: Scene, segment_s: float = 1.0) -> PowerConstrainedWiener:
    """Return the power-constrained Wiener solutions of a case, of weights that controllers reach."""
    ridge = scene.measurement_noise / (scene.settled[0].shape[-1] * scene.initial_variance)
    with reachable_weights():
        return power_constrained_wiener(
            scene.references[0],
            scene.plant,
            n_taps=scene.n_taps,
            rated_power=scene.rated_power,
            disturbance=scene.disturbances[0],
            segment_s=segment_s,
            switch_on_s=scene.switch_on_s,
            ridge=ridge,
        )


def bounds_db(scene: Scene, stationary: bool) -> tuple[float, float]:
    """Return the noise reduction of the bound and of the scaled Wiener filter over the steady half.

    Both are of one filter for the whole record, or of each second's own if the noise is not stationary.
    """
    bound = bound_of(scene)
    reached = bound.noise_reduction_over(0.5 * bound.whole.end_s)
    if stationary:
        return reached["whole"], reached["scaled"]
    return reached["per_second"], reached["scaled_per_second"]


# ---- Runs and tuning


def run_each(runs: Runs, scene: Scene, settings: Mapping[str, Setting], **recorded: Any) -> dict[str, SimulationResult]:
    """Return a run of each algorithm at its setting; what is recorded goes to `simulate`."""

    def run(job: tuple[str, Setting]) -> SimulationResult:
        return scene.run(make_controller(scene, *job), **recorded)

    return dict(zip(settings, runs.map(run, settings.items()), strict=True))


def run_seeds(runs: Runs, scene: Scene, tuned: Mapping[str, Tuned], planned: bool = True) -> Results:
    """Return the runs of each algorithm at its best setting on each seed; None if a filter could not go on."""
    jobs = [(name, best.setting, k) for name, best in tuned.items() for k in range(len(scene.seeds))]
    outcomes = iter(run_settings(runs, scene, jobs, lambda result: result, planned))
    return {name: [next(outcomes) for _ in scene.seeds] for name in tuned}


def grids(names: Iterable[str]) -> dict[str, list[Setting]]:
    """Return the settings that are tried of each algorithm."""
    return {name: algorithms()[name].grid for name in names}


def grid_runs(names: Iterable[str]) -> int:
    """Return the number of runs of the grids; those of the finer grids are not planned."""
    return sum(map(len, grids(names).values()))


def tune_all(runs: Runs, scene: Scene, settings: Mapping[str, Sequence[Setting]]) -> dict[str, Tuned | None]:
    """Return the best of the given settings of each algorithm; None if all of them diverge."""
    trials = try_settings(runs, scene, settings)
    return {name: best_setting(scene, name, own) for name, own in trials.items()}
