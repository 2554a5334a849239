"""Kalman filters that filterpy users can use in place of filterpy's."""

import lazy_loader

from .._removed import naming_removed

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = naming_removed(__getattr__, __name__, {"PowerBudgetKalmanFilter": "kf_pb, a controller"})
