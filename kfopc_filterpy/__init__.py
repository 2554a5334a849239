"""Kalman filter with output power constraint (KF-OPC) for active noise control, an extension of filterpy.

`KFOPC` is a `filterpy.kalman.KalmanFilter`. Everything else is loaded when it is first used, so that importing
the package costs little more than importing filterpy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .estimator import KFOPC

if TYPE_CHECKING:
    from .amplifiers import HardClipAmplifier, LinearAmplifier, SoftSaturationAmplifier
    from .constraint import OutputPowerConstraint
    from .controllers import Controller, FxLMS, KalmanController, MOVFxLMS, kf_anc, kf_opc
    from .random_walk import RandomWalkKFOPC
    from .simulation import SimulationResult, simulate

__version__ = "0.1.0"

# Public names and the module each lives in.
_LAZY = {
    "Controller": "controllers",
    "FxLMS": "controllers",
    "HardClipAmplifier": "amplifiers",
    "KalmanController": "controllers",
    "LinearAmplifier": "amplifiers",
    "MOVFxLMS": "controllers",
    "OutputPowerConstraint": "constraint",
    "RandomWalkKFOPC": "random_walk",
    "SimulationResult": "simulation",
    "SoftSaturationAmplifier": "amplifiers",
    "kf_anc": "controllers",
    "kf_opc": "controllers",
    "simulate": "simulation",
}

__all__ = ["KFOPC", *sorted(_LAZY)]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_LAZY[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
