"""The verdict on a rating: each cause from both sides, what it promises, its JSON, its page."""

from __future__ import annotations

import functools
import itertools
import json
import re
from dataclasses import replace
from datetime import date
from unittest.mock import Mock

import jsonschema
import numpy as np
import pytest
from scipy.signal import firwin, welch

from kfopc_filterpy import Plant, __version__
from kfopc_filterpy.metrics import a_weighting_db
from kfopc_filterpy.power import AmplifierRating
from kfopc_filterpy.signals import Recording, band_limited_noise
from kfopc_filterpy.verdict import assess
from kfopc_filterpy.verdict.assessment import CAUSES, SCHEMA, advice_on
from kfopc_filterpy.verdict.candidates import STEP_SIZES
from kfopc_filterpy.verdict.limits import Limits
from kfopc_filterpy.verdict.verdict_page import _bound, _tables

FS, SECONDS, TAPS = 8000, 3.0, 32
PLENTY = 100.0  # times what full control takes


def arriving(*samples: int, length: int = 128) -> np.ndarray:
    """A path that hands on what comes in after so many samples, once for each."""
    return np.eye(length)[list(samples)].sum(axis=0)


@functools.cache
def noise(seed: int = 1, high: float = 1500.0) -> np.ndarray:
    return band_limited_noise((100, high), SECONDS, fs=FS, rng=seed, power=1.0)


def heard(primary: np.ndarray, other_db: float) -> np.ndarray:
    """A disturbance with another source, so many dB below what the reference explains."""
    x = noise()
    return np.convolve(x, primary)[: x.size] + 10 ** (-other_db / 20) * noise(2)


SECONDARY = arriving(6, length=16)
PLANT = Plant(SECONDARY, arriving(20), fs=FS)


def on(x=None, primary=None, secondary=SECONDARY, **options):
    """The verdict on KF-PB alone, by default on a scene in which nothing is wrong."""
    options = {"rating": PLENTY, "n_taps": TAPS, "beside": (), "secondary_path_uncertainty": None} | options
    if primary is None and "disturbance" not in options:
        primary = arriving(20)
    return assess(noise() if x is None else x, Plant(secondary, primary, fs=FS), **options)


@functools.cache
def verdict_on(case: str, better: bool):
    """The verdict on a scene with one fault, or without it."""
    primary, secondary, x = arriving(20), SECONDARY, noise()
    options: dict = {}
    if case == "coherence":
        options["disturbance"] = heard(primary, 15.0 if better else 2.0)
    if case == "causality":
        x = noise(high=3500.0)  # what a filter hardly predicts
        primary, secondary = arriving(20 if better else 2), arriving(12, length=16)
    if case == "filter":
        primary = arriving(20, 100)
        options |= {"n_taps": 128 if better else TAPS, "want_db": 8.0}
    if case == "amplifier":
        options["rating"] = 0.6 if better else 0.1
    if case == "adaptation":
        options |= {"disturbance": heard(primary, 12.0), "want_db": 10.0}
        options |= {"algorithm": "KF-OPC", "memory_s": 0.25 if better else 0.003}
    return on(x, primary, secondary, **options)


@pytest.mark.parametrize("case", CAUSES)
def test_a_fault_is_found_as_the_cause_and_without_it_the_same_scene_is_enough(case):
    verdict = verdict_on(case, better=False)
    assert not verdict.enough
    assert verdict.limited_by == case
    assert verdict.noise_reduction_db < verdict.want_db
    assert case in verdict.reason.lower()
    assert verdict.advice
    assert repr(verdict).startswith(f"Not enough: {verdict.algorithm} reaches")
    # No ceiling is above the one before. A fit of 32 taps to 1.3 s explains some hundredths of a dB by chance.
    c = verdict.ceilings
    known = [value for value in (c.coherence_db, c.time_db, c.filter_db, c.power_db) if value is not None]
    assert all(later <= earlier + 0.1 for earlier, later in itertools.pairwise(known))
    jsonschema.validate(strict(verdict.json), strict(SCHEMA.read_text(encoding="utf-8")))
    better = verdict_on(case, better=True)
    assert (better.enough, better.limited_by, better.reason) == (True, None, "")
    assert better.noise_reduction_db >= better.want_db
    assert repr(better).startswith(f"Enough: {better.algorithm} reaches")


