"""Fast-array Kalman filter: the Kalman filter without state noise, or recursive least squares, in O(L) per sample.

R. Fraanje, A. H. Sayed, M. Verhaegen, N. J. Doelman, "A fast-array Kalman filter solution to active noise control", Int. J.
Adapt. Control Signal Process. 19, 2005; A. H. Sayed, Fundamentals of Adaptive Filtering, Wiley 2003, ch. 14, from which
these equations follow. Successive rows x' share all but one sample, so P, in units of the measurement noise q, changes by a
matrix of rank two, which two rotations update:

    ([P(n), 0; 0, 0] - [0, 0; 0, P(n-1)]) / lambda = B(n) diag(1, -1) B(n)^T

It begins with P = P0 diag(lambda, ..., lambda^L). With lambda < 1, rounding errors grow by 1/lambda per sample, until the
array is lost after 10 to 20 memories of 1/(1 - lambda) samples; a narrow band can spoil it without forgetting, too.
"""

import numpy as np

from .one_channel import OneChannel


class FastArrayKalman(OneChannel):
    """Kalman filter whose gains follow the filtered reference by rotations of three columns."""

    name = "fast-array KF"

    def __init__(self, n_taps: int, secondary: np.ndarray, *, forgetting: float, initial_variance: float) -> None:
        super().__init__(n_taps, secondary)
        self.forgetting, self.root = forgetting, 1.0  # gamma^-1/2, gamma^-1 = 1 + x'^T P x' / lambda
        self.gain, self.first, self.second = np.zeros((3, n_taps + 1))  # [g gamma^-1/2; 0], and the columns of B
        self.first[0] = np.sqrt(initial_variance)
        self.second[-1] = np.sqrt(initial_variance * forgetting**n_taps)

    def control_signal(self, reference: float) -> float:
        """Return the control signal for the newest reference sample, and let the gains follow."""
        self.hear(reference)
        self.rotate(self.filtered[: self.gain.size])
        return self.play()

    def rotate(self, row: np.ndarray) -> None:
        """Follow the L + 1 newest samples of the filtered reference."""
        # [gamma^-1/2(n),             x+^T(n+1) B(n)]         [gamma^-1/2(n+1),                 0              ]
        # [[0; g(n) gamma^-1/2(n)],   B(n)          ] Theta = [[g(n+1) gamma^-1/2(n+1); 0],  lambda^1/2 B(n+1)]
        ahead, behind = row @ self.first, row @ self.second
        norm = np.hypot(self.root, ahead)
        c, s = self.root / norm, ahead / norm  # orthogonal: the second entry of the first row becomes zero
        t = behind / norm  # hyperbolic: and so does the third
        h = 1 / np.sqrt(1 - t**2)
        gain = np.concatenate(([0.0], self.gain[:-1]))
        rotated = c * gain + s * self.first
        self.first = (c * self.first - s * gain) / np.sqrt(self.forgetting)
        self.gain = h * (rotated - t * self.second)
        self.second = h * (self.second - t * rotated) / np.sqrt(self.forgetting)
        self.root = float(norm / h)

    def update(self, error: float) -> None:
        """Correct the weights by the disturbance that an error reveals."""
        # w <- w + g (d^ - w^T x')
        n_taps = self.w.size
        innovation = self.disturbance(error) - self.w @ self.filtered[:n_taps]
        self.w += innovation / self.root * self.gain[:n_taps]
