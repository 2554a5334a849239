"""Seeded primary noises: tone, band-limited noise, compressor-like machine noise.

Every generator returns one channel, a float64 array (n_samples,) with n_samples = round(duration_s * fs) >= 1, and
draws its randomness only from `rng` (a seed or a numpy.random.Generator), so that the same call gives the same samples.
Power is the mean square over the whole signal. For several channels, stack calls with different seeds.
"""

from __future__ import annotations

import numpy as np

from .._types import Seed
from .._validate import as_band, as_generator, as_nonnegative, as_number, as_positive, as_sample_count
from .shaping import scaled_to_power

# The compressor's spectral envelope: a small shell radiates poorly below its peak, and forces fall above it.
_ENVELOPE_PEAK_HZ = 250.0
# Pocket-passing (lobe) lines stand 10 dB out of the other harmonics, whose levels spread by 3 dB.
_LOBE_GAIN_DB = 10.0
_LINE_SPREAD_DB = 3.0
# Load and speed of a machine wander over about half a second.
_FLUCTUATION_TIME_S = 0.5
_SPEED_FLUCTUATION, _LEVEL_FLUCTUATION = 0.003, 0.1  # standard deviations: of the speed, and of each log amplitude
_N_HARMONICS, _LOBES = 40, 4  # multiples of the number of lobes stand out
_BROADBAND_SHARE, _BROADBAND_FROM_HZ = 0.1, 20.0


def tone(
    frequency_hz: float, duration_s: float, *, fs: float, amplitude: float = 1.0, phase_rad: float = 0.0
) -> np.ndarray:
    """Make a sine of one frequency, the primary noise of the paper's tonal study.

    Parameters
    ----------
    frequency_hz : float
        Frequency in Hz, above 0 and below fs/2.
    duration_s : float
        Duration in seconds, at least one sample.
    fs : float
        Sampling frequency in Hz.
    amplitude : float, default 1.0
        Peak value. The power is amplitude**2 / 2; for a given power, pass sqrt(2 * power).
    phase_rad : float, default 0.0
        Phase at the first sample: amplitude * sin(2 pi f n / fs + phase).

    Returns
    -------
    ndarray, shape (n_samples,)
        The tone.

    Raises
    ------
    ValueError, TypeError
        If an argument is not a number in its range.

    Examples
    --------
    >>> import numpy as np
    >>> x = tone(400.0, 1.0, fs=16000, amplitude=np.sqrt(2.0))
    >>> x.shape, round(float(np.mean(x**2)), 12)
    ((16000,), 1.0)
    """
    n_samples = as_sample_count(duration_s, fs, "duration_s")
    frequency = as_positive(frequency_hz, "frequency_hz", unit="Hz")
    if frequency >= fs / 2:
        raise ValueError(f"frequency_hz must be below fs/2 = {fs / 2:g} Hz, got {frequency:g} Hz; raise fs or lower it")
    peak = as_nonnegative(amplitude, "amplitude")
    phase = as_number(phase_rad, "phase_rad", unit="rad")
    return peak * np.sin(2 * np.pi * frequency / fs * np.arange(n_samples) + phase)


def band_limited_noise(
    band: tuple[float, float], duration_s: float, *, fs: float, power: float = 1.0, rng: Seed
) -> np.ndarray:
    """Make Gaussian noise with a flat spectrum inside `band` and none outside, the paper's broadband noise.

    The discrete Fourier bins of white Gaussian noise outside the band are set to zero, so the edges are as sharp as the
    duration allows (1 / duration_s in Hz). The samples are scaled to `power` exactly, so that runs with different seeds
    are equally loud.

    Parameters
    ----------
    band : (float, float)
        Lowest and highest frequency in Hz, 0 <= low < high <= fs/2.
    duration_s : float
        Duration in seconds; below 1 / (high - low) there may be no Fourier bin inside the band.
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
        If an argument is not in its range, no Fourier bin falls inside the band, or `rng` is None.

    Examples
    --------
    >>> import numpy as np
    >>> x = band_limited_noise((200.0, 2000.0), 1.0, fs=16000, power=0.5, rng=1)
    >>> round(float(np.mean(x**2)), 12)
    0.5
    """
    n_samples = as_sample_count(duration_s, fs, "duration_s")
    low, high = as_band(band, fs)

    frequencies = np.fft.rfftfreq(n_samples, 1 / fs)
    shaped = _shaped_noise((frequencies >= low) & (frequencies <= high), n_samples, as_generator(rng))
    if not np.any(shaped):
        raise ValueError(
            f"duration_s = {duration_s:g} s is too short for the band {low:g} to {high:g} Hz: "
            f"take at least {1 / (high - low):g} s"
        )
    return scaled_to_power(shaped, power)


