"""Paths between several loudspeakers, references and microphones, as one array of taps."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._types import PathModels
from .._validate import as_real_array, require_finite
from .models import finite_taps, is_system, path_taps, sampling_rate, stacked, tells_rate

SECONDARY_AXES = "(K microphones, J loudspeakers, taps)"
PRIMARY_AXES = "(K microphones, I references, taps)"
FEEDBACK_AXES = "(I references, J loudspeakers, taps)"


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
    if not is_system(paths) and not _has_systems(paths) and np.ndim(paths) == 2:
        rate = sampling_rate(paths, fs, name=name) if tells_rate(paths) else None
        return path_matrix(as_real_array(paths, name)[:, np.newaxis], fs=fs, name=name, axes=PRIMARY_AXES)[0], rate
    return path_matrix(paths, fs=fs, n_taps=n_taps, name=name, axes=PRIMARY_AXES)


def single_path(path: PathModels, name: str, fs: float | None = None) -> tuple[np.ndarray, float | None]:
    """Return one path as taps, (n_taps,), and its sampling rate in Hz if a system tells it."""
    return path_taps(path, fs=fs, name=name), sampling_rate(path, fs, name=name) if tells_rate(path) else None


def feedback_paths(
    paths: PathModels, *, fs: float | None = None, n_taps: int | None = None, name: str = "feedback"
) -> tuple[np.ndarray, float | None]:
    """Return the paths from the loudspeakers to the reference microphones as taps (I, J, n_taps), and their sampling rate."""
    taps, rate = path_matrix(paths, fs=fs, n_taps=n_taps, name=name, axes=FEEDBACK_AXES)
    for first in taps[..., 0].flat:
        if first != 0.0:
            raise ValueError(f"{name} must have a delay of a sample at least: a first tap is {first:g}, not 0")
    return taps, rate


def is_path_matrix(paths: PathModels) -> bool:
    """Return whether paths are given as a matrix (outputs, inputs, taps), be it one by one, or as a matrix of systems."""
    if is_system(paths):
        return (paths.noutputs, paths.ninputs) != (1, 1)
    return _has_systems(paths) or np.ndim(paths) > 1


def path_matrix(
    paths: PathModels,
    *,
    fs: float | None,
    name: str,
    axes: str = "(outputs, inputs, taps)",
    n_taps: int | None = None,
) -> tuple[np.ndarray, float | None]:
    """Return paths as taps (outputs, inputs, n_taps), and their sampling rate in Hz if systems tell it.

    `n_taps` is the length to which infinite responses of systems are computed.
    """
    if is_system(paths):
        if (paths.noutputs, paths.ninputs) == (1, 1):
            return _taps_of(paths, fs, n_taps, name).reshape(1, 1, -1), sampling_rate(paths, fs, name=name)
        rows = [[paths[k, j] for j in range(paths.ninputs)] for k in range(paths.noutputs)]
        return _from_systems(rows, fs, n_taps, name, axes)
    if _has_systems(paths):
        return _from_systems(paths, fs, n_taps, name, axes)
    taps = as_real_array(paths, name)
    if taps.ndim == 1:
        taps = taps.reshape(1, 1, -1)
    if taps.ndim != 3 or 0 in taps.shape:
        raise ValueError(f"{name} must have shape {axes}, got {taps.shape}")
    if max(taps.shape[:2]) > taps.shape[2]:
        raise ValueError(f"{name} must have shape {axes}, got {taps.shape}: taps come last, see numpy.moveaxis")
    require_finite(taps, name)
    return np.ascontiguousarray(taps), sampling_rate(paths, fs, name=name) if tells_rate(paths) else None


def _has_systems(paths: Any) -> bool:
    rows = paths if isinstance(paths, list | tuple) else ()
    return any(tells_rate(entry) for row in rows if isinstance(row, list | tuple) for entry in row)


def sampled_path_matrix(paths: PathModels, fs: float | None, name: str, axes: str) -> tuple[np.ndarray, float]:
    """Return paths as taps (outputs, inputs, n_taps), and their sampling rate in Hz: the systems' own, or `fs`."""
    taps, rate = path_matrix(paths, fs=fs, name=name, axes=axes)
    return taps, sampling_rate(taps, fs, name=name) if rate is None else rate


def _taps_of(path: Any, fs: float | None, n_taps: int | None, name: str) -> np.ndarray:
    """Return the taps of a path; `n_taps` of them if its response is infinite."""
    return path_taps(path, fs=fs, n_taps=None if finite_taps(path, name) is not None else n_taps, name=name)


def _from_systems(
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
