"""Compiled functions for tests: parts of the package have no entry of their own for Python."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba


def from_python(part: Callable[..., Any]) -> Any:
    """Return a compiled function that calls a part of the package, as compiled callers do."""
    return numba.njit(lambda *arguments: part(*arguments), error_model="numpy")
