"""The record of a run: its times, its protection, what it says of itself, with one channel and with several."""

import pickle
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from helpers.results import multichannel_result, single_result

from kfopc_filterpy import metrics


@pytest.mark.parametrize("make", [single_result, multichannel_result])
def test_samples_and_times_are_those_of_the_last_axis(make):
    result = make(4000)
    assert result.n_samples == 4000
    np.testing.assert_array_equal(result.time_s, np.arange(4000) / 16000)


def test_a_result_is_frozen_and_its_arrays_are_read_only():
    result = multichannel_result()
    with pytest.raises(FrozenInstanceError):
        result.fs = 1.0
    for array in (result.error, result.weights, result.constraint_factor):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    copied = pickle.loads(pickle.dumps(result))
    np.testing.assert_array_equal(copied.error, result.error)
    assert result == result
    assert result != copied  # arrays have no single truth value: results are compared by their fields


@pytest.mark.parametrize("make", [single_result, multichannel_result])
def test_figures_of_merit_are_those_of_its_signals(make):
    run = make(4000)
    assert run.noise_reduction_db == metrics.noise_reduction_db(run.error, run.disturbance)
    np.testing.assert_array_equal(run.output_power, metrics.output_power(run.control_signal))
    np.testing.assert_array_equal(run.nse_db(0.01), metrics.nse_db(run.error, run.disturbance, run.fs, 0.01))
    assert run.convergence_time_s() == metrics.convergence_time_s(run.error, run.disturbance, run.fs)


def test_a_result_says_what_came_out():
    result = single_result(4000)  # the error is half of the disturbance
    said = "<SimulationResult KF-OPC: 0.25 s at 16000 Hz, noise reduction 6.0 dB, output power 1 (rated 1)>"
    assert repr(result) == said
    assert "(rated" not in repr(replace(result, rated_power=None))
    assert repr(replace(result, diverged_at_s=0.125)).endswith("16000 Hz, diverged at 0.125 s>")
