"""The verdict for several references, loudspeakers and microphones: against one channel, and each cause from both sides."""

from __future__ import annotations

import functools
import json
import re

import jsonschema
import numpy as np
import pytest
import soundfile
from scipy.signal import lfilter

from kfopc_filterpy import Plant, noise_reduction_db
from kfopc_filterpy.bounds import predictor_reference
from kfopc_filterpy.metrics import overshoot
from kfopc_filterpy.paths import internal_model_margin
from kfopc_filterpy.power import AmplifierRating, LoudspeakerRating
from kfopc_filterpy.signals import band_limited_noise
from kfopc_filterpy.verdict import assess
from kfopc_filterpy.verdict.assessment import SCHEMA
from kfopc_filterpy.verdict.limits import limits_of

FS, SECONDS, TAPS = 8000, 3.0, 32
PLENTY = 100.0  # times what full control takes
WANTED = 1 - 10 ** (-6 / 20)  # amplitude of the anti-noise that takes 6 dB


def arriving(samples: list, length: int) -> np.ndarray:
    """Paths that hand on what comes in after so many samples; None: nothing arrives."""
    paths = np.zeros((*np.shape(samples), length))
    for place, delay in np.ndenumerate(np.array(samples, dtype=object)):
        if delay is not None:
            paths[place][delay] = 1.0
    return paths


APART = arriving([[6, None], [None, 6]], 16)  # each loudspeaker reaches its own microphone
PRIMARY = arriving([[20], [24]], 64)


@functools.cache
def noise(seed: int = 1, high: float = 1500.0) -> np.ndarray:
    return band_limited_noise((100, high), SECONDS, fs=FS, rng=seed, power=1.0)


def heard(other_db: float) -> np.ndarray:
    """Disturbances at two microphones with another source, so many dB below what the reference explains."""
    own = np.array([np.convolve(noise(), p[0])[: noise().size] for p in PRIMARY])
    return own + 10 ** (-other_db / 20) * np.stack([noise(2), np.roll(noise(2), 5)])


def on(x=None, primary=PRIMARY, secondary=APART, **options):
    options = {"rating": PLENTY, "n_taps": TAPS, "beside": (), "secondary_path_uncertainty": None} | options
    return assess(noise() if x is None else x, Plant(secondary, primary, fs=FS), **options)


# ---- Against one channel


def test_one_channel_as_a_matrix_is_the_verdict_on_one_channel():
    options = {"disturbance": heard(12.0)[0], "rating": 0.3, "beside": None, "pascal_per_unit": 0.5}
    plain = on(primary=PRIMARY[0, 0], secondary=APART[0, 0], **options)
    matrix = on(x=noise()[np.newaxis], primary=PRIMARY[:1], secondary=APART[:1, :1], **options)
    assert matrix.to_dict() == plain.to_dict()
    assert plain.channels is None
    assert "channels" not in plain.to_dict()


@pytest.mark.parametrize("uncertainty", [None, 0.9], ids=["exact", "uncertain"])
def test_two_loudspeakers_that_do_not_meet_have_the_ceilings_and_the_powers_of_one(uncertainty):
    d, options = heard(12.0)[0], {"rating": 0.3, "secondary_path_uncertainty": uncertainty, "memory_s": 0.25}
    one = on(primary=None, secondary=APART[0, 0], disturbance=d, **options)
    two = on(primary=None, disturbance=np.stack([d, d]), **options)
    assert two.channels == (1, 2, 2)
    for name in ("coherence_db", "time_db", "filter_db", "power_db"):
        assert getattr(two.ceilings, name) == pytest.approx(getattr(one.ceilings, name), abs=0.01), name
    assert two.bound_db == pytest.approx(one.bound_db, abs=0.01)
    np.testing.assert_allclose(two.unlimited_power, 2 * [one.unlimited_power], rtol=1e-3)
    np.testing.assert_allclose(two.required_rated_power, 2 * [one.required_rated_power], rtol=1e-3)
    assert two.band.low_hz == pytest.approx(one.band.low_hz)
    assert two.settings.noises == pytest.approx(one.settings.noises, rel=1e-3)


