"""Analysis of paths: responses in Hz, gain (eq. 11), achieved band, causality margin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._taps import finite_taps, path_taps, sampling_rate
from .._types import PathModel
from .._validate import as_signal
from ..plant import Plant, as_constant_plant, has_one_channel
from .file_checks import require_sound

_EDGE_DB = -3.0  # of a band, relative to the peak of the response


def frequency_response(path: PathModel, frequencies_hz: ArrayLike, *, fs: float | None = None) -> np.ndarray:
    """Return the complex frequency response of a path.

    Parameters
    ----------
    path : control.TransferFunction, control.StateSpace or array_like, shape (n_taps,)
        Discrete-time system or impulse response.
    frequencies_hz : array_like, shape (n_frequencies,)
        Frequencies in Hz, within 0 to fs/2.
    fs : float, optional
        Sampling rate in Hz, needed for a tap array.

    Returns
    -------
    numpy.ndarray, shape (n_frequencies,), complex
        Response at each frequency.

    Raises
    ------
    TypeError, ValueError
        If the path is not a discrete-time system with one channel, or a frequency is out of range.

    Examples
    --------
    >>> frequency_response([0.5, 0.5], [0.0, 2000.0, 4000.0], fs=8000.0).round(3)
    array([1. +0.j , 0.5-0.5j, 0. -0.j ])
    """
    fs, f = sampling_rate(path, fs), as_signal(frequencies_hz, "frequencies_hz")
    if f.min() < 0 or f.max() > fs / 2:
        raise ValueError(f"frequencies_hz must lie within 0 to fs/2 = {fs / 2:g} Hz, got {f.min():g} to {f.max():g} Hz")
    return _response(path, 2 * np.pi * f / fs)


def _response(path: Any, omega: np.ndarray) -> np.ndarray:
    """Return the response at frequencies in rad/sample."""
    taps = finite_taps(path)
    if taps is None:
        return np.asarray(path(np.exp(1j * omega)))
    from scipy.signal import freqz

    return freqz(taps, worN=omega)[1]


def _response_on_grid(path: Any, n_frequencies: int) -> np.ndarray:
    """Return the response at evenly spaced frequencies from 0 to fs/2, by one FFT if the response is finite."""
    taps = finite_taps(path)
    if taps is None:
        return _response(path, np.linspace(0.0, np.pi, n_frequencies))
    period = 2 * (n_frequencies - 1)  # taps a period apart have the same phase at all of these frequencies
    padded = np.pad(taps, (0, -taps.size % period))
    return np.fft.rfft(padded.reshape(-1, period).sum(axis=0))


def secondary_path_gain(path: PathModel, *, reference: ArrayLike | None = None, fs: float | None = None) -> float:
    """Return the secondary-path gain ``G_s = E[x'^2] / E[x^2]`` (eq. 11), a power gain.

    Parameters
    ----------
    path : control.TransferFunction or array_like, shape (n_taps,)
        Secondary path with a finite impulse response.
    reference : array_like, shape (n_samples,), optional
        Reference signal, by default white noise; the first ``n_taps - 1`` samples, while the delay line fills, do
        not count.
    fs : float, optional
        Sampling rate in Hz that a system must have.

    Returns
    -------
    float
        Mean-square gain (not in dB).

    Raises
    ------
    TypeError, ValueError
        If the reference is silent or too short.

    References
    ----------
    .. [1] D. Shi et al., IEEE/ACM Trans. Audio Speech Lang. Process. 29, 2021.

    Examples
    --------
    >>> secondary_path_gain([0.0, 2.0])
    4.0
    """
    from scipy.signal import lfilter

    taps = path_taps(path, fs=fs)
    if reference is not None:
        x = as_signal(reference, "reference", min_length=taps.size)
        power = np.mean(x[taps.size - 1 :] ** 2)
        if power == 0:
            raise ValueError("reference must not be silent: the gain for it is undefined")
        return float(np.mean(lfilter(taps, 1.0, x)[taps.size - 1 :] ** 2) / power)
    return float(taps @ taps)


@dataclass(frozen=True)
class AchievedBand:
    """Band that a path really passes.

    Attributes
    ----------
    low_hz, high_hz : float
        Outermost frequencies at which the response is 3 dB below its peak; 0 or fs/2 if it does not fall that low.
    """

    low_hz: float
    high_hz: float


def achieved_band(path: PathModel, *, fs: float | None = None) -> AchievedBand:
    """Return the band at whose edges the response of a path is 3 dB below its peak: what its taps really pass.

    Parameters
    ----------
    path : control.TransferFunction, control.StateSpace or array_like, shape (n_taps,)
        Discrete-time system or impulse response.
    fs : float, optional
        Sampling rate in Hz, needed for a tap array.

    Returns
    -------
    AchievedBand
        Edges, interpolated on a grid of fs/65536.

    Raises
    ------
    TypeError, ValueError
        If the path is silent, or has no sampling rate.

    Examples
    --------
    >>> from kfopc_filterpy import bandpass_path
    >>> band = achieved_band(bandpass_path(32, fs=16000))  # designed for 20 to 5000 Hz
    >>> band.low_hz, round(band.high_hz)
    (0.0, 4792)
    """
    fs = sampling_rate(path, fs)
    frequencies = np.linspace(0.0, fs / 2, 2**15 + 1)
    magnitude = np.abs(_response_on_grid(path, frequencies.size))
    peak = int(np.argmax(magnitude))
    if magnitude[peak] == 0:
        raise ValueError("path must not be all zeros: a silent path has no band")
    level = magnitude[peak] * 10 ** (_EDGE_DB / 20)
    above = np.flatnonzero(magnitude >= level)
    return AchievedBand(
        low_hz=_crossing(frequencies, magnitude, level, above[0], above[0] - 1),
        high_hz=_crossing(frequencies, magnitude, level, above[-1], above[-1] + 1),
    )


def _crossing(frequencies: np.ndarray, magnitude: np.ndarray, level: float, inside: int, outside: int) -> float:
    """Return the frequency between two grid points at which the magnitude crosses a level."""
    if not 0 <= outside < frequencies.size:
        return float(frequencies[inside])
    share = (magnitude[inside] - level) / (magnitude[inside] - magnitude[outside])
    return float(frequencies[inside] + share * (frequencies[outside] - frequencies[inside]))


@dataclass(frozen=True)
class CausalityMargin:
    """Delay of the primary path over that of the secondary path.

    With several channels there is a margin for each pair of a microphone and a loudspeaker. At a microphone the
    loudspeaker with the largest one can act first. The margin of the whole is that of the microphone where this comes
    latest: the smallest over the microphones of the largest over the loudspeakers.

    Attributes
    ----------
    primary_onset_s : float or numpy.ndarray, shape (K,)
        Energy onset of the primary path in s: the time by which its impulse response has delivered 1 % of its energy,
        which ignores the ringing before a band-limited arrival. With several channels the earliest over the references,
        at each microphone.
    secondary_onset_s : float or numpy.ndarray, shape (K, J)
        Energy onset of the secondary path, or of that from each loudspeaker to each microphone; inf for a silent one.
    fs : float
        Sampling rate in Hz.
    """

    primary_onset_s: Any
    secondary_onset_s: Any
    fs: float

    def __repr__(self) -> str:
        margin = f"{1e3 * self.margin_s:.3g} ms, {self.margin_samples:.4g} samples"
        if np.ndim(self.secondary_onset_s) == 0:
            return f"<CausalityMargin: {margin}>"
        K, J = self.margins_s.shape
        return f"<CausalityMargin of {K} microphone(s) and {J} loudspeaker(s): {margin}>"

    @property
    def margins_s(self) -> np.ndarray:
        """Margins by energy onset in s, shape (K, J), one for each pair; -inf for a silent secondary path."""
        return np.atleast_1d(self.primary_onset_s)[:, np.newaxis] - np.atleast_2d(self.secondary_onset_s)

    @property
    def margin_s(self) -> float:
        """Margin by energy onset in s, primary minus secondary, of the whole; a negative one is not causal."""
        return float(self.margins_s.max(axis=1).min())

    @property
    def margin_samples(self) -> float:
        """Margin by energy onset in samples."""
        return self.margin_s * self.fs


def energy_onset(taps: np.ndarray, share: float = 0.01) -> int:
    """Return the sample by which an impulse response has delivered `share` of its energy."""
    energy = np.cumsum(taps**2)
    return int(np.searchsorted(energy, share * energy[-1]))


def causality_margin(plant: Plant) -> CausalityMargin:
    """Return the causality margin, the delay of the primary path over that of the secondary path.

    The control filter has this much time to act. Without any it must predict the noise, which works for tones only.

    Parameters
    ----------
    plant : Plant
        Plant with a primary path.

    Returns
    -------
    CausalityMargin
        Onsets and margins: of each pair of a microphone and a loudspeaker if there are several, and
        of the whole.

    Raises
    ------
    TypeError, ValueError
        If the plant has no primary path or changes, no sound reaches a microphone, or an argument is out of range.

    Examples
    --------
    >>> from kfopc_filterpy import Plant, bandpass_path
    >>> margin = causality_margin(Plant(bandpass_path(32, fs=16000), bandpass_path(128, fs=16000)))
    >>> round(margin.margin_samples)
    45

    Two loudspeakers and two microphones, in which sounds arrive after whole samples:

    >>> arriving = lambda samples: np.eye(16)[np.array(samples)]
    >>> margin = causality_margin(Plant(arriving([[2, 7], [6, 5]]), arriving([[9], [10]]), fs=8000))
    >>> margin.margins_s * margin.fs
    array([[7., 2.],
           [4., 5.]])
    >>> margin
    <CausalityMargin of 2 microphone(s) and 2 loudspeaker(s): 0.625 ms, 5 samples>
    """
    as_constant_plant(plant, "causality_margin")
    if plant.primary is None:
        raise ValueError("plant must have a primary path: make it with Plant(secondary, primary)")
    p, s, fs = plant.primary, plant.secondary, plant.fs
    require_sound("primary", p)
    require_sound("secondary", s)

    def onsets(paths: np.ndarray) -> np.ndarray:
        return np.array([[energy_onset(h) / fs if np.any(h) else np.inf for h in row] for row in paths])

    primary_onset, secondary_onset = onsets(p).min(axis=1), onsets(s)
    if has_one_channel(plant, p[0]):
        return CausalityMargin(primary_onset.item(), secondary_onset.item(), fs)
    return CausalityMargin(primary_onset, secondary_onset, fs)
