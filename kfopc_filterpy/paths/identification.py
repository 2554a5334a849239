"""Identification of secondary paths: excite the loudspeakers, record the microphones, fit impulse responses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.polynomial.polynomial import polysub
from numpy.typing import ArrayLike

from .._taps import path_taps
from .._types import PathModel, Seed
from .._validate import (
    as_channels,
    as_choice,
    as_count,
    as_generator,
    as_nonnegative,
    as_positive,
    as_real_array,
    require_channels_lead,
    require_finite,
)
from ..plant import Plant, as_constant_plant
from ..power.amplifiers import amplified_signal
from .least_squares import RANK_TOLERANCE, correlation_matrix, cross_correlation, minimum_norm_solve, ridge_solve
from .models import fir_path
from .uncertainty import relative_to

if TYPE_CHECKING:
    import control


SEGMENT = 512  # samples of a segment of the spectra; its frequencies are those of `path_uncertainty`
CORRELATED = 1.3  # times what chance gives: a residual is correlated with the excitation
_MOST_DENSE = 2048  # weights; of more, an iteration is faster and takes less memory
CONFIDENCE = 2.5  # standard deviations; a complex Gaussian error exceeds them at 0.2 % of the frequencies

# Excitations at once whose correlation coefficient exceeds this at some delay count as the same signal.
_LARGEST_CORRELATION = 0.9


@dataclass(frozen=True)
class PathEstimate:
    """A path, or the paths of several loudspeakers and microphones, fitted to excitations and the responses to them.

    Attributes
    ----------
    estimate : control.TransferFunction
        The fitted path, with ``dt = 1/fs``; with several, a system of J inputs and K outputs.
    taps : numpy.ndarray, shape (n_taps,) or (K, J, n_taps)
        Its impulse response, or that from each of J loudspeakers to each of K microphones.
    residual_db : float or numpy.ndarray, shape (K,) or (K, J)
        Share of the response's power that the fit leaves unexplained, in dB: noise, distortion by the amplifier, and
        the part of the path beyond `n_taps`. At least -300 dB. With several paths one for each response: (K,) if all
        loudspeakers played at once, (K, J) if in turn.
    uncertainty : numpy.ndarray, shape (257,)
        Relative error of the fit that must be expected at evenly spaced frequencies from 0 to fs/2, because of noise,
        distortion and the part of the path beyond `n_taps`: a controller's ``secondary_path_uncertainty``. With several
        paths it bounds the matrix norm, see `path_uncertainty`. It knows nothing of what changes after the recording.
    misalignment_db : float or numpy.ndarray, shape (K, J), or None
        ``10 log10(sum (s_est - s)^2 / sum s^2)``, the error of the whole impulse response, if the true path is known:
        from `identify_secondary_path`.
    """

    estimate: control.TransferFunction
    taps: np.ndarray
    residual_db: Any
    uncertainty: np.ndarray
    misalignment_db: Any = None


def estimate_path(
    excitation: ArrayLike, response: ArrayLike, n_taps: int, fs: float, *, regularization: float = 1e-5
) -> PathEstimate:
    """Fit impulse responses to recorded excitations and responses by least squares.

    The first ``n_taps - 1`` samples fill the delay line and are not fitted.

    The paths from several loudspeakers can be recorded in two ways. In turn: one loudspeaker plays at a time, and its
    paths are fitted to its own recording. At once: all play noises that are not correlated, and all paths to a
    microphone are fitted to its response together. Noise of the microphones then costs no more accuracy than in runs of
    this length for each loudspeaker. But what no fit explains, such as distortion and the paths beyond `n_taps`, adds
    up over all loudspeakers.

    Parameters
    ----------
    excitation : array_like, shape (n_samples,) or (J, n_samples)
        Signal sent to the amplifier, or to each of J amplifiers. In turn, (n_samples,) is the same signal for all.
    response : array_like, shape (n_samples,), (K, n_samples) or (J, K, n_samples)
        Signal of the error microphone, recorded at the same time; or of each of K microphones while all loudspeakers
        play at once; or of each of K microphones while loudspeaker j plays alone.
    n_taps : int
        Length of the impulse responses, including the delay of the path.
    fs : float
        Sampling rate in Hz.
    regularization : float, default 1e-5
        Ridge relative to the excitation's power. It keeps frequencies that the excitation hardly contains from being
        fitted to noise; the default limits the accuracy to about -100 dB. 0 is plain least squares.

    Returns
    -------
    PathEstimate
        The path as a system, its taps, the residual and the uncertainty. Of paths (K, J, n_taps) unless both signals
        are (n_samples,).

    Raises
    ------
    TypeError, ValueError
        If the signals differ in length, are shorter than ``(J + 1) n_taps - 1`` (in turn, or with one loudspeaker, ``2
        n_taps - 1``), silent or not finite, or loudspeakers play the same noise at once; if more than 16384 taps in all
        are to be fitted without a ridge.

    Examples
    --------
    >>> excitation = np.random.default_rng(0).standard_normal(1000)
    >>> response = np.convolve(excitation, [0.0, 0.8, -0.2])[:1000]
    >>> estimate_path(excitation, response, n_taps=4, fs=8000.0).taps.round(4) + 0.0
    array([ 0. ,  0.8, -0.2,  0. ])

    With noise, the fit says how far it may be from the path:

    >>> noise = 0.1 * np.random.default_rng(1).standard_normal(1000)
    >>> fitted = estimate_path(excitation, response + noise, n_taps=4, fs=8000.0)
    >>> true, found = (np.fft.rfft(taps, 512) for taps in ([0.0, 0.8, -0.2], fitted.taps))
    >>> bool(np.all(np.abs(found / true - 1) < fitted.uncertainty)), bool(fitted.uncertainty.max() < 0.05)
    (True, True)

    Two loudspeakers at once:

    >>> noises = np.random.default_rng(0).standard_normal((2, 1000))
    >>> response = 0.5 * noises[0] - 0.3 * noises[1]
    >>> estimate_path(noises, [response], n_taps=2, fs=8000.0).taps.round(4) + 0.0
    array([[[ 0.5,  0. ],
            [-0.3,  0. ]]])
    """
    fs = as_positive(fs, "fs", unit="Hz")
    n_taps = as_count(n_taps, "n_taps")
    ridge = as_nonnegative(regularization, "regularization")
    sent, heard = as_real_array(excitation, "excitation"), as_real_array(response, "response")
    if heard.ndim == 3:
        taps, residual_db, variance = _fit_in_turn(sent, heard, n_taps, ridge)
    else:
        single = sent.ndim < 2 and heard.ndim < 2
        sent, heard = np.atleast_2d(as_channels(sent, "excitation")), np.atleast_2d(as_channels(heard, "response"))
        require_length(sent.shape[1], (len(sent) + 1) * n_taps - 1)
        if heard.shape[1] != sent.shape[1]:
            raise ValueError(f"response must have {sent.shape[1]} samples, as excitation has, got {heard.shape[1]}")
        require_audible({"excitation": sent, "response": heard}, n_taps)
        _require_different(sent, n_taps)
        taps, residual_db, variance = _fit(sent, heard, n_taps, ridge)
        if single:
            only, uncertainty = taps[0, 0], relative_to(taps, variance)
            return PathEstimate(fir_path(only, fs), only, float(residual_db[0]), uncertainty)
    return PathEstimate(_system(taps, fs), taps, residual_db, relative_to(taps, variance))


def require_audible(recorded: Mapping[str, np.ndarray], n_taps: int) -> None:
    """Raise ValueError if a signal, (..., n_samples), is silent where it is fitted; the message gives its index."""
    for name, signals in recorded.items():
        for silent in np.argwhere(~np.any(signals[..., n_taps - 1 :], axis=-1)):
            index = "".join(f"[{i}]" for i in silent) if signals.size > signals.shape[-1] else ""
            raise ValueError(f"{name}{index} must not be silent: it does not reveal the path")


def require_length(n_samples: int, needed: int, name: str = "excitation") -> None:
    """Raise ValueError if a recording is too short for a fit."""
    if n_samples < needed:
        raise ValueError(f"{name} must have at least {needed} samples for these paths, got {n_samples}")


def _fit_in_turn(
    sent: np.ndarray, heard: np.ndarray, n_taps: int, ridge: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit the paths of loudspeakers that play alone, one after the other.

    Return the taps (K, J, n_taps), the residuals (K, J) in dB, and the squared errors to be expected, (K, J, 257).
    """
    if 0 in heard.shape:
        raise ValueError(f"response must be (J loudspeakers, K microphones, n_samples), got shape {heard.shape}")
    require_channels_lead(heard, "response")
    require_finite(heard, "response")
    sent = as_channels(sent, "excitation")
    sent = np.broadcast_to(sent, (len(heard), sent.shape[-1])) if sent.ndim == 1 else sent
    if sent.shape != (len(heard), heard.shape[2]):
        raise ValueError(
            f"excitation must be (J loudspeakers, n_samples) = {(len(heard), heard.shape[2])} for a response of shape "
            f"{heard.shape}, got {sent.shape}"
        )
    require_length(sent.shape[1], 2 * n_taps - 1)
    require_audible({"excitation": sent, "response": heard}, n_taps)
    fits = [_fit(sent[j : j + 1], responses, n_taps, ridge) for j, responses in enumerate(heard)]
    taps, residual_db, variance = zip(*fits, strict=True)
    return np.concatenate(taps, axis=1), np.stack(residual_db, axis=1), np.concatenate(variance, axis=1)


