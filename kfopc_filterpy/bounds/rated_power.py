"""Rated power needed for a noise reduction if the power is spent in the best way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_finite_array, per_loudspeaker
from ..plant import Plant, as_constant_plant, checked_signals, has_one_channel
from .channel_bound import ChannelCorrelations
from .wiener import record_of, reduction_db

ROUNDING_DB = 1e-9  # tolerance above the largest attainable noise reduction: its last digit may have been rounded up


@dataclass(frozen=True)
class RequiredRatedPower:
    """Rated power needed for given noise reductions if it is spent in the best way; see `required_rated_power`.

    Attributes
    ----------
    noise_reduction_db : numpy.ndarray
        Noise reductions wanted, in dB.
    rated_power : numpy.ndarray
        Rated power (mean square) of each loudspeaker, of the shape of `noise_reduction_db` with an axis (J,) added;
        infinite if the noise reduction is out of reach. For one channel without that axis.
    control_power : numpy.ndarray
        Power that each loudspeaker uses, of the same shape; NaN if out of reach.
    penalty : numpy.ndarray
        Weight of each loudspeaker's power in the cost, of the same shape: 0 if the rated power is not a limit to it,
        NaN if out of reach. More power would help most at the loudspeaker with the largest weight.
    """

    noise_reduction_db: np.ndarray
    rated_power: np.ndarray
    control_power: np.ndarray
    penalty: np.ndarray


def required_rated_power(
    noise_reduction_db: ArrayLike,
    reference: ArrayLike,
    plant: Plant,
    *,
    n_taps: int,
    disturbance: ArrayLike | None = None,
    proportions: ArrayLike | None = None,
) -> RequiredRatedPower:
    """Return the rated power needed for a noise reduction if the power is spent in the best way.

    All loudspeakers have the same rated power, or rated powers in given proportions. The result is the smallest rated
    power with which `power_constrained_wiener` reaches the noise reduction over the record. KF-PB comes close to this
    bound. KF-OPC scales its control filter as a whole, and needs more.

    Parameters
    ----------
    noise_reduction_db : float or array_like
        Noise reductions wanted in dB, zero or above, over all microphones.
    reference : array_like, shape (n_samples,) or (I, n_samples)
        Reference signal x.
    plant : Plant
        Plant, of which the paths count: the bound has linear amplifiers and no sensor noise.
    n_taps : int
        Taps of each control filter.
    disturbance : array_like, shape (n_samples,) or (K, n_samples), optional
        Disturbance d at the error microphones, in place of the plant's primary path.
    proportions : array_like, shape (J,), optional
        Proportions of the rated powers, such as ``[1, 1, 4]`` for a third loudspeaker with four times the power of the
        others; by default all are equal.

    Returns
    -------
    RequiredRatedPower
        The rated powers, the powers that are used, and the weights that show which rated power limits most.

    Raises
    ------
    TypeError, ValueError
        If a noise reduction is negative, if signals do not fit the paths, are silent or not finite, or
        if another argument is out of range.

    Notes
    -----
    The noise reduction grows with the rated powers. Brent's method finds the logarithm of their common scale; the
    correlations are computed once. Each step solves for J I n_taps unknowns a few times.

    Examples
    --------
    Two loudspeakers of the same rated power, and two microphones:

    >>> from kfopc_filterpy import Plant, power_constrained_wiener
    >>> from kfopc_filterpy.bounds import required_rated_power
    >>> x = np.random.default_rng(0).standard_normal(4000)
    >>> paths = [[[0, 1.0, 0.6], [0, 0.3, 0.3]], [[0, 0.4, 0.1], [0, 1.0, -0.5]]]
    >>> plant = Plant(paths, [[0, 0, 1.0, 0.5], [0, 0, 0.8, -0.2]], fs=8000)
    >>> needed = required_rated_power([3.0, 10.0], x, plant, n_taps=8)
    >>> needed.rated_power.round(3)
    array([[0.033, 0.033],
           [0.194, 0.194]])
    >>> bound = power_constrained_wiener(x, plant, n_taps=8, rated_power=needed.rated_power[1])
    >>> print(f"{bound.whole.noise_reduction_db:.2f} dB, scaled {bound.scaled.noise_reduction_db:.2f} dB")
    10.00 dB, scaled 5.99 dB
    """
    wanted = as_finite_array(noise_reduction_db, "noise_reduction_db")
    if np.any(wanted < 0):
        raise ValueError(f"noise_reduction_db must not be negative, got {wanted.min():g} dB")
    as_constant_plant(plant, "required_rated_power")
    x, d = checked_signals(plant, reference, disturbance)
    record = record_of(x, d, plant.secondary, n_taps).with_sound()
    shares = per_loudspeaker(1.0 if proportions is None else proportions, plant.n_loudspeakers, "proportions")
    search = _ScaleSearch(record.correlations(), shares, float(np.sum(np.mean(record.d**2, axis=-1))))
    found = np.array([search.powers(one) for one in wanted.ravel()])  # (n, 3, J)
    each = np.moveaxis(found, 1, 0).reshape(3, *wanted.shape, -1)
    return RequiredRatedPower(wanted, *(each[..., 0] if has_one_channel(plant, x) else each))


class _ScaleSearch:
    """Search for the scale of the rated powers that a noise reduction needs."""

    def __init__(self, correlations: ChannelCorrelations, shares: np.ndarray, disturbance_power: float) -> None:
        self.correlations, self.shares, self.disturbance_power = correlations, shares, disturbance_power
        free = correlations.weights()
        self.most = 1.001 * float(np.max(correlations.powers(free) / shares))  # a scale at which no rating binds
        self.most_db = self._reduction_db(free)
        self._penalty: np.ndarray | None = None

    def _reduction_db(self, weights: np.ndarray) -> float:
        left = self.disturbance_power - self.correlations.antinoise(weights)
        return reduction_db(left, self.disturbance_power)

    def _at(self, log_scale: float) -> tuple[np.ndarray, np.ndarray]:
        """Return weights and penalties for a scale; the search starts from the last penalties."""
        weights, penalty = self.correlations.constrained_weights(np.exp(log_scale) * self.shares, self._penalty)
        if np.any(penalty):
            self._penalty = penalty
        return weights, penalty

    def powers(self, wanted_db: float) -> np.ndarray:
        """Return rated powers, powers used and penalties, (3, J)."""
        from scipy.optimize import brentq

        if wanted_db > self.most_db + ROUNDING_DB:
            return np.array([np.full(self.shares.size, value) for value in (np.inf, np.nan, np.nan)])
        if wanted_db == 0.0:
            return np.zeros((3, self.shares.size))
        reached_db = min(wanted_db, self.most_db)

        def missing(log_scale: float) -> float:
            return reached_db - self._reduction_db(self._at(log_scale)[0])

        high = np.log(self.most)
        low = high - 1.0
        while missing(low) < 0.0:
            low -= 3.0
        scale = brentq(missing, low, high, xtol=1e-7)
        weights, penalty = self._at(scale)
        return np.array([np.exp(scale) * self.shares, self.correlations.powers(weights), penalty])
