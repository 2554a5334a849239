r"""The verdict on an amplifier: enough or not, by how much, what limits, and what to change.

Every cause is found by a measured noise reduction. Each of the following can do no better than the one before it, but
for what a fit reaches by chance:

===================== ==============================================================================================
ceiling               what it may use
===================== ==============================================================================================
coherence             everything that the reference explains of the disturbance, the future included
time                  a filter of `n_taps` taps with as much time as it likes, and any power
filter                a filter of `n_taps` taps, in time, and any power
path                  the same, held back where the secondary path is not known well enough
power                 the same, within the rated power
run                   the controller itself, adapting, behind its limiter and a clipping amplifier
===================== ==============================================================================================

The first of them that does not reach the noise reduction wanted is the cause. All are taken over the steady second half
of the run.
"""

from __future__ import annotations

import json
import os
import textwrap
import threading
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import fftconvolve, lfilter, welch

from kfopc_filterpy import (
    FxLMS,
    HardClipAmplifier,
    LinearAmplifier,
    OutputPowerConstraint,
    SimulationResult,
    kf_opc,
    kf_pb,
    noise_reduction_db,
    output_power,
    simulate,
    suggest_settings,
)
from kfopc_filterpy._validate import as_channels, as_choice, as_count, as_nonnegative, as_positive, as_signal
from kfopc_filterpy.bounds import SuggestedSettings, budgeted_rated_power, coherence_bound
from kfopc_filterpy.bounds.wiener import (
    Correlations,
    Stretch,
    constrained_weights,
    full_stretch,
    loss_db,
    reduction_db,
    warn_of_loss,
)
from kfopc_filterpy.metrics import (
    a_weighted_level_db,
    convergence_time_s,
    overshoot,
    peak_control_signal,
    third_octave_levels_db,
)
from kfopc_filterpy.paths import causality_margin, frequency_response, guard_filter, path_taps, path_uncertainty
from kfopc_filterpy.paths.least_squares import correlation_matrix, cross_correlation
from kfopc_filterpy.paths.uncertainty import HALF_A_SAMPLE
from kfopc_filterpy.power import LoudspeakerRating, OutputLimits, output_limits

from .items import jsonable
from .registry import REGISTRY
from .scene import Runs, Scene, one_blas_thread
from .tuning import AllDivergedError, tune

SCHEMA_VERSION = 1
SCHEMA = Path(__file__).with_name("verdict.schema.json")
CAUSES = ("coherence", "causality", "filter", "path", "amplifier", "adaptation")
ALGORITHMS = ("KF-PB", "KF-OPC", "FxLMS")
LONGEST = 256
LOOK_AHEAD = (1 / 16, 1 / 8, 1 / 4, 1 / 2)  # of the taps
TUNED_ON_S = 5.0  # of the record, for FxLMS's step size
WEAK_DB = -20.0  # gain of the secondary path, over its mean in the noise's band, below which the loudspeaker is weak
MANY_TAPS = 192  # from which float32 pays
LEAST_STATE_NOISE = 3e-7  # over the initial variance, for float32, which rounds that by 6e-8
NEARLY_FREE = 1e6  # times the rated power: an amplifier without limits
CURVE = 2.0 ** np.arange(-6.0, 3.01, 0.5)  # rated powers of the figure, over the one that full control needs


@dataclass(frozen=True)
class Ceilings:
    """Noise reductions in dB that nothing beyond can reach, over the steady half; see `Assessment`.

    Attributes
    ----------
    coherence_db : float or None
        What the coherence of reference and disturbance allows; None if the disturbance was computed from the reference.
    time_db : float
        A filter that may look ahead, with any power.
    filter_db : float
        A filter of this length, with any power.
    path_db : float
        The same, held back where the secondary path is uncertain.
    power_db : float
        The same, within the rated power.
    """

    coherence_db: float | None
    time_db: float
    filter_db: float
    path_db: float
    power_db: float


@dataclass(frozen=True)
class Band:
    """Where the noise is, and whether the loudspeaker can play there.

    Attributes
    ----------
    low_hz, high_hz : float
        Frequencies between which 90 % of the disturbance's power lies.
    weak_share : float
        Share of the disturbance's power at frequencies at which the secondary path lies more than 20 dB below its mean
        power gain in that band.
    uncertain_share : float
        Share of the disturbance's power at frequencies at which the secondary path may be wrong by 100 % or more.
    """

    low_hz: float
    high_hz: float
    weak_share: float
    uncertain_share: float


