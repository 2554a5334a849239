"""Recordings as files: vectors out of MATLAB files, WAV files in and out."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from .._validate import as_count, as_positive, as_signal, require_finite

__all__ = ["read_mat_vector", "read_wav", "write_wav"]


def read_mat_vector(path: str | os.PathLike[str], variable: str) -> np.ndarray:
    """One real vector out of a MATLAB file (version 4 to 7.2).

    Parameters
    ----------
    path : path
        The MAT file.
    variable : str
        Name of the variable; its shape is (n, 1), (1, n) or (n,).

    Returns
    -------
    ndarray, shape (n,)
        The values as float64.

    Raises
    ------
    FileNotFoundError
        Where there is no such file.
    ValueError
        Where the file cannot be read, the variable is not in it (the message lists those that are), or it is
        empty, complex, not numeric, not a vector, or holds NaN or Inf.

    Examples
    --------
    >>> import tempfile, scipy.io
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     scipy.io.savemat(folder + "/path.mat", {"S": [[0.0], [1.0], [0.5]]})
    ...     read_mat_vector(folder + "/path.mat", "S").tolist()
    [0.0, 1.0, 0.5]
    """
    import scipy.io

    _require_file(path)
    try:
        content = scipy.io.loadmat(path)
    except NotImplementedError as error:
        raise ValueError(f"{path} is a MAT file of version 7.3; save it with MATLAB's -v7 option") from error
    # A damaged file can make loadmat raise nearly anything, zlib.error and IndexError among others.
    except Exception as error:
        raise ValueError(f"{path} cannot be read as a MAT file: {error}") from error
    if variable not in content:
        there = ", ".join(sorted(name for name in content if not name.startswith("__"))) or "none"
        raise ValueError(f"variable {variable!r} is not in {path}; it holds: {there}")
    value = np.asarray(content[variable])
    name = f"variable {variable!r} of {path}"
    if value.dtype.kind not in "fiub":
        raise ValueError(f"{name} must hold real numbers, got {value.dtype}")
    if value.size == 0 or value.size != max(value.shape):
        raise ValueError(f"{name} must be a vector with at least one value, got shape {value.shape}")
    return as_signal(value.ravel(), name)


def read_wav(
    path: str | os.PathLike[str], fs: float | None = None, *, channel: int | None = None
) -> tuple[np.ndarray, float]:
    """One channel of a WAV file; whole-number samples are scaled so that full scale is 1.

    Parameters
    ----------
    path : path
        The WAV file: 8 to 32-bit PCM, or floating point.
    fs : float, optional
        The sampling frequency it has to have, in Hz. None takes any.
    channel : int, optional
        Channel to take, from 0; needed where the file has several.

    Returns
    -------
    signal : ndarray, shape (n_samples,)
        The samples as float64.
    fs : float
        The file's sampling frequency in Hz.

    Raises
    ------
    FileNotFoundError
        Where there is no such file.
    ValueError
        Where the file is not a WAV file, is cut short, empty or not finite, has another sampling frequency
        than `fs`, or has several channels and none is chosen.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_wav(folder + "/noise.wav", [0.0, 0.5, -0.25], 16000)
    ...     signal, fs = read_wav(folder + "/noise.wav", 16000)
    >>> signal.tolist(), fs
    ([0.0, 0.5, -0.25], 16000.0)
    """
    from scipy.io import wavfile

    _require_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", wavfile.WavFileWarning)
            # Chunks with titles, markers and the like are no part of the sound.
            warnings.filterwarnings("ignore", message="Chunk", category=wavfile.WavFileWarning)
            file_fs, samples = wavfile.read(path)
    # A damaged header can also run into struct.error or a division by zero.
    except Exception as error:
        raise ValueError(f"{path} cannot be read as a WAV file: {error}") from error
    if fs is not None and file_fs != as_positive(fs, "fs", unit="Hz"):
        raise ValueError(
            f"{path} is sampled at {file_fs} Hz, expected fs = {fs:g} Hz; resample it (scipy.signal.resample_poly)"
        )
    return as_signal(_full_scale(_one_channel(samples, channel, path)), f"the signal of {path}"), float(file_fs)


def write_wav(path: str | os.PathLike[str], signal: Any, fs: float, *, peak: float | None = None) -> None:
    """Write a signal as a WAV file, by default as it is, in 32-bit floating point.

    Files that are to be compared by ear need one scale: pass the same `peak`, the largest magnitude among all
    of them, to each.

    Parameters
    ----------
    path : path
        The file to write; one that is there is replaced.
    signal : array_like, shape (n_samples,)
        The signal. NaN at its end, as a diverged run has it, becomes silence.
    fs : float
        Sampling frequency in Hz, a whole number.
    peak : float, optional
        The signal value that becomes full scale of a 16-bit file. None writes the values unscaled, in 32-bit
        floating point; players clip those beyond 1.

    Raises
    ------
    ValueError, TypeError
        Where the signal is empty, exceeds `peak`, or holds Inf, or NaN before its end; where fs is not a
        whole number.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_wav(folder + "/error.wav", [4.0, -2.0, float("nan")], 16000, peak=4.0)
    ...     signal, fs = read_wav(folder + "/error.wav")
    >>> signal.round(3).tolist()
    [1.0, -0.5, 0.0]
    """
    from scipy.io import wavfile

    samples = _silent_tail(signal)
    rate = as_positive(fs, "fs", unit="Hz")
    if rate != round(rate):
        raise ValueError(f"fs must be a whole number of Hz in a WAV file, got {rate:g} Hz")
    if peak is None:
        wavfile.write(path, round(rate), samples.astype(np.float32))
        return
    full_scale = as_positive(peak, "peak")
    largest = np.max(np.abs(samples))
    if largest > full_scale:
        raise ValueError(
            f"signal reaches {largest:g}, beyond peak = {full_scale:g}; raise peak, or limit the signal with np.clip"
        )
    wavfile.write(path, round(rate), np.round(samples / full_scale * 32767).astype(np.int16))


def _require_file(path: str | os.PathLike[str]) -> None:
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path} does not exist or is not a file; the current folder is {Path.cwd()}")


def _one_channel(samples: np.ndarray, channel: int | None, path: str | os.PathLike[str]) -> np.ndarray:
    channels = samples.reshape(len(samples), -1)
    count = channels.shape[1]
    if channel is None and count > 1:
        raise ValueError(f"{path} has {count} channels; choose one with channel=0 to channel={count - 1}")
    index = as_count(channel or 0, "channel", minimum=0)
    if index >= count:
        raise ValueError(f"channel must be below the {count} channel(s) of {path}, got {index}")
    return channels[:, index]


def _full_scale(samples: np.ndarray) -> np.ndarray:
    """Samples as float64, whole numbers scaled to full scale 1."""
    if samples.dtype.kind == "f":
        return samples.astype(np.float64)
    if samples.dtype == np.uint8:
        # 8-bit WAV samples are unsigned, silence at 128.
        return (samples.astype(np.float64) - 128) / 128
    return samples.astype(np.float64) / (np.iinfo(samples.dtype).max + 1.0)


def _silent_tail(signal: Any) -> np.ndarray:
    """Signal with the NaN at its end replaced by zeros."""
    samples = np.array(signal, dtype=np.float64)
    numbers = np.flatnonzero(~np.isnan(samples.ravel()))
    end = numbers[-1] + 1 if numbers.size else 0
    if samples.ndim == 1:
        samples[end:] = 0.0
    require_finite(samples, "signal")
    return as_signal(samples, "signal")
