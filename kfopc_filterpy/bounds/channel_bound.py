"""The bound for several loudspeakers: the least error of fixed control filters within each one's rated power.

The sum of the squared errors over the microphones is minimised. Control filters are (J, I, n_taps); signals have the
channel as the first axis.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.signal import correlate, fftconvolve

from .._types import PathModels
from .._validate import as_channels, as_count
from ..paths.path_matrix import secondary_paths
from .wiener import WienerSolution, mean_square, reduction_db, require_sound

RIDGE = 1e-10  # of the mean energy of a tap: directions of the weights with less energy get no weight
TOLERANCE = 1e-5  # relative, for a rated power that limits
MISSED = 1e-3  # from which a rated power is not met
ROUNDING = 1e-14  # relative rounding error of the dual function
SOLUTIONS = 100  # at most; about ten are usual


@dataclass(frozen=True, eq=False)
class ChannelStretch:
    """Samples to which control filters are fitted; x and x' begin `n_taps` - 1 samples early to fill delay lines."""

    x: np.ndarray  # (I, n + n_taps - 1)
    filtered: np.ndarray  # (K, J, I, n + n_taps - 1)
    d: np.ndarray  # (K, n)
    n_taps: int

    @property
    def filtered_power(self) -> float:
        """Power of the filtered references, summed over microphones and loudspeakers."""
        return float(np.mean(self.filtered[..., self.n_taps - 1 :] ** 2, axis=-1).sum())

    def part(self, start: int, stop: int) -> ChannelStretch:
        """Return the samples from `start` to before `stop`, with their true past."""
        with_past = slice(start, stop + self.n_taps - 1)
        return ChannelStretch(self.x[:, with_past], self.filtered[..., with_past], self.d[:, start:stop], self.n_taps)

    def correlations(self) -> ChannelCorrelations:
        """Return the correlations of the stretch."""
        of_x = block_correlation(self.x, self.n_taps)
        return ChannelCorrelations(self.correlation(self.filtered), of_x, self.cross(), self.shape)

    def correlation(self, filtered: np.ndarray) -> np.ndarray:
        """Return the correlation matrix of signals that take the place of x', summed over microphones."""
        return np.asarray(sum(block_correlation(each, self.n_taps) for each in _rows(filtered)))

    def cross(self) -> np.ndarray:
        """Return r, the cross-correlation of d and x', summed over microphones."""
        each = [
            [correlate(row, d, "valid")[::-1] for row in rows]
            for rows, d in zip(_rows(self.filtered), self.d, strict=True)
        ]
        return np.sum(each, axis=0).ravel() / self.d.shape[1]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of the control filters, (J, I, n_taps)."""
        return self.filtered.shape[1], self.filtered.shape[2], self.n_taps

    def control_signal(self, weights: np.ndarray) -> np.ndarray:
        """Return the control signals, (J, n)."""
        return np.array([_sum_of_convolutions(self.x, w) for w in weights])

    def antinoise(self, weights: np.ndarray) -> np.ndarray:
        """Return the anti-noise, (K, n)."""
        n_signals = weights.shape[0] * weights.shape[1]
        filters = weights.reshape(n_signals, -1)
        return np.array([_sum_of_convolutions(x.reshape(n_signals, -1), filters) for x in self.filtered])

    def solution(self, weights: np.ndarray) -> WienerSolution:
        """Return the weights with their powers: the control power is (J,), the others are means over microphones."""
        antinoise = self.antinoise(weights)
        error_power, disturbance_power = mean_square(self.d - antinoise), mean_square(self.d)
        return WienerSolution(
            weights=weights,
            control_power=np.mean(self.control_signal(weights) ** 2, axis=-1),
            antinoise_power=mean_square(antinoise),
            disturbance_power=disturbance_power,
            error_power=error_power,
            noise_reduction_db=reduction_db(error_power, disturbance_power),
        )


def _rows(filtered: np.ndarray) -> np.ndarray:
    """Return filtered references (K, J, I, n) as (K, J I, n)."""
    return filtered.reshape(len(filtered), -1, filtered.shape[-1])


def _sum_of_convolutions(signals: np.ndarray, filters: np.ndarray) -> np.ndarray:
    return fftconvolve(signals, filters, mode="valid", axes=-1).sum(axis=0)


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
                warnings.warn(
                    f"the rated powers are met to {100 * missed:.2g} % only: the bound is not exact",
                    RuntimeWarning,
                    stacklevel=2,
                )
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


def block_correlation(signals: np.ndarray, n_taps: int) -> np.ndarray:
    """Return the mean of ``signals[a, n - i] * signals[b, n - j]`` over n >= n_taps - 1, (C n_taps, C n_taps).

    Each row of a block is computed from the one above by adding the products that enter the window and subtracting
    those that leave it.
    """
    n_signals, length = signals.shape
    count = length - n_taps + 1
    blocks = np.empty((n_signals, n_signals, n_taps, n_taps))
    now = signals[:, n_taps - 1 :]
    for a in range(n_signals):
        for b in range(n_signals):
            blocks[a, b, 0] = correlate(signals[b], now[a], "valid")[::-1] / count
    blocks[:, :, :, 0] = blocks[:, :, 0, :].swapaxes(0, 1)
    entering = signals[:, : n_taps - 1][:, ::-1]  # the samples before the window, newest first
    leaving = signals[:, ::-1][:, : n_taps - 1]  # the last samples, newest first
    for i in range(n_taps - 1):
        change = entering[:, i, None, None] * entering - leaving[:, i, None, None] * leaving
        blocks[:, :, i + 1, 1:] = blocks[:, :, i, :-1] + change / count
    return blocks.swapaxes(1, 2).reshape(n_signals * n_taps, -1)


def channel_record(
    reference: ArrayLike, disturbance: ArrayLike, secondary_path: PathModels, n_taps: int, fs: float
) -> ChannelStretch:
    """Check the signals of several channels and return them with silence before the first sample."""
    x = np.atleast_2d(as_channels(reference, "reference"))
    d = np.atleast_2d(as_channels(disturbance, "disturbance"))
    secondary, _ = secondary_paths(secondary_path, fs=fs)
    n_taps = as_count(n_taps, "n_taps")
    if d.shape != (len(secondary), x.shape[1]):
        raise ValueError(
            f"disturbance must be (K microphones, n_samples) = {(len(secondary), x.shape[1])}, got {d.shape}"
        )
    filtered = fftconvolve(x[np.newaxis, np.newaxis], secondary[:, :, np.newaxis], axes=-1)[..., : x.shape[1]]
    past = [(0, 0), (n_taps - 1, 0)]
    return ChannelStretch(np.pad(x, past), np.pad(filtered, [(0, 0), (0, 0), *past]), d, n_taps)


def full_channel_stretch(
    reference: ArrayLike, disturbance: ArrayLike, secondary_path: PathModels, n_taps: int, fs: float
) -> ChannelStretch:
    """Check the signals and return the samples at which all delay lines are full."""
    secondary, _ = secondary_paths(secondary_path, fs=fs)
    record = channel_record(reference, disturbance, secondary, n_taps, fs)
    start, stop = n_taps + secondary.shape[2] - 2, record.d.shape[1]
    if stop < start + n_taps:
        raise ValueError(
            f"reference must have at least {start + n_taps} samples for {n_taps} control "
            f"and {secondary.shape[2]} path taps, got {stop}; use a longer signal or fewer taps"
        )
    return require_sound(record.part(start, stop))
