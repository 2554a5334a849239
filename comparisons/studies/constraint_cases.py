"""Paths, noises and scenes of the study of the constraint."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from kfopc_filterpy import bandpass_path, power_constrained_wiener
from kfopc_filterpy.bench.scene import Scene, make_scene
from kfopc_filterpy.bounds import PowerConstrainedWiener
from kfopc_filterpy.paths import duct_paths, path_taps
from kfopc_filterpy.signals import (
    DataUnavailableError,
    band_limited_noise,
    bursty_noise,
    compressor_noise,
    level_jump,
    load_measured_duct,
    looped,
    swelling,
    tone,
)

FS = 16000.0
N_TAPS = 160
SWITCH_ON_S = 0.5
SENSOR_NOISE_DB = -40.0
TONE_HZ = 300.0
BAND_HZ = (100.0, 1000.0)
SWING_DB, PERIOD_S = 6.0, 4.0
STATIONARY = ("tone", "compressor", "band noise")

Noise = Callable[[float, int], np.ndarray]


@dataclass(frozen=True)
class Setting:
    """Where a case is run: a pair of paths and a noise, by name."""

    path: str
    noise: str

    @property
    def stationary(self) -> bool:
        """Whether the noise is as loud in one second as in another."""
        return self.noise in STATIONARY


def modelled_paths() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Primary and secondary taps of the models, by name."""
    duct = duct_paths(fs=FS)
    return {
        "band-pass": (path_taps(bandpass_path(128)), path_taps(bandpass_path(32))),
        "duct": (path_taps(duct.primary), path_taps(duct.secondary)),
    }


def paths() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Primary and secondary taps by name; the measured duct where it is at hand."""
    pairs = modelled_paths()
    measured = measured_data()
    if measured is not None:
        scale = np.sqrt(np.sum(measured.secondary**2))  # its scale is arbitrary: unit gain for white noise
        pairs["measured duct"] = (measured.primary / scale, measured.secondary / scale)
    return pairs


def made_noises() -> dict[str, Noise]:
    """Noises by name, functions of duration and seed, that are made and not recorded."""
    return {
        "tone": lambda duration, seed: tone(TONE_HZ, duration, fs=FS, phase_rad=float(seed)),
        "compressor": lambda duration, seed: compressor_noise(duration, fs=FS, rng=seed),
        "band noise": lambda duration, seed: band_limited_noise(BAND_HZ, duration, fs=FS, rng=seed),
        "bursts": lambda duration, seed: bursty_noise(duration, fs=FS, rng=seed),
        "swelling band noise": lambda duration, seed: swelling(
            band_limited_noise(BAND_HZ, duration, fs=FS, rng=seed),
            fs=FS,
            swing_db=SWING_DB,
            period_s=PERIOD_S,
            phase_rad=float(seed),
        ),
    }


def noises() -> dict[str, Noise]:
    """Noises by name, functions of duration and seed; the motor recording where it is at hand."""
    made = made_noises()
    measured = measured_data()
    if measured is not None:
        recording = measured.noise - measured.noise.mean()
        made["motor"] = lambda duration, seed: looped(recording, duration, fs=FS, start_s=2.5 * seed)
    return made


@cache
def measured_data() -> Any:
    """The measured duct and the motor recording, None where they are not to be had."""
    try:
        return load_measured_duct(allow_download=True)
    except DataUnavailableError:
        return None


def make_case(
    pair: tuple[np.ndarray, np.ndarray],
    noise: np.ndarray,
    *,
    n_taps: int | None = None,
    sensor_noise_db: float = SENSOR_NOISE_DB,
    seed: int = 0,
) -> Scene:
    """Scene of one noise whose unconstrained control power is 1.

    That power is of the filter that a Kalman filter without state noise would end with, ``(R_x' + q/(N P0) I) w = r``
    over the record: without the ridge, directions that the noise hardly excites could ask for any power. `n_taps` is
    N_TAPS by default; the seed is of the sensor noise.
    """
    scene = make_scene(
        {seed: noise},
        *pair,
        fs=FS,
        rated_power=1.0,
        power_multiple=1.0,
        n_taps=N_TAPS if n_taps is None else n_taps,
        switch_on_s=SWITCH_ON_S,
        sensor_noise_db=sensor_noise_db,
        nse_window_s=0.05,
    )
    normal = louder(scene, 1.0 / np.sqrt(bound_of(scene).unconstrained.control_power))
    return replace(normal, unconstrained_power=1.0)


def louder(scene: Scene, gain: float) -> Scene:
    """The scene with all signals times a gain, and the measurement noise with them."""
    return replace(
        scene,
        references=[gain * x for x in scene.references],
        disturbances=[gain * d for d in scene.disturbances],
        sensor_noise_std=gain * scene.sensor_noise_std,
        measurement_noise=gain**2 * scene.measurement_noise,
        unconstrained_power=gain**2 * scene.unconstrained_power,
        wiener_control_power=gain**2 * scene.wiener_control_power,
    )


def bound_of(scene: Scene) -> PowerConstrainedWiener:
    """The power-constrained Wiener solutions of a case."""
    ridge = scene.measurement_noise / (scene.settled[0].size * scene.initial_variance)
    return power_constrained_wiener(
        scene.references[0],
        scene.disturbances[0],
        scene.secondary,
        scene.n_taps,
        scene.rated_power,
        fs=FS,
        switch_on_s=SWITCH_ON_S,
        ridge=ridge,
    )


def with_jump(noise: np.ndarray, gain_db: float, begin_s: float, end_s: float) -> np.ndarray:
    """The noise, louder or softer between two times."""
    return level_jump(level_jump(noise, begin_s, gain_db, fs=FS), end_s, -gain_db, fs=FS)


def settings(pairs: Mapping[str, Any], made: Mapping[str, Noise]) -> list[Setting]:
    """All combinations of paths and noises."""
    return [Setting(path, noise) for path in pairs for noise in made]
