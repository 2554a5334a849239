"""Several channels: random plants, and the dense systems that oracles solve."""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag


def random_paths(outputs: int, inputs: int, taps: int, *, seed: int, delay: int = 1) -> np.ndarray:
    """Paths that decay, (outputs, inputs, taps), after a delay."""
    paths = np.random.default_rng(seed).standard_normal((outputs, inputs, taps)) * np.exp(-np.arange(taps) / (taps / 4))
    paths[..., :delay] = 0.0
    return paths


def through(paths: np.ndarray, signals: np.ndarray) -> np.ndarray:
    """The sum over inputs of each signal (inputs, n) through its path, (outputs, n)."""
    n_samples = signals.shape[1]
    return np.array([sum(np.convolve(p, s)[:n_samples] for p, s in zip(row, signals, strict=True)) for row in paths])


def delayed(signals: np.ndarray, taps: int) -> np.ndarray:
    """Each signal delayed by 0 to taps - 1 samples, (signals * taps, n)."""
    return np.array([np.concatenate([np.zeros(m), s[: s.size - m]]) for s in signals for m in range(taps)])


def dense_systems(
    x: np.ndarray, d: np.ndarray, secondary: np.ndarray, n_taps: int, start: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R_x' (J I L, J I L), R_x (I L, I L) and r (J I L,) of signals from `start` on, from the signals themselves."""
    filtered = [
        np.concatenate(
            [delayed(through(s.reshape(1, 1, -1), x[i : i + 1]), n_taps) for s in row for i in range(len(x))]
        )
        for row in secondary
    ]
    R = sum(rows[:, start:] @ rows[:, start:].T for rows in filtered)
    r = sum(rows[:, start:] @ one[start:] for rows, one in zip(filtered, d, strict=True))
    of_x = delayed(x, n_taps)[:, start:]
    count = x.shape[1] - start
    return np.asarray(R) / count, of_x @ of_x.T / count, np.asarray(r) / count


def constrained_filters(
    R: np.ndarray, of_x: np.ndarray, r: np.ndarray, rated: np.ndarray, ridge: float = 1e-9
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Control filters of the least error within the powers, by dense solves: filters, multipliers and powers."""
    J = rated.size
    natural = np.trace(R) / np.trace(of_x) / J
    penalty = np.full(J, natural)
    for _ in range(2000):
        matrix = R + block_diag(*(p * of_x for p in penalty)) + ridge * np.trace(R) / len(R) * np.eye(len(R))
        w = np.linalg.solve(matrix, r).reshape(J, -1)
        power = np.einsum("ja,ab,jb->j", w, of_x, w)
        before, penalty = penalty, np.maximum(penalty * power / rated, 1e-12 * natural)
        if np.allclose(before, penalty, rtol=1e-9, atol=0.0):
            break
    return w, penalty, power
