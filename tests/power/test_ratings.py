"""Ratings: watts, volts and millimetres as limits of a control signal, against signals that just keep them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kfopc_filterpy.power import AmplifierRating, LoudspeakerRating, OutputLimits, output_limits
from kfopc_filterpy.signals import band_limited_noise, tone

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


def test_programme_power_counts_half_and_an_impedance_curve_by_its_minimum():
    curve = ([20.0, 80.0, 300.0, 2000.0], [7.0, 40.0, 6.4, 12.0])
    noise = LoudspeakerRating(curve, noise_watt=30.0)
    assert noise.ohm == 6.4
    assert noise.rated_power == pytest.approx(192.0)
    assert LoudspeakerRating(curve, programme_watt=60.0).rated_power == pytest.approx(192.0)
    assert LoudspeakerRating(6.4, sine_watt=30.0).rated_power == pytest.approx(192.0)
    assert noise.amplitude_limit is None
    assert LoudspeakerRating(8.0, peak_volts=40.0).rated_power == 800.0


@pytest.mark.parametrize("hz", [50.0, 100.0, 400.0])
def test_a_tone_at_the_excursions_power_moves_the_cone_to_x_max(hz):
    rating = LoudspeakerRating(
        8.0,
        x_max_mm=3.0,
        displacement_mm_per_volt=([50.0, 100.0, 400.0], [0.4, 0.8, 0.02]),
        excursion_crest_factor=math.sqrt(2.0),
        volts_per_unit=5.0,
    )
    y = tone(hz, 1.0, fs=FS)
    y = y * math.sqrt(rating.excursion_rated_power(y, FS) / np.mean(y**2))
    assert np.abs(rating.displacement_mm(y, FS)).max() == pytest.approx(3.0, rel=1e-6)


def test_the_excursion_of_noise_depends_on_its_band_and_not_on_its_level():
    curve = ([20.0, 80.0, 1000.0], [0.5, 0.5, 0.005])
    rating = LoudspeakerRating(8.0, x_max_mm=2.0, displacement_mm_per_volt=curve)
    low, high = (band_limited_noise(band, 2.0, fs=FS, rng=1) for band in ((30, 80), (500, 1000)))
    assert rating.excursion_rated_power(low, FS) == pytest.approx((2.0 / 2.0 / 0.5) ** 2, rel=0.05)
    assert rating.excursion_rated_power(high, FS) > 3 * rating.excursion_rated_power(low, FS)
    assert rating.excursion_rated_power(7 * low, FS) == pytest.approx(rating.excursion_rated_power(low, FS))
    assert rating.excursion_rated_power(np.zeros(100), FS) == math.inf
    assert LoudspeakerRating(8.0, noise_watt=30.0).excursion_rated_power(low, FS) == math.inf


def test_several_ratings_give_the_strictest_of_each_limit():
    amplifier = AmplifierRating(ohm=8.0, sine_watt=100.0, peak_volts=40.0)
    small, large = (LoudspeakerRating(8.0, noise_watt=watt, thermal_window_s=5.0) for watt in (30.0, 300.0))
    assert output_limits([amplifier, small]) == OutputLimits(240.0, 40.0, 0.1, "loudspeaker's power")
    assert output_limits([amplifier, large]) == OutputLimits(800.0, 40.0, 0.1, "amplifier")
    assert output_limits(small) == OutputLimits(240.0, None, 5.0, "loudspeaker's power")
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
        (LoudspeakerRating, {"ohm": 8.0}, "one of noise_watt, sine_watt and programme_watt"),
        (LoudspeakerRating, {"ohm": 8.0, "x_max_mm": 3.0}, "must be given together"),
        (LoudspeakerRating, CONE | {"displacement_mm_per_volt": 1.0}, "must be given together"),
        (LoudspeakerRating, CONE | {"ohm": ([50.0, 80.0], [8.0, 0.0])}, "greater than 0 ohm, got 0"),
        (LoudspeakerRating, CONE | {"ohm": ([100.0, 50.0], [8.0, 8.0])}, "frequencies of ohm must rise"),
        (LoudspeakerRating, CONE | {"ohm": ([50.0], [8.0, 8.0])}, "a value for each frequency"),
        (LoudspeakerRating, CONE | {"ohm": [8.0, 8.0, 8.0]}, "ohm must be a number in ohm, or freq"),
    ],
)
def test_a_rating_that_says_nothing_or_too_much_is_refused(kind, sheet, message):
    with pytest.raises((TypeError, ValueError), match=message):
        kind(**sheet)


def test_limits_that_do_not_limit_the_power_or_differ_in_volts_are_refused():
    for ratings, message in (
        ([], "at least one rating"),
        ("20 W", "rating must be a rated power"),
        (-1.0, "rating must be greater than 0"),
        (LoudspeakerRating(8.0, x_max_mm=1.0, displacement_mm_per_volt=1.0), "must limit the mean power"),
        ([AmplifierRating(8.0, 1.0), LoudspeakerRating(**CONE, volts_per_unit=2.0)], "the same volts_per_unit"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            output_limits(ratings)
    with pytest.raises(ValueError, match="displacement_mm needs"):
        LoudspeakerRating(**CONE).displacement_mm([1.0], FS)


def test_a_loudspeakers_peak_volts_and_watts_are_in_units_of_the_control_signal():
    rating = LoudspeakerRating(8.0, noise_watt=2.0, peak_volts=12.0, volts_per_unit=4.0)
    assert rating.amplitude_limit == pytest.approx(12.0 / 4.0)
    assert rating.watt(1.0) == pytest.approx(4.0**2 / 8.0)
    assert rating.watt(rating.rated_power) == pytest.approx(2.0)
    peak_alone = LoudspeakerRating(8.0, peak_volts=12.0, volts_per_unit=4.0)
    assert peak_alone.rated_power == pytest.approx(72.0 / 4.0**2)  # of a sine


def test_limits_are_ratings_themselves():
    limits = OutputLimits(1.5, 3.0, 0.25, "fuse")
    assert output_limits(limits) == limits
    both = output_limits([limits, AmplifierRating(ohm=8.0, sine_watt=1.0)])
    assert (both.rated_power, both.amplitude_limit, both.decided_by) == (1.5, 3.0, "fuse")