@pytest.mark.parametrize("n_microphones", [1, 2])
@pytest.mark.parametrize("heard_before", [True, False])
def test_feedback_is_a_reference_that_is_the_disturbance_a_sample_late(n_microphones, heard_before):
    """With an exact path, a white source, and coloured noise that no reference microphone hears."""
    rng, secondary = np.random.default_rng(6), APART[:n_microphones, :n_microphones]
    white, unheard = rng.standard_normal(24000), rng.standard_normal((n_microphones, 24000))
    d = lfilter([0.2], [1.0, -0.98], unheard) + 0.3 * np.roll(white, 20)
    d[:, -1] = 0.0  # so that d and d(n - 1) both have no offset, which would be subtracted
    d[:, :-1] -= d[:, :-1].mean(axis=1, keepdims=True)
    x, late = white - white.mean() if heard_before else None, predictor_reference(d)
    options = {"primary": None, "secondary": secondary, "rating": 0.1, "want_db": 1.0}
    feedback = on(x=d if x is None else x, feedback=True, disturbance=None if x is None else d, **options)
    forward = on(x=late if x is None else np.concatenate((x[np.newaxis], late)), disturbance=d, **options)
    for one in (feedback.ceilings, forward.ceilings):
        assert one.power_db < one.filter_db
    assert feedback.ceilings.filter_db == pytest.approx(forward.ceilings.filter_db, abs=1e-6)
    assert feedback.bound_db == pytest.approx(forward.bound_db, abs=1e-6)
    # d^ is d to rounding, but whether KF-PB's price changes in a block, and its filter takes more steps, may depend on it:
    # 0.002 dB were seen.
    assert feedback.noise_reduction_db == pytest.approx(forward.noise_reduction_db, abs=1e-2)
    np.testing.assert_allclose(feedback.least_rated_power, forward.least_rated_power, rtol=1e-6)
    assert feedback.ceilings.coherence_db is None
    several = heard_before or n_microphones > 1
    assert feedback.channels == ((int(heard_before), n_microphones, n_microphones) if several else None)
    weights = feedback.runs["KF-PB"].weights[-1]
    margin = internal_model_margin(weights, Plant(secondary if several else secondary[0, 0], fs=FS))
    assert feedback.loop == margin
    assert forward.loop is None
    assert margin.stable


# ---- Each cause from both sides


def test_the_power_for_6_db_is_that_of_the_closed_form_and_the_amplifiers_are_the_cause_below_it():
    """Where each filter is a delay, the best one within a power is that delay, scaled."""
    small = on(rating=0.6 * WANTED**2)
    assert (small.enough, small.limited_by) == (False, "amplifier")
    np.testing.assert_allclose(small.required_rated_power / small.unlimited_power, WANTED**2, rtol=0.02)
    assert np.all(small.least_rated_power >= small.required_rated_power)
    assert repr(small).startswith("Not enough: KF-PB reaches")
    assert "each" in small.verdict
    large = on(rating=1.02 * small.least_rated_power)
    assert (large.enough, large.limited_by, large.reason) == (True, None, "")


def test_all_limiters_have_the_shortest_window_of_the_ratings():
    cone, amplifier = LoudspeakerRating(8.0, noise_watt=1.0), AmplifierRating(ohm=8.0, sine_watt=1.0)
    limits = limits_of([[cone], [amplifier]], several=True)
    assert [one.window_s for one in limits.each] == [amplifier.limits.window_s] * 2
    assert amplifier.limits.window_s < cone.limits.window_s


def test_one_weak_amplifier_is_the_cause_if_the_others_cannot_take_over():
    weak = on(rating=[PLENTY, 0.001])
    assert (weak.enough, weak.limited_by) == (False, "amplifier")
    assert weak.ceilings.power_db < 6 < weak.ceilings.filter_db
    ratio = weak.required_rated_power / np.array([PLENTY, 0.001])
    assert ratio[0] == pytest.approx(ratio[1])
    first, second = weak.figures["KF-PB"]["noise_reduction_by_microphone_db"]
    assert first > 15 > 1 > second
    helped = on(rating=[PLENTY, 0.001], secondary=arriving([[6, None], [6, 6]], 16), primary=arriving([[20], [20]], 64))
    assert helped.enough  # the first loudspeaker reaches both microphones in the same way


