"""What a run is given beside the controller and the plant: sensor noise, and the time of switching on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from .._types import Seed
from .._validate import as_generator, as_nonnegative

STRETCH = 1600  # samples between two reports of progress, or two opportunities to interrupt a run: 0.1 s at 16 kHz
DIVERGENCE_LIMIT = 1e6  # a run stops if the control signal exceeds this multiple of sqrt(rated power)
RESULTS = ("error", "control_signal", "amplifier_output", "anti_noise")  # of a run, as they are in `Signals`
# Recorded of each loudspeaker, if the controller states it; the constraint factor in any case.
RECORDED = ("constraint_factor", "disturbance_power", "secondary_path_gain", "power_weight")


def divergence_limits(rated_power: Any, n_loudspeakers: int) -> np.ndarray:
    """Return the control signals, (J,), beyond which a run has diverged; without a rated power its scale is 1."""
    rated = 1.0 if rated_power is None else rated_power
    return DIVERGENCE_LIMIT * np.sqrt(np.broadcast_to(np.asarray(rated, dtype=np.float64), n_loudspeakers))


class SensorNoise:
    """White noise, drawn stretch by stretch."""

    def __init__(self, std: float, rng: Seed | None) -> None:
        if std > 0 and rng is None:
            raise TypeError(
                f"the plant has sensor noise (sensor_noise_std={std:g}): give rng=, a seed or a numpy.random.Generator"
            )
        self.std = std
        self.rng = as_generator(rng) if std > 0 else None

    def take(self, *shape: int) -> np.ndarray | float:
        """Return the next samples in an array of a shape, or 0 if there is no noise."""
        return 0.0 if self.rng is None else self.std * self.rng.standard_normal(shape)

    def filled(self, room: np.ndarray) -> np.ndarray | None:
        """Fill an array with the next samples and return it, or None if there is no noise."""
        if self.rng is None:
            return None
        self.rng.standard_normal(out=room)
        room *= self.std
        return room


def switch_on_sample(switch_on_s: float, fs: float, n_samples: int) -> int:
    """Return the number of samples before the control is switched on."""
    on = round(as_nonnegative(switch_on_s, "switch_on_s", unit="s") * fs)
    if on >= n_samples:
        raise ValueError(f"switch_on_s must be less than the signal's {n_samples / fs:g} s, got {switch_on_s:g} s")
    return on


@contextmanager
def naming_sample(n: int) -> Iterator[None]:
    """Add to an error the number of the sample in which it occurred."""
    try:
        yield
    except Exception as error:
        error.add_note(f"in sample {n} of the run")
        raise
