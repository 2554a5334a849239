"""What a run needs beside what it returns."""

from __future__ import annotations

import tracemalloc

import numpy as np

from kfopc_filterpy import MOVFxLMS, kf_opc, simulate
from kfopc_filterpy.power.constraint import OutputPowerConstraint


def peak_beyond_the_result(make, n_samples, **options):
    """Bytes allocated at the worst moment of a run, less those of the result."""
    x = np.random.default_rng(0).standard_normal(n_samples)
    paths = {"primary_path": np.ones(128) / 128, "secondary_path": np.ones(32) / 32, "fs": 48000.0}
    simulate(make(), x[:10], **paths)  # compiled, imported
    controller = make()
    tracemalloc.start()
    result = simulate(controller, x, sensor_noise_std=0.1, rng=1, **paths, **options)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak - sum(value.nbytes for value in vars(result).values() if isinstance(value, np.ndarray))


def test_memory_of_a_minute_at_48_khz():
    """60 s at 48 kHz with 1024 taps: within 50 MB of the returned signals. The LMS run has all of the loop's memory..."""
    settings = {"constraint": OutputPowerConstraint(1.0, fs=48000.0)}
    lms = peak_beyond_the_result(lambda: MOVFxLMS(1024, np.ones(32) / 32, step_size=1e-6, **settings), 60 * 48000)
    assert 0 < lms < 30e6


def test_memory_of_1024_taps():
    """... and what the Kalman filter adds does not grow with the signal: P, 8.4 MB, which the controller brings along."""
    kalman = {"state_noise": 1e-8, "measurement_noise": 1.0, "initial_variance": 1e-3}
    settings = {"constraint": OutputPowerConstraint(1.0, fs=48000.0)}
    run_alone = peak_beyond_the_result(lambda: kf_opc(1024, np.ones(32) / 32, **kalman, **settings), 500)
    assert run_alone < 50e6 - 30e6 - 8.4e6
