"""Limits that no control filter of its length passes: Wiener solutions, free and within a rated power, and what they need."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
