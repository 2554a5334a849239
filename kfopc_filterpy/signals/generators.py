"""Seeded primary noises: tone, band-limited noise, compressor-like machine noise, level jumps.

Every generator returns a float64 array (n_samples,) with n_samples = round(duration_s * fs) >= 1, and takes
its randomness from `rng` only (a seed or a numpy.random.Generator), so that the same call gives the same
samples. Power is the mean square over the whole signal.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .._validate import (
    as_band,
    as_count,
    as_generator,
    as_nonnegative,
    as_number,
    as_positive,
    as_signal,
)

__all__ = ["band_limited_noise", "compressor_noise", "level_jump", "scaled_to_power", "tone"]

# The compressor's spectral envelope: a small shell radiates poorly below its peak, and forces fall above it.
_ENVELOPE_PEAK_HZ = 250.0
# Pocket-passing (lobe) lines stand 10 dB out of the other harmonics, whose levels spread by 3 dB.
_LOBE_GAIN_DB = 10.0
_LINE_SPREAD_DB = 3.0
# Load and speed of a machine wander over about half a second.
_FLUCTUATION_TIME_S = 0.5
_BROADBAND_FROM_HZ = 20.0


def tone(
    frequency_hz: float, duration_s: float, *, fs: float, amplitude: float = 1.0, phase_rad: float = 0.0
) -> np.ndarray:
    """Sine of one frequency, the primary noise of the paper's tonal study.

    Parameters
    ----------
    frequency_hz : float
        Frequency in Hz, above 0 and below fs/2.
    duration_s : float
        Duration in seconds, at least one sample.
    fs : float
        Sampling frequency in Hz.
    amplitude : float, default 1.0
        Peak value; the power is amplitude**2 / 2, so sqrt(2 * power) gives a wanted power.
    phase_rad : float, default 0.0
        Phase at the first sample: amplitude * sin(2 pi f n / fs + phase).

    Returns
    -------
    ndarray, shape (n_samples,)
        The tone.

    Raises
    ------
    ValueError, TypeError
        Where an argument is not a number in its range.

    Examples
    --------
    >>> import numpy as np
    >>> x = tone(400.0, 1.0, fs=16000, amplitude=np.sqrt(2.0))
    >>> x.shape, round(float(np.mean(x**2)), 12)
    ((16000,), 1.0)
    """
    n_samples = _sample_count(duration_s, fs)
    frequency = as_positive(frequency_hz, "frequency_hz", unit="Hz")
    if frequency >= fs / 2:
        raise ValueError(f"frequency_hz must be below fs/2 = {fs / 2:g} Hz, got {frequency:g} Hz; raise fs or lower it")
    peak = as_nonnegative(amplitude, "amplitude")
    phase = as_number(phase_rad, "phase_rad", unit="rad")
    return peak * np.sin(2 * np.pi * frequency / fs * np.arange(n_samples) + phase)


def band_limited_noise(
    band: tuple[float, float], duration_s: float, *, fs: float, power: float = 1.0, rng: Any
) -> np.ndarray:
    """Gaussian noise with a flat spectrum inside `band` and none outside, the paper's broadband noise.

    White Gaussian noise whose discrete Fourier bins outside the band are set to zero: the edges are as sharp
    as the duration allows (1 / duration_s in Hz). The samples are scaled to `power` exactly, so that runs
    with different seeds are equally loud.

    Parameters
    ----------
    band : (float, float)
        Lowest and highest frequency in Hz, 0 <= low < high <= fs/2.
    duration_s : float
        Duration in seconds; at least 1 / (high - low), or no Fourier bin may fall inside the band.
    fs : float
        Sampling frequency in Hz.
    power : float, default 1.0
        Mean square of the signal.
    rng : int or numpy.random.Generator
        Seed or generator. A longer duration with the same seed is another signal, not a continuation.

    Returns
    -------
    ndarray, shape (n_samples,)
        The noise.

    Raises
    ------
    ValueError, TypeError
        Where an argument is not in its range, no Fourier bin falls inside the band, or `rng` is None.

    Examples
    --------
    >>> import numpy as np
    >>> x = band_limited_noise((200.0, 2000.0), 1.0, fs=16000, power=0.5, rng=1)
    >>> round(float(np.mean(x**2)), 12)
    0.5
    """
    n_samples = _sample_count(duration_s, fs)
    low, high = as_band(band, fs)

    def inside(frequencies: np.ndarray) -> np.ndarray:
        return ((frequencies >= low) & (frequencies <= high)).astype(float)

    shaped = _shaped_noise(inside, n_samples, fs, as_generator(rng))
    if not np.any(shaped):
        raise ValueError(
            f"duration_s = {duration_s:g} s is too short for the band {low:g} to {high:g} Hz: "
            f"take at least {1 / (high - low):g} s"
        )
    return scaled_to_power(shaped, power)


def compressor_noise(
    duration_s: float,
    *,
    fs: float,
    rng: Any,
    power: float = 1.0,
    shaft_hz: float = 24.5,
    n_harmonics: int = 40,
    lobe_count: int = 4,
    speed_fluctuation: float = 0.003,
    level_fluctuation: float = 0.1,
    broadband_ratio: float = 0.1,
    bandwidth_hz: float = 2000.0,
) -> np.ndarray:
    """Compressor-like noise: harmonics of a slowly wandering shaft speed, and broadband flow noise.

    The built-in stand-in for a recorded compressor. Line k lies at k times the shaft's frequency; all lines
    follow the same speed, each has a level of its own that wanders. Lines and broadband share a spectral
    envelope that peaks at 250 Hz and falls by 6 dB per octave to both sides; every `lobe_count`-th line
    stands 10 dB higher, as pocket-passing lines do; single lines differ by 3 dB (standard deviation). Speed
    and levels wander as first-order Gauss-Markov processes with a time constant of 0.5 s.

    Parameters
    ----------
    duration_s : float
        Duration in seconds.
    fs : float
        Sampling frequency in Hz.
    rng : int or numpy.random.Generator
        Seed or generator.
    power : float, default 1.0
        Mean square of the signal, met exactly.
    shaft_hz : float, default 24.5
        Mean shaft frequency: a four-pole induction motor on 50 Hz with 2 % slip.
    n_harmonics : int, default 40
        Number of shaft harmonics; all must stay below fs/2.
    lobe_count : int, default 4
        Lobes or vanes on the shaft: multiples of lobe_count * shaft_hz stand out. 1 treats all lines alike.
    speed_fluctuation : float, default 0.003
        Standard deviation of the speed, relative to its mean. 0 gives a constant speed.
    level_fluctuation : float, default 0.1
        Standard deviation of each line's log amplitude (0.1 is about 0.9 dB). 0 gives constant levels.
    broadband_ratio : float, default 0.1
        Share of the power that is broadband, from 0 up to but not including 1.
    bandwidth_hz : float, default 2000.0
        Upper edge of the broadband part in Hz, at most fs/2; its lower edge is 20 Hz.

    Returns
    -------
    ndarray, shape (n_samples,)
        The noise.

    Raises
    ------
    ValueError, TypeError
        Where an argument is not in its range, a harmonic would alias, the duration is too short for the
        broadband part, or `rng` is None.

    Examples
    --------
    >>> import numpy as np
    >>> x = compressor_noise(2.0, fs=16000, rng=1)
    >>> x.shape, round(float(np.mean(x**2)), 12)
    ((32000,), 1.0)
    """
    n_samples = _sample_count(duration_s, fs)
    generator = as_generator(rng)
    lobes = as_count(lobe_count, "lobe_count")
    level_std = as_nonnegative(level_fluctuation, "level_fluctuation")
    share = as_nonnegative(broadband_ratio, "broadband_ratio")
    if share >= 1:
        raise ValueError(
            f"broadband_ratio must be below 1, got {share:g}; band_limited_noise makes noise without lines"
        )
    upper = as_positive(bandwidth_hz, "bandwidth_hz", unit="Hz")
    if not _BROADBAND_FROM_HZ < upper <= fs / 2:
        raise ValueError(
            f"bandwidth_hz must be above {_BROADBAND_FROM_HZ:g} Hz and at most fs/2 = {fs / 2:g} Hz, got {upper:g} Hz"
        )

    orders = np.arange(1, as_count(n_harmonics, "n_harmonics") + 1)
    shaft = as_positive(shaft_hz, "shaft_hz", unit="Hz")
    speed_std = as_nonnegative(speed_fluctuation, "speed_fluctuation")
    # Five standard deviations: a Gaussian speed goes beyond that once in two million correlation times.
    highest = orders[-1] * shaft * (1 + 5 * speed_std)
    if highest >= fs / 2:
        raise ValueError(
            f"n_harmonics = {orders[-1]} lines of shaft_hz = {shaft:g} Hz reach {highest:g} Hz with the "
            f"speed's fluctuation, beyond fs/2 = {fs / 2:g} Hz; lower n_harmonics or raise fs"
        )

    levels = _line_amplitudes(orders, shaft, lobes, generator)
    speed = shaft * (1 + speed_std * _slow_process(n_samples, fs, generator))
    lines = _modulated_lines(orders, levels, speed, level_std, fs, generator)
    signal = scaled_to_power(lines, 1 - share)
    if share > 0:
        signal = signal + scaled_to_power(_broadband(upper, n_samples, fs, generator), share)
    return scaled_to_power(signal, power)


def level_jump(signal: Any, at_s: float, gain_db: float, *, fs: float) -> np.ndarray:
    """Copy of `signal` that is `gain_db` louder (or softer) from the time `at_s` on.

    Parameters
    ----------
    signal : array_like, shape (n_samples,)
        The signal.
    at_s : float
        Time of the jump in seconds, within the signal; the sample round(at_s * fs) is the first changed.
    gain_db : float
        Change of level in dB: 6.02 doubles the amplitude.
    fs : float
        Sampling frequency in Hz.

    Returns
    -------
    ndarray, shape (n_samples,)
        The signal with the jump; the input is left as it is.

    Raises
    ------
    ValueError, TypeError
        Where the jump lies outside the signal, or an argument is not in its range.

    Examples
    --------
    >>> level_jump([1.0, 1.0, 1.0, 1.0], 0.5, 20.0, fs=4).tolist()
    [1.0, 1.0, 10.0, 10.0]
    """
    jumped = as_signal(signal, "signal").copy()
    rate = as_positive(fs, "fs", unit="Hz")
    first = round(as_nonnegative(at_s, "at_s", unit="s") * rate)
    if first >= jumped.size:
        raise ValueError(
            f"at_s must lie within the signal of {jumped.size / rate:g} s, got {at_s:g} s; make the signal longer"
        )
    jumped[first:] *= 10 ** (as_number(gain_db, "gain_db", unit="dB") / 20)
    return jumped


def scaled_to_power(signal: Any, power: float) -> np.ndarray:
    """Copy of `signal` scaled so that its mean square is `power`.

    Parameters
    ----------
    signal : array_like, shape (n_samples,)
        The signal, not all zeros.
    power : float
        Wanted mean square, above 0.

    Returns
    -------
    ndarray, shape (n_samples,)
        The scaled signal.

    Raises
    ------
    ValueError, TypeError
        Where the signal is silent or not finite, or the power is not above 0.

    Examples
    --------
    >>> scaled_to_power([3.0, -4.0], 50.0).tolist()
    [6.0, -8.0]
    """
    samples = as_signal(signal, "signal")
    wanted = as_positive(power, "power")
    peak = np.max(np.abs(samples))
    if peak == 0:
        raise ValueError("signal must not be all zeros: no scale gives silence a power")
    # Dividing by the peak first keeps the squares of very small or large samples within range.
    unit = samples / peak
    return unit * np.sqrt(wanted / np.mean(unit**2))


def _sample_count(duration_s: float, fs: float) -> int:
    """Number of samples in `duration_s`, at least one."""
    rate = as_positive(fs, "fs", unit="Hz")
    duration = as_positive(duration_s, "duration_s", unit="s")
    n_samples = round(duration * rate)
    if n_samples < 1:
        raise ValueError(f"duration_s must be at least one sample, {1 / rate:g} s, got {duration:g} s")
    return n_samples


def _shaped_noise(gain: Any, n_samples: int, fs: float, generator: np.random.Generator) -> np.ndarray:
    """White Gaussian noise whose Fourier bins are multiplied by gain(frequencies in Hz)."""
    spectrum = np.fft.rfft(generator.standard_normal(n_samples))
    return np.fft.irfft(spectrum * gain(np.fft.rfftfreq(n_samples, 1 / fs)), n_samples)


def _envelope(frequencies: np.ndarray) -> np.ndarray:
    """Amplitude envelope of the compressor: 1 at its peak, falling by 6 dB per octave to both sides."""
    relative = frequencies / _ENVELOPE_PEAK_HZ
    return 2 * relative / (1 + relative**2)


def _line_amplitudes(orders: np.ndarray, shaft: float, lobes: int, generator: np.random.Generator) -> np.ndarray:
    """Mean amplitude of each shaft harmonic."""
    gain_db = _LOBE_GAIN_DB * (orders % lobes == 0) + _LINE_SPREAD_DB * generator.standard_normal(orders.size)
    return _envelope(orders * shaft) * 10 ** (gain_db / 20)


def _modulated_lines(
    orders: np.ndarray,
    amplitudes: np.ndarray,
    speed: np.ndarray,
    level_std: float,
    fs: float,
    generator: np.random.Generator,
) -> np.ndarray:
    """Sum of the lines at `orders` times the momentary `speed` in Hz, each with a wandering level."""
    shaft_phase = 2 * np.pi / fs * np.cumsum(speed)
    start = generator.uniform(0, 2 * np.pi, orders.size)
    total = np.zeros(speed.size)
    for order, amplitude, phase in zip(orders, amplitudes, start, strict=True):
        level = np.exp(level_std * _slow_process(speed.size, fs, generator))
        total += amplitude * level * np.sin(order * shaft_phase + phase)
    return total


def _slow_process(n_samples: int, fs: float, generator: np.random.Generator) -> np.ndarray:
    """Stationary first-order Gauss-Markov process of unit variance, time constant 0.5 s."""
    from scipy.signal import lfilter

    pole = np.exp(-1 / (_FLUCTUATION_TIME_S * fs))
    white = generator.standard_normal(n_samples)
    # The state before the first sample is drawn from the stationary distribution: no run-in.
    state = pole * generator.standard_normal(1)
    return lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], white, zi=state)[0]


def _broadband(upper: float, n_samples: int, fs: float, generator: np.random.Generator) -> np.ndarray:
    """Noise from 20 Hz to `upper` with the compressor's envelope."""

    def gain(frequencies: np.ndarray) -> np.ndarray:
        return _envelope(frequencies) * ((frequencies >= _BROADBAND_FROM_HZ) & (frequencies <= upper))

    noise = _shaped_noise(gain, n_samples, fs, generator)
    if not np.any(noise):
        raise ValueError(
            f"duration_s = {n_samples / fs:g} s is too short for the broadband part, "
            f"{_BROADBAND_FROM_HZ:g} to {upper:g} Hz: take at least {1 / (upper - _BROADBAND_FROM_HZ):g} s"
        )
    return noise
