"""Eq. 10-13: from the rated power and running power estimates to the constraint factor."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_choice, as_nonnegative, as_number, as_positive
from ..kernels.compiling import compiled, inlined, part
from ..kernels.records import as_records, new_record

DEFAULT_FS = 16000.0
DEFAULT_MEMORY_S = 0.5

# Below the smallest normal number a ratio of powers has no digits left: such a reference counts as silent.
SILENCE = float(np.finfo(np.float64).tiny)

# Indices of the running powers; numpy integers, because numba would compile a function again for each Python int.
DISTURBANCE, FILTERED_REFERENCE, REFERENCE = np.arange(3)
POWER = np.dtype([("mean_square", np.float64), ("lap", np.float64), ("taken", np.float64)], align=True)


class ConstraintState(NamedTuple):
    """State that the compiled functions below read and update."""

    powers: (
        np.ndarray
    )  # (3,) of POWER: mean square, sum of squares since the sliding window last wrapped, samples taken
    window: np.ndarray  # (3, m) this lap's squares, then the last lap's sums from each index on; m = 0: exponential
    numbers: np.ndarray  # record: settings; values that the caller supplied (NaN: estimated); values last used


@part()
def forgetting_mean(mean, taken, rate, square):
    """Return an exponentially weighted mean square with one more sample, unbiased from the first sample on."""
    return mean + max(rate, 1.0 / (taken + 1)) * (square - mean)


@part()
def power_gain(supplied, last, filtered_power, reference_power):
    """Return the supplied gain, else that of eq. 11, or the last gain while the reference is silent."""
    if not np.isnan(supplied):
        return supplied
    if reference_power > SILENCE:
        return filtered_power / reference_power
    return last


@part()
def constraint_factor(supplied, rated_power, disturbance_power, gain):
    """Return the factor of eq. 13; 1 if there is nothing to constrain (no disturbance, or no gain known yet)."""
    if not np.isnan(supplied):
        return supplied
    if disturbance_power <= SILENCE or np.isnan(gain):
        return 1.0
    return min(math.sqrt(rated_power * gain / disturbance_power), 1.0)


@inlined
def _next_mean(state, signal, square):
    """Return the mean square of a signal with one more sample."""
    power, m = state.powers[signal], state.window.shape[1]
    if m == 0:
        return forgetting_mean(power.mean_square, power.taken, state.numbers[0].rate, square)
    position = np.int64(power.taken) % m
    rest = state.window[signal, position + 1] if position + 1 < m else 0.0
    total = power.lap + square + rest  # sums only, so that rounding never accumulates
    return total / min(power.taken + 1.0, float(m))


@inlined
def preview_constraint(state, disturbance, filtered_reference, reference):
    """Return the constraint factor with this sample included; nothing is changed.

    Also return the disturbance power and the gain that it was computed from, and the three mean squares. If `reference`
    is NaN (none given), the powers of the reference and the filtered reference stay as they are.
    """
    return preview_squares(
        state, disturbance * disturbance, filtered_reference * filtered_reference, reference * reference
    )


@inlined
def preview_squares(state, disturbance, filtered_reference, reference):
    """Return what `preview_constraint` does, for squares, which can be sums over channels."""
    numbers = state.numbers[0]
    mean_d = _next_mean(state, DISTURBANCE, disturbance)
    mean_xf, mean_x = state.powers[FILTERED_REFERENCE].mean_square, state.powers[REFERENCE].mean_square
    if not np.isnan(reference):
        mean_xf = _next_mean(state, FILTERED_REFERENCE, filtered_reference)
        mean_x = _next_mean(state, REFERENCE, reference)
    gain = power_gain(numbers.supplied_gain, numbers.gain, mean_xf, mean_x)
    power = mean_d if np.isnan(numbers.supplied_power) else numbers.supplied_power
    factor = constraint_factor(numbers.supplied_factor, numbers.rated_power, power, gain)
    return factor, power, gain, mean_d, mean_xf, mean_x


@inlined
def commit_constraint(state, previewed, disturbance, filtered_reference, reference):
    """Add the sample to the running powers; `previewed` is what `preview_constraint` returned for it."""
    commit_squares(
        state, previewed, disturbance * disturbance, filtered_reference * filtered_reference, reference * reference
    )


@inlined
def commit_squares(state, previewed, disturbance, filtered_reference, reference):
    """Add squares to the running powers; `previewed` is what `preview_squares` returned for them."""
    factor, power, gain, mean_d, mean_xf, mean_x = previewed
    _take(state, DISTURBANCE, disturbance, mean_d)
    if not np.isnan(reference):
        _take(state, FILTERED_REFERENCE, filtered_reference, mean_xf)
        _take(state, REFERENCE, reference, mean_x)
    numbers = state.numbers[0]
    numbers.factor, numbers.power, numbers.gain = factor, power, gain


@inlined
def advance_constraint(state, disturbance, filtered_reference, reference):
    """Add this sample to the running powers and return the constraint factor."""
    return advance_squares(
        state, disturbance * disturbance, filtered_reference * filtered_reference, reference * reference
    )


@inlined
def advance_squares(state, disturbance, filtered_reference, reference):
    """Add squares, which can be sums over channels, to the running powers and return the constraint factor."""
    previewed = preview_squares(state, disturbance, filtered_reference, reference)
    commit_squares(state, previewed, disturbance, filtered_reference, reference)
    return previewed[0]


@part()
def squares_are_finite(d, filtered, x):
    """Return whether the squares of this sample are finite: an infinite power would never be forgotten."""
    return np.isfinite(d * d) and np.isfinite(filtered * filtered) and np.isfinite(x * x)


@inlined
def _take(state, signal, square, mean):
    """Add one square to one running power, whose new mean square is `mean`."""
    power, m = state.powers[signal], state.window.shape[1]
    power.mean_square = mean
    if m > 0:
        position = np.int64(power.taken) % m
        power.lap += square
        state.window[signal, position] = square
        if position == m - 1:
            power.lap = 0.0
            for i in range(m - 2, -1, -1):
                state.window[signal, i] += state.window[signal, i + 1]
    power.taken += 1.0


@compiled()
def preview_sample(state, disturbance, filtered_reference, reference):
    """Return the factor and the gain of `preview_squares`; called from Python."""
    factor, _, gain, _, _, _ = preview_squares(state, disturbance, filtered_reference, reference)
    return factor, gain


@compiled()
def advance_sample(state, disturbance, filtered_reference, reference):
    """Call `advance_squares` from Python."""
    return advance_squares(state, disturbance, filtered_reference, reference)


class OutputPowerConstraint:
    r"""Constraint factor of KF-OPC, updated sample by sample (eq. 10-13).

    .. math:: \alpha = \min\{\sqrt{\rho_o G_s / \delta_d^2},\ 1\}

    Parameters
    ----------
    rated_power : float
        Rated output power :math:`\rho_o` of the amplifier, the mean square of the control signal.
    secondary_path_gain : float, optional
        Power gain :math:`G_s`; by default estimated as E[x'^2]/E[x^2] (eq. 11).
    fs : float, default 16000
        Sample rate in Hz.
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
        memory_s: float = DEFAULT_MEMORY_S,
        window: str = "exponential",
    ) -> None:
        rated_power = as_positive(rated_power, "rated_power")
        self.fs = as_positive(fs, "fs", unit="Hz")
        self.memory_s = as_positive(memory_s, "memory_s", unit="s")
        self.window = as_choice(window, "window", ("exponential", "sliding"))
        samples = self.memory_s * self.fs
        length = max(round(samples), 1) if window == "sliding" else 0
        numbers = new_record(
            rated_power=rated_power,
            rate=-math.expm1(-1.0 / samples),
            supplied_factor=math.nan,
            supplied_power=math.nan,
            supplied_gain=math.nan,
            factor=1.0,
            power=0.0,
            gain=math.nan,
        )
        self._state = ConstraintState(as_records(np.zeros(3, POWER)), np.zeros((3, length)), numbers)
        self._given_gain = secondary_path_gain
        self.secondary_path_gain = secondary_path_gain

    def fresh(self, rated_power: float | None = None) -> OutputPowerConstraint:
        """Return a constraint with the same settings and no samples yet; `rated_power` replaces the rated power."""
        return OutputPowerConstraint(
            self.rated_power if rated_power is None else rated_power,
            secondary_path_gain=self._given_gain,
            fs=self.fs,
            memory_s=self.memory_s,
            window=self.window,
        )

    @property
    def state(self) -> ConstraintState:
        """Arrays that the compiled loop updates."""
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
        """Constraint factor last used; assign a value to fix it, None to compute it again."""
        return self._read("factor")

    @factor.setter
    def factor(self, value: float | None) -> None:
        self._supply("factor", None if value is None else as_nonnegative(value, "constraint_factor"))

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

    @property
    def needs_reference(self) -> bool:
        """True if the gain must be estimated from the reference: neither the gain nor the factor was supplied."""
        numbers = self._state.numbers
        return math.isnan(numbers["supplied_gain"][0]) and math.isnan(numbers["supplied_factor"][0])

    def preview(self, disturbance: float, filtered_reference: float = 0.0, reference: float | None = None) -> float:
        """Return the constraint factor that `advance` would return for this sample; nothing is changed."""
        return self.preview_sums(*self._squares(disturbance, filtered_reference, reference))[0]

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
        return self.advance_sums(*self._squares(disturbance, filtered_reference, reference))

    def preview_sums(self, d_squared: float, xf_squared: float, x_squared: float | None) -> tuple[float, float]:
        """Return the factor and the gain (NaN: unknown) for the squares of a sample.

        `d_squared`, `xf_squared` and `x_squared` are those of `advance`'s arguments, or their sums over channels.
        """
        factor, gain = preview_sample(self._state, d_squared, xf_squared, self._known(x_squared))
        return float(factor), float(gain)

    def advance_sums(self, d_squared: float, xf_squared: float, x_squared: float | None) -> float:
        """Add the squares of a sample, `d_squared`, `xf_squared` and `x_squared`, to the powers; return the factor."""
        return float(advance_sample(self._state, d_squared, xf_squared, self._known(x_squared)))

    def _known(self, x_squared: float | None) -> float:
        """Return the square of the reference, NaN if none is given and none is needed."""
        if x_squared is None and self.needs_reference:
            raise ValueError(
                "the secondary-path gain is unknown: pass reference=, the newest reference sample x(n), "
                "or set secondary_path_gain"
            )
        return math.nan if x_squared is None else x_squared

    @staticmethod
    def _squares(disturbance: Any, filtered: Any, reference: Any) -> tuple[float, float, float | None]:
        return (
            squared(disturbance, "the measurement"),
            squared(filtered, "the newest filtered reference"),
            None if reference is None else squared(reference, "reference"),
        )

    def _read(self, name: str) -> float:
        supplied = self._state.numbers[f"supplied_{name}"][0]
        return float(self._state.numbers[name][0] if math.isnan(supplied) else supplied)

    def _supply(self, name: str, value: float | None) -> None:
        self._state.numbers[f"supplied_{name}"] = math.nan if value is None else value


def squared(value: Any, name: str) -> float:
    """Return the square of a number; it must be finite: an infinite power would never be forgotten."""
    number = as_number(value, name)
    square = number * number
    if math.isinf(square):
        raise ValueError(f"{name} must have a finite square, got {number:g}")
    return square
