"""Suggested settings against a grid of lengths and state noises: for tests, and as a command for all cases at hand.

`python tests/helpers/settings_grid.py` takes a quarter of an hour. It prints for each path and noise by how many dB the best of
the grid is better, in the noise reduction over the steady half and in the mean NSE over the whole run. The measured duct
and the recordings take part if KFOPC_DATA names their folder.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from comparisons.bench.measured import DataUnavailableError, load_measured_duct
from kfopc_filterpy import (
    bandpass_path,
    kf_anc,
    kf_opc,
    noise_reduction_db,
    nse_db,
    output_power,
    simulate_scenarios,
    suggest_settings,
)
from kfopc_filterpy.bounds import SuggestedSettings, wiener_solution
from kfopc_filterpy.paths import duct_paths, path_taps
from kfopc_filterpy.signals import (
    band_limited_noise,
    bursty_noise,
    compressor_noise,
    looped,
    scaled_to_power,
    swelling,
    tone,
)

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


def white(duration: float, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(round(duration * FS))


def band_noise(duration: float, seed: int) -> np.ndarray:
    return band_limited_noise((100, 1000), duration, fs=FS, rng=seed)


def tones(duration: float, seed: int) -> np.ndarray:
    strengths = {120.0: 1.0, 240.0: 0.7, 480.0: 0.5, 730.0: 0.3}
    return sum(a * tone(f, duration, fs=FS, phase_rad=seed + f) for f, a in strengths.items())


NOISES: dict[str, Noise] = {
    "white": white,
    "band noise": band_noise,
    "wide band noise": lambda duration, seed: band_limited_noise((20, 5000), duration, fs=FS, rng=seed),
    "tone": lambda duration, seed: tone(300.0, duration, fs=FS, phase_rad=float(seed)),
    "four tones": tones,
    "compressor": lambda duration, seed: compressor_noise(duration, fs=FS, rng=seed),
    "bursts": lambda duration, seed: bursty_noise(duration, fs=FS, rng=seed),
    "swelling": lambda duration, seed: swelling(
        band_noise(duration, seed), fs=FS, swing_db=6.0, period_s=4.0, phase_rad=float(seed)
    ),
}


def made_paths() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return primary and secondary taps of the models, by name."""
    duct = duct_paths(fs=FS)
    return {
        "band-pass": (path_taps(bandpass_path(128)), path_taps(bandpass_path(32))),
        "duct": (path_taps(duct.primary), path_taps(duct.secondary)),
    }


def signals(primary: np.ndarray, noise: Noise, seed: int, duration: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return reference, disturbance and standard deviation of the microphone's noise."""
    x = scaled_to_power(noise(duration + ON / FS, seed), 1.0)
    d = np.convolve(x, primary)[: x.size]
    return x, d, SENSOR_NOISE * float(np.sqrt(np.mean(d**2)))


def compare(
    primary: np.ndarray,
    s: np.ndarray,
    noise: Noise,
    *,
    duration: float,
    lengths: Sequence[int],
    factors: Sequence[float],
) -> Comparison:
    """Suggest settings from one run of the noise, and compare them on another with a grid.

    The grid has the given lengths, each with its suggested q and P0, and the given factors of its suggested r. A setting
    with which KF-OPC exceeds the rated power, and the power with the suggested ones, by 2 % is not counted: while the
    level changes, weights that lag behind the factor reduce more noise, with power that they should not take.
    """
    x, d, std = signals(primary, noise, 1, duration)
    silent = x[ON:], d[ON:] + std * np.random.default_rng(5).standard_normal(d.size - ON)
    suggested = suggest_settings(*silent, s, fs=FS, max_taps=max(lengths))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", np.exceptions.RankWarning)
        fixed = wiener_solution(*silent, s, suggested.n_taps, regularization=1e-6)
    x, d, std = signals(primary, noise, 2, duration)
    options: dict[str, Any] = {"disturbance": d, "secondary_path": s, "fs": FS, "switch_on_s": ON / FS}

    rated = RATED_SHARE * fixed.control_power

    def run(n_taps: int, settings: dict[str, float]) -> tuple[np.ndarray, float]:
        free = kf_anc(n_taps, s, **settings)
        constrained = kf_opc(n_taps, s, rated_power=rated, **settings)
        results = simulate_scenarios([free, constrained], x, sensor_noise_std=std, rng=[6, 6], **options)
        merits = [
            (noise_reduction_db(r.error, r.disturbance), -float(np.mean(nse_db(r.error, r.disturbance, FS, 0.05))))
            for r in results
        ]
        return np.array(merits), output_power(results[1].control_signal)

    own, power = run(suggested.n_taps, suggested.settings)
    best = np.full((2, 2), -np.inf)
    for n_taps in lengths:
        at = suggest_settings(*silent, s, fs=FS, n_taps=n_taps)
        for factor in factors:
            merits, used = run(n_taps, dataclasses.replace(at, state_noise=factor * at.state_noise).settings)
            best[0] = np.maximum(best[0], merits[0])
            if used <= 1.02 * max(power, rated):
                best[1] = np.maximum(best[1], merits[1])
    return Comparison(suggested, own, best)


def main() -> None:
    """Print the table of all cases."""
    paths, noises = made_paths(), dict(NOISES)
    try:
        for name, apart_s in (("motor", 5.0), ("compressor", 8.0)):  # the run begins so much later in the recording
            measured = load_measured_duct(name)
            recording = measured.noise - measured.noise.mean()
            noises[f"recorded {name}"] = lambda duration, seed, recording=recording, apart_s=apart_s: looped(
                recording, duration, fs=FS, start_s=apart_s * (seed - 1)
            )
        scale = np.sqrt(np.sum(measured.secondary**2))  # its units are arbitrary
        paths["measured duct"] = measured.primary / scale, measured.secondary / scale
    except DataUnavailableError as error:
        print(f"without the measured duct and the recordings: {error}")
    print("dB by which the best of the grid is better: noise reduction, mean NSE")
    worst = np.zeros((2, 2))
    for path, (primary, s) in paths.items():
        for name, noise in noises.items():
            found = compare(
                primary, s, noise, duration=4.5, lengths=(32, 64, 128, 256), factors=(0.01, 0.1, 1.0, 10.0, 100.0)
            )
            loss = found.best - found.own
            worst = np.maximum(worst, loss)
            taps, reduction = found.suggested.n_taps, found.own[0, 0]
            print(
                f"{path:13} {name:19} {taps:3} taps, KF-ANC reduces by {reduction:5.1f} dB: KF-ANC {loss[0, 0]:5.2f} "
                f"{loss[0, 1]:5.2f}, KF-OPC {loss[1, 0]:5.2f} {loss[1, 1]:5.2f}",
                flush=True,
            )
    print(f"at most: KF-ANC {worst[0, 0]:.2f} {worst[0, 1]:.2f}, KF-OPC {worst[1, 0]:.2f} {worst[1, 1]:.2f}")


if __name__ == "__main__":
    main()
