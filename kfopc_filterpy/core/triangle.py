"""The core's covariance (`covariance.h`) in an array of its own, for filters that Python steps.

P = scale (T - pending u u') + diagonal I, with the lower triangle T and u = P x' / sqrt(S) of the last update.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from .calls import covariance_describe, covariance_size
from .calls import covariance_update as covariance_update
from .library import fields_of

GROUP = 8  # rows of T that have one length, `PARTS` in vectors.h
LINE = 64  # bytes in a cache line
OWED = np.dtype(
    [(name, np.float64) for name in ("scale", "diagonal", "pending", "largest", "bound", "floored", "usual")]
)


class Covariance(NamedTuple):
    """State covariance of n weights."""

    memory: np.ndarray  # as the core lays it out; it begins at a cache line
    result: np.ndarray  # (2,) innovation and S of the last update


@cache
def _fields(n: int) -> tuple[int, dict[str, slice]]:
    """Return the size of the memory, and where its fields are, in numbers."""
    ends = {field.name: (field.offset // 8, int(np.prod(field.shape))) for field in fields_of(covariance_describe, n)}
    return covariance_size(n) // 8, {name: slice(begin, begin + size) for name, (begin, size) in ends.items()}


DIRECTION = _fields(1)[1]["gain_direction"].start  # of every n: what stands before has a fixed size


def new_covariance(P: np.ndarray) -> Covariance:
    """Return the covariance of a full symmetric array (n, n); the upper triangle is not read."""
    n = len(P)
    size, fields = _fields(n)
    room = np.zeros(size + LINE // 8)
    cov = Covariance(room[-(room.ctypes.data // 8) % (LINE // 8) :][:size], np.zeros(2))
    padded = -(-n // GROUP) * GROUP
    full = np.zeros((padded, padded))
    full[:n, :n] = np.tril(P) + np.tril(P, -1).T
    triangle = cov.memory[fields["triangle"]]
    for rows, group in _groups(triangle, n):
        rows[...] = full[group : group + GROUP, : group + GROUP]
    owed = owed_of(cov)
    owed["scale"], owed["largest"] = 1.0, np.max(np.diagonal(P))
    owed["bound"] = owed["largest"]
    return cov


def copy_covariance(cov: Covariance, n: int) -> Covariance:
    """Return an independent copy (a plain array copy might not begin at a cache line)."""
    other = new_covariance(np.zeros((n, n)))
    for own, theirs in zip(other, cov, strict=True):
        own[:] = theirs
    return other


def owed_of(cov: Covariance) -> np.ndarray:
    """Return the record of what is pending, a view, (1,)."""
    return cov.memory[: len(OWED.names or ())].view(OWED)


def direction_of(cov: Covariance, n: int) -> np.ndarray:
    """Return u, a view, (n,)."""
    return cov.memory[DIRECTION : DIRECTION + n]


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


def covariance_at(cov: Covariance, n: int, scale: float, diagonal: float, weight: float) -> np.ndarray:
    """Return `full_covariance` of a covariance's present T and u."""
    return full_covariance(cov.memory[_fields(n)[1]["triangle"]], direction_of(cov, n), scale, diagonal, weight)


def _groups(triangle: np.ndarray, n: int) -> list[tuple[np.ndarray, int]]:
    """Return views of the groups of rows of T, each with its first row's index."""
    groups, at = [], 0
    for group in range(0, n, GROUP):
        size = GROUP * (group + GROUP)
        groups.append((triangle[at : at + size].reshape(GROUP, -1), group))
        at += size
    return groups
