"""The Wiener control filter of recorded signals: the best that a fixed causal filter of a given length can do.

Sign convention: ``e = d - s*y``, ``y = w*x`` with the newest sample first, filtered reference ``x' = s*x``.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from .._types import NumberOrArray
from .._validate import as_channels, as_count, as_nonnegative, as_positive, as_signal
from ..paths.least_squares import RANK_TOLERANCE, correlation_matrix, cross_correlation, minimum_norm_solve
from ..plant import Plant, as_constant_plant, checked_signals, has_one_channel
from .channel_bound import ChannelCorrelations

# A control power that exceeds the rated one by no more than this share of it counts as within it.
BUDGET_TOLERANCE = 1e-12

# The directions that `RANK_TOLERANCE` leaves out matter if they would lower the error by so much, unless the error is
# below -60 dB already: there a microphone's own noise decides. Noise of a few octaves in a duct loses up to 4 dB, with
# weights of 1e10 that no controller could use.
LOSS_THAT_MATTERS_DB = 6.0
ERROR_THAT_MATTERS = 1e-6
ROWS_PER_TAP = 8  # samples that are fitted anew to find that out


@dataclass(frozen=True)
class WienerSolution:
    """A fixed control filter, and what it does to the signals it was computed from.

    All powers are mean squares over the samples the filter was fitted to.

    Attributes
    ----------
    weights : numpy.ndarray, shape (n_taps,)
        Control filter w, newest sample first.
    control_power : float or numpy.ndarray, shape (J,)
        Mean square of the control signal y = w*x, of each loudspeaker if there are several.
    antinoise_power : float
        Mean square of the anti-noise s*y.
    disturbance_power : float
        Mean square of the disturbance d.
    error_power : float
        Mean square of the error e = d - s*y.
    noise_reduction_db : float
        ``-10 log10(E[e^2] / E[d^2])``, at most 300 dB.
    """

    weights: np.ndarray
    control_power: Any
    antinoise_power: float
    disturbance_power: float
    error_power: float
    noise_reduction_db: float


def wiener_solution(
    reference: ArrayLike,
    plant: Plant,
    *,
    n_taps: int,
    disturbance: ArrayLike | None = None,
    regularization: float = 0.0,
    control_penalty: float = 0.0,
) -> WienerSolution:
    r"""Return the least-squares control filter of a reference and a disturbance.

    Minimises :math:`E[(d - w^T x')^2] + \gamma E[(w^T x)^2]` :math:`+ \lambda E[x'^2] \|w\|^2` over the samples at
    which the delay lines of control filter and secondary path are full: least squares on the data at hand, not the
    biased autocorrelation. Leave out the start-up transient of the disturbance if it should not count. If the data
    leave weights undetermined (a tone determines only two numbers), the solution of minimum norm is taken.

    Eigenvalues of the correlation matrix below 1e-11 of the largest count as zero, because float64 correlations do not
    resolve them. A narrow-band reference has such eigenvalues, and then a filter with very large weights can have a
    smaller error than the solution. A warning says so if it matters: the solution is then no bound.

    Parameters
    ----------
    reference : array_like, shape (n_samples,)
        Reference signal x.
    plant : Plant
        Plant of one channel, of which the paths count: the bound has linear amplifiers and no sensor noise.
    n_taps : int
        Length of the control filter.
    disturbance : array_like, shape (n_samples,), optional
        Disturbance d at the error microphone, if it was measured, in place of the plant's primary path.
    regularization : float, default 0.0
        Ridge λ, relative to the power of the filtered reference.
    control_penalty : float, default 0.0
        Penalty γ on the control power; MOV-FxLMS steers to this optimum. With the γ at which `control_power` equals the
        rated power, no filter of the length has a smaller error within that power, but for the directions left out.

    Returns
    -------
    WienerSolution
        Weights, powers and noise reduction.

    Raises
    ------
    TypeError, ValueError
        If the signals differ in length, are shorter than the delay lines, silent, or not finite.

    Warns
    -----
    numpy.exceptions.RankWarning
        If the directions left out would lower the error by more than 6 dB, and the noise reduction is below 60 dB.

    See Also
    --------
    power_constrained_solution : finds the γ for a rated power.

    References
    ----------
    .. [1] S. M. Kuo and D. R. Morgan, "Active noise control: a tutorial review", Proc. IEEE 87(6), 1999.
    .. [2] D. Shi et al., "Optimal output-constrained active noise control based on inverse adaptive modeling
       leak factor estimate", IEEE/ACM Trans. Audio Speech Lang. Process. 29, 2021.

    Examples
    --------
    >>> from kfopc_filterpy import Plant
    >>> plant = Plant([0.0, 1.0], [0.0, 0.0, 0.0, 0.5], fs=16000)
    >>> solution = wiener_solution(np.random.default_rng(0).standard_normal(2000), plant, n_taps=4)
    >>> solution.weights.round(6) + 0.0
    array([0. , 0. , 0.5, 0. ])
    """
    stretch = full_stretch(*one_channel(reference, plant, disturbance, "wiener_solution"), n_taps)
    ridge = as_nonnegative(regularization, "regularization") * stretch.filtered_power
    penalty = as_nonnegative(control_penalty, "control_penalty")
    correlations = stretch.correlations()
    weights = correlations.weights(penalty, ridge)
    warn_of_loss(loss_db(stretch, correlations, weights, penalty, ridge))
    return stretch.solution(weights)


@dataclass(frozen=True)
class CoherenceBound:
    """Noise reduction that the coherence of reference and disturbance allows.

    Attributes
    ----------
    frequencies_hz : numpy.ndarray, shape (n_frequencies,)
        Frequencies in Hz.
    noise_reduction_db : numpy.ndarray, shape (n_frequencies,)
        Greatest noise reduction at each frequency in dB, at most 300 dB.
    overall_db : float
        The same for the whole disturbance.
    """

    frequencies_hz: np.ndarray
    noise_reduction_db: np.ndarray
    overall_db: float


def coherence_bound(reference: ArrayLike, disturbance: ArrayLike, fs: float, *, segment: int = 1024) -> CoherenceBound:
    """Return the noise reduction of a non-causal filter of any length, ``-10 log10(1 - coherence)``.

    No control filter can cancel the part of the disturbance that the reference does not contain, such as a second
    source. Spectra are averaged by Welch's method; with few segments the coherence comes out too high.

    With several references it is the multiple coherence: what all references together explain. With several microphones
    powers are summed over them.

    Parameters
    ----------
    reference : array_like, shape (n_samples,) or (I, n_samples)
        Reference signal.
    disturbance : array_like, shape (n_samples,) or (K, n_samples)
        Disturbance.
    fs : float
        Sampling rate in Hz.
    segment : int, default 1024
        Samples in a segment; the signals must hold at least eight segments.

    Returns
    -------
    CoherenceBound
        Frequencies, bound at each and overall.

    Raises
    ------
    TypeError, ValueError
        If the signals differ in length, are too short, or silent.

    References
    ----------
    .. [1] S. M. Kuo and D. R. Morgan, "Active noise control: a tutorial review", Proc. IEEE 87(6), 1999.
    .. [2] J. S. Bendat and A. G. Piersol, "Random data: analysis and measurement procedures", Wiley, ch. 7 (multiple
       coherence).

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = rng.standard_normal(160_000)
    >>> bound = coherence_bound(x, x + 0.1 * rng.standard_normal(x.size), fs=16000.0)
    >>> round(bound.overall_db)  # the part without coherence lies 20 dB below
    20
    """
    from scipy.signal import csd, welch

    fs = as_positive(fs, "fs", unit="Hz")
    segment = as_count(segment, "segment", minimum=8)
    named = {"reference": reference, "disturbance": disturbance}
    x, d = (np.atleast_2d(as_channels(given, name)) for name, given in named.items())
    for each, name in zip((x, d), named, strict=True):
        for channel in each:
            as_signal(channel, name, min_length=8 * segment, length=x.shape[1])
    frequencies, of_d = welch(d, fs, nperseg=segment)
    of_d = of_d.sum(axis=0)
    spectra = np.moveaxis(csd(x[:, np.newaxis], x, fs, nperseg=segment)[1], -1, 0)  # (n_frequencies, I, I)
    if not np.any(spectra) or not np.any(of_d):
        raise ValueError("reference and disturbance must not be silent: their coherence is undefined")
    cross = np.moveaxis(csd(x[:, np.newaxis], d, fs, nperseg=segment)[1], -1, 0)  # (n_frequencies, I, K)
    explained = np.linalg.pinv(spectra, rcond=1e-10, hermitian=True) @ cross
    coherent = np.einsum("fik,fik->f", cross.conj(), explained).real
    floor, tiny = 1e-30, np.finfo(float).tiny
    remaining = np.clip(1 - coherent / np.maximum(of_d, tiny), floor, 1)
    overall = max(float(np.sum(remaining * of_d) / np.sum(of_d)), floor)
    return CoherenceBound(frequencies, -10 * np.log10(remaining), float(-10 * np.log10(overall)))


@dataclass(frozen=True)
class Correlations:
    """Correlations R_x', R_x and r of a stretch of signals, from which its filter follows for any penalty."""

    filtered: np.ndarray
    reference: np.ndarray
    cross: np.ndarray

    def weights(self, penalty: float = 0.0, ridge: float = 0.0) -> np.ndarray:
        """Return the minimum-norm solution of (R_x' + penalty R_x + ridge I) w = r."""
        return minimum_norm_solve(self.matrix(penalty, ridge), self.cross)

    def matrix(self, penalty: float, ridge: float) -> np.ndarray:
        """Return R_x' + penalty R_x + ridge I."""
        matrix = self.filtered + penalty * self.reference
        matrix.flat[:: self.cross.size + 1] += ridge
        return matrix

    @cached_property
    def free(self) -> np.ndarray:
        """The weights without a penalty."""
        return self.weights()

    @cached_property
    def balance(self) -> float:
        """Energy of x' over that of x; 0 if one of them is silent."""
        energies = float(np.trace(self.filtered)), float(np.trace(self.reference))
        return energies[0] / energies[1] if min(energies) > 0 else 0.0

    @cached_property
    def basis(self) -> tuple[np.ndarray, np.ndarray]:
        """A basis V with V.T R_x' V = diag(share) and balance V.T R_x V = diag(1 - share), and the shares.

        Both matrices may be singular. Directions that the path does not pass, which would cost power for nothing, are
        left out.
        """
        values, vectors = np.linalg.eigh(self.filtered + self.balance * self.reference)
        kept = values > RANK_TOLERANCE * values[-1]
        whitened = vectors[:, kept] / np.sqrt(values[kept])
        share, turn = np.linalg.eigh(whitened.T @ self.filtered @ whitened)
        heard = share > RANK_TOLERANCE
        return whitened @ turn[:, heard], np.minimum(share[heard], 1.0)

    def antinoise(self, weights: np.ndarray) -> float:
        """Return the reduction of the error power by the weights: 2 w'r - w' R_x' w."""
        return float(weights @ (2.0 * self.cross - self.filtered @ weights))


