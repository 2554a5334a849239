"""The delay lines that every rival has."""

from typing import Any

import numpy as np


def push(line: np.ndarray, newest: Any) -> None:
    """Move a delay line on by a sample; the newest one comes first."""
    line[1:] = line[:-1]
    line[0] = newest


class OneChannel:
    """A control filter w with the newest samples of the reference, the filtered reference and the control signal."""

    def __init__(self, n_taps: int, secondary: np.ndarray, memory: int = 0) -> None:
        self.secondary, self.w = np.array(secondary, dtype=float), np.zeros(n_taps)
        self.x, self.filtered, self.y = np.zeros((3, max(n_taps + 1, self.secondary.size, memory)))

    def control_signal(self, reference: float) -> float:
        """Return the control signal for the newest reference sample."""
        self.hear(reference)
        return self.play()

    def hear(self, reference: float) -> None:
        """Take a sample of the reference."""
        push(self.x, reference)
        # x'(n) = (s^ * x)(n)
        push(self.filtered, self.secondary @ self.x[: self.secondary.size])

    def play(self) -> float:
        """Return the control signal."""
        # y(n) = w^T x(n)
        push(self.y, self.w @ self.x[: self.w.size])
        return float(self.y[0])

    def disturbance(self, error: float) -> float:
        """Return what the error reveals of the disturbance."""
        # d^(n) = e(n) + (s^ * y)(n)
        return float(error + self.secondary @ self.y[: self.secondary.size])

    @property
    def weights(self) -> np.ndarray:
        """Control filter, (L,)."""
        return self.w.copy()
