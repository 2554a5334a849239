"""The constraint of a filter as its user sees it: what can be read, and supplied by the caller instead."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .._validate import as_choice, as_nonnegative, as_positive

if TYPE_CHECKING:
    from ..power.constraint import OutputPowerConstraint


def constraint_settings(
    fs: float | None, memory: float | None, window: str, secondary_path_gain: float | None
) -> dict[str, Any]:
    """Keywords of an `OutputPowerConstraint`, checked now although it may be made later; None: its default."""
    settings: dict[str, Any] = {"window": as_choice(window, "power_window", ("exponential", "sliding"))}
    if fs is not None:
        settings["fs"] = as_positive(fs, "fs", unit="Hz")
    if memory is not None:
        settings["memory"] = as_positive(memory, "power_memory", unit="s")
    if secondary_path_gain is not None:
        settings["secondary_path_gain"] = as_positive(secondary_path_gain, "secondary_path_gain")
    return settings


class ConstraintAttributes:
    """Attributes of a filter with an output power constraint (eq. 10-13), for a class with `dim_z`."""

    dim_z: int
    _constraint: OutputPowerConstraint | None = None
    _unconstrained_factor = 1.0
    _constraint_settings: dict[str, Any]

    @property
    def rated_power(self) -> float | None:
        """Rated output power; assign another, or None to lift the constraint."""
        return None if self._constraint is None else self._constraint.rated_power

    @rated_power.setter
    def rated_power(self, value: float | None) -> None:
        if value is None:
            self._constraint = None
        elif self._constraint is not None:
            self._constraint.rated_power = value
        else:
            if self.dim_z != 1:
                raise ValueError(f"a rated power needs one measurement, dim_z = 1, got dim_z = {self.dim_z}")
            from ..power.constraint import OutputPowerConstraint  # numba, only where it is needed

            self._constraint = OutputPowerConstraint(value, **self._constraint_settings)

    @property
    def constraint(self) -> OutputPowerConstraint | None:
        """The object that keeps the powers and the factor; None without a rated power."""
        return self._constraint

    @property
    def constraint_factor(self) -> float:
        """Factor that scales the measurement; assign a value to hold it, None to follow eq. 13 again."""
        return self._unconstrained_factor if self._constraint is None else self._constraint.factor

    @constraint_factor.setter
    def constraint_factor(self, value: float | None) -> None:
        if self._constraint is not None:
            self._constraint.factor = value
        else:
            self._unconstrained_factor = 1.0 if value is None else as_nonnegative(value, "constraint_factor")

    @property
    def disturbance_power(self) -> float | None:
        """Disturbance power delta_d^2 last used (eq. 10), None without a rated power; can be supplied."""
        return None if self._constraint is None else self._constraint.disturbance_power

    @disturbance_power.setter
    def disturbance_power(self, value: float | None) -> None:
        self._require_constraint("disturbance_power").disturbance_power = value

    @property
    def secondary_path_gain(self) -> float | None:
        """Secondary-path power gain G_s last used (eq. 11), None before any is known; can be supplied."""
        return None if self._constraint is None else self._constraint.secondary_path_gain

    @secondary_path_gain.setter
    def secondary_path_gain(self, value: float | None) -> None:
        self._require_constraint("secondary_path_gain").secondary_path_gain = value

    def _require_constraint(self, name: str) -> OutputPowerConstraint:
        if self._constraint is None:
            raise ValueError(f"{name} takes part only in a constraint: set rated_power first")
        return self._constraint


class BatchReferences:
    """Reference samples of a batch under way; a filter copied meanwhile (`Saver` does) is in no batch."""

    def __init__(self, samples: np.ndarray) -> None:
        self.next = iter(samples.tolist()).__next__

    def __deepcopy__(self, memo: dict[int, Any]) -> None:
        return None
