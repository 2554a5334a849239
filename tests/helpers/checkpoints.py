"""Runs that can be interrupted: a controller in a room, and a filter with its measurements, sample by sample."""

from __future__ import annotations

import copy
import hashlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from helpers.channels import random_paths
from helpers.controllers import N_TAPS, I, J, K
from helpers.loop import S_HAT, noises
from kfopc_filterpy.checkpoint import content_of

N = 400
TRUE = random_paths(K, J, 5, seed=9)


class Room:
    """Noise and a secondary path, sample by sample; it can be copied between two samples."""

    def __init__(self, controller: Any) -> None:
        several = getattr(controller, "multichannel", False) or hasattr(controller, "virtual")
        rng = np.random.default_rng(5)
        if several:
            self.x, self.d = rng.standard_normal((N, I)), rng.standard_normal((N, K))
            self.path, self.played = np.moveaxis(TRUE, 2, 0), np.zeros((5, J))
        else:
            self.x, self.d, _ = noises(N)
            self.path, self.played = 1.1 * S_HAT, np.zeros(S_HAT.size)
        if getattr(controller, "n_references", 1) == 0:
            self.x = None
        self.n = 0

    def heard(self, n: int | slice) -> tuple[Any, Any]:
        """Return the references, or None, and the disturbances of some samples; channels lead."""
        return None if self.x is None else self.x[n].T, self.d[n].T

    def play(self, controller: Any) -> Any:
        """Let the controller emit the next sample."""
        y = controller.control_signal(self.heard(self.n)[0])
        self.played = np.roll(self.played, 1, axis=0)
        self.played[0] = y
        return y

    def hear(self, controller: Any) -> None:
        """Let it adapt to the error."""
        heard = np.einsum("tkj,tj->k", self.path, self.played) if self.played.ndim == 2 else self.path @ self.played
        controller.update(self.d[self.n] - heard)
        self.n += 1

    def run(self, controller: Any, samples: int) -> np.ndarray:
        """Return the control signal, and the weights after each sample, for some samples."""
        kept = []
        for _ in range(samples):
            y = self.play(controller)
            self.hear(controller)
            kept.append(np.concatenate((np.ravel(y), np.ravel(controller.weights))))
        return np.array(kept)

    def copy(self) -> Room:
        """Return a room in the same state."""
        return copy.deepcopy(self)


class Measurements:
    """Measurements for a filter, one in seven of which is missing."""

    def __init__(self) -> None:
        self.n = 0

    def run(self, kf: Any, samples: int) -> np.ndarray:
        """Return what the filter knows after each of some samples."""
        kept = []
        for n in range(self.n, self.n + samples):
            rng = np.random.default_rng(n)
            row, z = rng.standard_normal(N_TAPS), float(rng.standard_normal())
            kf.predict()
            budget = {} if kf.rated_power is None else {"reference": row[0]}
            kf.update(None if n % 7 == 6 else z, H=row, **budget)
            known = kf.x, kf.P, kf.K, kf.P_prior, kf.P_post, kf.S, kf.log_likelihood, kf.constraint_factor
            kept.append(np.concatenate([np.ravel(one) for one in known]))
        self.n += samples
        return np.array(kept)

    copy = Room.copy


def assert_same_contents(one: Any, other: Any) -> None:
    """Two objects hold the same, to the bit, and hold the same things twice."""
    assert content_of(one) == content_of(other)


def sealed(path: Path, content: bytes) -> Path:
    """Write a content with the checksum that belongs to it; return its path."""
    path.write_bytes(content + hashlib.sha256(content).hexdigest().encode())
    return path


def forged(path: Path, edited: Callable[[Any], Any], **arrays: Any) -> Path:
    """Write a file with the header that `edited` makes of that of `path`, and other arrays; return its path."""
    with np.load(path) as file:
        held = dict(file) | arrays
    header = edited(json.loads(held.pop("header").item()))
    archived = io.BytesIO()
    np.savez(archived, header=np.array(json.dumps(header).encode()), **held)
    return sealed(path.with_name("forged.npz"), archived.getvalue())
