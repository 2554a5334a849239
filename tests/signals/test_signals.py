"""Primary noises against closed forms and direct Fourier sums."""

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from kfopc_filterpy.signals import band_limited_noise, compressor_noise, generators, scaled_to_power, tone

FS = 16000
# Rounding of a sum of 1e5 squares: far below 1e-12 relative.
EXACT = 1e-12


def band_share(signal, low, high):
    """Share of the power between two frequencies, from the plain Fourier transform."""
    energy = np.abs(np.fft.rfft(signal)) ** 2
    frequencies = np.fft.rfftfreq(signal.size, 1 / FS)
    return np.sum(energy[(frequencies >= low) & (frequencies <= high)]) / np.sum(energy)


def test_tone_is_the_sine_of_its_definition():
    x = tone(400.0, 0.5, fs=FS, amplitude=3.0, phase_rad=0.25)
    assert x.shape == (8000,)
    assert x.dtype == np.float64
    expected = [3.0 * np.sin(2 * np.pi * 400.0 * n / FS + 0.25) for n in range(8000)]
    # The phase reaches 1257 rad, where one rounding is 2e-13.
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-11)


def test_band_limited_noise_has_its_power_in_its_band_only():
    x = band_limited_noise((200.0, 2000.0), 4.0, fs=FS, power=0.8, rng=3)
    assert np.mean(x**2) == pytest.approx(0.8, rel=EXACT)
    # Bins outside are zero up to rounding.
    assert band_share(x, 200.0, 2000.0) == pytest.approx(1.0, abs=1e-20 + 4e-16)
    # Flat: 7200 bins per quarter hold a quarter of the power, to within 5 standard deviations (5 /
    # sqrt(1800)).
    for low in (200.0, 650.0, 1100.0, 1550.0):
        assert band_share(x, low, low + 450.0) == pytest.approx(0.25, rel=0.12)


def test_band_limited_noise_takes_the_whole_band():
    x = band_limited_noise((0.0, FS / 2), 0.01, fs=FS, rng=1)
    white = np.random.default_rng(1).standard_normal(160)
    np.testing.assert_allclose(x, white / np.sqrt(np.mean(white**2)), rtol=0, atol=1e-13)


@pytest.fixture
def steady(monkeypatch):
    """A compressor of constant speed and levels without broadband noise."""
    for name in ("_SPEED_FLUCTUATION", "_LEVEL_FLUCTUATION", "_BROADBAND_SHARE"):
        monkeypatch.setattr(generators, name, 0.0)
    monkeypatch.setattr(generators, "scaled_to_power", lambda x, power: scaled_to_power(x, power) if power else 0.0)


def test_compressor_with_steady_speed_and_levels_is_a_sum_of_exact_harmonics_and_lobes_stand_out(steady):
    ratios = []
    for seed in range(40):
        x = compressor_noise(2.0, shaft_hz=25.0, fs=4000, rng=seed, power=2.0)
        assert np.mean(x**2) == pytest.approx(2.0, rel=EXACT)
        # 25 Hz over 2 s lies on bin 50: the lines hold all of the power, up to rounding.
        energy = np.abs(np.fft.rfft(x)) ** 2
        assert np.sum(energy[50 * np.arange(1, 41)]) == pytest.approx(np.sum(energy), rel=1e-12)
        # Orders 9 and 11 surround order 10, the peak of the envelope; 8 and 12 are lobe lines.
        ratios.append(10 * np.log10(energy[50 * 12] * energy[50 * 8] / (energy[50 * 9] * energy[50 * 11])) / 2)
    # 10 dB apart; four independent spreads of 3 dB, halved, over 40 seeds: standard error 0.5 dB.
    assert np.mean(ratios) == pytest.approx(10.0, abs=2.0)


def test_compressor_broadband_share_and_band(steady, monkeypatch):
    monkeypatch.setattr(generators, "_BROADBAND_SHARE", 0.25)
    x = compressor_noise(8.0, shaft_hz=25.0, fs=FS, rng=2)
    energy = np.abs(np.fft.rfft(x)) ** 2
    energy[25 * 8 * np.arange(1, 41)] = 0.0
    # The broadband part's own share of the 40 bins, and its correlation with the lines, are about 0.5 %.
    assert np.sum(energy) / np.sum(np.abs(np.fft.rfft(x)) ** 2) == pytest.approx(0.25, rel=0.03)
    assert band_share(x, 19.9, 2000.1) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(("name", "spread"), [("_SPEED_FLUCTUATION", 0.01), ("_LEVEL_FLUCTUATION", 0.1)])
