"""Figures of merit in frequency: harmonics, coherence and gain of the anti-noise, power spectra.

The conventions on runs, the steady portion, NaN and errors are those of `kfopc_filterpy.metrics`, which hands
these functions out as well.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ._runs import as_pair, as_runs, ratio, ratio_db, steady_part, window_length
from ._validate import as_band, as_choice, as_positive

__all__ = ["CoherenceAndGain", "coherence_and_gain", "harmonics_db", "power_spectrum_db"]

# Half the main lobe of the four-term Blackman-Harris window, in Fourier bins.
_LOBE_BINS = 4


class CoherenceAndGain(NamedTuple):
    """Mean magnitude-squared coherence (0 to 1) and linear gain of the anti-noise over the disturbance."""

    coherence: float
    gain: float


def harmonics_db(error: Any, disturbance: Any, fundamental_hz: float, fs: float, *, steady: float = 0.5) -> float:
    """Power of the error at 2 to 10 times the fundamental, over the disturbance's power at the fundamental.

    A line's power is the sum over the main lobe (4 bins to each side) of a Blackman-Harris-windowed Fourier
    transform of the steady portion, so it is right between bins too. What leaks from the error's fundamental
    into its harmonics stays below -100 dB of that fundamental: the floor of this figure. Broadband noise
    within the lobes counts as well. Harmonics that do not fit below fs/2 are left out.

    Parameters
    ----------
    error, disturbance : array_like, shape (n_samples,) or (n_runs, n_samples)
        Residual error and tonal disturbance.
    fundamental_hz : float
        Frequency of the tone in Hz; twice it must lie below fs/2.
    fs : float
        Sampling frequency in Hz.
    steady : float, default 0.5
        Portion of the run, from its end; at least 16 periods of the tone.

    Returns
    -------
    float
        Level in dB.

    Raises
    ------
    ValueError, TypeError
        Where the steady portion is shorter than 16 periods, the second harmonic does not fit below fs/2, or a
        signal or a setting is not as described.

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
    e, d = as_pair(error, "error", disturbance, "disturbance")
    e, d = steady_part(e, steady), steady_part(d, steady)
    rate = as_positive(fs, "fs", unit="Hz")
    bins_per_harmonic = as_positive(fundamental_hz, "fundamental_hz", unit="Hz") * e.shape[1] / rate
    if bins_per_harmonic < 16:
        raise ValueError(
            f"error and disturbance must hold at least 16 periods of fundamental_hz = {fundamental_hz:g} Hz "
            f"in the steady portion, got {bins_per_harmonic:g}; make the run longer"
        )
    centres = np.round(np.arange(2, 11) * bins_per_harmonic).astype(int)
    centres = centres[centres + _LOBE_BINS <= (e.shape[1] - 1) // 2]
    if centres.size == 0:
        raise ValueError(
            f"fundamental_hz must leave its second harmonic below fs/2 = {rate / 2:g} Hz, got {fundamental_hz:g} Hz"
        )
    harmonics = np.sum(_line_powers(e, centres))
    fundamental = _line_powers(d, np.array([round(bins_per_harmonic)]))[0]
    return float(ratio_db(harmonics, fundamental))


def coherence_and_gain(
    disturbance: Any,
    anti_noise: Any,
    fs: float,
    band: tuple[float, float],
    *,
    steady: float = 0.5,
    segment_s: float = 0.064,
) -> CoherenceAndGain:
    """How linear the anti-noise is in the disturbance: mean coherence over a band, and the gain between them.

    The coherence is ``|S_da|² / (S_dd S_aa)``, averaged over the bins in the band; the gain is the least-squares
    one of the band, ``Re(sum S_da) / sum S_dd``: for an output-constrained controller that is otherwise perfect
    it is the constraint factor. Spectra are Welch's, Hann window, half overlap. Unrelated signals read about
    1 / (number of independent segments), not 0.

    Parameters
    ----------
    disturbance, anti_noise : array_like, shape (n_samples,) or (n_runs, n_samples)
        Disturbance d and anti-noise y' at the error microphone, error = d - y'.
    fs : float
        Sampling frequency in Hz.
    band : (float, float)
        Lowest and highest frequency in Hz.
    steady : float, default 0.5
        Portion of the run, from its end; at least 8 segments.
    segment_s : float, default 0.064
        Length of a segment in seconds; its inverse is the resolution in Hz.

    Returns
    -------
    CoherenceAndGain
        (coherence, gain).

    Raises
    ------
    ValueError, TypeError
        Where the steady portion is shorter than 8 segments, the band holds no frequency bin, or a signal or a
        setting is not as described.

    Examples
    --------
    >>> import numpy as np
    >>> d = np.random.default_rng(1).standard_normal(32000)
    >>> coherence, gain = coherence_and_gain(d, 0.5 * d, 16000, (200.0, 2000.0))
    >>> round(coherence, 9), round(gain, 9)
    (1.0, 0.5)
    """
    from scipy.signal import csd

    d, a = as_pair(disturbance, "disturbance", anti_noise, "anti_noise")
    d, a = steady_part(d, steady), steady_part(a, steady)
    segment = window_length(segment_s, fs, "segment_s")
    if d.shape[1] < 8 * segment:
        raise ValueError(
            f"disturbance and anti_noise must hold at least 8 segments of {segment} samples in the "
            f"steady portion, got {d.shape[1]} samples; make the run longer or segment_s shorter"
        )
    low, high = as_band(band, fs)
    frequencies = np.fft.rfftfreq(segment, 1 / fs)
    inside = (frequencies >= low) & (frequencies <= high)
    if not np.any(inside):
        raise ValueError(
            f"band {low:g} to {high:g} Hz holds no frequency bin, {fs / segment:g} Hz apart; raise segment_s"
        )

    def cross(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return csd(x, y, fs, nperseg=segment, detrend=False)[1].mean(axis=0)[inside]

    s_dd, s_aa, s_da = cross(d, d).real, cross(a, a).real, cross(d, a)
    coherence = np.mean(ratio(np.abs(s_da) ** 2, s_dd * s_aa))
    return CoherenceAndGain(float(coherence), float(ratio(np.sum(s_da.real), np.sum(s_dd))))


def power_spectrum_db(
    signal: Any, fs: float, *, steady: float = 0.5, segment_s: float = 0.128, scaling: str = "density"
) -> tuple[np.ndarray, np.ndarray]:
    """Power spectrum by Welch's method, Hann window, half overlap.

    Parameters
    ----------
    signal : array_like, shape (n_samples,) or (n_runs, n_samples)
        Signal.
    fs : float
        Sampling frequency in Hz.
    steady : float, default 0.5
        Portion of the run, from its end.
    segment_s : float, default 0.128
        Length of a segment in seconds, shortened to the portion; its inverse is the resolution in Hz.
    scaling : {"density", "spectrum"}, default "density"
        "density": dB of power per Hz, for noise. "spectrum": dB of power, in which a tone that lies on a bin
        reads its own power.

    Returns
    -------
    frequencies : ndarray, shape (n_bins,)
        Frequencies in Hz, from 0 to fs/2.
    level : ndarray, shape (n_bins,)
        Level in dB.

    Raises
    ------
    ValueError, TypeError
        Where `scaling` is unknown, or a signal or a setting is not as described.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.sqrt(2) * np.sin(2 * np.pi * 1000 / 16000 * np.arange(16000))
    >>> f, level = power_spectrum_db(x, 16000, segment_s=0.1, scaling="spectrum")
    >>> float(f[np.argmax(level)]), abs(round(float(np.max(level)), 6))
    (1000.0, 0.0)
    """
    from scipy.signal import welch

    part = steady_part(as_runs(signal, "signal"), steady)
    segment = min(window_length(segment_s, fs, "segment_s"), part.shape[1])
    kind = as_choice(scaling, "scaling", ("density", "spectrum"))
    frequencies, power = welch(part, fs, nperseg=segment, detrend=False, scaling=kind)
    return frequencies, ratio_db(power.mean(axis=0), 1.0)


def _line_powers(runs: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Power of the spectral lines around the Fourier bins `centres`, mean over runs."""
    from scipy.signal.windows import blackmanharris

    n_samples = runs.shape[1]
    window = blackmanharris(n_samples, sym=False)
    spectrum = np.mean(np.abs(np.fft.rfft(runs * window)) ** 2, axis=0)
    lobes = centres[:, None] + np.arange(-_LOBE_BINS, _LOBE_BINS + 1)
    # Parseval: a line's positive-frequency lobe holds half its energy.
    return 2 * np.sum(spectrum[lobes], axis=1) / (n_samples * np.sum(window**2))
