"""Audio files: WAV, RF64, AIFF and FLAC."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from typing import BinaryIO

from .content import Content, require_room

# A size that a WAV file's header states if its writer could not know it (it wrote to a pipe), or in RF64.
_SIZE_UNKNOWN = 0xFFFFFFFF
_FORMATS = ("WAV", "WAVEX", "RF64", "AIFF", "FLAC")
_LOSSLESS = ("PCM_U8", "PCM_S8", "PCM_16", "PCM_24", "PCM_32", "FLOAT", "DOUBLE")  # codings of samples
_MOST_CHUNKS = 10_000
_CONTAINERS = {b"RIFF": "<", b"RF64": "<", b"BW64": "<", b"RIFX": ">", b"FORM": ">"}  # and their byte order


def read_audio(path: str | os.PathLike[str]) -> Content:
    """Return the samples of an audio file, full scale 1, and its sampling rate."""
    import soundfile

    _require_whole(path)
    with soundfile.SoundFile(path) as file:
        if file.format not in _FORMATS or file.subtype not in _LOSSLESS:
            raise ValueError(
                f"{path} is {file.format_info}, {file.subtype_info}, expected WAV, AIFF or FLAC without loss: record it "
                "again in one of these, or convert it (MP3, Ogg, ADPCM and others have left out what an ear would not miss)"
            )
        # Before anything is read: soundfile makes room for as many frames as the header claims.
        require_room(path, float(file.frames) * file.channels)
        frames, claimed, fs = file.read(dtype="float64", always_2d=True), file.frames, file.samplerate
    if len(frames) == 0:
        raise ValueError(f"{path} holds no samples (zero frames): record or export it again")
    if len(frames) < claimed:
        raise ValueError(f"{path} is cut short: its header claims {claimed} frames, {len(frames)} could be read")
    return Content(frames.T, float(fs))


def _require_whole(path: str | os.PathLike[str]) -> None:
    """Raise ValueError if a WAV or AIFF file is shorter than its header says: libsndfile would read what is left."""
    with open(path, "rb") as file:
        held = file.seek(0, os.SEEK_END)
        file.seek(0)
        kind = file.read(4)
        if kind not in _CONTAINERS or held < 12:
            return
        claimed = _claimed_end(file, _CONTAINERS[kind], kind in (b"RF64", b"BW64"))
    if claimed > held:
        raise ValueError(f"{path} is cut short: its header claims {claimed} bytes, {held} are there")


def _claimed_end(file: BinaryIO, order: str, is_64_bit: bool) -> int:
    """Return where the file must end at the earliest by its header's sizes."""
    (size,) = struct.unpack(f"{order}I", file.read(4))
    end = 8 + size if size != _SIZE_UNKNOWN else 0
    wide_data = None
    for name, start, size in _chunks(file, order):
        if is_64_bit and name == b"ds64" and size >= 16:
            file.seek(start)
            wide, wide_data = struct.unpack("<QQ", file.read(16).ljust(16, b"\0"))
            end = max(end, 8 + wide)
        if name in (b"data", b"SSND"):
            if size == _SIZE_UNKNOWN:
                size = wide_data or 0
            return max(end, start + size)
    return end


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
