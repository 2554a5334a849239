"""What the forms of KF-PB for several channels share: control filters for the primary paths that they estimate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._validate import as_count, as_nonnegative, as_positive, per_loudspeaker
from ..paths.channels import secondary_paths
from ..power.amplifiers import Amplifier
from ..power.channels import ChannelBudget
from ..power.limiter import OutputLimiter
from .base import FilteredReferenceController, listed

BLOCK_S = 0.032  # time between two solutions
PATH_MEMORY_S, MEMORY_S = 1.0, 0.5  # of the paths and of the correlation; longer for long filters:
MEMORY_LENGTHS = 16


class PrimaryPathController(FilteredReferenceController):
    """Base class: estimated primary paths, and control filters within the rated power of each loudspeaker.

    A subclass sets `_state`, whose record `numbers` counts in `waiting` the samples since the last block ended, and
    defines `primary_path` and `_end_block`, which calls `_solve`. Its arguments are described in `SharedGainKalman`.
    """

    _state: Any

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        rated_power: Any,
        n_references: int,
        n_primary: int | None,
        path_memory_s: float | None,
        memory_s: float | None,
        fs: float,
        microphone_weights: Any,
        amplifier: Amplifier | Sequence[Amplifier] | None,
        limiter: Sequence[OutputLimiter] | None,
        block: int | None = None,
    ) -> None:
        secondary, _ = secondary_paths(secondary_path)
        n_taps = as_count(n_taps, "n_taps")
        n_primary = n_taps + secondary.shape[2] if n_primary is None else as_count(n_primary, "n_primary")
        self.fs = as_positive(fs, "fs", unit="Hz")
        self.block = self._usual_block(n_primary) if block is None else as_count(block, "block")
        super().__init__(
            n_taps,
            secondary_path,
            n_references=n_references,
            multichannel=True,
            amplifier=amplifier,
            limiter=limiter,
            filtered_taps=0,
            history=n_taps + secondary.shape[2] + n_primary + self.block,
        )
        path_memory_s = self._usual_memory(PATH_MEMORY_S, n_primary) if path_memory_s is None else path_memory_s
        memory_s = self._usual_memory(MEMORY_S, n_taps) if memory_s is None else memory_s
        self.path_memory_s = as_positive(path_memory_s, "path_memory_s", unit="s")
        self.memory_s = as_positive(memory_s, "memory_s", unit="s")
        self._rated = None if rated_power is None else per_loudspeaker(rated_power, self.n_loudspeakers, "rated_power")
        self._path_weights = np.sqrt(self._microphone_weights(microphone_weights))[:, np.newaxis, np.newaxis]
        self._budget = ChannelBudget(
            self._path_weights * secondary,
            self.n_taps,
            n_primary,
            self.n_references,
            np.full(self.n_loudspeakers, np.inf) if self._rated is None else self._rated,
        )

    def _usual_block(self, n_primary: int) -> int:
        """Return the samples of a block."""
        return max(round(BLOCK_S * self.fs), 1)

    def _usual_memory(self, shortest: float, n_taps: int) -> float:
        """Return the memory in seconds for `n_taps` unknowns: an average over fewer samples would follow chance."""
        return max(shortest, MEMORY_LENGTHS * n_taps / self.fs)

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
    def primary_path(self) -> np.ndarray:
        """Estimated primary paths, (K, I, L_p); a copy."""
        raise NotImplementedError

    @property
    def rated_power(self) -> np.ndarray | None:
        """Rated output power of each loudspeaker, (J,); None if unlimited."""
        return None if self._rated is None else self._rated.copy()

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
        """Return the number of samples until the end of the block."""
        return max(self.block - int(self._state.numbers["waiting"][0]), 1)

    def after_compiled(self, state: Any) -> None:
        """Learn from the block and solve for the control filters if it has ended."""
        if state.numbers["waiting"][0] >= self.block:
            state.numbers["waiting"] = 0
            self._end_block()

    def _end_block(self) -> None:
        raise NotImplementedError

    def _solve(self, correlation: np.ndarray, keep: float) -> None:
        """Find the control filters for the present paths and the correlation, over samples that fade by `keep`."""
        # Faded like this, it is the correlation of a signal that fades, which is positive definite.
        fade = np.sqrt(keep) ** np.arange(len(correlation))
        faded = correlation * fade[:, np.newaxis, np.newaxis]
        self._budget.solve(faded, self._path_weights * self.primary_path)
        self._state.weights[...] = self._budget.weights

    def _path_noise(self, power: float, prior: float) -> tuple[float, float]:
        """Return the state noise and the initial variance of a path's tap for references of a power.

        `prior` is the energy of the references in the unknown paths, relative to the measurement noise.
        """
        size = self.n_references * self._budget.n_primary
        return 1.0 / (power * (self.path_memory_s * self.fs) ** 2), prior / (size * power)
