"""Load the core's library: the one for the highest level of this processor, if it was built from these sources."""

from __future__ import annotations

import ctypes
import functools
import os
from pathlib import Path
from typing import NamedTuple

from . import building

LEVEL_VARIABLE = "KFOPC_CORE_LEVEL"
_HOW = "build it from the clone: python -m pip install -e ."


class Library(NamedTuple):
    """A loaded library of the core."""

    path: Path
    level: str
    free: ctypes.CDLL  # its calls release the interpreter's lock: other threads run
    held: ctypes.PyDLL  # its calls keep the lock: shorter, and two threads cannot be inside one controller


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
        raise ImportError(
            f"the C core of kfopc_filterpy does not load ({' '.join(str(error).split())}); {_HOW}"
        ) from None
    if building.stamp_of(free) != building.stamp():
        raise ImportError(
            f"the C core of kfopc_filterpy was built from other sources than those beside it ({path.name}); {_HOW}"
        )
    return Library(path, level, free, held)
