"""KF-PB for several loudspeakers and microphones: the Kalman filter estimates the primary paths.

All microphones hear the same references, so their paths have the same observation row, and one covariance and one gain
serve them all: O((I L_p)^2 + K I L_p) per sample, whatever the number of loudspeakers. The control filters follow from
the estimated paths and the recent correlation of the references (certainty equivalence), within the rated power of
each loudspeaker.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_count, as_nonnegative, as_positive, per_loudspeaker
from ..kernels.compiling import inlined
from ..kernels.covariance import Covariance, correct_weights, kalman_step, new_covariance
from ..kernels.delay_lines import latest, newest
from ..kernels.records import new_record
from ..kernels.vectors import copy_into, dot
from ..paths.channels import secondary_paths
from ..power.amplifiers import Amplifier
from ..power.channels import ChannelBudget
from ..power.constraint import DEFAULT_FS
from ..power.limiter import OutputLimiter
from .base import FilteredReferenceController, listed
from .channels import ChannelLines, estimate_disturbances
from .step import adapt, follow

PRIOR = 1e3  # energy of the reference in the unknown paths, relative to the measurement noise
BLOCK_S = 0.032  # time between two solutions
GROWN = 4.0  # growth of the references' power from which the state noise follows it: they began soft or silent


class SharedGainState(NamedTuple):
    """State of `SharedGainKalman`."""

    lines: ChannelLines
    weights: np.ndarray  # (J, I, L) control filters
    paths: np.ndarray  # (K, I L_p) estimated primary paths
    gains: Covariance  # of a row of `paths`; the measurement noise is 1
    row: np.ndarray  # (I L_p,) references, newest first
    correlation: np.ndarray  # (M, I, I) running sum of x_i(n - m) x_k(n)
    numbers: (
        np.ndarray
    )  # record: state_noise, keep (of the correlation), mass, waiting (samples since the last solution)


@adapt.register(SharedGainState)
def adapt_shared_gain(state, error, control_signal):
    """Apply eq. 2-8 to the primary path of each microphone, with the reference as the row."""
    if not estimate_disturbances(state.lines, error):
        return False
    d, h, paths, numbers = state.lines.disturbance, reference_row(state), state.paths, state.numbers[0]
    innovation, S = kalman_step(state.gains, paths[0], h, d[0], numbers.state_noise, 1.0, 1.0)
    if not np.isfinite(innovation):
        return False
    for k in range(1, paths.shape[0]):
        correct_weights(paths[k], state.gains.gain_direction, (d[k] - dot(h, paths[k])) / S)
    add_correlation(state)
    return True


@follow.register(SharedGainState)
def follow_shared_gain(state, error):
    """Add the sample to the correlation."""
    if not estimate_disturbances(state.lines, error):
        return False
    add_correlation(state)
    return True


@inlined
def reference_row(state):
    """Return the newest references, one after the other."""
    row, lines = state.row, state.lines.reference
    taps = row.size // lines.shape[0]
    for i in range(lines.shape[0]):
        copy_into(row[i * taps : (i + 1) * taps], newest(lines[i], taps))
    return row


@inlined
def add_correlation(state):
    """Add the newest sample to the correlation of the references; older samples fade."""
    r, lines, numbers = state.correlation, state.lines.reference, state.numbers[0]
    for i in range(lines.shape[0]):
        past = newest(lines[i], r.shape[0])
        for k in range(lines.shape[0]):
            x = latest(lines[k])
            for m in range(r.shape[0]):
                r[m, i, k] = numbers.keep * r[m, i, k] + past[m] * x
    numbers.mass = numbers.keep * numbers.mass + 1.0
    numbers.waiting += 1


class SharedGainKalman(FilteredReferenceController):
    """KF-PB for several channels, in real time: primary paths by a Kalman filter, control filters within the powers.

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
    path_memory_s : float, default 1
        Time in seconds over which the primary paths are averaged; longer is more exact, shorter follows changes.
    memory_s : float, default 0.5
        Memory of the correlation of the references in seconds.
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
    1. The power of the references is taken from the first block that is not silent, and again if it has grown to more
    than four times: a recording may begin softly.

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
        path_memory_s: float = 1.0,
        memory_s: float = 0.5,
        fs: float = DEFAULT_FS,
        microphone_weights: Any = None,
        amplifier: Amplifier | Sequence[Amplifier] | None = None,
        limiter: Sequence[OutputLimiter] | None = None,
    ) -> None:
        secondary, _ = secondary_paths(secondary_path)
        n_taps = as_count(n_taps, "n_taps")
        n_primary = n_taps + secondary.shape[2] if n_primary is None else as_count(n_primary, "n_primary")
        n_lags = n_taps + secondary.shape[2] + n_primary
        super().__init__(
            n_taps,
            secondary_path,
            n_references=n_references,
            multichannel=True,
            amplifier=amplifier,
            limiter=limiter,
            filtered_taps=0,
            history=n_lags,
        )
        self.fs = as_positive(fs, "fs", unit="Hz")
        self.path_memory_s = as_positive(path_memory_s, "path_memory_s", unit="s")
        self.memory_s = as_positive(memory_s, "memory_s", unit="s")
        self._rated = None if rated_power is None else per_loudspeaker(rated_power, self.n_loudspeakers, "rated_power")
        weights = self._microphone_weights(microphone_weights)
        unlimited = np.full(self.n_loudspeakers, np.inf)
        self._budget = ChannelBudget(
            np.sqrt(weights)[:, np.newaxis, np.newaxis] * secondary,
            self.n_taps,
            n_primary,
            self.n_references,
            unlimited if self._rated is None else self._rated,
        )
        self._path_weights = np.sqrt(weights)[:, np.newaxis, np.newaxis]
        self.block = max(round(BLOCK_S * self.fs), 1)
        size = self.n_references * n_primary
        self._state = SharedGainState(
            lines=self._lines,
            weights=np.zeros((self.n_loudspeakers, self.n_references, self.n_taps)),
            paths=np.zeros((self.n_microphones, size)),
            gains=new_covariance(np.zeros((size, size))),
            row=np.zeros(size),
            correlation=np.zeros((n_lags, self.n_references, self.n_references)),
            numbers=new_record(state_noise=0.0, keep=np.exp(-1.0 / (self.memory_s * self.fs)), mass=0.0, waiting=0),
        )

    def _microphone_weights(self, weights: Any) -> np.ndarray:
        if weights is None:
            return np.ones(self.n_microphones)
        if np.shape(weights) != (self.n_microphones,):
            raise ValueError(
                f"microphone_weights must have one weight for each of the {self.n_microphones} microphones, "
                f"got shape {np.shape(weights)}"
            )
        return np.array([as_nonnegative(weight, "microphone_weights") for weight in weights])

    @property
    def rated_power(self) -> np.ndarray | None:
        """Rated output power of each loudspeaker, (J,); None if unlimited."""
        return None if self._rated is None else self._rated.copy()

    @property
    def primary_path(self) -> np.ndarray:
        """Estimated primary paths, (K, I, L_p); a copy."""
        return self._state.paths.reshape(self.n_microphones, self.n_references, -1).copy()

    @property
    def power_weight(self) -> np.ndarray:
        """Weight lambda of each loudspeaker's control power, (J,)."""
        penalty = self._budget.penalty
        return np.zeros(self.n_loudspeakers) if penalty is None or self._rated is None else penalty.copy()

    def __repr__(self) -> str:
        parts = [*self._channel_counts(), f"{self.n_taps} taps"]
        if self._rated is not None:
            parts.append(f"rated power {listed(self._rated, 'g')}")
        return f"<{self.name}: {', '.join(parts)}>"

    @property
    def _powers_fs(self) -> float:
        return self.fs

    def samples_to_block(self) -> int:
        """Return the number of samples until the next solution."""
        return max(self.block - int(self._state.numbers["waiting"][0]), 1)

    def after_compiled(self, state: SharedGainState) -> None:
        """Solve for the control filters if a block has passed."""
        if state.numbers["waiting"][0] >= self.block:
            state.numbers["waiting"] = 0
            self._solve()

    def _solve(self) -> None:
        """Find the control filters for the present paths and correlation."""
        state = self._state
        mass, keep = state.numbers["mass"][0], state.numbers["keep"][0]
        # Faded like this, it is the correlation of a signal that fades, which is positive definite.
        fade = np.sqrt(keep) ** np.arange(len(state.correlation))
        correlation = state.correlation * fade[:, np.newaxis, np.newaxis] / mass
        power = np.trace(correlation[0]) / self.n_references
        if not power > 0.0:
            state.numbers["mass"] = 0.0  # the correlation begins with the first sound
            return
        self._scale(power)
        self._budget.solve(correlation, self._path_weights * self.primary_path)
        state.weights[...] = self._budget.weights

    def _scale(self, power: float) -> None:
        """Set the state noise and the initial variance for a power of the references; if it grew, the former only."""
        state = self._state
        now, wanted = state.numbers["state_noise"][0], 1.0 / (power * (self.path_memory_s * self.fs) ** 2)
        if now == 0.0:
            state.gains.triangle.flat[:: state.gains.triangle.shape[1] + 1] = PRIOR / (state.row.size * power)
        if now == 0.0 or wanted < now / GROWN:
            state.numbers["state_noise"] = wanted
