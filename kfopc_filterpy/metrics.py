"""Figures of merit of a run: noise reduction, output power, saturation, distortion, convergence, spectra.

Common to all functions here:

- A signal is (n_samples,), or (n_runs, n_samples) for several runs of one experiment with different seeds;
  powers are then averaged over the runs before any ratio or logarithm is taken.
- Power is the mean square. `steady` is the portion of the run, counted from its end, that a figure looks at:
  0.5, the steady second half, unless told otherwise; 1.0 is the whole run.
- A diverged run ends in NaN. A figure that looks at NaN samples is NaN, without a warning.
- A disturbance of zero power leaves a ratio undefined: NaN. A residual of exactly zero is -inf dB.
- An empty signal, Inf, shapes that differ or more than two dimensions raise ValueError; values that are not
  real numbers raise TypeError. Both name the argument.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ._runs import as_pair, as_runs, ratio_db, steady_part, window_length
from ._validate import as_positive
from .spectra import CoherenceAndGain, coherence_and_gain, harmonics_db, power_spectrum_db

__all__ = [
    "CoherenceAndGain",
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
]


def nse_db(error: Any, disturbance: Any, fs: float, window_s: float = 0.005) -> np.ndarray:
    """Normalised squared error: 10 log10(sum e² / sum d²) over a sliding window.

    Sample n looks at the window that ends with n, so it never sees the future; the first samples look at the
    samples there are, without padding.

    Parameters
    ----------
    error, disturbance : array_like, shape (n_samples,) or (n_runs, n_samples)
        Residual error and disturbance; squares are summed over the runs as well as the window.
    fs : float
        Sampling frequency in Hz.
    window_s : float, default 0.005
        Length of the window in seconds, at least one sample.

    Returns
    -------
    ndarray, shape (n_samples,)
        NSE in dB; NaN where the window holds NaN or no disturbance.

    Raises
    ------
    ValueError, TypeError
        Where the window is shorter than a sample, or a signal or a setting is not as described.

    References
    ----------
    T. Li et al., "Distributed active noise control based on an augmented diffusion FxLMS algorithm", IEEE/ACM
    Trans. Audio, Speech, Language Process. 31, 1449-1463, 2023.

    Examples
    --------
    >>> nse_db([1.0, 1.0, 0.1, 0.1], [1.0, 1.0, 1.0, 1.0], fs=1000, window_s=0.001).round(6).tolist()
    [0.0, 0.0, -20.0, -20.0]
    """
    e, d = as_pair(error, "error", disturbance, "disturbance")
    width = window_length(window_s, fs)
    return ratio_db(_sliding_sum(_sum_over_runs(e), width), _sliding_sum(_sum_over_runs(d), width))


def noise_reduction_db(error: Any, disturbance: Any, *, steady: float = 0.5) -> float:
    """Noise reduction, -10 log10(sum e² / sum d²) over the steady portion.

    Parameters
    ----------
    error, disturbance : array_like, shape (n_samples,) or (n_runs, n_samples)
        Residual error and disturbance.
    steady : float, default 0.5
        Portion of the run, from its end.

    Returns
    -------
    float
        Noise reduction in dB, positive where the error is the weaker.

    Raises
    ------
    ValueError, TypeError
        Where a signal or a setting is not as described.

    Examples
    --------
    >>> noise_reduction_db([1.0, 1.0, 0.1, 0.1], [1.0, 1.0, 1.0, 1.0])
    20.0
    """
    e, d = as_pair(error, "error", disturbance, "disturbance")
    e, d = steady_part(e, steady), steady_part(d, steady)
    return -float(ratio_db(np.sum(e**2), np.sum(d**2)))


def output_power(control_signal: Any, *, steady: float = 0.5) -> float:
    """Output power: mean square of the control signal before the amplifier, over the steady portion.

    Parameters
    ----------
    control_signal : array_like, shape (n_samples,) or (n_runs, n_samples)
        Control signal y.
    steady : float, default 0.5
        Portion of the run, from its end.

    Returns
    -------
    float
        Mean square, in the square of the signal's unit; over several runs, the mean of their powers.

    Raises
    ------
    ValueError, TypeError
        Where a signal or a setting is not as described.

    Examples
    --------
    >>> output_power([5.0, 5.0, 1.0, -1.0])
    1.0
    """
    return float(np.mean(steady_part(as_runs(control_signal, "control_signal"), steady) ** 2))


def overshoot(control_signal: Any, rated_power: float, fs: float, *, window_s: float = 0.05) -> float:
    """Peak of the short-time output power over the whole run, divided by the rated power.

    Parameters
    ----------
    control_signal : array_like, shape (n_samples,) or (n_runs, n_samples)
        Control signal y; of several runs, the highest peak counts.
    rated_power : float
        Rated output power, above 0.
    fs : float
        Sampling frequency in Hz.
    window_s : float, default 0.05
        Length of the power's sliding window in seconds; windows that would stand out of the run are left out,
        and a longer one than the run is the run.

    Returns
    -------
    float
        Ratio of powers: 1.0 is just at the rated power, 2.0 twice (3 dB) above.

    Raises
    ------
    ValueError, TypeError
        Where the rated power is not above 0, or a signal or a setting is not as described.

    Examples
    --------
    >>> overshoot([1.0, 2.0, 2.0, 1.0], 2.0, fs=1000, window_s=0.002)
    2.0
    """
    runs = as_runs(control_signal, "control_signal")
    rated = as_positive(rated_power, "rated_power")
    width = min(window_length(window_s, fs), runs.shape[1])
    peaks = [np.max(_sliding_sum(run**2, width)[width - 1 :]) for run in runs]
    return float(np.max(peaks) / width / rated)


def clipped_fraction(control_signal: Any, limit: float, *, steady: float = 0.5) -> float:
    """Share of the samples of the control signal beyond the amplifier's limit, in the steady portion.

    Parameters
    ----------
    control_signal : array_like, shape (n_samples,) or (n_runs, n_samples)
        Control signal y before the amplifier (after it, nothing lies beyond the limit).
    limit : float
        Amplitude limit, above 0; a sample counts where abs(y) > limit.
    steady : float, default 0.5
        Portion of the run, from its end.

    Returns
    -------
    float
        Between 0 and 1.

    Raises
    ------
    ValueError, TypeError
        Where the limit is not above 0, or a signal or a setting is not as described.

    Examples
    --------
    >>> clipped_fraction([0.5, 2.0, -2.0, 1.0], 1.0, steady=1.0)
    0.5
    """
    y = steady_part(as_runs(control_signal, "control_signal"), steady)
    beyond = np.abs(y) > as_positive(limit, "limit")
    return float(np.mean(np.where(np.isnan(y), np.nan, beyond)))


def peak_control_signal(control_signal: Any, *, steady: float = 0.5) -> float:
    """Largest magnitude of the control signal in the steady portion.

    Parameters
    ----------
    control_signal : array_like, shape (n_samples,) or (n_runs, n_samples)
        Control signal y.
    steady : float, default 0.5
        Portion of the run, from its end; 1.0 takes the start with its overshoot in.

    Returns
    -------
    float
        Peak, in the signal's unit.

    Raises
    ------
    ValueError, TypeError
        Where a signal or a setting is not as described.

    Examples
    --------
    >>> peak_control_signal([9.0, 0.0, 1.0, -3.0])
    3.0
    """
    return float(np.max(np.abs(steady_part(as_runs(control_signal, "control_signal"), steady))))


def convergence_time_s(
    error: Any,
    disturbance: Any,
    fs: float,
    *,
    window_s: float = 0.005,
    tolerance_db: float = 3.0,
    steady: float = 0.5,
) -> float:
    """First time from which the NSE stays within 3 dB of its steady value.

    The steady value is the NSE of the whole steady portion; the NSE has to stay within the tolerance, above
    and below, to the end of the run. The NSE over 5 ms of a random signal never settles so closely: a band of
    width B leaves about 2 B window_s independent values in a window, whose ratio wanders by several dB where
    the residual is unlike the disturbance. For noise from 200 to 2000 Hz, 0.05 s settle for one run and 0.02
    s for eight runs together. Compare only figures of one window: a window delays the figure, by up to its
    own length.

    Parameters
    ----------
    error, disturbance : array_like, shape (n_samples,) or (n_runs, n_samples)
        Residual error and disturbance; squares are summed over runs.
    fs : float
        Sampling frequency in Hz.
    window_s : float, default 0.005
        Window of the NSE in seconds.
    tolerance_db : float, default 3.0
        Allowed distance from the steady value in dB.
    steady : float, default 0.5
        Portion of the run, from its end, that gives the steady value.

    Returns
    -------
    float
        Time in seconds, 0.0 where the NSE is never outside; NaN where it does not settle before the end.

    Raises
    ------
    ValueError, TypeError
        Where the window is shorter than a sample, or a signal or a setting is not as described.

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
    curve = nse_db(error, disturbance, fs, window_s)
    steady_value = -noise_reduction_db(error, disturbance, steady=steady)
    tolerance = as_positive(tolerance_db, "tolerance_db", unit="dB")
    # -inf less -inf, a perfect residual, is on its steady value although the difference is NaN.
    with np.errstate(invalid="ignore"):
        settled = (np.abs(curve - steady_value) <= tolerance) | (curve == steady_value)
    if not settled[-1]:
        return float("nan")
    outside = np.flatnonzero(~settled)
    first_settled = outside[-1] + 1 if outside.size else 0
    return float(first_settled / fs)


def _sum_over_runs(runs: np.ndarray) -> np.ndarray:
    return np.sum(runs**2, axis=0)


def _sliding_sum(values: np.ndarray, width: int) -> np.ndarray:
    """Sum of the last `width` values at each sample, fewer at the start.

    Each window is the end of one block plus the start of the next: no subtraction of running sums, which
    would lose a small residual after a large transient, and would carry NaN on for good.
    """
    n = values.size
    width = min(width, n)
    padded = np.zeros(-(-(n + width - 1) // width) * width)
    padded[width - 1 : width - 1 + n] = values
    blocks = padded.reshape(-1, width)
    from_block_start = np.cumsum(blocks, axis=1).ravel()
    to_block_end = np.cumsum(blocks[:, ::-1], axis=1)[:, ::-1].ravel()
    first = np.arange(n)
    # A window that is a whole block is in the first sum already.
    return from_block_start[first + width - 1] + np.where(first % width == 0, 0.0, to_block_end[first])
