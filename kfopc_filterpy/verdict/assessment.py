r"""The verdict on an amplifier: enough or not, by how much, what limits, and what to change.

Every cause is found by a measured noise reduction. Each of the following reaches no more than the one before it, apart
from small differences by chance:

===================== ==============================================================================================
ceiling               what it may use
===================== ==============================================================================================
coherence             everything that the reference explains of the disturbance, the future included
time                  a filter of `n_taps` taps with as much time as it likes, and any power
filter                a filter of `n_taps` taps, in time, and any power
power                 the same, within the rated power, which is a mean: its peaks are not clipped
run                   the controller itself, adapting, behind its limiter and a clipping amplifier
===================== ==============================================================================================

The first of them that does not reach the noise reduction wanted is the cause. All are taken over the steady second half
of the run.
"""

from __future__ import annotations

import json
import math
import os
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult, __version__
from kfopc_filterpy.bounds import SuggestedSettings

from .._types import NumberOrArray
from .._writing import jsonable, prepare_folder, replacing_files
from ..paths import FeedbackMargin
from ..power.ratings import SINE_CREST
from .fixed_filters import longest_filter
from .limits import Limits, watt_per_power

SCHEMA_VERSION = 1
SCHEMA = Path(__file__).with_name("verdict.schema.json")
ROOM_FOR_RESPONSE = 1.25  # times the time that a control filter must last
MOST_TAPS = 1024  # that advice names: longer filters take very long
RATE_OF_BAND = 2.5  # least sample rate over the highest frequency of the noise
CAUSES = ("coherence", "causality", "filter", "amplifier", "adaptation")