def test_the_sensor_noise_of_the_plant_limits_unless_the_disturbance_was_recorded_with_its_own():
    """As loud as the disturbance, it leaves half of what is heard."""
    noisy = Plant(SECONDARY, arriving(20), fs=FS, sensor_noise_std=1.0)
    options = {"rating": PLENTY, "n_taps": TAPS, "beside": (), "secondary_path_uncertainty": None}
    verdict = assess(noise(), noisy, **options)
    assert verdict.limited_by == "coherence"
    for reached in (verdict.ceilings.filter_db, verdict.noise_reduction_db):
        assert reached == pytest.approx(10 * np.log10(2), abs=0.5)  # 32 weights fit some of it by chance
    assert any("the coherence shows only the plant's sensor noise" in note for note in verdict.notes)
    by_ear = assess(noise(), noisy, feedback=True, **options)
    assert by_ear.ceilings.coherence_db is None
    assert any("so the coherence is not checked" in note for note in by_ear.notes)
    recorded = [assess(noise(), plant, disturbance=heard(arriving(20), 15.0), **options) for plant in (PLANT, noisy)]
    assert recorded[0].noise_reduction_db == recorded[1].noise_reduction_db > 10.0


def test_the_cause_is_the_amplifier_if_its_peaks_are_what_is_missing(tmp_path):
    """Noise within the mean power has peaks beyond a sine's: a fixed filter would do, the run does not, with more it does."""
    small = on(rating=AmplifierRating(ohm=8.0, sine_watt=0.75 * 2, volts_per_unit=4.0), want_db=14.0)
    assert small.ceilings.power_db >= 14.0
    assert small.limited_by == "amplifier"
    share = 100 * small.figures["KF-PB"]["of_rated_power"]
    assert small.reason == (
        f"The amplifier's peak voltage limits: what is above 4.9 V is clipped, although the run takes only {share:.2g} % of "
        f"the rated power. Without clipping the run would reach {small.unclipped_db:.1f} dB with 1.5 W into 8 ohm."
    )
    noise = "If the data sheet states watts of noise, give noise_watt; if "
    assert small.advice[1] == f"{noise}the amplifier clips at a higher voltage, give peak_volts."
    (ceilings, *_) = _tables(small)
    assert [row[2] for row in ceilings.rows] == ["", "", "", "", "", "limits", ""]
    assert ceilings.rows[4][1] == f"{small.unclipped_db:.1f} dB"
    page = small.write(tmp_path).read_text(encoding="utf-8")
    assert "peaks up to 4.9 V" in page
    assert page.count("The bound knows the mean power and not the clipping") == 2  # its caption, for eye and ear
    other = on(rating=AmplifierRating(8.0, sine_watt=1.5, peak_volts=20.0, volts_per_unit=4.0), want_db=14.0)
    assert other.noise_reduction_db == pytest.approx(small.unclipped_db, abs=0.01)
    assert other.enough
    low = on(rating=AmplifierRating(8.0, sine_watt=1.5, peak_volts=4.0, volts_per_unit=4.0), want_db=14.0)
    assert low.advice[1] == "If the amplifier clips at a higher voltage, give peak_volts."
    assert on(rating=AmplifierRating(ohm=8.0, sine_watt=16.0, volts_per_unit=4.0), want_db=14.0).enough


def test_the_cause_is_the_amplifier_if_only_a_filter_that_is_fixed_does_with_its_mean_power():
    verdict = on(rating=0.6, want_db=12.0)
    assert verdict.ceilings.power_db >= 12.0 > verdict.noise_reduction_db
    assert (verdict.limited_by, verdict.unclipped_db) == ("amplifier", None)  # nothing clips
    assert verdict.reason == (
        f"The amplifier limits: with a rated power of 0.6 a fixed filter reaches {verdict.bound_db:.1f} dB, but the run, "
        f"which keeps the rated power in each window of 0.1 s, only {verdict.noise_reduction_db:.1f} dB."
    )
    assert [row[2] for row in next(_tables(verdict)).rows] == ["", "", "", "", "limits", ""]
    clipped = replace(verdict, unclipped_db=11.7)  # which is not enough, either
    assert clipped.reason == f"{verdict.reason} Without clipping the run would reach 11.7 dB."


@pytest.mark.parametrize(
    ("peaks", "volts", "told"),
    [
        ((8.0,), None, "8"),
        ((4.9, 4.9), 2.0, "9.8 V at each loudspeaker"),
        ((8.0, 6.0), 1.0, "8 V at loudspeaker 1 and 6 V at loudspeaker 2"),
        ((None, 8.0), None, "8 at loudspeaker 2"),
    ],
)
def test_a_peak_is_told_of_each_loudspeaker_that_has_a_limit(peaks, volts, told):
    verdict = verdict_on("amplifier", better=True)
    limits = Limits(tuple(replace(verdict.limits.each[0], amplitude_limit=peak) for peak in peaks), len(peaks) > 1)
    scale = volts if volts is None else np.full(len(peaks), volts)
    assert replace(verdict, limits=limits, volts_per_unit=scale).peak == told


