"""Control in real time: interfaces to a sound device or a simulated plant, a supervisor, and the run itself."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
