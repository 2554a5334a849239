"""Arrays of numpy: .npy and .npz. Nothing is unpickled."""

from __future__ import annotations

import math
import os
import zipfile
from typing import IO, NamedTuple

import numpy as np

from .content import Content, require_room
from .variables import chosen_variable, require_few

_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class _Header(NamedTuple):
    shape: tuple[int, ...]
    is_fortran: bool
    dtype: np.dtype


def read_npy(path: str | os.PathLike[str]) -> Content:
    """Return the array of a .npy file."""
    with open(path, "rb") as file:
        header = _read_header(file)
        if header.dtype.kind not in "fiub":
            raise ValueError(f"{path} must hold real numbers, got {header.dtype}")
        require_room(path, math.prod(header.shape))
        array = _read_array(file, header)
        if file.read(1):
            raise ValueError(
                f"{path} goes on after its array: save one array in a .npy file, or several in a .npz file"
            )
    if array.size == 0:
        raise ValueError(f"{path} holds no samples, shape {array.shape}: expected at least one")
    return Content(array)


def read_npz(path: str | os.PathLike[str], variable: str | None) -> Content:
    """Return one array of a .npz file."""
    with zipfile.ZipFile(path) as archive:
        if not any(name.endswith(".npy") for name in archive.namelist()):
            raise ValueError(
                f"{path} is an archive without arrays: of a workbook (.xlsx, .ods), save the sheet as .csv"
            )
        require_few(path, len(archive.infolist()))
        headers: dict[str, _Header] = {}
        for entry in archive.infolist():
            require_room(path, entry.file_size / 8)  # numpy would read a header of any length
            with archive.open(entry) as file:
                headers[entry.filename.removesuffix(".npy")] = _read_header(file)

        def read(name: str) -> np.ndarray:
            with archive.open(f"{name}.npy") as file:
                return _read_array(file, _read_header(file))

        shapes = {name: header.shape for name, header in headers.items() if header.dtype.kind in "fiub"}
        kinds = {name: header.dtype for name, header in headers.items() if name not in shapes}
        others = {name: "text" if kind.kind in "US" else str(kind) for name, kind in kinds.items()}
        return chosen_variable(path, shapes, read, variable, others)


def _read_header(file: IO[bytes]) -> _Header:
    version = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise ValueError(f"its format has version {version}, expected (1, 0) or (2, 0)")
    header = _Header(*_HEADERS[version](file))
    if any(type(n) is not int or n < 0 for n in header.shape):
        raise ValueError(f"its header claims the shape {header.shape}")
    return header


def _read_array(file: IO[bytes], header: _Header) -> np.ndarray:
    """Return the array; not by numpy.load, which makes room for what the header claims before it reads."""
    content = file.read(math.prod(header.shape) * header.dtype.itemsize)
    values = np.frombuffer(content, header.dtype)  # a cut file leaves too few for the shape
    return values.reshape(header.shape, order="F" if header.is_fortran else "C")
