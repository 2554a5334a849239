"""Responses, delays, gain. Oracles: numpy.fft, closed forms."""

import control
import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kfopc_filterpy import Plant
from kfopc_filterpy.paths import causality_margin
from kfopc_filterpy.paths.analysis import achieved_band, frequency_response, secondary_path_gain
from kfopc_filterpy.paths.models import bandpass_path, fir_path

FS = 16000.0
TAPS = arrays(float, st.integers(1, 30), elements=st.floats(-1, 1)).filter(lambda h: np.abs(h).max() > 0.01)


def _iir():
    numerator, denominator = scipy.signal.butter(3, [500, 3000], "band", fs=FS)
    return numerator, denominator, control.TransferFunction(numerator, denominator, 1 / FS)


@given(taps=TAPS)
@settings(max_examples=50, deadline=None)
def test_frequency_response_is_the_dft(taps):
    frequencies = np.arange(33) * FS / 64
    expected = np.fft.rfft(taps, 64)
    # Rounding of a polynomial of 30 terms of size 1.
    np.testing.assert_allclose(frequency_response(taps, frequencies, fs=FS), expected, atol=1e-12)
    np.testing.assert_allclose(frequency_response(fir_path(taps, FS), frequencies), expected, atol=1e-12)


def test_frequency_response_of_an_infinite_response():
    numerator, denominator, path = _iir()
    frequencies = np.array([0.0, 100.0, 1000.0, 8000.0])
    expected = scipy.signal.freqz(numerator, denominator, worN=frequencies, fs=FS, include_nyquist=True)[1]
    np.testing.assert_allclose(frequency_response(path, frequencies), expected, atol=1e-12)


def arriving(primary, secondary, n_taps=64):
    """Return a plant whose paths have a single tap each; none for -1."""
    taps = np.vstack([np.eye(n_taps), np.zeros(n_taps)])
    return Plant(taps[np.array(secondary)], taps[np.array(primary)], fs=FS)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: frequency_response([1.0], [9000.0], fs=FS), "frequencies_hz must lie within 0 to fs/2"),
        (lambda: secondary_path_gain([1.0, 1.0], reference=[1.0]), "reference must have at least 2"),
        (lambda: achieved_band([0.0], fs=FS), "path must not be all zeros"),
        (lambda: secondary_path_gain([1.0], reference=[0.0, 0.0]), "reference must not be silent"),
        (lambda: causality_margin(Plant([1.0], fs=FS)), "plant must have a primary path"),
        (lambda: causality_margin(Plant([1.0], [0.0], fs=FS)), "primary must not be silent"),
        (lambda: causality_margin(Plant([1.0], [1.0], fs=FS).changed_at(1.0, primary=[2.0])), "does not change"),
        (lambda: causality_margin(arriving([[9], [-1]], [[2], [3]])), r"primary\[1\] must not be silent"),
        (lambda: causality_margin(arriving([[9]], [[-1, -1]])), "secondary must not be silent"),
    ],
)
def test_analysis_refuses(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@given(primary=st.integers(0, 60), secondary=st.integers(0, 60), gain=st.floats(0.1, 10))
@settings(max_examples=25, deadline=None)
def test_causality_margin_of_delays_is_their_difference(primary, secondary, gain):
    p, s = np.zeros(64), np.zeros(64)
    p[primary], s[secondary] = gain, -1.0
    margin = causality_margin(Plant(s, p, fs=FS))
    assert margin.margin_samples == pytest.approx(primary - secondary, abs=1e-9)
    assert margin.margin_s == pytest.approx((primary - secondary) / FS, abs=1e-12)
    assert margin.margins_s.tolist() == [[margin.margin_s]]


def test_gain_for_a_reference_is_equation_11():
    path = bandpass_path(32, fs=FS)
    response = frequency_response(path, (np.arange(64) + 0.5) * FS / 128)  # twice as many as taps: the mean is exact
    assert secondary_path_gain(path) == pytest.approx(np.mean(np.abs(response) ** 2), rel=1e-12)
    # A tone of whole periods: |S|² at its frequency.
    tone = np.sin(2 * np.pi * 400 * np.arange(4000 + 31) / FS)
    expected = np.abs(frequency_response(path, [400.0])[0]) ** 2
    assert secondary_path_gain(path, reference=tone) == pytest.approx(expected, rel=1e-9)
    noise = np.random.default_rng(0).standard_normal(200_000)
    # 200 000 samples of noise: a standard deviation of about 0.3 %.
    assert secondary_path_gain(path, reference=noise) == pytest.approx(secondary_path_gain(path), rel=0.015)


def test_achieved_band_of_a_known_response():
    # |1 + z^-1| / 2 = cos(pi f / fs): -3 dB at acos(10^(-3/20)) fs / pi.
    band = achieved_band([0.5, 0.5], fs=FS)
    assert band.low_hz == 0.0
    assert band.high_hz == pytest.approx(np.arccos(10 ** (-3 / 20)) * FS / np.pi, abs=1e-3)
    highpass = achieved_band([0.5, -0.5], fs=FS)
    assert (highpass.low_hz + band.high_hz, highpass.high_hz) == (pytest.approx(FS / 2, abs=1e-3), FS / 2)


def test_margins_of_several_channels_are_those_of_their_pairs():
    rng = np.random.default_rng(2)
    primary = rng.standard_normal((3, 2, 80)) * np.exp(-np.arange(80) / 20)
    primary = np.pad(primary, [(0, 0), (0, 0), (40, 0)])
    secondary = rng.standard_normal((3, 4, 90)) * np.exp(-np.abs(np.arange(90) - rng.integers(5, 30, (3, 4, 1))))
    margin = causality_margin(Plant(secondary, primary, fs=FS))

    def pairs(k, j):
        return [causality_margin(Plant(secondary[k, j], p, fs=FS)) for p in primary[k]]

    # Of the reference that arrives first.
    least = np.array([[min(m.margin_s for m in pairs(k, j)) for j in range(4)] for k in range(3)])
    np.testing.assert_allclose(margin.margins_s, least, atol=1e-15)
    # At each microphone the best loudspeaker, and of these the worst.
    assert margin.margin_s == pytest.approx(least.max(axis=1).min(), abs=1e-15)
    assert margin.margin_samples == margin.margin_s * FS


def test_an_unplugged_loudspeaker_does_not_decide_the_margin():
    margin = causality_margin(arriving([[20], [22]], [[-1, 15], [-1, 30]]))
    np.testing.assert_allclose(margin.margins_s * FS, [[-np.inf, 5], [-np.inf, -8]], atol=1e-9)
    assert margin.margin_samples == pytest.approx(-8)
    assert repr(margin) == "<CausalityMargin of 2 microphone(s) and 2 loudspeaker(s): -0.5 ms, -8 samples>"


def test_a_band_of_taps_beyond_the_grids_period_is_that_of_their_response():
    taps = np.zeros(70_000)  # the grid has a period of 65536 samples
    taps[[0, 65_536]] = 0.5, 0.5
    assert achieved_band(taps, fs=FS) == achieved_band([1.0], fs=FS)
