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


# Several channels, at a lower rate and with shorter paths: 2 microphones, 2 loudspeakers, 2 references.

SLOW_FS = 2000.0
N_SHORT = 12


def crossed_paths(delay: int, gain: float, seed: int, n_channels: int = 2) -> np.ndarray:
    """Return paths (n_channels, n_channels, taps) of which those from loudspeaker k to microphone k are the strongest."""
    n = np.arange(N_SHORT)
    ringing = np.where(n < delay, 0.0, 0.7 ** np.abs(n - delay))
    paths = np.random.default_rng(seed).standard_normal((n_channels, n_channels, N_SHORT)) * ringing
    near = 0.3 + 0.7 * np.eye(n_channels)
    return gain * near[..., np.newaxis] * paths / np.linalg.norm(paths, axis=-1, keepdims=True)


def noises_of_several(seconds: float, seed: int = 1, sensor_noise: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Return two references, (2, n), and disturbances, (2, n), of about power 1, with a part that they do not explain."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((2, round(seconds * SLOW_FS)))
    primary = np.concatenate((np.zeros((2, 2, 8)), rng.standard_normal((2, 2, 12)) * 0.75 ** np.arange(12)), axis=2)
    primary /= np.sqrt(np.sum(primary**2, axis=(1, 2), keepdims=True))
    d = np.array([sum(np.convolve(one, p)[: one.size] for one, p in zip(x, row, strict=True)) for row in primary])
    return x, d + sensor_noise * rng.standard_normal(d.shape)


def run_several(
    controller: Any, x: np.ndarray, d: np.ndarray, paths_at: Callable[[float], np.ndarray], limit: float = 1e6
) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (K, n) and control signals (J, n) as `run` does, for `paths_at(t)` of shape (K, J, taps)."""
    K, J, taps = paths_at(0.0).shape
    played, errors, emitted = np.zeros((J, taps)), np.full(d.shape, np.nan), np.full((J, x.shape[1]), np.nan)
    for n in range(x.shape[1]):
        y = controller.control_signal(x[:, n])
        if not np.all(np.abs(y) <= limit):
            break
        played = np.concatenate((y[:, np.newaxis], played[:, :-1]), axis=1)
        errors[:, n], emitted[:, n] = d[:, n] - paths_at(n / SLOW_FS).reshape(K, -1) @ played.reshape(-1), y
        controller.update(errors[:, n])
    return errors, emitted
