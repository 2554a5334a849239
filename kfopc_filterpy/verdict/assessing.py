"""Assess an amplifier from recordings: check them, find the bounds, run the controllers, name the cause."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import welch

from kfopc_filterpy import SimulationResult, noise_reduction_db, output_power, suggest_settings
from kfopc_filterpy._validate import (
    as_channels,
    as_choice,
    as_count,
    as_nonnegative,
    as_positive,
    as_signal,
    per_channel,
)
from kfopc_filterpy.bounds import coherence_bound, predictor_reference
from kfopc_filterpy.bounds.wiener import mean_square, reduction_db
from kfopc_filterpy.controllers.kf_pb import DEFAULT_UNCERTAINTY
from kfopc_filterpy.loop.inputs import SensorNoise
from kfopc_filterpy.metrics import (
    a_weighted_level_db,
    a_weighting_db,
    convergence_time_s,
    overshoot,
    peak_control_signal,
    third_octave_levels_db,
)
from kfopc_filterpy.paths import (
    FeedbackMargin,
    causality_margin,
    frequency_response,
    internal_model_margin,
    path_uncertainty,
)
from kfopc_filterpy.paths.analysis import energy_onset
from kfopc_filterpy.paths.file_checks import require_different, require_each_microphone, require_heard, require_sound
from kfopc_filterpy.paths.timing import timing_fault
from kfopc_filterpy.paths.uncertainty import Uncertainty, as_uncertainty
from kfopc_filterpy.plant import Plant, as_constant_plant, checked_signals, require_rate
from kfopc_filterpy.signals.quality import RECOMMENDED_S, clipping_remarks, recording_remarks

from .._types import ProgressBar
from .assessment import Assessment, Band, Ceilings, SoundLevels, advice_on, nominal_hz, percent
from .candidates import CANDIDATES, CHOSEN, DIRECT, ONE_CHANNEL, Settings
from .fixed_filters import FixedFilters, longest_filter
from .limits import Limits, Ratings, limits_of, ratings_of_each, scale_of, watt_per_power
from .runs import NSE_WINDOW_S, Plan, announce, one_blas_thread

ALL = "all"
USUAL = ("KF-PB", "KF-OPC", "FxLMS")
MOST_DIRECT_WEIGHTS = 256  # from which the Kalman filters of all weights together run only if they are named
MEMORY_S, CHANNEL_MEMORY_S = 0.25, 1.0
WEAK_DB = -20.0  # gain of the secondary path, over its mean in the noise's band, below which the loudspeaker is weak
SWITCH_ON_S = 0.5  # into the record, but at most a tenth of it
LEAST_RUN_S = 2.0  # its second half then has ten of an amplifier's windows of 0.1 s
LEAST_TOLERANCE = 0.01  # of the least rated power
SAME_DB, KEPT = 0.1, 1.02  # runs that differ by less are as good, and a rating that is exceeded by less is kept
MOST_BANDS = 3  # that a note names
LOUDER_DB, HEARD = 1.0, 1e-3  # of a third octave: by how much, and its least share of the A-weighted power that remains
DIFFERING_DB = -6.0  # left of a recorded disturbance by a primary path, from which a note says so
NEARLY_FREE = 1e6  # times the power of the bound: an amplifier without limits
SEED = 7_315_846_209  # of the plant's sensor noise: no likely seed of a noise, with which it would be correlated


@one_blas_thread()
def assess(
    noise: ArrayLike,
    plant: Plant,
    *,
    rating: Ratings,
    disturbance: ArrayLike | None = None,
    want_db: float = 6.0,
    algorithm: str = "KF-PB",
    beside: Sequence[str] | None = None,
    n_taps: int | None = None,
    memory_s: float | None = None,
    secondary_path_uncertainty: Uncertainty | None = DEFAULT_UNCERTAINTY,
    pascal_per_unit: ArrayLike | None = None,
    feedback: bool = False,
    bar: ProgressBar | None = None,
) -> Assessment:
    """Return the verdict on an amplifier: whether it buys a noise reduction, what limits, and what to change.

    With I references, J loudspeakers and K error microphones, noise reductions are those of all microphones together:
    energies are summed over the microphones before the ratio is taken. Each loudspeaker has its own rated power, and
    the amplifiers are enough if all of them together are. The offsets of the recordings are subtracted, because no
    loudspeaker plays them.

    Parameters
    ----------
    noise : array_like, shape (n_samples,) or (I, n_samples)
        Recording of the reference microphones, with silent loudspeakers; if there are none, of the error microphones
        (see `feedback`). A `Recording` must have the plant's sample rate.
    plant : Plant
        Paths from each reference and from each control signal to each error microphone. The primary path may be missing
        if there is a `disturbance`, or no reference microphone. The amplifiers are those of the `rating`. Its sensor
        noise is added to a disturbance that the primary path gives; a recorded one has its own.
    rating : float, AmplifierRating, LoudspeakerRating, or a sequence of them
        What the amplifier and the loudspeaker bear; a number is a rated power in squared units of the control signal.
        With several loudspeakers one rating for all, or a sequence with an entry for each: a rating, or a sequence of
        ratings that hold together.
    disturbance : array_like, shape (n_samples,) or (K, n_samples), optional
        Recording of the error microphones, made together with `noise`. It contains what the reference does not explain,
        so that the coherence can be checked, and is compared with what the primary path gives, if there is one. By
        default it is computed by the primary path.
    want_db : float, default 6
        Noise reduction wanted in dB.
    algorithm : str, default "KF-PB"
        Controller that the verdict is on. It has a limiter, which keeps the rating in every window.
    beside : sequence of str or "all", optional
        Algorithms to run beside it, without a limiter; by default KF-PB, KF-OPC and FxLMS. Each runs with
        the best of the settings that are tried on the first 5 s: step sizes, state noises or forgetting factors. With
        several channels KF-OPC and KF-ANC run only if they are named, or if all control filters together have at most
        256 taps, because their cost grows with the square of them.
    n_taps : int, optional
        Taps of a control filter; by default `suggest_settings` finds them, at most 256, and at most 1024 in all filters
        together.
    memory_s : float, optional
        Memory of KF-OPC in s, by which the settings are suggested; by default 0.25 s, and 1 s with several channels.
    secondary_path_uncertainty : PathTolerance, float or array_like, optional
        How far the true secondary path may differ from the plant's, for KF-PB, which learns the path as it controls:
        a relative error, by default 0.3, or what `paths.path_uncertainty` takes. None: it is exact.
    pascal_per_unit : float or array_like, shape (K,), optional
        Sound pressure at the error microphone in Pa for a value of 1, of all microphones or of each. With it, sound
        levels are computed.
    feedback : bool, default False
        Whether the controllers also predict the disturbance from its past (hybrid control, see `with_internal_model`).
        If there is neither a primary path nor a `disturbance`, there is no reference microphone, as in headphones, and
        `noise` is the disturbance.
    bar : tqdm bar, optional
        Bar that advances with the samples that are run, those on which settings are tried included; its total is set,
        and it is described by what is going on.

    Returns
    -------
    Assessment
        The verdict; its ``print`` tells it, `to_dict` gives it as JSON, `write` as a page with figures and sounds.

    Raises
    ------
    TypeError, ValueError
        Signals that are not finite, silent, too short for the filter or for a run of 2 s, or of different lengths;
        paths whose channels do not fit the signals; neither a primary path nor a disturbance without `feedback`; a
        settled feedback loop without a margin, with the secondary path or one that was measured again; a rating that
        does not limit the mean power, or ratings for another number of loudspeakers; an unknown algorithm.

    Notes
    -----
    The cause is the first ceiling that does not reach `want_db`; see `Ceilings`. If all of them do and the run does
    not, the amplifier is the cause if a run with more power reaches it (peaks and short windows cost more than the mean
    power), otherwise the adaptation is. A run with an amplifier that does not clip tells whether the peaks do.

    The least rated power is found by bisection: the run is repeated with other ratings, about six times. They do not
    depend on the rating that is given, only on its proportions: of the loudspeakers, and of peak and mean power.

    The algorithms run side by side, on as many cores as there are. The numerical libraries get one thread
    meanwhile: with filters of this size, more of them slow each other down.

    With `feedback`, the disturbance one sample late is a reference, for the ceilings too: they are those of predictors,
    and there is no coherence. `paths.internal_model_margin` judges the settled loop with the plant's path and with any
    measured ones in `secondary_path_uncertainty`; the least margin counts.

    With several loudspeakers the required rated powers are in the proportions of the ratings. The coherence is the
    multiple coherence of all references. The causality margin is that of each microphone's earliest loudspeaker, at the
    worst microphone.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import Plant
    >>> from kfopc_filterpy.verdict import assess
    >>> from kfopc_filterpy.power import AmplifierRating
    >>> from kfopc_filterpy.signals import band_limited_noise
    >>> noise = band_limited_noise((100, 1000), 4.0, fs=8000, rng=1)
    >>> plant = Plant(np.eye(16)[8], np.eye(64)[40], fs=8000)
    >>> verdict = assess(noise, plant, rating=AmplifierRating(ohm=8, sine_watt=0.02), n_taps=64)
    >>> print(verdict.enough, verdict.limited_by)
    False amplifier
    """
    as_constant_plant(plant, "assess")
    x, d, s = recorded_signals(noise, plant, disturbance, feedback)
    fs, p = plant.fs, plant.primary
    several = s.ndim == 3
    K, J, n_references = (*s.shape[:2], len(x)) if several else (1, 1, 1)
    want_db = as_nonnegative(want_db, "want_db", unit="dB")
    as_choice(algorithm, "algorithm", CANDIDATES)
    by_name = beside is not None and beside != ALL
    others = list(CANDIDATES if beside == ALL else USUAL if beside is None else beside)
    for name in others:
        as_choice(name, "beside", CANDIDATES)
    ratings = ratings_of_each(rating, J)
    limits = limits_of(ratings, several)
    pascals = None if pascal_per_unit is None else _pascals(pascal_per_unit, K)
    if memory_s is None:
        memory_s = CHANNEL_MEMORY_S if several else MEMORY_S
    start = round(min(SWITCH_ON_S * fs, x.shape[-1] / 10))
    run_s = (x.shape[-1] - start) / fs
    if run_s < LEAST_RUN_S:
        raise ValueError(
            f"noise must last {LEAST_RUN_S:g} s after the control is switched on, got {run_s:.3g} s: a shorter run says "
            f"nothing; record {RECOMMENDED_S:g} s or more"
        )
    notes: list[str] = []
    announce(bar, 0, "bounds")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", np.exceptions.RankWarning)
        settings = suggest_settings(
            x[..., start:],
            Plant(s, fs=fs),
            disturbance=d[..., start:],
            memory_s=memory_s,
            n_taps=None if n_taps is None else as_count(n_taps, "n_taps"),
            max_taps=longest_filter(J * n_references),
        )
        margin_s = None if p is None else causality_margin(plant).margin_s
        late = max(0, round(-(margin_s or 0.0) * fs))
        bounds = FixedFilters(x[..., start:], d[..., start:], s, settings.n_taps, fs, late)
        within_power_db = bounds.within(limits.rated_power)
        required = bounds.needed(want_db, limits.rated_power)
    if any(issubclass(warning.category, np.exceptions.RankWarning) for warning in caught):
        notes.append("The reference is so narrow-band that larger weights could do better than the bound.")
    weights = J * n_references * settings.n_taps
    if several and not by_name:
        others = [name for name in others if name not in ONE_CHANNEL]
        slow = [name for name in others if name in DIRECT and name != algorithm]
        if slow and weights > MOST_DIRECT_WEIGHTS:
            others = [name for name in others if name not in slow]
            notes.append(
                f"{' and '.join(slow)} left out, because {weights} weights take long: choose {' or '.join(slow)} as the "
                f"algorithm, or {MOST_DIRECT_WEIGHTS // (J * n_references)} taps or fewer."
            )
    names = [algorithm, *(name for name in others if name != algorithm)]

    plan = Plan(x, d, s, fs, start, limits, settings, secondary_path_uncertainty, bar, feedback)
    announce(bar, sum(map(plan.planned_samples, names)), ", ".join(names))
    runs: dict[str, SimulationResult] = {}
    for name, outcome in zip(names, plan.outcomes(names), strict=True):
        if isinstance(outcome, SimulationResult):
            runs[name] = outcome
        elif name == algorithm:
            raise ValueError(f"{outcome}; use another algorithm") from outcome
        else:
            notes.append(f"{name} is left out: {outcome}.")
    run = runs[algorithm]
    reached = _reduction(run)
    loop = _settled_loop(run, s, secondary_path_uncertainty) if feedback else None
    coherence_db = None
    if (disturbance is not None or plant.sensor_noise_std) and not feedback:
        # Segments as long as sixteen of them allow.
        segment = int(2 ** np.clip(np.floor(np.log2(max(bounds.x.shape[-1] / 16, 8))), 3, 14))
        coherence_db = max(coherence_bound(bounds.x, bounds.d, fs, segment=segment).overall_db, bounds.time_db)
    ceilings = Ceilings(coherence_db, bounds.time_db, bounds.filter_db, within_power_db)
    cause = None if reached >= want_db else _cause(ceilings, want_db, late >= settings.n_taps)
    volts_per_unit, ohm = (scale_of(ratings, name, several) for name in ("volts_per_unit", "ohm"))
    watts = watt_per_power(volts_per_unit, ohm)
    least = np.inf if want_db else 0.0
    if want_db and cause in (None, "amplifier", "adaptation"):
        first = required if np.all(np.isfinite(required)) else bounds.free.control_power
        unit = np.ravel(limits.rated_power * (1.0 if watts is None else watts))[0]
        least = _least_share(plan, algorithm, want_db, np.max(first / limits.rated_power), unit)
    if cause == "adaptation" and np.isfinite(least):
        cause = "amplifier"
    unclipped_db = None
    if cause == "amplifier" and within_power_db >= want_db and limits.has_peaks:
        announce(bar, plan.planned_samples(algorithm), "without clipping")
        unclipped_db = _reduction(replace(plan, limits=limits.without_peaks(), chosen={}).run(algorithm, limited=True))
    figures = {name: _figures(one, limits, fs, plan.chosen[name]) for name, one in runs.items()}
    notes += _on_better_runs(figures, algorithm) + _on_louder_bands(run)
    if watts is None:
        unknown = "the rating states no impedance" if ohm is None else "volts_per_unit is not known, and taken as 1 V"
        notes.append(f"Powers are mean squares of the control signal, not watts: {unknown}.")
    notes += recording_remarks(noise, fs, "noise")
    if disturbance is not None:
        notes += clipping_remarks(disturbance, "disturbance") + _on_differing_path(noise, plant, disturbance)
    elif p is not None:
        lacking = "is not checked" if coherence_db is None else "shows only the plant's sensor noise"
        notes.append(
            f"The disturbance was computed from the reference, so the coherence {lacking}: record both microphones "
            "together and give the disturbance."
        )
    notes += _on_uncertain_path(loop, s, secondary_path_uncertainty)
    n_heard = n_references - K if feedback else n_references
    assessment = Assessment(
        enough=cause is None,
        want_db=want_db,
        noise_reduction_db=reached,
        limited_by=cause,
        advice=(),
        notes=tuple(notes),
        algorithm=algorithm,
        limits=limits,
        ceilings=ceilings,
        unlimited_power=bounds.free.control_power,
        required_rated_power=required,
        least_rated_power=least * limits.rated_power,
        unclipped_db=unclipped_db,
        causality_margin_s=margin_s,
        helpful_delay_s=bounds.helpful_delay_s(want_db) if bounds.filter_db < want_db else None,
        band=_band(bounds.d, s, fs),
        levels=None if pascals is None else _levels(run, pascals),
        settings=settings,
        figures=figures,
        runs=runs,
        curve=bounds.curve(limits.rated_power),
        volts_per_unit=volts_per_unit,
        ohm=ohm,
        fs=fs,
        channels=(n_heard, J, K) if several else None,
        pascal_per_unit=pascal_per_unit,
        switch_on_s=start / fs,
        response_s=None if p is None else _response_s(p, s, want_db, fs),
        feedback=n_heard == 0,
        loop=loop,
        timing_fault=timing_fault(np.atleast_2d(x)[0], np.atleast_2d(d)[0], fs, ("noise", "disturbance"))
        if disturbance is not None and cause in ("coherence", "causality", "filter", "adaptation")
        else None,
    )
    return replace(assessment, advice=tuple(advice_on(assessment)))


def recorded_signals(
    noise: ArrayLike, plant: Plant, disturbance: ArrayLike | None, feedback: bool = False
) -> tuple[np.ndarray, ...]:
    """Return references, disturbances and secondary paths, checked, the recordings without their offsets.

    With `feedback`, the disturbances one sample late are the last references, or the only ones if there is neither a
    primary path nor a `disturbance`: `noise` is then the disturbance. With one channel of each kind, there are no
    channel axes.
    """
    x, s = _recording(noise, "noise", plant.fs), plant.secondary
    K, J, _ = s.shape
    require_sound("secondary", s)
    if plant.primary is not None and plant.n_references != len(x):
        raise ValueError(
            f"noise must have the {plant.n_references} channel(s) of the plant's primary path, got {len(x)}; leave out "
            "the channels that do not fit"
        )
    if disturbance is not None:
        d = _recording(disturbance, "disturbance", plant.fs, length=x.shape[1])
        require_each_microphone("disturbance", d, K, "secondary")
        require_different("disturbance", d, "noise", x)
    elif plant.primary is None and feedback:
        d, x = x, x[:0]
        require_each_microphone("noise", d, K, "secondary")
    elif plant.primary is None:
        raise ValueError(
            "plant must have a primary path unless there is a disturbance: what arrives at the error microphone?"
        )
    else:
        _, d = checked_signals(plant, x, None)
    if not np.any(d):
        raise ValueError("disturbance must not be silent: every value is 0")
    if disturbance is None and plant.primary is not None:
        d = d + SensorNoise(plant.sensor_noise_std, SEED).take(*d.shape)
    if feedback:
        x = np.concatenate((x, predictor_reference(d)))
    return (x[0], d[0], s[0, 0]) if (K, J, len(x)) == (1, 1, 1) else (x, d, s)


def _recording(value: Any, name: str, fs: float, length: int | None = None) -> np.ndarray:
    """Return the channels of a recording without their offsets, (channels, n_samples)."""
    require_rate(value, fs, name)
    channels = np.atleast_2d(as_channels(value, name))
    for number, channel in enumerate(channels):
        which = name if len(channels) == 1 else f"{name}[{number}]"
        as_signal(channel, which, length=length)
    require_heard(name, channels)
    return channels - channels.mean(axis=1, keepdims=True)


def _pascals(value: Any, n_microphones: int) -> Any:
    """Return pascals per unit, of all microphones or as a column of them."""
    if not np.iterable(value):
        return as_positive(value, "pascal_per_unit", unit="Pa")
    return per_channel(value, n_microphones, "microphones", "pascal_per_unit")[:, np.newaxis]


def _response_s(p: np.ndarray, s: np.ndarray, want_db: float, fs: float) -> float:
    """Return how long a control filter must be to treat enough of the primary path's energy, in s.

    It is the time from the first sound of a loudspeaker until the share of the energy has come that must be removed, at
    the microphone where this takes longest.
    """
    s = s.reshape(len(p), -1, s.shape[-1])
    share = 1.0 - 10 ** (-want_db / 10)
    lasting = [
        energy_onset(np.sqrt(np.sum(of_all**2, axis=0)), share)
        - min(energy_onset(one) for one in reached if np.any(one))
        for of_all, reached in zip(p, s, strict=True)
    ]
    return (max(lasting) + 1) / fs


def _reduction(run: SimulationResult) -> float:
    """Return the noise reduction of a run in dB; -Inf if it diverged."""
    reached = noise_reduction_db(run.error, run.disturbance)
    return -np.inf if np.isnan(reached) else reached


def _settled_loop(run: SimulationResult, s: np.ndarray, uncertainty: Any) -> FeedbackMargin | None:
    """Return the least margin of a run's last control filter, for all measured paths; None if the run diverged."""
    if run.diverged_at_s is not None or run.weights is None:
        return None
    stated: Any = as_uncertainty(uncertainty)
    measured = [s, *np.reshape(stated, (-1, *s.shape[:-1], np.shape(stated)[-1]))] if np.ndim(stated) > 1 else [s]
    loops = [internal_model_margin(run.weights[-1], Plant(path, fs=run.fs), s) for path in measured]
    least = min(loops, key=lambda loop: loop.disk_margin)
    if not least.stable:
        raise ValueError(
            f"the settled loop of {run.algorithm} has no margin: it is unstable with measured secondary path "
            f"{loops.index(least)} of those that state its uncertainty; measure the path as it is in use, or use another "
            "algorithm or fewer taps"
        )
    return least


