"""Audio files: WAV, RF64, AIFF and FLAC."""

from __future__ import annotations

import io
import os
import shlex
import struct
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from .content import Content, require_room, room_of

# Sizes that a WAV file's header states if its writer could not know it (it wrote to a pipe: ffmpeg, SoX, arecord), or
# in RF64.
_SIZES_UNKNOWN = (0xFFFFFFFF, 0x7FFFF000, 0x7FFFFFFF, 0x80000000)
_FORMATS = ("WAV", "WAVEX", "RF64", "AIFF", "FLAC")
_LOSSLESS = ("PCM_U8", "PCM_S8", "PCM_16", "PCM_24", "PCM_32", "FLOAT", "DOUBLE")  # codings of samples
_BYTES = {"PCM_16": 2, "PCM_24": 3, "PCM_32": 4}
_MOST_CHUNKS = 10_000
_PCM, _EXTENSIBLE = 1, 0xFFFE  # the tags of integers without loss, and of a longer header that has the tag
_NO_TOTAL = 2**62  # frames, from which a FLAC file states none: its encoder wrote to a pipe
_TAGS = (b"TAG", b"ID3")  # of music, which some programs append without a chunk
_CONTAINERS = {b"RIFF": "<", b"RF64": "<", b"BW64": "<", b"RIFX": ">", b"FORM": ">"}  # and their byte order


class _Bits(NamedTuple):
    """Bits of a sample, and bytes of the samples of all channels at a time."""

    bits: int
    block: int


def read_audio(path: str | os.PathLike[str]) -> Content:
    """Return the samples of an audio file, full scale 1, and its sampling rate."""
    import soundfile

    convert = f"convert it to WAV, for example with: ffmpeg {_from_to(path, '-c:a pcm_f32le')}"
    bits = _require_whole(path)
    try:
        file = soundfile.SoundFile(_as_rf64(path))
    except soundfile.LibsndfileError as error:
        raise ValueError(
            f"{path} cannot be read as an audio file: {error.error_string} If other programs play it, {convert}"
        ) from error
    with file:
        if file.format not in _FORMATS or file.subtype not in _LOSSLESS:
            raise ValueError(
                f"{path} is {file.format_info}, {file.subtype_info}, expected WAV, AIFF or FLAC without loss: record it "
                f"again in one of these, or {convert} (MP3, Ogg, ADPCM and others have left out what an ear would not miss)"
            )
        claimed, fs = file.frames, file.samplerate
        if claimed >= _NO_TOTAL:
            file.seekable = lambda: False  # libsndfile cannot seek in it, which soundfile does after reading
            claimed, most = 0, room_of(path) // (8 * file.channels)
            frames = file.read(most, dtype="float64", always_2d=True).copy()
            require_room(path, frames.size + (len(frames) == most))
        else:
            # Before anything is read: soundfile makes room for as many frames as the header claims.
            require_room(path, float(claimed) * file.channels)
            frames = file.read(dtype="float64", always_2d=True)
        if bits is not None:
            frames *= _justified(path, frames, bits, _BYTES.get(file.subtype, 0), file.channels)
        elif (
            file.subtype == "PCM_32" and np.max(np.abs(frames), initial=0.0) <= 2.0**-8 and np.any(frames * 2**31 % 256)
        ):
            warnings.warn(
                f"{path} has 32 bits, of which the highest 8 are not used: if it was recorded with arecord -f S24_LE, its "
                "numbers are 48 dB too small; record it in S24_3LE or S32_LE",
                stacklevel=2,
            )
    if len(frames) == 0:
        raise ValueError(
            f"{path} holds no samples: its header claims zero frames, in a file of {Path(path).stat().st_size} bytes; "
            "record or export it again"
        )
    if len(frames) < claimed:
        raise ValueError(f"{path} is cut short: its header claims {claimed} frames, {len(frames)} could be read")
    return Content(frames.T, float(fs))


def _as_rf64(path: str | os.PathLike[str]) -> str | os.PathLike[str] | io.BytesIO:
    """Return a file for libsndfile, which does not know that BW64 (ITU-R BS.2088) is RF64 or RIFF."""
    with open(path, "rb") as file:
        if file.read(4) != b"BW64":
            return path
        rest = file.read()
    return io.BytesIO((b"RF64" if rest[8:12] == b"ds64" else b"RIFF") + rest)


def _from_to(path: str | os.PathLike[str], coding: str) -> str:
    """Return the arguments of ffmpeg that write a file beside another."""
    return f"-i {shlex.quote(Path(path).name)} {coding} {shlex.quote(f'{Path(path).stem}-pcm.wav')}"


