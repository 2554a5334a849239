"""MATLAB files of version 7.3, which are HDF5."""

from __future__ import annotations

import os

import numpy as np

from .._validate import optional_module
from .content import Content, require_room
from .variables import chosen_variable

NUMERIC_CLASSES = (
    "double",
    "single",
    "logical",
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
)


def read_mat73(path: str | os.PathLike[str], variable: str | None) -> Content:
    """Return one variable of a MATLAB file of version 7.3.

    h5py and not pymatreader: it tells shapes and types before it reads, so that a file cannot claim the memory, and it
    needs nothing else.
    """
    h5py = optional_module("h5py", "formats", f"{path} is an HDF5 file, which")
    with h5py.File(path, "r") as file:
        shapes: dict[str, tuple[int, ...]] = {}
        others: dict[str, str] = {}
        names = [name for name in file if not name.startswith("#")]  # those are MATLAB's own
        structs = set()
        for name in names:
            place = name.replace(".", "/")
            if not isinstance(file.get(place, getlink=True), h5py.HardLink):
                others[name] = "a link to another file"
                continue
            item = file[place]
            if not isinstance(item, h5py.Dataset):
                if item not in structs:  # which may hold itself
                    names.extend(f"{name}.{field}" for field in item)
                structs.add(item)
                others[name] = "a struct"
                continue
            kind = item.attrs.get("MATLAB_class")
            kind = kind.decode(errors="replace") if isinstance(kind, bytes) else str(kind)
            if kind in NUMERIC_CLASSES and item.dtype.kind in "fiu":
                # HDF5 has the axes in C's order, MATLAB in Fortran's; of an empty variable it keeps the shape.
                shapes[name] = (0,) if "MATLAB_empty" in item.attrs else item.shape[::-1]
            else:
                words = {"char": "text", "cell": "a cell"}
                others[name] = "complex numbers" if kind in NUMERIC_CLASSES else words.get(kind, kind)

        def read(name: str) -> np.ndarray:
            data = file[name.replace(".", "/")]
            if data.is_virtual or data.external:
                raise ValueError(f"{name!r} of {path} refers to other files: store its samples in the file itself")
            require_room(path, data.size)
            return np.empty(0) if "MATLAB_empty" in data.attrs else data[()].T

        return chosen_variable(path, shapes, read, variable, others)
