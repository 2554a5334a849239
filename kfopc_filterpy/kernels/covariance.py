"""The core's covariance (`covariance.h`) in an array of its own, for filters that Python or numba's code steps.

P = scale (T - pending u u') + diagonal I, with the lower triangle T and u = P x' / sqrt(S) of the last update.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from ..core.calls import covariance_fields, covariance_step_compiled
from ..core.calls import covariance_update as covariance_update
from .compiling import inlined, part
from .vectors import FAST

GROUP = 8  # rows of T that have one length, `PARTS` in vectors.h
LINE = 64  # bytes in a cache line
OWED = np.dtype([(name, np.float64) for name in ("scale", "diagonal", "pending", "largest", "bound", "floored")])


class Covariance(NamedTuple):
    """State covariance of n weights."""

    memory: np.ndarray  # as the core lays it out; it begins at a cache line
    result: np.ndarray  # (2,) innovation and S of the last update


@cache
def _fields(n: int) -> tuple[int, dict[str, slice]]:
    """Return the size of the memory, and where its fields are, in numbers."""
    return covariance_fields(n)


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


def covariance_matrix(cov: Covariance, n: int) -> np.ndarray:
    """Return P as a new full symmetric array (n, n)."""
    scale, diagonal, pending, *_ = owed_of(cov).item()
    return covariance_at(cov, n, scale, diagonal, -scale * pending)


def _groups(triangle: np.ndarray, n: int) -> list[tuple[np.ndarray, int]]:
    """Return views of the groups of rows of T, each with its first row's index."""
    groups, at = [], 0
    for group in range(0, n, GROUP):
        size = GROUP * (group + GROUP)
        groups.append((triangle[at : at + size].reshape(GROUP, -1), group))
        at += size
    return groups


@inlined
def kalman_step(cov, w, h, scaled_measurement, state_noise, noise, alpha_sq):
    """Process one sample (eq. 2-9): predict, correct the weights `w` in place, return the innovation and S.

    If P could overflow, the innovation is NaN and nothing has changed.
    """
    cov.result[0] = cov.result[1] = np.nan
    covariance_step_compiled(
        cov.memory.ctypes.data,
        w.size,
        w.ctypes.data,
        h.ctypes.data,
        scaled_measurement,
        state_noise,
        noise,
        alpha_sq,
        cov.result.ctypes.data,
    )
    return cov.result[0], cov.result[1]


@part(fastmath=FAST)
def correct_weights(w, gain_direction, innovation_over_root):
    """Apply eq. 5, w(n|n) = w(n|n-1) + K (d - x'w), with K = u / sqrt(S)."""
    for i in range(w.size):
        w[i] += gain_direction[i] * innovation_over_root