@dataclass(frozen=True, eq=False)
class Record:
    """Samples that control filters are fitted to.

    The signals x and x' begin `n_taps` - 1 samples early, to fill the delay lines. With one channel, x, x' and d are
    one-dimensional; with several, x is (I, n + n_taps - 1), x' (K, J, I, n + n_taps - 1) and d (K, n).
    """

    x: np.ndarray
    filtered: np.ndarray
    d: np.ndarray
    n_taps: int

    @property
    def one_channel(self) -> bool:
        """Whether the signals have no channel axis."""
        return self.x.ndim == 1

    @property
    def _rows(self) -> np.ndarray:
        """Filtered references as (K, J I, n + n_taps - 1)."""
        return self.filtered.reshape(len(np.atleast_2d(self.d)), -1, self.filtered.shape[-1])

    def correlations(self) -> Any:
        """Return the correlations R_x' and r, summed over microphones, and R_x."""
        of_filtered = np.asarray(sum(correlation_matrix(rows, self.n_taps) for rows in self._rows))
        found = of_filtered, correlation_matrix(self.x, self.n_taps), self.cross()
        if self.one_channel:
            return Correlations(*found)
        return ChannelCorrelations(*found, (*self.filtered.shape[1:3], self.n_taps))

    def cross(self) -> np.ndarray:
        """Return r, the cross-correlation of d and x', summed over microphones."""
        pairs = zip(self._rows, np.atleast_2d(self.d), strict=True)
        return np.sum([[cross_correlation(d, row) for row in rows] for rows, d in pairs], axis=0).ravel()

    def control_signal(self, weights: np.ndarray) -> np.ndarray:
        """Return the control signal y = w*x, with several channels (J, n)."""
        if self.one_channel:
            return np.convolve(self.x, weights, mode="valid")
        return np.array([_sum_of_convolutions(self.x, w) for w in weights])

    def antinoise(self, weights: np.ndarray) -> np.ndarray:
        """Return the anti-noise w*x', with several channels (K, n)."""
        if self.one_channel:
            return np.convolve(self.filtered, weights, mode="valid")
        filters = weights.reshape(-1, self.n_taps)
        return np.array([_sum_of_convolutions(rows, filters) for rows in self._rows])

    @property
    def filtered_power(self) -> float:
        """Power of the filtered reference, summed over microphones and loudspeakers."""
        return float(np.mean(self.filtered[..., self.n_taps - 1 :] ** 2, axis=-1).sum())

    def part(self, start: int, stop: int) -> Self:
        """Return the samples from `start` to before `stop`, with their true past."""
        with_past = slice(start, stop + self.n_taps - 1)
        return type(self)(self.x[..., with_past], self.filtered[..., with_past], self.d[..., start:stop], self.n_taps)

    def full(self, n_path: int) -> Self:
        """Return the samples at which all delay lines are full, behind paths of `n_path` taps."""
        start, stop = self.n_taps + n_path - 2, self.d.shape[-1]
        if stop < start + self.n_taps:
            raise ValueError(
                f"reference must have at least {start + self.n_taps} samples for {self.n_taps} control "
                f"and {n_path} path taps, got {stop}; use a longer signal or fewer taps"
            )
        return self.part(start, stop).with_sound()

    def with_sound(self) -> Self:
        """Return the record, or raise ValueError if x' or d is silent."""
        filtered_power = self.filtered_power
        if filtered_power == 0 or mean_square(self.d) == 0:
            silent = "disturbance" if filtered_power else "reference through the secondary path"
            raise ValueError(f"{silent} must not be silent: there is nothing to solve for")
        return self

    def solution(self, weights: np.ndarray) -> WienerSolution:
        """Return the weights with their powers, those of the signals: the matrices have fewer correct digits.

        With several channels the control power is (J,), and the others are means over microphones.
        """
        antinoise, control_power = self.antinoise(weights), np.mean(self.control_signal(weights) ** 2, axis=-1)
        error_power, disturbance_power = mean_square(self.d - antinoise), mean_square(self.d)
        return WienerSolution(
            weights=weights,
            control_power=control_power if np.ndim(control_power) else float(control_power),
            antinoise_power=mean_square(antinoise),
            disturbance_power=disturbance_power,
            error_power=error_power,
            noise_reduction_db=reduction_db(error_power, disturbance_power),
        )


