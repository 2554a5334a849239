"""MATLAB files of version 7.3, which are HDF5. They are read in a process of their own, see `child`."""

from __future__ import annotations

import math
import os
import zlib
from typing import Any

import numpy as np

from .._validate import optional_module
from .child import read_in_child
from .content import Content, require_room
from .variables import chosen_variable

NUMERIC_CLASSES = (
    "double",
    "single",
    "logical",
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
)
_STRUCT = "a struct"
_CHUNK_COST = 4096  # bytes that HDF5 takes for a chunk, however small it is
_DEFLATE, _SHUFFLE, _FLETCHER32 = 1, 2, 3  # filters of HDF5 that neither run foreign code nor expand twice


def read_mat73(path: str | os.PathLike[str], variable: str | None) -> Content:
    """Return one variable of a MATLAB file of version 7.3."""
    _h5py(path)
    return read_in_child("h5py", read_mat73_here, path, variable)


def read_mat73_here(path: str | os.PathLike[str], variable: str | None) -> Content:
    """Return what `read_mat73` does, in this process.

    h5py and not pymatreader: it tells shapes and types before it reads, so that a file cannot claim the memory, and it
    needs nothing else.
    """
    with _h5py(path).File(path, "r") as file:
        shapes: dict[str, tuple[int, ...]] = {}
        others: dict[str, str] = {}
        names = [name for name in file if not name.startswith("#")]  # those are MATLAB's own
        structs = set()
        for name in names:
            kind, place = _matlab_class(path, file, name), name.replace(".", "/")
            if kind == _STRUCT:
                if file[place] not in structs:  # which may hold itself
                    names.extend(f"{name}.{field}" for field in file[place])
                structs.add(file[place])
                others[name] = kind
            elif kind in NUMERIC_CLASSES and file[place].dtype.kind in "fiu":
                # HDF5 has the axes in C's order, MATLAB in Fortran's; of an empty variable it keeps the shape.
                empty = "MATLAB_empty" in file[place].attrs
                shapes[name] = (0,) if empty else file[place].shape[::-1]
            else:
                others[name] = (
                    "complex numbers" if kind in NUMERIC_CLASSES else {"char": "text", "cell": "a cell"}.get(kind, kind)
                )
        return chosen_variable(
            path,
            shapes,
            lambda name: _read(path, file, name.replace(".", "/")).T if shapes.get(name) != (0,) else np.empty(0),
            variable,
            others,
        )


def _h5py(path: str | os.PathLike[str]) -> Any:
    return optional_module("h5py", "formats", f"{path} is an HDF5 file, which")


def _matlab_class(path: str | os.PathLike[str], file: Any, name: str) -> str:
    h5py, name = _h5py(path), name.replace(".", "/")
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        return "a link to another file"
    if not isinstance(file[name], h5py.Dataset):
        return _STRUCT
    return _text(file[name].attrs.get("MATLAB_class"))


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _read(path: str | os.PathLike[str], file: Any, name: str) -> np.ndarray:
    """Return a data set whose samples are in this very file, and no more of them than it may hold."""
    h5py = _h5py(path)
    if not isinstance(file.get(name, getlink=True), h5py.HardLink) or not isinstance(file[name], h5py.Dataset):
        raise ValueError(f"{path} has no data set {name!r} of its own")
    data = file[name]
    if data.is_virtual or data.external:
        raise ValueError(f"{name!r} of {path} refers to other files: store its samples in the file itself")
    if data.dtype.kind not in "fiu" or data.shape is None:
        raise ValueError(f"{name!r} of {path} must hold real numbers, got {data.dtype}")
    require_room(path, math.prod(data.shape))
    if data.chunks is not None:
        _require_honest_chunks(path, data)
    return data[()]


def _require_honest_chunks(path: str | os.PathLike[str], data: Any) -> None:
    """Raise ValueError if a chunk would become larger than the data set says: HDF5 makes room without limit."""
    plist = data.id.get_create_plist()
    filters = [plist.get_filter(index)[0] for index in range(plist.get_nfilters())]
    if set(filters) - {_DEFLATE, _SHUFFLE, _FLETCHER32} or filters.count(_DEFLATE) > 1:
        raise ValueError(
            f"{data.name} of {path} is compressed in a way that is not read: store it with gzip or without"
        )
    room = math.prod(data.chunks) * data.dtype.itemsize
    require_room(path, room / 8)
    n_chunks = math.prod(-(-size // chunk) for size, chunk in zip(data.shape, data.chunks, strict=True))
    require_room(path, n_chunks * _CHUNK_COST / 8, what=f"its {n_chunks} chunks take as much memory as")
    for index in range(data.id.get_num_chunks()) if _DEFLATE in filters else ():
        _, raw = data.id.read_direct_chunk(data.id.get_chunk_info(index).chunk_offset)
        if len(zlib.decompressobj().decompress(raw, room + 5)) > room + 4:  # Fletcher's checksum has 4 bytes
            raise ValueError(f"{data.name} of {path} is damaged: a chunk is larger than its {room} bytes")
