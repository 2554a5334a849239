"""Adaptive controllers for active noise control, one family a file; `Controller` is what a user's own must be."""

from .base import Controller
from .fxlms import FxLMS, MOVFxLMS
from .kalman import KalmanController, kf_anc, kf_opc, kf_pb
from .limited import LimitedController
from .repaired import RepairedKFOPC, kf_opc_repaired

__all__ = [
    "Controller",
    "FxLMS",
    "KalmanController",
    "LimitedController",
    "MOVFxLMS",
    "RepairedKFOPC",
    "kf_anc",
    "kf_opc",
    "kf_opc_repaired",
    "kf_pb",
]