@dataclass(frozen=True)
class Levels:
    """Sound levels without and with control; third-octave bands.

    Attributes
    ----------
    before_dba, after_dba : float
        A-weighted equivalent levels in dB re 20 µPa.
    centres_hz, before_db, after_db : ndarray, shape (n_bands,)
        Centres of third-octave bands in Hz, and their levels in dB re 20 µPa.
    """

    before_dba: float
    after_dba: float
    centres_hz: np.ndarray
    before_db: np.ndarray
    after_db: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class Assessment:
    """Verdict on a rating, made by `assess`; ``print(assessment)`` tells it.

    Attributes
    ----------
    enough : bool
        Whether the controller reached the noise reduction wanted.
    want_db, noise_reduction_db : float
        Noise reduction wanted, and the controller's over the steady half, in dB.
    limited_by : str or None
        What limits: "coherence", "causality", "filter" (its length), "path" (how well it is known), "amplifier" or
        "adaptation"; None if the rating is enough.
    advice : tuple of str
        What to change.
    notes : tuple of str
        Further remarks on the data.
    algorithm : str
        The controller that the verdict is on.
    limits : OutputLimits
        What the rating allows the control signal.
    ceilings : Ceilings
        Noise reductions that nothing can surpass, one after the other.
    bound_db : float
        The least error that any fixed filter of this length reaches within the rated power, as a noise reduction.
    unlimited_power : float
        Power that this filter takes without a limit.
    required_rated_power : float
        Rated power with which the bound reaches the noise reduction wanted; Inf if it is out of reach.
    expected_rated_power : float
        An estimate of the rated power that the controller needs: `required_rated_power`, times the power of the rating
        that its run took (by its worst window or its highest peak) over the one with which the bound reaches what the
        controller reached. Inf if it is out of reach.
    causality_margin_s : float or None
        Time by which the anti-noise is early; None without a primary path.
    helpful_delay_s : float or None
        Shortest extra time tried with which a filter of this length reaches the noise reduction wanted; None if none
        does, or if none is needed.
    band : Band
        Where the noise is.
    levels : Levels or None
        Sound levels, if the calibration is known.
    excursion_mm : float or None
        Largest excursion in the run, if a loudspeaker's rating has one.
    settings : SuggestedSettings
        Length and noise variances of the Kalman filters.
    figures : dict of str to dict
        Figures of merit of each algorithm.
    runs : dict of str to SimulationResult
        Run of each algorithm, from the moment it is switched on.
    curve : tuple of ndarray
        Rated powers, and the noise reduction in dB that is the bound for each.
    volts_per_unit, ohm : float or None
        Scale of the control signal and impedance, if a rating has them.
    fs : float
        Sample rate in Hz.
    """

    enough: bool
    want_db: float
    noise_reduction_db: float
    limited_by: str | None
    advice: tuple[str, ...]
    notes: tuple[str, ...]
    algorithm: str
    limits: OutputLimits
    ceilings: Ceilings
    bound_db: float
    unlimited_power: float
    required_rated_power: float
    expected_rated_power: float
    causality_margin_s: float | None
    helpful_delay_s: float | None
    band: Band
    levels: Levels | None
    excursion_mm: float | None
    settings: SuggestedSettings
    figures: Mapping[str, Mapping[str, float | None]]
    runs: Mapping[str, SimulationResult]
    curve: tuple[np.ndarray, np.ndarray]
    volts_per_unit: float | None
    ohm: float | None
    fs: float

    @property
    def verdict(self) -> str:
        """The verdict as one sentence."""
        answer = "Enough" if self.enough else "Not enough"
        missed = self.noise_reduction_db - self.want_db
        if not np.isfinite(missed):
            return f"{answer}: {self.algorithm} diverges with {self.power(self.limits.rated_power)}."
        return (
            f"{answer}: {self.algorithm} reaches {self.noise_reduction_db:.1f} dB with {self.power(self.limits.rated_power)}, "
            f"{abs(missed):.1f} dB {'more' if missed >= 0 else 'less'} than the {self.want_db:g} dB wanted."
        )

    @property
    def reason(self) -> str:
        """What limits, as one sentence; empty if the rating is enough."""
        return _REASONS[self.limited_by].format(**self._words) if self.limited_by else ""

    @cached_property
    def _words(self) -> dict[str, str]:
        c = self.ceilings
        numbers = {
            "want": self.want_db,
            "reached": self.noise_reduction_db,
            "coherence": np.nan if c.coherence_db is None else c.coherence_db,
            "time": c.time_db,
            "filter": c.filter_db,
            "path": c.path_db,
            "power": c.power_db,
        }
        return {name: f"{value:.1f} dB" for name, value in numbers.items()} | {
            "taps": str(self.settings.n_taps),
            "rated": self.power(self.limits.rated_power),
        }

    def power(self, rated_power: float) -> str:
        """Return a `rated_power` in words: in W if the impedance is known, else in squared units."""
        if self.watt_per_power is None:
            return f"a rated power of {rated_power:.3g}"
        return f"{rated_power * self.watt_per_power:.3g} W into {self.ohm:g} ohm"

    @property
    def watt_per_power(self) -> float | None:
        """Watts of a mean square of 1; None if the impedance is not known."""
        return None if self.ohm is None or self.volts_per_unit is None else self.volts_per_unit**2 / self.ohm

    def __repr__(self) -> str:
        lines = [self.verdict, self.reason, *self.advice]
        return "\n".join(line for text in lines if text for line in textwrap.wrap(text, 110))

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict in strict JSON's types, as `verdict.schema.json` describes it."""
        loudspeaker = {"volts_per_unit": self.volts_per_unit, "ohm": self.ohm}
        levels = None if self.levels is None else vars(self.levels)
        return jsonable(
            {
                "schema_version": SCHEMA_VERSION,
                "enough": self.enough,
                "verdict": self.verdict,
                "limited_by": self.limited_by,
                "reason": self.reason,
                "advice": list(self.advice),
                "notes": list(self.notes),
                "want_db": self.want_db,
                "noise_reduction_db": self.noise_reduction_db,
                "algorithm": self.algorithm,
                "rating": {
                    "rated_power": self.limits.rated_power,
                    "amplitude_limit": self.limits.amplitude_limit,
                    "window_s": self.limits.window_s,
                    "decided_by": self.limits.decided_by,
                    **loudspeaker,
                },
                "ceilings": vars(self.ceilings),
                "bound_db": self.bound_db,
                "unlimited_power": self.unlimited_power,
                "required_rated_power": self.required_rated_power,
                "expected_rated_power": self.expected_rated_power,
                "causality_margin_s": self.causality_margin_s,
                "helpful_delay_s": self.helpful_delay_s,
                "band": vars(self.band),
                "levels": levels,
                "excursion_mm": self.excursion_mm,
                "settings": {"n_taps": self.settings.n_taps, **self.settings.settings},
                "algorithms": self.figures,
                "fs": self.fs,
            },
            "verdict",
        )

    def write(self, folder: str | os.PathLike[str]) -> Path:
        """Write verdict.html, verdict.json, figures and sounds into a `folder`, and return the path of the page.

        The page needs no other file. All sounds have one scale: what is louder in a file is louder at the microphone.

        Raises
        ------
        OSError
            The folder cannot be written.
        ModuleNotFoundError
            A library of the extra `studies` is missing.
        """
        from .assessment_page import write_assessment

        return write_assessment(self, folder)

    @property
    def json(self) -> str:
        """`to_dict` as text."""
        return json.dumps(self.to_dict(), allow_nan=False, ensure_ascii=False, indent=2)


