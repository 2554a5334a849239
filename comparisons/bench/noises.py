"""Noises that vary: bursts, a level that jumps or swings, and a recording in a loop.

Signals are (n_samples,) or (n_channels, n_samples), and all channels are changed alike.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import butter, oaconvolve, sosfilt

from kfopc_filterpy._types import Seed
from kfopc_filterpy._validate import as_band, as_channels, as_generator, as_nonnegative, as_sample_count
from kfopc_filterpy.signals import scaled_to_power

FADE_S = 0.05  # cross-fade where a recording begins again


def bursty_noise(
    duration_s: float,
    *,
    fs: float,
    rng: Seed,
    power: float = 1.0,
    rate_hz: float = 10.0,
    decay_s: float = 0.012,
    band: tuple[float, float] = (100.0, 1500.0),
    level_spread_db: float = 4.0,
    background_db: float = -20.0,
) -> np.ndarray:
    """Make impulsive noise, as of presses or rivets: bursts at random times that die away, over a steady background.

    Parameters
    ----------
    duration_s : float
        Duration in seconds.
    fs : float
        Sample rate in Hz.
    rng : int or numpy.random.Generator
        Seed or generator.
    power : float, default 1.0
        Mean square of the signal, met exactly.
    rate_hz : float, default 10.0
        Mean number of bursts per second; they come as a Poisson process.
    decay_s : float, default 0.012
        Time constant of a burst's amplitude in seconds.
    band : (float, float), default (100.0, 1500.0)
        Band in Hz of bursts and background (Butterworth, four poles at either edge).
    level_spread_db : float, default 4.0
        Standard deviation of the bursts' levels in dB.
    background_db : float, default -20.0
        Power of the background over that of the bursts in dB.

    Returns
    -------
    ndarray, shape (n_samples,)
        The noise.

    Raises
    ------
    ValueError
        If no burst falls into the duration, or the band does not lie below fs/2.

    Examples
    --------
    >>> from comparisons.bench.noises import bursty_noise
    >>> x = bursty_noise(2.0, fs=16000, rng=1)
    >>> round(float(np.mean(x**2)), 12), bool(np.max(np.abs(x)) > 6.0)  # Gaussian noise stays below 5
    (1.0, True)
    """
    n_samples, generator = as_sample_count(duration_s, fs, "duration_s"), as_generator(rng)
    low, high = as_band(band, fs)
    count = generator.poisson(rate_hz * n_samples / fs)
    if count == 0:
        raise ValueError(
            f"no burst fell into duration_s = {duration_s:g} s: take a longer duration or a higher rate_hz"
        )
    decay = decay_s * fs
    levels = np.zeros(n_samples)
    times = generator.integers(0, n_samples, count)
    np.add.at(levels, times, 10 ** (level_spread_db * generator.standard_normal(count) / 20))
    envelope = oaconvolve(levels, np.exp(-np.arange(max(round(6 * decay), 1)) / decay))[:n_samples]
    sos = butter(4, (max(low, 1e-6 * fs), min(high, 0.499999 * fs)), "bandpass", fs=fs, output="sos")
    impulsive = sosfilt(sos, np.maximum(envelope, 0.0) * generator.standard_normal(n_samples))
    steady = sosfilt(sos, generator.standard_normal(n_samples))
    background = 10 ** (background_db / 20)
    return scaled_to_power(scaled_to_power(impulsive, 1.0) + scaled_to_power(steady, 1.0) * background, power)


def level_jump(signal: ArrayLike, at_s: float, gain_db: float, *, fs: float) -> np.ndarray:
    """Return a signal that is louder by `gain_db` from the time `at_s` on."""
    jumped = as_channels(signal, "signal").copy()
    first = round(as_nonnegative(at_s, "at_s", unit="s") * fs)
    if first >= jumped.shape[-1]:
        raise ValueError(f"at_s must lie within the signal of {jumped.shape[-1] / fs:g} s, got {at_s:g} s")
    jumped[..., first:] *= 10 ** (gain_db / 20)
    return jumped


def swelling(signal: ArrayLike, *, fs: float, swing_db: float, period_s: float, phase_rad: float = 0.0) -> np.ndarray:
    """Let the level of a signal in dB swing up and down as a sine, and keep its mean power."""
    samples = as_channels(signal, "signal")
    angle = 2 * np.pi * np.arange(samples.shape[-1]) / (period_s * fs) + phase_rad
    return scaled_to_power(samples * 10 ** (swing_db * np.sin(angle) / 20), float(np.mean(samples**2)))


def looped(recording: ArrayLike, duration_s: float, *, fs: float, start_s: float = 0.0) -> np.ndarray:
    """Repeat a recording to fill a duration, with a cross-fade of 50 ms where it begins again.

    `start_s` is where in the recording to begin, modulo its length less the cross-fade.
    """
    samples, n_samples = as_channels(recording, "recording"), as_sample_count(duration_s, fs, "duration_s")
    fade = max(round(FADE_S * fs), 1)
    if samples.shape[-1] <= 2 * fade:
        raise ValueError(
            f"recording must be longer than {2 * fade / fs:g} s, two cross-fades, got {samples.shape[-1] / fs:g} s"
        )
    # One turn of the loop: the end, faded out, is added to the beginning, faded in.
    turn = samples[..., :-fade].copy()
    angle = 0.5 * np.pi * (np.arange(fade) + 0.5) / fade
    turn[..., :fade] = turn[..., :fade] * np.sin(angle) + samples[..., -fade:] * np.cos(angle)
    first = round(as_nonnegative(start_s, "start_s", unit="s") * fs)
    return turn[..., (first + np.arange(n_samples)) % turn.shape[-1]]
