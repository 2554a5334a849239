"""Results made by hand, with one channel and with several."""

import numpy as np

from kfopc_filterpy import SimulationResult

N_MICROPHONES, N_LOUDSPEAKERS, N_REFERENCES, N_TAPS = 3, 2, 1, 4


def multichannel_result(n_samples: int = 4000, fs: float = 16000.0, seed: int = 0, **changes) -> SimulationResult:
    """Return a run with three microphones, two loudspeakers and one reference."""
    rng = np.random.default_rng(seed)
    disturbance = rng.standard_normal((N_MICROPHONES, n_samples)) * [[1.0], [2.0], [3.0]]
    error = disturbance * [[0.1], [0.2], [0.3]]
    control = rng.standard_normal((N_LOUDSPEAKERS, n_samples)) * [[0.5], [1.0]]
    every = 100
    fields = {
        "algorithm": "KF-OPC",
        "fs": fs,
        "rated_power": 1.0,
        "reference": rng.standard_normal((N_REFERENCES, n_samples)),
        "disturbance": disturbance,
        "error": error,
        "control_signal": control,
        "amplifier_output": np.clip(control, -1.0, 1.0),
        "anti_noise": disturbance - error,
        "constraint_factor": np.full(n_samples, 0.5),
        "weights": rng.standard_normal((n_samples // every, N_LOUDSPEAKERS, N_REFERENCES, N_TAPS)),
        "weights_time_s": np.arange(n_samples // every) * every / fs,
    }
    return SimulationResult(**(fields | changes))


def single_result(n_samples: int = 400, fs: float = 16000.0, **changes) -> SimulationResult:
    """Return a run with one microphone, loudspeaker and reference that cancels half of the disturbance."""
    disturbance = np.ones(n_samples)
    fields = {
        "algorithm": "KF-OPC",
        "fs": fs,
        "rated_power": 1.0,
        "reference": disturbance,
        "disturbance": disturbance,
        "error": 0.5 * disturbance,
        "control_signal": disturbance,
        "amplifier_output": disturbance,
        "anti_noise": 0.5 * disturbance,
        "constraint_factor": np.full(n_samples, 0.5),
    }
    return SimulationResult(**(fields | changes))
