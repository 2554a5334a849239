"""Bounds on what a control filter of a given length can do: Wiener filters with and without a rated power."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