def test_compressor_speed_and_levels_wander_as_stated(steady, monkeypatch, name, spread):
    monkeypatch.setattr(generators, "_N_HARMONICS", 1)
    monkeypatch.setattr(generators, name, spread)
    x = compressor_noise(60.0, shaft_hz=100.0, bandwidth_hz=1000.0, fs=2000, rng=4)
    # One line: the phase of its analytic signal gives the momentary frequency, its magnitude the level.
    analytic = scipy.signal.hilbert(x)
    frequency = np.diff(np.unwrap(np.angle(analytic)))[200:-200] * 2000 / (2 * np.pi)
    wandering = frequency / 100.0 if name == "_SPEED_FLUCTUATION" else np.log(np.abs(analytic))[200:-200]
    # 60 s hold about 60 correlation times (2 * 0.5 s): the mean within 5/sqrt(60) spreads, the spread within 45 %.
    assert np.mean(frequency) == pytest.approx(100.0, abs=0.65)
    assert np.std(wandering) == pytest.approx(spread, rel=0.45)


@given(
    st.lists(st.floats(-1e150, 1e150).filter(lambda v: abs(v) > 1e-150), min_size=1, max_size=30), st.floats(1e-6, 1e6)
)
@settings(max_examples=100, deadline=None)
def test_scaled_signal_has_the_power_and_the_shape(values, power):
    scaled = scaled_to_power(values, power)
    assert np.mean(scaled**2) == pytest.approx(power, rel=1e-12)
    np.testing.assert_array_equal(np.sign(scaled[np.abs(scaled) > 0]), np.sign(np.array(values))[np.abs(scaled) > 0])
    # Scaling again to the same power changes nothing but rounding.
    np.testing.assert_allclose(scaled_to_power(scaled, power), scaled, rtol=1e-12, atol=0)


def test_channels_are_scaled_by_one_gain():
    np.testing.assert_allclose(scaled_to_power([[1.0, -1.0], [2.0, 2.0]], 10.0), [[2.0, -2.0], [4.0, 4.0]], rtol=1e-12)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: tone(8000.0, 1.0, fs=FS), ValueError, "frequency_hz must be below fs/2 = 8000 Hz"),
        (lambda: tone(400.0, 1.0, fs=FS, amplitude=-1.0), ValueError, "amplitude must not be negative"),
        (lambda: band_limited_noise((200, 9000), 1.0, fs=FS, rng=1), ValueError, "band must satisfy"),
        (lambda: band_limited_noise((201, 210), 0.01, fs=FS, rng=1), ValueError, "too short for the band 201 to"),
        (lambda: band_limited_noise((200, 2000), 1.0, fs=FS, rng=None), TypeError, "rng must be a seed"),
        (lambda: compressor_noise(1.0, shaft_hz=200.0, fs=FS, rng=1), ValueError, "beyond fs/2"),
        (
            lambda: compressor_noise(1.0, bandwidth_hz=20.0, fs=FS, rng=1),
            ValueError,
            "bandwidth_hz must be above 20 Hz",
        ),
        (lambda: compressor_noise(1.0, bandwidth_hz=9e3, fs=FS, rng=1), ValueError, "at most fs/2 = 8000 Hz, got 9"),
        (lambda: compressor_noise(0.001, bandwidth_hz=500, fs=FS, rng=1), ValueError, "too short for"),
        (lambda: scaled_to_power([0.0, 0.0], 1.0), ValueError, "signal must not be all zeros"),
        (lambda: scaled_to_power([1j], 1.0), TypeError, "signal must be a sequence of real numbers"),
    ],
)
def test_refusals_say_what_was_wrong(call, error, message):
    with pytest.raises(error, match=message):
        call()


@pytest.mark.parametrize(
    "make",
    [
        lambda rng: band_limited_noise((50.0, 450.0), 0.5, fs=FS, rng=rng),
        lambda rng: compressor_noise(0.5, fs=16000.0, rng=rng),
    ],
)
def test_a_seed_repeats_and_the_global_state_is_left_alone(make):
    before = np.random.get_state()[1].copy()  # noqa: NPY002 - the state that must not matter
    first = make(7)
    np.testing.assert_array_equal(first, make(7))
    np.testing.assert_array_equal(first, make(np.random.default_rng(7)))
    assert not np.array_equal(first, make(8))
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
