"""The record of a run: its times, its protection, what it says of itself, with one channel and with several."""

import pickle
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from helpers.results import multichannel_result

from kfopc_filterpy import noise_reduction_db


def single():
    many = multichannel_result()
    names = ("reference", "disturbance", "error", "control_signal", "amplifier_output", "anti_noise")
    return replace(
        many, **{name: getattr(many, name)[0].copy() for name in names}, weights=many.weights[:, 0, 0].copy()
    )


@pytest.mark.parametrize("make", [single, multichannel_result])
def test_samples_and_times_are_those_of_the_last_axis(make):
    result = make()
    assert result.n_samples == 4000
    np.testing.assert_array_equal(result.time_s, np.arange(4000) / 16000)


@pytest.mark.parametrize("make", [single, multichannel_result])
def test_a_result_is_frozen_and_its_arrays_are_read_only(make):
    result = make()
    with pytest.raises(FrozenInstanceError):
        result.fs = 1.0
    for array in (result.error, result.weights, result.constraint_factor):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    copied = pickle.loads(pickle.dumps(result))
    np.testing.assert_array_equal(copied.error, result.error)
    assert result == result
    assert result != copied  # arrays have no single truth value: results are compared by their fields


def test_a_result_says_what_came_out():
    result = single()
    reduction = noise_reduction_db(result.error, result.disturbance)
    assert repr(result).startswith("<SimulationResult KF-OPC: 0.25 s at 16000 Hz, noise reduction 20.0 dB")
    assert f"{reduction:.1f}" == "20.0"
    assert repr(result).endswith(f"output power {np.mean(result.control_signal[2000:] ** 2):.3g} (rated 1)>")
    assert "(rated" not in repr(replace(result, rated_power=None))
    assert repr(replace(result, diverged_at_s=0.125)).endswith("16000 Hz, diverged at 0.125 s>")