@pytest.mark.parametrize(
    ("missed", "told"),
    [
        (-0.04, "Not enough: .* just short of the 6 dB wanted"),
        (0.04, "Enough: .* just enough for the 6 dB wanted"),
        (-0.06, "Not enough: .* 0.1 dB less than the 6 dB wanted"),
        (0.06, "Enough: .* 0.1 dB more than the 6 dB wanted"),
    ],
)
def test_a_verdict_that_is_close_says_so(missed, told):
    close = replace(verdict_on("amplifier", better=True), noise_reduction_db=6.0 + missed, enough=missed > 0)
    assert re.match(told, close.verdict)


def test_a_filter_that_ends_before_the_noise_arrives_is_advised_how_long_it_must_be():
    """The second arrival comes 94 samples after the loudspeaker's sound and carries half of the energy."""
    verdict = verdict_on("filter", better=False)
    assert verdict.response_s == pytest.approx((100 - 6 + 1) / FS)
    (advice,) = verdict.advice
    assert advice.startswith(
        "32 taps last 4 ms, but the noise arrives up to 12 ms later than the loudspeaker's sound: "
    )
    assert advice.endswith("resample everything with fs=4000, or take a longer filter with n_taps=128.")
    assert verdict_on("filter", better=True).noise_reduction_db > 8.0  # with those 128 taps
    late = replace(verdict, response_s=0.9)  # at 4000 Hz 3600 taps, more than anyone runs
    assert advice_on(late) == [
        "32 taps last 4 ms, but the noise arrives up to 900 ms later than the loudspeaker's sound: move the reference "
        "microphone towards the error microphone, or give a primary path that ends sooner."
    ]


def test_without_a_primary_path_a_short_filter_is_advised_to_be_longer():
    verdict = on(disturbance=np.convolve(noise(), arriving(12, 30))[: noise().size], n_taps=8)
    assert verdict.limited_by == "filter"
    assert verdict.response_s is None
    assert verdict.advice[0].startswith("Try a filter longer than 8 taps: 8 taps last 1 ms at 8000 Hz, more at a lower")


def test_a_tone_is_predicted_so_that_a_late_loudspeaker_does_not_limit():
    t = np.arange(round(SECONDS * FS)) / FS
    x = np.sin(2 * np.pi * 300 * t) + 0.01 * np.random.default_rng(0).standard_normal(t.size)
    verdict = on(x, arriving(2), arriving(12, length=16), want_db=15.0)
    assert verdict.causality_margin_s < 0
    assert verdict.enough


def test_the_bar_moves_while_fxlms_is_tuned_and_ends_at_its_total():
    bar = Mock(total=None)
    on(algorithm="FxLMS", beside=("KF-PB",), bar=bar, want_db=0.0)
    after_switch_on = round(0.9 * SECONDS * FS)
    grid = len(STEP_SIZES)
    moved = [call.args[0] for call in bar.update.call_args_list]
    assert bar.total == sum(moved) == (2 + grid) * after_switch_on
    assert moved.count(after_switch_on) >= grid


def watts(sine_watt: float) -> AmplifierRating:
    return AmplifierRating(ohm=8.0, sine_watt=sine_watt, volts_per_unit=3.0)


@pytest.mark.parametrize(("kind", "algorithm"), [(float, "KF-PB"), (watts, "KF-PB"), (watts, "FxLMS")])
def test_the_least_rating_is_one_answer_whatever_is_typed_and_typed_back_it_is_just_enough(kind, algorithm):
    def on(rated: float):
        options: dict = {"algorithm": algorithm, "beside": (), "secondary_path_uncertainty": None, "n_taps": TAPS}
        return assess(noise(), PLANT, rating=kind(rated), want_db=8.0, **options)

    few, many = on(0.01), on(1000.0)
    assert (few.limited_by, many.enough) == ("amplifier", True)
    assert few.least_rated_power == pytest.approx(many.least_rated_power, rel=1e-12)
    printed = float(re.search(r"About (?:a rated power of )?(\S+) ", few.advice[0])[1])
    assert many.advice == few.advice[:1]
    assert on(printed).enough
    assert not on(0.98 * printed).enough


