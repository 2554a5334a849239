"""Suggested settings against a grid of lengths and state noises."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from comparisons.bench.noises import bursty_noise
from kfopc_filterpy import Plant, kf_anc, kf_opc, simulate, suggest_settings
from kfopc_filterpy.bounds import SuggestedSettings, wiener_solution
from kfopc_filterpy.signals import band_limited_noise, compressor_noise, scaled_to_power, tone

FS = 16000.0
ON = 8000  # samples until the control is switched on: the start-up of the primary path is over
SENSOR_NOISE = 0.01  # standard deviation of the microphone's noise over that of the disturbance
RATED_SHARE = 0.25  # rated power of KF-OPC over what the best fixed filter takes

Noise = Callable[[float, int], np.ndarray]  # of a duration in s and a seed


class Comparison(NamedTuple):
    """KF-ANC and KF-OPC (rows) with their noise reduction and minus their mean NSE in dB (columns)."""

    suggested: SuggestedSettings
    own: np.ndarray
    best: np.ndarray  # of the grid; KF-OPC only with settings that keep its power, see `compare`


NOISES: dict[str, Noise] = {
    "white": lambda duration, seed: np.random.default_rng(seed).standard_normal(round(duration * FS)),
    "band noise": lambda duration, seed: band_limited_noise((100, 1000), duration, fs=FS, rng=seed),
    "tone": lambda duration, seed: tone(300.0, duration, fs=FS, phase_rad=float(seed)),
    "compressor": lambda duration, seed: compressor_noise(duration, fs=FS, rng=seed),
    "bursts": lambda duration, seed: bursty_noise(duration, fs=FS, rng=seed),
}


def noisy_scene(plant: Plant, noise: Noise, seed: int, duration: float) -> tuple[np.ndarray, Plant]:
    """Return a reference of power 1, and the plant with the noise of its microphone."""
    x = scaled_to_power(noise(duration + ON / FS, seed), 1.0)
    std = SENSOR_NOISE * float(np.sqrt(np.mean(plant.disturbance(x) ** 2)))
    return x, Plant(plant.secondary, plant.primary, fs=FS, sensor_noise_std=std)


def silent_run(x: np.ndarray, plant: Plant) -> tuple[np.ndarray, np.ndarray]:
    """Return the reference and what the microphone hears of it, without the start-up."""
    d = plant.disturbance(x)[ON:]
    return x[ON:], d + plant.sensor_noise_std * np.random.default_rng(5).standard_normal(d.size)


def compare(
    plant: Plant, noise: Noise, *, duration: float, lengths: Sequence[int], factors: Sequence[float]
) -> Comparison:
    """Suggest settings from one run of the noise, and compare them on another with a grid.

    The grid has the given lengths, each with its suggested q and P0, and the given factors of its suggested r. A setting
    with which KF-OPC exceeds the rated power, and the power with the suggested ones, by 2 % is not counted: while the
    level changes, weights that lag behind the factor reduce more noise, with power that they should not take.
    """
    heard, d = silent_run(*noisy_scene(plant, noise, 1, duration))
    suggested = suggest_settings(heard, plant, disturbance=d, max_taps=max(lengths))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", np.exceptions.RankWarning)
        fixed = wiener_solution(heard, plant, n_taps=suggested.n_taps, disturbance=d, regularization=1e-6)
    rated = RATED_SHARE * fixed.control_power
    x, noisy = noisy_scene(plant, noise, 2, duration)

    def run(n_taps: int, noises: dict[str, float]) -> tuple[np.ndarray, float]:
        both = kf_anc(n_taps, plant, **noises), kf_opc(n_taps, plant, rated_power=rated, **noises)
        results = simulate(both, x, noisy, rng=6, switch_on_s=ON / FS)
        merits = [(one.noise_reduction_db, -float(np.mean(one.nse_db(0.05)))) for one in results]
        return np.array(merits), results[1].output_power

    own, power = run(suggested.n_taps, suggested.noises)
    best = np.full((2, 2), -np.inf)
    for n_taps in lengths:
        at = suggest_settings(heard, plant, disturbance=d, n_taps=n_taps)
        for factor in factors:
            merits, used = run(n_taps, dataclasses.replace(at, state_noise=factor * at.state_noise).noises)
            best[0] = np.maximum(best[0], merits[0])
            if used <= 1.02 * max(power, rated):
                best[1] = np.maximum(best[1], merits[1])
    return Comparison(suggested, own, best)
