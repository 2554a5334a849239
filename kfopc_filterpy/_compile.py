"""numba's `njit` with an on-disk cache that notices a change in any of the package's compiled modules.

numba watches only the file that a function stands in, but the loop has the kernels of other files compiled into it:
after an upgrade or an edit of one of them it would go on with the old ones.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

COMPILED_MODULES = ("amplifiers", "constraint", "kernels", "loop")
SOURCES = hashlib.sha256(
    b"".join(Path(__file__).with_name(f"{name}.py").read_bytes() for name in COMPILED_MODULES)
).hexdigest()


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: `numba.njit(cache=True, error_model="numpy", **options)`.

    Division is numpy's (Inf or NaN, which the callers look for): a test for zero at each would make a way out of every
    function, at which references to all its arrays are counted; the loop took three times as long for it.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = njit(cache=True, error_model="numpy", **options)(function)
        cache_file: Any = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
        if hasattr(cache_file, "_source_stamp"):  # not where numba's compiler is switched off
            cache_file._source_stamp = (cache_file._source_stamp, SOURCES)
        return dispatcher

    return decorate
