"""A trained controller as plain C99, for a microcontroller or a signal processor, or as an FMU, for a simulator."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
