"""Names that the package had: asking for one says what to use in its place."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any


def naming_removed(found: Callable[[str], Any], module: str, instead: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a module that says of removed names what to use `instead`, and else asks `found`."""

    def get(name: str) -> Any:
        if name in instead:
            raise AttributeError(f"{module} has no {name} any more: use {instead[name]}")
        return found(name)

    return get
