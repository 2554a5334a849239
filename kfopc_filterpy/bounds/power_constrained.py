"""The bound: the least error that a control filter of a given length can reach within a power budget.

This is the minimum of E[e^2] subject to E[y^2] <= ρ_o, for recorded signals and known paths: over a whole record by one
filter, and in each second by a filter of its own. Sign convention and delay lines are those of `wiener`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._types import PerLoudspeaker
from .._validate import as_nonnegative, as_positive, as_sample_count, per_loudspeaker
from ..metrics import overshoot
from ..plant import Plant, as_constant_plant, checked_signals, has_one_channel
from . import wiener


@dataclass(frozen=True)
class ControlFilter(wiener.WienerSolution):
    r"""A fixed control filter over a stretch of a record: a `WienerSolution` with how it was computed.

    Its weights solve :math:`(R_{x'} + λ R_x + \mathrm{ridge}\, I)\, w = α r`.

    Attributes
    ----------
    weights, control_power, antinoise_power, disturbance_power, error_power, noise_reduction_db
        As in `WienerSolution`; the powers are mean squares over the stretch.
    penalty : float or ndarray, shape (J,)
        λ of each loudspeaker; 0 if the budget does not constrain the filter.
    constraint_factor : float
        α, as in KF-OPC; 1 for filters that are not scaled.
    start_s, end_s : float
        Start and end of the stretch in seconds from the first sample that counts.
    stretch : Record
        Samples of the stretch.
    """

    penalty: Any
    constraint_factor: float
    start_s: float
    end_s: float
    stretch: wiener.Record = field(repr=False, compare=False)

    @property
    def control_signal(self) -> np.ndarray:
        """Control signal y = w*x of the stretch, shape (n_samples,)."""
        return self.stretch.control_signal(self.weights)

    @property
    def error(self) -> np.ndarray:
        """Error e = d - s*y of the stretch, shape (n_samples,)."""
        return self.stretch.d - self.stretch.antinoise(self.weights)


def _of_each(name: str, description: str) -> Any:
    """Return a property: an array of a value of each segment."""
    return property(lambda own: np.array([getattr(segment, name) for segment in own.segments]), doc=description)


@dataclass(frozen=True)
class ControlFilters:
    """A control filter for each segment of a record.

    Attributes
    ----------
    segments : tuple of ControlFilter
        The filter of each segment: its weights, powers, noise reduction, λ, start and end.
    """

    segments: tuple[ControlFilter, ...]

    weights = _of_each("weights", "Weights of each segment, shape (n_segments, n_taps).")
    penalty = _of_each("penalty", "λ of each segment, shape (n_segments,).")
    control_power = _of_each("control_power", "Mean square of y in each segment, shape (n_segments,).")

    @property
    def noise_reduction_db(self) -> float:
        """Noise reduction over all segments, -10 log10(sum e^2 / sum d^2), at most 300 dB."""
        d = np.concatenate([segment.stretch.d for segment in self.segments], axis=-1)
        return wiener.reduction_db(wiener.mean_square(self.error), wiener.mean_square(d))

    @property
    def control_signal(self) -> np.ndarray:
        """Control signal, each segment with its own weights, shape (n_samples,)."""
        return np.concatenate([segment.control_signal for segment in self.segments], axis=-1)

    @property
    def error(self) -> np.ndarray:
        """Error, each segment with its own weights, shape (n_samples,)."""
        return np.concatenate([segment.error for segment in self.segments], axis=-1)


@dataclass(frozen=True)
class PowerConstrainedWiener:
    """Least errors that fixed control filters reach on a record within a power budget.

    Signals and times begin with the first sample that counts, like those of a `SimulationResult` with the same
    `switch_on_s`, so the same figures of merit apply: ``nse_db(bound.per_second.error, bound.disturbance, fs)``.

    Attributes
    ----------
    whole : ControlFilter
        The bound over the whole record: one filter that meets the budget on average over the record.
    per_second : ControlFilters
        The bound of each segment: a filter for each, which meets the budget in it.
    unconstrained : ControlFilter
        One filter without a budget; its `control_power` is the power that full control needs.
    scaled : ControlFilter
        The unconstrained filter times the factor of at most 1 that meets the budget: KF-OPC steers to it.
    scaled_per_second : ControlFilters
        The same for each segment: its own unconstrained filter, scaled.
    rated_power : float or ndarray, shape (J,)
        Budget ρ_o, mean square of the control signal.
    filtered_power : float
        Power of the filtered reference, E[x'^2].
    disturbance : numpy.ndarray, shape (n_samples,)
        Disturbance from the first sample that counts on.
    fs : float
        Sampling rate in Hz.
    """

    whole: ControlFilter
    per_second: ControlFilters
    unconstrained: ControlFilter
    scaled: ControlFilter
    scaled_per_second: ControlFilters
    rated_power: float | np.ndarray
    filtered_power: float
    disturbance: np.ndarray = field(repr=False)
    fs: float

    def __repr__(self) -> str:
        seconds = self.disturbance.shape[-1] / self.fs
        reached = f"noise reduction {self.per_second.noise_reduction_db:.1f} dB within the rated power of each second"
        free = f"{self.unconstrained.noise_reduction_db:.1f} dB with any power"
        return f"<PowerConstrainedWiener: {seconds:g} s at {self.fs:g} Hz, {reached}, {free}>"

    def noise_reduction_over(self, start_s: float = 0.0, end_s: float | None = None) -> dict[str, float]:
        """Return the noise reduction of each solution over a part of the record, -10 log10(sum e^2 / sum d^2) in dB.

        The steady half is ``noise_reduction_over(0.5 * bound.whole.end_s)``.

        Parameters
        ----------
        start_s, end_s : float
            Start and end of the part in seconds from the first sample that counts; by default all of it.

        Returns
        -------
        dict
            Noise reduction in dB, at most 300, of `whole`, `per_second`, `unconstrained`, `scaled` and
            `scaled_per_second`; NaN if the disturbance is silent.

        Raises
        ------
        TypeError, ValueError
            If no sample lies in the part, or it ends after the record.
        """
        n_samples = self.disturbance.shape[-1]
        start = round(as_nonnegative(start_s, "start_s", unit="s") * self.fs)
        stop = n_samples if end_s is None else round(as_positive(end_s, "end_s", unit="s") * self.fs)
        if not start < stop <= n_samples:
            raise ValueError(
                f"start_s and end_s must mark a part of the {n_samples / self.fs:g} s that count, "
                f"got {start_s:g} s to {stop / self.fs:g} s"
            )
        part = slice(start, stop)
        disturbance_power = wiener.mean_square(self.disturbance[..., part])
        names = ("whole", "per_second", "unconstrained", "scaled", "scaled_per_second")
        return {
            name: wiener.reduction_db(wiener.mean_square(getattr(self, name).error[..., part]), disturbance_power)
            for name in names
        }

    def within_windows(self, window_s: float = 0.1) -> ControlFilter:
        """Return the filter for the whole record whose power keeps the budget in every window.

        It shows what a hard promise costs, such as that of `OutputLimiter`: beside `whole`, which keeps the budget on
        average.

        Parameters
        ----------
        window_s : float, default 0.1
            Length of the sliding window in seconds.

        Returns
        -------
        ControlFilter
            The filter with the smallest error among those of one price of power, to 0.2 % of the budget.

        Raises
        ------
        TypeError, ValueError
            If `window_s` is not above 0.

        Examples
        --------
        >>> x = np.random.default_rng(0).standard_normal(4000) * np.repeat([1.0, 2.0], 2000)
        >>> from kfopc_filterpy import Plant
        >>> bound = power_constrained_wiener(x, Plant([1.0], [1.0], fs=1000), n_taps=8, rated_power=0.5)
        >>> print(f"{bound.whole.noise_reduction_db:.1f} dB, {bound.within_windows().noise_reduction_db:.1f} dB")
        5.2 dB, 3.1 dB
        """
        stretch, power = self.whole.stretch, np.asarray(self.rated_power, dtype=np.float64)
        correlations: Any = stretch.correlations()
        for _ in range(50):
            weights, penalty = wiener.constrained_weights(stretch, correlations, power if power.ndim else float(power))
            y = stretch.control_signal(weights)
            peak = np.asarray(overshoot(y, self.rated_power, self.fs, window_s=window_s))
            # A loudspeaker that keeps the budget without a price needs no more power.
            if np.all((np.abs(peak - 1.0) <= 0.002) | ((peak <= 1.0) & (np.asarray(penalty) == 0.0))):
                break
            power = power / np.where((peak < 1.0) & (np.asarray(penalty) == 0.0), 1.0, peak)
        times: dict[str, Any] = {"start_s": self.whole.start_s, "end_s": self.whole.end_s, "stretch": stretch}
        return ControlFilter(**vars(stretch.solution(weights)), **times, penalty=penalty, constraint_factor=1.0)


def power_constrained_wiener(
    reference: ArrayLike,
    plant: Plant,
    *,
    n_taps: int,
    rated_power: PerLoudspeaker,
    disturbance: ArrayLike | None = None,
    segment_s: float = 1.0,
    switch_on_s: float = 0.0,
    ridge: float = 0.0,
) -> PowerConstrainedWiener:
    r"""Return the least error within a power budget, over a record and in each second of it.

    Minimises :math:`E[(d - w^T x')^2]` subject to :math:`E[(w^T x)^2] ≤ ρ_o`. The problem is convex, and its solution

    .. math::

       (R_{x'} + λ R_x)\, w = r,

       λ ≥ 0,

       λ\,(E[y^2] - ρ_o) = 0

    is a bound: no filter of `n_taps` taps that stays fixed over the stretch does better within the power, unless its
    weights are very large in the directions left out (below). A filter that adapts may do better if the noise changes
    within the stretch. The bound is fitted to the stretch it is judged on, so by chance alone it removes about ``n_taps
    / fs`` per second of what the reference does not explain. The bound of each second meets the budget in each second,
    that of the record on average; which of them is better depends on the noise.

    With several loudspeakers, microphones or references the sum of the squared errors is minimised, and each
    loudspeaker j has a budget and a :math:`λ_j` of its own. `scaled` then is the unconstrained solution times the
    largest factor that keeps every budget: what one constraint factor can do at best.

    Delay lines hold the past of the record, also at the edges of segments, and zeros before its first sample. So only
    the record itself starts up, and the anti-noise at an edge is that of weights that have been there before.

    Directions in which reference and filtered reference have less than 1e-11 of the energy of the strongest get no
    weight, because float64 correlations do not resolve them. A narrow-band reference has such directions, and then very
    large weights can do better than the bound. A warning says so if it matters for the whole record.

    Parameters
    ----------
    reference : array_like, shape (n_samples,) or (I, n_samples)
        Reference signal x.
    plant : Plant
        Plant, of which the paths and the sample rate count: the bound has linear amplifiers and no sensor noise.
    n_taps : int
        Length of the control filter.
    rated_power : float or array_like, shape (J,)
        Budget ρ_o, mean square of the control signal, of all loudspeakers or of each.
    disturbance : array_like, shape (n_samples,) or (K, n_samples), optional
        Disturbance d at the error microphone, in place of the plant's primary path: one that was measured, or with its
        sensor noise if the error is to include it.
    segment_s : float, default 1.0
        Length of a segment in seconds, at least ``2 n_taps`` samples. The rest at the end is a segment of its own, or
        part of the one before if it is shorter than half a segment.
    switch_on_s : float, default 0
        Time in seconds of the first sample that counts, as in `simulate`.
    ridge : float, default 0
        Used for `unconstrained` and the scaled filters only, which solve :math:`(R_{x'} + \mathrm{ridge}\, I) w = r`.
        With ``ridge = q / (N P0)``, where N is the number of samples that count, a Kalman filter without state noise,
        with measurement noise q and initial variance P0, ends with these weights. `wiener_solution` takes the ridge
        relative to the power of the filtered reference: ``regularization = ridge / filtered_power``.

    Returns
    -------
    PowerConstrainedWiener
        Both bounds, the unconstrained filter, and the scaled filters of KF-OPC.

    Raises
    ------
    TypeError, ValueError
        If the signals differ in length, have fewer than `n_taps` samples that count, are silent in them, or are not
        finite; if an argument is out of range, or the plant changes. A silent segment is no error: it
        needs no power and gets zero weights.

    Warns
    -----
    numpy.exceptions.RankWarning
        If, over the whole record, the directions left out would lower the error of `whole` or `unconstrained` by more
        than 6 dB, and its noise reduction is below 60 dB.

    See Also
    --------
    power_constrained_solution : one filter, over the samples at which all delay lines are full.

    References
    ----------
    .. [1] D. Shi et al., "Optimal output-constrained active noise control based on inverse adaptive modeling
       leak factor estimate", IEEE/ACM Trans. Audio Speech Lang. Process. 29, 2021.
    .. [2] J. J. Moré and D. C. Sorensen, "Computing a trust region step", SIAM J. Sci. Stat. Comput. 4(3), 1983.

    Examples
    --------
    White noise, twice as strong in the last two of four seconds, and a secondary path that favours low frequencies:

    >>> x = np.random.default_rng(0).standard_normal(4000) * np.repeat([1.0, 2.0], 2000)
    >>> from kfopc_filterpy import Plant
    >>> plant = Plant([1.0, 0.8], [0.0, 0.0, 1.0], fs=1000)
    >>> bound = power_constrained_wiener(x, plant, n_taps=8, rated_power=0.5)
    >>> print(f"{bound.unconstrained.control_power:.1f}, {bound.whole.control_power:.3f}, {bound.whole.penalty:.2f}")
    4.8, 0.500, 0.93
    >>> bound.per_second.control_power.round(6)
    array([0.5, 0.5, 0.5, 0.5])
    >>> [round(segment.noise_reduction_db, 1) for segment in bound.per_second.segments]
    [9.2, 8.6, 4.4, 4.3]
    >>> {name: round(value, 1) for name, value in bound.noise_reduction_over(start_s=2.0).items()}
    {'whole': 5.6, 'per_second': 4.4, 'unconstrained': 16.0, 'scaled': 3.3, 'scaled_per_second': 2.5}
    """
    ridge = as_nonnegative(ridge, "ridge")
    as_constant_plant(plant, "power_constrained_wiener")
    x, d = checked_signals(plant, reference, disturbance)
    fs, record = plant.fs, record_of_any(x, d, plant, n_taps)
    if record.one_channel:
        rated_power = as_positive(rated_power, "rated_power")
    else:
        rated_power = per_loudspeaker(rated_power, plant.n_loudspeakers, "rated_power")
    first = round(as_nonnegative(switch_on_s, "switch_on_s", unit="s") * fs)
    n_samples = record.d.shape[-1]
    if n_samples - first < record.n_taps:
        raise ValueError(
            f"reference must have at least {record.n_taps} samples from switch_on_s on for {record.n_taps} taps, "
            f"got {max(n_samples - first, 0)}; use a longer signal, an earlier switch_on_s or fewer taps"
        )
    length = as_sample_count(segment_s, fs, "segment_s")
    if length < 2 * record.n_taps:
        raise ValueError(
            f"segment_s must be at least {2 * record.n_taps / fs:g} s, twice the {record.n_taps} taps, got "
            f"{length / fs:g} s: a filter overfits shorter ones; use longer segments or fewer taps"
        )
    counted = record.part(first, n_samples).with_sound()
    edges = list(range(first, n_samples, length))
    if len(edges) > 1 and n_samples - edges[-1] < length / 2:
        edges.pop()

    def solve(start: int, stop: int) -> tuple[ControlFilter, ControlFilter, ControlFilter]:
        return _solve(record.part(start, stop), rated_power, ridge, (start - first) / fs, (stop - first) / fs)

    over_record = solve(first, n_samples)
    whole, unconstrained, scaled = over_record
    if counted.one_channel:
        correlations = counted.correlations()
        left_out = wiener.loss_db(counted, correlations, whole.weights, penalty=whole.penalty)
        wiener.warn_of_loss(max(left_out, wiener.loss_db(counted, correlations, unconstrained.weights, ridge=ridge)))
    segments = zip(edges, [*edges[1:], n_samples], strict=True)
    each = [over_record] if len(edges) == 1 else [solve(start, stop) for start, stop in segments]
    return PowerConstrainedWiener(
        whole=whole,
        per_second=ControlFilters(tuple(constrained for constrained, _, _ in each)),
        unconstrained=unconstrained,
        scaled=scaled,
        scaled_per_second=ControlFilters(tuple(scaled for _, _, scaled in each)),
        rated_power=rated_power,
        filtered_power=counted.filtered_power,
        disturbance=counted.d,
        fs=fs,
    )


def power_constrained_solution(
    reference: ArrayLike, plant: Plant, *, n_taps: int, rated_power: float, disturbance: ArrayLike | None = None
) -> wiener.WienerSolution:
    """Return the least-squares control filter whose control power does not exceed the rated power.

    The penalty γ of `wiener_solution` is chosen so that the control power is `rated_power`, or zero if the filter needs
    less. As in `wiener_solution`, only samples at which the delay lines of control filter and secondary path are full
    count, and directions in which the reference has hardly any energy get no weight. But for those, no filter of this
    length has a smaller error within the power.

    Parameters
    ----------
    reference, plant, n_taps, disturbance
        As in `wiener_solution`.
    rated_power : float
        Rated power (mean square of the control signal).

    Returns
    -------
    WienerSolution
        Weights, powers and noise reduction.

    Raises
    ------
    TypeError, ValueError
        As for `wiener_solution`, or if `rated_power` is not positive.

    Warns
    -----
    numpy.exceptions.RankWarning
        As for `wiener_solution`.

    See Also
    --------
    power_constrained_wiener : the same in each second too, with the scaled filter beside it.

    Examples
    --------
    >>> x = np.random.default_rng(0).standard_normal(2000)
    >>> from kfopc_filterpy import Plant
    >>> solution = power_constrained_solution(x, Plant([1.0], [2.0], fs=16000), n_taps=1, rated_power=1.0)
    >>> round(solution.control_power, 4)
    1.0
    """
    rated_power = as_positive(rated_power, "rated_power")
    signals = wiener.one_channel(reference, plant, disturbance, "power_constrained_solution")
    stretch = wiener.full_stretch(*signals, n_taps)
    correlations = stretch.correlations()
    weights, penalty = wiener.constrained_weights(stretch, correlations, rated_power)
    wiener.warn_of_loss(wiener.loss_db(stretch, correlations, weights, penalty))
    return stretch.solution(weights)


def record_of_any(x: np.ndarray, d: np.ndarray, plant: Plant, n_taps: int) -> wiener.Record:
    """Return the record of checked signals, (I, n) and (K, n): one channel has more exact solutions than several."""
    if has_one_channel(plant, x):
        return wiener.record_of(x[0], d[0], plant.secondary[0, 0], n_taps)
    return wiener.record_of(x, d, plant.secondary, n_taps)


def _solve(
    stretch: wiener.Record, rated_power: Any, ridge: float, start_s: float, end_s: float
) -> tuple[ControlFilter, ControlFilter, ControlFilter]:
    """Return the filter within the power, the one without a budget, and the latter scaled."""

    def control_filter(weights: np.ndarray, penalty: Any = 0.0, constraint_factor: float = 1.0) -> ControlFilter:
        solution = stretch.solution(weights)
        weights.flags.writeable = False
        return ControlFilter(**vars(solution), **times, penalty=penalty, constraint_factor=constraint_factor)

    times: dict[str, Any] = {"start_s": start_s, "end_s": end_s, "stretch": stretch}
    correlations: Any = stretch.correlations()
    constrained = control_filter(*wiener.constrained_weights(stretch, correlations, rated_power))
    free = control_filter(correlations.weights(ridge=ridge))
    if np.all(free.control_power <= rated_power):
        return constrained, free, free
    factor = float(np.sqrt(np.min(rated_power / np.maximum(free.control_power, np.finfo(float).tiny))))
    return constrained, free, control_filter(factor * free.weights, constraint_factor=factor)
