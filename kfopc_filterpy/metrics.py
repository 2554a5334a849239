"""Figures of merit of a run: noise reduction, powers, saturation, convergence, harmonics, coherence, spectra.

These rules hold for every function here:

- A signal is (n_samples,), or (n_channels, n_samples). Error, disturbance and anti-noise have one channel per
  microphone, the control signal has one per loudspeaker.
- `nse_db`, `noise_reduction_db`, `convergence_time_s` and `harmonics_db` rate all microphones together: energies are
  summed over the microphones before the ratio is taken. The other figures come back one per channel, or as a single
  figure if the signal came without a channel axis.
- ``runs=True`` says that the leading axis counts runs of one experiment, for example with different seeds:
  (n_runs, n_samples) or (n_runs, n_channels, n_samples). Powers are then averaged over the runs before any ratio or
  logarithm is taken; peaks are the highest of all runs. A leading axis never means runs by itself.
- Power is the mean square. `steady` is the portion of the run, counted from its end, that a figure looks at:
  by default 0.5, the steady second half; 1.0 is the whole run.
- A diverged run ends in NaN. A figure that looks at NaN samples is NaN, without a warning.
- If the disturbance has no power, a ratio to it is undefined: NaN. A residual of exactly zero is -inf dB.
- Every function raises ValueError for an empty signal, Inf, shapes that differ or have the wrong number of axes, and
  settings out of range; TypeError for values that are not real numbers. The message names the argument.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ._types import NumberOrArray, PerLoudspeaker
from ._validate import as_band, as_number, as_positive, as_real_array, as_sample_count, as_signal, require_channels_lead

__all__ = [
    "CoherenceAndGain",
    "a_weighted_level_db",
    "a_weighting_db",
    "clipped_fraction",
    "coherence_and_gain",
    "convergence_time_s",
    "harmonics_db",
    "noise_reduction_db",
    "nse_db",
    "output_power",
    "overshoot",
    "peak_control_signal",
    "power_spectrum_db",
    "short_time_power",
    "third_octave_levels_db",
]

SOUND_PRESSURE = 2e-5  # Pa, the reference of sound pressure levels
BAND_ORDER, HIGHEST_BAND = 4, 0.48  # of a third octave's filter, and its upper edge over fs: then it keeps to class 1

_SETTLED_DB = 3.0  # from the steady NSE

# Half the main lobe of the four-term Blackman-Harris window, in Fourier bins.
_LOBE_BINS = 4


def nse_db(
    error: ArrayLike, disturbance: ArrayLike, fs: float, window_s: float = 0.005, *, runs: bool = False
) -> np.ndarray:
    """Return the normalised squared error, 10 log10(sum e² / sum d²) over a sliding window.

    Sample n looks at the window that ends with n, so it never sees the future. The first samples look at the samples
    there are, without padding.

    Parameters
    ----------
    error, disturbance : array_like, shape (n_samples,) or (n_microphones, n_samples)
        Residual error and disturbance; squares are summed over the microphones.
    fs : float
        Sampling frequency in Hz.
    window_s : float, default 0.005
        Length of the window in seconds, at least one sample.
    runs : bool, default False
        The leading axis counts runs; squares are summed over them too.

    Returns
    -------
    ndarray, shape (n_samples,)
        NSE in dB; NaN where the window holds NaN or no disturbance.

    Raises
    ------
    ValueError
        If the window is shorter than a sample.

    References
    ----------
    T. Li et al., "Distributed active noise control based on an augmented diffusion FxLMS algorithm", IEEE/ACM
    Trans. Audio, Speech, Language Process. 31, 1449-1463, 2023.

    Examples
    --------
    >>> nse_db([1.0, 1.0, 0.1, 0.1], [1.0, 1.0, 1.0, 1.0], fs=1000, window_s=0.001).round(6).tolist()
    [0.0, 0.0, -20.0, -20.0]
    """
    e, d = _as_pair(error, "error", disturbance, "disturbance", runs)
    width = as_sample_count(window_s, fs, "window_s")
    return _ratio_db(_sliding_sum(_energy(e), width), _sliding_sum(_energy(d), width))


def noise_reduction_db(error: ArrayLike, disturbance: ArrayLike, *, steady: float = 0.5, runs: bool = False) -> float:
    """Return the noise reduction, -10 log10(sum e² / sum d²) over the steady portion.

    Parameters
    ----------
    error, disturbance : array_like, shape (n_samples,) or (n_microphones, n_samples)
        Residual error and disturbance; squares are summed over the microphones.
    steady : float, default 0.5
        Portion of the run, from its end.
    runs : bool, default False
        The leading axis counts runs; squares are summed over them too.

    Returns
    -------
    float
        Noise reduction in dB, positive if the error is the weaker.

    Examples
    --------
    >>> noise_reduction_db([1.0, 1.0, 0.1, 0.1], [1.0, 1.0, 1.0, 1.0])
    20.0

    Two microphones, one silenced and one left as it was: half the energy is gone.

    >>> round(noise_reduction_db([[0.0, 0.0], [1.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]]), 2)
    3.01
    """
    e, d = _as_pair(error, "error", disturbance, "disturbance", runs, steady)
    return -float(_ratio_db(np.sum(e**2), np.sum(d**2)))


def output_power(control_signal: ArrayLike, *, steady: float = 0.5, runs: bool = False) -> NumberOrArray:
    """Return the output power, the mean square of the control signal before the amplifier, over the steady portion.

    Parameters
    ----------
    control_signal : array_like, shape (n_samples,) or (n_loudspeakers, n_samples)
        Control signal y.
    steady : float, default 0.5
        Portion of the run, from its end.
    runs : bool, default False
        The leading axis counts runs; their powers are averaged.

    Returns
    -------
    float, or ndarray of shape (n_loudspeakers,)
        Mean square, in the square of the signal's unit.

    Examples
    --------
    >>> output_power([5.0, 5.0, 1.0, -1.0])
    1.0
    >>> output_power([[5.0, 5.0, 1.0, -1.0], [5.0, 5.0, 2.0, -2.0]])  # one power per loudspeaker
    array([1., 4.])
    """
    y = _steady_part(_as_runs(control_signal, "control_signal", runs), steady)
    return _figure(np.mean(y**2, axis=(0, -1)))


def short_time_power(signal: ArrayLike, fs: float, window_s: float, *, runs: bool = False) -> np.ndarray:
    """Return the mean square of a signal over a sliding window.

    Sample n looks at the window that ends with n. The first samples look at the samples there are, without padding.

    Parameters
    ----------
    signal : array_like, shape (n_samples,) or (n_channels, n_samples)
        Signal.
    fs : float
        Sampling frequency in Hz.
    window_s : float
        Length of the window in seconds, at least one sample.
    runs : bool, default False
        The leading axis counts runs; their powers are averaged.

    Returns
    -------
    ndarray, shape (n_samples,) or (n_channels, n_samples)
        Power, in the square of the signal's unit; NaN where the window holds NaN.

    Raises
    ------
    ValueError
        If the window is shorter than a sample.

    Examples
    --------
    >>> short_time_power([2.0, 0.0, 0.0, 4.0], fs=1000, window_s=0.002).tolist()
    [4.0, 2.0, 0.0, 8.0]
    """
    power = np.mean(_as_runs(signal, "signal", runs) ** 2, axis=0)
    width = as_sample_count(window_s, fs, "window_s")
    return _sliding_sum(power, width) / np.minimum(np.arange(1, power.shape[-1] + 1), width)


def overshoot(
    control_signal: ArrayLike, rated_power: PerLoudspeaker, fs: float, *, window_s: float = 0.05, runs: bool = False
) -> NumberOrArray:
    """Return the peak of the short-time output power over the whole run, divided by the rated power.

    Parameters
    ----------
    control_signal : array_like, shape (n_samples,) or (n_loudspeakers, n_samples)
        Control signal y.
    rated_power : float or array_like, shape (n_loudspeakers,)
        Rated output power, above 0: one for all loudspeakers, or one each.
    fs : float
        Sampling frequency in Hz.
    window_s : float, default 0.05
        Length of the power's sliding window in seconds. Only windows that lie wholly in the run count; a window longer
        than the run is cut to the run.
    runs : bool, default False
        The leading axis counts runs; the highest peak counts.

    Returns
    -------
    float, or ndarray of shape (n_loudspeakers,)
        Ratio of powers: 1.0 is just at the rated power, 2.0 is twice it (3 dB above).

    Raises
    ------
    ValueError
        If the rated power is not above 0.

    Examples
    --------
    >>> overshoot([1.0, 2.0, 2.0, 1.0], 2.0, fs=1000, window_s=0.002)
    2.0
    """
    y = _as_runs(control_signal, "control_signal", runs)
    rated = _as_limits(rated_power, "rated_power", y)
    width = min(as_sample_count(window_s, fs, "window_s"), y.shape[-1])
    peak = np.max(_sliding_sum(y**2, width)[..., width - 1 :], axis=(0, -1)) / width
    return _figure(peak / rated)


def clipped_fraction(
    control_signal: ArrayLike, limit: float | ArrayLike, *, steady: float = 0.5, runs: bool = False
) -> NumberOrArray:
    """Return the share of the samples of the control signal beyond the amplifier's limit, in the steady portion.

    Parameters
    ----------
    control_signal : array_like, shape (n_samples,) or (n_loudspeakers, n_samples)
        Control signal y before the amplifier (after it, nothing lies beyond the limit).
    limit : float or array_like, shape (n_loudspeakers,)
        Amplitude limit, above 0: one for all loudspeakers, or one each. A sample counts if abs(y) > limit.
    steady : float, default 0.5
        Portion of the run, from its end.
    runs : bool, default False
        The leading axis counts runs; the share is that of all their samples.

    Returns
    -------
    float, or ndarray of shape (n_loudspeakers,)
        Between 0 and 1.

    Raises
    ------
    ValueError
        If the limit is not above 0.

    Examples
    --------
    >>> clipped_fraction([0.5, 2.0, -2.0, 1.0], 1.0, steady=1.0)
    0.5
    """
    y = _steady_part(_as_runs(control_signal, "control_signal", runs), steady)
    beyond = np.abs(y) > _as_limits(limit, "limit", y)[..., None]
    return _figure(np.mean(np.where(np.isnan(y), np.nan, beyond), axis=(0, -1)))


def peak_control_signal(control_signal: ArrayLike, *, steady: float = 0.5, runs: bool = False) -> NumberOrArray:
    """Return the largest magnitude of the control signal in the steady portion.

    Parameters
    ----------
    control_signal : array_like, shape (n_samples,) or (n_loudspeakers, n_samples)
        Control signal y.
    steady : float, default 0.5
        Portion of the run, from its end; 1.0 includes the start and its overshoot.
    runs : bool, default False
        The leading axis counts runs; the highest peak counts.

    Returns
    -------
    float, or ndarray of shape (n_loudspeakers,)
        Peak, in the signal's unit.

    Examples
    --------
    >>> peak_control_signal([9.0, 0.0, 1.0, -3.0])
    3.0
    """
    y = _steady_part(_as_runs(control_signal, "control_signal", runs), steady)
    return _figure(np.max(np.abs(y), axis=(0, -1)))


def convergence_time_s(
    error: ArrayLike,
    disturbance: ArrayLike,
    fs: float,
    *,
    window_s: float = 0.005,
    runs: bool = False,
) -> float:
    """Return the first time from which the NSE stays within 3 dB of its steady value.

    The steady value is the NSE of the whole steady half. From the time returned to the end of the run, the NSE stays
    within the tolerance, above and below.

    The NSE of a random signal over 5 ms never settles that closely. A band of width B leaves about 2 B window_s
    independent values in a window, and their ratio wanders by several dB if the residual is unlike the disturbance. For
    noise from 200 to 2000 Hz, one run settles with a window of 0.05 s, eight runs together with 0.02 s. Compare only
    figures with the same window: a window delays the figure by up to its own length.

    Parameters
    ----------
    error, disturbance : array_like, shape (n_samples,) or (n_microphones, n_samples)
        Residual error and disturbance; squares are summed over the microphones.
    fs : float
        Sampling frequency in Hz.
    window_s : float, default 0.005
        Window of the NSE in seconds.
    runs : bool, default False
        The leading axis counts runs; squares are summed over them too.

    Returns
    -------
    float
        Time in seconds: 0.0 if the NSE is never outside, NaN if it does not settle before the end.

    Raises
    ------
    ValueError
        If the window is shorter than a sample.

    See Also
    --------
    nse_db : the curve itself.

    Examples
    --------
    >>> import numpy as np
    >>> e = np.where(np.arange(1000) < 250, 1.0, 0.1)
    >>> convergence_time_s(e, np.ones(1000), fs=1000, window_s=0.001)
    0.25
    """
    curve = nse_db(error, disturbance, fs, window_s, runs=runs)
    steady_value = -noise_reduction_db(error, disturbance, runs=runs)
    # A perfect residual is at its steady value, but -inf less -inf is NaN.
    with np.errstate(invalid="ignore"):
        settled = (np.abs(curve - steady_value) <= _SETTLED_DB) | (curve == steady_value)
    if not settled[-1]:
        return float("nan")
    outside = np.flatnonzero(~settled)
    first_settled = outside[-1] + 1 if outside.size else 0
    return float(first_settled / fs)


def harmonics_db(
    error: ArrayLike,
    disturbance: ArrayLike,
    fundamental_hz: float,
    fs: float,
    *,
    steady: float = 0.5,
    runs: bool = False,
) -> float:
    """Return the error's power at 2 to 10 times the fundamental over the disturbance's power at the fundamental.

    A line's power is the sum over the main lobe (4 bins to each side) of a Blackman-Harris-windowed Fourier transform
    of the steady portion, so it is also right between bins. Leakage from the error's fundamental into its harmonics
    stays below -100 dB of that fundamental, which is the floor of this figure. Broadband noise within the lobes
    counts as well. Harmonics that do not fit below fs/2 are left out.

    Parameters
    ----------
    error, disturbance : array_like, shape (n_samples,) or (n_microphones, n_samples)
        Residual error and tonal disturbance; powers are summed over the microphones.
    fundamental_hz : float
        Frequency of the tone in Hz; twice it must lie below fs/2.
    fs : float
        Sampling frequency in Hz.
    steady : float, default 0.5
        Portion of the run, from its end; at least 16 periods of the tone.
    runs : bool, default False
        The leading axis counts runs; powers are averaged over them.

    Returns
    -------
    float
        Level in dB.

    Raises
    ------
    ValueError
        If the steady portion is shorter than 16 periods, or the second harmonic does not fit below fs/2.

    References
    ----------
    F. J. Harris, "On the use of windows for harmonic analysis with the discrete Fourier transform", Proc.
    IEEE 66(1), 51-83, 1978.

    Examples
    --------
    >>> import numpy as np
    >>> angle = 2 * np.pi * 400 / 16000 * np.arange(16000)
    >>> level = harmonics_db(np.sin(angle) + 0.01 * np.sin(3 * angle), np.sin(angle), 400.0, fs=16000)
    >>> round(level, 6)
    -40.0
    """
    e, d = _as_pair(error, "error", disturbance, "disturbance", runs, steady)
    n_samples, rate = e.shape[-1], as_positive(fs, "fs", unit="Hz")
    bins_per_harmonic = as_positive(fundamental_hz, "fundamental_hz", unit="Hz") * n_samples / rate
    if bins_per_harmonic < 16:
        raise ValueError(
            f"error and disturbance must hold at least 16 periods of fundamental_hz = {fundamental_hz:g} Hz "
            f"in the steady portion, got {bins_per_harmonic:g}; make the run longer"
        )
    centres = np.round(np.arange(2, 11) * bins_per_harmonic).astype(int)
    centres = centres[centres + _LOBE_BINS <= (n_samples - 1) // 2]
    if centres.size == 0:
        raise ValueError(
            f"fundamental_hz must have its second harmonic below fs/2 = {rate / 2:g} Hz, got {fundamental_hz:g}"
        )
    harmonics = np.sum(_line_powers(e, centres))
    fundamental = _line_powers(d, np.array([round(bins_per_harmonic)]))[0]
    return float(_ratio_db(harmonics, fundamental))


class CoherenceAndGain(NamedTuple):
    """Mean magnitude-squared coherence (0 to 1) and linear gain of the anti-noise over the disturbance.

    Both are floats, or arrays of shape (n_microphones,).
    """

    coherence: Any
    gain: Any


def coherence_and_gain(
    disturbance: ArrayLike,
    anti_noise: ArrayLike,
    fs: float,
    band: tuple[float, float],
    *,
    steady: float = 0.5,
    segment_s: float = 0.064,
    runs: bool = False,
) -> CoherenceAndGain:
    """Return how linear the anti-noise is in the disturbance: mean coherence over a band, and the gain between them.

    The coherence is ``|S_da|² / (S_dd S_aa)``, averaged over the bins in the band. The gain is the least-squares gain
    of the band, ``Re(sum S_da) / sum S_dd``; for an output-constrained controller that is otherwise perfect it is the
    constraint factor. Spectra are Welch's, with a Hann window and half overlap. Unrelated signals read about
    1 / (number of independent segments), not 0.

    Parameters
    ----------
    disturbance, anti_noise : array_like, shape (n_samples,) or (n_microphones, n_samples)
        Disturbance d and anti-noise y' at the error microphones, error = d - y'.
    fs : float
        Sampling frequency in Hz.
    band : (float, float)
        Lowest and highest frequency in Hz.
    steady : float, default 0.5
        Portion of the run, from its end; at least 8 segments.
    segment_s : float, default 0.064
        Length of a segment in seconds; its inverse is the resolution in Hz.
    runs : bool, default False
        The leading axis counts runs; spectra are averaged over them.

    Returns
    -------
    CoherenceAndGain
        (coherence, gain), one of each per microphone.

    Raises
    ------
    ValueError
        If the steady portion is shorter than 8 segments, or the band holds no frequency bin.

    Examples
    --------
    >>> import numpy as np
    >>> d = np.random.default_rng(1).standard_normal(32000)
    >>> coherence, gain = coherence_and_gain(d, 0.5 * d, 16000, (200.0, 2000.0))
    >>> round(coherence, 9), round(gain, 9)
    (1.0, 0.5)
    """
    from scipy.signal import csd

    d, a = _as_pair(disturbance, "disturbance", anti_noise, "anti_noise", runs, steady)
    segment = as_sample_count(segment_s, fs, "segment_s")
    if d.shape[-1] < 8 * segment:
        raise ValueError(
            f"disturbance and anti_noise must hold at least 8 segments of {segment} samples in the "
            f"steady portion, got {d.shape[-1]} samples; make the run longer or segment_s shorter"
        )
    low, high = as_band(band, fs)
    frequencies = np.fft.rfftfreq(segment, 1 / fs)
    inside = (frequencies >= low) & (frequencies <= high)
    if not np.any(inside):
        raise ValueError(f"band {low:g} to {high:g} Hz holds no frequency bin of {fs / segment:g} Hz; raise segment_s")

    def cross(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return csd(x, y, fs, nperseg=segment, detrend=False)[1].mean(axis=0)[..., inside]

    s_dd, s_aa, s_da = cross(d, d).real, cross(a, a).real, cross(d, a)
    coherence = np.mean(_ratio(np.abs(s_da) ** 2, s_dd * s_aa), axis=-1)
    return CoherenceAndGain(_figure(coherence), _figure(_ratio(np.sum(s_da.real, axis=-1), np.sum(s_dd, axis=-1))))


def power_spectrum_db(
    signal: ArrayLike, fs: float, *, steady: float = 0.5, segment_s: float = 0.128, runs: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return the power spectral density by Welch's method, with a Hann window and half overlap.

    Parameters
    ----------
    signal : array_like, shape (n_samples,) or (n_channels, n_samples)
        Signal.
    fs : float
        Sampling frequency in Hz.
    steady : float, default 0.5
        Portion of the run, from its end.
    segment_s : float, default 0.128
        Length of a segment in seconds, cut to the portion if that is shorter; its inverse is the resolution in Hz.
    runs : bool, default False
        The leading axis counts runs; powers are averaged over them.

    Returns
    -------
    frequencies : ndarray, shape (n_bins,)
        Frequencies in Hz, from 0 to fs/2.
    level : ndarray, shape (n_bins,) or (n_channels, n_bins)
        Power per Hz in dB.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.random.default_rng(1).standard_normal(160000)  # of power 1 over 8000 Hz: -39.0 dB
    >>> f, level = power_spectrum_db(x, 16000)
    >>> round(float(10 * np.log10(np.mean(10 ** (level / 10)))), 1)
    -39.0
    """
    from scipy.signal import welch

    part = _steady_part(_as_runs(signal, "signal", runs), steady)
    segment = min(as_sample_count(segment_s, fs, "segment_s"), part.shape[-1])
    frequencies, power = welch(part, fs, nperseg=segment, detrend=False)
    return frequencies, _ratio_db(power.mean(axis=0), 1.0)


