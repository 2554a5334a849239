"""Recordings as files: read from the formats that people have, with rate and unit, and written as WAV."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .._validate import (
    as_channels,
    as_count,
    as_number,
    as_positive,
    as_rate,
    as_rate_ratio,
    as_real_array,
    require_finite,
)
from .._writing import replacing
from .arrays import read_npy, read_npz
from .audio import read_audio
from .content import (
    LEAST_SURE_RATE,
    Content,
    agreed_rate,
    channels_first,
    even_step,
    reading,
    require_file,
    require_room,
    rounding_of,
)
from .matlab import read_mat
from .text import Table, read_text, without_time

_REFERENCE_PRESSURE = 20e-6  # Pa, of sound pressure levels
_LEAST_TONE_S = 0.5  # of a calibrator
_LEAST_TONE_SHARE = 0.9  # of the power of a calibrator's recording
_LARGEST_DRIFT_DB = 0.5


class _Format(NamedTuple):
    """A file format: its name in messages, and its reader, which takes a path, and perhaps a variable."""

    name: str
    read: Callable[..., Content]
    suffixes: tuple[str, ...]
    beginnings: tuple[bytes, ...] = ()  # first bytes, by which a file without a known suffix is recognised
    has_variables: bool = False
    holds_arrays: bool = False  # whose axes, and times among them, nothing names


AUDIO_FILES = (".wav", ".wave", ".bwf", ".rf64", ".flac", ".aif", ".aiff", ".aifc")
_REFUSED_AUDIO = (".m4a", ".aac", ".mp3", ".ogg", ".oga", ".opus", ".wma", ".w64", ".caf", ".au")  # with the remedy
_AUDIO_HEADS = (b"RIFF", b"RIFX", b"RF64", b"BW64", b"FORM", b"fLaC")
_REFUSED_HEADS = (b"OggS", b"ID3", b"\xff\xfb", b"riff", b"caff", b".snd")
_AUDIO = _Format("an audio file", read_audio, AUDIO_FILES + _REFUSED_AUDIO, _AUDIO_HEADS + _REFUSED_HEADS)
_MAT = _Format("a MAT file", read_mat, (".mat",), (b"MATLAB",), has_variables=True, holds_arrays=True)
_TEXT = _Format("text", read_text, (".txt", ".csv", ".tsv", ".dat", ".asc", ".frd", ".zma"))
_NPY = _Format("a .npy file", read_npy, (".npy",), (b"\x93NUMPY",), holds_arrays=True)
_NPZ = _Format("a .npz file", read_npz, (".npz",), (b"PK\x03\x04",), has_variables=True, holds_arrays=True)
_FORMATS = (_AUDIO, _MAT, _TEXT, _NPY, _NPZ)


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """Samples that were read from a file, with their rate and unit: of a recording, or the taps of measured paths.

    Functions take it in place of an array; `simulate` and those that take paths check its rate.

    Attributes
    ----------
    samples : ndarray, shape (n_samples,) or (n_channels, n_samples)
        The samples, or the taps of a path. Paths from a file that has a matrix of them are (K microphones,
        J loudspeakers, n_taps).
    fs : float
        Sampling frequency in Hz.
    unit : str, default "1"
        Unit of the samples: "Pa", "V", "Pa/V"; "1" is full scale of an audio file, or not known.
    name : str, default ""
        Where they come from, for messages: the file's name.
    file_fs : float, optional
        Sampling frequency in Hz that the file states. None if it states none: then the caller gave it.

    Raises
    ------
    ValueError, TypeError
        If the samples are empty, not finite or have more channels than samples, or a rate is not above 0.

    Examples
    --------
    >>> Recording(np.zeros((2, 4000)), 8000, unit="Pa", name="fan.wav", file_fs=44100)
    <Recording fan.wav: 0.5 s, 2 x 4000 samples at 8000 Hz (44100 Hz in the file), in Pa>
    """

    samples: np.ndarray
    fs: float
    unit: str = "1"
    name: str = ""
    file_fs: float | None = None

    def __post_init__(self) -> None:
        name = f"the signal of {self.name}" if self.name else "samples"
        samples = as_real_array(self.samples, name)
        if samples.ndim == 3 and samples.size:
            require_finite(samples, name)
        else:
            samples = as_channels(samples, name)
        object.__setattr__(self, "samples", samples)
        object.__setattr__(self, "fs", as_rate(self.fs, "fs"))
        if self.file_fs is not None:
            object.__setattr__(self, "file_fs", as_rate(self.file_fs, "file_fs"))

    def one_channel(self) -> np.ndarray:
        """Return the samples of the only channel, (n_samples,).

        Raises
        ------
        ValueError
            If there are several channels. Read the file with `channel`.

        Examples
        --------
        >>> Recording([[1.0, 2.0, 3.0]], 8000).one_channel().tolist()
        [1.0, 2.0, 3.0]
        """
        if self.samples.size != self.samples.shape[-1]:
            count = math.prod(self.samples.shape[:-1])
            name = self.name or "the recording"
            raise ValueError(
                f"{name} has {count} channels where one is needed: read it with channel=0 to channel={count - 1} (in a "
                f"command, name one of {name}:0 to {name}:{count - 1})"
            )
        return self.samples.reshape(-1)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """Return the samples: whatever takes an array takes a recording."""
        return np.array(self.samples, dtype=dtype) if copy else np.asarray(self.samples, dtype=dtype)

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.samples.shape))
        other = f" ({self.file_fs:g} Hz in the file)" if self.file_fs not in (None, self.fs) else ""
        given = " (not stated in the file)" if self.file_fs is None and self.name else ""
        unit = f", in {self.unit}" if self.unit != "1" else ""
        name = f" {self.name}" if self.name else ""
        length = f"{self.samples.shape[-1] / self.fs:.3g} s, {shape} samples at {self.fs:g} Hz"
        return f"<Recording{name}: {length}{other}{given}{unit}>"


def read_recording(
    path: str | os.PathLike[str],
    *,
    fs: float | None = None,
    channel: int | None = None,
    variable: str | None = None,
    unit: str | None = None,
    unit_per_full_scale: float | None = None,
    calibrator: str | os.PathLike[str] | Recording | None = None,
    level_db: float = 94.0,
    file_fs: float | None = None,
) -> Recording:
    """Read a recording: WAV, RF64, FLAC, AIFF, MATLAB, .npy, .npz, text or CSV.

    The suffix of the file tells its format, or else how the file begins. Whole-number samples of audio files are scaled
    so that full scale is 1. In formats that hold arrays, the longer axis is time. A first column of text that rises
    evenly is time (in seconds, or the unit of its heading; without one, the sample number if it rises by 1) and is left
    out. The page *File formats* has all of it.

    Nothing is unpickled. Files that are compressed may become at most 64 MiB or 100 times their size, whichever is
    more.

    Parameters
    ----------
    path : path
        The file.
    fs : float, optional
        Sampling frequency wanted in Hz: a recording with another is resampled by `scipy.signal.resample_poly`. By
        default it stays as it is. A file that states no rate is taken to be sampled at `fs`, unless `file_fs` says
        otherwise.
    channel : int, optional
        Channel to read, from 0. By default all are read.
    variable : str, optional
        Variable of a .mat or .npz file, or field of a struct: "meas.ir". By default the only one with several values.
    unit : str, optional
        Unit of the samples, after scaling. By default what the file states, without a prefix (Pa for mPa), or "1".
    unit_per_full_scale : float, optional
        What the number 1 in the file stands for, in `unit`: 2.5 for a WAV file whose full scale is 2.5 Pa, or 20 for
        numbers in volts of a microphone with 50 mV/Pa.
    calibrator : path or Recording, optional
        Recording of a sound calibrator with the same gain: `calibration_factor` gives the scale, and the unit is "Pa".
        If it has several channels, `channel` is used.
    level_db : float, default 94.0
        Sound pressure level of the calibrator in dB re 20 uPa.
    file_fs : float, optional
        Sampling frequency in Hz of a file that states none, or one below 300 Hz, which may be in kHz.

    Returns
    -------
    Recording
        Samples as float64, (n_samples,) or (n_channels, n_samples), their rate, unit and name.

    Raises
    ------
    FileNotFoundError, OSError
        If there is no such file, or it may not be read.
    ModuleNotFoundError
        If the format needs a library of the extra `formats`; the message names it.
    ValueError, TypeError
        If the file is empty, cut short, damaged, claims more than it has, or holds NaN or Inf; if it holds several
        variables and none is chosen, or no such variable or channel; if no sampling rate is known, or `file_fs` is
        another than the file's; if the file states a rate below 300 Hz and neither `fs` nor `file_fs` confirms it; if
        the rates are in no ratio of whole numbers; if a scale comes without its unit; if `unit` is another than the
        file's.

    See Also
    --------
    kfopc_filterpy.paths.read_path : for impulse responses, which resampling must treat differently.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_wav(folder + "/noise.wav", [[0.0, 0.5, -0.25], [1.0, 0.0, 0.0]], 16000)
    ...     recording = read_recording(folder + "/noise.wav", unit="Pa", unit_per_full_scale=2.0)
    >>> recording
    <Recording noise.wav: 0.000188 s, 2 x 3 samples at 16000 Hz, in Pa>
    >>> recording.samples.tolist()
    [[0.0, 1.0, -0.5], [2.0, 0.0, 0.0]]
    """
    content = read_content(path, channel=channel, variable=variable)
    if calibrator is not None:
        if unit_per_full_scale is not None or unit not in (None, "Pa"):
            raise ValueError("calibrator gives scale and unit (Pa): leave out unit and unit_per_full_scale")
        unit, unit_per_full_scale = "Pa", calibration_factor(calibrator, level_db, channel=channel)
    return recording_of(path, content, fs, file_fs, unit, unit_per_full_scale)


def recording_of(
    path: str | os.PathLike[str],
    content: Content,
    fs: float | None,
    file_fs: float | None,
    unit: str | None = None,
    unit_per_full_scale: float | None = None,
) -> Recording:
    """Return the content of a file as a recording; the arguments are those of `read_recording`."""
    if content.samples.ndim > 2:
        raise ValueError(
            f"{path} must hold signals, (n_channels, n_samples), got shape {content.samples.shape}; read impulse responses "
            "with paths.read_path"
        )
    from scipy.signal import resample_poly

    rate, wanted, stated = rates_of(path, content, fs, file_fs)
    samples, unit = scaled(content, unit, unit_per_full_scale)
    if wanted != rate:
        require_room(path, samples.size * wanted / rate, what=f"resampled from {rate:g} to {wanted:g} Hz it has")
        samples = resample_poly(samples, *as_rate_ratio(rate, wanted), axis=-1)
    return Recording(samples, wanted, unit, Path(path).name, stated)


def calibration_factor(
    calibrator: str | os.PathLike[str] | Recording, level_db: float = 94.0, *, channel: int | None = None
) -> float:
    """Return the pascals that the number 1 of a recording stands for, from a recording of a sound calibrator.

    The rms of the tone becomes ``20e-6 * 10**(level_db / 20)`` Pa: 1.002 Pa at 94 dB. Hum and noise beside the tone do
    not count.

    Parameters
    ----------
    calibrator : path or Recording
        The calibrator's tone, at least 0.5 s of it and nothing else, recorded with the gain of the recordings to be
        scaled.
    level_db : float, default 94.0
        Its sound pressure level in dB re 20 uPa; IEC 60942 prefers 94 dB and 114 dB.
    channel : int, optional
        Channel of a recording with several.

    Returns
    -------
    float
        Pascals per unit, the `unit_per_full_scale` of `read_recording`.

    Raises
    ------
    ValueError, TypeError
        If the recording has several channels and none is chosen, is shorter than 0.5 s or silent, has a unit already,
        if less than 90 % of its power is one tone, or its level drifts by more than 0.5 dB.

    Examples
    --------
    >>> tone = 0.1 * np.sin(2 * np.pi * 1000 * np.arange(16000) / 16000)
    >>> round(calibration_factor(Recording(tone, 16000)), 2)  # 1.002 Pa is an rms of 0.0707
    14.18
    """
    level = as_number(level_db, "level_db", unit="dB")
    recording = calibrator if isinstance(calibrator, Recording) else read_recording(calibrator)
    if recording.unit != "1":
        raise ValueError(
            f"calibrator must not be scaled yet, got {recording.unit}: read it without unit, or remove the unit from its file"
        )
    if channel is not None and recording.samples.ndim == 2:
        recording = replace(
            recording, samples=recording.samples[as_channel(channel, recording.samples, recording.name)]
        )
    signal = recording.one_channel()
    signal = signal - signal.mean()
    what = f"calibrator {recording.name}".strip()
    if signal.size < _LEAST_TONE_S * recording.fs:
        raise ValueError(f"{what} must last {_LEAST_TONE_S} s or more, got {signal.size / recording.fs:.3g} s")
    quarters = [np.mean(part**2) for part in np.array_split(signal, 4)]
    if min(quarters) == 0:
        raise ValueError(f"{what} is silent: record the calibrator's tone")
    drift = 10 * np.log10(max(quarters) / min(quarters))
    if drift > _LARGEST_DRIFT_DB:
        raise ValueError(f"{what} must have a steady level, but it drifts by {drift:.1f} dB: cut out the steady part")
    power = np.abs(np.fft.rfft(signal * np.hanning(signal.size))) ** 2
    peak = int(np.argmax(power))
    reach = max(3, round(0.03 * peak))  # the tone is within 3 % of the strongest frequency
    share = float(np.sum(power[max(0, peak - reach) : peak + reach + 1]) / np.sum(power))
    if share < _LEAST_TONE_SHARE:
        raise ValueError(
            f"{what} must be one tone, but only {100 * share:.0f} % of its power is: record the calibrator alone, unclipped"
        )
    return _REFERENCE_PRESSURE * 10 ** (level / 20) / math.sqrt(share * np.mean(signal**2))


def read_content(path: str | os.PathLike[str], *, channel: int | None = None, variable: str | None = None) -> Content:
    """Return what a file holds as finite float64, with time as the last axis, or the channel chosen."""
    require_file(path)
    suffix = Path(path).suffix.lower()
    kind = next((one for one in _FORMATS if suffix in one.suffixes), None) or _format_of(path)
    if variable is not None and not kind.has_variables:
        raise ValueError(f"{path} is {kind.name}, which has no named variables: leave out the option variable")
    with reading(path, kind.name):
        content = kind.read(path, variable) if kind.has_variables else kind.read(path)
    if content.fs is not None:
        as_rate(content.fs, f"the rate that {path} states")
    if content.samples.ndim == 3 and max(content.samples.shape[:2]) >= content.samples.shape[2]:
        raise ValueError(
            f"{path} has the shape {content.samples.shape}, expected (microphones, loudspeakers, taps) with the taps last: "
            "which axis is which? Store it in that order; (taps, microphones, loudspeakers) becomes it with MATLAB's "
            "permute(S, [2 3 1]) or numpy.moveaxis(S, 0, 2)"
        )
    if kind.holds_arrays:
        content = _without_time(path, content)
    samples = channels_first(content.samples)
    if channel is not None:
        units = (content.unit or "1").split(", ")
        content = content._replace(unit=units[channel % len(units)])
        samples = np.atleast_2d(samples)[as_channel(channel, np.atleast_2d(samples), path)]
    require_finite(
        samples, f"the signal of {path}", fs=content.fs, remedy="export it again without gaps, or cut them out"
    )
    return content._replace(samples=np.ascontiguousarray(samples, dtype=np.float64))


def _without_time(path: str | os.PathLike[str], content: Content) -> Content:
    """Return an array's channels without the times beside them, by the rules for the columns of a text."""
    samples = content.samples
    if samples.ndim == 2 and samples.shape[0] == samples.shape[1] > 1:
        raise ValueError(
            f"{path} has the shape {samples.shape}: which axis is time? Store more samples than channels, or each channel "
            "in a variable or file of its own"
        )
    channels = np.asarray(channels_first(samples), dtype=float)
    if channels.ndim != 2 or even_step(channels[0]) is None:
        return content
    times, timed = channels[0], without_time(path, Table([], channels.T, []))
    fs = agreed_rate(path, content.fs, timed.fs, rounding_of(times) / np.ptp(times))
    return content._replace(samples=timed.samples, fs=fs, start_s=content.start_s or timed.start_s)


