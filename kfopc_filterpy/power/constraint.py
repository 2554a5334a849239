"""Eq. 10-13: from the rated power and running power estimates to the constraint factor."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_choice, as_nonnegative, as_number, as_positive
from ..kernels.compiling import part

DEFAULT_FS = 16000.0
DEFAULT_MEMORY_S = 0.5

# Below the smallest normal number a ratio of powers has no digits left: such a reference counts as silent.
SILENCE = float(np.finfo(np.float64).tiny)

# Rows of the state's table, and what their three columns are.
MEAN, LAP, TAKEN, SUPPLIED, LAST, SETTINGS = range(6)
# of MEAN, LAP, TAKEN; numpy's integers, since numba compiles a function anew for each plain one it is called with
DISTURBANCE, FILTERED_REFERENCE, REFERENCE = np.arange(3)
FACTOR, POWER, GAIN = range(3)  # of SUPPLIED, LAST
RATED_POWER, FORGETTING = range(2)  # of SETTINGS


class ConstraintState(NamedTuple):
    """What the compiled functions below read and advance.

    Few arrays, since each is an argument more to compile in every function. The table's rows: MEAN, mean squares
    of disturbance, filtered reference and reference; LAP, their sums of squares since the sliding window last wrapped;
    TAKEN, samples taken; SUPPLIED, factor, disturbance power and gain set by the caller, NaN where estimated; LAST, the
    same as last used; SETTINGS, rated power and 1 - forgetting factor.
    """

    table: np.ndarray  # (6, 3)
    window: np.ndarray  # (3, m) this lap's squares, then the last lap's sums from there on; m = 0: exponential


@part(forceinline=True)
def forgetting_mean(mean, n, rate, square):
    """Mean square with one more sample after n, of exponential memory and unbiased from the first sample on."""
    return mean + max(rate, 1.0 / (n + 1)) * (square - mean)


@part(forceinline=True)
def power_gain(supplied, last, filtered_power, reference_power):
    """Eq. 11, or the gain supplied, or the last one while the reference is silent."""
    if not np.isnan(supplied):
        return supplied
    if reference_power > SILENCE:
        return filtered_power / reference_power
    return last


@part(forceinline=True)
def constraint_factor(supplied, rated_power, disturbance_power, gain):
    """Eq. 13; 1 where there is nothing to constrain (no disturbance, or no gain known yet)."""
    if not np.isnan(supplied):
        return supplied
    if disturbance_power <= SILENCE or np.isnan(gain):
        return 1.0
    return min(math.sqrt(rated_power * gain / disturbance_power), 1.0)


@part(forceinline=True)
def _next_mean(state, row, square):
    """Mean square with one more sample."""
    n, m, mean = state.table[TAKEN, row], state.window.shape[1], state.table[MEAN, row]
    if m == 0:
        return forgetting_mean(mean, n, state.table[SETTINGS, FORGETTING], square)
    position = np.int64(n) % m
    rest = state.window[row, position + 1] if position + 1 < m else 0.0
    total = state.table[LAP, row] + square + rest  # sums only, so that rounding never accumulates
    return total / min(n + 1.0, float(m))


@part(forceinline=True)
def preview_constraint(state, disturbance, filtered_reference, reference):
    """Constraint factor with this sample included; nothing is changed.

    Returns the factor, the disturbance power and the gain it follows from, and the three mean squares. A NaN
    `reference` (none given) leaves the powers of the reference and the filtered reference as they are.
    """
    mean_d = _next_mean(state, DISTURBANCE, disturbance * disturbance)
    mean_xf, mean_x = state.table[MEAN, FILTERED_REFERENCE], state.table[MEAN, REFERENCE]
    if not np.isnan(reference):
        mean_xf = _next_mean(state, FILTERED_REFERENCE, filtered_reference * filtered_reference)
        mean_x = _next_mean(state, REFERENCE, reference * reference)
    table = state.table
    gain = power_gain(table[SUPPLIED, GAIN], table[LAST, GAIN], mean_xf, mean_x)
    power = mean_d if np.isnan(table[SUPPLIED, POWER]) else table[SUPPLIED, POWER]
    factor = constraint_factor(table[SUPPLIED, FACTOR], table[SETTINGS, RATED_POWER], power, gain)
    return factor, power, gain, mean_d, mean_xf, mean_x


@part(forceinline=True)
def commit_constraint(state, previewed, disturbance, filtered_reference, reference):
    """Take the sample that `previewed` was made of into the running powers."""
    factor, power, gain, mean_d, mean_xf, mean_x = previewed
    _take(state, DISTURBANCE, disturbance, mean_d)
    if not np.isnan(reference):
        _take(state, FILTERED_REFERENCE, filtered_reference, mean_xf)
        _take(state, REFERENCE, reference, mean_x)
    table = state.table
    table[LAST, FACTOR], table[LAST, POWER], table[LAST, GAIN] = factor, power, gain


@part(forceinline=True)
def advance_constraint(state, disturbance, filtered_reference, reference):
    """Take this sample into the running powers and return the constraint factor."""
    previewed = preview_constraint(state, disturbance, filtered_reference, reference)
    commit_constraint(state, previewed, disturbance, filtered_reference, reference)
    return previewed[0]


@part(forceinline=True)
def _take(state, row, value, mean):
    """Record one sample of one running power, whose new mean square is `mean`."""
    state.table[MEAN, row] = mean
    m = state.window.shape[1]
    if m > 0:
        position = np.int64(state.table[TAKEN, row]) % m
        state.table[LAP, row] += value * value
        state.window[row, position] = value * value
        if position == m - 1:
            state.table[LAP, row] = 0.0
            for i in range(m - 2, -1, -1):
                state.window[row, i] += state.window[row, i + 1]
    state.table[TAKEN, row] += 1


class OutputPowerConstraint:
    r"""Constraint factor of KF-OPC, kept sample by sample (eq. 10-13).

    .. math:: \alpha = \min\{\sqrt{\rho_o G_s / \delta_d^2},\ 1\}

    Parameters
    ----------
    rated_power : float
        Rated output power :math:`\rho_o` of the amplifier, the mean square of the control signal.
    secondary_path_gain : float, optional
        Power gain :math:`G_s`; by default estimated as E[x'^2]/E[x^2] (eq. 11).
    fs : float, default 16000
        Sample rate in Hz.
    memory : float, default 0.5
        Memory of the power estimates in seconds: the time constant of the exponential window, or the length
        of the sliding one.
    window : {"exponential", "sliding"}, default "exponential"
        The estimates start bias-free: until the window is full they are plain means.

    Raises
    ------
    ValueError
        A power, gain, rate or memory that is not positive and finite, or another window.

    Examples
    --------
    >>> from kfopc_filterpy import OutputPowerConstraint
    >>> constraint = OutputPowerConstraint(rated_power=1.0, secondary_path_gain=1.0)
    >>> constraint.advance(2.0)  # a disturbance of power 4, a rated power of 1
    0.5
    >>> constraint.disturbance_power
    4.0
    """

    def __init__(
        self,
        rated_power: float,
        *,
        secondary_path_gain: float | None = None,
        fs: float = DEFAULT_FS,
        memory: float = DEFAULT_MEMORY_S,
        window: str = "exponential",
    ) -> None:
        rated_power = as_positive(rated_power, "rated_power")
        self.fs = as_positive(fs, "fs", unit="Hz")
        self.memory = as_positive(memory, "memory", unit="s")
        self.window = as_choice(window, "window", ("exponential", "sliding"))
        samples = self.memory * self.fs
        length = max(round(samples), 1) if window == "sliding" else 0
        table = np.zeros((6, 3))
        table[SUPPLIED] = np.nan
        table[LAST] = 1.0, 0.0, np.nan
        table[SETTINGS, :2] = rated_power, -math.expm1(-1.0 / samples)
        self._state = ConstraintState(table, np.zeros((3, length)))
        self.secondary_path_gain = secondary_path_gain

    @property
    def state(self) -> ConstraintState:
        """Arrays that the compiled loop advances."""
        return self._state

    @property
    def rated_power(self) -> float:
        """Rated output power; can be assigned."""
        return float(self._state.table[SETTINGS, RATED_POWER])

    @rated_power.setter
    def rated_power(self, value: float) -> None:
        self._state.table[SETTINGS, RATED_POWER] = as_positive(value, "rated_power")

    @property
    def factor(self) -> float:
        """Constraint factor last used; assign a value to hold it there, None to estimate it again."""
        return self._read(FACTOR)

    @factor.setter
    def factor(self, value: float | None) -> None:
        self._supply(FACTOR, None if value is None else as_nonnegative(value, "constraint_factor"))

    @property
    def disturbance_power(self) -> float:
        """Disturbance power last used (eq. 10); assign a value to supply it, None to estimate it again."""
        return self._read(POWER)

    @disturbance_power.setter
    def disturbance_power(self, value: float | None) -> None:
        self._supply(POWER, None if value is None else as_nonnegative(value, "disturbance_power"))

    @property
    def secondary_path_gain(self) -> float | None:
        """Power gain last used (eq. 11), None before any; assign to supply it, None to estimate it again."""
        gain = self._read(GAIN)
        return None if math.isnan(gain) else gain

    @secondary_path_gain.setter
    def secondary_path_gain(self, value: float | None) -> None:
        self._supply(GAIN, None if value is None else as_positive(value, "secondary_path_gain"))

    @property
    def needs_reference(self) -> bool:
        """Whether the gain has to come from the reference: neither it nor the factor was supplied."""
        return bool(np.isnan(self._state.table[SUPPLIED, GAIN]) and np.isnan(self._state.table[SUPPLIED, FACTOR]))

    def preview(self, disturbance: float, filtered_reference: float = 0.0, reference: float | None = None) -> float:
        """Constraint factor that `advance` would return for this sample; nothing is changed."""
        return float(preview_constraint(self._state, *self._sample(disturbance, filtered_reference, reference))[0])

    def advance(self, disturbance: float, filtered_reference: float = 0.0, reference: float | None = None) -> float:
        """Take one sample into the powers and return the constraint factor.

        Parameters
        ----------
        disturbance : float
            Disturbance (measurement) d(n).
        filtered_reference : float, default 0
            Newest filtered reference x'(n).
        reference : float, optional
            Newest reference x(n); without it the gain must have been supplied.

        Returns
        -------
        float
            Constraint factor, 0 to 1.

        Raises
        ------
        ValueError
            NaN, Inf or a value whose square overflows; no reference and no gain.
        """
        return float(advance_constraint(self._state, *self._sample(disturbance, filtered_reference, reference)))

    def _sample(self, disturbance: Any, filtered: Any, reference: Any) -> tuple[float, float, float]:
        if reference is None and self.needs_reference:
            raise ValueError(
                "the secondary-path gain is unknown: pass reference=, the newest reference sample x(n), "
                "or set secondary_path_gain"
            )
        values = (
            _squarable(disturbance, "the measurement"),
            _squarable(filtered, "the newest filtered reference"),
            math.nan if reference is None else _squarable(reference, "reference"),
        )
        return values

    def _read(self, row: int) -> float:
        supplied = self._state.table[SUPPLIED, row]
        return float(self._state.table[LAST, row] if math.isnan(supplied) else supplied)

    def _supply(self, row: int, value: float | None) -> None:
        self._state.table[SUPPLIED, row] = math.nan if value is None else value


def _squarable(value: Any, name: str) -> float:
    """A finite number whose square is finite too: an infinite power would never be forgotten."""
    number = as_number(value, name)
    if math.isinf(number * number):
        raise ValueError(f"{name} must have a finite square, got {number:g}")
    return number