def a_weighting_db(frequencies_hz: ArrayLike) -> np.ndarray:
    r"""Return the frequency weighting A in dB, 0 dB at 1 kHz.

    It is the formula of IEC 61672-1 with the poles at 20.6, 107.7, 737.9 and 12194 Hz:

    .. math::

       A(f) &= 20 \log_{10} R(f) - A_{1000}

       R(f) &= \frac{f^2}{f^2 + f_1^2}\, \frac{f}{\sqrt{f^2 + f_2^2}}\, \frac{f}{\sqrt{f^2 + f_3^2}}\, \frac{f_4^2}{f^2
       + f_4^2}

    Parameters
    ----------
    frequencies_hz : array_like
        Frequencies in Hz, zero or above.

    Returns
    -------
    ndarray
        The weighting in dB, of the same shape; -inf at 0 Hz.

    Raises
    ------
    ValueError, TypeError
        If a frequency is negative, or no number.

    References
    ----------
    IEC 61672-1, "Electroacoustics - Sound level meters - Part 1: Specifications".

    Examples
    --------
    >>> from kfopc_filterpy.metrics import a_weighting_db
    >>> a_weighting_db([100.0, 1000.0, 10000.0]).round(1) + 0.0
    array([-19.1,   0. ,  -2.5])
    """
    f = as_real_array(frequencies_hz, "frequencies_hz")
    if np.any(f < 0):
        raise ValueError(f"frequencies_hz must not be negative, got {f.min():g} Hz")
    with np.errstate(divide="ignore"):
        return 20 * np.log10(np.abs(_a_response(f) / _a_response(np.array([1000.0]))))


