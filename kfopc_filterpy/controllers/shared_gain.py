"""KF-PB for several loudspeakers and microphones: the Kalman filter estimates the primary paths.

The primary paths to all microphones have the same references as their inputs, so they share one observation row, and
one covariance and one gain serve them all: O((I L_p)^2 + K I L_p) operations per sample, whatever the number of
loudspeakers. The control filters are computed from the estimated paths and the recent correlation of the references
(certainty equivalence), within the rated power of each loudspeaker.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..kernels.compiling import inlined
from ..kernels.covariance import DIRECTION, Covariance, correct_weights, kalman_step, new_covariance
from ..kernels.delay_lines import newest
from ..kernels.records import new_record
from ..kernels.vectors import copy_into, dot
from ..paths.uncertainty import ONE_SAMPLE
from ..power.amplifiers import Amplifier
from ..power.budget import DEFAULT_AVERAGING_S
from ..power.constraint import DEFAULT_FS
from ..power.limiter import OutputLimiter
from .blocks import DEFAULT_MEMORY_S
from .channels import ChannelLines, sample_is_finite
from .primary_paths import DEFAULT_PATH_MEMORY_S, PrimaryPathController
from .step import adapt, follow

PRIOR = 1e3  # energy of the references in the unknown paths, relative to the measurement noise


class SharedGainState(NamedTuple):
    """State of `SharedGainKalman`."""

    lines: ChannelLines
    weights: np.ndarray  # (J, I, L) control filters
    paths: np.ndarray  # (K, I L_p) estimated primary paths
    gains: Covariance  # of a row of `paths`; the measurement noise is 1
    row: np.ndarray  # (I L_p,) references, newest first
    numbers: np.ndarray  # record: state_noise, waiting (samples since the last solution)


@adapt.register(SharedGainState)
def adapt_shared_gain(state, error, control_signal):
    """Apply eq. 2-8 to the primary path of each microphone, with the reference as the row."""
    if not sample_is_finite(state.lines, error):
        return False
    d, h, paths, numbers = state.lines.disturbance, reference_row(state), state.paths, state.numbers[0]
    innovation, S = kalman_step(state.gains, paths[0], h, d[0], numbers.state_noise, 1.0, 1.0)
    if not np.isfinite(innovation):
        return False
    direction, root = state.gains.memory[DIRECTION : DIRECTION + h.size], np.sqrt(S)
    for k in range(1, paths.shape[0]):
        correct_weights(paths[k], direction, (d[k] - dot(h, paths[k])) / root)
    numbers.waiting += 1
    return True


@follow.register(SharedGainState)
def follow_shared_gain(state, error):
    """Count the sample; its references are in the delay lines."""
    if not sample_is_finite(state.lines, error):
        return False
    state.numbers[0].waiting += 1
    return True


@inlined
def reference_row(state):
    """Return the newest references, one after the other."""
    row, lines = state.row, state.lines.reference
    taps = row.size // lines.shape[0]
    for i in range(lines.shape[0]):
        copy_into(row[i * taps : (i + 1) * taps], newest(lines[i], taps))
    return row


class SharedGainKalman(PrimaryPathController):
    """KF-PB for several channels: a Kalman filter estimates the primary paths; control filters keep the rated powers.

    Parameters
    ----------
    n_taps : int
        Taps L of each control filter.
    secondary_path : array_like, shape (K, J, n_path), or nested sequence of control systems
        Estimated secondary paths, loudspeaker j to microphone k.
    rated_power : float or array_like, shape (J,), optional
        Rated power of each loudspeaker; by default unlimited.
    n_references : int, default 1
        Number of references I.
    n_primary : int, optional
        Taps L_p of the estimated primary paths; by default ``n_taps`` plus the taps of the secondary paths.
    secondary_path_uncertainty : PathTolerance, float or array_like, optional
        Uncertainty of the secondary paths, see `paths.path_uncertainty`; by default a sample of delay. None: the
        paths are exact.
    path_memory_s : float, default 1
        Time in seconds over which the primary paths are averaged: a longer one is more exact, a shorter one follows
        changes faster.
    memory_s : float, default 0.5
        Memory of the correlation of the references in seconds.
    averaging_s : float, default 10
        Time in seconds over which the mean powers are kept to the rated ones, at least 8 blocks; see `PowerBudget`.
    fs : float, default 16000
        Sample rate in Hz.
    microphone_weights : array_like, shape (K,), optional
        Weight of each microphone's squared error; 0 leaves a microphone out. By default 1.
    amplifier, limiter
        As for `FilteredReferenceController`.

    Raises
    ------
    ValueError, TypeError
        A setting that is out of range, or whose shape does not fit the secondary paths.

    Notes
    -----
    Only the ratio of the state noise to the measurement noise matters here. The state noise is
    ``1 / (E[x^2] (path_memory_s fs)^2)`` and the initial variance ``1000 / (I L_p E[x^2])``, for a measurement noise of
    1. The power of the references is taken from the first block that is not silent. If the power grows to more than
    four times that value, the state noise is set anew, because a recording may begin softly.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.controllers import SharedGainKalman
    >>> paths = np.zeros((2, 2, 8))
    >>> paths[:, :, 1] = [[1.0, 0.3], [0.2, 1.0]]
    >>> SharedGainKalman(32, paths, rated_power=0.5)
    <KF-PB (shared gain): 2 microphones, 2 loudspeakers, 1 reference, 32 taps, rated power 0.5, 0.5>
    """

    name = "KF-PB (shared gain)"

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        rated_power: Any = None,
        n_references: int = 1,
        n_primary: int | None = None,
        secondary_path_uncertainty: Any = ONE_SAMPLE,
        path_memory_s: float = DEFAULT_PATH_MEMORY_S,
        memory_s: float = DEFAULT_MEMORY_S,
        averaging_s: float = DEFAULT_AVERAGING_S,
        fs: float = DEFAULT_FS,
        microphone_weights: Any = None,
        amplifier: Amplifier | Sequence[Amplifier] | None = None,
        limiter: Sequence[OutputLimiter] | None = None,
    ) -> None:
        super().__init__(
            n_taps,
            secondary_path,
            rated_power=rated_power,
            n_references=n_references,
            n_primary=n_primary,
            secondary_path_uncertainty=secondary_path_uncertainty,
            path_memory_s=path_memory_s,
            memory_s=memory_s,
            averaging_s=averaging_s,
            fs=fs,
            microphone_weights=microphone_weights,
            amplifier=amplifier,
            limiter=limiter,
        )
        size = self.n_references * self._budget.n_primary
        self._state = SharedGainState(
            lines=self._lines,
            weights=np.zeros((self.n_loudspeakers, self.n_references, self.n_taps)),
            paths=np.zeros((self.n_microphones, size)),
            gains=new_covariance(np.zeros((size, size))),
            row=np.zeros(size),
            numbers=new_record(state_noise=0.0, waiting=0),
        )

    @property
    def primary_path(self) -> np.ndarray:
        """Estimated primary paths, (K, I, L_p); a copy."""
        return self._state.paths.reshape(self.n_microphones, self.n_references, -1).copy()

    def _end_block(self, references: np.ndarray) -> None:
        """Solve for the control filters."""
        power, numbers = self._reference_power(), self._state.numbers
        if not power > 0.0:
            return
        if numbers["state_noise"][0] == 0.0:
            size = self._state.row.size
            first = new_covariance(self._first_variance(PRIOR, power) * np.eye(size))
            self._state.gains.memory[:] = first.memory
        numbers["state_noise"] = self._state_noise(numbers["state_noise"][0], power)
        self._solve()
