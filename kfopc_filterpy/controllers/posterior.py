"""What KF-PB knows of the plant: the posterior of its paths."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from .._validate import as_nonnegative
from ..paths.uncertainty import rms_relative_error
from .core_controller import CoreController

DEFAULT_UNCERTAINTY = 0.3  # relative rms error of a secondary path
LEAST_SPREAD, MOST_SPREAD = 1e-4, 1e3  # of a path that is not exact
BLOCK_S = 0.032  # from one posterior to the next, at least
# What is known about the plant: fields of `posterior.c`.
POSTERIOR = (
    *(
        "posterior",
        "posterior_counts",
        "fits",
        "theta",
        "noise",
        "draws",
        "data",
        "data_of_errors",
        "error_energy",
        "factor",
    ),
    *("inverse_diagonal", "set_aside_of_errors", "set_aside_energy", "path_correlation", "cross_correlation"),
)


def block_of(fs: float) -> int:
    """Return the number of samples in a block at a sample rate."""
    return max(round(BLOCK_S * fs), 1)


def relative_spread(uncertainty: Any, secondary_path: Any) -> float:
    """Return the relative rms error of the path as the core takes it, 0 if the path is exact."""
    error = rms_relative_error(uncertainty, secondary_path)
    if error > MOST_SPREAD:
        raise ValueError(f"secondary_path_uncertainty must be at most {MOST_SPREAD:g}, got {error:g}")
    return max(error, LEAST_SPREAD) if error > 0.0 else 0.0


class PosteriorController(CoreController):
    """Base class of these controllers: what is known about the plant, read from the fields of `posterior.c`."""

    checks: ClassVar = {"spread": as_nonnegative}
    takes_guard = False  # the posterior knows how far the path may be off

    @property
    def alarms(self) -> int:
        """Number of times so far that the errors contradicted the paths."""
        return int(self._block.fields["alarms"].item())

    @property
    def primary_path(self) -> np.ndarray:
        """Posterior mean of the primary path, (N,), or with several channels (K, I, N); N = L + M - 1."""
        paths = self._means()[0].copy()
        return paths if self.multichannel else paths[0, 0]

    @property
    def identified_path(self) -> np.ndarray:
        """Posterior mean of the secondary path, of the shape of `secondary_path`; the given path if it is exact."""
        paths = self._means()[1].copy()
        return paths if self.multichannel else paths[0, 0]

    @property
    def measurement_noise(self) -> Any:
        """Power that the plant's model does not explain, or with several channels that at each microphone, (K,).

        It is 0 before the first posterior.
        """
        return self._number_of_each("noise")

    def _means(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the posterior means as the core has them, (K, I, N) and (K, J, M)."""
        fields = self._block.fields
        theta, given = fields["theta"].reshape(self.n_microphones, -1), fields["secondary_path"][0]
        learned = given[0].size if fields["spread"].item() > 0.0 else 0  # taps of secondary paths, the last in theta
        n = theta.shape[1] - learned
        primary = theta[:, :n].reshape(self.n_microphones, -1, self.n_taps + given.shape[-1] - 1)
        return primary, theta[:, n:].reshape(given.shape) if learned else given

    def _after_new_path(self, before: np.ndarray) -> None:
        """Begin the posterior anew around the new path; the control filter, the account and the signals stay."""
        block = self._block
        spread = block.fields["spread"]
        if spread.item() > 0.0 and self._uncertainty is not None:  # measured paths: another distance from the new path
            spread[:] = relative_spread(self._uncertainty, self._estimated_path()) or LEAST_SPREAD
        fresh = block.fresh(block.shape)
        for name in POSTERIOR:
            block.fields[name][:] = fresh.fields[name]
