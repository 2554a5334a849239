"""A plant whose secondary path changes during the run, written out sample by sample."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

FS = 8000.0
N_PATH = 32


def resonant_path(delay: float, frequency_hz: float, decay: float, gain: float) -> np.ndarray:
    """Return a delay, of whole samples or not, followed by a resonance; `gain` is the root of its energy."""
    n = np.arange(N_PATH)
    arrival = (
        np.sinc(n - delay) * np.clip(0.5 + 0.5 * np.cos(np.pi * (n - delay) / 6), 0.0, None) * (abs(n - delay) < 6)
    )
    ringing = decay**n * np.cos(2 * np.pi * frequency_hz / FS * n)
    path = np.convolve(arrival, ringing)[:N_PATH]
    return gain * path / np.linalg.norm(path)


def noises(seconds: float, seed: int = 1, sensor_noise: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Return a reference, noise of 100 to 1500 Hz of power 1, and a disturbance with a part that it does not explain."""
    from scipy.signal import butter, sosfilt

    rng = np.random.default_rng(seed)
    band = butter(2, (100.0, 1500.0), "bandpass", fs=FS, output="sos")
    x = sosfilt(band, rng.standard_normal(round(seconds * FS)))
    x /= x.std()
    return x, np.convolve(x, primary_path())[: x.size] + sensor_noise * rng.standard_normal(x.size)


def primary_path() -> np.ndarray:
    """Return a primary path of power gain 1, later than the secondary paths."""
    n = np.arange(34)
    path = np.concatenate((np.zeros(14), 0.9**n * np.cos(0.5 * n)))
    return path / np.linalg.norm(path)


def run(
    controller: Any, x: np.ndarray, d: np.ndarray, path_at: Callable[[float], np.ndarray], limit: float = 1e6
) -> tuple[np.ndarray, np.ndarray]:
    """Return error and control signal of a run in which the path at t seconds is `path_at(t)`; NaN once it diverged."""
    played, error, emitted = np.zeros(N_PATH), np.full(x.size, np.nan), np.full(x.size, np.nan)
    for n in range(x.size):
        y = controller.control_signal(float(x[n]))
        if not abs(y) <= limit:
            break
        played = np.concatenate(([y], played[:-1]))
        error[n], emitted[n] = d[n] - path_at(n / FS) @ played, y
        controller.update(float(error[n]))
    return error, emitted


def reduction_db(error: np.ndarray, d: np.ndarray, begin_s: float, end_s: float) -> float:
    """Return the noise reduction between two times, in dB; NaN after a divergence."""
    part = slice(round(begin_s * FS), round(end_s * FS))
    return float(-10 * np.log10(np.mean(error[part] ** 2) / np.mean(d[part] ** 2)))