def test_the_advice_on_causality_is_a_delay_that_helps():
    verdict = verdict_on("causality", better=False)
    more = round(verdict.helpful_delay_s * FS)
    helped = on(noise(high=3500.0), arriving(2 + more), arriving(12, length=16))
    assert helped.ceilings.filter_db >= verdict.want_db
    assert verdict.causality_margin_s == pytest.approx(-10 / FS)


def test_buffers_far_longer_than_the_filter_are_no_matter_of_its_length():
    """As in an impulse response that holds 0.2 s of an interface's latency."""
    verdict = on(noise(high=3500.0), arriving(20), arriving(1620, length=1700))
    assert verdict.limited_by == "causality"
    assert verdict.helpful_delay_s == pytest.approx(0.2)  # one tap cancels the noise, if it knows it so early
    late = replace(verdict, helpful_delay_s=None)  # as if the noise's path were longer than the filter
    assert advice_on(late)[0].startswith("The anti-noise is 200 ms late: move the microphone towards the source")


# What it writes.


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("verdict") / "out"
    rating = AmplifierRating(ohm=8.0, sine_watt=2.0, volts_per_unit=10.0)
    verdict = assess(noise(), PLANT, rating=rating, n_taps=TAPS, pascal_per_unit=1.0)
    return verdict, verdict.write(folder)


def strict(text: str):
    def refuse(constant):
        raise AssertionError(constant)

    return json.loads(text, parse_constant=refuse)