def compressor_noise(
    duration_s: float, *, fs: float, rng: Seed, power: float = 1.0, shaft_hz: float = 24.5, bandwidth_hz: float = 2000.0
) -> np.ndarray:
    """Make compressor-like noise: harmonics of a slowly wandering shaft speed, and broadband flow noise.

    This is the built-in stand-in for a recorded compressor. Each of 40 lines lies at a multiple of the shaft's
    frequency; all follow the same speed, and each has a level of its own that wanders. A tenth of the power is
    broadband, from 20 Hz. Lines and broadband share a spectral envelope that peaks at 250 Hz and falls by 6 dB per
    octave to both sides. Every fourth line stands 10 dB higher, as pocket-passing lines do; single lines differ by 3 dB
    (standard deviation). The speed wanders by 0.3 % and the levels by 0.9 dB, as first-order Gauss-Markov processes with
    a time constant of 0.5 s.

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
        Mean shaft frequency: by default that of a four-pole induction motor on 50 Hz with 2 % slip.
    bandwidth_hz : float, default 2000.0
        Upper edge of the broadband part in Hz, at most fs/2.

    Returns
    -------
    ndarray, shape (n_samples,)
        The noise.

    Raises
    ------
    ValueError, TypeError
        If an argument is not in its range, a harmonic would alias, the duration is too short for the broadband part,
        or `rng` is None.

    Examples
    --------
    >>> import numpy as np
    >>> x = compressor_noise(2.0, shaft_hz=25.0, fs=16000, rng=1)
    >>> x.shape, round(float(np.mean(x**2)), 12)
    ((32000,), 1.0)
    """
    n_samples = as_sample_count(duration_s, fs, "duration_s")
    generator = as_generator(rng)
    shaft, upper = as_positive(shaft_hz, "shaft_hz", unit="Hz"), as_positive(bandwidth_hz, "bandwidth_hz", unit="Hz")
    if not _BROADBAND_FROM_HZ < upper <= fs / 2:
        bounds = f"above {_BROADBAND_FROM_HZ:g} Hz and at most fs/2 = {fs / 2:g} Hz"
        raise ValueError(f"bandwidth_hz must be {bounds}, got {upper:g} Hz")
    # Five standard deviations: a Gaussian speed exceeds them once in two million correlation times.
    highest = _N_HARMONICS * shaft * (1 + 5 * _SPEED_FLUCTUATION)
    if highest >= fs / 2:
        raise ValueError(
            f"{_N_HARMONICS} lines of shaft_hz = {shaft:g} Hz reach {highest:g} Hz with the speed's fluctuation, beyond "
            f"fs/2 = {fs / 2:g} Hz; lower shaft_hz or raise fs"
        )
    lines = scaled_to_power(_lines(shaft, n_samples, fs, generator), 1 - _BROADBAND_SHARE)
    broadband = scaled_to_power(_broadband(upper, n_samples, fs, generator), _BROADBAND_SHARE)
    return scaled_to_power(lines + broadband, power)


def _shaped_noise(gains: np.ndarray, n_samples: int, generator: np.random.Generator) -> np.ndarray:
    """Return white Gaussian noise whose Fourier bins are multiplied by these gains."""
    return np.fft.irfft(np.fft.rfft(generator.standard_normal(n_samples)) * gains, n_samples)


def _envelope(frequencies: np.ndarray) -> np.ndarray:
    """Return the amplitude envelope of the compressor: 1 at its peak, falling by 6 dB per octave to both sides."""
    relative = frequencies / _ENVELOPE_PEAK_HZ
    return 2 * relative / (1 + relative**2)


def _lines(shaft_hz: float, n_samples: int, fs: float, generator: np.random.Generator) -> np.ndarray:
    """Return the sum of the lines at the orders of the momentary speed, each with a wandering level."""
    orders = np.arange(1, _N_HARMONICS + 1)
    gain_db = _LOBE_GAIN_DB * (orders % _LOBES == 0)
    gain_db = gain_db + _LINE_SPREAD_DB * generator.standard_normal(orders.size)
    amplitudes = _envelope(orders * shaft_hz) * 10 ** (gain_db / 20)
    speed = shaft_hz * (1 + _SPEED_FLUCTUATION * _slow_process(n_samples, fs, generator))
    shaft_phase = 2 * np.pi / fs * np.cumsum(speed)
    start = generator.uniform(0, 2 * np.pi, orders.size)
    total = np.zeros(n_samples)
    for order, amplitude, phase in zip(orders, amplitudes, start, strict=True):
        level = np.exp(_LEVEL_FLUCTUATION * _slow_process(n_samples, fs, generator))
        total += amplitude * level * np.sin(order * shaft_phase + phase)
    return total


def _slow_process(n_samples: int, fs: float, generator: np.random.Generator) -> np.ndarray:
    """Return a stationary first-order Gauss-Markov process of unit variance, with a time constant of 0.5 s."""
    from scipy.signal import lfilter

    pole = np.exp(-1 / (_FLUCTUATION_TIME_S * fs))
    white = generator.standard_normal(n_samples)
    # The state before the first sample is drawn from the stationary distribution: no run-in.
    state = pole * generator.standard_normal(1)
    return lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], white, zi=state)[0]


def _broadband(upper: float, n_samples: int, fs: float, generator: np.random.Generator) -> np.ndarray:
    """Return noise from 20 Hz to `upper` with the compressor's envelope."""
    frequencies = np.fft.rfftfreq(n_samples, 1 / fs)
    inside = (frequencies >= _BROADBAND_FROM_HZ) & (frequencies <= upper)
    noise = _shaped_noise(_envelope(frequencies) * inside, n_samples, generator)
    if not np.any(noise):
        raise ValueError(
            f"duration_s = {n_samples / fs:g} s is too short for the broadband part, "
            f"{_BROADBAND_FROM_HZ:g} to {upper:g} Hz: take at least {1 / (upper - _BROADBAND_FROM_HZ):g} s"
        )
    return noise
