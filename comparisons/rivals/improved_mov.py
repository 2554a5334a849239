"""Improved MOV-FxLMS: MOV-FxLMS whose penalty factor follows the disturbance that an identified primary path predicts.

J. Ji, D. Shi, X. Shen, Z. Luo, W.-S. Gan, Applied Acoustics 231, 2025, 10.1016/j.apacoust.2024.110473. The step has the
measured error, the penalty factor is that of MOV-MFxLMS. An amplifier that clips spoils the estimate e + s^ * y and not
p^ * x. Powers are sums over a window, with floors on those of x and x', as in the authors' code.
"""

import numpy as np

from .one_channel import OneChannel, push

WINDOW = 1024  # samples
FLOOR = 0.3  # of the sums of x^2 and x'^2
PATH_ENERGY = 1e-6  # of the reference, per tap: without it a narrow band would leave the path undetermined


class ImprovedMOV(OneChannel):
    """MOV-FxLMS with a primary path that is given, or identified from what it hears before the control is on."""

    name = "improved MOV-FxLMS"

    def __init__(
        self, n_taps: int, secondary: np.ndarray, *, step_size: float, rated_power: float, primary: np.ndarray
    ) -> None:
        self.mu, self.rated_power, self.primary = step_size, rated_power, np.array(primary, dtype=float)
        super().__init__(n_taps, secondary, memory=self.primary.size)
        self.squares = np.zeros((3, WINDOW))  # of d^, x', x, the newest first
        self.gamma = 0.0

    def listen(self, references: np.ndarray, errors: np.ndarray) -> None:
        """Identify the primary path by least squares, from the samples before the control is switched on."""
        self.primary = None
        for reference in references:
            self.hear(reference)

    def update(self, error: float) -> None:
        """Take a step, by the error and the penalty factor."""
        # d^(n) = (p^ * x)(n)
        d = self.primary @ self.x[: self.primary.size]
        push(self.squares.T, np.square([d, self.filtered[0], self.x[0]]))
        power_d, power_filtered, power_x = np.maximum(np.sum(self.squares, axis=1), [0.0, FLOOR, FLOOR])
        # gamma = max{G (sqrt(E[d^2] / (G rho)) - 1), 0},  G = E[x'^2] / E[x^2]
        G = power_filtered / power_x
        self.gamma = max(G * (np.sqrt(power_d / WINDOW / (G * self.rated_power)) - 1), 0.0)
        # w <- w + mu (e x' - gamma y x)
        n_taps = self.w.size
        self.w += self.mu * (error * self.filtered[:n_taps] - self.gamma * self.y[0] * self.x[:n_taps])