@dataclass(frozen=True)
class Ceilings:
    """Noise reductions in dB that nothing beyond can reach, over the steady half; see `Assessment`.

    Attributes
    ----------
    coherence_db : float or None
        What the coherence of reference and disturbance allows; None with feedback, or if the disturbance was computed
        from the reference without sensor noise.
    time_db : float
        A filter that may look ahead, with any power.
    filter_db : float
        A filter of this length, with any power.
    power_db : float
        The same, within the rated power; its peaks are not clipped.
    """

    coherence_db: float | None
    time_db: float
    filter_db: float
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
    """

    low_hz: float
    high_hz: float
    weak_share: float


@dataclass(frozen=True)
class SoundLevels:
    """Sound levels without and with control; third-octave bands.

    Attributes
    ----------
    before_dba, after_dba : float, or ndarray of shape (K,)
        A-weighted equivalent levels in dB re 20 µPa; of each microphone with several channels.
    centres_hz : ndarray, shape (n_bands,)
        Centres of third-octave bands in Hz.
    before_db, after_db : ndarray, shape (n_bands,) or (K, n_bands)
        Their levels in dB re 20 µPa.
    """

    before_dba: Any
    after_dba: Any
    centres_hz: np.ndarray
    before_db: np.ndarray
    after_db: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class Assessment:
    """Verdict on a rating, made by `assess`; ``print(assessment)`` tells it.

    With several channels, noise reductions are those of all microphones together, and the powers are (J,).

    Attributes
    ----------
    enough : bool
        Whether the controller reached the noise reduction wanted.
    want_db, noise_reduction_db : float
        Noise reduction wanted, and the controller's over the steady half, in dB.
    limited_by : str or None
        What limits: "coherence", "causality", "filter" (its length), "amplifier" or
        "adaptation"; None if the rating is enough.
    advice : tuple of str
        What to change.
    notes : tuple of str
        Further remarks on the data.
    algorithm : str
        The controller that the verdict is on.
    limits : Limits
        What the rating allows the control signal; `each` has the limits of each loudspeaker.
    ceilings : Ceilings
        Noise reductions that nothing can surpass, one after the other.
    unlimited_power : float or ndarray, shape (J,)
        Power that this filter takes without a limit.
    required_rated_power : float or ndarray, shape (J,)
        Rated power with which the bound reaches the noise reduction wanted; Inf if it is out of reach. With several
        loudspeakers in the proportions of their ratings.
    least_rated_power : float or ndarray, shape (J,)
        Least rated power with which the controller's run reaches the noise reduction wanted, found by runs to 1 %; the
        peaks that the rating allows are changed with it. Inf if none does.
    unclipped_db : float or None
        Noise reduction of the controller's run with the same rated power and an amplifier that does not clip; None unless
        the amplifier is the cause although the bound within the rated power reaches the noise reduction wanted.
    causality_margin_s : float or None
        Time by which the anti-noise is early; None without a primary path.
    helpful_delay_s : float or None
        Shortest extra time tried with which a filter of this length reaches the noise reduction wanted; None if none
        does, or if none is needed.
    band : Band
        Where the noise is.
    levels : SoundLevels or None
        Sound levels, if the calibration is known.
    settings : SuggestedSettings
        Length and noise variances of the Kalman filters.
    figures : dict of str to dict
        Figures of merit of each algorithm.
    runs : dict of str to SimulationResult
        Run of each algorithm, from the moment it is switched on.
    curve : tuple of ndarray
        Rated powers, and the noise reduction in dB that is the bound for each. With several loudspeakers multiples of
        all ratings.
    volts_per_unit, ohm : float, ndarray of shape (J,), or None
        Scale of the control signal and impedance, if a rating has them.
    fs : float
        Sample rate in Hz.
    channels : tuple of int or None
        Numbers of references, loudspeakers and microphones; None if there is one of each.
    pascal_per_unit : float, array_like of shape (K,), or None
        Sound pressure at the error microphones for a value of 1, if the calibration is known.
    switch_on_s : float
        Time of the recording in s at which the control is switched on.
    response_s : float or None
        Time from the first sound of a loudspeaker until the primary path has delivered the energy that must be removed:
        the control filter has to be so long. None without a primary path.
    feedback : bool
        Whether there is no reference microphone.
    loop : FeedbackMargin or None
        Stability of the settled loop of a feedback or hybrid controller; None otherwise, or if the run diverged.
    timing_fault : str or None
        What is wrong with the timing of the recordings (clocks that differ, lost samples, swapped files), if coherence
        or causality limits and they show it.
    origin : dict of str to str
        What the page says of where it comes from: the command, and each file.
    """

    enough: bool
    want_db: float
    noise_reduction_db: float
    limited_by: str | None
    advice: tuple[str, ...]
    notes: tuple[str, ...]
    algorithm: str
    limits: Limits
    ceilings: Ceilings
    unlimited_power: Any
    required_rated_power: Any
    least_rated_power: Any
    unclipped_db: float | None
    causality_margin_s: float | None
    helpful_delay_s: float | None
    band: Band
    levels: SoundLevels | None
    settings: SuggestedSettings
    figures: Mapping[str, Mapping[str, Any]]
    runs: Mapping[str, SimulationResult]
    curve: tuple[np.ndarray, np.ndarray]
    volts_per_unit: Any
    ohm: Any
    fs: float
    channels: tuple[int, int, int] | None = None
    pascal_per_unit: Any = None
    switch_on_s: float = 0.0
    response_s: float | None = None
    feedback: bool = False
    loop: FeedbackMargin | None = None
    timing_fault: str | None = None
    origin: Mapping[str, str] = field(default_factory=dict)

    @property
    def bound_db(self) -> float:
        """The least error that any fixed filter of this length reaches within the rated power, as a noise reduction."""
        return self.ceilings.power_db

    @property
    def verdict(self) -> str:
        """The verdict as one sentence."""
        answer = "Enough" if self.enough else "Not enough"
        missed = self.noise_reduction_db - self.want_db
        if not np.isfinite(missed):
            return f"{answer}: {self.algorithm} diverges with {self.power(self.limits.rated_power)}."
        want = f"{self.want_db:g} dB wanted"
        if round(missed, 1):
            compared = f"{abs(missed):.1f} dB {'more' if missed > 0 else 'less'} than the {want}"
        else:
            compared = f"just {'enough for' if missed >= 0 else 'short of'} the {want}"
        weighted = _db(self.figures[self.algorithm]["noise_reduction_dba"])
        return (
            f"{answer}: {self.algorithm} reaches {_db(self.noise_reduction_db)} ({weighted} A-weighted) with "
            f"{self.power(self.limits.rated_power)}, {compared}, in a run of "
            f"{self.runs[self.algorithm].n_samples / self.fs:.3g} s."
        )

    @property
    def reason(self) -> str:
        """What limits, as one sentence or two; empty if the rating is enough."""
        cause = self.limited_by
        if cause is None:
            return ""
        if self.limited_by_run:
            cause = "peaks" if self.limited_by_peaks else "windows"
        ceilings = {name: "" if value is None else _db(value) for name, value in vars(self.ceilings).items()}
        text = _REASONS[cause]
        if cause == "windows" and self.unclipped_db is not None:
            text += " Without clipping the run would reach {unclipped}."
        return text.format(
            **ceilings,
            reached=_db(self.noise_reduction_db),
            taps=self.settings.n_taps,
            rated=self.power(self.limits.rated_power),
            peak=self.peak,
            share=_each(100 * self.figures[self.algorithm]["of_rated_power"], ".2g", " %"),
            unclipped="" if self.unclipped_db is None else _db(self.unclipped_db),
            window=self.limits.window_s,
        )

    @property
    def limited_by_run(self) -> bool:
        """Whether the amplifier limits by what only the run meets: clipping, or short windows."""
        return self.limited_by == "amplifier" and self.ceilings.power_db >= self.want_db

    @property
    def limited_by_peaks(self) -> bool:
        """Whether the run would reach the noise reduction wanted with the same rated power if nothing clipped."""
        return self.unclipped_db is not None and self.unclipped_db >= self.want_db

    @property
    def peak(self) -> str:
        """Largest magnitude of each control signal that has a limit, in words: in V if its scale is known."""
        volts = self.volts_per_unit
        peaks = np.ravel(np.array(self.limits.amplitude_limit, dtype=float) * (1.0 if volts is None else volts))
        unit = "" if volts is None else " V"
        if np.ptp(peaks) == 0.0:
            return _each(peaks, ".3g", unit, " at each loudspeaker")
        limited = ((j, peak) for j, peak in enumerate(peaks, 1) if not np.isnan(peak))  # NaN of None
        return " and ".join(f"{_each(peak, '.3g', unit)} at loudspeaker {j}" for j, peak in limited)

    @property
    def stability(self) -> str:
        """Error of its path that a settled feedback loop tolerates, as one sentence; empty without such a loop."""
        if self.loop is None:
            return ""
        loop = self.loop
        return (
            f"The settled loop tolerates a secondary path that is wrong by {percent(loop.path_error)} (least at "
            f"{loop.path_error_hz:.0f} Hz); its gain may change by {loop.gain_margin_db:.1f} dB or its phase by "
            f"{loop.phase_margin_deg:.0f} degrees."
        )

    def power(self, rated_power: NumberOrArray) -> str:
        """Return a `rated_power` in words: in W if the impedance is known, else in squared units."""
        if self.watt_per_power is None:
            return f"a rated power of {_each(rated_power, '.3g')}"
        return (
            f"{_each(rated_power * self.watt_per_power, '.3g', ' W')} into {_each(self.ohm, 'g', all_the_same='')} ohm"
        )

    @property
    def watt_per_power(self) -> NumberOrArray | None:
        """Watts of a mean square of 1, of each of several loudspeakers; None if the impedance is not known."""
        return watt_per_power(self.volts_per_unit, self.ohm)

    def __repr__(self) -> str:
        lines = [self.verdict, self.reason, self.stability, *self.advice]
        return "\n".join(line for text in lines if text for line in textwrap.wrap(text, 110))

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict in strict JSON's types, as `verdict.schema.json` describes it."""
        same = (
            *("enough", "verdict", "limited_by", "reason", "advice", "notes", "want_db", "noise_reduction_db"),
            *("algorithm", "bound_db", "unlimited_power", "required_rated_power", "least_rated_power"),
            *("unclipped_db", "causality_margin_s", "helpful_delay_s", "fs", "origin"),
        )
        rating = {
            name: getattr(self.limits, name) for name in ("rated_power", "amplitude_limit", "window_s", "decided_by")
        }
        told = {"schema_version": SCHEMA_VERSION} | {name: getattr(self, name) for name in same}
        told |= {
            "rating": rating | {"volts_per_unit": self.volts_per_unit, "ohm": self.ohm},
            "ceilings": vars(self.ceilings),
            "band": vars(self.band),
            "levels": self.levels and vars(self.levels),
            "settings": {"n_taps": self.settings.n_taps, **self.settings.noises},
            "algorithms": self.figures,
            "version": __version__,
        }
        if self.channels:
            told["channels"] = dict(zip(("references", "loudspeakers", "microphones"), self.channels, strict=True))
        if self.loop:
            told["loop"] = {name: value for name, value in vars(self.loop).items() if name not in ("paths", "fs")}
        return jsonable(told, "verdict")

    def write(self, folder: str | os.PathLike[str]) -> Path:
        """Write verdict.html, verdict.json, figures and sounds into a `folder`, and return the path of the page.

        The page needs no other file. All sounds have one scale: what is louder in a file is louder at the microphone.
        Files of the same names are replaced once all are written, and others stay.

        Raises
        ------
        OSError
            The folder cannot be written.
        """
        from .verdict_page import write_assessment

        path = prepare_folder(folder)
        with replacing_files(path) as new:
            return path / write_assessment(self, new).name

    @property
    def json(self) -> str:
        """`to_dict` as text."""
        return json.dumps(self.to_dict(), allow_nan=False, ensure_ascii=False, indent=2)


