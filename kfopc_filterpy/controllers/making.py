"""What all functions that make a controller have in common."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from inspect import signature
from typing import Any, TypeVar, cast

_Maker = TypeVar("_Maker", bound=Callable[..., Any])


def controller_maker(make: _Maker) -> _Maker:
    """Return a function that makes a controller, and says what keeps a rated power if its own law has none."""
    known = signature(make).parameters

    @wraps(make)
    def made(*arguments: Any, **settings: Any) -> Any:
        for name in ("rated_power", "fs"):
            if name in settings and name not in known:
                raise TypeError(
                    f"{make.__name__} has no {name}, because its law does not use one: to keep a rated power whatever the "
                    "controller asks for, give limiter=OutputLimiter(rated_power, fs=...)"
                )
        return make(*arguments, **settings)

    return cast("_Maker", made)


def require_rated_power(rated_power: Any, constraint: Any) -> None:
    """Raise ValueError unless a controller that needs a rated power gets either that or a constraint."""
    if (rated_power is None) == (constraint is None):
        raise ValueError("give either rated_power= or constraint=, an OutputPowerConstraint")
