"""A room for any controller, sample by sample: its run can be interrupted at each of them."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from helpers.channels import random_paths
from helpers.controllers import I, J, K
from helpers.loop import S_HAT, noises

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