def _a_response(f: np.ndarray) -> np.ndarray:
    """Return the complex response of the analogue filter A, which is causal, without its gain."""
    from scipy.signal import freqs_zpk

    one, two, three, four = -2 * np.pi * np.array([20.598997, 107.65265, 737.86223, 12194.217])
    return freqs_zpk([0, 0, 0, 0], [one, one, two, three, four, four], 1.0, 2 * np.pi * f)[1]


def a_weighted_level_db(
    signal: ArrayLike, fs: float, *, reference: float = SOUND_PRESSURE, steady: float = 0.5
) -> NumberOrArray:
    """Return the A-weighted equivalent level, LAeq, in dBA if the signal is a sound pressure in Pa.

    It is the mean over the steady portion of the square of the weighted signal. The filter begins with the signal, and
    its response is that of `a_weighting_db` up to fs/2.

    Parameters
    ----------
    signal : array_like, shape (n_samples,) or (n_channels, n_samples)
        Sound pressure, in Pa for the default reference.
    fs : float
        Sampling frequency in Hz.
    reference : float, default 2e-5
        Rms value of 0 dB: 20 µPa.
    steady : float, default 0.5
        Portion of the run, from its end.

    Returns
    -------
    float or ndarray, shape (n_channels,)
        Level in dB.

    Examples
    --------
    >>> from kfopc_filterpy.metrics import a_weighted_level_db
    >>> from kfopc_filterpy.signals import tone
    >>> round(a_weighted_level_db(tone(100.0, 2.0, fs=16000, amplitude=2**0.5), 16000), 1)  # 1 Pa rms, 94.0 dB
    74.8
    """
    x, fs = _as_runs(signal, "signal", False)[0], as_positive(fs, "fs", unit="Hz")
    length = x.shape[-1]
    padded = 2 * length  # so that the end does not reach the beginning
    response = _a_response(np.fft.rfftfreq(padded, 1 / fs)) / np.abs(_a_response(np.array([1000.0])))
    weighted = np.fft.irfft(np.fft.rfft(x, padded) * response, padded)[..., :length]
    return _level_db(weighted, steady, reference)


