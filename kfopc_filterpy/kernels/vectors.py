"""Compiled arithmetic of vectors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numba.extending import overload

from .compiling import OPTIONS, part

# No flag here lets the compiler assume that NaN or Inf do not occur: the checks for them must survive.
FAST = {"reassoc", "contract", "nsz"}


@part()
def copy_into(target, source):
    """Set target[:] = source, by a loop because numba takes two seconds to compile the slice."""
    for i in range(source.size):
        target[i] = source[i]


@part(fastmath=FAST)
def dot(a, b):
    """Return the inner product of `a` and the first a.size elements of `b`."""
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@part(fastmath=FAST)
def add_scaled(target, factor, source, begin, end):
    """Add factor * source to target at the indices begin to end - 1."""
    for k in range(begin, end):
        target[k] += factor * source[k]


def at(values: Any, j: int) -> Any:
    """Return the j-th of several values, in an array or a plain tuple; a single value, a NamedTuple too, is returned."""
    several = isinstance(values, np.ndarray) or (isinstance(values, tuple) and not hasattr(values, "_fields"))
    return values[j] if several else values


@overload(at, jit_options=OPTIONS | {"forceinline": True})
def _at(values, j):
    if isinstance(values, types.Array | types.UniTuple):
        return lambda values, j: values[j]
    return lambda values, j: values
