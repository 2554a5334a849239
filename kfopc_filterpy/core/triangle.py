"""The core's covariance (`covariance.h`), read as a full array.

P = scale (T - pending u u') + diagonal I, with the lower triangle T and u = P x' / sqrt(S) of the last update.
"""

from __future__ import annotations

import numpy as np

GROUP = 8  # rows of T that have one length, `PARTS` in vectors.h
OWED = np.dtype(
    [(name, np.float64) for name in ("scale", "diagonal", "pending", "largest", "bound", "floored", "usual")]
)


def full_covariance(triangle: np.ndarray, u: np.ndarray, scale: float, diagonal: float, weight: float) -> np.ndarray:
    """Return the full symmetric array scale T + weight u u' + diagonal I."""
    n = u.size
    padded = -(-n // GROUP) * GROUP
    P = np.empty((padded, padded))
    for rows, group in _groups(triangle, n):
        P[group : group + GROUP, : group + GROUP] = rows
        P[:group, group : group + GROUP] = rows[:, :group].T
    P = P[:n, :n] * scale + weight * np.multiply.outer(u, u)
    P[np.diag_indices(n)] += diagonal
    return P


def _groups(triangle: np.ndarray, n: int) -> list[tuple[np.ndarray, int]]:
    """Return views of the groups of rows of T, each with its first row's index."""
    groups, at = [], 0
    for group in range(0, n, GROUP):
        size = GROUP * (group + GROUP)
        groups.append((triangle[at : at + size].reshape(GROUP, -1), group))
        at += size
    return groups
