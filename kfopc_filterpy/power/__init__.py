"""Rated output power: constraint factor, power budget, limiter, amplifier models and ratings."""

import lazy_loader

from .._removed import naming_removed

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
_INSTEAD = {"PowerBudget": "kf_pb, whose averaging_s keeps the account of the power"}
__getattr__ = naming_removed(__getattr__, __name__, _INSTEAD)
