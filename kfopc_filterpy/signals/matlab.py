"""MATLAB files: versions 4 to 7.2, and which version a file has."""

from __future__ import annotations

import os
import struct
import zlib

import numpy as np

from .content import Content, require_room, room_of
from .hdf5 import NUMERIC_CLASSES, read_mat73
from .variables import chosen_variable, require_few

_HEAD, _COMPRESSED = 128, 15  # bytes before the parts of a file, and the mark of a compressed one


def read_mat(path: str | os.PathLike[str], variable: str | None) -> Content:
    """Return one variable of a MATLAB file of any version."""
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import matfile_version

    version = matfile_version(path)[0]
    if version == 2:
        return read_mat73(path, variable)
    if version == 1:
        _require_room_unpacked(path)
    contents = whosmat(path)
    require_few(path, len(contents))  # before the structs among them are read, each from the file's beginning on
    shapes = {name: tuple(map(int, shape)) for name, shape, kind in contents if kind in NUMERIC_CLASSES}
    others = {name: "text" if kind == "char" else kind for name, _, kind in contents if kind not in NUMERIC_CLASSES}
    fields: dict[str, np.ndarray] = {}
    for name in [name for name, kind in others.items() if kind == "struct" and variable not in shapes]:
        fields |= _fields(name, loadmat(path, variable_names=[name])[name])
    shapes |= {name: field.shape for name, field in fields.items() if field.dtype.kind in "fiub"}
    kinds = {"O": "a cell or struct array: store its parts in variables of their own", "U": "text"}
    others |= {n: kinds.get(one.dtype.kind, str(one.dtype)) for n, one in fields.items() if n not in shapes}

    def read(name: str) -> np.ndarray:
        return fields[name] if name in fields else loadmat(path, variable_names=[name])[name]

    return chosen_variable(path, shapes, read, variable, others)


def _require_room_unpacked(path: str | os.PathLike[str]) -> None:
    """Raise ValueError if a compressed part of a file of version 5 to 7.2 is too large: scipy unpacks it whole."""
    with open(path, "rb") as file:
        head = file.read(_HEAD)
        order = "<" if head.endswith(b"IM") else ">"
        while len(tag := file.read(8)) == 8:
            kind, size = struct.unpack(f"{order}2I", tag)
            part = file.read(size)
            if kind == _COMPRESSED:
                require_room(path, len(zlib.decompressobj().decompress(part, room_of(path) + 1)) / 8)


def _fields(name: str, value: np.ndarray) -> dict[str, np.ndarray]:
    """Return the fields of a struct, and of the structs in it, by their names: "meas.ir"."""
    found: dict[str, np.ndarray] = {}
    for field in value.dtype.names or () if value.size == 1 else ():
        inner = np.asarray(value[field].item())
        own = f"{name}.{field}"
        found |= _fields(own, inner) if inner.dtype.names else {own: inner}
    return found
