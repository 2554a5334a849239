"""MATLAB files: versions 4 to 7.2, and which version a file has.

They are read in a process of their own, see `child`.
"""

from __future__ import annotations

import os

import numpy as np

from .child import read_in_child
from .content import Content
from .hdf5 import NUMERIC_CLASSES, read_mat73
from .variables import chosen_variable


def read_mat(path: str | os.PathLike[str], variable: str | None) -> Content:
    """Return one variable of a MATLAB file of any version."""
    from scipy.io.matlab import matfile_version

    if matfile_version(path)[0] == 2:
        return read_mat73(path, variable)
    return read_in_child("scipy.io", read_mat_here, path, variable)


def read_mat_here(path: str | os.PathLike[str], variable: str | None) -> Content:
    """Return one variable of a MATLAB file of version 4 to 7.2, in this process."""
    from scipy.io import loadmat, whosmat

    contents = whosmat(path)
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


def _fields(name: str, value: np.ndarray) -> dict[str, np.ndarray]:
    """Return the fields of a struct, and of the structs in it, by their names: "meas.ir"."""
    found: dict[str, np.ndarray] = {}
    for field in value.dtype.names or () if value.size == 1 else ():
        inner = np.asarray(value[field].item())
        own = f"{name}.{field}"
        found |= _fields(own, inner) if inner.dtype.names else {own: inner}
    return found
