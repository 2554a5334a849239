"""The plant: what its paths can be, where its rate comes from, its disturbance, and what it refuses."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import control
import numpy as np
import pytest
from helpers.channels import random_paths, through

from kfopc_filterpy import HardClipAmplifier, LinearAmplifier, Plant, bandpass_path
from kfopc_filterpy.paths import fir_path
from kfopc_filterpy.plant import estimated_secondary
from kfopc_filterpy.signals import Recording

FS = 8000.0
S, P = np.array([0.0, 0.9, -0.4]), np.array([0.0, 0.0, 1.0, 0.5])
K, J, I = 3, 2, 2  # noqa: E741
SECONDARY, PRIMARY = random_paths(K, J, 9, seed=0), random_paths(K, I, 14, seed=1)
FEEDBACK = random_paths(I, J, 5, seed=2)
DECAY = control.TransferFunction([1.0, 0.0], [1.0, -0.5], 1 / FS)  # its response is 0.5^n


def systems(paths: np.ndarray) -> list[list[Any]]:
    return [[fir_path(taps, FS) for taps in row] for row in paths]


def system(paths: np.ndarray) -> control.TransferFunction:
    """All paths as one system."""
    outputs, inputs, n_taps = paths.shape
    one = np.eye(1, n_taps)[0]
    return control.TransferFunction(paths.tolist(), [[one] * inputs] * outputs, 1 / FS)


# ---- What paths can be


@pytest.mark.parametrize(
    "kind",
    [list, np.float32, lambda taps: fir_path(taps, FS), lambda taps: Recording(taps, FS)],
    ids=["list", "float32", "system", "recording"],
)
def test_one_path_has_the_axes_of_the_channels(kind):
    plant = Plant(kind(0.5 * S), kind(P), feedback=kind(2.0 * S), fs=FS)
    np.testing.assert_allclose(plant.secondary, [[0.5 * S]], rtol=1e-7)  # that of float32
    np.testing.assert_array_equal(plant.primary, [[P]])
    assert plant.feedback.shape == (1, 1, 3)
    assert (plant.n_microphones, plant.n_loudspeakers, plant.n_references) == (1, 1, 1)
    assert plant.secondary.dtype == np.float64


@pytest.mark.parametrize("kind", [np.asarray, systems, system])
def test_several_paths_are_an_array_or_rows_of_systems_or_a_system_with_several_inputs(kind):
    plant = Plant(kind(SECONDARY), kind(PRIMARY), feedback=kind(FEEDBACK), fs=FS)
    for found, taps in ((plant.secondary, SECONDARY), (plant.primary, PRIMARY), (plant.feedback, FEEDBACK)):
        np.testing.assert_array_equal(found, taps)
    assert (plant.n_microphones, plant.n_loudspeakers, plant.n_references) == (K, J, I)


@pytest.mark.parametrize("kind", [lambda taps: Recording(taps, FS), np.float32], ids=["recordings", "pyroomacoustics"])
def test_paths_of_different_lengths_are_filled_with_zeros(kind):
    """A list for each microphone, of a path for each source: pyroomacoustics gives a room's responses like this."""
    rows = [[kind(S)], [kind(S[:2])]]
    plant = Plant(rows, primary=rows, fs=FS)
    for taps in (plant.secondary, plant.primary):
        np.testing.assert_allclose(taps, [[S], [[*S[:2], 0.0]]], rtol=1e-7)  # that of float32


def test_the_primary_paths_of_one_reference_need_no_axis_of_the_references():
    for primary in (PRIMARY[:, 0], Recording(PRIMARY[:, 0], FS)):
        np.testing.assert_array_equal(Plant(SECONDARY, primary, fs=FS).primary, PRIMARY[:, :1])


def test_an_infinite_response_has_as_many_taps_as_are_asked_for():
    """And a finite one keeps its own."""
    plant = Plant([[DECAY], [fir_path(S, FS)]], n_path=30)
    np.testing.assert_allclose(plant.secondary[0, 0], 0.5 ** np.arange(30), rtol=1e-12)
    np.testing.assert_array_equal(plant.secondary[1, 0], np.pad(S, (0, 27)))
    assert Plant(fir_path(S, FS), DECAY, n_path=30).secondary.shape == (1, 1, 3)
    changed = plant.changed_at(1.0, secondary=[[DECAY], [-DECAY]])
    np.testing.assert_array_equal(changed.at(1.0).secondary[1], -plant.secondary[0])


def test_paths_may_have_fewer_taps_than_channels():
    assert Plant([[[1.0], [0.5]]], fs=FS).secondary.shape == (1, 2, 1)
    assert Plant(np.ones((4, 4, 1)), np.ones((4, 1, 2)), fs=FS).n_references == 1