_REASONS = {
    "coherence": "Coherence limits: the reference explains {coherence} of the disturbance at most, whatever the "
    "controller and the amplifier.",
    "causality": "Causality limits: with more time a filter of {taps} taps reaches {time}, in time only {filter}, "
    "with any power.",
    "filter": "The filter limits: {taps} taps reach {filter} with any power, and more time does not help.",
    "path": "The secondary path limits: a filter of {taps} taps reaches {filter} with any power, but only {path} if it "
    "must not make the noise louder within the path's uncertainty.",
    "amplifier": "The amplifier limits: with any power {path} are in reach, with {rated} {power} for a fixed filter.",
    "adaptation": "The adaptation limits: a fixed filter reaches {power} within the rated power, the controller {reached}, "
    "and more power does not help it.",
}


@one_blas_thread()
def assess(
    noise: Any,
    primary: Any,
    secondary: Any,
    *,
    rating: Any,
    fs: float,
    disturbance: Any = None,
    want_db: float = 6.0,
    algorithm: str = "KF-PB",
    beside: Sequence[str] | None = None,
    n_taps: int | None = None,
    memory_s: float = 0.25,
    secondary_path_uncertainty: Any = HALF_A_SAMPLE,
    pascal_per_unit: float | None = None,
    switch_on_s: float | None = None,
    bar: Any = None,
) -> Assessment:
    """Return the verdict on an amplifier: whether it buys a noise reduction, what limits, and what to change.

    One reference, one loudspeaker and one error microphone. The offsets of the recordings are subtracted, because no
    loudspeaker plays them.

    Parameters
    ----------
    noise : array_like, shape (n_samples,)
        Recording of the reference microphone, with a silent loudspeaker.
    primary : array_like, shape (n_path,), or control.TransferFunction, optional
        Impulse response from the reference to the error microphone. None if there is a `disturbance`.
    secondary : array_like, shape (n_path,), or control.TransferFunction
        Impulse response from the control signal to the error microphone.
    rating : float, AmplifierRating, LoudspeakerRating, or a sequence of them
        What the amplifier and the loudspeaker bear; a number is a rated power in squared units of the control signal.
    fs : float
        Sample rate in Hz of all of them.
    disturbance : array_like, shape (n_samples,), optional
        Recording of the error microphone, made together with `noise`. It contains what the reference does not explain,
        so that the coherence can be checked. By default it is computed by the primary path.
    want_db : float, default 6
        Noise reduction wanted in dB.
    algorithm : {"KF-PB", "KF-OPC", "FxLMS"}, default "KF-PB"
        Controller that the verdict is on. It has a limiter, which keeps the rating in every window.
    beside : sequence of str, optional
        Algorithms to run beside it, without a limiter, as published; by default the other two.
    n_taps : int, optional
        Taps of the control filter; by default `suggest_settings` finds them, at most 256.
    memory_s : float, default 0.25
        Memory of the Kalman filters in s.
    secondary_path_uncertainty : PathTolerance, float or array_like, optional
        How far the true secondary path may differ from `secondary`, see `paths.path_uncertainty`; by default half a
        sample of delay. None: it is exact.
    pascal_per_unit : float, optional
        Sound pressure at the error microphone in Pa for a value of 1. With it, sound levels are computed.
    switch_on_s : float, optional
        Time in s at which the control is switched on; by default 0.5 s, or a tenth of a shorter record.
    bar : tqdm bar, optional
        Bar that advances with the samples that are run; its total is set, and it is described by what is going on.

    Returns
    -------
    Assessment
        The verdict; its ``print`` tells it, `to_dict` gives it as JSON, `write` as a page with figures and sounds.

    Raises
    ------
    TypeError, ValueError
        Signals that are not finite, silent, too short for the filter, or of different lengths; neither a primary path nor
        a disturbance; a rating that does not limit the mean power; an unknown algorithm.

    Notes
    -----
    The cause is the first ceiling that does not reach `want_db`; see `Ceilings`. If all of them do and the run does not,
    it is repeated with a million times the rated power: the amplifier is the cause if that reaches it (its peaks and its
    short windows cost more than its mean power), otherwise the adaptation is.

    The algorithms run side by side, on as many cores as there are. The numerical libraries get one thread meanwhile if
    threadpoolctl is installed (it is in the extra `studies`): with filters of this size, more of them slow each other down.

    If a loudspeaker's rating has an excursion, the rated power is the largest at which the best fixed filter's control
    signal keeps it.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.bench import assess
    >>> from kfopc_filterpy.power import AmplifierRating
    >>> from kfopc_filterpy.signals import band_limited_noise
    >>> noise = band_limited_noise((100, 1000), 4.0, fs=8000, rng=1)
    >>> primary, secondary = np.eye(64)[40], np.eye(16)[8]
    >>> verdict = assess(noise, primary, secondary, rating=AmplifierRating(ohm=8, sine_watt=0.02), fs=8000, n_taps=64)
    >>> print(verdict.enough, verdict.limited_by)
    False amplifier
    """
    fs = as_positive(fs, "fs", unit="Hz")
    x, d, s = recorded_signals(noise, primary, secondary, disturbance, fs)
    want_db = as_nonnegative(want_db, "want_db", unit="dB")
    as_choice(algorithm, "algorithm", ALGORITHMS)
    others = ALGORITHMS if beside is None else [as_choice(name, "beside", ALGORITHMS) for name in beside]
    limits = output_limits(rating)
    if pascal_per_unit is not None:
        as_positive(pascal_per_unit, "pascal_per_unit", unit="Pa")
    start = switch_on_sample(switch_on_s, fs, x.size)
    delta = path_uncertainty(secondary_path_uncertainty, s)
    names = [algorithm, *(name for name in others if name != algorithm)]
    notes: list[str] = []
    _announce(bar, len(names) * (x.size - start), "bounds")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", np.exceptions.RankWarning)
        settings = suggest_settings(
            x[start:],
            d[start:],
            s,
            fs=fs,
            memory_s=memory_s,
            n_taps=None if n_taps is None else as_count(n_taps, "n_taps"),
            max_taps=LONGEST,
        )
        bounds = FixedFilters(x[start:], d[start:], s, settings.n_taps, fs, delta)
        limits = _with_excursion(limits, rating, bounds)
        official = bounds.within(limits.rated_power)
        required = bounds.needed(want_db)
    if any(issubclass(warning.category, np.exceptions.RankWarning) for warning in caught):
        notes.append("The reference is so narrow-band that larger weights could do better than the bound.")

    plan = _Plan(x, d, s, fs, start, limits, settings, secondary_path_uncertainty, bar)
    _announce(bar, 0, ", ".join(names))
    runs: dict[str, SimulationResult] = {}
    for name, outcome in zip(names, Runs().map(lambda name: plan.outcome(name, name == algorithm), names), strict=True):
        if isinstance(outcome, SimulationResult):
            runs[name] = outcome
        elif name == algorithm:
            raise ValueError(f"{outcome}; use another algorithm") from outcome
        else:
            notes.append(f"{name} is left out: {outcome}.")
    run = runs[algorithm]
    reached = _reduction(run)
    ceilings = Ceilings(
        coherence_db=None if disturbance is None else max(_coherence_db(bounds.x, bounds.d, fs), bounds.time_db),
        time_db=bounds.time_db,
        filter_db=bounds.filter_db,
        path_db=bounds.path_db,
        power_db=bounds.guarded(limits.rated_power)[1],
    )
    cause = None if reached >= want_db else _cause(ceilings, want_db)
    if cause == "adaptation" and _reduction(plan.run(algorithm, limited=True, freed=NEARLY_FREE)) >= want_db:
        cause = "amplifier"
    if disturbance is None:
        notes.append(
            "The disturbance was computed from the reference, so the coherence is not checked: record both microphones "
            "together and give the disturbance."
        )
    margin = None if primary is None else causality_margin(path_taps(primary, fs=fs), s, fs=fs).margin_s
    scale = next((one for one in _each(rating) if hasattr(one, "volts_per_unit")), None)
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
        bound_db=official,
        unlimited_power=float(bounds.free.control_power),
        required_rated_power=required,
        expected_rated_power=required * _price(_taken(run, limits), bounds.needed(reached)),
        causality_margin_s=margin,
        helpful_delay_s=bounds.helpful_delay_s(want_db) if bounds.filter_db < want_db else None,
        band=_band(bounds.d, s, delta, fs),
        levels=None if pascal_per_unit is None else _levels(run, pascal_per_unit),
        excursion_mm=_excursion_mm(rating, run),
        settings=settings,
        figures={name: _figures(one, limits, fs) for name, one in runs.items()},
        runs=runs,
        curve=bounds.curve(limits.rated_power),
        volts_per_unit=None if scale is None else scale.volts_per_unit,
        ohm=None if scale is None else scale.ohm,
        fs=fs,
    )
    return replace(assessment, advice=tuple(_advice(assessment)))


