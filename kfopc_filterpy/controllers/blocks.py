"""Controllers of several channels that solve for the control filters within the rated powers, block by block.

In each sample, a Kalman filter either learns or stores what it will learn from at the end of the block. This module has
what the forms of KF-PB have in common: the blocks, the recent correlation of the references, and the rated powers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .._validate import as_count, as_positive, per_loudspeaker
from ..kernels.correlation import FadingCorrelation
from ..kernels.delay_lines import newest
from ..paths.channels import secondary_paths
from ..paths.uncertainty import as_uncertainty, guard_filter, path_uncertainty
from ..power.channels import ChannelBudget
from .base import listed
from .compiled_controller import CompiledController

BLOCK_S = 0.032  # time between two solutions
DEFAULT_MEMORY_S = 0.5
LOUDEST = 1e100  # references beyond it have been refused, but are still in the delay lines


class BlockController(CompiledController):
    """Base class that computes control filters within each loudspeaker's rated power after every block.

    A subclass sets `_state` and defines `_end_block`. The state has a record `numbers`, whose field `waiting` counts the
    samples since the end of the last block.
    """

    _state: Any

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        rated_power: Any,
        secondary_path_uncertainty: Any,
        microphone_weights: np.ndarray,
        n_primary: int,
        n_references: int,
        memory_s: float,
        averaging_s: float,
        fs: float,
        block: int | None = None,
        history: int = 0,
        **settings: Any,
    ) -> None:
        secondary, _ = secondary_paths(secondary_path)
        n_taps, n_references = as_count(n_taps, "n_taps"), as_count(n_references, "n_references")
        self.fs = as_positive(fs, "fs", unit="Hz")
        self.memory_s = as_positive(memory_s, "memory_s", unit="s")
        self.block = max(round(BLOCK_S * self.fs), 1) if block is None else as_count(block, "block")
        self._rated = None if rated_power is None else per_loudspeaker(rated_power, secondary.shape[1], "rated_power")
        limits = np.full(secondary.shape[1], np.inf) if self._rated is None else self._rated
        self._path_weights = np.sqrt(microphone_weights)[:, np.newaxis, np.newaxis]
        self._heard = np.asarray(microphone_weights) > 0.0  # the microphones that count
        self._uncertainty = as_uncertainty(secondary_path_uncertainty)
        self._budget = ChannelBudget(
            self._path_weights * secondary,
            n_taps,
            n_primary,
            n_references,
            limits,
            as_positive(averaging_s, "averaging_s", unit="s") * self.fs / self.block,
            self._guard_for(secondary),
        )
        n_lags = self._budget.n_lags
        self._past = max(history, n_lags - 1 + self.block)  # samples of the references that a block needs
        super().__init__(
            n_taps, secondary_path, n_references=n_references, multichannel=True, history=self._past, **settings
        )
        keep = np.exp(-1.0 / (self.memory_s * self.fs))
        self._correlation = FadingCorrelation(n_lags, n_references, keep)

    def _read_rated_power(self) -> np.ndarray | None:
        return None if self._rated is None else self._rated.copy()

    def _take_rated_power(self, value: np.ndarray) -> None:
        self._rated = self._budget.rated_power = value

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

    def _after_new_path(self, before: np.ndarray) -> None:
        """Solve for the new paths from the end of this block on, with a guard if there was one."""
        secondary = self.secondary_path
        guard = self._guard_for(secondary) if self._budget.n_guard > 1 else None
        self._budget.use_paths(self._path_weights * secondary, guard)

    def _guard_for(self, secondary: np.ndarray) -> np.ndarray | None:
        """Return the guard filter for secondary paths (K, J, n_path), or None."""
        stated = self._uncertainty
        path_uncertainty(stated, secondary)  # refuses measured paths of other channels
        if isinstance(stated, np.ndarray) and stated.ndim == 4:
            stated = stated[:, self._heard]
        return guard_filter(stated, secondary[self._heard])

    def samples_to_block(self) -> int:
        """Return the number of samples until the end of the block."""
        return max(self.block - int(self._state.numbers["waiting"][0]), 1)

    def after_compiled(self, state: Any) -> None:
        """Learn from the block and solve for the control filters, if the block has ended."""
        if state.numbers["waiting"][0] < self.block:
            return
        state.numbers["waiting"] = 0
        references = np.array([newest(line, self._past)[::-1] for line in self._lines.reference])
        energy, n_emitted = self._lines.energy.copy(), float(self._lines.n_emitted[0])
        self._lines.energy[:] = self._lines.n_emitted[:] = 0.0
        if np.all(np.abs(references) < LOUDEST):
            level = float(np.mean(references[:, -self.block :] ** 2, axis=1).sum())
            if n_emitted > 0.0:  # more than a block's if some samples were skipped
                self._budget.spend(level, energy / n_emitted, max(round(n_emitted / self.block), 1))
            else:
                self._budget.spend(level, None)  # the control was off
            self._correlation.add(references[:, 1 - len(self._correlation.total) - self.block :])
            self._end_block(references)

    def _end_block(self, references: np.ndarray) -> None:
        """Learn from a block and set the control filters; `references`, (I, n), end with those of the block."""
        raise NotImplementedError

    def _listen(self, references: np.ndarray, errors: np.ndarray, adapting: np.ndarray) -> int:
        """Follow block by block."""
        taken = 0
        while taken < len(references):
            block = slice(taken, taken + self.samples_to_block())
            done = super()._listen(references[block], errors[block], adapting[block])
            self.after_compiled(self._state)
            taken += done
            if done < len(references[block]):
                break
        return taken
