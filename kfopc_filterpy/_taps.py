"""Paths as taps: arrays, python-control systems and recordings are read here, one path or a matrix of them.

Systems are in discrete time with `dt = 1/fs`; `path_taps` gives the finite impulse response that a sample-by-sample
loop runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeGuard

import numpy as np

from ._types import PathModel, PathModels, System
from ._validate import as_count, as_positive, as_real_array, as_signal, require_finite, same_rate
from .signals.recordings import Recording

# Share of an impulse response's energy that may be cut off: -60 dB.
_TRUNCATION_CUT = 1e-6
# Channels of which a plant has fewer: an axis that is longer than this and than that of the taps was meant to be
# theirs.
_MANY_CHANNELS = 8
SECONDARY_AXES = "(K microphones, J loudspeakers, taps)"
PRIMARY_AXES = "(K microphones, I references, taps)"
FEEDBACK_AXES = "(I references, J loudspeakers, taps)"


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
    >>> from kfopc_filterpy import bandpass_path
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
    if fs is not None and not same_rate(rate, fs):
        raise ValueError(f"{name} is sampled at {rate:g} Hz but fs is {fs:g} Hz; resample one (resample_path)")
    return rate if fs is None else fs


def finite_taps(path: PathModel, name: str = "path") -> np.ndarray | None:
    """Return the exact taps of a path, or None for a system with an infinite impulse response."""
    if not is_system(path):
        taps = as_real_array(path, name)
        return as_signal(taps[0, 0] if taps.shape[:-1] == (1, 1) else taps, name)
    if hasattr(path, "A"):  # D, CB, CAB, ... until A^n B is 0, which n states do not outlast
        state, response = path.B, [path.D]
        for _ in range(len(path.A)):
            response, state = [*response, path.C @ state], path.A @ state
        return None if np.any(state) else np.ravel(response)
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
    path : control.TransferFunction, control.StateSpace or array_like, shape (n_taps,) or (1, 1, n_taps)
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


def lengthened(paths: np.ndarray, n_taps: int) -> np.ndarray:
    """Return paths (outputs, inputs, taps), filled with zeros to so many taps."""
    return np.pad(paths, ((0, 0), (0, 0), (0, n_taps - paths.shape[2])))


def secondary_paths(
    paths: PathModels, *, fs: float | None = None, n_taps: int | None = None, name: str = "secondary"
) -> tuple[np.ndarray, float | None]:
    """Return secondary paths as taps (K, J, n_taps), and their sampling rate in Hz if systems tell it."""
    return path_matrix(paths, fs=fs, n_taps=n_taps, name=name, axes=SECONDARY_AXES)


def primary_paths(
    paths: PathModels, *, fs: float | None = None, n_taps: int | None = None, name: str = "primary"
) -> tuple[np.ndarray, float | None]:
    """Return primary paths as taps (K, I, n_taps), and their sampling rate in Hz if systems tell it.

    Taps (K, n_taps) are those of one reference.
    """
    if not is_system(paths) and not _has_entries(paths) and np.ndim(paths) == 2:
        rate = sampling_rate(paths, fs, name=name) if tells_rate(paths) else None
        return path_matrix(as_real_array(paths, name)[:, np.newaxis], fs=fs, name=name, axes=PRIMARY_AXES)[0], rate
    return path_matrix(paths, fs=fs, n_taps=n_taps, name=name, axes=PRIMARY_AXES)


def feedback_paths(
    paths: PathModels, *, fs: float | None = None, n_taps: int | None = None, name: str = "feedback"
) -> tuple[np.ndarray, float | None]:
    """Return the paths from loudspeakers to reference microphones as taps (I, J, n_taps), and their sampling rate."""
    taps, rate = path_matrix(paths, fs=fs, n_taps=n_taps, name=name, axes=FEEDBACK_AXES)
    for first in taps[..., 0].flat:
        if first != 0.0:
            raise ValueError(f"{name} must have a delay of a sample at least: a first tap is {first:g}, not 0")
    return taps, rate


def path_matrix(
    paths: PathModels, *, fs: float | None, name: str, axes: str = "(outputs, inputs, taps)", n_taps: int | None = None
) -> tuple[np.ndarray, float | None]:
    """Return paths as taps (outputs, inputs, n_taps), and their sampling rate in Hz if systems tell it.

    `n_taps` is the length to which infinite responses of systems are computed.
    """
    if is_system(paths):
        if (paths.noutputs, paths.ninputs) == (1, 1):
            return _taps_of(paths, fs, n_taps, name).reshape(1, 1, -1), sampling_rate(paths, fs, name=name)
        rows = [[paths[k, j] for j in range(paths.ninputs)] for k in range(paths.noutputs)]
        return _from_entries(rows, fs, n_taps, name, axes)
    if _has_entries(paths):
        return _from_entries(paths, fs, n_taps, name, axes)
    taps = as_real_array(paths, name)
    if taps.ndim == 1:
        taps = taps.reshape(1, 1, -1)
    if taps.ndim != 3 or 0 in taps.shape:
        raise ValueError(f"{name} must have shape {axes}, got {taps.shape}")
    if max(taps.shape[:2]) > max(taps.shape[2], _MANY_CHANNELS):
        raise ValueError(f"{name} must have shape {axes}, got {taps.shape}: taps come last, see numpy.moveaxis")
    require_finite(taps, name)
    return np.ascontiguousarray(taps), sampling_rate(paths, fs, name=name) if tells_rate(paths) else None


def _has_entries(paths: Any) -> bool:
    """Return whether paths are rows of systems, recordings or arrays, which may differ in length."""
    rows = paths if isinstance(paths, list | tuple) else ()
    entries = [entry for row in rows if isinstance(row, list | tuple) for entry in row]
    return any(tells_rate(entry) or (isinstance(entry, np.ndarray) and entry.ndim == 1) for entry in entries)


def sampled_path_matrix(paths: PathModels, fs: float | None, name: str, axes: str) -> tuple[np.ndarray, float]:
    """Return paths as taps (outputs, inputs, n_taps), and their sampling rate in Hz: the systems' own, or `fs`."""
    taps, rate = path_matrix(paths, fs=fs, name=name, axes=axes)
    return taps, sampling_rate(taps, fs, name=name) if rate is None else rate


def _taps_of(path: Any, fs: float | None, n_taps: int | None, name: str) -> np.ndarray:
    """Return the taps of a path; `n_taps` of them if its response is infinite."""
    return path_taps(path, fs=fs, n_taps=None if finite_taps(path, name) is not None else n_taps, name=name)


def _from_entries(
    rows: Any, fs: float | None, n_taps: int | None, name: str, axes: str
) -> tuple[np.ndarray, float | None]:
    if len({len(row) for row in rows}) != 1:
        raise ValueError(f"{name} must be {axes}: its rows differ in length")
    rates = {sampling_rate(path, fs, name=name) for row in rows for path in row if tells_rate(path)}
    if len(rates) > 1:
        raise ValueError(f"{name} has systems of different sampling rates: {sorted(rates)} Hz")
    entries = [(path, f"{name}[{k}][{j}]") for k, row in enumerate(rows) for j, path in enumerate(row)]
    taps = stacked([_taps_of(path, fs, n_taps, entry) for path, entry in entries])
    return taps.reshape(len(rows), len(rows[0]), -1), rates.pop() if rates else None