def recorded_signals(noise: Any, primary: Any, secondary: Any, disturbance: Any, fs: float) -> tuple[np.ndarray, ...]:
    """Return reference, disturbance and secondary path, checked, the recordings without their offsets."""
    for value, name in ((noise, "noise"), (disturbance, "disturbance")):
        if value is not None and as_channels(value, name).ndim == 2 and len(value) > 1:
            raise ValueError(
                f"{name} must have one channel, got {len(value)}; choose one. For several loudspeakers and microphones, "
                "power_constrained_wiener gives the bound and simulate runs the controllers"
            )
    x = as_signal(np.ravel(as_channels(noise, "noise")), "noise")
    x = x - x.mean()
    s = path_taps(secondary, fs=fs, name="secondary")
    if disturbance is not None:
        d = as_signal(np.ravel(as_channels(disturbance, "disturbance")), "disturbance", length=x.size)
        d = d - d.mean()
    elif primary is None:
        raise ValueError("primary must be given unless there is a disturbance: what arrives at the error microphone?")
    else:
        d = fftconvolve(x, path_taps(primary, fs=fs, name="primary"))[: x.size]
    for signal, name in ((x, "noise"), (d, "disturbance"), (s, "secondary")):
        if not np.any(signal):
            raise ValueError(f"{name} must not be silent: every value is {'the same' if name == 'noise' else '0'}")
    return x, d, s