def _each(values: Any, form: str, unit: str = "", all_the_same: str = " each") -> str:
    """Return a number, or those of several loudspeakers, as text: "20 W", "20 W each" or "20 and 10 W"."""
    texts = [format(float(format(value, form)), "g") for value in np.ravel(values)]  # 1250, not 1.25e+03
    if len(set(texts)) == 1:
        return f"{texts[0]}{unit}{all_the_same if len(texts) > 1 else ''}"
    return f"{', '.join(texts[:-1])} and {texts[-1]}{unit}"


def nominal_hz(centre: float) -> str:
    """Return a third octave's nominal centre frequency: the exact one to the preferred digits."""
    digits = (1, 1.25, 1.6, 2, 2.5, 3.15, 4, 5, 6.3, 8)[round(10 * np.log10(centre)) % 10]
    return f"{digits * 10 ** np.floor(np.log10(centre) + 1e-6):g}"


def percent(share: float, form: str = ".0f") -> str:
    """Return a share as text."""
    return f"{100 * share:{form}} %"


def _db(value: float) -> str:
    """Return a level as text, without a minus sign before zero."""
    return f"{round(value, 1) + 0.0:.1f} dB"


_REASONS = {
    "coherence": "Coherence limits: the reference explains {coherence_db} of the disturbance at most, whatever the "
    "controller and the amplifier.",
    "causality": "Causality limits: with more time a filter of {taps} taps reaches {time_db}, in time only {filter_db}, "
    "with any power.",
    "filter": "The filter limits: {taps} taps reach {filter_db} with any power, and more time does not help.",
    "amplifier": "The amplifier limits: with any power {filter_db} are in reach, with {rated} {power_db} for a fixed filter.",
    "peaks": "The amplifier's peak voltage limits: what is above {peak} is clipped, although the run takes only {share} of "
    "the rated power. Without clipping the run would reach {unclipped} with {rated}.",
    "windows": "The amplifier limits: with {rated} a fixed filter reaches {power_db}, but the run, which keeps the rated power "
    "in each window of {window:g} s, only {reached}.",
    "adaptation": "The adaptation limits: a fixed filter reaches {power_db} within the rated power, the controller {reached}, "
    "and more power does not help it.",
}


