"""Measured impulse responses as files."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np

from ..signals.content import Content, require_room
from ..signals.recordings import Recording, rates_of, read_content, scaled
from .resampling import resample_path

_LOST_BEFORE_ZERO = 1e-4  # share of the energy, -40 dB


def read_path(
    path: str | os.PathLike[str],
    *,
    fs: float | None = None,
    channel: int | None = None,
    variable: str | None = None,
    unit: str | None = None,
    unit_per_full_scale: float | None = None,
    file_fs: float | None = None,
) -> Recording:
    """Read the impulse response of a path: all formats of `read_recording`, and text exported by REW.

    At another rate, an impulse response keeps its sum, which is the path's gain, where a recording keeps its height; so
    `resample_path` is what resamples it. The first tap is at time 0. A file that states the time of its first sample
    (REW, text with a column of times) is shifted, to the nearest sample, and what is before time 0 is cut off.

    Parameters
    ----------
    path : path
        The file.
    fs : float, optional
        Sampling frequency wanted in Hz: a path with another is resampled by `resample_path`. By default it stays as it
        is. A file that states no rate is taken to be sampled at `fs`, unless `file_fs` says otherwise.
    channel : int, optional
        Channel to read, from 0. By default all are read.
    variable : str, optional
        Variable of a .mat or .npz file, or field of a struct: "meas.ir". By default the only one with several values.
    unit : str, optional
        Unit of the taps, after scaling: "Pa/V". By default "1".
    unit_per_full_scale : float, optional
        What the number 1 in the file stands for, in `unit`: the factor of the recording at the path's end over the
        factor of the signal at its beginning.
    file_fs : float, optional
        Sampling frequency in Hz of a file that states none.

    Returns
    -------
    Recording
        Taps as float64: (n_taps,); (n_channels, n_taps) from a file with several channels; (K microphones,
        J loudspeakers, n_taps) from arrays with three axes.

    Raises
    ------
    FileNotFoundError, OSError, ModuleNotFoundError, ValueError, TypeError
        As `read_recording`.
    ValueError
        If more than -40 dB of the energy is before time 0, as in a measurement without a timing reference; if the file
        is REW's minimum-phase version; if a path cannot be resampled, see `resample_path`.

    See Also
    --------
    kfopc_filterpy.signals.read_recording : for recordings.

    Examples
    --------
    >>> import tempfile
    >>> from kfopc_filterpy.signals import write_wav
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_wav(folder + "/secondary.wav", [0.0] * 30 + [0.5, 0.25] + [0.0] * 28, 48000)
    ...     secondary = read_path(folder + "/secondary.wav", fs=16000, unit="Pa/V")
    >>> secondary
    <Recording secondary.wav: 0.00187 s, 30 samples at 16000 Hz (48000 Hz in the file), in Pa/V>
    >>> round(float(secondary.samples.sum()), 2)  # its gain at 0 Hz
    0.75
    """
    content = read_content(path, channel=channel, variable=variable)
    return path_of(path, content, fs, file_fs, unit, unit_per_full_scale)


def path_of(
    path: str | os.PathLike[str],
    content: Content,
    fs: float | None,
    file_fs: float | None,
    unit: str | None = None,
    unit_per_full_scale: float | None = None,
) -> Recording:
    """Return the content of a file as the taps of paths; the arguments are those of `read_path`."""
    rate, wanted, stated = rates_of(path, content, fs, file_fs)
    taps, unit = scaled(content, unit, unit_per_full_scale)
    if content.start_s:
        taps = _from_time_zero(path, taps, content.start_s * rate)
    if wanted != rate:
        require_room(path, taps.size * wanted / rate, what=f"resampled from {rate:g} to {wanted:g} Hz it has")
        rows = [resample_path(row, wanted, fs=rate) for row in taps.reshape(-1, taps.shape[-1])]
        taps = np.reshape(rows, (*taps.shape[:-1], -1))
    return Recording(taps, wanted, unit, Path(path).name, stated)


def _from_time_zero(path: str | os.PathLike[str], taps: np.ndarray, start: float) -> np.ndarray:
    """Return the taps from time 0 on; `start` is the time of the first in samples."""
    if start > 0:
        require_room(path, taps.size / taps.shape[-1] * (taps.shape[-1] + start), what="with its start time it has")
        silence = np.zeros((*taps.shape[:-1], round(start)))
        return np.concatenate([silence, taps], axis=-1)
    early, rest = np.split(taps, [min(round(-start), taps.shape[-1])], axis=-1)
    share = np.sum(early**2) / (np.sum(taps**2) or 1.0)
    if share > _LOST_BEFORE_ZERO or rest.size == 0:
        level = f"{10 * math.log10(share):.1f} dB of its energy" if share else "all of it"
        raise ValueError(
            f"{path} has {level} before time 0, more than -40 dB, so it tells no delay: measure it with a timing reference "
            "(a loopback), or give it a start time at which it is causal"
        )
    return np.ascontiguousarray(rest)
