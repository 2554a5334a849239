"""What a run needs beside what it returns."""

from __future__ import annotations

import tracemalloc

import numpy as np

from kfopc_filterpy import Plant, kf_opc, mov_fx_lms, simulate

PLANT = Plant(np.ones(32) / 32, np.ones(128) / 128, fs=48000, sensor_noise_std=0.1)


def peak_beyond_the_result(make, n_samples):
    """Bytes allocated at the worst moment of a run, less those of the result."""
    x = np.random.default_rng(0).standard_normal(n_samples)
    simulate(make(), x[:10], PLANT, rng=1)  # compiled, imported
    controller = make()
    tracemalloc.start()
    result = simulate(controller, x, PLANT, rng=1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak - sum(value.nbytes for value in vars(result).values() if isinstance(value, np.ndarray))


def test_memory_of_a_minute_at_48_khz():
    """60 s at 48 kHz with 1024 taps: within 50 MB of the returned signals. The LMS run has all of the loop's memory..."""
    lms = peak_beyond_the_result(lambda: mov_fx_lms(1024, PLANT, step_size=1e-6, rated_power=1.0), 60 * 48000)
    assert 0 < lms < 30e6


def test_memory_of_1024_taps():
    """... and what the Kalman filter adds does not grow with the signal: P, 8.4 MB, which the controller brings along."""
    kalman = {"state_noise": 1e-8, "measurement_noise": 1.0, "initial_variance": 1e-3}
    run_alone = peak_beyond_the_result(lambda: kf_opc(1024, PLANT, rated_power=1.0, **kalman), 500)
    assert run_alone < 50e6 - 30e6 - 8.4e6