def test_the_json_is_strict_and_as_its_schema_says(written):
    verdict, page = written
    schema = strict(SCHEMA.read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    data = strict((page.parent / "verdict.json").read_text(encoding="utf-8"))
    jsonschema.validate(data, schema)
    assert data == verdict.to_dict()
    assert data["enough"] is verdict.enough
    assert set(data["algorithms"]) == {"KF-PB", "KF-OPC", "FxLMS"}
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(data | {"surprise": 1}, schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(data | {"limited_by": "bad luck"}, schema)


def test_the_page_says_where_it_comes_from_and_no_watts_that_are_not_known(tmp_path):
    known, unknown = (on(rating=AmplifierRating(8.0, 2.0, volts_per_unit=volts), want_db=1.0) for volts in (4.0, None))
    named = replace(unknown, origin={"Files": "<a>.wav, 24000 samples"})
    days = [date.today()]
    pages = [verdict.write(tmp_path).read_text(encoding="utf-8") for verdict in (known, named)]
    days.append(date.today())  # another one at midnight
    assert known.limits.rated_power == unknown.limits.rated_power / 16 == 1.0
    assert "with 2 W into 8 ohm" in known.verdict
    for told in ("Power (W into 8 ohm)", ">4 V<", f"kfopc_filterpy {__version__}", "8000 Hz"):
        assert told in pages[0]
    assert any(str(day) in pages[0] for day in days)
    assert not re.search(r"\d W\b|\(W", re.sub(r"data:[^\"]*", "", pages[1]))
    for told in ("not watts: volts_per_unit is not known", "&lt;a&gt;.wav, 24000 samples"):
        assert told in pages[1]
    for text in pages:
        assert not re.search(r'(?:href|src)="(?:https?:)?//', text)
        assert all(source.startswith("data:") for source in re.findall(r'src="([^"]{0,40})', text))
        assert all((tmp_path / stem).is_file() for stem in re.findall(r'href="([^"#]+)"', text))


@pytest.mark.parametrize(
    ("rating", "algorithm", "other", "why"),
    [
        (PLENTY, "FxLMS", "KF-OPC", "dB within the rating: choose it as the algorithm."),
        (0.1, "KF-PB", "FxLMS", "dB, but does not keep the rating: its mean power is"),
    ],
)
def test_a_controller_that_did_better_is_chosen_or_the_verdict_says_why_not(rating, algorithm, other, why):
    options: dict = {"n_taps": TAPS, "beside": (other,), "want_db": 0.0}
    verdict = assess(noise(), PLANT, rating=rating, algorithm=algorithm, **options)
    reached = {name: figures["noise_reduction_db"] for name, figures in verdict.figures.items()}
    assert reached[other] > reached[algorithm] + 0.1
    assert any(
        note.startswith(f"{other}, without a limiter, reaches {reached[other]:.1f} {why}") for note in verdict.notes
    )


def test_the_watts_of_the_lead_figure_are_written_out(written):
    ax = _bound(written[0])
    ax.figure.canvas.draw()
    low, high = ax.get_xlim()
    shown = [tick.get_text() for tick in ax.get_xticklabels() if low <= tick.get_position()[0] <= high]
    assert len(shown) >= 2
    assert all(re.fullmatch(r"0\.0*1|10*", text) for text in shown)


@pytest.mark.parametrize(("scheme", "width"), [("dark", 390), ("light", 900)])
def test_the_page_fits_a_phone_and_its_figures_are_dark_where_the_page_is(written, browser, scheme, width):
    shape = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", shape)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    try:
        browser.get(written[1].as_uri())
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width
        shown = browser.execute_script("return getComputedStyle(document.querySelector('figure img')).filter")
        assert ("invert" in shown) == (scheme == "dark")
        cut_off = (
            "return [...document.querySelectorAll('.wide')].filter(one => one.scrollWidth > one.clientWidth).length"
        )
        assert width < 900 or browser.execute_script(cut_off) == 0  # on a phone, tables scroll
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_a_third_octave_that_the_control_makes_louder_is_noted():
    """A white reference explains a disturbance of one band; a short filter adds noise beside it."""
    x = np.random.default_rng(0).standard_normal(3 * FS)
    verdict = on(x, firwin(41, [400, 900], pass_zero=False, fs=FS), arriving(8, length=16))
    note = next(note for note in verdict.notes if "third octaves louder" in note)
    count, centre, more, share = re.match(
        r"KF-PB makes (\d+) of \d+ third octaves louder: (\d+) Hz by ([\d.]+) dB, which carries ([\d.]+) % of the A-weighted noise "
        r"that remains; \d+ Hz by [\d.]+ dB, which carries [\d.]+ %[;.]",
        note,
    ).groups()
    run = verdict.runs["KF-PB"]
    half = np.array([run.error, run.disturbance])[:, run.n_samples // 2 :]
    f, spectra = welch(half, FS, nperseg=2048)
    exact = 1000 * 10 ** (round(10 * np.log10(int(centre) / 1000)) / 10)
    band = 1 / (1 + ((f[1:] / exact - exact / f[1:]) / (10**0.05 - 10**-0.05)) ** 8)  # of a Butterworth band-pass
    after, before = spectra[:, 1:] @ band
    assert float(more) == pytest.approx(10 * np.log10(after / before), abs=1.0)  # Welch smears a steep edge
    assert int(count) > 1
    weighted = spectra[:, 1:] * 10 ** (a_weighting_db(f[1:]) / 10)
    assert float(share) == pytest.approx(100 * weighted[0] @ band / weighted[0].sum(), rel=0.1)
    less = 10 * np.log10(weighted[1].sum() / weighted[0].sum())
    own = verdict.figures["KF-PB"]["noise_reduction_dba"]
    assert own == pytest.approx(less, abs=0.3)
    assert f"({own:.1f} dB A-weighted)" in verdict.verdict
    assert not any("louder" in note for note in on().notes)


# What it refuses.


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"noise": np.ones(8000)}, "noise must not be silent"),
        ({"noise": np.full(8000, np.nan)}, "noise must be finite"),
        ({"secondary": np.zeros(8)}, "secondary must not be silent: every value is 0; record it again"),
        ({"primary": None}, "plant must have a primary path unless there is a disturbance"),
        ({"disturbance": noise()}, "noise and disturbance are the same signal: give the error microphone's recording"),
        ({"disturbance": np.ones(7)}, "disturbance must have 24000 values, got 7"),
        (
            {"noise": noise()[:16000].reshape(2, 8000)},
            "noise must have the 1 channel(s) of the plant's primary path, got 2",
        ),
        ({"noise": Recording(noise(), 2 * FS)}, f"noise is sampled at {2 * FS} Hz but fs is {FS} Hz"),
        ({"rating": 0.0}, "rating must be greater than 0"),
        ({"algorithm": "KF"}, "algorithm must be one of 'KF-PB', 'KF-OPC', 'FxLMS'"),
        ({"want_db": -1.0}, "want_db must not be negative"),
        (
            {"noise": noise()[: 2 * FS]},
            "after the control is switched on, got 1.8 s: a shorter run says nothing; record 10 s",
        ),
        ({"n_taps": 12000}, "must have at least"),
        ({"pascal_per_unit": 0.0}, "pascal_per_unit must be greater than 0"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_bad_input_is_refused(change, message):
    good = {"noise": noise(), "primary": arriving(20), "secondary": SECONDARY, "rating": 1.0, "n_taps": 16} | change
    with pytest.raises(ValueError, match=re.escape(message)):
        assess(plant=Plant(good.pop("secondary"), good.pop("primary"), fs=FS), **good)
