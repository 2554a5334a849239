"""Plants and noises that KF-PB is judged in, and the fixed filters of each case: for its study and the loss map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.signal import fftconvolve

from kfopc_filterpy import Plant, kf_pb, noise_reduction_db, power_constrained_wiener, simulate

from ..bench.noises import level_jump, looped
from ..bench.scene import reachable_weights
from .cases import FS, SENSOR_NOISE_DB, made_noises, measured_room, plants, recordings

N_TAPS = 256
SILENT_S, DURATION_S = 3.0, 20.0  # before and after the control is switched on
SHARES = (0.25, 0.1)  # rated power over the power that full control needs
SEED = 1
STEADY, CHANGING = "steady and recorded", "jumps, bursts, mixes"
JUMPS = {  # dB, from and to s after switch-on
    "12 dB louder from 8 s on": (12.0, 8.0, DURATION_S),
    "12 dB softer from 8 s on": (-12.0, 8.0, DURATION_S),
    "10 dB louder for 4 s": (10.0, 6.0, 10.0),
}

Make = Callable[[], np.ndarray]


def noises() -> dict[str, tuple[str, Make]]:
    """Return the class and the samples of each noise, recordings where they are at hand."""
    duration = SILENT_S + DURATION_S
    made: dict[str, Make] = {name: partial(make, duration, SEED) for name, make in made_noises().items()}
    steady = {name: made[name] for name in ("compressor", "band noise")}
    for name, recording in recordings("motor", "compressor").items():
        steady[f"recorded {name}"] = partial(looped, recording, duration, fs=FS)
    some = list(steady)[::2]  # a made one, and a recorded one where it is at hand
    changing: dict[str, Make] = {name: made[name] for name in ("bursts", "swelling band noise")}
    for words, jump in JUMPS.items():
        changing |= {f"{name}, {words}": partial(jumping, steady[name], *jump) for name in some}
    changing["band noise, then compressor"] = lambda: mixed(steady["band noise"](), steady["compressor"]())
    return {name: (STEADY, make) for name, make in steady.items()} | {
        name: (CHANGING, make) for name, make in changing.items()
    }


def jumping(make: Make, gain_db: float, begin_s: float, end_s: float) -> np.ndarray:
    """Return a noise that is louder between two times after switch-on."""
    louder = level_jump(make(), SILENT_S + begin_s, gain_db, fs=FS)
    return level_jump(louder, SILENT_S + end_s - 1 / FS, -gain_db, fs=FS)


def mixed(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return one noise, the other from 7 s after switch-on on, and both from 13 s on."""
    t = np.arange(one.size) / FS - SILENT_S
    return one / np.std(one) * ((t < 7) | (t >= 13)) + other / np.std(other) * (t >= 7)


def all_plants() -> dict[str, Plant]:
    """Return the plants of the studies, with one loudspeaker and microphone of the measured room if it is at hand."""
    room = measured_room()
    if room is None or room.primary is None:
        return plants()
    return plants() | {"measured room": Plant(room.secondary[0, 0], room.primary[0, 0], fs=room.fs)}


@dataclass(frozen=True)
class Rated:
    """A noise, its disturbance with sensor noise, the plant behind it, and a rated power."""

    reference: np.ndarray
    disturbance: np.ndarray
    plant: Plant  # its secondary path; the disturbance takes the place of the primary one
    rated_power: float
    bound_error: np.ndarray  # of each second's own fixed filter within the rated power

    @property
    def secondary(self) -> np.ndarray:
        """The taps of the secondary path."""
        return self.plant.secondary[0, 0]

    @property
    def after(self) -> np.ndarray:
        """The disturbance after switch-on."""
        return self.disturbance[round(SILENT_S * FS) :]

    def kf_pb(self, estimate: np.ndarray, **options: Any) -> Any:
        """Return KF-PB with an estimate of the secondary path."""
        return kf_pb(N_TAPS, estimate, rated_power=self.rated_power, fs=FS, **options)

    def run(self, controller: Any) -> Any:
        """Return the run of a controller."""
        return simulate(controller, self.reference, self.plant, disturbance=self.disturbance, switch_on_s=SILENT_S)

    def reduction_db(self, error: np.ndarray, begin_s: float = 1.0, end_s: float | None = None) -> float:
        """Return the noise reduction between two times after switch-on, up to the end if only one is given."""
        part = slice(round(begin_s * FS), round((DURATION_S if end_s is None else end_s) * FS))
        return noise_reduction_db(error[part], self.after[part], steady=1.0)


def make_rated(plant: Plant, noise: np.ndarray, share: float) -> Rated:
    """Return a case whose rated power is a share of what full control needs."""
    x = noise / np.std(noise)
    d = plant.disturbance(x)
    d += 10 ** (SENSOR_NOISE_DB / 20) * np.std(d) * np.random.default_rng(SEED).standard_normal(d.size)
    heard = Plant(plant.secondary, fs=plant.fs)
    needed = with_any_power(x, d, heard, N_TAPS).control_power
    bound = fixed_filters(x, d, heard, N_TAPS, rated_power=share * needed).per_second.error
    return Rated(x, d, heard, share * needed, bound)


def with_any_power(x: np.ndarray, d: np.ndarray, plant: Plant, n_taps: int) -> Any:
    """Return the best fixed filter of a length for a reference and a disturbance, whatever power it takes."""
    ridge = 1e-4 * np.var(fftconvolve(x, plant.secondary[0, 0])[: x.size])
    whole = {"rated_power": 1e12, "segment_s": DURATION_S, "ridge": ridge}
    return fixed_filters(x, d, plant, n_taps, **whole).unconstrained


def fixed_filters(x: np.ndarray, d: np.ndarray, plant: Plant, n_taps: int, **settings: Any) -> Any:
    """Return the power-constrained Wiener solutions."""
    with reachable_weights():
        return power_constrained_wiener(x, plant, n_taps=n_taps, disturbance=d, switch_on_s=SILENT_S, **settings)
