"""Models of the primary and secondary path: band-pass filters, user taps, and perturbed copies of them.

Systems are python-control systems with one input and one output, in discrete time with `dt = 1/fs`; `path_taps` gives
the finite impulse response that a sample-by-sample loop runs. Tap arrays are accepted wherever a system is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from .._types import PathModel, System
from .._validate import as_band, as_count, as_number, as_positive, as_signal
from ..signals.recordings import Recording

if TYPE_CHECKING:
    import control

# Share of an impulse response's energy that may be cut off: -60 dB.
_TRUNCATION_CUT = 1e-6


def bandpass_path(
    n_taps: int,
    band: tuple[float, float] = (20.0, 5000.0),
    *,
    fs: float,
    window: str | float | tuple[str, float] | tuple[str, float, float] = "hamming",
) -> control.TransferFunction:
    """Design a linear-phase band-pass path, the path model of the paper's simulations.

    The paper uses 20-5000 Hz with 128 taps (primary) and 32 taps (secondary). So few taps cannot realise an edge of
    20 Hz; `achieved_band` shows what they do realise.

    Parameters
    ----------
    n_taps : int
        Length of the impulse response, at least 3. Its delay is ``(n_taps - 1) / 2`` samples.
    band : (float, float), default (20.0, 5000.0)
        Pass band (low, high) in Hz. ``low = 0`` gives a low-pass; ``high = fs/2`` gives a high-pass, which needs an odd
        `n_taps`.
    fs : float
        Sample rate in Hz; the paper's is 16000.
    window : str or tuple, default "hamming"
        Any window that `scipy.signal.get_window` knows.

    Returns
    -------
    control.TransferFunction
        The path, with ``dt = 1/fs``.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range.

    Examples
    --------
    >>> from kfopc_filterpy.paths import path_taps
    >>> path = bandpass_path(32, fs=16000)
    >>> path.dt, path_taps(path).size
    (6.25e-05, 32)
    """
    from scipy.signal import firwin

    fs = as_positive(fs, "fs", unit="Hz")
    n_taps = as_count(n_taps, "n_taps", minimum=3)
    low, high = as_band(band, fs)
    if low == 0 and high == fs / 2:
        raise ValueError(f"band must not be all of 0 to fs/2, ({low:g}, {high:g}) Hz: for a flat path use fir_path")
    if high == fs / 2 and n_taps % 2 == 0:
        raise ValueError(f"n_taps must be odd for a band that reaches fs/2, got {n_taps}; use {n_taps + 1}")
    edges = [edge for edge in (low, high) if 0 < edge < fs / 2]
    try:
        taps = firwin(n_taps, edges, window=window, pass_zero=low == 0, fs=fs)
    except (ValueError, TypeError) as error:
        raise ValueError(f"window must be one that scipy.signal.get_window knows, got {window!r}") from error
    return fir_path(taps, fs)


def fir_path(taps: ArrayLike, fs: float, name: str | None = None) -> control.TransferFunction:
    """Make a python-control system from an impulse response.

    Parameters
    ----------
    taps : array_like, shape (n_taps,)
        Impulse response, earliest sample first.
    fs : float
        Sampling rate in Hz.
    name : str, optional
        Name of the system.

    Returns
    -------
    control.TransferFunction
        ``taps[0] + taps[1] z^-1 + ...`` with ``dt = 1/fs``.

    Raises
    ------
    TypeError, ValueError
        If the taps are not a finite one-dimensional array or are all zero, or `fs` is not positive.

    Examples
    --------
    >>> path = fir_path([0.0, 1.0, 0.5], 8000.0)
    >>> path_taps(path)
    array([0. , 1. , 0.5])
    """
    from control import TransferFunction

    taps = as_signal(taps, "taps")
    if not np.any(taps):
        raise ValueError("taps must not all be zero: such a path carries no sound")
    fs = as_positive(fs, "fs", unit="Hz")
    return TransferFunction(taps, np.eye(1, taps.size)[0], 1 / fs, **({} if name is None else {"name": name}))


def is_system(path: object) -> TypeGuard[System]:
    """Tell whether `path` is a python-control system, by its attributes, so that control need not be imported."""
    return hasattr(path, "dt") and hasattr(path, "ninputs")


def tells_rate(path: object) -> bool:
    """Tell whether `path` states its sampling rate, as a python-control system and a recording do."""
    return is_system(path) or isinstance(path, Recording)


def sampling_rate(path: PathModel, fs: float | None = None, *, name: str = "path") -> float:
    """Return the sampling rate of a path in Hz: a system's or a recording's own, or `fs` for a tap array.

    Parameters
    ----------
    path : control.TransferFunction, control.StateSpace, Recording or array_like, shape (n_taps,)
        A discrete-time single-channel system, or an impulse response.
    fs : float, optional
        Sampling rate in Hz: needed for a tap array; with a system or a recording it must agree.
    name : str, default "path"
        The argument's name in error messages.

    Returns
    -------
    float
        Sampling rate in Hz.

    Raises
    ------
    TypeError, ValueError
        If the system is continuous or has several channels, its rate differs from `fs`, or `fs` is missing.

    Examples
    --------
    >>> sampling_rate(bandpass_path(32, fs=16000.0))
    16000.0
    """
    if fs is not None:
        fs = as_positive(fs, "fs", unit="Hz")
    if isinstance(path, Recording):
        if fs not in (None, path.fs):
            raise ValueError(f"{name} is sampled at {path.fs:g} Hz but fs is {fs:g} Hz; read it with fs={fs:g}")
        return path.fs
    if not is_system(path):
        if fs is None:
            raise ValueError(f"fs must be given if {name} is a tap array, which carries no sampling rate")
        return fs
    if (path.ninputs, path.noutputs) != (1, 1):
        raise ValueError(
            f"{name} must have one input and one output, got {path.ninputs} and {path.noutputs}; "
            f"pick a channel, e.g. {name}[0, 0]"
        )
    if path.dt is None or path.dt is True or path.dt == 0:
        raise ValueError(
            f"{name} must be a discrete-time system with a known sample time, got dt = {path.dt}; "
            "set dt = 1/fs, or convert a continuous system with control.sample_system"
        )
    rate = 1 / float(path.dt)
    if fs is not None and abs(rate - fs) > 1e-9 * fs:
        raise ValueError(f"{name} is sampled at {rate:g} Hz but fs is {fs:g} Hz; resample one (resample_path)")
    return rate if fs is None else fs


def finite_taps(path: PathModel, name: str = "path") -> np.ndarray | None:
    """Return the exact taps of a path, or None for a system with an infinite impulse response."""
    if not is_system(path):
        return as_signal(path, name)
    if hasattr(path, "A"):  # D, CB, CAB, ... until A^n B is 0, which n states do not outlast
        state, taps = path.B, [path.D]
        for _ in range(len(path.A)):
            taps, state = [*taps, path.C @ state], path.A @ state
        return None if np.any(state) else np.ravel(taps)
    if not hasattr(path, "num_array"):
        return None
    numerator, denominator = path.num_array[0, 0], path.den_array[0, 0]
    if np.any(denominator[1:]):
        return None
    # python-control strips the leading zeros of the numerator, which are the delay of the path.
    return np.concatenate([np.zeros(denominator.size - numerator.size), numerator / denominator[0]])


def path_taps(path: PathModel, *, fs: float | None = None, n_taps: int | None = None, name: str = "path") -> np.ndarray:
    """Return the impulse response of a path as an array, for running it sample by sample.

    Parameters
    ----------
    path : control.TransferFunction, control.StateSpace or array_like, shape (n_taps,)
        A discrete-time single-channel system, or an impulse response (which needs no python-control).
    fs : float, optional
        Sampling rate in Hz that a system must have.
    n_taps : int, optional
        Number of taps wanted; a shorter response is padded with zeros, a longer one cut. By default a finite response
        keeps its length; a system with an infinite response (IIR) needs a number.
    name : str, default "path"
        The argument's name in error messages.

    Returns
    -------
    numpy.ndarray, shape (n_taps,)
        Impulse response, earliest sample first; exact for a finite one.

    Raises
    ------
    TypeError, ValueError
        If the system has another sampling rate, is continuous, non-causal, unstable or multi-channel, has an infinite
        response and `n_taps` is not given, or has more than -60 dB of its energy beyond `n_taps`.

    Examples
    --------
    >>> import control
    >>> decay = control.TransferFunction([1.0, 0.0], [1.0, -0.5], 1 / 8000)
    >>> path_taps(decay, n_taps=12)[:4]
    array([1.   , 0.5  , 0.25 , 0.125])
    """
    if n_taps is not None:
        n_taps = as_count(n_taps, "n_taps")
    if tells_rate(path):
        sampling_rate(path, fs, name=name)
    if is_system(path) and hasattr(path, "num_array") and path.num_array[0, 0].size > path.den_array[0, 0].size:
        raise ValueError(f"{name} must be causal, but its numerator has a higher degree than its denominator")
    taps = finite_taps(path, name)
    if taps is None:
        if n_taps is None:
            raise ValueError(
                f"{name} has an infinite impulse response: say how many taps of it to compute, Plant(..., n_path=...), or "
                "pass path_taps(system, n_taps=...) to functions that take only taps or FIR systems"
            )
        taps = _infinite_response(path, 2 * n_taps, name)
    if not np.all(np.isfinite(taps)):
        raise ValueError(f"{name} must have finite coefficients, but its response holds NaN or Inf")
    if n_taps is None or n_taps == taps.size:
        return taps
    lost, energy = np.sum(taps[n_taps:] ** 2), np.sum(taps**2)
    if lost > _TRUNCATION_CUT * energy:
        raise ValueError(
            f"{n_taps} taps cut off {10 * np.log10(lost / energy):.1f} dB of the energy of {name}, "
            "more than -60 dB: its response has not decayed; use more taps"
        )
    return np.pad(taps[:n_taps], (0, max(n_taps - taps.size, 0)))


def _infinite_response(system: Any, length: int, name: str) -> np.ndarray:
    """Return the impulse response of a stable IIR system."""
    poles = np.abs(system.poles()) if hasattr(system, "poles") else None
    if poles is None:
        raise TypeError(f"{name} must be a TransferFunction or StateSpace, got {type(system).__name__}")
    if np.max(poles, initial=0.0) >= 1:
        raise ValueError(
            f"{name} must be stable, but has a pole of magnitude {poles.max():.6g}; a filter of high order "
            "is easily unstable as a transfer function: design it as second-order sections and pass its taps"
        )
    from scipy.signal import dimpulse, lfilter

    if hasattr(system, "num_array"):
        numerator, denominator = system.num_array[0, 0], system.den_array[0, 0]
        delay = denominator.size - numerator.size
        return lfilter(np.pad(numerator, (delay, 0)), denominator, np.eye(1, length)[0])
    return dimpulse((system.A, system.B, system.C, system.D, 1), n=length)[1][0][:, 0]


def stacked(responses: Sequence[np.ndarray]) -> np.ndarray:
    """Return impulse responses as rows of one array, the shorter ones filled with zeros."""
    longest = max(taps.size for taps in responses)
    return np.array([np.pad(taps, (0, longest - taps.size)) for taps in responses])


def perturbed_path(
    path: PathModel,
    *,
    gain_db: float = 0.0,
    phase_deg: float = 0.0,
    delay_samples: float = 0.0,
    fs: float | None = None,
) -> control.TransferFunction:
    """Return a copy of a path with another gain, phase and delay, to study a mismatched estimate.

    The response wanted is ``H(f) * 10^(gain_db/20) * exp(j phase) * exp(-j 2 pi f delay)``. Gains, whole samples of
    delay and multiples of 180 degrees are exact. Any other phase (the same at all frequencies, a Hilbert-type rotation)
    and fractions of a sample are fitted by least squares over 0.01 fs to 0.45 fs with 64 additional taps. For 90 degrees
    on the paper's 32-tap path at 16 kHz the fit is accurate to 2.5 degrees and 0.4 dB over 300-4500 Hz, and to
    1.5 degrees over 500-4500 Hz; for fractional delays it is better than 0.1 degree.

    Parameters
    ----------
    path : control.TransferFunction or array_like, shape (n_taps,)
        The path to copy (finite impulse response).
    gain_db : float, default 0.0
        Gain in dB.
    phase_deg : float, default 0.0
        Phase in degrees, positive for a lead; 90 is the stability bound of filtered-reference control.
    delay_samples : float, default 0.0
        Delay in samples. A negative delay advances the path, as far as its own delay allows.
    fs : float, optional
        Sampling rate in Hz, needed for a tap array.

    Returns
    -------
    control.TransferFunction
        The perturbed copy, with ``dt = 1/fs``.

    Raises
    ------
    ValueError
        If no causal filter comes within -20 dB of the response wanted, because the delay of the path is too short.

    Examples
    --------
    >>> louder = perturbed_path([0.0, 1.0, 0.5], gain_db=20.0, delay_samples=1, fs=8000.0)
    >>> path_taps(louder)
    array([ 0.,  0., 10.,  5.])
    """
    fs = sampling_rate(path, fs)
    taps = path_taps(path) * 10 ** (as_number(gain_db, "gain_db", unit="dB") / 20)
    phase = as_number(phase_deg, "phase_deg", unit="degrees") % 360.0
    delay = as_number(delay_samples, "delay_samples")
    if phase == 180.0:
        taps, phase = -taps, 0.0
    if phase == 0.0 and delay >= 0 and delay == round(delay):
        return fir_path(np.pad(taps, (round(delay), 0)), fs)
    return fir_path(_rotated(taps, np.deg2rad(phase), delay), fs)


def _rotated(taps: np.ndarray, phase: float, delay: float) -> np.ndarray:
    """Return causal taps, fitted to `taps` with a constant phase (rad) and a delay (samples) added."""
    n = taps.size + max(int(np.ceil(delay)), 0) + 64
    omega = np.linspace(0.0, np.pi, 4 * n)
    basis = np.exp(-1j * np.outer(omega, np.arange(n)))
    wanted = (basis[:, : taps.size] @ taps) * np.exp(1j * (phase - omega * delay))
    band = (omega >= 0.02 * np.pi) & (omega <= 0.9 * np.pi)
    # A real filter cannot rotate 0 Hz and fs/2. A small weight there keeps the gain from growing without bound.
    weight = np.where(band, 1.0, 0.1)[:, None]
    system = np.vstack([weight * basis.real, weight * basis.imag])
    target = np.concatenate([weight[:, 0] * wanted.real, weight[:, 0] * wanted.imag])
    fitted = np.linalg.lstsq(system, target, rcond=None)[0]
    error = np.linalg.norm((basis @ fitted - wanted)[band]) / np.linalg.norm(wanted[band])
    if error > 0.1:
        raise ValueError(
            f"phase_deg and delay_samples cannot be realised causally on this path: the best fit is "
            f"{20 * np.log10(error):.0f} dB off; use a path with more delay, or a larger delay_samples"
        )
    return fitted