def _on_differing_path(noise: ArrayLike, plant: Plant, disturbance: ArrayLike) -> list[str]:
    """Return a note if the primary path gives another disturbance than the one that was recorded."""
    if plant.primary is None:
        return []
    x, d = (_recording(signal, name, plant.fs) for signal, name in ((noise, "noise"), (disturbance, "disturbance")))
    left = d - checked_signals(plant, x, None)[1]
    left_db = -reduction_db(mean_square(left), mean_square(d))
    if left_db < DIFFERING_DB:
        return []
    return [
        f"The recorded disturbance differs from the one that the primary path gives: {left_db:.1f} dB of its power is left. "
        "The verdict is on the recorded one; the path counts for the causality margin only."
    ]


def _on_uncertain_path(loop: FeedbackMargin | None, s: np.ndarray, uncertainty: Any) -> list[str]:
    """Return a note if the path may be more wrong than the settled loop surely tolerates; measured paths were tried."""
    stated: Any = as_uncertainty(uncertainty)
    if loop is None or np.ndim(stated) > 1:
        return []
    error = path_uncertainty(uncertainty, s)
    frequencies = np.linspace(0.0, loop.fs / 2.0, error.size)
    tolerated = loop.path_error_at(frequencies)
    worst = int(np.argmax(error / tolerated))
    if error[worst] < tolerated[worst]:
        return []
    return [
        f"The secondary path may be wrong by {percent(error[worst])} at {frequencies[worst]:.0f} Hz, where the settled "
        f"loop tolerates {percent(tolerated[worst])}: measure the path again as it is in use, and state both measurements."
    ]


