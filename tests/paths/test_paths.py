"""Band-pass and user paths, their taps, perturbed copies. Oracles: scipy.signal, numpy.fft, closed forms."""

import control
import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from kfopc_filterpy._taps import path_taps, sampling_rate
from kfopc_filterpy.paths.models import bandpass_path, fir_path, perturbed_path

FS = 16000.0


@pytest.mark.parametrize(
    ("n_taps", "band", "fs", "pass_zero"),
    [
        (32, (20.0, 5000.0), 16000.0, False),  # the paper's designs
        (128, (20.0, 5000.0), 16000.0, False),
        (65, (0.0, 1000.0), 8000.0, True),
        (65, (1000.0, 4000.0), 8000.0, "highpass"),
    ],
)
def test_bandpass_is_a_fir_design_by_a_hamming_window(n_taps, band, fs, pass_zero):
    path = bandpass_path(n_taps, fs=fs) if fs == FS else bandpass_path(n_taps, band, fs=fs)
    assert isinstance(path, control.TransferFunction)
    assert path.dt == 1 / fs
    edges = [edge for edge in band if 0 < edge < fs / 2]
    expected = scipy.signal.firwin(n_taps, edges, window="hamming", pass_zero=pass_zero, fs=fs)
    # The same design; python-control divides by a denominator of 1, which is exact.
    np.testing.assert_array_equal(path_taps(path), expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_taps": 32, "band": (100.0, 9000.0)}, r"band must satisfy .* fs/2 = 8000 Hz"),
        ({"n_taps": 32, "band": 100.0}, "band must be a pair"),
        ({"n_taps": 32, "band": (0.0, 8000.0)}, "use fir_path"),
        ({"n_taps": 32, "band": (100.0, 8000.0)}, "n_taps must be odd .* use 33"),
    ],
)
def test_bandpass_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        bandpass_path(**arguments, fs=FS)


@given(
    taps=st.lists(st.floats(-10, 10), min_size=1, max_size=40).filter(any),
    delay=st.integers(0, 10),
    tail=st.integers(0, 5),
)
@settings(max_examples=50, deadline=None)
def test_taps_survive_the_round_trip_through_a_system(taps, delay, tail):
    # Leading zeros, which python-control strips, are the delay and must come back.
    taps = np.concatenate([np.zeros(delay), taps, np.zeros(tail)])
    np.testing.assert_array_equal(path_taps(fir_path(taps, FS), fs=FS), taps)


def test_taps_of_an_array_are_padded_and_cut():
    np.testing.assert_array_equal(path_taps([1, 2]), [1.0, 2.0])
    np.testing.assert_array_equal(path_taps([1, 2], n_taps=4), [1.0, 2.0, 0.0, 0.0])
    np.testing.assert_array_equal(path_taps([1, 2, 1e-9], n_taps=2), [1.0, 2.0])


def _iir(order=3, low=500, high=3000):
    numerator, denominator = scipy.signal.butter(order, [low, high], "band", fs=FS)
    return numerator, denominator, control.TransferFunction(numerator, denominator, 1 / FS)


def test_infinite_response_as_transfer_function_and_state_space():
    numerator, denominator, path = _iir()
    impulse = np.eye(1, 300)[0]
    expected = scipy.signal.lfilter(numerator, denominator, impulse)
    np.testing.assert_allclose(path_taps(path, n_taps=300), expected, atol=1e-15)
    matrices = scipy.signal.tf2ss(numerator, denominator)
    space = control.StateSpace(*matrices, 1 / FS)
    # Rounding of another realisation.
    np.testing.assert_allclose(path_taps(space, n_taps=300), expected, atol=1e-12)
    delayed = control.TransferFunction(numerator, np.append(denominator, [0.0, 0.0]), 1 / FS)
    np.testing.assert_allclose(path_taps(delayed, n_taps=300)[2:], expected[:-2], atol=1e-15)


@pytest.mark.parametrize(
    ("matrices", "expected"),
    [
        (([], [], [], [[0.7]]), [0.7]),
        (([[0, 0], [1, 0]], [[1], [0]], [[0.5, 0.2]], [[0]]), [0.0, 0.5, 0.2]),
        (([[0, 1], [0, 0]], [[1], [0]], [[0.5, 0.2]], [[0.3]]), [0.3, 0.5, 0.0]),  # the second state is never reached
    ],
)
def test_a_state_space_with_a_finite_response_is_exact(matrices, expected):
    assert path_taps(control.StateSpace(*matrices, 1 / FS)).tolist() == expected


