"""A limiter for a user-defined controller."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._types import NumberOrArray
from .._validate import as_finite_array
from ..power.limiter import OutputLimiter
from .base import Controller, WrappedController, listening
from .core_controller import CoreController


class LimitedController(WrappedController):
    """A user-defined controller whose control signal passes through a limiter.

    The built-in controllers have their own `limiter`, with which they run at compiled speed.

    Parameters
    ----------
    controller : Controller
        Any controller. If it has a method ``emitted(control_signal)``, this is called with the limiter's output in each
        sample, before `update`. A disturbance estimate ``e + s^ * y`` must use that output.
    limiter : OutputLimiter
        Limiter, not shared with another controller.

    Raises
    ------
    TypeError
        An object that is not a controller, or not a limiter.
    ValueError
        A built-in controller, which has its own `limiter`.

    Examples
    --------
    >>> from kfopc_filterpy import LimitedController, OutputLimiter
    >>> class Loud:
    ...     def control_signal(self, reference):
    ...         return 10.0 * reference
    ...     def update(self, error):
    ...         pass
    >>> controller = LimitedController(Loud(), OutputLimiter(rated_power=1.0, fs=16000, amplitude_limit=2.0))
    >>> controller.control_signal(1.0)
    2.0
    """

    _limiter: Any = None

    def __init__(self, controller: Controller, limiter: OutputLimiter) -> None:
        if isinstance(controller, CoreController):
            raise ValueError("this controller has a limiter of its own: set controller.limiter, or pass limiter=")
        super().__init__(controller, "limited")
        self.limiter = limiter

    @property
    def limiter(self) -> OutputLimiter:
        """Limiter of the control signal; can be assigned, but not shared with another controller."""
        return self._limiter

    @limiter.setter
    def limiter(self, limiter: OutputLimiter) -> None:
        if not isinstance(limiter, OutputLimiter):
            raise TypeError(f"limiter must be an OutputLimiter, got {limiter!r}")
        if self._limiter is not None:
            limiter.follow(self._limiter)
        self._limiter = limiter

    def __repr__(self) -> str:
        return f"<{self.name}: limiter of rated power {self.limiter.rated_power:g}>"

    def control_signal(self, reference: float) -> float:
        """Return the limited control signal y(n) for the newest reference sample x(n)."""
        as_finite_array(reference, "reference")
        y = self.controller.control_signal(reference)
        if not np.isfinite(y):  # a divergence: return it, so that the loop detects it
            return y
        y = self.limiter(y)
        emitted = getattr(self.controller, "emitted", None)
        if emitted is not None:
            emitted(y)
        return y

    def update(self, error: NumberOrArray) -> None:
        """Pass the error e(n) to the controller's `update`."""
        as_finite_array(error, "error")
        super().update(error)

    def _rates(self) -> dict[str, float | None]:
        return {"limiter": self.limiter.fs}

    def listen(self, references: np.ndarray, errors: np.ndarray) -> None:
        """Let the controller follow `references` and `errors` before the control is switched on, with silent output."""
        listening(self.controller).listen(references, errors)
        self.limiter.process(np.zeros(len(references)))