def _least_share(plan: Plan, name: str, want_db: float, start: float, unit: float) -> float:
    """Return the least share of the rating with which an algorithm's run reaches a noise reduction; Inf if none does.

    The search begins at the share `start`. It tries powers of three digits, which are those that are printed: `unit` is
    the power that is printed for a share of 1.
    """
    from scipy.optimize import brentq

    tried: dict[float, float] = {}

    def excess(log_power: float) -> float:
        power = float(f"{np.exp(log_power):.3g}")
        if power not in tried:
            announce(plan.bar, plan.planned_samples(name), "least rating")
            reached = _reduction(plan.run(name, limited=True, share=power / unit))
            tried[power] = max(reached, -100.0) - want_db  # a number if it diverged, too
        return tried[power]

    low = high = np.log(start * unit)
    step, highest = np.log(2.0), high + np.log(NEARLY_FREE)
    while excess(high) < 0:
        if high >= highest:
            return np.inf
        low, high, step = high, high + step, 2 * step
    while excess(low) >= 0:
        low, high, step = low - step, low, 2 * step
    brentq(excess, low, high, xtol=LEAST_TOLERANCE)
    return min(power for power, more in tried.items() if more >= 0) / unit


def _on_better_runs(figures: Mapping[str, Mapping[str, Any]], algorithm: str) -> list[str]:
    """Return why the verdict is not on the best algorithm of those that keep the rating, and of those that do not."""
    least = figures[algorithm]["noise_reduction_db"] + SAME_DB
    better = sorted(
        ((own["noise_reduction_db"], name) for name, own in figures.items() if own["noise_reduction_db"] > least),
        reverse=True,
    )
    notes: dict[bool, str] = {}
    for reached, name in better:
        mean, worst = (float(np.max(figures[name][key])) for key in ("of_rated_power", "worst_window"))
        why = (
            " within the rating: choose it as the algorithm."
            if worst <= KEPT
            else f", but does not keep the rating: its mean power is {mean:.2g} times the rated power, and {worst:.2g} times "
            "in its worst window."
        )
        notes.setdefault(worst <= KEPT, f"{name}, without a limiter, reaches {reached:.1f} dB{why}")
    return list(notes.values())


