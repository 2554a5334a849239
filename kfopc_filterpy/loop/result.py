"""The record of a run, which `simulate` returns; figures of merit and plots are computed from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..controllers.base import listed
from ..metrics import noise_reduction_db, output_power


@dataclass(frozen=True, eq=False, repr=False)
class SimulationResult:
    """Record of a run: its signals, read-only, and what the controller did.

    A run with one channel has signals of shape (n_samples,). With several channels, the first axis is the channel: the
    reference microphone, the loudspeaker or the error microphone, as stated below. After a divergence, the signals that
    depend on the controller are NaN.

    Attributes
    ----------
    algorithm : str
        Name of the controller.
    fs : float
        Sampling frequency in Hz.
    rated_power : float, ndarray of shape (n_loudspeakers,), or None
        Rated output power of each loudspeaker: the controller's, or the one given to `simulate`.
    reference : ndarray, shape (n_samples,) or (n_references, n_samples)
        Reference x.
    disturbance, error, anti_noise : ndarray, shape (n_samples,) or (n_microphones, n_samples)
        Disturbance d, error e = d - s*y_amp (sensor noise included) and anti-noise s*y_amp at the error microphones.
    control_signal, amplifier_output : ndarray, shape (n_samples,) or (n_loudspeakers, n_samples)
        Control signal y before the amplifier, and y_amp after it.
    constraint_factor : ndarray, shape (n_samples,) or (n_loudspeakers, n_samples)
        Constraint factor; 1 for a controller without a constraint, NaN for one that does not report it.
    weights : ndarray or None, shape (n_rows, n_taps) or (n_rows, n_loudspeakers, n_references, n_taps)
        Control filter after samples 0, k, 2k, ..., if ``record_weights_every=k`` was given.
    weights_time_s : ndarray or None, shape (n_rows,)
        Times of the rows of `weights` in seconds.
    disturbance_power, secondary_path_gain : ndarray or None, shape (n_samples,)
        Power histories (eq. 10, 11), if ``record_powers=True`` was given.
    power_weight : ndarray or None, shape (n_samples,)
        Weight λ of the control power, if ``record_powers=True`` was given and the controller has one.
    diverged_at_s : float or None
        Time at which the control signal exceeded 1e6 sqrt(rated power); None if it did not.

    Examples
    --------
    >>> from kfopc_filterpy import FxLMS, simulate
    >>> from kfopc_filterpy.signals import tone
    >>> x = tone(400.0, 0.1, fs=16000)
    >>> simulate(FxLMS(8, [1.0], step_size=1e-4), x, secondary_path=[1.0], primary_path=[0.5])
    <SimulationResult FxLMS: 0.1 s at 16000 Hz, noise reduction 2.5 dB, output power 0.011>
    """

    algorithm: str
    fs: float
    rated_power: float | np.ndarray | None
    reference: np.ndarray
    disturbance: np.ndarray
    error: np.ndarray
    control_signal: np.ndarray
    amplifier_output: np.ndarray
    anti_noise: np.ndarray
    constraint_factor: np.ndarray
    weights: np.ndarray | None = None
    weights_time_s: np.ndarray | None = None
    disturbance_power: np.ndarray | None = None
    secondary_path_gain: np.ndarray | None = None
    power_weight: np.ndarray | None = None
    diverged_at_s: float | None = None

    def __post_init__(self) -> None:
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    @property
    def n_samples(self) -> int:
        """Number of samples of each channel."""
        return self.error.shape[-1]

    @property
    def time_s(self) -> np.ndarray:
        """Time of each sample in seconds, shape (n_samples,)."""
        return np.arange(self.n_samples) / self.fs

    def __repr__(self) -> str:
        n_microphones, n_loudspeakers = (x.size // self.n_samples for x in (self.error, self.control_signal))
        channels = "" if self.error.ndim == 1 else f", {n_loudspeakers} loudspeaker(s), {n_microphones} microphone(s)"
        text = f"<SimulationResult {self.algorithm}: {self.n_samples / self.fs:g} s at {self.fs:g} Hz{channels}"
        if self.diverged_at_s is not None:
            return f"{text}, diverged at {self.diverged_at_s:.3g} s>"
        reduction = noise_reduction_db(self.error, self.disturbance)
        powers = listed(output_power(self.control_signal), ".3g")
        rated = "" if self.rated_power is None else f" (rated {listed(self.rated_power, 'g')})"
        return f"{text}, noise reduction {reduction:.1f} dB, output power {powers}{rated}>"
