"""MATLAB files of version 4 to 7.2, and which version a file has."""

from __future__ import annotations

import io
import math
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .content import Content, chosen_variable, require_room, room_of
from .hdf5 import NUMERIC_CLASSES, read_mat73

_COMPRESSED, _MATRIX = 15, 14  # MATLAB's numbers for these elements
_UINT32, _NUMBER_TYPES = 6, {1, 2, 3, 4, 5, 6, 7, 9, 12, 13}  # of the numbers in an element
_TEXT_TYPES = {16, 17, 18}
_NUMBER_CLASSES, _COMPLEX = range(6, 16), 0x800  # of a variable: double to uint64, and the flag beside it
_CELL, _CHAR, _SPARSE = 1, 4, 5  # further classes
_WITH_FIELDS = {2: 3, 3: 4}  # structs and objects, and the part in which the names of their fields begin
_WITH_ELEMENTS = (_CELL, _CHAR, *_WITH_FIELDS)
# Parts of a variable: flags, dimensions and name, and what its class adds. Complex numbers have one more.
_PARTS = {**dict.fromkeys(_NUMBER_CLASSES, 4), _CELL: 3, _CHAR: 4, _SPARSE: 6, 2: 5, 3: 6}
_LEADING = 8  # parts, at most, before the elements of a struct or cell
_VARIABLE = 256  # bytes of room that a variable in a struct or cell counts for, whatever it holds
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
    fields: dict[str, np.ndarray] = {}
    for name in [name for name, kind in others.items() if kind == "struct" and variable not in shapes]:
        fields |= _fields(name, _load(source, name))
    shapes |= {name: field.shape for name, field in fields.items() if field.dtype.kind in "fiub"}
    others |= {name: str(field.dtype) for name, field in fields.items() if name not in shapes}
    return chosen_variable(
        path, shapes, lambda name: fields[name] if name in fields else _load(source, name), variable, others
    )


def _fields(name: str, value: Any) -> dict[str, np.ndarray]:
    """Return the fields of a struct, and of the structs in it, by their names: "meas.ir"."""
    found: dict[str, np.ndarray] = {}
    for field in value.dtype.names if value.size == 1 else ():
        inner = np.asarray(value[field].item())
        own = f"{name}.{field}"
        found |= _fields(own, inner) if inner.dtype.names else {own: inner}
    return found


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
        _require_honest_parts(path, memoryview(body), order)
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


def _require_honest_parts(path: str | os.PathLike[str], body: Any, order: str) -> int:
    """Raise ValueError if a part of a matrix claims more bytes than the matrix has, or if a variable lacks parts.

    scipy ends the process for numbers of a type that it does not know, which is the index into a table of its own. It
    would also take the imaginary part of a variable that has none from what follows, and make room for the elements that
    a struct or cell claims. Return the number of variables, with those in structs and cells.
    """
    if len(body) < 24:
        raise ValueError(f"{path} is damaged: a variable of {len(body)} bytes")
    kind, size, flags_type, flags_size, flags = struct.unpack_from(f"{order}5I", body)
    if kind != _MATRIX or 8 + size > len(body) or (flags_type, flags_size) != (_UINT32, 8):
        raise ValueError(
            f"{path} is damaged: {len(body)} bytes claim to be type {kind} of {size} bytes, expected a variable"
        )
    own_class = flags & 0xFF
    begin, end, count = 8, 8 + size, 1
    parts: list[_Part] = []
    while begin + 8 <= end:
        kind, part = struct.unpack_from(f"{order}II", body, begin)
        at = begin + 8
        if kind >> 16:  # a part of up to four bytes, its size beside its type
            kind, part, at = kind & 0xFFFF, kind >> 16, begin + 4
        if at + part > end:
            raise ValueError(f"{path} is damaged: a part of {part} bytes in a variable of {size}")
        if len(parts) < _LEADING:  # what follows are the elements
            parts.append(_Part(kind, body[at : at + part]))
        if kind == _MATRIX:
            count += _require_honest_parts(path, body[begin : at + part], order) if part else 1
        begin = at + part + (-part) % 8 if at == begin + 8 else begin + 8
    needed = _PARTS.get(own_class, 3) + (own_class in (_SPARSE, *_NUMBER_CLASSES) and flags & _COMPLEX > 0)
    types, dimensions = [part.kind for part in parts], parts[1].content if len(parts) > 1 else b""
    known = _NUMBER_TYPES | (_TEXT_TYPES if own_class == _CHAR else set())
    if len(types) < needed or not set(types[:needed]) <= known or (own_class in _PARTS and len(dimensions) < 8):
        raise ValueError(
            f"{path} is damaged: a variable has parts of the types {types}, expected {needed} with numbers"
        )
    if own_class in _WITH_ELEMENTS:
        claimed = math.prod(parts[1].integers(order))
        if own_class in _WITH_FIELDS:  # the length of a field's name, and the names, precede the fields
            length, names = parts[_WITH_FIELDS[own_class] :][:2]
            claimed *= len(names.content) // max(1, *length.integers(order))
        if claimed > (size if own_class == _CHAR else count):
            raise ValueError(f"{path} is damaged: a struct, cell or text of {size} bytes claims {claimed} elements")
    require_room(path, count * _VARIABLE / 8, what="its structs and cells have room for")
    return count


class _Part(NamedTuple):
    """Part of a variable: MATLAB's number for its type, and its bytes."""

    kind: int
    content: Any

    def integers(self, order: str) -> tuple[int, ...]:
        return struct.unpack(f"{order}{len(self.content) // 4}I", self.content[: len(self.content) // 4 * 4])
