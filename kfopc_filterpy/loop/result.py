"""The record of a run, which `simulate` returns: its signals, and the figures of merit that people ask for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import metrics
from .._types import NumberOrArray
from ..controllers.base import listed

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class SimulationResult:
    """Record of a run: its signals, read-only, what the controller did, and figures of merit.

    A run with one channel has signals of shape (n_samples,). With several channels, the first axis is the channel: the
    reference microphone, the loudspeaker or the error microphone, as stated below. After a divergence, the signals that
    depend on the controller are NaN.

    Attributes
    ----------
    algorithm : str
        Name of the controller.
    fs : float
        Sample rate in Hz.
    rated_power : float, ndarray of shape (n_loudspeakers,), or None
        Rated output power of each loudspeaker, if the controller has one.
    reference : ndarray, shape (n_samples,) or (n_references, n_samples)
        Reference x.
    disturbance, error, anti_noise : ndarray, shape (n_samples,) or (n_microphones, n_samples)
        Disturbance d, error e = d - s*y_amp (sensor noise included) and anti-noise s*y_amp at the error microphones.
    control_signal, amplifier_output : ndarray, shape (n_samples,) or (n_loudspeakers, n_samples)
        Control signal y before the amplifier, and y_amp after it.
    constraint_factor : ndarray, shape (n_samples,) or (n_loudspeakers, n_samples)
        Constraint factor; 1 for a controller without a constraint, NaN for one that does not report it.
    disturbance_power, secondary_path_gain, power_weight : ndarray or None, of the shape of `control_signal`
        Running powers (eq. 10, 11), and the price of power of KF-PB; None for a controller that does not report them.
    weights : ndarray or None, shape (n_rows, n_taps) or (n_rows, n_loudspeakers, n_references, n_taps)
        Control filter after samples 0, k, 2k, ..., if ``record_weights_every=k`` was given.
    weights_time_s : ndarray or None, shape (n_rows,)
        Times of the rows of `weights` in seconds.
    diverged_at_s : float or None
        Time at which the control signal exceeded 1e6 sqrt(rated power); None if it did not.

    Examples
    --------
    >>> from kfopc_filterpy import Plant, fx_lms, simulate
    >>> from kfopc_filterpy.signals import tone
    >>> plant = Plant([1.0], [0.5], fs=16000)
    >>> run = simulate(fx_lms(8, plant, step_size=1e-3), tone(400.0, 1.0, fs=16000), plant)
    >>> run
    <SimulationResult FxLMS: 1 s at 16000 Hz, noise reduction 47.9 dB, output power 0.125>
    >>> round(run.nse_db()[-1])  # at the end
    -72
    """

    algorithm: str
    fs: float
    rated_power: Any
    reference: np.ndarray
    disturbance: np.ndarray
    error: np.ndarray
    control_signal: np.ndarray
    amplifier_output: np.ndarray
    anti_noise: np.ndarray
    constraint_factor: np.ndarray
    disturbance_power: np.ndarray | None = None
    secondary_path_gain: np.ndarray | None = None
    power_weight: np.ndarray | None = None
    weights: np.ndarray | None = None
    weights_time_s: np.ndarray | None = None
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

    @property
    def noise_reduction_db(self) -> float:
        """Noise reduction over the second half of the run in dB, see `metrics.noise_reduction_db`.

        NaN after a divergence.
        """
        return metrics.noise_reduction_db(self.error, self.disturbance)

    @property
    def output_power(self) -> NumberOrArray:
        """Mean square of the control signal over the second half of the run, of each loudspeaker, (J,)."""
        return metrics.output_power(self.control_signal)

    def nse_db(self, window_s: float = 0.005) -> np.ndarray:
        """Return the normalised squared error over the last `window_s` in dB, (n_samples,), see `metrics.nse_db`."""
        return metrics.nse_db(self.error, self.disturbance, self.fs, window_s)

    def convergence_time_s(self) -> float:
        """Return the time in s from which the error stays near its steady value, see `metrics.convergence_time_s`."""
        return metrics.convergence_time_s(self.error, self.disturbance, self.fs)

    def plot(self) -> Figure:
        """Return a figure of the run: the normalised squared error and the output power over time, and the spectra.

        With several microphones, errors are those of the first.

        Examples
        --------
        >>> from kfopc_filterpy import Plant, fx_lms, simulate
        >>> plant = Plant([1.0], [0.5], fs=8000)
        >>> x = np.random.default_rng(0).standard_normal(8000)
        >>> figure = simulate(fx_lms(8, plant, step_size=1e-3), x, plant).plot()
        >>> len(figure.axes)
        3
        """
        from ..plot.runs import plot_run

        return plot_run(self)

    def __repr__(self) -> str:
        n_microphones, n_loudspeakers = (x.size // self.n_samples for x in (self.error, self.control_signal))
        channels = "" if self.error.ndim == 1 else f", {n_loudspeakers} loudspeaker(s), {n_microphones} microphone(s)"
        text = f"<SimulationResult {self.algorithm}: {self.n_samples / self.fs:g} s at {self.fs:g} Hz{channels}"
        if self.diverged_at_s is not None:
            return f"{text}, diverged at {self.diverged_at_s:.3g} s>"
        powers = listed(self.output_power, ".3g")
        rated = "" if self.rated_power is None else f" (rated {listed(self.rated_power, 'g')})"
        return f"{text}, noise reduction {self.noise_reduction_db:.1f} dB, output power {powers}{rated}>"
