"""Functions of the core that numba's compiled code and Python call: limiter, powers, amplifiers, covariance."""

from __future__ import annotations

import ctypes
from typing import Any

import llvmlite.binding
from numba import types

from .block import VISITOR
from .library import load

_library = load()
llvmlite.binding.load_library_permanently(str(_library.path))  # where numba's code finds the functions


def _compiled(name: str, result: Any, *arguments: Any) -> Any:
    """Return a function of the core for numba's code; addresses are given as integers."""
    return types.ExternalFunction(f"anc_{name}", result(*arguments))


def _held(name: str, result: Any, *arguments: Any) -> Any:
    """Return a function of the core for Python; it keeps the interpreter's lock."""
    function = getattr(_library.held, f"anc_{name}")
    function.restype, function.argtypes = result, arguments
    return function


_POWERS = (types.intp, types.intp, types.intp, types.int32, types.intp, types.float64, types.float64, types.float64)
preview_compiled = _compiled("preview", types.void, *_POWERS)
commit_compiled = _compiled("commit", types.void, *_POWERS)
limit_compiled = _compiled("limit", types.float64, types.intp, types.intp, types.float64)
amplify_compiled = _compiled("amplify", types.float64, types.intp, types.float64)

_SQUARES = (*(ctypes.c_void_p,) * 3, ctypes.c_int32, ctypes.c_void_p, *(ctypes.c_double,) * 3)
preview = _held("preview", None, *_SQUARES)
commit = _held("commit", None, *_SQUARES)
limit_all = _held("limit_all", None, *(ctypes.c_void_p,) * 4, ctypes.c_int64)
limit = _held("limit", ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_double)
amplify_all = _held("amplify_all", None, *(ctypes.c_void_p,) * 3, ctypes.c_int64)

_PLACES = (types.intp, types.int32, types.intp, types.intp)
covariance_step_compiled = _compiled("covariance_step", types.int32, *_PLACES, *(types.float64,) * 4, types.intp)
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
