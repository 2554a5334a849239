"""Adaptive controllers for active noise control, one family a file; `Controller` is what a user's own must be."""

from .base import Controller
from .fxlms import FxLMS, MOVFxLMS
from .kalman import KalmanController, kf_anc, kf_opc

__all__ = ["Controller", "FxLMS", "KalmanController", "MOVFxLMS", "kf_anc", "kf_opc"]