def test_a_plant_keeps_copies_that_cannot_be_written():
    taps = SECONDARY.copy()
    plant = Plant(taps, fs=FS)
    taps[:] = 0.0
    np.testing.assert_array_equal(plant.secondary, SECONDARY)
    with pytest.raises(ValueError, match="read-only"):
        plant.secondary[:] = 0.0


def test_amplifiers_are_one_for_all_or_one_for_each():
    clip = HardClipAmplifier(1.0)
    assert Plant(SECONDARY, fs=FS).amplifiers == (None, None)
    assert Plant(SECONDARY, amplifier=clip, fs=FS).amplifiers == (clip, clip)
    assert Plant(SECONDARY, amplifier=[np.tanh, None], fs=FS).amplifiers == (np.tanh, None)


def test_copies_and_pickles_are_the_plant():
    plant = Plant(S, P, amplifier=HardClipAmplifier(1.0), fs=FS).changed_at(0.1, secondary=-S)
    for other in (copy.deepcopy(plant), pickle.loads(pickle.dumps(plant))):
        assert repr(other) == repr(plant)
        np.testing.assert_array_equal(other.at(0.1).secondary, plant.at(0.1).secondary)
        assert not any(taps.flags.writeable for taps in (other.secondary, other.primary, other.at(0.1).secondary))


# ---- The sample rate


def test_the_rate_is_that_of_systems_and_recordings_or_the_one_given():
    assert Plant(bandpass_path(32, fs=48000)).fs == 48000
    assert Plant(S, Recording(P, 44100)).fs == 44100  # it holds for the taps, too
    assert Plant(S, feedback=fir_path(S, FS)).fs == FS
    assert Plant(S, fs=FS).fs == Plant(fir_path(S, FS), fs=8000).fs == FS


RATES = [
    ({}, "fs must be given, the sample rate in Hz: taps have none"),
    ({"secondary": fir_path(S, FS), "fs": 16000}, "secondary is sampled at 8000 Hz but fs is 16000 Hz"),
    ({"primary": Recording(P, FS), "fs": 16000}, "primary is sampled at 8000 Hz but fs is 16000 Hz"),
    ({"feedback": [[fir_path(S, FS)]], "fs": 16000}, r"feedback is sampled at 8000 Hz but fs is 16000 Hz"),
    (
        {"secondary": fir_path(S, FS), "primary": Recording(P, 16000)},
        "the primary path is sampled at 16000 Hz but the secondary path at 8000 Hz",
    ),
    ({"secondary": [[fir_path(S, FS)], [fir_path(S, 16000)]]}, "secondary has systems of different sampling rates"),
    ({"fs": 0.0}, "fs must be greater than 0 Hz"),
]


@pytest.mark.parametrize(("wrong", "message"), RATES, ids=range(len(RATES)))
def test_no_rate_and_rates_that_differ_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        Plant(**{"secondary": S} | wrong)


# ---- What is refused


REFUSED = [
    ({"secondary": None}, r"secondary must have shape \(K microphones, J loudspeakers, taps\)"),
    ({"secondary": []}, "secondary must have shape"),
    ({"secondary": SECONDARY[0]}, r"secondary must have shape .*, got \(2, 9\)"),
    ({"secondary": np.moveaxis(SECONDARY, 2, 0)}, "taps come last"),
    ({"secondary": [0.0, np.nan]}, "secondary must be finite"),
    ({"secondary": "paths.wav"}, "secondary must be a sequence of real numbers, got str: read .* with paths.read_path"),
    ({"secondary": Plant(S, fs=FS)}, "secondary must be a sequence of real numbers, got Plant"),
    ({"secondary": [[fir_path(S, FS)], []]}, "its rows differ in length"),
    ({"secondary": control.TransferFunction([1.0], [1.0, 2.0])}, "secondary must be a discrete-time system"),
    ({"secondary": DECAY}, r"secondary has an infinite impulse response: .* Plant\(\.\.\., n_path=\.\.\.\)"),
    ({"primary": DECAY, "n_path": 4}, "4 taps cut off -24.1 dB of the energy of primary"),
    ({"n_path": 0}, "n_path must be at least 1"),
    ({"n_path": 2.5}, "n_path must be a whole number"),
    ({"primary": PRIMARY}, r"primary must be .* with the 1 microphones of secondary, got \(3, 2, 14\)"),
    ({"feedback": S + 0.1}, "feedback must have a delay of a sample at least: a first tap is 0.1, not 0"),
    ({"feedback": FEEDBACK}, r"feedback must be .* with the 1 loudspeakers of secondary, got \(2, 2, 5\)"),
    ({"primary": P, "feedback": FEEDBACK[:, :1]}, "and the 1 references of primary"),
    ({"amplifier": 2.0}, "amplifier must be a function of a sample, or None, got 2.0"),
    ({"amplifier": [None, None]}, "amplifier"),
    ({"sensor_noise_std": -0.1}, "sensor_noise_std must not be negative"),
]


