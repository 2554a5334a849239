"""The bound for several loudspeakers: the least error of fixed control filters within each one's rated power.

The sum of the squared errors over the microphones is minimised. Control filters are (J, I, n_taps).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

RIDGE = 1e-10  # of the mean energy of a tap: directions of the weights with less energy get no weight
TOLERANCE = 1e-5  # relative, for a rated power that limits
MISSED = 1e-3  # from which a rated power is not met
ROUNDING = 1e-14  # relative rounding error of the dual function
SOLUTIONS = 100  # at most; about ten are usual


@dataclass(frozen=True)
class ChannelCorrelations:
    """Correlations R_x', R_x and r of a stretch, which determine the control filters for any penalties."""

    filtered: np.ndarray  # (J I n_taps, J I n_taps), summed over microphones
    reference: np.ndarray  # (I n_taps, I n_taps)
    cross: np.ndarray  # (J I n_taps,)
    shape: tuple[int, int, int]

    def weights(self, penalty: np.ndarray | float = 0.0, ridge: float = 0.0) -> np.ndarray:
        """Return the solution of (R_x' + blkdiag(penalty_j R_x) + ridge I) w = r, (J, I, n_taps)."""
        return cho_solve(self._factors(penalty, ridge), self.cross).reshape(self.shape)

    def _factors(self, penalty: np.ndarray | float, ridge: float = 0.0) -> Any:
        """Return the Cholesky factors of R_x' + blkdiag(penalty_j R_x) + ridge I."""
        J = self.shape[0]
        matrix = self.filtered + block_diag(*(p * self.reference for p in np.broadcast_to(penalty, J)))
        matrix.flat[:: self.cross.size + 1] += ridge + RIDGE * np.trace(self.filtered) / self.cross.size
        return cho_factor(matrix, overwrite_a=True)

    def powers(self, weights: np.ndarray) -> np.ndarray:
        """Return the powers of the control signals, (J,)."""
        rows = weights.reshape(self.shape[0], -1)
        return np.einsum("ja,ab,jb->j", rows, self.reference, rows)

    def antinoise(self, weights: np.ndarray) -> float:
        """Return the reduction of the error power by the weights, summed over microphones: 2 w'r - w' R_x' w."""
        w = weights.ravel()
        return float(2.0 * w @ self.cross - w @ self.filtered @ w)

    def constrained_weights(
        self, rated_power: np.ndarray, start: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the weights of the least error within the rated powers, and the penalties, (J,).

        The dual function is concave in the penalties; projected Newton steps maximise it. Each step is computed for
        1 / sqrt(power), which is nearly linear in the penalty (Moré and Sorensen 1983), and is shortened until the dual
        function rises. `start`, the penalties for similar rated powers, saves some of the steps.
        """
        J = self.shape[0]
        if not np.trace(self.filtered) > 0.0:
            return np.zeros(self.shape), np.zeros(J)
        weights, penalty = self.weights(), np.zeros(J)
        if np.all(self.powers(weights) <= rated_power):
            return weights, penalty
        natural = np.full(J, np.trace(self.filtered) / np.trace(self.reference) / J)
        trial, gained, step = natural if start is None else start, -np.inf, natural
        for _ in range(SOLUTIONS):
            factors = self._factors(trial)
            found = cho_solve(factors, self.cross).reshape(self.shape)
            dual = -self.cross @ found.ravel() - trial @ rated_power
            if dual < gained - ROUNDING * abs(dual):  # the step was too long
                step = 0.25 * step
            else:
                weights, penalty, gained = found, trial, dual
                ratio = self.powers(weights) / rated_power
                if np.all(ratio < 1.0 + TOLERANCE) and np.all(np.abs(ratio[penalty > 0.0] - 1.0) < TOLERANCE):
                    break
                step = self._newton_step(factors, weights, rated_power, (penalty > 0.0) | (ratio > 1.0))
            trial = np.maximum(penalty + step, 0.0)
        else:
            missed = float(np.max(np.where(penalty > 0.0, np.abs(ratio - 1.0), ratio - 1.0)))
            if missed > MISSED:
                text = f"the rated powers are met to {100 * missed:.2g} % only: the bound is not exact"
                warnings.warn(text, RuntimeWarning, stacklevel=2)
        return weights, penalty

    def _newton_step(self, factors: Any, weights: np.ndarray, rated_power: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Return a Newton step of the `free` penalties towards the rated powers; the dual function rises along it."""
        J = self.shape[0]
        rows = weights.reshape(J, -1) @ self.reference  # R_x w_j
        changes = cho_solve(factors, block_diag(*rows).T).reshape(J, -1, J)  # -dw / d penalty_i at [..., i]
        slopes = np.einsum("ja,jai->ji", rows, changes)[np.ix_(free, free)]  # -d power_j / d penalty_i, halved
        size = 1.0 / np.sqrt(np.maximum(np.diag(slopes), np.finfo(float).tiny))  # of loudspeakers, loud or faint

        def solved(right: np.ndarray) -> np.ndarray:
            return np.asarray(size * np.linalg.lstsq(size[:, np.newaxis] * slopes * size, size * right, rcond=None)[0])

        powers = self.powers(weights)
        excess, step = (powers - rated_power)[free], np.zeros(J)
        step[free] = solved((powers * (np.sqrt(powers / rated_power) - 1.0))[free])
        if not step[free] @ excess > 0.0:
            step[free] = solved(0.5 * excess)
        return step
