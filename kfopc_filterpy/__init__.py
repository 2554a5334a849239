"""Kalman filter with output power constraint (KF-OPC) for active noise control, an extension of filterpy.

What everyone uses is here; the rest is in the namespaces `filters`, `power`, `controllers`, `paths`, `signals`, `bounds`,
`metrics`, `realtime`, `export` and `plot`. Each name stands once, in the `__init__.pyi` beside this file or in a
namespace's, and is loaded when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = "1.0.0"
