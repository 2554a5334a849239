"""Kalman filter with output power constraint (KF-OPC) for active noise control, an extension of filterpy.

`KFOPC` is a `filterpy.kalman.KalmanFilter`. Everything else is loaded when it is first used, so that importing
the package costs little more than importing filterpy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .estimator import KFOPC

if TYPE_CHECKING:
    from .constraint import OutputPowerConstraint
    from .random_walk import RandomWalkKFOPC

__version__ = "0.1.0"

# Public names and the module each lives in.
_LAZY = {
    "OutputPowerConstraint": "constraint",
    "RandomWalkKFOPC": "random_walk",
}

__all__ = ["KFOPC", "OutputPowerConstraint", "RandomWalkKFOPC"]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_LAZY[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
