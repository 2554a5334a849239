"""What all functions that make a controller have in common."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from inspect import signature
from numbers import Integral
from typing import Any, TypeVar, cast

_Maker = TypeVar("_Maker", bound=Callable[..., Any])


def controller_maker(make: _Maker) -> _Maker:
    """Return a function that makes a controller, and says what is wrong with arguments that its law does not take.

    That is: a rated power or rate that it has no use for, or its first two arguments swapped.
    """
    known = signature(make).parameters

    @wraps(make)
    def made(*arguments: Any, **settings: Any) -> Any:
        if len(arguments) > 1 and isinstance(arguments[1], Integral):
            raise TypeError(
                f"secondary must be a path or a Plant, got {arguments[1]}: the order is {make.__name__}(n_taps, secondary, ...)"
            )
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