def _require_whole(path: str | os.PathLike[str]) -> _Bits | None:
    """Raise ValueError if a WAV or AIFF file is shorter than its header says: libsndfile would read what is left.

    Return the bits of a sample of a WAV file that has more room than they need, or None.
    """
    with open(path, "rb") as file:
        held = file.seek(0, os.SEEK_END)
        file.seek(0)
        kind = file.read(4)
        if kind not in _CONTAINERS or held < 12:
            return None
        order = _CONTAINERS[kind]
        chunks = {name: place for name, *place in reversed(list(_chunks(file, order)))}  # the first of each name
        samples_end, claimed = _claimed_ends(file, order, chunks)
        more = samples_end and _unclaimed(file, order, samples_end)
        spared = None if kind == b"FORM" else _spared(file, order, chunks)
    if claimed > held:
        raise ValueError(f"{path} is cut short: its header claims {claimed} bytes, {held} are there")
    if more:
        copy = _from_to(path, "-c copy")
        raise ValueError(
            f"{path} goes on for {more} bytes after the end of its samples that its header states: was the recorder "
            f"interrupted? Read them with ffmpeg -ignore_length 1 {copy}, or leave them out with ffmpeg {copy}"
        )
    return spared


def _claimed_ends(file: BinaryIO, order: str, chunks: Mapping[bytes, Sequence[int]]) -> tuple[int, int]:
    """Return where the samples end by the header, 0 if it does not say, and where the file ends at the earliest."""
    file.seek(4)
    (size,) = struct.unpack(f"{order}I", file.read(4))
    end = 8 + size if size not in _SIZES_UNKNOWN else 0
    wide_data = None
    if b"ds64" in chunks and chunks[b"ds64"][1] >= 16:
        file.seek(chunks[b"ds64"][0])
        wide, wide_data = struct.unpack("<QQ", file.read(16).ljust(16, b"\0"))
        end = max(end, 8 + wide)
    start, size = chunks.get(b"data") or chunks.get(b"SSND") or (0, 0)
    if size in _SIZES_UNKNOWN:
        if wide_data is None:  # then the size of the whole is unknown, too
            return 0, 0
        size = wide_data
    return start + size, max(end, start + size)


def _unclaimed(file: BinaryIO, order: str, end: int) -> int:
    """Return how many bytes after the samples are no chunk: a recorder updates the sizes from time to time."""
    file.seek(end)
    rest = file.read()
    if len(rest) < 8 or not rest.strip(b"\0") or rest.startswith(_TAGS):
        return 0
    for begin in (0, 1):  # a chunk begins at an even byte; not every program knows
        name, size = struct.unpack_from(f"{order}4sI", rest.ljust(9, b"\0"), begin)
        if name.isascii() and name.decode().isprintable() and begin + 8 + size <= len(rest) + 1:
            return 0
    return len(rest)


def _spared(file: BinaryIO, order: str, chunks: Mapping[bytes, Sequence[int]]) -> _Bits | None:
    start, size = chunks.get(b"fmt ", (0, 0))
    if size < 16:
        return None
    file.seek(start)
    head = file.read(min(size, 28)).ljust(28, b"\0")
    tag, channels, _, _, block, bits, _, valid, _, own_tag = struct.unpack(f"{order}HHIIHHHHII", head)
    if tag == _EXTENSIBLE:
        tag, bits = own_tag, min(bits, valid or bits)
    return _Bits(bits, block) if tag == _PCM and bits > 8 and 8 * block != bits * channels else None


def _justified(path: str | os.PathLike[str], frames: np.ndarray, own: _Bits, n_bytes: int, n_channels: int) -> float:
    """Return the factor of samples that have more room than bits: 1, or a power of 2 if they are in the low bits.

    By the standard they are in the high bits and zeros follow; ALSA's S24_LE has them in the low ones.
    """
    spare = 8 * n_bytes - own.bits
    if own.block == n_channels * n_bytes:
        whole = frames * 2.0 ** (8 * n_bytes - 1)
        are_high, are_low = not np.any(whole % 2**spare), np.max(np.abs(whole)) <= 2.0 ** (own.bits - 1)
        if are_high and are_low and np.any(whole):
            raise ValueError(
                f"{path} states {own.bits} bits in {8 * n_bytes}, and its samples fit the high as well as the low ones: it is "
                f"so quiet (-{6 * spare} dB of full scale at most), or of fewer bits in the low ones, as of ALSA's S24_LE; "
                "record it in 16, 24 (packed) or 32 bits"
            )
        if are_high or are_low:
            return 1.0 if are_high else float(2**spare)
    raise ValueError(
        f"{path} states {own.bits} bits in blocks of {own.block} bytes for {n_channels} channel(s), which its samples "
        "do not fit: record it in 16, 24 (packed) or 32 bits"
    )


def _chunks(file: BinaryIO, order: str) -> Iterator[tuple[bytes, int, int]]:
    """Yield name, first byte and size of each chunk."""
    start = 12
    for _ in range(_MOST_CHUNKS):
        file.seek(start)
        head = file.read(8)
        if len(head) < 8:
            return
        name, size = struct.unpack(f"{order}4sI", head)
        yield name, start + 8, size
        start += 8 + size + size % 2
