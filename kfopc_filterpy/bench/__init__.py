"""Scene, registry of algorithms, tuning rule and report: what studies and sweeps share."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
