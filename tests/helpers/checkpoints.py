"""Runs that are interrupted, what an object holds to the bit, and files that somebody else might have written."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Callable
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


def contents(value: Any) -> tuple[list[Any], list[Any], set[Any]]:
    """Return all that an object holds: nodes, the bytes and strides of its arrays, and which of them share memory."""
    writer = checkpoint._Writer()
    writer.value(value, "it")
    number = {id(node): index for index, node in enumerate(writer.nodes)}
    arrays = [(number.get(id(node)), a.dtype.descr, a.shape, a.strides, a.tobytes()) for node, a in writer.arrays]
    shared = {
        frozenset((number.get(id(node)), node["at"] - place.at) for node, _ in place.arrays)
        for place in checkpoint._placed(writer.arrays)
        if place.high > place.low
    }
    for node, _ in writer.arrays:
        del node["at"]  # it depends on addresses
    return json.loads(json.dumps(writer.nodes)), arrays, shared


def assert_same_contents(one: Any, other: Any) -> None:
    """Two objects hold the same, to the bit, and share the same within themselves."""
    for mine, theirs in zip(contents(one), contents(other), strict=True):
        assert mine == theirs


def forge(path: Path, change: Callable[[dict[str, Any]], Any]) -> Path:
    """Change the header of a file, and give it the checksum that belongs to it; return another path."""
    start, line, rest = path.read_bytes().split(b"\n", 2)
    data = rest[-(len(start) + len(line) + 2) % checkpoint.LINE : -checkpoint.DIGEST]
    header = json.loads(line)
    change(header)
    line = json.dumps(header).encode()
    begin = start.rsplit(b" ", 1)[0] + f" {len(line)}\n".encode() + line + b"\n"
    return sealed(path.with_name("forged.kfopc"), begin + bytes(-len(begin) % checkpoint.LINE) + data)


def sealed(path: Path, content: bytes) -> Path:
    """Write a content with its checksum."""
    path.write_bytes(content + hashlib.sha256(content).hexdigest().encode())
    return path
