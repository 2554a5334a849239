"""Causality margin: the time that the primary path leaves the control filter and the secondary path."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .._validate import as_band, as_positive
from .analysis import frequency_response
from .models import path_taps, sampling_rate


@dataclass(frozen=True)
class CausalityMargin:
    """By how much the primary path is later than the secondary path.

    Attributes
    ----------
    primary_onset_s, secondary_onset_s : float
        Energy onset of each path: the time by which its impulse response has brought `onset_share` of its
        energy.
    primary_delay_s, secondary_delay_s : float
        Group delay of each path, averaged over the band with the weight ``|H|^2``. In a reverberant path it
        holds the reverberation too, so that the onset is the safer measure.
    fs : float
        Sampling rate in Hz.
    """

    primary_onset_s: float
    secondary_onset_s: float
    primary_delay_s: float
    secondary_delay_s: float
    fs: float

    @property
    def margin_s(self) -> float:
        """Onset of the primary less that of the secondary path in s; negative: not causal."""
        return self.primary_onset_s - self.secondary_onset_s

    @property
    def margin_samples(self) -> float:
        """Margin by energy onset in samples."""
        return self.margin_s * self.fs

    @property
    def group_delay_margin_s(self) -> float:
        """Margin by mean group delay in s."""
        return self.primary_delay_s - self.secondary_delay_s

    @property
    def group_delay_margin_samples(self) -> float:
        """Margin by mean group delay in samples."""
        return self.group_delay_margin_s * self.fs


def energy_onset(taps: np.ndarray, share: float = 0.01) -> int:
    """Sample by which an impulse response has brought `share` of its energy."""
    energy = np.cumsum(taps**2)
    return int(np.searchsorted(energy, share * energy[-1]))


def causality_margin(
    primary: Any,
    secondary: Any,
    *,
    fs: float | None = None,
    band: tuple[float, float] | None = None,
    onset_share: float = 0.01,
) -> CausalityMargin:
    """Causality margin: the delay of the primary path over that of the secondary path.

    The control filter has this much time; with none it must predict the noise, which works for tones only.

    Parameters
    ----------
    primary, secondary : control.TransferFunction or array_like, shape (n_taps,)
        Paths with finite impulse responses.
    fs : float, optional
        Sampling rate in Hz, needed for tap arrays.
    band : (float, float), optional
        Band in Hz over which the group delay is averaged; all frequencies by default.
    onset_share : float
        Share of the energy that marks the onset, in (0, 1): by default 1 %, which passes over the ringing
        before a band-limited arrival.

    Returns
    -------
    CausalityMargin
        Onsets, mean group delays and margins.

    Raises
    ------
    TypeError, ValueError
        The paths differ in sampling rate or are silent, or an argument is out of range.

    Examples
    --------
    >>> from kfopc_filterpy.paths.models import bandpass_path
    >>> margin = causality_margin(bandpass_path(128), bandpass_path(32))
    >>> round(margin.margin_samples), round(margin.group_delay_margin_samples)
    (45, 48)
    """
    fs = sampling_rate(primary, fs, name="primary")
    sampling_rate(secondary, fs, name="secondary")
    share = as_positive(onset_share, "onset_share")
    if share >= 1:
        raise ValueError(f"onset_share must be below 1, got {share:g}")
    low, high = (0.0, fs / 2) if band is None else as_band(band, fs)
    responses = (path_taps(primary, name="primary"), path_taps(secondary, name="secondary"))
    for name, taps in zip(("primary", "secondary"), responses, strict=True):
        if not np.any(taps):
            raise ValueError(f"{name} must not be all zeros: a silent path has no delay")
    onsets = [energy_onset(h, share) / fs for h in responses]
    delays = [_mean_group_delay(h, low, high, fs) for h in responses]
    return CausalityMargin(onsets[0], onsets[1], delays[0], delays[1], fs)


def _mean_group_delay(taps: np.ndarray, low: float, high: float, fs: float) -> float:
    """Group delay weighted by |H|²: the mean of Re(conj(H) FT{n h}) over that of |H|² in the band, in s."""
    frequencies = low + (high - low) * (np.arange(4 * taps.size) + 0.5) / (4 * taps.size)
    response = frequency_response(taps, frequencies, fs=fs)
    ramped = frequency_response(taps * np.arange(taps.size), frequencies, fs=fs)  # transform of n h[n]
    return float(np.sum(np.real(np.conj(response) * ramped)) / np.sum(np.abs(response) ** 2) / fs)
