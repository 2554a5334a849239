"""Identification of the secondary path: excite the loudspeaker, record the microphone, fit an impulse response."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .._validate import as_choice, as_count, as_generator, as_nonnegative, as_positive, as_signal
from .analysis import frequency_response
from .least_squares import correlation_matrix, cross_correlation, minimum_norm_solve
from .models import fir_path, path_taps, sampling_rate

if TYPE_CHECKING:
    import control


@dataclass(frozen=True)
class PathEstimate:
    """A path fitted to an excitation and the response to it.

    Attributes
    ----------
    estimate : control.TransferFunction
        The fitted path, with ``dt = 1/fs``.
    taps : numpy.ndarray, shape (n_taps,)
        Its impulse response.
    residual_db : float
        Share of the response's power that the fit leaves unexplained, in dB: noise, distortion by the amplifier, and the
        part of the path beyond `n_taps`. At least -300 dB.
    """

    estimate: control.TransferFunction
    taps: np.ndarray
    residual_db: float


@dataclass(frozen=True)
class IdentificationResult(PathEstimate):
    """Result of a simulated identification, in which the true path is known.

    Attributes
    ----------
    estimate, taps, residual_db
        As in `PathEstimate`.
    frequencies_hz : numpy.ndarray, shape (n_frequencies,)
        Frequencies of the modelling error in Hz.
    modelling_error_db : numpy.ndarray, shape (n_frequencies,)
        ``20 log10(|S_est - S| / |S|)`` at each frequency.
    misalignment_db : float
        ``10 log10(sum (s_est - s)^2 / sum s^2)``, the error of the whole impulse response.
    """

    frequencies_hz: np.ndarray
    modelling_error_db: np.ndarray
    misalignment_db: float


def estimate_path(
    excitation: Any, response: Any, n_taps: int, fs: float, *, regularization: float = 1e-5
) -> PathEstimate:
    """Fit an impulse response to a recorded excitation and response by least squares.

    The first ``n_taps - 1`` samples fill the delay line and are not fitted.

    Parameters
    ----------
    excitation : array_like, shape (n_samples,)
        Signal sent to the amplifier.
    response : array_like, shape (n_samples,)
        Signal of the error microphone, recorded at the same time.
    n_taps : int
        Length of the impulse response, including the delay of the path.
    fs : float
        Sampling rate in Hz.
    regularization : float, default 1e-5
        Ridge relative to the excitation's power. It keeps frequencies that the excitation hardly contains from being
        fitted to noise; the default limits the accuracy to about -100 dB. 0 is plain least squares.

    Returns
    -------
    PathEstimate
        The path as a system, its taps and the residual.

    Raises
    ------
    TypeError, ValueError
        If the signals differ in length, are shorter than ``2 n_taps - 1``, silent or not finite.

    Examples
    --------
    >>> excitation = np.random.default_rng(0).standard_normal(1000)
    >>> response = np.convolve(excitation, [0.0, 0.8, -0.2])[:1000]
    >>> estimate_path(excitation, response, n_taps=4, fs=8000.0).taps.round(4) + 0.0
    array([ 0. ,  0.8, -0.2,  0. ])
    """
    fs = as_positive(fs, "fs", unit="Hz")
    n_taps = as_count(n_taps, "n_taps")
    excitation = as_signal(excitation, "excitation", min_length=2 * n_taps - 1)
    response = as_signal(response, "response", length=excitation.size)
    for name, signal in (("excitation", excitation), ("response", response)):
        if not np.any(signal[n_taps - 1 :]):
            raise ValueError(f"{name} must not be silent: it does not reveal the path")
    heard = response[n_taps - 1 :]
    matrix = correlation_matrix(excitation, n_taps, n_taps - 1)
    ridge = as_nonnegative(regularization, "regularization") * float(np.mean(excitation[n_taps - 1 :] ** 2))
    matrix.flat[:: n_taps + 1] += ridge
    taps = minimum_norm_solve(matrix, cross_correlation(heard, excitation))
    left = heard - np.convolve(excitation, taps, mode="valid")
    residual_db = 10 * np.log10(max(np.mean(left**2) / np.mean(heard**2), 1e-30))
    return PathEstimate(fir_path(taps, fs), taps, float(residual_db))


def identify_secondary_path(
    secondary_path: Any,
    *,
    n_taps: int,
    duration_s: float,
    rng: Any,
    fs: float | None = None,
    excitation: str = "white",
    level: float = 1.0,
    amplifier: Callable[[np.ndarray], np.ndarray] | None = None,
    sensor_noise_std: float = 0.0,
    regularization: float = 1e-5,
    frequencies_hz: Any = None,
) -> IdentificationResult:
    """Simulate the identification of a secondary path, as it is done before the control starts.

    The excitation runs through the amplifier and the true path, sensor noise is added, and `estimate_path` fits the taps
    to excitation and response.

    Parameters
    ----------
    secondary_path : control.TransferFunction or array_like, shape (n_path,)
        True path s with a finite impulse response.
    n_taps : int
        Length of the estimate.
    duration_s : float
        Duration of the run in s.
    rng : int or numpy.random.Generator
        Seed or generator of excitation and sensor noise.
    fs : float, optional
        Sampling rate in Hz, needed for a tap array.
    excitation : {"white", "sweep"}, default "white"
        Gaussian white noise, or a sine whose frequency rises exponentially from fs/1000 to fs/2.
    level : float, default 1.0
        Root mean square of the excitation. A sweep peaks at ``sqrt(2) * level``.
    amplifier : callable, optional
        Maps the signal before the amplifier, (n,), to that after it; by default linear.
    sensor_noise_std : float, default 0.0
        Standard deviation of the noise of the microphone.
    regularization : float, default 1e-5
        As in `estimate_path`.
    frequencies_hz : array_like, shape (n_frequencies,), optional
        Frequencies of the modelling error in Hz; by default 256, evenly spaced up to 0.45 fs, above which converters
        pass little.

    Returns
    -------
    IdentificationResult
        Estimate, residual, modelling error over frequency and overall misalignment.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range, the run is too short, or the amplifier changes the shape of the signal.

    Examples
    --------
    >>> from kfopc_filterpy import bandpass_path
    >>> result = identify_secondary_path(
    ...     bandpass_path(32), n_taps=32, duration_s=1.0, rng=1, sensor_noise_std=0.01
    ... )
    >>> result.misalignment_db < -40
    True
    """
    fs = sampling_rate(secondary_path, fs, name="secondary_path")
    true = path_taps(secondary_path, name="secondary_path")
    n_samples = round(as_positive(duration_s, "duration_s", unit="s") * fs)
    n_taps = as_count(n_taps, "n_taps")
    if n_samples < 2 * n_taps - 1:
        raise ValueError(
            f"duration_s must be at least {(2 * n_taps - 1) / fs:.3g} s for {n_taps} taps, got {duration_s:g}"
        )
    generator = as_generator(rng)
    sent = _excitation(excitation, n_samples, fs, as_positive(level, "level"), generator)
    received = _through(sent, amplifier, true)
    received += as_nonnegative(sensor_noise_std, "sensor_noise_std") * generator.standard_normal(n_samples)

    fitted = estimate_path(sent, received, n_taps, fs, regularization=regularization)
    if frequencies_hz is None:
        frequencies_hz = np.arange(1, 257) * 0.45 * fs / 256
    return IdentificationResult(
        estimate=fitted.estimate,
        taps=fitted.taps,
        residual_db=fitted.residual_db,
        frequencies_hz=as_signal(frequencies_hz, "frequencies_hz"),
        modelling_error_db=modelling_error_db(true, fitted.taps, frequencies_hz, fs=fs),
        misalignment_db=misalignment_db(true, fitted.taps),
    )


def _excitation(kind: str, n_samples: int, fs: float, level: float, rng: np.random.Generator) -> np.ndarray:
    if as_choice(kind, "excitation", ("white", "sweep")) == "white":
        return level * rng.standard_normal(n_samples)
    from scipy.signal import chirp

    t = np.arange(n_samples) / fs
    return np.sqrt(2) * level * chirp(t, fs / 1000, n_samples / fs, fs / 2, method="logarithmic", phi=-90)


def _through(sent: np.ndarray, amplifier: Callable[[np.ndarray], np.ndarray] | None, taps: np.ndarray) -> np.ndarray:
    """Run a signal through the amplifier and the path."""
    from scipy.signal import lfilter

    amplified = sent
    if amplifier is not None:
        # A copy, so that an amplifier that works in place does not change the excitation.
        amplified = as_signal(amplifier(sent.copy()), "amplifier(excitation)", length=sent.size)
    return lfilter(taps, 1.0, amplified)


def modelling_error_db(path: Any, estimate: Any, frequencies_hz: Any, *, fs: float | None = None) -> np.ndarray:
    """Return the modelling error of an estimate over frequency, ``20 log10(|S_est - S| / |S|)``.

    Parameters
    ----------
    path, estimate : control.TransferFunction, control.StateSpace or array_like, shape (n_taps,)
        True path and its estimate.
    frequencies_hz : array_like, shape (n_frequencies,)
        Frequencies in Hz, within 0 to fs/2.
    fs : float, optional
        Sampling rate in Hz, needed for tap arrays.

    Returns
    -------
    numpy.ndarray, shape (n_frequencies,)
        Error in dB, between -300 and 300.

    Raises
    ------
    TypeError, ValueError
        If the paths differ in sampling rate, or a frequency is out of range.

    Examples
    --------
    >>> modelling_error_db([1.0, 0.5], [1.1, 0.55], [100.0, 1000.0], fs=8000.0).round(6)
    array([-20., -20.])
    """
    fs = sampling_rate(path, fs)
    sampling_rate(estimate, fs, name="estimate")
    true = frequency_response(path, frequencies_hz, fs=fs)
    error = np.abs(frequency_response(estimate, frequencies_hz, fs=fs) - true)
    tiny = np.finfo(float).tiny
    ratio = np.maximum(error, tiny) / np.maximum(np.abs(true), tiny)
    return np.clip(20 * np.log10(np.maximum(ratio, tiny)), -300.0, 300.0)


def misalignment_db(path: Any, estimate: Any) -> float:
    """Return the error of a whole impulse response, ``10 log10(sum (s_est - s)^2 / sum s^2)``.

    Parameters
    ----------
    path, estimate : control.TransferFunction or array_like, shape (n_taps,)
        True path and its estimate; the shorter is padded with zeros.

    Returns
    -------
    float
        Misalignment in dB, at least -300.

    Raises
    ------
    TypeError, ValueError
        If the path is silent, or its impulse response is not finite.

    Examples
    --------
    >>> round(misalignment_db([1.0, 0.0], [0.9]), 6)
    -20.0
    """
    true, estimated = path_taps(path), path_taps(estimate, name="estimate")
    if not np.any(true):
        raise ValueError("path must not be all zeros: an error relative to it is undefined")
    length = max(true.size, estimated.size)
    error = np.pad(estimated, (0, length - estimated.size)) - np.pad(true, (0, length - true.size))
    return float(10 * np.log10(max(np.sum(error**2) / np.sum(true**2), 1e-30)))
