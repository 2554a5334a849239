"""MATLAB files of version 4 to 7.2, and which version a file has."""

from __future__ import annotations

import io
import math
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .content import Content, chosen_variable, require_room, room_of
from .hdf5 import NUMERIC_CLASSES, read_mat73

_COMPRESSED, _MATRIX = 15, 14  # MATLAB's numbers for these elements
_NUMBER_TYPES = (1, 2, 3, 4, 5, 6, 7, 9, 12, 13)  # of the numbers in an element
_NUMBER_CLASSES = [bytes([kind]) for kind in range(6, 16)]  # of a variable, double to uint64
_HEADER = 128  # bytes


def read_mat(path: str | os.PathLike[str], variable: str | None) -> Content:
    """Return one variable of a MATLAB file of any version."""
    import scipy.io.matlab

    version, _ = scipy.io.matlab.matfile_version(path)
    if version == 2:
        return read_mat73(path, variable)
    return _from_scipy(path, path if version == 0 else _unpacked(path), variable)


def _from_scipy(path: str | os.PathLike[str], source: Any, variable: str | None) -> Content:
    import scipy.io

    contents = scipy.io.whosmat(source)
    shapes = {name: tuple(map(int, shape)) for name, shape, kind in contents if kind in NUMERIC_CLASSES}
    others = {name: kind for name, _, kind in contents if kind not in NUMERIC_CLASSES}
    size = source.getbuffer().nbytes if isinstance(source, io.BytesIO) else Path(path).stat().st_size
    for name, shape in shapes.items():
        if math.prod(shape) > size:  # a value takes a byte or more
            raise ValueError(f"variable {name!r} of {path} is damaged: its header claims the shape {shape}")
    return chosen_variable(path, shapes, lambda name: _load(source, name), variable, others)


def _load(source: Any, name: str) -> Any:
    import scipy.io

    if isinstance(source, io.BytesIO):
        source.seek(0)
    return scipy.io.loadmat(source, variable_names=[name])[name]


def _unpacked(path: str | os.PathLike[str]) -> io.BytesIO:
    """Return a file of version 5 to 7.2 with nothing compressed, and no size in it beyond what is there.

    scipy makes room for what an element's header claims, and unpacks without limit.
    """
    content = Path(path).read_bytes()
    order = ">" if content[126:128] == b"MI" else "<"
    unpacked = io.BytesIO()
    unpacked.write(content[:_HEADER])
    for kind, begin, end in _elements(path, memoryview(content)[_HEADER:], order):
        body = content[_HEADER + begin : _HEADER + end]
        if kind == _COMPRESSED:
            body = _unzipped(path, body, room_of(path) - unpacked.tell())
        else:
            body = struct.pack(f"{order}II", kind, len(body)) + body
        _require_honest_parts(path, body, order)
        unpacked.write(body)
    unpacked.seek(0)
    return unpacked


def _unzipped(path: str | os.PathLike[str], packed: bytes, room: int) -> bytes:
    unzip = zlib.decompressobj()
    body = unzip.decompress(packed, max(1, room))
    if len(body) > room or unzip.unconsumed_tail:
        require_room(path, math.inf, what="its compressed variables unpack to more than it may hold, up to")
    if not unzip.eof:
        raise ValueError(f"{path} is cut short: the compressed data of a variable do not end")
    return body


def _elements(path: str | os.PathLike[str], content: Any, order: str) -> Iterator[tuple[int, int, int]]:
    """Yield type, begin and end of each element."""
    begin = 0
    while begin + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, begin)
        if begin + 8 + size > len(content):
            raise ValueError(
                f"{path} is cut short: a variable claims {size} bytes, {len(content) - begin - 8} are there"
            )
        yield kind, begin + 8, begin + 8 + size
        begin += 8 + size


def _require_honest_parts(path: str | os.PathLike[str], body: bytes, order: str) -> None:
    """Raise ValueError if a part of a matrix claims more bytes than the matrix has, or numbers of no known type.

    A type that scipy does not know (it is the index into a table of its own) ends the process.
    """
    kind, size = struct.unpack_from(f"{order}II", body) if len(body) >= 8 else (0, 0)
    if kind != _MATRIX or 8 + size > len(body):
        raise ValueError(
            f"{path} is damaged: {len(body)} bytes claim to be type {kind} of {size} bytes, expected a variable"
        )
    begin, end, count = 8, 8 + size, 0
    is_numeric = body[16 if order == "<" else 19 : 20][:1] in _NUMBER_CLASSES
    while begin + 8 <= end:
        kind, part = struct.unpack_from(f"{order}II", body, begin)
        if kind >> 16:  # a part of up to four bytes, its size beside its type
            kind, part = kind & 0xFFFF, 0
        if begin + 8 + part > end:
            raise ValueError(f"{path} is damaged: a part of {part} bytes in a variable of {size}")
        if kind not in _NUMBER_TYPES and (is_numeric or count < 3):  # flags, dimensions and name come first
            raise ValueError(f"{path} is damaged: a variable has numbers of the unknown type {kind}")
        begin += 8 + part + (-part) % 8
        count += 1
