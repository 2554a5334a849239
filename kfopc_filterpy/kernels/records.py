"""Records: named numbers that compiled code and Python share and change in place."""

from __future__ import annotations

import numba
import numpy as np


def new_record(**numbers: float) -> np.ndarray:
    """Return an array of one record with a field for each keyword: int64 for a plain int, float64 for anything else.

    Compiled code reads and writes ``record[0].name``, Python ``record["name"][0]``.

    Examples
    --------
    >>> from kfopc_filterpy.kernels.records import new_record
    >>> account = new_record(balance=0.5, entries=2)
    >>> account.item()
    (0.5, 2)
    """
    kinds = [(name, np.int64 if type(value) is int else np.float64) for name, value in numbers.items()]
    return as_records(np.array([tuple(numbers.values())], np.dtype(kinds, align=True)))


def as_records(array: np.ndarray) -> np.ndarray:
    """Return the array; if numba's compiler is switched off, one whose records have attributes in Python too."""
    return array.view(np.recarray) if vars(numba)["config"].DISABLE_JIT else array
