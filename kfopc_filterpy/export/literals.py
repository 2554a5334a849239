"""Numbers and arrays as C writes them."""

from __future__ import annotations

from collections.abc import Iterable
from textwrap import fill

import numpy as np

WIDTH = 120


def number(value: float, name: str, precision: np.dtype) -> str:
    """Return a number as C writes it; the precision must be able to hold it."""
    if isinstance(value, int | np.integer):
        return str(value)
    with np.errstate(over="ignore", under="ignore"):
        rounded = precision.type(value)
    if not np.isfinite(rounded):
        raise ValueError(f"{name} must be finite in {precision}, got {value:g}: scale the signals")
    return f"{rounded!s}{'' if precision == np.float64 else 'f'}"


def braces(numbers: Iterable[str], indent: str = "") -> str:
    """Return an array of numbers in braces, in several lines if it is long."""
    text = ", ".join(numbers)
    if len(text) < WIDTH // 2:
        return f"{{{text}}}"
    inner = indent + "    "
    wrapped = fill(text, WIDTH, initial_indent=inner, subsequent_indent=inner, break_on_hyphens=False)
    return f"{{\n{wrapped}\n{indent}}}"
