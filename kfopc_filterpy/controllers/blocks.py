"""Controllers of several channels that solve for the control filters within the rated powers, block by block.

Between the blocks a Kalman filter estimates, sample by sample, what the solution needs. Here is what the forms of KF-PB
have in common: the recent correlation of the references, and the solutions.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .._validate import as_positive
from ..kernels.compiling import inlined
from ..kernels.delay_lines import latest, newest
from ..kernels.records import new_record
from ..power.channels import ChannelBudget
from .base import FilteredReferenceController, listed

BLOCK_S = 0.032  # time between two solutions
DEFAULT_MEMORY_S = 0.5


class RecentCorrelation(NamedTuple):
    """Correlation of the references, whose older samples fade."""

    sums: np.ndarray  # (lags, I, I) running sum of x_i(n - m) x_k(n)
    numbers: np.ndarray  # record: keep (share kept in a sample), mass, waiting (samples since the last solution)


@inlined
def add_correlation(recent, references):
    """Add the newest sample of the delay lines `references` to their correlation."""
    r, numbers = recent.sums, recent.numbers[0]
    for i in range(references.shape[0]):
        past = newest(references[i], r.shape[0])
        for k in range(references.shape[0]):
            x = latest(references[k])
            for m in range(r.shape[0]):
                r[m, i, k] = numbers.keep * r[m, i, k] + past[m] * x
    numbers.mass = numbers.keep * numbers.mass + 1.0
    numbers.waiting += 1


class BlockController(FilteredReferenceController):
    """A controller whose control filters keep each loudspeaker's rated power, found anew in each block.

    A subclass sets `_state`, with a field `recent`, and `_budget`, and solves in `_solve`.
    """

    _rated: np.ndarray | None
    _budget: ChannelBudget

    def _new_correlation(self, n_lags: int, memory_s: float, fs: float) -> RecentCorrelation:
        """Set the sample rate, the memory and the block length; return the correlation before the first sample."""
        self.fs = as_positive(fs, "fs", unit="Hz")
        self.memory_s = as_positive(memory_s, "memory_s", unit="s")
        self.block = max(round(BLOCK_S * self.fs), 1)
        return RecentCorrelation(
            np.zeros((n_lags, self.n_references, self.n_references)),
            new_record(keep=np.exp(-1.0 / (self.memory_s * self.fs)), mass=0.0, waiting=0),
        )

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
        """Return the number of samples until the next solution."""
        return max(self.block - int(self._state.recent.numbers["waiting"][0]), 1)

    def after_compiled(self, state: Any) -> None:
        """Solve for the control filters if a block has passed."""
        recent = state.recent
        if recent.numbers["waiting"][0] < self.block:
            return
        recent.numbers["waiting"] = 0
        # Faded like this, it is the correlation of a signal that fades, which is positive definite.
        fade = np.sqrt(recent.numbers["keep"][0]) ** np.arange(len(recent.sums))
        correlation = recent.sums * fade[:, np.newaxis, np.newaxis] / recent.numbers["mass"][0]
        if np.trace(correlation[0]) > 0.0:
            self._solve(correlation)

    def _solve(self, correlation: np.ndarray) -> None:
        """Set the control filters for the present estimate and the correlation of the references, (lags, I, I)."""
        raise NotImplementedError