def _fit(sent: np.ndarray, heard: np.ndarray, n_taps: int, ridge: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the paths from J signals to K others, their residuals in dB and the squared errors to be expected."""
    taps, left, residual_db = fit_paths(sent, heard, n_taps, ridge)
    return taps, residual_db, squared_error(sent, left, taps, ridge)


def fit_paths(
    sent: np.ndarray, heard: np.ndarray, n_taps: int, regularization: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit the paths from J signals to K others.

    Return the taps (K, J, n_taps), what they leave unexplained, (K, n_samples - n_taps + 1), and its power in dB, (K,).
    """
    from scipy.linalg import cho_factor, cho_solve

    settled = heard[:, n_taps - 1 :]
    right = np.array([np.concatenate([cross_correlation(k, signal) for signal in sent]) for k in settled])
    ridges = regularization * np.mean(sent[:, n_taps - 1 :] ** 2, axis=1)
    is_definite = regularization > RANK_TOLERANCE
    if is_definite and right.shape[1] > _MOST_DENSE:
        fitted = ridge_solve(sent, right, ridges)
    else:
        matrix = correlation_matrix(sent, n_taps)
        matrix[np.diag_indices_from(matrix)] += np.repeat(ridges, n_taps)
        if len(sent) > 1 and is_definite:  # Cholesky's method saves most of the time
            fitted = cho_solve(cho_factor(matrix), right.T).T
        else:
            fitted = minimum_norm_solve(matrix, right)
    taps = fitted.reshape(len(heard), len(sent), n_taps)
    left = settled - [
        sum(np.convolve(signal, path, mode="valid") for signal, path in zip(sent, paths, strict=True)) for paths in taps
    ]
    unexplained = np.mean(left**2, axis=1) / np.mean(settled**2, axis=1)
    return taps, left, 10 * np.log10(np.maximum(unexplained, 1e-30))


def squared_error(sent: np.ndarray, left: np.ndarray, taps: np.ndarray, regularization: float) -> np.ndarray:
    """Return the squared error to be expected of fitted responses, (K, J, 257) from 0 to fs/2.

    Parameters
    ----------
    sent : ndarray, shape (J, n_samples)
        Excitations.
    left : ndarray, shape (K, n_samples - n_taps + 1)
        What the fit leaves unexplained.
    taps : ndarray, shape (K, J, n_taps)
        The fitted paths.
    regularization : float
        Ridge of the fit, relative to the power of the excitations.

    Notes
    -----
    The error has three parts. Noise of spectral density R, not correlated with the excitation of density X, gives a fit
    of L taps to N samples the variance ``L R / (N X)`` [1]_; it counts `CONFIDENCE` times. The path beyond L taps is
    the part of the residual that is correlated with the excitation, the cross-spectrum over X; it counts if it is
    larger than chance makes it. The ridge makes the response too small by its share of X.

    References
    ----------
    .. [1] L. Ljung, "System Identification: Theory for the User", 2nd ed., Prentice Hall, 1999, eq. 9.62.
    """
    from scipy.ndimage import maximum_filter1d
    from scipy.signal import csd, welch

    n_samples = left.shape[1]
    finer = max(1, min(max(8, -(-8 * taps.shape[2] // SEGMENT)), n_samples // (8 * SEGMENT)))  # to hold what is beyond
    size = min(finer * SEGMENT, max(n_samples // 16, 1))  # of few segments, a spectrum is known badly
    sent = sent[:, -n_samples:]
    shape: Any = {"nperseg": size, "nfft": finer * SEGMENT, "detrend": False}
    _, excitation = welch(sent, **shape)
    _, residual = welch(left, **shape)
    _, cross = csd(sent[np.newaxis], left[:, np.newaxis], **shape)
    excitation = np.maximum(excitation, np.finfo(float).tiny)
    ratio = np.maximum(residual, np.finfo(float).tiny)[:, np.newaxis] / excitation
    chance = ratio * size / (1.9 * n_samples)  # there are 1.9 independent Hann windows in the length of one
    beyond = np.abs(cross / excitation) ** 2
    beyond *= np.mean(beyond / chance, axis=-1, keepdims=True) > CORRELATED
    ridge = regularization * np.mean(sent**2, axis=-1, keepdims=True) / (0.5 * excitation)  # the spectra are one-sided
    bias = ridge * np.abs(np.fft.rfft(taps, finer * SEGMENT))
    error = (CONFIDENCE * np.sqrt(taps.shape[2] / n_samples * ratio) + np.sqrt(beyond) + bias) ** 2
    return maximum_filter1d(error, 2 * (finer // 2) + 1, axis=-1)[..., ::finer]


def _require_different(sent: np.ndarray, n_taps: int) -> None:
    """Raise ValueError if two excitations are the same signal at some delay."""
    past = sent[:, n_taps - 1 :]
    for j, signal in enumerate(sent):
        for i in range(j):
            size = np.sqrt(np.mean(past[i] ** 2) * np.mean(past[j] ** 2))
            one, other = cross_correlation(past[i], signal), cross_correlation(past[j], sent[i])
            if max(np.abs(one).max(), np.abs(other).max()) > _LARGEST_CORRELATION * size:
                raise ValueError(
                    f"excitation[{j}] must not be correlated with excitation[{i}], since their paths cannot be told "
                    "apart: play noises of different seeds, or let the loudspeakers play in turn"
                )


def _system(taps: np.ndarray, fs: float) -> control.TransferFunction:
    """Return paths (K, J, n_taps) as a system of J inputs and K outputs."""
    from control import TransferFunction

    denominator = np.eye(1, taps.shape[2])[0]
    return TransferFunction([list(row) for row in taps], [[denominator] * taps.shape[1]] * len(taps), 1 / fs)


def identify_secondary_path(
    plant: Plant,
    *,
    n_taps: int,
    duration_s: float,
    rng: Seed,
    level: float = 1.0,
    regularization: float = 1e-5,
    loudspeakers: str = "in turn",
) -> PathEstimate:
    """Simulate the identification of secondary paths, as it is done before the control starts.

    The excitation runs through the amplifier and the true path, sensor noise is added, and `estimate_path` fits the
    taps to excitation and response. Several loudspeakers play in turn, or noises of their own at once.

    Parameters
    ----------
    plant : Plant
        Plant with the true paths, the amplifiers and the noise of the microphones.
    n_taps : int
        Length of the estimate.
    duration_s : float
        Duration of the run in s; in turn, of each loudspeaker's run.
    rng : int or numpy.random.Generator
        Seed or generator of excitation and sensor noise.
    level : float, default 1.0
        Root mean square of the excitation, Gaussian white noise.
    regularization : float, default 1e-5
        As in `estimate_path`.
    loudspeakers : {"in turn", "at once"}, default "in turn"
        How several loudspeakers play.

    Returns
    -------
    PathEstimate
        Estimate, residual and misalignment, of each pair of a microphone and a loudspeaker if there are several.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range, the run is too short, or a path is silent.

    Examples
    --------
    >>> from kfopc_filterpy import Plant, bandpass_path
    >>> plant = Plant(bandpass_path(32, fs=16000), sensor_noise_std=0.01)
    >>> result = identify_secondary_path(plant, n_taps=32, duration_s=1.0, rng=1)
    >>> result.misalignment_db < -40
    True

    Two loudspeakers and two microphones, at once:

    >>> paths = [[[0.0, 1.0, 0.2], [0.0, 0.0, 0.5]], [[0.0, 0.0, 0.4], [0.0, 0.9, 0.1]]]
    >>> plant = Plant(paths, fs=8000, sensor_noise_std=0.01)
    >>> result = identify_secondary_path(plant, n_taps=3, duration_s=1.0, rng=1, loudspeakers="at once")
    >>> result.taps.shape, bool(result.misalignment_db.max() < -30)
    ((2, 2, 3), True)
    """
    as_constant_plant(plant, "identify_secondary_path")
    true, fs = plant.secondary, plant.fs
    several = true.shape[:2] != (1, 1)
    for k, j in np.argwhere(~np.any(true, axis=2)):
        raise ValueError(
            f"secondary path {k}, {j} must not be all zeros: an error relative to it is undefined; leave out the "
            "loudspeaker if it is unplugged, or the microphone if it is dead"
        )
    K, J, _ = true.shape
    n_samples = round(as_positive(duration_s, "duration_s", unit="s") * fs)
    n_taps = as_count(n_taps, "n_taps")
    in_turn = as_choice(loudspeakers, "loudspeakers", ("in turn", "at once")) == "in turn"
    needed = 2 * n_taps - 1 if in_turn else (J + 1) * n_taps - 1
    if n_samples < needed:
        raise ValueError(f"duration_s must be at least {needed / fs:.3g} s for {n_taps} taps, got {duration_s:g}")
    generator = as_generator(rng)
    sent = as_positive(level, "level") * generator.standard_normal((J, n_samples))
    received = _through(sent, plant.amplifiers, true)  # (J, K, n_samples)
    received = received if in_turn else received.sum(axis=0)
    received += plant.sensor_noise_std * generator.standard_normal(received.shape)
    if not several:
        sent, received = sent[0], received.reshape(-1)

    fitted = estimate_path(sent, received, n_taps, fs, regularization=regularization)
    found = fitted.taps.reshape(K, J, -1)
    misalignments = np.array([[misalignment_db(true[k, j], found[k, j]) for j in range(J)] for k in range(K)])
    return replace(fitted, misalignment_db=misalignments if several else float(misalignments[0, 0]))


def _through(sent: np.ndarray, amplifiers: Sequence[Any], paths: np.ndarray) -> np.ndarray:
    """Return what each loudspeaker alone adds to each microphone, (J, K, n_samples)."""
    from scipy.signal import lfilter

    received = np.empty((len(sent), len(paths), sent.shape[1]))
    for j, amplifier in enumerate(amplifiers):
        amplified = amplified_signal(amplifier, sent[j])
        for k, row in enumerate(paths):
            received[j, k] = lfilter(row[j], 1.0, amplified)
    return received


def misalignment_db(path: PathModel, estimate: PathModel) -> float:
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
    error = polysub(estimated, true)
    return float(10 * np.log10(max(np.sum(error**2) / np.sum(true**2), 1e-30)))
