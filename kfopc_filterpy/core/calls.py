"""Functions of the core that Python calls: limiter, powers, amplifiers. They keep the interpreter's lock."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from .library import load

LONGEST_CALL = 1600  # samples between two opportunities to interrupt: 0.1 s at 16 kHz
_held = load().held
preview, commit = _held.anc_preview, _held.anc_commit
limit, limit_all, amplify_all = _held.anc_limit, _held.anc_limit_all, _held.anc_amplify_all


def in_parts(function: Callable[..., Any], places: tuple[int, ...], signal: NDArray[Any], out: NDArray[Any]) -> None:
    """Let a function turn a signal into `out`, part by part: in between, other threads run and Ctrl-C is heard."""
    signal, flat = signal.reshape(-1), out.reshape(-1)
    for begin in range(0, signal.size, LONGEST_CALL):
        part = slice(begin, begin + LONGEST_CALL)
        function(*places, signal[part].ctypes.data, flat[part].ctypes.data, flat[part].size)
