"""Noises that vary, (n_samples,): bursts, a level that jumps or swings, and a recording in a loop."""

from __future__ import annotations

import numpy as np
from scipy.signal import butter, oaconvolve, sosfilt

from kfopc_filterpy._types import Seed
from kfopc_filterpy.signals import scaled_to_power

FADE_S = 0.05  # cross-fade where a recording begins again
# Bursts as of presses or rivets
BURSTS_HZ = 10.0  # in the mean
DECAY_S = 0.012  # time constant of a burst's amplitude
BURST_BAND_HZ = (100.0, 1500.0)
LEVEL_SPREAD_DB = 4.0  # standard deviation of the bursts' levels
BACKGROUND_DB = -20.0  # power of the background over that of the bursts


def bursty_noise(duration_s: float, *, fs: float, rng: Seed) -> np.ndarray:
    """Make impulsive noise of power 1: bursts at the times of a Poisson process that die away, over a steady background.

    Examples
    --------
    >>> from comparisons.bench.noises import bursty_noise
    >>> x = bursty_noise(2.0, fs=16000, rng=1)
    >>> round(float(np.mean(x**2)), 12), bool(np.max(np.abs(x)) > 6.0)  # Gaussian noise stays below 5
    (1.0, True)
    """
    n_samples, generator, decay = round(duration_s * fs), np.random.default_rng(rng), DECAY_S * fs
    count = generator.poisson(BURSTS_HZ * n_samples / fs)
    levels = np.zeros(n_samples)
    times = generator.integers(0, n_samples, count)
    np.add.at(levels, times, 10 ** (LEVEL_SPREAD_DB * generator.standard_normal(count) / 20))
    envelope = oaconvolve(levels, np.exp(-np.arange(round(6 * decay)) / decay))[:n_samples]
    sos = butter(4, BURST_BAND_HZ, "bandpass", fs=fs, output="sos")
    impulsive = sosfilt(sos, np.maximum(envelope, 0.0) * generator.standard_normal(n_samples))
    steady = sosfilt(sos, generator.standard_normal(n_samples))
    background = 10 ** (BACKGROUND_DB / 20)
    return scaled_to_power(scaled_to_power(impulsive, 1.0) + scaled_to_power(steady, 1.0) * background, 1.0)


def level_jump(signal: np.ndarray, at_s: float, gain_db: float, *, fs: float) -> np.ndarray:
    """Return a signal that is louder by `gain_db` from the time `at_s` on."""
    jumped = signal.copy()
    jumped[round(at_s * fs) :] *= 10 ** (gain_db / 20)
    return jumped


def swelling(signal: np.ndarray, *, fs: float, swing_db: float, period_s: float, phase_rad: float = 0.0) -> np.ndarray:
    """Let the level of a signal in dB swing up and down as a sine, and keep its mean power."""
    angle = 2 * np.pi * np.arange(signal.size) / (period_s * fs) + phase_rad
    return scaled_to_power(signal * 10 ** (swing_db * np.sin(angle) / 20), float(np.mean(signal**2)))


def looped(recording: np.ndarray, duration_s: float, *, fs: float, start_s: float = 0.0) -> np.ndarray:
    """Repeat a recording of more than 0.1 s to fill a duration, with a cross-fade of 50 ms where it begins again.

    `start_s` is where in the recording to begin, modulo its length less the cross-fade.
    """
    fade = round(FADE_S * fs)
    # One turn of the loop: the end, faded out, is added to the beginning, faded in.
    turn = recording[:-fade].copy()
    angle = 0.5 * np.pi * (np.arange(fade) + 0.5) / fade
    turn[:fade] = turn[:fade] * np.sin(angle) + recording[-fade:] * np.cos(angle)
    return turn[(round(start_s * fs) + np.arange(round(duration_s * fs))) % turn.size]
