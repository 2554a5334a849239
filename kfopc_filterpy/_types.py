"""Types of arguments and results that occur in many signatures.

They are read by type checkers, and import only numpy.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from numpy.typing import ArrayLike

if TYPE_CHECKING:
    import control
    import numpy as np

# A float with one channel, with several an array with a number for each, (n,). As with numpy's own functions that
# return a number or an array, it is Any: with a union, a type checker would have every caller check which of them came.
NumberOrArray: TypeAlias = Any
PerLoudspeaker: TypeAlias = float | ArrayLike  # one number for all loudspeakers, or one for each, (J,)
PerMicrophone: TypeAlias = float | ArrayLike  # one number for all microphones, or one for each, (K,)
# What rng= takes; in quotes, because numpy imports numpy.random only when it is first used.
Seed: TypeAlias = "int | Sequence[int] | np.random.SeedSequence | np.random.Generator"

# One path: its taps, (n_taps,), or a discrete-time system of python-control.
System: TypeAlias = "control.TransferFunction | control.StateSpace"
PathModel: TypeAlias = "ArrayLike | System"
# One path, or several: taps (outputs, inputs, n_taps), a system with several channels, or rows of systems.
PathModels: TypeAlias = "PathModel | Sequence[Sequence[System]]"


class Counter(Protocol):
    """What counts samples or runs that are done."""

    def update(self, n: int, /) -> object:
        """Count `n` more as done."""
        ...


class ProgressBar(Counter, Protocol):
    """What is used of a bar of tqdm."""

    total: Any

    def set_description(self, desc: str, /) -> object:
        """Show what is being done."""
        ...
