"""Base of the two forms of KF-PB that estimate the primary paths and compute the control filters from them."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._validate import as_count, as_nonnegative, as_positive
from ..paths.channels import secondary_paths
from .blocks import BlockController

DEFAULT_PATH_MEMORY_S = 1.0
GROWN = 4.0  # growth of the references' power above which the state noise is set anew: the noise began softly


class PrimaryPathController(BlockController):
    """Base class that estimates primary paths and keeps each loudspeaker within its rated power.

    A subclass defines `primary_path` and `_end_block`, which calls `_solve`. Its arguments are described in
    `SharedGainKalman`.
    """

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        n_primary: int | None,
        path_memory_s: float,
        microphone_weights: Any,
        **settings: Any,
    ) -> None:
        self.path_memory_s = as_positive(path_memory_s, "path_memory_s", unit="s")
        secondary, n_taps, n_primary = read_paths(secondary_path, n_taps, n_primary)
        weights = weights_of_microphones(microphone_weights, len(secondary))
        super().__init__(
            n_taps, secondary_path, microphone_weights=weights, n_primary=n_primary, filtered_taps=0, **settings
        )

    @property
    def primary_path(self) -> np.ndarray:
        """Estimated primary paths, (K, I, L_p); a copy."""
        raise NotImplementedError

    def _solve(self) -> None:
        """Find the control filters for the present paths and correlation."""
        self._budget.solve(self._correlation.faded, self._path_weights * self.primary_path)
        self._state.weights[...] = self._budget.weights

    def _reference_power(self) -> float:
        """Return the mean power of the references; in silence, let the correlation start anew with the first sound."""
        power = float(np.trace(self._correlation.faded[0])) / self.n_references
        if not power > 0.0:
            self._correlation.mass = 0.0
        return power

    def _state_noise(self, now: float, power: float) -> float:
        """Return the state noise for references of a power: the present one, unless they have become much louder."""
        wanted = 1.0 / (power * (self.path_memory_s * self.fs) ** 2)
        return wanted if now == 0.0 or wanted < now / GROWN else now

    def _first_variance(self, prior: float, power: float) -> float:
        """Return the initial variance of a tap for references of a power.

        `prior` is the energy of the references in the unknown paths, relative to the measurement noise.
        """
        return prior / (self.n_references * self._budget.n_primary * power)


def weights_of_microphones(weights: Any, n_microphones: int) -> np.ndarray:
    """Return the weight of each microphone, (K,); by default 1."""
    if weights is None:
        return np.ones(n_microphones)
    if np.shape(weights) != (n_microphones,):
        raise ValueError(
            f"microphone_weights must have one weight for each of the {n_microphones} microphones, "
            f"got shape {np.shape(weights)}"
        )
    if not np.any(weights):
        raise ValueError("microphone_weights must have one above 0: without any microphone there is nothing to reduce")
    return np.array([as_nonnegative(weight, "microphone_weights") for weight in weights])


def read_paths(secondary_path: Any, n_taps: int, n_primary: int | None) -> tuple[np.ndarray, int, int]:
    """Return the secondary paths (K, J, taps), the taps of a control filter and those of a primary path.

    By default, a primary path has as many taps as control filter and secondary path can cancel.
    """
    secondary, _ = secondary_paths(secondary_path)
    n_taps = as_count(n_taps, "n_taps")
    usual = n_taps + secondary.shape[2]
    return secondary, n_taps, usual if n_primary is None else as_count(n_primary, "n_primary")
