"""What a run needs beside what it returns."""

from __future__ import annotations

import tracemalloc

import numpy as np

from kfopc_filterpy import Plant, mov_fx_lms, simulate

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
    """60 s at 48 kHz with 1024 taps, beside the returned signals."""
    lms = peak_beyond_the_result(lambda: mov_fx_lms(1024, PLANT, step_size=1e-6, rated_power=1.0), 60 * 48000)
    assert 0 < lms < 30e6