def third_octave_levels_db(
    signal: ArrayLike, fs: float, *, reference: float = SOUND_PRESSURE, steady: float = 0.5
) -> tuple[np.ndarray, np.ndarray]:
    """Return the levels in third-octave bands from 25 Hz on.

    The bands are those of IEC 61260-1 with base ten: exact centres ``1000 * 10**(k/10)``, edges half a tenth of a
    decade to each side. The filters are Butterworth band-passes of eight poles, which keep to class 1 of that standard.
    The signal is filtered from its beginning, and the level is the mean over the steady portion. Bands that do not end
    below 0.48 fs are left out, and those in which the portion is shorter than one over the bandwidth.

    Parameters
    ----------
    signal : array_like, shape (n_samples,) or (n_channels, n_samples)
        Sound pressure, in Pa for the default reference.
    fs : float
        Sampling frequency in Hz.
    reference : float, default 2e-5
        Rms value of 0 dB: 20 µPa.
    steady : float, default 0.5
        Portion of the run, from its end.

    Returns
    -------
    centres_hz : ndarray, shape (n_bands,)
        Exact centre frequencies in Hz.
    levels_db : ndarray, shape (n_bands,) or (n_channels, n_bands)
        Level of each band in dB.

    Raises
    ------
    ValueError
        If the portion is too short for a single band, or an argument is out of range.

    References
    ----------
    IEC 61260-1, "Electroacoustics - Octave-band and fractional-octave-band filters - Part 1: Specifications".

    Examples
    --------
    >>> from kfopc_filterpy.metrics import third_octave_levels_db
    >>> from kfopc_filterpy.signals import tone
    >>> centres, levels = third_octave_levels_db(tone(100.0, 2.0, fs=16000, amplitude=2**0.5), 16000)  # 1 Pa rms
    >>> print(f"{levels.max():.1f} dB in the band at {centres[levels.argmax()]:.0f} Hz")
    94.0 dB in the band at 100 Hz
    """
    from scipy.signal import butter, sosfilt

    x, fs = _as_runs(signal, "signal", False)[0], as_positive(fs, "fs", unit="Hz")
    exact = 1000.0 * 10.0 ** (np.arange(-16, 14) / 10.0)
    low, high = exact * 10**-0.05, exact * 10**0.05
    kept = (high < HIGHEST_BAND * fs) & ((high - low) * _steady_part(x, steady).shape[-1] >= fs)
    if not np.any(kept):
        raise ValueError(f"signal must be longer for a third-octave band, got {x.shape[-1]} samples at {fs:g} Hz")
    filters = [
        butter(BAND_ORDER, edges, "bandpass", fs=fs, output="sos") for edges in zip(low[kept], high[kept], strict=True)
    ]
    levels = [_level_db(sosfilt(sections, x), steady, reference) for sections in filters]
    return exact[kept], np.stack(levels, axis=-1)