def as_channel(channel: int, samples: np.ndarray, name: object) -> int:
    """Return a channel if samples (n_channels, n_samples) of `name` have it."""
    if samples.ndim > 2:
        raise ValueError(f"{name} holds a matrix of paths, {samples.shape}, and no channels: leave out channel")
    index = as_count(channel, "channel", minimum=0)
    if index >= len(samples):
        last = len(samples) - 1
        there = ("only channel 0", "channels 0 and 1", f"channels 0 to {last}")[min(last, 2)]
        raise ValueError(f"{name} has {there} (counted from 0), got channel {index}")
    return index


def _format_of(path: str | os.PathLike[str]) -> _Format:
    """Return the format of a file without a known suffix, by its first bytes."""
    with open(path, "rb") as file:
        head = file.read(600)
    for kind in _FORMATS:
        if head.startswith(kind.beginnings):
            return kind
    if head[4:8] == b"ftyp":  # MPEG-4
        return _AUDIO
    if head[512:516] == b"\x89HDF":
        return _MAT
    return _TEXT


def rates_of(
    path: str | os.PathLike[str], content: Content, fs: float | None, file_fs: float | None
) -> tuple[float, float, float | None]:
    """Return the rate of a file, the rate wanted, and the rate that the file states, in Hz."""
    wanted = None if fs is None else as_rate(fs, "fs")
    given = None if file_fs is None else as_rate(file_fs, "file_fs")
    stated = content.fs
    if stated is not None and stated < LEAST_SURE_RATE and stated != wanted:
        if given is None:
            raise ValueError(
                f"{path} states a sampling rate of {stated:g} Hz: is it in kHz, or its times in ms? Pass the rate in Hz, "
                f"file_fs={1000 * stated:g} or {stated:g} (in a command --file-fs)"
            )
        stated = None
    if stated is not None and given is not None and given != stated:
        raise ValueError(f"{path} states a sampling rate of {stated:g} Hz, but file_fs = {given:g} Hz: leave it out")
    rate = stated or given or wanted
    if rate is None:
        raise ValueError(
            f"{path} states no sampling rate: pass fs, the rate in Hz at which it was sampled (or file_fs, if it is to be "
            "resampled to fs)"
        )
    return rate, wanted or rate, stated


