"""Eq. 10-13: from the rated power and running power estimates to the constraint factor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_choice, as_nonnegative, as_number, as_positive
from ..core.calls import commit, preview

DEFAULT_MEMORY_S = 0.5


# Structures of the core, see anc.h.
POWER = np.dtype([(name, np.float64) for name in ("mean_square", "lap", "taken", "position")])
SETTINGS = ("rated_power", "rate", "supplied_factor", "supplied_power", "supplied_gain")  # NaN if not supplied
NUMBERS = np.dtype([(name, np.float64) for name in (*SETTINGS, "factor", "power", "gain")])
PREVIEWED = np.dtype(
    [(name, np.float64, 3) for name in ("square", "mean")]
    + [(name, np.float64) for name in ("factor", "power", "gain")]
)


class ConstraintState(NamedTuple):
    """State that the core reads and updates."""

    powers: np.ndarray  # (3,) of POWER: disturbance, filtered reference, reference
    window: np.ndarray  # (3, m) this lap's squares, then the last lap's sums from each index on; m = 0: exponential
    numbers: np.ndarray  # (1,) of NUMBERS: settings, values last used


class _Room:
    """What the core makes of a sample before it is accepted, and where it finds the state."""

    def __init__(self, state: ConstraintState) -> None:
        self.previewed = np.zeros(1, PREVIEWED)
        self.previewed["square"] = 0.0, 0.0, math.nan
        powers, window, numbers, previewed = (array.ctypes.data for array in (*state, self.previewed))
        self.places = numbers, powers, window, state.window.shape[1], previewed


class OutputPowerConstraint:
    r"""Constraint factor of KF-OPC, updated sample by sample (eq. 10-13).

    .. math:: \alpha = \min\{\sqrt{\rho_o G_s / \delta_d^2},\ 1\}

    Parameters
    ----------
    rated_power : float
        Rated output power :math:`\rho_o` of the amplifier, the mean square of the control signal.
    fs : float
        Sample rate in Hz.
    secondary_path_gain : float, optional
        Power gain :math:`G_s`; by default estimated as E[x'^2]/E[x^2] (eq. 11).
    memory_s : float, default 0.5
        Memory of the power estimates in seconds: the time constant of the exponential window, or the length
        of the sliding one.
    window : {"exponential", "sliding"}, default "exponential"
        Window of the power estimates. They are unbiased from the start: plain means until the window is full.

    Raises
    ------
    ValueError
        A power, gain, rate or memory that is not positive and finite, or an unknown window.

    Examples
    --------
    >>> from kfopc_filterpy import OutputPowerConstraint
    >>> constraint = OutputPowerConstraint(rated_power=1.0, fs=16000, secondary_path_gain=1.0)
    >>> constraint.advance(2.0)  # a disturbance of power 4, a rated power of 1
    0.5
    >>> constraint.disturbance_power
    4.0
    """

    def __init__(
        self,
        rated_power: float,
        *,
        fs: float,
        secondary_path_gain: float | None = None,
        memory_s: float = DEFAULT_MEMORY_S,
        window: str = "exponential",
    ) -> None:
        rated_power = as_positive(rated_power, "rated_power")
        self.fs = as_positive(fs, "fs", unit="Hz")
        self.memory_s = as_positive(memory_s, "memory_s", unit="s")
        self.window = as_choice(window, "window", ("exponential", "sliding"))
        samples = self.memory_s * self.fs
        length = max(round(samples), 1) if window == "sliding" else 0
        numbers = np.zeros(1, NUMBERS)
        numbers["rated_power"], numbers["rate"] = rated_power, -math.expm1(-1.0 / samples)
        for name in ("supplied_factor", "supplied_power", "supplied_gain", "gain"):
            numbers[name] = math.nan
        numbers["factor"] = 1.0
        self._state = ConstraintState(np.zeros(3, POWER), np.zeros((3, length)), numbers)
        self._room: _Room | None = None
        self._given_gain = secondary_path_gain
        self.secondary_path_gain = secondary_path_gain

    def fresh(self, rated_power: float | None = None) -> OutputPowerConstraint:
        """Return a constraint with the same settings and no samples yet; `rated_power` replaces the rated power."""
        return OutputPowerConstraint(
            self.rated_power if rated_power is None else rated_power,
            fs=self.fs,
            secondary_path_gain=self._given_gain,
            memory_s=self.memory_s,
            window=self.window,
        )

    @property
    def state(self) -> ConstraintState:
        """Arrays that the core updates."""
        return self._state

    @property
    def rated_power(self) -> float:
        """Rated output power; can be assigned."""
        return float(self._state.numbers["rated_power"][0])

    @rated_power.setter
    def rated_power(self, value: float) -> None:
        self._state.numbers["rated_power"] = as_positive(value, "rated_power")

    @property
    def factor(self) -> float:
        """Constraint factor last used; assign a value from 0 to 1 to fix it, None to compute it again."""
        return self._read("factor")

    @factor.setter
    def factor(self, value: float | None) -> None:
        factor = None if value is None else as_nonnegative(value, "constraint_factor")
        if factor is not None and factor > 1.0:
            raise ValueError(
                f"constraint_factor must be 1 at most (eq. 13), got {factor!r}: 1 leaves the measurement as it is"
            )
        self._supply("factor", factor)

    @property
    def disturbance_power(self) -> float:
        """Disturbance power last used (eq. 10); assign a value to supply it, None to estimate it again."""
        return self._read("power")

    @disturbance_power.setter
    def disturbance_power(self, value: float | None) -> None:
        self._supply("power", None if value is None else as_nonnegative(value, "disturbance_power"))

    @property
    def secondary_path_gain(self) -> float | None:
        """Power gain last used (eq. 11), or None; assign a value to supply it, None to estimate it again."""
        gain = self._read("gain")
        return None if math.isnan(gain) else gain

    @secondary_path_gain.setter
    def secondary_path_gain(self, value: float | None) -> None:
        self._supply("gain", None if value is None else as_positive(value, "secondary_path_gain"))

    def preview(self, disturbance: float, filtered_reference: float = 0.0, reference: float | None = None) -> float:
        """Return the constraint factor with this sample; the powers change only if `accept` follows.

        `disturbance`, `filtered_reference` and `reference` are those of `advance`.
        """
        supplied = self._state.numbers[["supplied_gain", "supplied_factor"]].item()
        if reference is None and all(map(math.isnan, supplied)):
            raise ValueError(
                "the secondary-path gain is unknown: pass reference=, the newest reference sample x(n), "
                "or set secondary_path_gain"
            )
        room = self._opened()
        room.previewed["square"] = (
            squared(disturbance, "the measurement"),
            squared(filtered_reference, "the newest filtered reference"),
            math.nan if reference is None else squared(reference, "reference"),
        )
        preview(*room.places)
        return float(room.previewed["factor"][0])

    def accept(self) -> float:
        """Add the sample of the last `preview` to the powers and return the constraint factor."""
        room = self._opened()
        commit(*room.places)
        return float(self._state.numbers["factor"][0])

    def advance(self, disturbance: float, filtered_reference: float = 0.0, reference: float | None = None) -> float:
        """Add one sample to the powers and return the constraint factor.

        Parameters
        ----------
        disturbance : float
            Disturbance (measurement) d(n).
        filtered_reference : float, default 0
            Newest filtered reference x'(n).
        reference : float, optional
            Newest reference x(n); can be omitted if the gain or the factor was supplied.

        Returns
        -------
        float
            Constraint factor, 0 to 1.

        Raises
        ------
        ValueError
            NaN, Inf or a value whose square overflows; no reference although the gain must be estimated.
        """
        self.preview(disturbance, filtered_reference, reference)
        return self.accept()

    def _opened(self) -> _Room:
        """Return the room for a preview; that of a copy is made when it is first used."""
        if self._room is None:
            self._room = _Room(self._state)
        return self._room

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for a copy or a file, whose arrays are elsewhere."""
        return self.__dict__ | {"_room": None}

    def live_in(self, powers: np.ndarray, window: np.ndarray, numbers: np.ndarray) -> None:
        """Go on in a block's arrays `powers`, `window` and `numbers`, which get the present numbers."""
        state = self._state
        places = state._replace(
            powers=powers.view(POWER).reshape(3), window=window, numbers=numbers.view(NUMBERS).reshape(1)
        )
        for own, place in zip(state, places, strict=True):
            place[...] = own
        self._state, self._room = places, None

    def _read(self, name: str) -> float:
        supplied = self._state.numbers[f"supplied_{name}"][0]
        return float(self._state.numbers[name][0] if math.isnan(supplied) else supplied)

    def _supply(self, name: str, value: float | None) -> None:
        self._state.numbers[f"supplied_{name}"] = math.nan if value is None else value


def squared(value: ArrayLike, name: str) -> float:
    """Return the square of a number; it must be finite: an infinite power would never be forgotten."""
    number = as_number(value, name)
    square = number * number
    if math.isinf(square):
        raise ValueError(f"{name} must have a finite square, got {number:g}")
    return square


# One for all loudspeakers, or one for each.
Constraints: TypeAlias = OutputPowerConstraint | Sequence[OutputPowerConstraint] | None