def _level_db(signal: np.ndarray, steady: float, reference: float) -> Any:
    """Return the level of the steady portion, a mean over time."""
    power = np.mean(_steady_part(signal, steady) ** 2, axis=-1)
    return _figure(_ratio_db(power, as_positive(reference, "reference") ** 2))


def _as_runs(value: Any, name: str, runs: bool) -> np.ndarray:
    """Return `value` as float64, (n_runs, n_samples) or (n_runs, n_channels, n_samples).

    NaN is let through, because diverged runs end in it.
    """
    array = as_real_array(value, name)
    if array.ndim - bool(runs) not in (1, 2):
        expected = "(n_samples,) or (n_channels, n_samples)"
        if runs:
            expected = "with runs=True (n_runs, n_samples) or (n_runs, n_channels, n_samples)"
        hint = "" if runs or array.ndim < 3 else "; pass runs=True if the leading axis counts runs"
        raise ValueError(f"{name} must be {expected}, got shape {array.shape}{hint}")
    if array.size == 0:
        raise ValueError(f"{name} must have at least one sample, got shape {array.shape}")
    if array.ndim - bool(runs) == 2:
        require_channels_lead(array, name)
    if np.any(np.isinf(array)):
        raise ValueError(f"{name} must hold finite numbers, or NaN after a divergence, but holds Inf")
    return array if runs else array[None]