def _on_louder_bands(run: SimulationResult) -> list[str]:
    """Return a note if third octaves that can be heard beside the others are louder with control."""
    try:
        (centres, before), (_, after) = (third_octave_levels_db(one, run.fs) for one in (run.disturbance, run.error))
    except ValueError:  # none is below half of such a low rate
        return []
    power = 10 ** (np.atleast_2d(after + a_weighting_db(centres)) / 10)
    share = power / power.sum(axis=1, keepdims=True)  # at each microphone
    more = np.where(share > HEARD, after - before, 0.0).max(axis=0)
    louder = sorted(np.flatnonzero(more > LOUDER_DB), key=lambda band: -share[:, band].max())
    if not louder:
        return []
    each = zip(map(nominal_hz, centres), more, share.max(axis=0), strict=True)
    named = [f"{centre} Hz by {db:.1f} dB, which carries {percent(own, '.1f')}" for centre, db, own in each]
    named[louder[0]] += " of the A-weighted noise that remains"
    first = (named[band] for band in louder[:MOST_BANDS])
    return [
        f"{run.algorithm} makes {len(louder)} of {more.size} third octaves louder: {'; '.join(first)}"
        f"{'; and others' if len(louder) > MOST_BANDS else ''}."
    ]


def _cause(ceilings: Ceilings, want_db: float, is_later_than_filter: bool) -> str:
    """Return the cause by the first ceiling that does not reach what is wanted; what comes too late needs no longer filter."""
    if ceilings.coherence_db is not None and ceilings.coherence_db < want_db:
        return "coherence"
    if ceilings.filter_db < want_db:
        return "causality" if ceilings.time_db >= want_db or is_later_than_filter else "filter"
    return "amplifier" if ceilings.power_db < want_db else "adaptation"


