"""Improved MOV-FxLMS: MOV-FxLMS whose penalty factor follows the disturbance that an identified primary path predicts.

J. Ji, D. Shi, X. Shen, Z. Luo, W.-S. Gan, Applied Acoustics 231, 2025, 10.1016/j.apacoust.2024.110473. The penalty factor is
that of MOV-MFxLMS, the step has the measured error. An amplifier that clips spoils e + s^ * y, and not p^ * x. The powers
are sums over a window, with floors for x and x', as in the authors' published code, with which this agrees to rounding.
"""

import numpy as np
from scipy.linalg import solve, toeplitz

from .one_channel import OneChannel, push

WINDOW = 1024  # samples
FLOOR = 0.3  # of the sums of x^2 and x'^2
RIDGE = 1e-6  # over the energy of the reference: a narrow band does not determine the path


class ImprovedMOV(OneChannel):
    """MOV-FxLMS with a primary path that is given, or identified before the control is switched on."""

    name = "improved MOV-FxLMS"

    def __init__(
        self, n_taps: int, secondary: np.ndarray, *, step_size: float, rated_power: float, primary: np.ndarray
    ) -> None:
        self.mu, self.rated_power, self.primary = step_size, rated_power, np.array(primary, dtype=float)
        super().__init__(n_taps, secondary, memory=self.primary.size)
        self.squares = np.zeros((3, WINDOW))  # of d^, x', x
        self.gamma = 0.0

    def listen(self, references: np.ndarray, errors: np.ndarray) -> None:
        """Identify a primary path of the given length; the loudspeaker is silent."""
        # p^ = (X^T X + epsilon I)^-1 X^T d
        X = toeplitz(references, np.zeros(self.primary.size))
        epsilon = RIDGE * np.sum(references**2)
        self.primary = solve(X.T @ X + epsilon * np.eye(self.primary.size), X.T @ errors, assume_a="pos")
        for reference in references:
            self.hear(reference)
            self.follow()

    def follow(self) -> None:
        """Let the penalty factor follow the newest sample."""
        # d^(n) = (p^ * x)(n)
        d = self.primary @ self.x[: self.primary.size]
        push(self.squares.T, np.square([d, self.filtered[0], self.x[0]]))
        power_d, power_filtered, power_x = np.maximum(self.squares.sum(axis=1), [0.0, FLOOR, FLOOR]) / WINDOW
        # gamma = max{G (sqrt(E[d^2] / (G rho)) - 1), 0},  G = E[x'^2] / E[x^2]
        G = power_filtered / power_x
        self.gamma = max(G * (np.sqrt(power_d / (G * self.rated_power)) - 1), 0.0)

    def update(self, error: float) -> None:
        """Take a step, by the error and the penalty factor."""
        self.follow()
        # w <- w + mu (e x' - gamma y x)
        n_taps = self.w.size
        self.w += self.mu * (error * self.filtered[:n_taps] - self.gamma * self.y[0] * self.x[:n_taps])
