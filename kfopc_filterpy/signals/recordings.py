"""Recordings as files: vectors in MATLAB files, signals in audio files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from .._validate import as_channels, as_count, as_positive, as_real_array, as_signal

# A size that a WAV file's header states if its writer could not know it, because it wrote to a pipe.
_SIZE_UNKNOWN = 0xFFFFFFFF


def read_mat_vector(path: str | os.PathLike[str], variable: str) -> np.ndarray:
    """Read one real vector from a MATLAB file (version 4 to 7.2).

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
        If there is no such file.
    ValueError
        If the file cannot be read, does not hold the variable (the message lists those it holds), or the variable is
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
    """Read an audio file: WAV, or any other format that libsndfile reads, such as FLAC or AIFF.

    Whole-number samples are scaled so that full scale is 1.

    Parameters
    ----------
    path : path
        The audio file.
    fs : float, optional
        Sampling frequency in Hz that the file must have. By default any is taken.
    channel : int, optional
        Channel to read, from 0. By default all are read.

    Returns
    -------
    signal : ndarray, shape (n_samples,) or (n_channels, n_samples)
        The samples as float64. A file with several channels gives (n_channels, n_samples) unless one is chosen.
    fs : float
        Sampling frequency of the file in Hz.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not an audio file, is cut short, is empty or holds NaN or Inf, has another sampling frequency
        than `fs`, or does not have the channel.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_wav(folder + "/noise.wav", [[0.0, 0.5, -0.25], [1.0, 0.0, 0.0]], 16000)
    ...     signal, fs = read_wav(folder + "/noise.wav", 16000)
    >>> signal.tolist(), fs
    ([[0.0, 0.5, -0.25], [1.0, 0.0, 0.0]], 16000.0)
    """
    import soundfile

    _require_file(path)
    _require_whole(path)
    try:
        frames, file_fs = soundfile.read(path, dtype="float64", always_2d=True)
    except soundfile.SoundFileError as error:
        raise ValueError(f"{path} cannot be read as an audio file: {error}") from error
    if fs is not None and file_fs != as_positive(fs, "fs", unit="Hz"):
        raise ValueError(
            f"{path} is sampled at {file_fs} Hz, expected fs = {fs:g} Hz; read it without fs and "
            "resample it: a recording with scipy.signal.resample_poly, an impulse response with paths.resample_path"
        )
    name, channels = f"the signal of {path}", frames.T
    if channel is not None:
        index = as_count(channel, "channel", minimum=0)
        if index >= len(channels):
            raise ValueError(f"channel must be below the {len(channels)} channel(s) of {path}, got {index}")
        return as_signal(channels[index], name), float(file_fs)
    return as_channels(channels[0] if len(channels) == 1 else channels, name), float(file_fs)


def write_wav(path: str | os.PathLike[str], signal: Any, fs: float, *, peak: float | None = None) -> None:
    """Write a signal as a WAV file, by default unscaled in 32-bit floating point.

    Files that are to be compared by ear need one scale: pass the same `peak`, the largest magnitude among all of them,
    to each.

    Parameters
    ----------
    path : path
        The file to write; an existing one is replaced.
    signal : array_like, shape (n_samples,) or (n_channels, n_samples)
        The signal. NaN at its end, as in a diverged run, becomes silence.
    fs : float
        Sampling frequency in Hz, a whole number.
    peak : float, optional
        Signal value that becomes full scale of a 16-bit file. By default the values are written unscaled in 32-bit
        floating point; players clip those beyond 1.

    Raises
    ------
    ValueError, TypeError
        If the signal is empty, exceeds `peak`, or holds Inf, or NaN before its end; if fs is not a whole number.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_wav(folder + "/error.wav", [4.0, -2.0, float("nan")], 16000, peak=4.0)
    ...     signal, fs = read_wav(folder + "/error.wav")
    >>> signal.round(3).tolist()
    [1.0, -0.5, 0.0]
    """
    # Not soundfile, which puts the time of writing into floating-point files: the same signal gives the same bytes.
    from scipy.io import wavfile

    samples = _silent_tail(signal)
    rate = as_positive(fs, "fs", unit="Hz")
    if rate != round(rate):
        raise ValueError(f"fs must be a whole number of Hz in a WAV file, got {rate:g} Hz")
    if peak is None:
        wavfile.write(path, round(rate), samples.T.astype(np.float32))
        return
    full_scale = as_positive(peak, "peak")
    largest = np.max(np.abs(samples))
    if largest > full_scale:
        raise ValueError(
            f"signal reaches {largest:g}, beyond peak = {full_scale:g}; raise peak, or limit the signal with np.clip"
        )
    wavfile.write(path, round(rate), np.round(samples.T / full_scale * 32767).astype(np.int16))


def _require_file(path: str | os.PathLike[str]) -> None:
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path} does not exist or is not a file; the current folder is {Path.cwd()}")


def _require_whole(path: str | os.PathLike[str]) -> None:
    """Raise ValueError if a WAV file is shorter than its header says: libsndfile would read what is left of it."""
    with open(path, "rb") as file:
        riff, size, kind = file.read(4), int.from_bytes(file.read(4), "little"), file.read(4)
    held = Path(path).stat().st_size - 8
    if (riff, kind) == (b"RIFF", b"WAVE") and held < size != _SIZE_UNKNOWN:
        raise ValueError(f"{path} cannot be read as an audio file: it is cut short, at {held} of {size} bytes")


def _silent_tail(signal: Any) -> np.ndarray:
    """Return the signal with the NaN at the end of each channel replaced by zeros."""
    samples = as_real_array(signal, "signal").copy()
    for channel in np.atleast_2d(samples) if samples.ndim < 3 else ():
        numbers = np.flatnonzero(~np.isnan(channel))
        channel[numbers[-1] + 1 if numbers.size else 0 :] = 0.0
    return as_channels(samples, "signal")