def _band(d: np.ndarray, s: np.ndarray, fs: float) -> Band:
    """Return where the disturbance is, and which share of it the loudspeakers together hardly reach."""
    frequencies, powers = welch(np.atleast_2d(d), fs, nperseg=min(4096, d.shape[-1]))
    share = powers.sum(axis=0) / powers.sum()
    below = np.cumsum(share)
    low, high = (float(np.interp(edge, below, frequencies)) for edge in (0.05, 0.95))
    paths = s.reshape(-1, s.shape[-1])
    gain = np.sum([np.abs(frequency_response(one, frequencies, fs=fs)) ** 2 for one in paths], axis=0)
    inside = (frequencies >= low) & (frequencies <= high)
    mean = float(np.mean(gain[inside])) if np.any(inside) else float(gain.max())
    return Band(low, high, float(share[gain < 10 ** (WEAK_DB / 10) * mean].sum()))


def _levels(run: SimulationResult, pascal: Any) -> SoundLevels:
    sounds = pascal * run.disturbance, pascal * run.error
    before_dba, after_dba = (a_weighted_level_db(sound, run.fs) for sound in sounds)
    (centres, before), (_, after) = (third_octave_levels_db(sound, run.fs) for sound in sounds)
    return SoundLevels(before_dba, after_dba, centres, before, after)


