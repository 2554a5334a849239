"""One constraint factor for several loudspeakers: the smallest of their factors."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._types import PerLoudspeaker
from .._validate import as_nonnegative, as_positive, as_signal, per_loudspeaker
from .constraint import OutputPowerConstraint


def _of_each(name: str, check: Callable[[Any, str], float], description: str) -> Any:
    """Return a property: an array of a value of each constraint; one number can be assigned for all."""

    def get(own: SharedConstraint) -> np.ndarray:
        return np.array([getattr(one, name) for one in own], dtype=np.float64)

    return property(get, lambda own, value: own._assign(name, value, check), doc=description)


class SharedConstraint(tuple[OutputPowerConstraint, ...]):
    r"""Constraints of J loudspeakers; the smallest of their factors scales the measurements of all microphones.

    .. math:: \alpha = \min_j \min\{\sqrt{\rho_j G_j / \delta_d^2},\ 1\}

    The disturbance power is summed over microphones. The gain :math:`G_j` is the power of loudspeaker j's filtered
    references, summed over microphones and references, divided by the power of the references: each loudspeaker is
    treated as if it were alone. A loudspeaker that no microphone hears has a gain of zero and is left out: its control
    filters stay zero. With one loudspeaker, microphone and reference this is eq. 13. The extension is this package's,
    not the paper's. All properties except `factor` have one value for each loudspeaker, (J,).
    """

    rated_power = _of_each("rated_power", as_positive, "Rated powers, (J,); can be assigned.")
    disturbance_power = _of_each(
        "disturbance_power", as_nonnegative, "Disturbance powers last used, (J,); can be assigned."
    )
    secondary_path_gain = _of_each(
        "secondary_path_gain", as_positive, "Power gains last used, (J,), NaN if unknown; can be assigned."
    )

    @property
    def factor(self) -> float:
        """Smallest factor; assign a value to fix it, or None to compute it again."""
        return _least([(one.factor, one.secondary_path_gain) for one in self])

    @factor.setter
    def factor(self, value: float | None) -> None:
        self._assign("factor", value, as_nonnegative)

    def fresh(self, rated_power: PerLoudspeaker) -> SharedConstraint:
        """Return constraints with the same settings, without samples, for other rated powers."""
        powers = per_loudspeaker(rated_power, len(self), "rated_power")
        return SharedConstraint(one.fresh(power) for one, power in zip(self, powers, strict=True))

    def preview(
        self, disturbance: ArrayLike, filtered_reference: ArrayLike, reference: ArrayLike | None = None
    ) -> float:
        """Return the factor with this sample; the powers change only if `accept` follows.

        `disturbance`, `filtered_reference` and `reference` are those of `advance`.
        """
        d, filtered, x = self._sums(disturbance, filtered_reference, reference)
        factors = [one.preview_sums(d, xf, x) for one, xf in zip(self, filtered, strict=True)]
        return _least([(factor, one.previewed_gain) for factor, one in zip(factors, self, strict=True)])

    def accept(self) -> None:
        """Add the sample of the last `preview` to the powers."""
        for one in self:
            one.accept()

    def advance(
        self, disturbance: ArrayLike, filtered_reference: ArrayLike, reference: ArrayLike | None = None
    ) -> float:
        """Add one sample to the powers and return the factor.

        Parameters
        ----------
        disturbance : array_like, shape (K,)
            Disturbances.
        filtered_reference : array_like, shape (J, K, I)
            Newest filtered references.
        reference : array_like, shape (I,), optional
            Newest references; can be omitted if every gain or factor was assigned.

        Returns
        -------
        float
            Factor, 0 to 1.

        Raises
        ------
        ValueError
            NaN, Inf or values whose squares overflow; no reference, although a gain must be estimated. Nothing was
            changed.
        """
        factor = self.preview(disturbance, filtered_reference, reference)
        self.accept()
        return factor

    def _sums(self, disturbance: Any, filtered: Any, reference: Any) -> tuple[float, list[float], float | None]:
        """Return the sums of squares of the disturbances, each loudspeaker's filtered references and the references."""
        return (
            _sum_of_squares(disturbance, "the measurement"),
            [_sum_of_squares(one, "the newest filtered reference") for one in filtered],
            None if reference is None else _sum_of_squares(reference, "reference"),
        )

    def _assign(self, name: str, value: Any, check: Callable[[Any, str], float]) -> None:
        values = [None] * len(self) if value is None else per_loudspeaker(value, len(self), name, check)
        for one, own in zip(self, values, strict=True):
            setattr(one, name, own)


def _least(factors: list[tuple[float, float | None]]) -> float:
    """Return the smallest factor among those with a gain other than zero; if all gains are zero, among all."""
    return float(min([factor for factor, gain in factors if gain != 0.0] or [factor for factor, _ in factors]))


def _sum_of_squares(values: Any, name: str) -> float:
    """Return the sum of the squares of several channels' samples; it must be finite."""
    each = as_signal(np.ravel(values), name)
    with np.errstate(over="ignore"):
        square = float(each @ each)
    if math.isinf(square):
        raise ValueError(f"{name} must have a finite square, summed over channels, got {each}")
    return square