@pytest.mark.parametrize(
    ("path", "arguments", "message"),
    [
        (bandpass_path(32, fs=FS), {"fs": 8000.0}, "path is sampled at 16000 Hz but fs is 8000 Hz"),
        (control.TransferFunction([1.0], [1.0, 2.0]), {}, "discrete-time .* got dt = 0"),
        (control.TransferFunction([1.0], [1.0, 0.2], True), {}, "got dt = True"),
        (control.StateSpace(np.eye(2) / 2, np.eye(2), np.eye(2), np.zeros((2, 2)), 1 / FS), {}, "one input"),
        (_iir()[2], {}, "say how many taps of it to compute"),
        (_iir()[2], {"n_taps": 8}, "8 taps cut off .* not decayed"),
        (control.TransferFunction([1.0, 0.0], [1.0, -1.01], 1 / FS), {"n_taps": 8}, "pole of magnitude 1.01"),
        (control.TransferFunction([1.0, 0.0, 0.0], [1.0, -0.5], 1 / FS), {"n_taps": 8}, "causal"),
        (_iir(12, 20, 5000)[2], {"n_taps": 4096}, "second-order sections"),  # unstable by rounding
        ([1.0, 1.0, 1.0], {"n_taps": 2}, "2 taps cut off -4.8 dB"),
    ],
)
def test_path_taps_refuses(path, arguments, message):
    with pytest.raises(ValueError, match=message):
        path_taps(path, **arguments)


def test_path_taps_refuses_measured_responses_and_names_the_argument():
    measured = control.FrequencyResponseData([1.0, 1.0], [1.0, 2.0], 1 / FS)
    with pytest.raises(TypeError, match="primary must be a TransferFunction or StateSpace"):
        path_taps(measured, n_taps=4, name="primary")
    with pytest.raises(ValueError, match="fs must be given if path is a tap array"):
        sampling_rate([1.0])
    with pytest.raises(ValueError, match="taps must not all be zero"):
        fir_path([0.0, 0.0], FS)


@given(gain_db=st.floats(-40, 40), delay=st.integers(0, 20), flip=st.booleans())
@settings(max_examples=25, deadline=None)
def test_gain_whole_delay_and_sign_are_exact(gain_db, delay, flip):
    taps = np.array([0.0, 1.0, -0.5])
    copy = perturbed_path(taps, gain_db=gain_db, phase_deg=180.0 * flip, delay_samples=delay, fs=FS)
    expected = np.concatenate([np.zeros(delay), (-1) ** flip * 10 ** (gain_db / 20) * taps])
    np.testing.assert_allclose(path_taps(copy), expected, rtol=1e-14)


@pytest.mark.parametrize(
    ("phase", "delay", "low", "degrees", "decibels"),
    [
        # The accuracy the documentation states, with the band it holds in.
        (90.0, 0.0, 300.0, 2.5, 0.4),
        (90.0, 0.0, 500.0, 1.5, 0.4),
        (-90.0, 0.0, 300.0, 2.5, 0.4),
        (60.0, 1.5, 300.0, 2.5, 0.4),
        (0.0, 0.5, 160.0, 0.1, 0.01),
        (0.0, 2.25, 160.0, 0.1, 0.01),
    ],
)
def test_phase_and_fractional_delay_within_stated_accuracy(phase, delay, low, degrees, decibels):
    path = bandpass_path(32, fs=FS)
    copy = perturbed_path(path, gain_db=-3.0, phase_deg=phase, delay_samples=delay)
    omega = 2 * np.pi * np.linspace(low, 4500, 500) / FS
    before = scipy.signal.freqz(path_taps(path), worN=omega)[1]
    after = scipy.signal.freqz(path_taps(copy), worN=omega)[1]
    ratio = after / before / (10 ** (-3 / 20) * np.exp(1j * (np.deg2rad(phase) - omega * delay)))
    assert np.max(np.abs(np.rad2deg(np.angle(ratio)))) < degrees
    assert np.max(np.abs(20 * np.log10(np.abs(ratio)))) < decibels
    assert np.max(np.abs(scipy.signal.freqz(path_taps(copy), worN=4096)[1])) < 1.0  # no gain runs off


def test_perturbation_without_room_for_it_is_refused():
    with pytest.raises(ValueError, match="cannot be realised causally"):
        perturbed_path([1.0, 0.5], phase_deg=90.0, fs=FS)
    with pytest.raises(ValueError, match="cannot be realised causally"):
        perturbed_path([0.0, 1.0, 0.5], delay_samples=-3.0, fs=FS)
    advanced = path_taps(perturbed_path([0.0, 0.0, 0.0, 1.0, 0.5], delay_samples=-3.0, fs=FS))
    np.testing.assert_allclose(advanced[:2], [1.0, 0.5], atol=1e-10)