def _a_weighted_db(signals: np.ndarray, fs: float) -> float:
    """Return the A-weighted level of all microphones together; NaN for a run that diverged."""
    levels = np.array(a_weighted_level_db(signals, fs, reference=1.0))
    return 10.0 * float(np.log10(np.sum(10 ** (levels / 10))))


def _figures(run: SimulationResult, limits: Limits, fs: float, settings: Settings) -> dict[str, Any]:
    """Return the figures of merit of a run and its settings; with several channels also of each microphone."""
    signals = (run.control_signal, run.error, run.disturbance)
    y, e, d = (np.atleast_2d(signal) if limits.several else signal for signal in signals)
    power = output_power(y)
    figures = {
        "noise_reduction_db": noise_reduction_db(e, d),
        "noise_reduction_dba": _a_weighted_db(d, fs) - _a_weighted_db(e, fs),
        "output_power": power,
        "of_rated_power": power / limits.rated_power,
        "worst_window": overshoot(y, limits.rated_power, fs, window_s=limits.window_s),
        "peak_control_signal": peak_control_signal(y, steady=1.0),
        "convergence_time_s": convergence_time_s(e, d, fs, window_s=NSE_WINDOW_S),
        "diverged_at_s": run.diverged_at_s,
        "settings": {key: float(settings[key]) for key in settings if key in CHOSEN},
    }
    if not limits.several:
        return figures
    return figures | {
        "noise_reduction_by_microphone_db": [noise_reduction_db(*pair) for pair in zip(e, d, strict=True)]
    }
