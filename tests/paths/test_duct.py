"""The duct against closed-form resonances, travel times and an image-source sum in the time domain."""

import numpy as np
import pytest
import scipy.signal

from kfopc_filterpy.paths import Duct, causality_margin, duct_plant, frequency_response

FS = 16000.0
SPEED = 343.0
# Loudspeaker in one end, microphone at the other: the response is then a constant over 1 - r0 rL g(2L).
ENDS = {"source_m": 0.0, "reference_m": 0.0, "loudspeaker_m": 0.0, "loudspeaker_resonance_hz": None}


def responses(plant, frequencies_hz):
    """The responses of the primary and the secondary path."""
    return [frequency_response(paths[0, 0], frequencies_hz, fs=plant.fs) for paths in (plant.primary, plant.secondary)]


def _peaks(plant, count):
    """The first resonances of the secondary path."""
    frequencies = np.arange(5.0, 1500.0, 0.05)
    magnitude = np.abs(np.fft.rfft(plant.secondary[0, 0], int(FS / 0.05)))[100:30000]
    found = scipy.signal.find_peaks(magnitude, prominence=0.2 * magnitude.max())[0]
    return frequencies[found][:count]


@pytest.mark.parametrize(
    ("reflection", "closed_form"),
    [
        ((0.7, 0.7), lambda n: n * SPEED / (2 * 2.0)),  # rigid-rigid: n c / 2L
        ((-0.7, -0.7), lambda n: n * SPEED / (2 * 2.0)),  # open-open
        ((0.7, -0.7), lambda n: (2 * n - 1) * SPEED / (4 * 2.0)),  # rigid-open: (2n - 1) c / 4L
    ],
)
def test_lossless_resonances_are_the_closed_form(reflection, closed_form):
    duct = Duct(length_m=2.0, error_m=2.0, reflection=reflection, attenuation_db_per_m=0.0, **ENDS)
    expected = closed_form(np.arange(1, 9))
    # 0.1 Hz: two steps of the frequency grid; the cut of the tail at -54 dB moves a peak by less.
    np.testing.assert_allclose(_peaks(duct_plant(duct, fs=FS), 8), expected, atol=0.1)


def test_wall_loss_lowers_resonances_by_its_dispersion():
    duct = Duct(length_m=2.0, error_m=2.0, reflection=(0.7, 0.7), **ENDS)
    peaks = _peaks(duct_plant(duct, fs=FS), 8)
    nepers = 1.0 / (20 * np.log10(np.e))
    f = np.arange(1, 9) * SPEED / (2 * 2.0)  # of the lossless duct
    # Phase over a round trip: 2 pi f 2L/c + 2L a sqrt(f/1000) = 2 pi n, solved to first order.
    expected = f - nepers * SPEED * np.sqrt(f / 1000) / (2 * np.pi)
    # 2 %: second order of a shift of up to 2 %, and the loss itself, which tilts the peaks.
    np.testing.assert_allclose(peaks, expected, rtol=0.02)
    assert np.all(peaks < f)


def test_lossless_secondary_path_is_the_sum_of_its_images():
    length, speaker, error, (r0, r1), latency = 2.0, 1.2, 1.7, (0.6, -0.5), 0.25e-3
    lossless = {"attenuation_db_per_m": 0.0, "loudspeaker_resonance_hz": None, "reflection": (r0, r1)}
    plant = duct_plant(Duct(length_m=length, loudspeaker_m=speaker, error_m=error, **lossless), fs=FS)
    # Every image by itself, summed at frequencies in the flat part of the band limit.
    f = np.linspace(50, 6000, 400)
    total = np.zeros(f.size, complex)
    for trip in range(60):
        gain, travelled = (r0 * r1) ** trip, 2 * length * trip
        for factor, distance in (
            (1.0, error - speaker),
            (r0, error + speaker),
            (r1, 2 * length - error - speaker),
            (r0 * r1, 2 * length - error + speaker),
        ):
            total += gain * factor * np.exp(-2j * np.pi * f * ((travelled + distance) / SPEED + latency))
    # 1 %: what the cut leaves out, -40 dB.
    error_rms = np.linalg.norm(responses(plant, f)[1] - total) / np.linalg.norm(total)
    assert error_rms < 0.01


def test_primary_path_is_the_ratio_of_two_microphones():
    settings = {"attenuation_db_per_m": 2.0, "reflection": (0.5, -0.5), "source_m": 0.0}
    ducts = (
        Duct(reference_m=None, **settings),
        Duct(reference_m=None, loudspeaker_m=0.1, error_m=0.8, **settings),
        Duct(reference_m=0.8, **settings),
    )
    f = np.linspace(50, 6000, 400)
    at_error, at_reference, ratio = (responses(duct_plant(duct, fs=FS), f)[0] for duct in ducts)
    # 1 %: the tails cut off.
    np.testing.assert_allclose(ratio, at_error / at_reference, atol=0.01)


def test_default_duct_is_causal_by_its_geometry():
    margin = causality_margin(duct_plant(fs=FS))
    assert margin.primary_onset_s == pytest.approx(1.65 / SPEED, abs=1 / FS)
    assert margin.secondary_onset_s == pytest.approx(0.5 / SPEED + 0.25e-3, abs=2 / FS)
    # (loudspeaker - reference) / c less the electronics: 49.6 samples; onsets are whole samples.
    assert margin.margin_samples == pytest.approx(FS * (1.15 / SPEED - 0.25e-3), abs=2)


@pytest.mark.parametrize("fs", [8000.0, 16000.0, 48000.0])
def test_loudspeaker_is_a_second_order_high_pass(fs):
    f = np.array([50.0, 100.0, 200.0, 400.0, 1000.0])
    ideal, real = (
        responses(duct_plant(duct, fs=fs), f)[1]
        for duct in (Duct(loudspeaker_resonance_hz=None), Duct(loudspeaker_resonance_hz=100.0, loudspeaker_q=1.5))
    )
    s = 1j * f / 100
    expected = s**2 / (s**2 + s / 1.5 + 1)
    np.testing.assert_allclose(real / ideal, expected, atol=0.02)  # tails cut


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"error_m": 3.0}, r"positions must satisfy .* error_m = 3"),
        ({"loudspeaker_m": 0.1}, "positions must satisfy"),
        ({"source_m": -0.1}, "positions must satisfy"),
        ({"reflection": (1.0, 0.5)}, "reflection must lie strictly between -1 and 1"),
        ({"reflection": 0.5}, "reflection must be a pair"),
        ({"length_m": 0.0}, "length_m must be greater than 0"),
        ({"reflection": (0.999, 0.999), "attenuation_db_per_m": 0.0}, "the response rings too long"),
        ({"error_m": 1.4001, "electronics_delay_s": 0.0}, "rings before time zero"),
    ],
)
def test_duct_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        duct_plant(Duct(**arguments), fs=FS)
