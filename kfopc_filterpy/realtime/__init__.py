"""Control in real time: a supervisor for faults, interfaces to a sound device or a simulated plant, and the run itself."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