def switch_on_sample(switch_on_s: float | None, fs: float, n_samples: int) -> int:
    duration = n_samples / fs
    time = min(0.5, 0.1 * duration) if switch_on_s is None else as_nonnegative(switch_on_s, "switch_on_s", unit="s")
    if time >= duration:
        raise ValueError(f"switch_on_s must be within the {duration:g} s of the noise, got {time:g} s")
    return round(time * fs)


class FixedFilters:
    """What fixed filters reach on the steady half of a run."""

    def __init__(self, x: np.ndarray, d: np.ndarray, s: np.ndarray, n_taps: int, fs: float, delta: np.ndarray) -> None:
        past = s.size + n_taps - 2  # samples that fill the delay lines
        first = max(x.size // 2 - past, 0)
        self.x, self.d, self.s, self.n_taps, self.fs = x[first:], d[first:], s, n_taps, fs
        self.stretch = full_stretch(self.x, self.d, s, n_taps)
        self.correlations = self.stretch.correlations()
        self.free = self.stretch.solution(self.correlations.weights())
        self.filter_db = self.free.noise_reduction_db
        self._guarded = self._held_back(guard_filter(delta)) if np.any(delta) else self.correlations
        self.path_db = self.stretch.solution(self._guarded.weights()).noise_reduction_db
        ahead = sorted({round(share * n_taps) for share in LOOK_AHEAD} - {0})
        self.ahead = {samples: self._ahead_db(samples) for samples in ahead}
        self.time_db = max([self.filter_db, *self.ahead.values()])

    def _held_back(self, guard: np.ndarray) -> Correlations:
        """Return the correlations with the penalty of the guard, E[(v * W * x')^2]."""
        penalised = lfilter(guard, 1.0, self.stretch.filtered)
        penalty = correlation_matrix(penalised, self.n_taps, self.n_taps - 1)
        return replace(self.correlations, filtered=self.correlations.filtered + penalty)

    def _ahead_db(self, samples: int) -> float:
        """Return the noise reduction of a filter that knows the reference so many samples ahead."""
        own = self.stretch
        later = Stretch(own.x[samples:], own.filtered[samples:], own.d[: own.d.size - samples], self.n_taps)
        correlations = replace(self.correlations, cross=cross_correlation(later.d, later.filtered))
        return later.solution(correlations.weights()).noise_reduction_db

    def helpful_delay_s(self, want_db: float) -> float | None:
        """Return the shortest time ahead tried that is enough."""
        return next((samples / self.fs for samples, reached in self.ahead.items() if reached >= want_db), None)

    def guarded(self, rated_power: float) -> tuple[np.ndarray, float]:
        """Return the filter within the rated power that is held back by the guard, and its noise reduction in dB."""
        weights, _ = constrained_weights(self.stretch, self._guarded, rated_power)
        return weights, self.stretch.solution(weights).noise_reduction_db

    def within(self, rated_power: float) -> float:
        """Return the bound within the rated power, as a noise reduction in dB; warn if larger weights could do better."""
        own = self.correlations
        weights, penalty = constrained_weights(self.stretch, own, rated_power)
        warn_of_loss(max(loss_db(self.stretch, own, weights, penalty), loss_db(self.stretch, own, self.free.weights)))
        return self.stretch.solution(weights).noise_reduction_db

    def needed(self, reduction_db: float) -> float:
        """Return the rated power with which the bound reaches a noise reduction; Inf if none does, 0 below 0 dB."""
        if reduction_db <= 0:
            return 0.0
        found = budgeted_rated_power(
            reduction_db, self.x, self.d, self.s, self.n_taps, fs=self.fs, beyond="inf"
        ).rated_power
        return float(found)

    def curve(self, rated_power: float) -> tuple[np.ndarray, np.ndarray]:
        """Return rated powers about the given one and the one that full control needs, and the bound for each."""
        powers = np.unique([*CURVE * self.free.control_power, rated_power, rated_power / 2, rated_power * 2])
        own, left = self.correlations, []
        for power in powers:
            weights, _ = constrained_weights(self.stretch, own, float(power))
            left.append(self.free.disturbance_power - weights @ (2 * own.cross - own.filtered @ weights))
        return powers, np.array([reduction_db(one, self.free.disturbance_power) for one in left])


def _with_excursion(limits: OutputLimits, rating: Any, bounds: FixedFilters) -> OutputLimits:
    """Return limits with the largest rated power at which the best filter keeps the excursion of every loudspeaker."""
    from scipy.optimize import brentq

    for one in _each(rating):
        if not isinstance(one, LoudspeakerRating) or one.x_max_mm is None:
            continue

        def excess(log_power: float, one: LoudspeakerRating = one) -> float:
            y = bounds.stretch.control_signal(bounds.guarded(float(np.exp(log_power)))[0])
            return float(np.log(np.mean(y**2) / one.excursion_rated_power(y, bounds.fs)))

        high = np.log(limits.rated_power)
        if excess(high) <= 0:
            continue
        low = high - 1.0
        while excess(low) > 0:
            low -= 2.0
        power = float(np.exp(brentq(excess, low, high, xtol=1e-4)))
        limits = replace(limits, rated_power=power, decided_by="loudspeaker's excursion")
    return limits


@dataclass
class _Plan:
    """How the controllers of an assessment are made and run."""

    x: np.ndarray
    d: np.ndarray
    s: np.ndarray
    fs: float
    start: int
    limits: OutputLimits
    settings: SuggestedSettings
    uncertainty: Any
    bar: Any
    lock: Any = field(default_factory=threading.Lock)

    def outcome(self, name: str, limited: bool) -> SimulationResult | AllDivergedError:
        """Return an algorithm's run, or why there is none."""
        try:
            return self.run(name, limited=limited)
        except AllDivergedError as error:
            return error

    def advance(self, samples: int) -> None:
        """Move the bar, which several threads share."""
        with self.lock:
            self.bar.update(samples)

    def run(self, name: str, *, limited: bool, freed: float = 1.0) -> SimulationResult:
        """Run an algorithm, behind a limiter or not; `freed` multiplies the rating's power."""
        limits = self.limits
        if freed != 1.0:
            _announce(self.bar, self.x.size - self.start, f"{name}, unlimited")
            peak = limits.amplitude_limit
            limits = replace(
                limits, rated_power=freed * limits.rated_power, amplitude_limit=peak and float(np.sqrt(freed)) * peak
            )
        peak = limits.amplitude_limit
        return simulate(
            self.controller(name, limits, limited),
            self.x,
            disturbance=self.d,
            secondary_path=self.s,
            fs=self.fs,
            amplifier=LinearAmplifier() if peak is None else HardClipAmplifier(peak),
            rated_power=limits.rated_power,
            switch_on_s=self.start / self.fs,
            progress=None if self.bar is None else self.advance,
        )

    def controller(self, name: str, limits: OutputLimits, limited: bool) -> Any:
        """Return a fresh controller."""
        limiter = limits.limiter(self.fs) if limited else None
        n_taps = self.settings.n_taps
        noises: dict[str, Any] = {**self.settings.settings, "dtype": self.precision}
        if name == "FxLMS":
            return FxLMS(n_taps, self.s, step_size=self.step_size, limiter=limiter)
        if name == "KF-OPC":
            constraint = OutputPowerConstraint(limits.rated_power, fs=self.fs)
            return kf_opc(n_taps, self.s, constraint=constraint, limiter=limiter, **noises)
        return kf_pb(
            n_taps,
            self.s,
            rated_power=limits.rated_power,
            fs=self.fs,
            limiter=limiter,
            secondary_path_uncertainty=self.uncertainty,
            form="direct",
            **noises,
        )

    @property
    def precision(self) -> type:
        """float32 for long filters, which halves the time, if the state noise is well above its rounding of P."""
        settings = self.settings
        is_safe = settings.state_noise > LEAST_STATE_NOISE * settings.initial_variance
        return np.float32 if is_safe and settings.n_taps >= MANY_TAPS else np.float64

    @cached_property
    def step_size(self) -> float:
        """Step size of FxLMS by the rule of the studies, on the start of the record."""
        excerpt = slice(0, self.start + round(TUNED_ON_S * self.fs))
        scene = recorded_scene(
            self.x[excerpt], self.d[excerpt], self.s, self.fs, self.start, self.limits, self.settings
        )
        return REGISTRY["FxLMS"].value(scene, tune(Runs(), scene, ["FxLMS"])["FxLMS"].setting)


def recorded_scene(
    x: np.ndarray,
    d: np.ndarray,
    s: np.ndarray,
    fs: float,
    start: int,
    limits: OutputLimits,
    settings: SuggestedSettings,
    unconstrained_power: float = 1.0,
) -> Scene:
    """Return a scene of recorded signals as they are, the control switched on at sample `start`."""
    peak = limits.amplitude_limit
    return Scene(
        fs=fs,
        secondary=s,
        references=[x],
        disturbances=[d],
        rated_power=limits.rated_power,
        n_taps=settings.n_taps,
        sensor_noise_std=0.0,
        switch_on_s=start / fs,
        nse_window_s=0.005,
        amplifier=None if peak is None else HardClipAmplifier(peak),
        measurement_noise=settings.measurement_noise,
        initial_variance=settings.initial_variance,
        unconstrained_power=unconstrained_power,
        seeds=[0],
    )


def _announce(bar: Any, samples: int, description: str) -> None:
    """Add samples to a bar's total, and say what begins."""
    if bar is not None:
        bar.total = (bar.total or 0) + samples
        bar.set_description(description)


def _each(rating: Any) -> list[Any]:
    return list(rating) if isinstance(rating, list | tuple) else [rating]


def _reduction(run: SimulationResult) -> float:
    """Return the noise reduction of a run in dB; -Inf if it diverged."""
    reached = noise_reduction_db(run.error, run.disturbance)
    return -np.inf if np.isnan(reached) else reached


def _taken(run: SimulationResult, limits: OutputLimits) -> float:
    """Return the least rated power, with limits in proportion, that would have left the run as it is."""
    worst = overshoot(run.control_signal, limits.rated_power, run.fs, window_s=limits.window_s)
    peak = peak_control_signal(run.control_signal, steady=1.0)
    of_peak = 0.0 if limits.amplitude_limit is None else (peak / limits.amplitude_limit) ** 2
    share = max(worst, of_peak)
    return limits.rated_power * (min(share, 1.0) if np.isfinite(share) else 1.0)


def _price(taken: float, of_the_bound: float) -> float:
    """Return how many times the power of the bound the controller takes, at least 1; Inf if it reached nothing."""
    return max(taken / of_the_bound, 1.0) if of_the_bound > 0 else np.inf


def _cause(ceilings: Ceilings, want_db: float) -> str:
    """Return the cause by the first ceiling that does not reach what is wanted."""
    if ceilings.coherence_db is not None and ceilings.coherence_db < want_db:
        return "coherence"
    if ceilings.filter_db < want_db:
        return "causality" if ceilings.time_db >= want_db else "filter"
    if ceilings.path_db < want_db:
        return "path"
    return "amplifier" if ceilings.power_db < want_db else "adaptation"


def _coherence_db(x: np.ndarray, d: np.ndarray, fs: float) -> float:
    """Return the noise reduction that the coherence allows; segments as long as sixteen of them allow."""
    segment = int(2 ** np.clip(np.floor(np.log2(max(x.size / 16, 8))), 3, 14))
    return coherence_bound(x, d, fs, segment=segment).overall_db


def _band(d: np.ndarray, s: np.ndarray, delta: np.ndarray, fs: float) -> Band:
    """Return where the disturbance is, and which share of it the loudspeaker hardly reaches."""
    frequencies, powers = welch(d, fs, nperseg=min(4096, d.size))
    share = powers / powers.sum()
    below = np.cumsum(share)
    low, high = (float(np.interp(edge, below, frequencies)) for edge in (0.05, 0.95))
    gain = np.abs(frequency_response(s, frequencies, fs=fs)) ** 2
    inside = (frequencies >= low) & (frequencies <= high)
    mean = float(np.mean(gain[inside])) if np.any(inside) else float(gain.max())
    wrong = np.interp(frequencies, np.linspace(0.0, fs / 2, delta.size), delta) >= 1.0
    return Band(low, high, float(share[gain < 10 ** (WEAK_DB / 10) * mean].sum()), float(share[wrong].sum()))


def _levels(run: SimulationResult, pascal: float) -> Levels:
    before, after = pascal * run.disturbance, pascal * run.error
    centres, bands = third_octave_levels_db(before, run.fs)
    return Levels(
        a_weighted_level_db(before, run.fs),
        a_weighted_level_db(after, run.fs),
        centres,
        bands,
        third_octave_levels_db(after, run.fs)[1],
    )


def _excursion_mm(rating: Any, run: SimulationResult) -> float | None:
    """Return the largest excursion of a run, if a rating knows it."""
    moved = [
        float(np.abs(one.displacement_mm(np.nan_to_num(run.amplifier_output), run.fs)).max())
        for one in _each(rating)
        if isinstance(one, LoudspeakerRating) and one.x_max_mm is not None
    ]
    return max(moved, default=None)


def _figures(run: SimulationResult, limits: OutputLimits, fs: float) -> dict[str, float | None]:
    """Return the figures of merit of a run."""
    power = output_power(run.control_signal)
    return {
        "noise_reduction_db": noise_reduction_db(run.error, run.disturbance),
        "output_power": power,
        "of_rated_power": power / limits.rated_power,
        "worst_window": overshoot(run.control_signal, limits.rated_power, fs, window_s=limits.window_s),
        "peak_control_signal": peak_control_signal(run.control_signal, steady=1.0),
        "convergence_time_s": convergence_time_s(run.error, run.disturbance, fs, window_s=0.1),
        "diverged_at_s": run.diverged_at_s,
    }


def _advice(verdict: Assessment) -> list[str]:
    """Return what to change, in sentences."""
    want = f"{verdict.want_db:g} dB"
    needed = verdict.expected_rated_power
    if verdict.enough:
        return (
            [f"About {verdict.power(needed)} would do for {want}."]
            if np.isfinite(needed) and needed < 0.9 * verdict.limits.rated_power
            else []
        )
    if verdict.limited_by == "coherence":
        return [
            "Move the reference microphone closer to the source, or add one for each source; shield it from wind and "
            "other noise."
        ]
    if verdict.limited_by == "causality":
        delay = verdict.helpful_delay_s
        late = f"With {1e3 * delay:.2g} ms more" if delay is not None else "With more time"
        return [
            f"{late} between the reference microphone and the loudspeaker, the same filter reaches {want}: move the "
            "microphone towards the source or the loudspeaker towards the error microphone, or shorten the latency of the "
            "electronics."
        ]
    if verdict.limited_by == "filter":
        return [
            f"Try a filter longer than {verdict.settings.n_taps} taps. If that gains nothing, the loudspeaker does not "
            "reach what is left of the noise, or it needs to be closer to the microphone."
        ]
    if verdict.limited_by == "path":
        return [
            f"{verdict.band.uncertain_share:.0%} of the noise lies where the path may be wrong by 100 %. Measure the "
            "secondary path again and state a smaller uncertainty, or use a higher sample rate."
        ]
    if verdict.limited_by == "adaptation":
        return [
            "Try a longer memory for a steady noise, a shorter one for a noise that changes, or a longer record: the "
            "controller may not have settled."
        ]
    advice = [
        f"About {verdict.power(needed)} would do for {want}, an estimate from the bound, and from what this controller loses to it."
    ]
    if not np.isfinite(needed):
        advice = [
            f"A fixed filter would need {verdict.power(verdict.required_rated_power)} for {want}; this controller did "
            "not reduce the noise at all. Try another memory."
        ]
    if verdict.band.weak_share > 0.1:
        advice.append(
            f"{verdict.band.weak_share:.0%} of the noise lies where the loudspeaker is weak: a loudspeaker for "
            f"{verdict.band.low_hz:.0f} to {verdict.band.high_hz:.0f} Hz takes less power."
        )
    return advice
