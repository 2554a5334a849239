"""Ratings: watts and volts as limits of a control signal, against signals that just keep them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kfopc_filterpy.power import AmplifierRating, LoudspeakerRating, OutputLimits, output_limits
from kfopc_filterpy.signals import tone

FS = 16000


@pytest.mark.parametrize("volts_per_unit", [1.0, 10.0, 0.05])
def test_a_sine_at_an_amplifiers_sine_rating_has_its_watts_and_just_reaches_its_peak(volts_per_unit):
    rating = AmplifierRating(ohm=8.0, sine_watt=20.0, volts_per_unit=volts_per_unit)
    y = tone(400.0, 1.0, fs=FS, amplitude=rating.amplitude_limit)
    volts = volts_per_unit * y
    assert np.mean(volts**2) / 8.0 == pytest.approx(20.0)
    assert np.mean(y**2) == pytest.approx(rating.rated_power)
    assert rating.watt(rating.rated_power) == pytest.approx(20.0)


def test_a_noise_rating_leaves_three_decibels_more_for_peaks_than_a_sine_rating():
    sine, noise = AmplifierRating(ohm=4.0, sine_watt=50.0), AmplifierRating(ohm=4.0, noise_watt=50.0)
    assert sine.rated_power == noise.rated_power == 200.0
    assert noise.amplitude_limit / math.sqrt(noise.rated_power) == pytest.approx(2.0)
    assert (noise.amplitude_limit / sine.amplitude_limit) ** 2 == pytest.approx(2.0)


def test_a_peak_voltage_replaces_the_one_from_the_watts_and_stands_alone_for_a_sine():
    assert AmplifierRating(ohm=8.0, sine_watt=20.0, peak_volts=30.0, volts_per_unit=10.0).amplitude_limit == 3.0
    alone = AmplifierRating(ohm=8.0, peak_volts=40.0)
    assert alone.rated_power == 800.0
    assert alone.watt(alone.rated_power) == 100.0


def test_a_loudspeakers_watts_limit_the_mean_power_and_not_the_peaks():
    noise = LoudspeakerRating(6.4, noise_watt=30.0)
    assert noise.rated_power == pytest.approx(192.0)
    assert LoudspeakerRating(6.4, sine_watt=30.0).rated_power == pytest.approx(192.0)
    assert noise.amplitude_limit is None
    assert LoudspeakerRating(8.0, peak_volts=40.0).rated_power == 800.0


def test_several_ratings_give_the_strictest_of_each_limit():
    amplifier = AmplifierRating(ohm=8.0, sine_watt=100.0, peak_volts=40.0)
    small, large = (LoudspeakerRating(8.0, noise_watt=watt) for watt in (30.0, 300.0))
    assert output_limits([amplifier, small]) == OutputLimits(240.0, 40.0, 0.1, "loudspeaker's power")
    assert output_limits([amplifier, large]) == OutputLimits(800.0, 40.0, 0.1, "amplifier")
    assert output_limits(small) == OutputLimits(240.0, None, 10.0, "loudspeaker's power")
    assert output_limits(1.5) == OutputLimits(1.5)


def test_the_limiter_of_a_thermal_rating_lets_a_burst_pass_and_holds_the_mean():
    """Two seconds at twice the power are less than a fifth of ten seconds; an amplifier's 100 ms would cut them."""
    limits = LoudspeakerRating(8.0, noise_watt=1.0).limits
    assert limits.window_s == 10.0
    burst = tone(400.0, 2.0, fs=FS, amplitude=math.sqrt(2 * 16.0))
    out = limits.limiter(FS).process(burst)
    np.testing.assert_array_equal(out, burst)
    short = AmplifierRating(ohm=8.0, sine_watt=1.0).limits.limiter(FS).process(burst)
    assert np.mean(short**2) <= 8.0
    loud = limits.limiter(FS).process(tone(400.0, 25.0, fs=FS, amplitude=math.sqrt(2 * 16.0)))
    assert np.mean(loud[-round(10 * FS) :] ** 2) <= 8.0


AMPLIFIER, CONE = {"ohm": 8.0}, {"ohm": 8.0, "noise_watt": 1.0}


@pytest.mark.parametrize(
    ("kind", "sheet", "message"),
    [
        (AmplifierRating, AMPLIFIER, "sine_watt or noise_watt, or else peak_volts"),
        (AmplifierRating, AMPLIFIER | {"sine_watt": 1.0, "noise_watt": 1.0}, "got sine_watt and noise_watt"),
        (AmplifierRating, {"ohm": 0.0, "sine_watt": 1.0}, "ohm must be greater than 0"),
        (AmplifierRating, AMPLIFIER | {"sine_watt": "20 W"}, "sine_watt must be a single number in W"),
        (LoudspeakerRating, {"ohm": 8.0}, "sine_watt or noise_watt, or else peak_volts, got none"),
        (LoudspeakerRating, CONE | {"ohm": [8.0, 8.0]}, "ohm must be a single number in ohm"),
    ],
)
def test_a_rating_that_says_nothing_or_too_much_is_refused(kind, sheet, message):
    with pytest.raises((TypeError, ValueError), match=message):
        kind(**sheet)


def test_what_is_no_rating_or_differs_in_volts_is_refused():
    for ratings, message in (
        ([], "at least one rating"),
        ("20 W", "rating must be a rated power"),
        (-1.0, "rating must be greater than 0"),
        ([AmplifierRating(8.0, 1.0), LoudspeakerRating(**CONE, volts_per_unit=2.0)], "the same volts_per_unit"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            output_limits(ratings)
