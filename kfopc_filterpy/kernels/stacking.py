"""NamedTuples of one type, stacked into one whose arrays have an extra leading axis, for compiled loops over them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numba.extending import overload

from .compiling import OPTIONS
from .covariance import LINE


def stacked(values: list[Any]) -> Any:
    """Return several NamedTuples of one type as one: arrays and numbers get a leading axis, None stays None."""
    first = values[0]
    if isinstance(first, tuple):
        return type(first)(*(stacked(list(field)) for field in zip(*values, strict=True)))
    return None if first is None else aligned(np.array(values))


def aligned(array: np.ndarray) -> np.ndarray:
    """Return a copy that begins at a cache line, so that fewer vector loads cross two lines."""
    memory = np.empty(array.nbytes + LINE, np.uint8)
    start = -memory.ctypes.data % LINE
    copy = memory[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy


def unstack(stack: Any, i: int, value: Any) -> None:
    """Copy the arrays of the i-th of the stacked NamedTuples into `value`."""
    for many, own in zip(stack, value, strict=True):
        if isinstance(own, tuple):
            unstack(many, i, own)
        elif isinstance(own, np.ndarray):
            own[...] = many[i]


def member(stack: Any, i: int) -> Any:
    """Return the i-th of stacked NamedTuples, its arrays as views.

    An array of one row, and a NamedTuple with a field `taken`, belong to all.
    """
    raise NotImplementedError("for compiled callers")


@overload(member, jit_options=OPTIONS)
def _member(stack, i):
    if isinstance(stack, types.Array):
        return lambda stack, i: stack[i if len(stack) > 1 else 0]
    if isinstance(stack, types.BaseNamedTuple) and not hasattr(stack.instance_class, "taken"):  # type: ignore[attr-defined]
        kind = stack.instance_class  # type: ignore[attr-defined]
        return lambda stack, i: kind(*_member_items(tuple(stack), i))
    return lambda stack, i: stack


def _member_items(items: Any, i: int) -> Any:
    raise NotImplementedError("for compiled callers")


@overload(_member_items, jit_options=OPTIONS)
def _member_tuple(items, i):
    if len(items) == 1:
        return lambda items, i: (member(items[0], i),)
    return lambda items, i: (member(items[0], i),) + _member_items(items[1:], i)  # noqa: RUF005