def _sum_of_convolutions(signals: np.ndarray, filters: np.ndarray) -> np.ndarray:
    from scipy.signal import fftconvolve

    return np.asarray(fftconvolve(signals, filters, mode="valid", axes=-1).sum(axis=0))


def one_channel(
    reference: ArrayLike, plant: Plant, disturbance: ArrayLike | None, what: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return reference, disturbance and secondary path of one channel, in the name of what needs them."""
    as_constant_plant(plant, what)
    x, d = checked_signals(plant, reference, disturbance)
    if not has_one_channel(plant, x):
        raise ValueError(
            f"{what} takes one channel, got {len(x)} reference(s) and secondary paths {plant.secondary.shape[:2]}: "
            "power_constrained_wiener takes several"
        )
    return x[0], d[0], plant.secondary[0, 0]


def record_of(x: np.ndarray, d: np.ndarray, secondary: np.ndarray, n_taps: int) -> Record:
    """Return copies of checked signals, with silence before the first sample; see `Record` for their shapes."""
    from scipy.signal import fftconvolve, lfilter

    n_taps = as_count(n_taps, "n_taps")
    if x.ndim == 1:
        filtered = lfilter(secondary, 1.0, x)
    else:
        filtered = fftconvolve(x[np.newaxis, np.newaxis], secondary[:, :, np.newaxis], axes=-1)[..., : x.shape[1]]
    x, filtered = (np.pad(signal, [(0, 0)] * (signal.ndim - 1) + [(n_taps - 1, 0)]) for signal in (x, filtered))
    record = Record(x, filtered, d.copy(), n_taps)
    for signal in (record.x, record.filtered, record.d):
        signal.flags.writeable = False
    return record


def full_stretch(x: np.ndarray, d: np.ndarray, secondary: np.ndarray, n_taps: int) -> Record:
    """Return the samples at which the delay lines of w and s are full."""
    return record_of(x, d, secondary, n_taps).full(secondary.shape[-1])


def mean_square(signal: np.ndarray) -> float:
    """Return the power of a signal."""
    return float(np.mean(signal**2))


def reduction_db(error_power: float, disturbance_power: float) -> float:
    """Return the noise reduction in dB, at most 300; NaN if there is no disturbance to reduce."""
    if disturbance_power == 0:
        return float("nan")
    return float(-10 * np.log10(max(error_power / disturbance_power, 1e-30)))


def loss_db(stretch: Record, correlations: Any, weights: np.ndarray, penalty: float = 0.0, ridge: float = 0.0) -> float:
    """Return by how many dB weights in the directions left out would lower the error; 0 if the loss does not matter.

    With several channels it is not known, and 0 is returned. With a penalty or a ridge, the error is that of the
    penalised problem. The signals themselves resolve weights that their correlations do not: a QR decomposition of
    evenly spaced samples is compared with `weights` at those samples.
    """
    from scipy.linalg import lstsq

    if not stretch.one_channel:
        return 0.0
    values = np.linalg.eigvalsh(correlations.matrix(penalty, ridge))
    if values[0] > RANK_TOLERANCE * values[-1]:
        return 0.0
    n_taps, n_samples = stretch.n_taps, stretch.d.size
    chosen = np.linspace(0, n_samples - 1, min(n_samples, ROWS_PER_TAP * n_taps)).astype(int)
    of_filtered, of_reference = (
        np.lib.stride_tricks.sliding_window_view(signal, n_taps)[chosen, ::-1]
        for signal in (stretch.filtered, stretch.x)
    )
    blocks = [of_filtered]
    if penalty:
        blocks.append(math.sqrt(penalty) * of_reference)
    if ridge:
        blocks.append(math.sqrt(ridge * chosen.size) * np.eye(n_taps))
    rows = np.concatenate(blocks)
    right = np.concatenate([stretch.d[chosen], np.zeros(len(rows) - chosen.size)])
    best, _, rank, _ = lstsq(rows, right, cond=len(rows) * np.finfo(float).eps, lapack_driver="gelsy")
    error = mean_square(right - rows @ weights)
    least = mean_square(right - rows @ best) * right.size / max(right.size - rank, 1)  # each weight fits by chance too
    if error <= ERROR_THAT_MATTERS * mean_square(right):
        return 0.0
    loss = 10 * math.log10(error / max(least, 1e-30 * error))
    return loss if loss > LOSS_THAT_MATTERS_DB else 0.0


def warn_of_loss(loss: float, what: str = "the solution is not the least-squares optimum, and no bound") -> None:
    """Warn the caller of the public function that calls this one, if there is a loss in dB."""
    if loss:
        warnings.warn(
            f"the reference is too narrow-band for this many taps: {what}. Weights in directions with less than "
            f"{RANK_TOLERANCE:g} of the strongest one's energy, which float64 correlations do not resolve, would lower "
            f"the error by {loss:.1f} dB more, with very large weights. Use fewer taps, add the sensor noise to the "
            "reference, or give a regularization",
            np.exceptions.RankWarning,
            stacklevel=3,
        )


def constrained_weights(
    stretch: Record, correlations: Any, rated_power: NumberOrArray
) -> tuple[np.ndarray, NumberOrArray]:
    """Return the weights of the least error within the power of each loudspeaker, and their λ."""
    if not stretch.one_channel:
        return correlations.constrained_weights(rated_power)
    weights, penalty = np.zeros(stretch.n_taps), 0.0
    if correlations.balance > 0:
        weights, penalty = _least_penalty(correlations, rated_power)
    if penalty == 0:
        # Without a penalty, `wiener_solution` takes the filter of least norm. In directions that the path does not pass
        # that filter may waste power, and so exceed the rated power.
        free = correlations.free
        if mean_square(stretch.control_signal(free)) <= rated_power:
            weights = free
    return weights, penalty


def _least_penalty(correlations: Correlations, rated_power: float) -> tuple[np.ndarray, float]:
    """Return the weights that solve (R_x' + λ R_x) w = r with the smallest λ >= 0 that keeps within the power, and it.

    In the basis of the correlations, each λ costs a sum over the taps instead of the solution of a system.
    """
    balance, (basis, share) = correlations.balance, correlations.basis
    cross = basis.T @ correlations.cross

    # Newton's method on 1/sqrt(power), which rises with λ and is concave and nearly straight: from λ = 0 the steps
    # approach the root from below, in at most a dozen steps if the eigenvalues span twelve decades (Moré and Sorensen).
    penalty = 0.0
    while True:
        stiffness = share + penalty * (1 - share)
        parts = cross / stiffness
        power = float((1 - share) @ parts**2) / balance
        if power <= rated_power * (1 + BUDGET_TOLERANCE):
            return basis @ parts, penalty * balance
        slope = float((1 - share) ** 2 @ (parts**2 / stiffness)) / balance
        penalty += power / slope * (math.sqrt(power / rated_power) - 1)
