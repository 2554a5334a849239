"""Arrays that compiled code borrows from Python for the time of a call.

numba counts the references to each array that passes through a call or comes out of a tuple. In a loop over samples that
takes longer than the arithmetic of a short control filter. A borrowed array owns nothing, so there is nothing to count:
the loops at 32, 128 and 256 taps take a fifth, 0.6 and 0.85 of the time. Nothing borrowed may be returned to Python.
"""

from __future__ import annotations

from typing import Any

from numba import carray, errors, types
from numba.extending import intrinsic, overload

from .compiling import OPTIONS


@intrinsic
def _pointer(typing_context: Any, address: Any) -> Any:
    """Turn an address into a pointer (the example of an intrinsic in numba's documentation)."""
    if not isinstance(address, types.Integer):
        return None

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.voidptr(types.uintp), generate


def borrowed(value):
    """Return a NamedTuple of arrays, nested or not, with every array borrowed; in Python, the value itself."""
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
    return lambda value: value


def _borrowed_items(items):
    return items


@overload(_borrowed_items, jit_options=OPTIONS)
def _borrowed_tuple(items):
    if len(items) == 1:
        return lambda items: (borrowed(items[0]),)
    return lambda items: (borrowed(items[0]),) + _borrowed_items(items[1:])  # noqa: RUF005
