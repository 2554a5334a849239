"""The core's covariance (`covariance.h`), read as a full array.

P = scale (T - pending u u') + diagonal I, with the lower triangle T and u = P x' / sqrt(S) of the last update.
"""

from __future__ import annotations

import numpy as np

GROUP = 8  # rows of T that have one length, `PARTS` in vectors.h
OWED = np.dtype(
    [(name, np.float64) for name in ("scale", "diagonal", "pending", "largest", "bound", "floored", "usual", "release")]
)


def full_covariance(triangle: np.ndarray, u: np.ndarray, scale: float, diagonal: float, weight: float) -> np.ndarray:
    """Return the full symmetric array scale T + weight u u' + diagonal I."""
    n, begin = u.size, 0
    padded = -(-n // GROUP) * GROUP
    P = np.empty((padded, padded))
    for end in range(GROUP, padded + 1, GROUP):  # rows that end with this column
        rows = triangle[begin : begin + GROUP * end].reshape(GROUP, end)
        P[end - GROUP : end, :end] = rows
        P[:end, end - GROUP : end] = rows.T
        begin += rows.size
    P = P[:n, :n] * scale + weight * np.multiply.outer(u, u)
    P[np.diag_indices(n)] += diagonal
    return P
