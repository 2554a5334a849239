"""The scene that the loop is tested in: paths, noises, amplifiers, and a run of 500 samples."""

import numpy as np
from oracles import signals

from kfopc_filterpy import HardClipAmplifier, LinearAmplifier, Plant, SoftSaturationAmplifier, simulate

N_TAPS, N = 10, 500
S = np.array([0.0, 0.9, -0.4, 0.2, 0.1])
S_HAT = np.array([0.1, 0.8, -0.3, 0.1])  # neither its taps nor its length are those of S
FEEDBACK = np.array([0.0, 0.15, -0.1, 0.05, 0.0, 0.02, 0.01])  # longer than S
R, Q, P0, MU = 1e-5, 1e-2, 0.5, 4e-3
FS, MEMORY_S = 8000.0, 0.01  # 80 samples: forgetting is at work in a run of 500

AMPLIFIERS = {
    "none": (None, signals.linear),
    "linear": (LinearAmplifier(), signals.linear),
    "hard": (HardClipAmplifier(0.7), signals.hard_clip(0.7)),
    "soft": (SoftSaturationAmplifier(0.7, 1.5), signals.rapp(0.7, 1.5)),
}


def noises(n=N, seed=3):
    """Reference, disturbance that a control filter explains in part, sensor noise."""
    rng = np.random.default_rng(seed)
    x, other, noise = rng.standard_normal((3, n))
    return x, np.convolve(x, [0.0, 0.0, 1.2, -0.7, 0.5, 0.3])[:n] + 0.1 * other, 0.05 * noise


def run(made, *, amplifier=None, feedback=None, on=0, n=N, **options):
    """Run a controller in the scene, everything recorded."""
    x, d, _ = noises(n)
    plant = Plant(S, feedback=feedback, amplifier=amplifier, fs=FS, sensor_noise_std=0.05)
    options = {"record_weights_every": 1} | options
    return simulate(made, x, plant, disturbance=d, rng=11, switch_on_s=on / FS, **options)