@pytest.mark.parametrize(("wrong", "message"), REFUSED, ids=range(len(REFUSED)))
def test_what_is_no_plant_is_refused(wrong, message):
    with pytest.raises((ValueError, TypeError), match=message):
        Plant(**{"secondary": S, "fs": FS} | wrong)


# ---- The disturbance


def test_the_disturbance_is_the_reference_through_the_primary_paths():
    x = np.random.default_rng(0).standard_normal((I, 300))
    d = Plant(SECONDARY, PRIMARY, fs=FS).disturbance(x)
    np.testing.assert_allclose(d, through(PRIMARY, x), rtol=0, atol=1e-12)  # sums of 28 products of order 1
    one = Plant(S, P, fs=FS).disturbance(x[0])
    np.testing.assert_allclose(one, np.convolve(x[0], P)[:300], rtol=0, atol=1e-13)
    np.testing.assert_array_equal(Plant(S, P, fs=FS).disturbance(Recording(x[0], FS)), one)


def test_one_channel_has_no_axis_unless_there_are_several_loudspeakers_or_microphones():
    x = np.random.default_rng(0).standard_normal(50)
    assert Plant(S, P, fs=FS).disturbance(x[np.newaxis]).shape == (50,)
    assert Plant([[S, S]], P, fs=FS).disturbance(x).shape == (1, 50)
    assert Plant([[S], [S]], np.stack([P, P]), fs=FS).disturbance(x).shape == (2, 50)


@pytest.mark.parametrize(
    ("plant", "reference", "message"),
    [
        (Plant(S, fs=FS), np.ones(9), r"no primary path: make it with one, Plant\(secondary, primary\)"),
        (Plant(S, P, fs=FS), np.ones((2, 9)), "reference must have the 1 channel"),
        (Plant(S, P, fs=FS), Recording(np.ones(9), 16000), "reference is sampled at 16000 Hz but fs is 8000 Hz"),
        (Plant(S, P, fs=FS), [], "reference must have at least 1 value"),
    ],
)
def test_a_disturbance_that_is_not_known_is_refused(plant, reference, message):
    with pytest.raises(ValueError, match=message):
        plant.disturbance(reference)


# ---- What it says of itself, and as an estimate


def test_a_plant_says_what_it_is():
    class Unhashable:
        __hash__ = None  # as that of a dataclass

        def __call__(self, y):
            return y

        def __repr__(self):
            return "Mine()"

    assert repr(Plant([1.0], fs=FS)) == "<Plant at 8000 Hz: secondary path of 1 tap>"
    plant = Plant(
        SECONDARY, PRIMARY, feedback=FEEDBACK, amplifier=[Unhashable(), LinearAmplifier()], fs=FS, sensor_noise_std=0.1
    )
    assert repr(plant.changed_at(1.0, secondary=-SECONDARY).changed_at(2.5, primary=-PRIMARY)) == (
        "<Plant at 8000 Hz: secondary paths 3 x 2 of 9 taps, primary paths 3 x 2 of 14 taps, "
        "feedback paths 2 x 2 of 5 taps, Mine(), LinearAmplifier(), sensor noise 0.1, changes at 1, 2.5 s>"
    )


def test_the_plant_of_the_time_of_a_change_is_the_changed_one():
    """Whatever the rounding: 1.001 s at 16 kHz are 16015.999999999998 samples."""
    for time_s in (1.001, *np.random.default_rng(0).uniform(0.001, 10.0, 100)):
        changed = Plant(S, fs=16000).changed_at(time_s, secondary=-S)
        np.testing.assert_array_equal(changed.at(time_s).secondary, [[-S]])
    with pytest.raises(ValueError, match="time_s must not be negative"):
        Plant(S, fs=FS).at(-1.0)


def test_a_plant_is_an_estimate_of_its_own_secondary_path():
    plant = Plant(S, P, fs=FS)
    taps, rate = estimated_secondary(plant)
    taps[:] = 0.0  # a copy
    np.testing.assert_array_equal(plant.secondary, [[S]])
    assert rate == FS
    with pytest.raises(ValueError, match=r"needs a plant that does not change: .* plant\.at\(time_s\)"):
        estimated_secondary(plant.changed_at(1.0, secondary=-S))