def advice_on(
    verdict: Assessment,
    *,
    fs: str = "fs=",
    n_taps: str = "n_taps=",
    noise_rating: str = "noise_watt",
    peak_volts: str = "peak_volts",
) -> list[str]:
    """Return what to change, in sentences; the other arguments are what the caller calls these settings."""
    want = f"{verdict.want_db:g} dB"
    needed = verdict.least_rated_power
    enough = [f"About {verdict.power(needed)} would do for {want}: the least with which the run reaches it."]
    if verdict.enough:
        return enough if np.max(needed / verdict.limits.rated_power) < 0.9 else []
    if verdict.timing_fault is not None:
        return [verdict.timing_fault[0].upper() + verdict.timing_fault[1:]]
    if verdict.limited_by == "coherence":
        return [
            "Move the reference microphone closer to the source, or add one for each source; shield it from wind and "
            "other noise. Tones that it does not hear can be predicted: try hybrid control (feedback)."
        ]
    if verdict.limited_by == "causality":
        delay = verdict.helpful_delay_s
        late = f"With {1e3 * delay:.2g} ms more" if delay is not None else "With more time"
        if verdict.feedback:
            return [
                f"{late} for the prediction, the same filter reaches {want}: move the loudspeaker towards the error "
                "microphone, shorten the latency of the electronics, or add a reference microphone (hybrid control)."
            ]
        if delay is None and (verdict.causality_margin_s or 0.0) < 0:
            late = f"The anti-noise is {-1e3 * (verdict.causality_margin_s or 0.0):.3g} ms late"
        else:
            late += f" between the reference microphone and the loudspeaker, the same filter reaches {want}"
        return [
            f"{late}: move the microphone towards the source or the loudspeaker towards the error microphone, or shorten the "
            "latency of the electronics."
        ]
    if verdict.limited_by == "filter":
        return _advice_on_length(verdict, fs, n_taps)
    if verdict.limited_by == "adaptation":
        return ["Try a longer record: the controller may not have settled."]
    advice = enough
    if not np.all(np.isfinite(needed)):
        advice = [
            f"A fixed filter would need {verdict.power(verdict.required_rated_power)} for {want}; this controller does not "
            "reach it with any power. Try a longer record."
        ]
    if verdict.limited_by_peaks:
        crest = np.array(verdict.limits.amplitude_limit, dtype=float) / np.sqrt(verdict.limits.rated_power)
        of_a_sine = np.any(np.isclose(crest, SINE_CREST))
        noise = f"If the data sheet states watts of noise, give {noise_rating}; if" if of_a_sine else "If"
        advice.append(f"{noise} the amplifier clips at a higher voltage, give {peak_volts}.")
    if verdict.band.weak_share > 0.1:
        advice.append(
            f"{percent(verdict.band.weak_share)} of the noise lies where the loudspeaker is weak: a loudspeaker for "
            f"{verdict.band.low_hz:.0f} to {verdict.band.high_hz:.0f} Hz takes less power."
        )
    return advice