def test_another_source_is_the_cause_until_it_has_a_reference_of_its_own():
    alone = on(primary=None, disturbance=heard(2.0))
    assert (alone.enough, alone.limited_by) == (False, "coherence")
    share = 10 ** (-2 / 10) / (1 + 10 ** (-2 / 10))  # of the other source, in closed form
    assert alone.ceilings.coherence_db == pytest.approx(-10 * np.log10(share), abs=0.3)
    assert on(primary=None, disturbance=heard(15.0)).enough
    early = np.roll(noise(2), -8)  # a microphone that hears it before the others
    both = on(np.stack([noise(), early]), primary=None, disturbance=heard(2.0))
    assert both.channels == (2, 2, 2)
    assert both.enough
    assert both.ceilings.coherence_db > 20


# ---- Ratings


def test_every_rating_is_kept_in_every_window_and_the_figures_are_those_of_the_run():
    verdict = on(rating=[0.1, 0.05], beside=None)
    run = verdict.runs["KF-PB"]
    for y, rated in zip(run.control_signal, (0.1, 0.05), strict=True):
        assert overshoot(y, rated, FS, window_s=0.1) <= 1 + 1e-12
    assert verdict.noise_reduction_db == noise_reduction_db(run.error, run.disturbance)
    assert verdict.figures["KF-PB"]["noise_reduction_by_microphone_db"] == [
        noise_reduction_db(e, d) for e, d in zip(run.error, run.disturbance, strict=True)
    ]
    assert set(verdict.runs) == {"KF-PB", "KF-OPC", "FxLMS"}


# ---- What it writes


def test_json_and_page_have_the_loudspeakers_and_the_microphones(tmp_path):
    amplifiers = [AmplifierRating(ohm=ohm, sine_watt=2.0, volts_per_unit=10.0) for ohm in (8.0, 4.0)]
    verdict = on(rating=amplifiers, pascal_per_unit=[1.0, 2.0], beside=("FxLMS",))
    page = verdict.write(tmp_path / "out")
    data = json.loads((page.parent / "verdict.json").read_text(encoding="utf-8"))
    jsonschema.validate(data, json.loads(SCHEMA.read_text(encoding="utf-8")))
    assert data["channels"] == {"references": 1, "loudspeakers": 2, "microphones": 2}
    assert data["rating"]["rated_power"] == pytest.approx([0.16, 0.08])
    assert data["rating"]["ohm"] == [8.0, 4.0]
    assert len(data["algorithms"]["KF-PB"]["output_power"]) == 2
    before = data["levels"]["before_dba"]
    powers = [np.mean(d[d.size // 2 :] ** 2) for d in verdict.runs["KF-PB"].disturbance]
    assert before[1] - before[0] == pytest.approx(20 * np.log10(2) + 10 * np.log10(powers[1] / powers[0]), abs=0.1)
    assert "2 W each into 8 and 4 ohm" in data["verdict"]
    text = page.read_text(encoding="utf-8")
    assert "Are the amplifiers enough?" in text
    assert text.count('role="group"') == 2  # a player for each microphone
    assert all(source.startswith("data:") for source in re.findall(r'src="([^"]{0,40})', text))
    for k in (1, 2):
        sounds = [soundfile.read(page.parent / "audio" / f"verdict-{name}-{k}.wav")[0] for name in ("before", "after")]
        run = verdict.runs["KF-PB"]
        wanted = np.sum(run.disturbance[k - 1] ** 2) / np.sum(run.error[k - 1] ** 2)
        assert np.sum(sounds[0] ** 2) / np.sum(sounds[1] ** 2) == pytest.approx(wanted, rel=1e-3)  # 16 bits


# ---- What it refuses

AMPLIFIER, CONE = AmplifierRating(ohm=8.0, sine_watt=1.0), LoudspeakerRating(ohm=8.0, noise_watt=1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"primary": PRIMARY[:1]},
            "primary must be (K microphones, I references, taps) with the 2 microphones of secondary, got (1, 1, 64)",
        ),
        ({"disturbance": noise()}, "disturbance must have a channel for each of the 2 microphone"),
        ({"secondary": APART[0]}, "secondary must have shape (K microphones, J loudspeakers, taps)"),
        ({"secondary": APART * [[[1.0]], [[0.0]]]}, "secondary[1] must not be silent"),
        ({"rating": [1.0, 1.0, 1.0]}, "an entry for each, got 3 ratings"),
        ({"rating": [AMPLIFIER, CONE]}, "are one entry: [[amplifier, loudspeaker]] * 2"),
        ({"pascal_per_unit": [1.0, 1.0, 1.0]}, "one for each of the 2 microphones"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_bad_input_is_refused(change, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        on(**change)
