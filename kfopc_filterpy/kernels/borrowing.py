"""Arrays that compiled code borrows from Python for the duration of a call.

numba counts the references to each array that is passed to a function or unpacked from a tuple. In a loop over samples
this takes longer than the arithmetic of a short control filter. A borrowed array owns nothing, so there is nothing to
count: the loop of KF-OPC at 32 taps takes a third of the time, at 128 taps 0.7. Never return a borrowed array to Python.
"""

from __future__ import annotations

from typing import Any

from numba import errors, types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from .compiling import OPTIONS


def borrowed(value):
    """Return a NamedTuple, possibly nested, or a tuple of them, with every array borrowed; in Python, the value itself."""
    return value


@overload(borrowed, jit_options=OPTIONS)
def _borrowed(value):
    return lambda value: _without_owner(value)  # type: ignore[call-arg]


@intrinsic
def _without_owner(typing_context: Any, value: Any) -> Any:
    """Return a value whose arrays have no owner."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return disowned(context, builder, value, arguments[0])

    return value(value), generate


def disowned(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Return an LLVM value with the owners of its arrays set to null."""
    if isinstance(kind, types.Array):
        if kind.layout != "C":
            raise errors.TypingError("arrays of a state must be contiguous: numpy.ascontiguousarray makes them so")
        array = cgutils.create_struct_proxy(kind)(context, builder, value=value)
        array.meminfo, array.parent = array.meminfo.type(None), array.parent.type(None)
        return array._getvalue()
    if isinstance(kind, types.BaseTuple):
        for i in range(len(kind)):
            item = disowned(context, builder, kind[i], builder.extract_value(value, i))  # type: ignore[index]
            value = builder.insert_value(value, item, i)
    return value
