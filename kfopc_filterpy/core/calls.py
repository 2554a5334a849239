"""Functions of the core that numba's compiled code and Python call: limiter, powers, amplifiers."""

from __future__ import annotations

import ctypes
from typing import Any

import llvmlite.binding
from numba import types

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
