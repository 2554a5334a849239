"""Frequency-domain FxLMS whose control signal keeps a power limit in each of several frequency bands."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import rfft

from .._types import NumberOrArray, PathModels
from .._validate import as_positive, as_rate, as_real_array, per_loudspeaker
from .base import require_rates
from .block import TINY
from .frequency_domain import FrequencyDomainFxLMS

PRICE_RATE = 1 / 16  # of the step size: the prices settle without ringing, also with the averaged powers
MOST_EXCESS = 3.0  # relative to the limit, in a step of the prices


class BandLimitedFxLMS(FrequencyDomainFxLMS):
    r"""Frequency-domain FxLMS within a power limit for each frequency band of the control signal.

    A band whose limit is exceeded gets a price :math:`\lambda_b`, the weight of a penalty on its power (a Lagrange
    multiplier). The other bands adapt as without limits. With the spectrum Y of the block's control signal, the powers
    :math:`p_b` in the bands, their limits :math:`\rho_b` and the gain :math:`G_b = E|X'|^2 / E|X|^2` in a band,

    .. math::

       W \leftarrow W + \mu\, C\big\{M\, C\{M^* (X'^* E - \lambda X^* Y)\}\big\},

       |M|^{-2} = \sum_p |X'_p|^2 + \lambda |X_p|^2

    .. math:: \lambda_b \leftarrow \max\Big\{\lambda_b + \frac{\mu}{16}\, G_b \Big(\frac{p_b}{\rho_b} - 1\Big),\ 0\Big\}

    The algorithm settles where :math:`E[e^2] + \sum_b \lambda_b (p_b - \rho_b)` is stationary, so each band keeps its limit with
    the least error. With one band, from 0 to fs/2, this is the power-constrained Wiener solution.

    Parameters
    ----------
    n_taps, secondary_path, step_size, block_size, partition_size, n_references
        As for `FrequencyDomainFxLMS`.
    band_edges : array_like, shape (n_bands + 1,)
        Edges of adjacent bands in Hz, rising, within 0 to fs/2. A band must be at least as wide as the spacing of the
        bins, ``fs / (N + B)``. Bins outside all bands have no limit.
    band_powers : array_like, shape (n_bands,) or (J, n_bands)
        Power limit (mean square) of the control signal in each band, above zero; (J, n_bands) gives each loudspeaker
        its own.
    fs : float, default 16000
        Sample rate in Hz.
    forgetting : float, default 0.9
        Forgetting factor, per block, of all powers.

    Attributes
    ----------
    band_prices : numpy.ndarray, shape (n_bands,) or (J, n_bands)
        Prices lambda, in the unit of G; 0 where a limit is not reached. A copy.

    Raises
    ------
    ValueError
        As for `FrequencyDomainFxLMS`; edges that do not rise or leave the range; a band that is too narrow; limits that
        are not positive or have another shape.

    Notes
    -----
    The powers in the bands come from Hann windows of N + B samples, so an edge is about two bins wide. The limits hold
    for the mean power after the prices have settled, within some ``32 / step_size`` blocks.

    References
    ----------
    W. J. Kozacky, T. Ogunfunmi, "An active noise control algorithm with gain and power constraints on the adaptive
    filter", EURASIP Journal on Advances in Signal Processing 2013:17; B. Rafaely, S. J. Elliott, "A computationally
    efficient frequency-domain LMS algorithm with constraints on the adaptive filter", IEEE Trans. Signal Processing
    48(6), 2000. Only the abstract and the introduction of the first were available; it has penalty functions on the
    power in each bin of a frequency-domain LMS. With a penalty of fixed weight, the power exceeds its limit by an
    amount that depends on the weight; here the weight of each band is integrated until the limit is met.

    Examples
    --------
    The cancellation of this white noise takes a power of 0.5 in each half of the spectrum; the limit of the upper half
    is half of that:

    >>> import numpy as np
    >>> from kfopc_filterpy import BandLimitedFxLMS, simulate
    >>> x = np.random.default_rng(0).standard_normal(24000)
    >>> controller = BandLimitedFxLMS(
    ...     64, [0.0, 1.0], step_size=0.2, block_size=64, band_edges=[0, 4000, 8000], band_powers=[1.0, 0.25]
    ... )
    >>> result = simulate(controller, x, primary_path=[0.0, 0.0, 1.0], secondary_path=[0.0, 1.0])
    >>> y = np.fft.rfft(result.control_signal[8000:])
    >>> powers = 2 * np.sum(np.abs(y[:-1].reshape(2, -1)) ** 2, axis=1) / 16000**2
    >>> powers.round(2)  # the edge of a filter of 64 taps is not sharp
    array([0.47, 0.25])
    """

    name = "band-limited FxLMS"
    forgetting: float

    def __init__(
        self,
        n_taps: int,
        secondary_path: PathModels,
        *,
        step_size: float,
        block_size: int,
        band_edges: ArrayLike,
        band_powers: ArrayLike,
        fs: float = 16000.0,
        partition_size: int | None = None,
        forgetting: float = 0.9,
        n_references: int = 1,
    ) -> None:
        super().__init__(
            n_taps,
            secondary_path,
            step_size=step_size,
            block_size=block_size,
            partition_size=partition_size,
            forgetting=as_positive(forgetting, "forgetting"),
            n_references=n_references,
        )
        self.fs = as_rate(fs, "fs")
        self._bands = _bins_of_bands(band_edges, self.fs, self._size)
        self._limits = self._checked_limits(band_powers)
        self._prices = np.zeros((self.n_loudspeakers, len(self._bands)))
        self._output_powers = np.zeros_like(self._prices)
        self._reference_powers = np.zeros_like(self._powers)
        self._window_shape = np.hanning(self._size + 1)[:-1]

    def _checked_limits(self, powers: Any) -> np.ndarray:
        limits, shape = as_real_array(powers, "band_powers"), (self.n_loudspeakers, len(self._bands))
        if limits.shape not in (shape[1:], shape) or (limits.ndim == 2 and not self.multichannel):
            raise ValueError(
                f"band_powers must have a value for each of the {shape[1]} bands, ({shape[1]},)"
                f"{f' or {shape}' if self.multichannel else ''}, got shape {limits.shape}"
            )
        return np.reshape([as_positive(limit, "band_powers") for limit in np.broadcast_to(limits, shape).flat], shape)

    @property
    def band_powers(self) -> np.ndarray:
        """Power limits of the bands, (n_bands,) or (J, n_bands); a copy. New limits can be assigned at any time."""
        return self._of_bands(self._limits)

    @band_powers.setter
    def band_powers(self, powers: ArrayLike) -> None:
        self._limits = self._checked_limits(powers)

    @property
    def band_prices(self) -> np.ndarray:
        """Prices lambda of the bands, (n_bands,) or (J, n_bands); a copy."""
        return self._of_bands(self._prices)

    def _of_bands(self, values: np.ndarray) -> np.ndarray:
        return values.copy() if self.multichannel else values[0].copy()

    @property
    def rated_power(self) -> NumberOrArray:
        """Sum of the limits of all bands, with several channels (J,). Assigning another sum scales the limits."""
        total = self._limits.sum(axis=1)
        return total if self.multichannel else float(total[0])

    @rated_power.setter
    def rated_power(self, power: Any) -> None:
        wanted = per_loudspeaker(power, self.n_loudspeakers, "rated_power")
        self._limits = self._limits * (wanted / self._limits.sum(axis=1))[:, None]

    def _follow(self) -> None:
        super()._follow()
        newest = np.sum(np.abs(self._X[:, 0]) ** 2, axis=0)
        self._reference_powers = self._averaged(self._reference_powers, newest)
        y = np.abs(rfft(self._window_shape * self._newest(self._emitted))) ** 2
        y[..., 1 : (self._window_shape.size + 1) // 2] *= 2.0  # of both signs of the frequency
        y /= self._window_shape.size * np.sum(self._window_shape**2)
        self._output_powers = self._averaged(self._output_powers, y @ self._bands.T)

    def _adapt(self) -> None:
        powers, reference = self._bands @ self._powers, self._bands @ self._reference_powers
        gain = powers / np.maximum(reference, TINY)
        excess = np.minimum(self._output_powers / self._limits - 1.0, MOST_EXCESS)
        self._prices = np.maximum(self._prices + PRICE_RATE * self.step_size * gain * excess, 0.0)
        prices = (self._prices @ self._bands)[:, None, None]
        Y = self._block_spectrum(self._played)[:, None, None]
        gradient = self._gradient() - prices * self._X[:, :: self._every].conj() * Y
        self._descend(gradient, self._divisor(self._powers + prices * self._reference_powers))

    def require_sample_rate(self, fs: float) -> None:
        """Raise ValueError if the bands or the secondary path are for another sample rate than `fs` in Hz."""
        super().require_sample_rate(fs)
        require_rates(fs, {"bands": self.fs})


def _bins_of_bands(edges: Any, fs: float, samples: int) -> np.ndarray:
    """Return the share of each bin of a transform that lies in each band, (n_bands, bins)."""
    values, spacing = as_real_array(edges, "band_edges"), fs / samples
    if (
        values.ndim != 1
        or values.size < 2
        or not (values[0] >= 0 and values[-1] <= fs / 2 and np.all(np.diff(values) > 0))
    ):
        raise ValueError(f"band_edges must rise from 0 or above to fs/2 = {fs / 2:g} Hz at most, got {edges!r}")
    if np.diff(values).min() < spacing:
        raise ValueError(
            f"band_edges must be {spacing:.4g} Hz apart at least, as the bins are, got {np.diff(values).min():g}: take "
            "wider bands or a longer partition"
        )
    bins = np.arange(samples // 2 + 1)
    # A bin reaches half a spacing to both sides; those at 0 and fs/2 have one side.
    lower, upper = (np.clip(bins + side, 0.0, samples / 2) for side in (-0.5, 0.5))
    low, high = values[:-1, None] / spacing, values[1:, None] / spacing
    return np.maximum(np.minimum(upper, high) - np.maximum(lower, low), 0.0) / (upper - lower)