def _advice_on_length(verdict: Assessment, fs: str, n_taps: str) -> list[str]:
    """Return what to change about a filter that is too short, or seems to be."""
    taps, rate, needed_s = verdict.settings.n_taps, verdict.fs, verdict.response_s
    lasts = f"{taps} taps last {1e3 * taps / rate:.2g} ms"
    if needed_s is None or needed_s * rate <= taps:
        return [
            f"Try a filter longer than {taps} taps: {lasts} at {rate:g} Hz, more at a lower sample rate. If that gains "
            "nothing, the loudspeaker does not reach what is left of the noise, or it needs to be closer to the "
            "microphone."
        ]
    enough = 2 ** math.ceil(math.log2(ROOM_FOR_RESPONSE * needed_s * rate))
    slower = _slower_rate(verdict, needed_s)
    mends = [] if slower is None else [f"resample everything with {fs}{slower:g}"]
    if enough <= MOST_TAPS:
        mends.append(f"take a longer filter with {n_taps}{enough}")
    if not mends:
        mends.append(
            "move the reference microphone towards the error microphone, or give a primary path that ends sooner"
        )
    late = float(f"{1e3 * needed_s:.2g}")
    return [
        f"{lasts}, but the noise arrives up to {late:g} ms later than the loudspeaker's sound: {', or '.join(mends)}."
    ]


def _slower_rate(verdict: Assessment, needed_s: float) -> float | None:
    """Return a whole fraction of the sample rate that keeps the noise's band and makes the filter long enough."""
    n_references, n_loudspeakers, _ = verdict.channels or (1, 1, 1)
    longest = longest_filter(n_references * n_loudspeakers)
    for divisor in range(2, 13):
        rate = verdict.fs / divisor
        if rate < RATE_OF_BAND * verdict.band.high_hz:
            return None
        if rate.is_integer() and ROOM_FOR_RESPONSE * needed_s * rate <= longest:
            return rate
    return None
