"""Noises whose level varies: bursts, swelling noise, and a recording made as long as a study needs."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._validate import as_band, as_count, as_generator, as_nonnegative, as_number, as_positive, as_signal
from .generators import scaled_to_power

_FADE_S = 0.05  # cross-fade where a recording begins again


def bursty_noise(
    duration_s: float,
    *,
    fs: float,
    rng: Any,
    power: float = 1.0,
    rate_hz: float = 10.0,
    decay_s: float = 0.012,
    band: tuple[float, float] = (100.0, 1500.0),
    level_spread_db: float = 4.0,
    background_db: float = -20.0,
) -> np.ndarray:
    """Impulsive noise: bursts that come at random and die away, over a steady background, as of presses or rivets.

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
    rate_hz : float, default 10
        Mean number of bursts a second; they come as a Poisson process.
    decay_s : float, default 0.012
        Time constant of a burst's amplitude in seconds.
    band : (float, float), default (100, 1500)
        Band in Hz of bursts and background (Butterworth, four poles at either edge).
    level_spread_db : float, default 4
        Standard deviation of the bursts' levels in dB.
    background_db : float, default -20
        Power of the background over that of the bursts in dB.

    Returns
    -------
    ndarray, shape (n_samples,)
        The noise.

    Raises
    ------
    ValueError, TypeError
        An argument out of its range, no burst in the duration, or `rng` is None.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.signals import bursty_noise
    >>> x = bursty_noise(2.0, fs=16000, rng=1)
    >>> round(float(np.mean(x**2)), 12), bool(np.max(np.abs(x)) > 6.0)  # Gaussian noise stays below 5
    (1.0, True)
    """
    from scipy.signal import butter, oaconvolve, sosfilt

    fs = as_positive(fs, "fs", unit="Hz")
    n_samples = as_count(round(as_positive(duration_s, "duration_s", unit="s") * fs), "duration_s fs, in samples,")
    low, high = as_band(band, fs)
    spread = as_nonnegative(level_spread_db, "level_spread_db", unit="dB")
    background = 10 ** (as_number(background_db, "background_db", unit="dB") / 20)
    generator = as_generator(rng)
    count = generator.poisson(as_positive(rate_hz, "rate_hz", unit="Hz") * n_samples / fs)
    if count == 0:
        raise ValueError(
            f"no burst fell into duration_s = {duration_s:g} s: take a longer duration or a higher rate_hz"
        )
    decay = as_positive(decay_s, "decay_s", unit="s") * fs
    levels = np.zeros(n_samples)
    np.add.at(levels, generator.integers(0, n_samples, count), 10 ** (spread * generator.standard_normal(count) / 20))
    envelope = oaconvolve(levels, np.exp(-np.arange(max(round(6 * decay), 1)) / decay))[:n_samples]
    sos = butter(4, (max(low, 1e-6 * fs), min(high, 0.499999 * fs)), "bandpass", fs=fs, output="sos")
    bursts = sosfilt(sos, np.maximum(envelope, 0.0) * generator.standard_normal(n_samples))
    steady = sosfilt(sos, generator.standard_normal(n_samples))
    return scaled_to_power(scaled_to_power(bursts, 1.0) + scaled_to_power(steady, 1.0) * background, power)


def swelling(
    signal: Any, *, fs: float, swing_db: float = 6.0, period_s: float = 4.0, phase_rad: float = 0.0
) -> np.ndarray:
    """Copy of a signal whose level in dB swings up and down as a sine, its mean power kept.

    Parameters
    ----------
    signal : array_like, shape (n_samples,)
        The signal, not all zeros.
    fs : float
        Sample rate in Hz.
    swing_db : float, default 6
        Largest deviation of the level to either side in dB.
    period_s : float, default 4
        Period in seconds.
    phase_rad : float, default 0
        Phase at the first sample in radians.

    Returns
    -------
    ndarray, shape (n_samples,)
        The signal with its level swinging.

    Raises
    ------
    ValueError, TypeError
        A silent or bad signal, or an argument out of its range.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.signals import swelling
    >>> y = swelling(np.ones(8), fs=8.0, period_s=1.0, swing_db=20.0)
    >>> round(float(20 * np.log10(y[2] / y[6])), 6)
    40.0
    """
    samples = as_signal(signal, "signal")
    if not samples.any():
        raise ValueError("signal must not be all zeros: silence has no level to swing")
    turn = 2 * np.pi / (as_positive(period_s, "period_s", unit="s") * as_positive(fs, "fs", unit="Hz"))
    level_db = as_nonnegative(swing_db, "swing_db", unit="dB") * np.sin(
        turn * np.arange(samples.size) + as_number(phase_rad, "phase_rad")
    )
    return scaled_to_power(samples * 10 ** (level_db / 20), float(np.mean(samples**2)))


def looped(recording: Any, duration_s: float, *, fs: float, start_s: float = 0.0) -> np.ndarray:
    """A recording from a time on, begun again at its end as often as the duration needs, cross-faded over 50 ms.

    Parameters
    ----------
    recording : array_like, shape (n_samples,)
        The recording, longer than 0.1 s.
    duration_s : float
        Duration wanted in seconds.
    fs : float
        Sample rate in Hz.
    start_s : float, default 0
        Where in the recording to begin, taken modulo its length less the cross-fade.

    Returns
    -------
    ndarray, shape (round(duration_s fs),)
        The signal.

    Raises
    ------
    ValueError, TypeError
        A recording too short for the cross-fade, or an argument out of its range.

    Examples
    --------
    >>> from kfopc_filterpy.signals import looped
    >>> looped([1.0] * 100, 1.0, fs=500.0).size  # 0.2 s made 1 s
    500
    """
    fs = as_positive(fs, "fs", unit="Hz")
    samples = as_signal(recording, "recording")
    n_samples = as_count(round(as_positive(duration_s, "duration_s", unit="s") * fs), "duration_s fs, in samples,")
    fade = max(round(_FADE_S * fs), 1)
    if samples.size <= 2 * fade:
        raise ValueError(
            f"recording must be longer than {2 * fade / fs:g} s, two cross-fades, got {samples.size / fs:g} s"
        )
    # The end, faded out, lies over the beginning, faded in: one turn of the loop.
    turn = samples[: samples.size - fade].copy()
    angle = 0.5 * np.pi * (np.arange(fade) + 0.5) / fade
    turn[:fade] = turn[:fade] * np.sin(angle) + samples[-fade:] * np.cos(angle)
    first = round(as_nonnegative(start_s, "start_s", unit="s") * fs) % turn.size
    return np.resize(np.roll(turn, -first), n_samples)
