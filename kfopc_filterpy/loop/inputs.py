"""What a run is given beside the controller and the plant: the disturbance, sensor noise, the time of switching on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import fftconvolve

from .._types import ChangingPaths, Seed
from .._validate import as_channels, as_generator, as_nonnegative, as_number, as_signal
from ..paths.models import path_taps
from ..paths.path_matrix import primary_paths
from .schedule import as_schedule, path_schedule

LARGEST_GAIN_DB = 400.0  # 1e20 is the largest sample that controllers learn from
DIVERGENCE_LIMIT = 1e6  # a run stops if the control signal exceeds this multiple of sqrt(rated power)


def noise_gain(level_db: Any, n_samples: int, fs: float, crossfade_s: float = 0.0) -> np.ndarray:
    """Return the gain of a noise in each sample, from a level in dB that may change."""

    def read(value: Any) -> float:
        level = as_number(value, "noise_level_db", unit="dB")
        if abs(level) > LARGEST_GAIN_DB:
            raise ValueError(f"noise_level_db must be within {LARGEST_GAIN_DB:g} dB of 0 dB, got {level:g} dB")
        return float(10 ** (level / 20))

    gains = as_schedule(level_db, "noise_level_db", read, n_samples, fs, crossfade_s, of_numbers=True)
    total = np.zeros(n_samples)
    for gain, part, share in gains.parts(n_samples):
        total[part] += share * gain
    return total


def disturbance_at_microphone(
    x: np.ndarray,
    primary_path: ChangingPaths | None,
    disturbance: ArrayLike | None,
    fs: float,
    crossfade_s: float = 0.0,
) -> np.ndarray:
    """Return the disturbance d, (n_samples,), as given or as p*x."""
    require_one_source(primary_path, disturbance)
    if disturbance is not None:
        return as_signal(disturbance, "disturbance", length=x.size)

    def read(path: Any) -> np.ndarray:
        return path_taps(path, fs=fs, name="primary_path")

    return _through(x, primary_path, read, np.convolve, fs, crossfade_s)


def channel_disturbances(
    x: np.ndarray,
    primary_path: ChangingPaths | None,
    disturbance: ArrayLike | None,
    fs: float,
    n_microphones: int,
    crossfade_s: float = 0.0,
) -> np.ndarray:
    """Return the disturbances, (K, n_samples), as given or as the sum of p_ki * x_i."""
    require_one_source(primary_path, disturbance)

    def read(paths: Any) -> np.ndarray:
        primary, _ = primary_paths(paths, fs=fs)
        if primary.shape[:2] != (n_microphones, len(x)):
            raise ValueError(
                f"primary_path must be (K microphones, I references, taps) with K = {n_microphones} of secondary_path "
                f"and I = {len(x)} of reference, got {primary.shape}"
            )
        return primary

    def convolve(x: np.ndarray, primary: np.ndarray) -> np.ndarray:
        return np.array([fftconvolve(x, p, axes=-1).sum(axis=0) for p in primary])

    if primary_path is not None:
        return _through(x, primary_path, read, convolve, fs, crossfade_s)
    d = np.atleast_2d(as_channels(disturbance, "disturbance"))
    if d.shape != (n_microphones, x.shape[1]):
        raise ValueError(
            f"disturbance must be (K microphones, n_samples) = {(n_microphones, x.shape[1])}, got {d.shape}"
        )
    return d


def _through(
    x: np.ndarray,
    primary_path: Any,
    read: Callable[[Any], np.ndarray],
    convolve: Callable[[np.ndarray, np.ndarray], np.ndarray],
    fs: float,
    crossfade_s: float,
) -> np.ndarray:
    """Return what comes through paths that may change; sound on its way at a change arrives through the new path."""
    n_samples = x.shape[-1]
    paths = path_schedule(primary_path, "primary_path", read, n_samples, fs, crossfade_s)
    d = np.zeros((*paths.values[0].shape[:-2], n_samples))
    for taps, part, share in paths.parts(n_samples):
        first = max(part.start - taps.shape[-1] + 1, 0)
        heard = convolve(x[..., first : part.stop], taps)
        d[..., part] += share * heard[..., part.start - first : part.stop - first]
    return d


def require_one_source(primary_path: ChangingPaths | None, disturbance: ArrayLike | None) -> None:
    """Raise ValueError unless exactly one of the two is given."""
    if (primary_path is None) == (disturbance is None):
        raise ValueError("give either primary_path= or disturbance=, not both and not neither")


class SensorNoise:
    """White noise, drawn stretch by stretch."""

    def __init__(self, std: float, rng: Seed | None) -> None:
        self.std = as_nonnegative(std, "sensor_noise_std")
        self.rng = as_generator(rng) if self.std > 0 else None

    def take(self, *shape: int) -> np.ndarray | float:
        """Return the next samples in an array of a shape, or 0 if there is no noise."""
        return 0.0 if self.rng is None else self.std * self.rng.standard_normal(shape)

    def filled(self, room: np.ndarray) -> np.ndarray | None:
        """Fill an array with the next samples and return it, or None if there is no noise."""
        if self.rng is None:
            return None
        self.rng.standard_normal(out=room)
        room *= self.std
        return room


def switch_on_sample(switch_on_s: float, fs: float, n_samples: int) -> int:
    """Return the number of samples before the control is switched on."""
    on = round(as_nonnegative(switch_on_s, "switch_on_s", unit="s") * fs)
    if on >= n_samples:
        raise ValueError("switch_on_s must leave samples to control: it covers the whole signal")
    return on


@contextmanager
def naming_sample(n: int) -> Iterator[None]:
    """Add to an error the number of the sample in which it occurred."""
    try:
        yield
    except Exception as error:
        error.add_note(f"in sample {n} of the run")
        raise
