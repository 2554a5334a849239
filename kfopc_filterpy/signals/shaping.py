"""Changes to a signal: its power, jumps and swings of its level, its length.

Each function returns a new float64 array and leaves its input as it is. Signals are (n_samples,) or
(n_channels, n_samples); all channels are changed alike, so that their balance is kept.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_channels, as_nonnegative, as_number, as_positive, as_sample_count

_FADE_S = 0.05  # cross-fade where a recording begins again


def scaled_to_power(signal: ArrayLike, power: float) -> np.ndarray:
    """Scale a signal so that its mean square is `power`.

    Parameters
    ----------
    signal : array_like, shape (n_samples,) or (n_channels, n_samples)
        The signal, not all zeros.
    power : float
        Mean square wanted, above 0; of several channels, the mean over them.

    Returns
    -------
    ndarray, shape of `signal`
        The scaled signal.

    Raises
    ------
    ValueError, TypeError
        If the signal is silent or not finite, or the power is not above 0.

    Examples
    --------
    >>> scaled_to_power([3.0, -4.0], 50.0).tolist()
    [6.0, -8.0]
    """
    samples = as_channels(signal, "signal")
    wanted = as_positive(power, "power")
    peak = np.max(np.abs(samples))
    if peak == 0:
        raise ValueError("signal must not be all zeros: no scale gives silence a power")
    # Dividing by the peak first keeps the squares of very small or large samples within range.
    unit = samples / peak
    return unit * np.sqrt(wanted / np.mean(unit**2))


def level_jump(signal: ArrayLike, at_s: float, gain_db: float, *, fs: float) -> np.ndarray:
    """Make a signal louder or softer by `gain_db` from the time `at_s` on.

    Parameters
    ----------
    signal : array_like, shape (n_samples,) or (n_channels, n_samples)
        The signal.
    at_s : float
        Time of the jump in seconds, within the signal; the sample round(at_s * fs) is the first to change.
    gain_db : float
        Change of level in dB: 6.02 doubles the amplitude.
    fs : float
        Sampling frequency in Hz.

    Returns
    -------
    ndarray, shape of `signal`
        The signal with the jump.

    Raises
    ------
    ValueError, TypeError
        If the jump lies outside the signal, or an argument is not in its range.

    Examples
    --------
    >>> level_jump([1.0, 1.0, 1.0, 1.0], 0.5, 20.0, fs=4).tolist()
    [1.0, 1.0, 10.0, 10.0]
    """
    jumped = as_channels(signal, "signal").copy()
    rate, n_samples = as_positive(fs, "fs", unit="Hz"), jumped.shape[-1]
    first = round(as_nonnegative(at_s, "at_s", unit="s") * rate)
    if first >= n_samples:
        raise ValueError(
            f"at_s must lie within the signal of {n_samples / rate:g} s, got {at_s:g} s; make the signal longer"
        )
    jumped[..., first:] *= 10 ** (as_number(gain_db, "gain_db", unit="dB") / 20)
    return jumped


def swelling(
    signal: ArrayLike, *, fs: float, swing_db: float = 6.0, period_s: float = 4.0, phase_rad: float = 0.0
) -> np.ndarray:
    """Let the level of a signal in dB swing up and down as a sine, and keep its mean power.

    Parameters
    ----------
    signal : array_like, shape (n_samples,) or (n_channels, n_samples)
        The signal, not all zeros.
    fs : float
        Sampling frequency in Hz.
    swing_db : float, default 6.0
        Largest deviation of the level to either side in dB.
    period_s : float, default 4.0
        Period in seconds.
    phase_rad : float, default 0.0
        Phase at the first sample in radians.

    Returns
    -------
    ndarray, shape of `signal`
        The signal with its level swinging.

    Raises
    ------
    ValueError, TypeError
        If the signal is silent or not finite, or an argument is not in its range.

    Examples
    --------
    >>> import numpy as np
    >>> y = swelling(np.ones(8), fs=8.0, period_s=1.0, swing_db=20.0)
    >>> round(float(20 * np.log10(y[2] / y[6])), 6)
    40.0
    """
    samples = as_channels(signal, "signal")
    if not samples.any():
        raise ValueError("signal must not be all zeros: silence has no level to swing")
    turn = 2 * np.pi / (as_positive(period_s, "period_s", unit="s") * as_positive(fs, "fs", unit="Hz"))
    level_db = as_nonnegative(swing_db, "swing_db", unit="dB") * np.sin(
        turn * np.arange(samples.shape[-1]) + as_number(phase_rad, "phase_rad")
    )
    return scaled_to_power(samples * 10 ** (level_db / 20), float(np.mean(samples**2)))


def looped(recording: ArrayLike, duration_s: float, *, fs: float, start_s: float = 0.0) -> np.ndarray:
    """Repeat a recording to fill a duration, with a cross-fade of 50 ms where it begins again.

    Parameters
    ----------
    recording : array_like, shape (n_samples,) or (n_channels, n_samples)
        The recording, longer than 0.1 s.
    duration_s : float
        Duration wanted in seconds.
    fs : float
        Sampling frequency in Hz.
    start_s : float, default 0.0
        Where in the recording to begin, modulo its length less the cross-fade.

    Returns
    -------
    ndarray, shape (round(duration_s * fs),), or (n_channels, round(duration_s * fs))
        The signal.

    Raises
    ------
    ValueError, TypeError
        If the recording is too short for the cross-fade, or an argument is not in its range.

    Examples
    --------
    >>> looped([1.0] * 100, 1.0, fs=500.0).size  # 0.2 s made 1 s
    500
    """
    fs = as_positive(fs, "fs", unit="Hz")
    samples = as_channels(recording, "recording")
    n_samples = as_sample_count(duration_s, fs, "duration_s")
    fade = max(round(_FADE_S * fs), 1)
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
