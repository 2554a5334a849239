"""Load the core's library: the one for the highest level of this processor, if it was built from these sources."""

from __future__ import annotations

import ctypes
import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import building

LEVEL_VARIABLE = "KFOPC_CORE_LEVEL"
LINE = 64  # bytes in a cache line
_HOW = "build it from the clone: python -m pip install -e ."
VISITOR = ctypes.PYFUNCTYPE(
    None,
    *(ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_int, ctypes.c_size_t),
    ctypes.POINTER(ctypes.c_int32),
)
# Types of the functions in anc.h that Python calls, first that of the result: - nothing, P a pointer, i and q integers
# of 32 and 64 bits, N a size, r a number of the core, V a visitor.
_TYPES = {"-": None, "P": ctypes.c_void_p, "i": ctypes.c_int32, "q": ctypes.c_int64, "N": ctypes.c_size_t, "V": VISITOR}
_CALLS = {
    "size": "NPP",
    "open": "iPPPPNi",
    "describe": "-PPVP",
    "refilter": "-P",
    "listen": "qPPPPPqP",
    "run": "qPPPPiqqP",
    "hear": "-PPq",
    "play": "-PPqq",
    "process": "qPiiiPPPPqqqPP",
    "preview": "-PPPiP",
    "commit": "-PPPiP",
    "limit": "rPPr",
    "limit_all": "-PPPPq",
    "amplify_all": "-PPPq",
}


class Library(NamedTuple):
    """A loaded library of the core."""

    path: Path
    level: str
    free: ctypes.CDLL  # its calls release the interpreter's lock: other threads run
    held: ctypes.PyDLL  # its calls keep the lock: shorter, and two threads cannot be inside one controller


class Field(NamedTuple):
    """A field of a controller's memory, as the core describes it."""

    name: str
    role: int
    kind: int  # of its numbers: 0 for those of the core, 1 for integers
    offset: int  # in bytes
    shape: tuple[int, ...]


def fields_of(describe: Callable[..., None], *what: Any) -> list[Field]:
    """Return the fields of what a function of the core describes to a visitor."""
    found: list[Field] = []

    def visit(_: Any, name: bytes, role: int, kind: int, offset: int, axes: Any) -> None:
        found.append(Field(name.decode(), role, kind, offset, tuple(axes[:4])))

    describe(*what, VISITOR(visit), None)
    return found


def at_cache_line(n_bytes: int) -> NDArray[np.uint8]:
    """Return zeros that begin at a cache line, where wide vectors are fastest."""
    room = np.zeros(n_bytes + LINE, np.uint8)
    return room[-room.ctypes.data % LINE :][:n_bytes]


def constant(name: str, real: str = "double") -> float:
    """Return the constant `anc_<name>` of anc.h."""
    kind = ctypes.c_float if real == "float" else ctypes.c_double
    return kind.in_dll(load(real).held, f"anc_{name}").value


@functools.cache
def load(real: str = "double") -> Library:
    """Load the core's library for a type of numbers.

    Parameters
    ----------
    real : {"double", "float"}
        Type of the core's numbers.

    Returns
    -------
    Library
        For the highest level that is built and that this processor has, or for the level that the environment variable
        KFOPC_CORE_LEVEL names.

    Raises
    ------
    ImportError
        If the library is missing, was built from other sources or does not fit this machine. The message says how to
        build it.
    """
    if real not in building.REALS:
        raise ValueError(f"real must be one of {building.REALS}, got {real!r}")
    lowest = _open(real, building.LEVELS[0])
    highest = {3: 2, 4: 3}.get(lowest.free.anc_processor_level(), 1)
    usable = [level for level in building.LEVELS[:highest] if _path(real, level).exists()]
    level = os.environ.get(LEVEL_VARIABLE) or usable[-1]
    if level not in usable:
        raise ImportError(
            f"{LEVEL_VARIABLE}={level}: the levels that are built and that this machine has are {', '.join(usable)}"
        )
    return lowest if level == lowest.level else _open(real, level)


def _path(real: str, level: str) -> Path:
    return building.FOLDER / building.library_name(real, level)


def _open(real: str, level: str) -> Library:
    path = _path(real, level)
    if not path.exists():
        raise ImportError(f"the C core of kfopc_filterpy is not built ({path.name} is missing); {_HOW}")
    try:
        free, held = ctypes.CDLL(str(path)), ctypes.PyDLL(str(path))
    except OSError as error:
        why = " ".join(str(error).split())
        raise ImportError(f"the C core of kfopc_filterpy does not load ({why}); {_HOW}") from None
    if building.stamp_of(free) != building.stamp():
        raise ImportError(
            f"the C core of kfopc_filterpy, {path.name}, was built from other sources than its own; {_HOW}"
        )
    types = _TYPES | {"r": ctypes.c_float if real == "float" else ctypes.c_double}
    for name, letters in _CALLS.items():
        for library in (free, held):
            function = getattr(library, f"anc_{name}")
            function.restype, *function.argtypes = (types[letter] for letter in letters)
    return Library(path, level, free, held)
