"""What the filtered-reference LMS algorithms share."""

from __future__ import annotations

from .core_controller import CoreController, Limiters

__all__ = ["LMSController", "Limiters"]


class LMSController(CoreController):
    """A controller of the core with the setting `step_size`."""

    @property
    def step_size(self) -> float:
        """Step size mu."""
        return self._of_setting("step_size")
