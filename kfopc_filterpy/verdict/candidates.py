"""The settings that a verdict tries for each algorithm: one if it is known beforehand, else several, the smallest first.

Leaky FxLMS is not here, because its leak has to be tuned to the rated power; optimal leaky FxLMS computes it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import fftconvolve

from kfopc_filterpy import OutputPowerConstraint
from kfopc_filterpy.bounds import SuggestedSettings

from .limits import Limits

# Step sizes over the taps and the power of the filtered reference. From twice the largest on, gradient descent diverges
# on any noise; with the smallest it learns for some 10^4 samples per tap.
STEP_SIZES = tuple((2.0 ** np.arange(-14.0, 0.0)).tolist())
# r E[x'^2]/q: the filter forgets over about its inverse square root in samples. The diagonal filter learns as slowly as
# NLMS, and needs less state noise than the full one, whose best is at 1e-8 to 1e-4.
DIAGONAL_STATE_NOISES = (1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4)
FORGOTTEN = (1e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3)  # 1 - lambda: memories of 10^6 to 10^3 samples
RIDGE = 0.01  # of FxNLMS, over the energy in the delay line: it is for the start
DIRECT = ("KF-OPC", "KF-ANC")  # a sample takes K (J I L)^2 operations
ONE_CHANNEL = ("FxRLS",)
# The settings that are suggested or tried; the others follow from the rating and the path.
CHOSEN = (
    *("step_size", "output_step_size", "regularization", "forgetting"),
    *("state_noise", "measurement_noise", "initial_variance"),
)

Settings = dict[str, Any]


def filtered_power(x: np.ndarray, s: np.ndarray) -> float:
    """Return the power of the filtered reference; it makes step sizes and state noises comparable.

    With several channels, it is summed over microphones and references, and averaged over loudspeakers.
    """
    x, s = np.atleast_2d(x), s if s.ndim == 3 else s.reshape(1, 1, -1)
    filtered = fftconvolve(x[np.newaxis, np.newaxis], s[:, :, np.newaxis], axes=-1)[..., : x.shape[1]]
    return float(np.mean(filtered**2, axis=(1, 3)).sum())


@dataclass
class Known:
    """What is known before the runs: ratings, suggested settings, powers of the reference and of the filtered one."""

    fs: float
    limits: Limits
    suggested: SuggestedSettings
    uncertainty: Any
    reference_power: float
    filtered_power: float

    @property
    def noises(self) -> Settings:
        """Suggested settings of a Kalman filter."""
        return self.suggested.noises

    @property
    def energy(self) -> float:
        """Energy of the filtered reference in the delay line."""
        return self.suggested.n_taps * self.filtered_power

    @property
    def constraint(self) -> Settings:
        """Output power constraint, or one for each loudspeaker."""
        each = (OutputPowerConstraint(one.rated_power, fs=self.fs) for one in self.limits.each)
        return {"constraint": self.limits.own(each)}

    @property
    def peak(self) -> Settings:
        """Amplitude at which the amplifier clips, by default the peak of a sine at rated power."""
        each = (one.amplitude_limit or np.sqrt(2.0 * one.rated_power) for one in self.limits.each)
        return {"amplitude_limit": self.limits.own(each)}

    def steps(self, **further: Any) -> list[Settings]:
        """Return all step sizes, with further settings."""
        return [{"step_size": step / self.energy, **further} for step in STEP_SIZES]


def _power_budget(known: Known) -> list[Settings]:
    budget = {"rated_power": known.limits.rated_power, "fs": known.fs}
    return [budget | {"secondary_path_uncertainty": known.uncertainty}]


def _diagonal(known: Known) -> list[Settings]:
    per_noise = known.noises["measurement_noise"] / known.filtered_power
    return [known.noises | {"state_noise": noise * per_noise} for noise in DIAGONAL_STATE_NOISES]


def _forgetting(known: Known) -> list[Settings]:
    variance = known.noises["initial_variance"] / known.noises["measurement_noise"]
    return [{"forgetting": 1.0 - forgotten, "initial_variance": variance} for forgotten in FORGOTTEN]


def _two_gradients(known: Known) -> list[Settings]:
    gain = known.filtered_power / known.reference_power  # of the secondary path, for the reference
    return [own | {"output_step_size": gain * own["step_size"]} for own in known.steps(**known.peak)]


CANDIDATES: dict[str, Callable[[Known], list[Settings]]] = {
    "KF-PB": _power_budget,
    "KF-OPC": lambda known: [known.noises | known.constraint],
    "FxLMS": lambda known: known.steps(),
    "KF-ANC": lambda known: [known.noises],
    "diagonal KF": _diagonal,
    "FxRLS": _forgetting,
    "FxNLMS": lambda known: [{"step_size": step, "regularization": RIDGE * known.energy} for step in STEP_SIZES],
    "optimal leaky FxLMS": lambda known: known.steps(**known.constraint),
    "MOV-FxLMS": lambda known: known.steps(**known.constraint),
    "MOV-MFxLMS": lambda known: known.steps(**known.constraint),
    "two-gradient FxLMS": _two_gradients,
    "re-scaling FxLMS": lambda known: known.steps(**known.peak),
    "clipping FxLMS": lambda known: known.steps(**known.peak),
}