def scaled(content: Content, unit: str | None, unit_per_full_scale: float | None) -> tuple[np.ndarray, str]:
    """Return the samples in their unit."""
    stated = content.unit if content.unit not in (None, "1") else None
    if unit is not None and stated is not None and (unit_per_full_scale is None) == (unit != stated):
        raise ValueError(
            f"the file states that it is in {stated}, but unit = {unit!r}"
            + (
                f": leave out unit_per_full_scale, its numbers are in {stated} already"
                if unit == stated
                else f": leave out unit, choose a channel, or give unit_per_full_scale, the {unit} that 1 {stated} stands for"
            )
        )
    if unit_per_full_scale is None:
        return content.samples, unit or stated or "1"
    if unit is None:
        raise ValueError('unit_per_full_scale needs the unit of its result: pass unit="Pa" or unit="V", for example')
    return content.samples * as_positive(unit_per_full_scale, "unit_per_full_scale"), unit


def write_wav(path: str | os.PathLike[str], signal: ArrayLike, fs: float, *, peak: float | None = None) -> None:
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
    ...     recording = read_recording(folder + "/error.wav")
    >>> recording.samples.round(3).tolist()
    [1.0, -0.5, 0.0]
    """
    # Not soundfile, which puts the time of writing into floating-point files: the same signal gives the same bytes.
    from scipy.io import wavfile

    samples = _silent_tail(signal)
    rate = as_positive(fs, "fs", unit="Hz")
    if rate != round(rate):
        raise ValueError(f"fs must be a whole number of Hz in a WAV file, got {rate:g} Hz")
    if peak is None:
        frames = samples.T.astype(np.float32)
    else:
        full_scale, largest = as_positive(peak, "peak"), np.max(np.abs(samples))
        if largest > full_scale:
            raise ValueError(
                f"signal reaches {largest:g}, beyond peak = {full_scale:g}; raise peak, or limit the signal with np.clip"
            )
        frames = np.round(samples.T / full_scale * 32767).astype(np.int16)
    with replacing(path) as file:
        wavfile.write(file, round(rate), frames)


def _silent_tail(signal: Any) -> np.ndarray:
    """Return the signal with the NaN at the end of each channel replaced by zeros."""
    samples = as_real_array(signal, "signal").copy()
    for channel in np.atleast_2d(samples) if samples.ndim < 3 else ():
        numbers = np.flatnonzero(~np.isnan(channel))
        channel[numbers[-1] + 1 if numbers.size else 0 :] = 0.0
    return as_channels(samples, "signal")
