"""Arrays that compiled code borrows from Python for the duration of a call.

numba counts the references to each array that is passed to a function or unpacked from a tuple. In a loop over samples
this takes longer than the arithmetic of a short control filter. A borrowed array owns nothing, so there is nothing to
count: the loop of KF-OPC at 32 taps takes a third of the time, at 128 taps 0.7. Never return a borrowed array to Python.
"""

from __future__ import annotations

from typing import Any

from numba import carray, errors, types
from numba.extending import intrinsic, overload

from .compiling import OPTIONS


@intrinsic
def _pointer(typing_context: Any, address: Any) -> Any:
    """Return an address as a pointer (numba's documentation has this as its example of an intrinsic)."""
    if not isinstance(address, types.Integer):
        return None

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.voidptr(types.uintp), generate


def borrowed(value):
    """Return a NamedTuple, possibly nested, or a tuple of them, with every array borrowed; called from Python, return the value itself."""
    return value


@overload(borrowed, jit_options=OPTIONS)
def _borrowed(value):
    if isinstance(value, types.Array):
        if value.layout != "C":
            raise errors.TypingError("arrays of a state must be contiguous: numpy.ascontiguousarray makes them so")
        return lambda value: carray(_pointer(value.ctypes.data), value.shape, value.dtype)  # type: ignore[call-arg]
    if isinstance(value, types.BaseNamedTuple):
        kind = value.instance_class  # type: ignore[attr-defined]
        return lambda value: kind(*_borrowed_items(tuple(value)))
    if isinstance(value, types.UniTuple):  # of NamedTuples, one for each loudspeaker
        return lambda value: _borrowed_items(value)
    return lambda value: value


def _borrowed_items(items):
    return items


@overload(_borrowed_items, jit_options=OPTIONS)
def _borrowed_tuple(items):
    if len(items) == 1:
        return lambda items: (borrowed(items[0]),)
    return lambda items: (borrowed(items[0]),) + _borrowed_items(items[1:])  # noqa: RUF005
