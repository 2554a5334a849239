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
_UINT32, _NUMBER_TYPES = 6, {1, 2, 3, 4, 5, 6, 7, 9, 12, 13}  # of the numbers in an element
_NUMBER_CLASSES, _COMPLEX = range(6, 16), 0x800  # of a variable: double to uint64, and the flag beside it
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
    """Raise ValueError if a part of a matrix claims more bytes than the matrix has, or if a variable lacks parts.

    scipy ends the process for numbers of a type that it does not know, which is the index into a table of its own. It
    would also take the imaginary part of a variable that has none from what follows.
    """
    if len(body) < 24:
        raise ValueError(f"{path} is damaged: a variable of {len(body)} bytes")
    kind, size, flags_type, flags_size, flags = struct.unpack_from(f"{order}5I", body)
    if kind != _MATRIX or 8 + size > len(body) or (flags_type, flags_size) != (_UINT32, 8):
        raise ValueError(
            f"{path} is damaged: {len(body)} bytes claim to be type {kind} of {size} bytes, expected a variable"
        )
    is_numeric = (flags & 0xFF) in _NUMBER_CLASSES
    begin, end, types = 8, 8 + size, []
    while begin + 8 <= end:
        kind, part = struct.unpack_from(f"{order}II", body, begin)
        if kind >> 16:  # a part of up to four bytes, its size beside its type
            kind, part = kind & 0xFFFF, 0
        if begin + 8 + part > end:
            raise ValueError(f"{path} is damaged: a part of {part} bytes in a variable of {size}")
        types.append(kind)
        begin += 8 + part + (-part) % 8
    # Flags, dimensions and name; then, of numbers, the real part and the imaginary part.
    needed = 3 if not is_numeric else 5 if flags & _COMPLEX else 4
    if len(types) < needed or not set(types[:needed]) <= _NUMBER_TYPES:
        raise ValueError(
            f"{path} is damaged: a variable has parts of the types {types[:8]}, expected {needed} with numbers"
        )
