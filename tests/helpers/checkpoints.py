"""Runs that are interrupted, what an object holds to the bit, and files that somebody else might have written."""

from __future__ import annotations

import copy
import hashlib
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from helpers.channels import random_paths
from helpers.controllers import I, J, K
from helpers.loop import S_HAT, noises
from kfopc_filterpy import checkpoint

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
        self.n = 0

    def play(self, controller: Any) -> Any:
        """Let the controller emit the next sample."""
        y = controller.control_signal(self.x[self.n])
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


def contents(value: Any) -> list[Any]:
    """Return all that an object holds: what it is made of, with the bytes of its arrays, and what it holds twice."""
    found: list[Any] = []
    known: dict[int, tuple[int, Any]] = {}  # holds the values, so that no id is used twice

    def add(value: Any) -> None:
        kind = type(value)
        if value is None or kind in (bool, int, str, float):
            found.append((kind, repr(value)))
            return
        new = id(value) not in known
        found.append((kind.__qualname__, known.setdefault(id(value), (len(known), value))[0]))
        if not new:
            return
        if isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
            found.append((value.dtype.descr, value.shape, value.tobytes()))
        elif isinstance(value, np.ndarray):
            add(value.shape), add(value.ravel().tolist())
        elif isinstance(value, np.random.Generator):
            add(value.bit_generator.state)
        elif isinstance(value, list | tuple | deque):
            for item in value:
                add(item)
        elif isinstance(value, dict):
            add(list(value)), add(list(value.values()))
        elif not hasattr(value, "__qualname__"):
            add(value.__reduce_ex__(2)[2])

    add(value)
    return found


def assert_same_contents(one: Any, other: Any) -> None:
    """Two objects hold the same, to the bit, and hold the same things twice."""
    assert contents(one) == contents(other)


def forge(path: Path, program: bytes, arrays: bytes = b"") -> Path:
    """Write a file with another pickle, and the checksum that belongs to it; return its path."""
    first = path.read_bytes().partition(b": ")[0] + b": %d\n" % len(program)
    content = first + program
    return sealed(path.with_name("forged.kfopc"), content + bytes(-len(content) % checkpoint.LINE) + arrays)


def pickle_of(path: Path) -> bytes:
    """Return the pickle in a file."""
    first, _, rest = path.read_bytes().partition(b"\n")
    return rest[: int(first.rpartition(b" ")[2])]


def sealed(path: Path, content: bytes) -> Path:
    """Write a content with its checksum."""
    path.write_bytes(content + hashlib.sha256(content).hexdigest().encode())
    return path
