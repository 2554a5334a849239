"""Functions of the core that Python calls: limiter, powers, amplifiers, covariance."""

from __future__ import annotations

import ctypes
from typing import Any

from .block import VISITOR
from .library import load

_library = load()


def _held(name: str, result: Any, *arguments: Any) -> Any:
    """Return a function of the core for Python; it keeps the interpreter's lock."""
    function = getattr(_library.held, f"anc_{name}")
    function.restype, function.argtypes = result, arguments
    return function


_SQUARES = (*(ctypes.c_void_p,) * 3, ctypes.c_int32, ctypes.c_void_p, *(ctypes.c_double,) * 3)
preview = _held("preview", None, *_SQUARES)
commit = _held("commit", None, *_SQUARES)
limit_all = _held("limit_all", None, *(ctypes.c_void_p,) * 4, ctypes.c_int64)
limit = _held("limit", ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_double)
amplify_all = _held("amplify_all", None, *(ctypes.c_void_p,) * 3, ctypes.c_int64)

covariance_predict = _held("covariance_predict", None, ctypes.c_void_p, ctypes.c_int32, *(ctypes.c_double,) * 2)
covariance_update = _held(
    "covariance_update",
    *(ctypes.c_int, ctypes.c_void_p, ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p),
    *(ctypes.c_double, ctypes.c_double, ctypes.c_void_p),
)


def covariance_fields(n: int) -> tuple[int, dict[str, slice]]:
    """Return the size of the memory of a covariance, and where its fields are, in numbers."""
    fields: dict[str, slice] = {}

    def keep(_: Any, name: bytes, role: int, kind: int, offset: int, shape: Any) -> None:
        begin = offset // 8
        fields[name.decode()] = slice(begin, begin + shape[0] * shape[1] * shape[2] * shape[3])

    _held("covariance_describe", None, ctypes.c_int32, VISITOR, ctypes.c_void_p)(n, VISITOR(keep), None)
    return _held("covariance_size", ctypes.c_size_t, ctypes.c_int32)(n) // 8, fields
