"""Adaptive controllers for active noise control, one family a file; `Controller` is what a user's own must be."""

from .amplitude_limited import ClippingFxLMS, RescalingFxLMS, TwoGradientFxLMS
from .base import Controller
from .diagonal import DiagonalKalman
from .fast_array import FastArrayKalman
from .fxlms import FxLMS, FxNLMS
from .fxrls import fx_rls
from .kalman import KalmanController, kf_anc, kf_opc, kf_pb
from .limited import LimitedController
from .penalized import LeakyFxLMS, MOVFxLMS, OptimalLeakyFxLMS, leak_factor, penalty_factor
from .repaired import RepairedKFOPC, kf_opc_repaired

__all__ = [
    "ClippingFxLMS",
    "Controller",
    "DiagonalKalman",
    "FastArrayKalman",
    "FxLMS",
    "FxNLMS",
    "KalmanController",
    "LeakyFxLMS",
    "LimitedController",
    "MOVFxLMS",
    "OptimalLeakyFxLMS",
    "RepairedKFOPC",
    "RescalingFxLMS",
    "TwoGradientFxLMS",
    "fx_rls",
    "kf_anc",
    "kf_opc",
    "kf_opc_repaired",
    "kf_pb",
    "leak_factor",
    "penalty_factor",
]
