"""Kalman filter with output power constraint (KF-OPC) for active noise control, an extension of filterpy.

What everyone uses is here; the rest is in the namespaces `filters`, `power`, `controllers`, `paths`, `signals`,
`bounds`, `metrics`, `verdict`, `realtime`, `export` and `plot`. Each name stands once, in the `__init__.pyi` beside
this file or in a namespace's, and is loaded when it is first used.
"""

import sys
from typing import Any

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = "1.0.0"


def __getattr__(name: str) -> Any:
    """Load a name when it is first used; the error of one that does not exist says which was meant."""
    try:
        return _load(name)
    except AttributeError:
        if name.startswith("_") or name in __all__:
            raise
    from difflib import get_close_matches
    from importlib.util import find_spec
    from pathlib import Path

    known = {there.lower(): there for there in __all__}
    for stub in Path(__file__).parent.glob("*/__init__.pyi"):
        space = _load(stub.parent.name)
        known = {there.lower(): f"{space.__name__}.{there}" for there in space.__all__} | known
    meant = "".join(f"; did you mean {known[one]}?" for one in get_close_matches(name.lower(), known, n=1))
    # `from kfopc_filterpy import ...` asks whether there is such a name, and would say nothing of an AttributeError
    if sys._getframe(1).f_code.co_name == "_handle_fromlist" and find_spec(f"{__name__}.{name}") is None:
        raise ImportError(f"cannot import name {name!r} from {__name__!r}{meant}", name=__name__)
    # with an object of its own, Python's traceback adds no guess among the top-level names
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}{meant}", name=name, obj=None)