def _as_pair(
    first: Any, first_name: str, second: Any, second_name: str, runs: bool, steady: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the steady part of two signals of the same runs as `_as_runs` does, checked to have one shape."""
    one, two = _as_runs(first, first_name, runs), _as_runs(second, second_name, runs)
    if one.shape != two.shape:
        shapes = f"{np.shape(first)} and {np.shape(second)}"
        raise ValueError(f"{first_name} and {second_name} must have one shape, got {shapes}")
    return _steady_part(one, steady), _steady_part(two, steady)


def _as_limits(value: Any, name: str, signal: np.ndarray) -> np.ndarray:
    """Return a positive limit, shape (), or one per channel of `signal`, shape (n_channels,)."""
    if np.ndim(value) == 0:
        return np.asarray(as_positive(value, name))
    if signal.ndim < 3:
        raise ValueError(f"{name} must be a single number for a signal without a channel axis, got {value!r}")
    return np.array([as_positive(limit, name) for limit in as_signal(value, name, length=signal.shape[1])])


def _steady_part(signal: np.ndarray, steady: float) -> np.ndarray:
    """Return the last `steady` portion of each channel, at least one sample."""
    portion = as_number(steady, "steady")
    if not 0 < portion <= 1:
        raise ValueError(f"steady must be a portion above 0 and at most 1, got {portion:g}")
    n_samples = signal.shape[-1]
    return signal[..., min(int(n_samples * (1 - portion)), n_samples - 1) :]


def _figure(value: Any) -> Any:
    """Return a figure as a float, or as an array if there is one per channel."""
    return float(value) if np.ndim(value) == 0 else value


def _energy(signal: np.ndarray) -> np.ndarray:
    """Return the squares, summed over all axes but the samples."""
    return np.sum(signal**2, axis=tuple(range(signal.ndim - 1)))


def _ratio(numerator: Any, denominator: Any) -> np.ndarray:
    """Return the quotient, NaN where the denominator is zero, without warnings."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.asarray(denominator) == 0, np.nan, np.divide(numerator, denominator))


def _ratio_db(numerator: Any, denominator: Any) -> np.ndarray:
    """Return a ratio of powers in dB, NaN where the denominator is zero, without warnings."""
    with np.errstate(divide="ignore"):
        return 10 * np.log10(_ratio(numerator, denominator))


def _sliding_sum(values: np.ndarray, width: int) -> np.ndarray:
    """Return the sum of the last `width` values at each sample of the last axis, of fewer at the start.

    Each window is the end of one block plus the start of the next. Subtracting running sums instead would lose a small
    residual after a large transient, and would carry NaN on for good.
    """
    *channels, n = values.shape
    width = min(width, n)
    n_blocks = -(-(n + width - 1) // width)
    blocks = np.zeros((*channels, n_blocks * width))
    blocks[..., width - 1 : width - 1 + n] = values
    blocks = blocks.reshape(*channels, n_blocks, width)
    from_block_start = np.cumsum(blocks, axis=-1).reshape(*channels, -1)
    to_block_end = np.cumsum(blocks[..., ::-1], axis=-1)[..., ::-1].reshape(*channels, -1)
    # A window that is a whole block is already in the first sum.
    whole_block = np.arange(n) % width == 0
    return from_block_start[..., width - 1 : width - 1 + n] + np.where(whole_block, 0.0, to_block_end[..., :n])


def _line_powers(signal: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return the power of the spectral lines around the Fourier bins `centres`, mean over runs and channels."""
    from scipy.signal.windows import blackmanharris

    n_samples = signal.shape[-1]
    window = blackmanharris(n_samples, sym=False)
    spectrum = np.mean(np.abs(np.fft.rfft(signal * window)) ** 2, axis=tuple(range(signal.ndim - 1)))
    lobes = centres[:, None] + np.arange(-_LOBE_BINS, _LOBE_BINS + 1)
    # Parseval: the positive-frequency lobe of a line holds half its energy.
    return 2 * np.sum(spectrum[lobes], axis=1) / (n_samples * np.sum(window**2))
