"""Control in real time: a supervisor for faults, interfaces to a sound device or a simulated plant, and the run itself."""

import lazy_loader

from .._removed import naming_removed

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = naming_removed(__getattr__, __name__, {"Levels": "RunStatus"})
