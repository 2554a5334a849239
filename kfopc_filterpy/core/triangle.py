"""The core's covariance (`covariance.h`) in an array of its own, for filters that Python steps.

P = scale (T - pending u u') + diagonal I, with the lower triangle T and u = P x' / sqrt(S) of the last update.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from .calls import covariance_describe, covariance_size
from .library import at_cache_line, fields_of

GROUP = 8  # rows of T that have one length, `PARTS` in vectors.h
OWED = np.dtype(
    [(name, np.float64) for name in ("scale", "diagonal", "pending", "largest", "bound", "floored", "usual")]
)


@cache
def _fields(n: int) -> dict[str, slice]:
    """Return where the fields of a covariance of n weights are, in numbers."""
    ends = {field.name: (field.offset // 8, int(np.prod(field.shape))) for field in fields_of(covariance_describe, n)}
    return {name: slice(begin, begin + size) for name, (begin, size) in ends.items()}


class Covariance:
    """State covariance of n weights, made of a full symmetric array (n, n), whose upper triangle is not read."""

    def __init__(self, P: np.ndarray) -> None:
        self.n = len(P)
        self.memory = at_cache_line(covariance_size(self.n)).view(np.float64)  # as the core lays it out
        self.result = np.zeros(2)  # innovation and S of the last update
        padded = -(-self.n // GROUP) * GROUP
        full = np.zeros((padded, padded))
        full[: self.n, : self.n] = np.tril(P) + np.tril(P, -1).T
        for rows, group in _groups(self.triangle, self.n):
            rows[...] = full[group : group + GROUP, : group + GROUP]
        self.owed["scale"], self.owed["largest"] = 1.0, np.max(np.diagonal(P))
        self.owed["bound"] = self.owed["largest"]

    @property
    def owed(self) -> np.ndarray:
        """Record of what is pending, a view, (1,)."""
        return self.memory[: len(OWED.names or ())].view(OWED)

    @property
    def triangle(self) -> np.ndarray:
        """T, a view."""
        return self.memory[_fields(self.n)["triangle"]]

    @property
    def direction(self) -> np.ndarray:
        """u, a view, (n,)."""
        return self.memory[_fields(self.n)["gain_direction"]][: self.n]


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
