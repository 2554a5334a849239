"""Sub-filter Kalman filter: fixed sub-filters, mixed by gains that a Kalman filter of as many states finds.

The structure is that of Z. Luo, D. Shi, X. Shen, J. Ji, W.-S. Gan, "GFANC-Kalman: Generative fixed-filter active noise
control with CNN-Kalman filtering", IEEE Signal Process. Lett. 31, 2024. There, a network tells from each second of noise
which of 15 sub-filters it needs, and the Kalman filter smooths these answers. Here, nothing is trained: the sub-filters
are the bands of one broadband control filter, and the Kalman filter observes the error microphone.
"""

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import brentq

from .one_channel import OneChannel

BLOCK_S, MEMORY_S = 0.005, 0.5  # after which R, H and the reduction of the gains are computed anew; memory of R and H
RIDGE = 1e-6  # of the mean energy of an output: bands with less get no gain while the power is limited


def band_subfilters(control_filter: np.ndarray, n_bands: int = 15) -> np.ndarray:
    """Return the parts of a control filter in bands of equal width, (n_bands, L); their sum is the control filter."""
    spectrum = np.fft.rfft(control_filter)
    parts = np.zeros((n_bands, spectrum.size), dtype=complex)
    for part, bins in zip(parts, np.array_split(np.arange(spectrum.size), n_bands), strict=True):
        part[bins] = spectrum[bins]
    return np.fft.irfft(parts, n=len(control_filter))


class SubfilterKalman(OneChannel):
    """Sub-filters (C, L), mixed by gains g, which are reduced to the best ones within the rated power."""

    name = "sub-filter KF"

    def __init__(
        self,
        n_taps: int,
        secondary: np.ndarray,
        *,
        subfilters: np.ndarray,
        state_noise: float,
        measurement_noise: float,
        rated_power: float,
        fs: float,
    ) -> None:
        super().__init__(n_taps, secondary)
        self.bank, self.r, self.q, self.rated_power = subfilters, state_noise, measurement_noise, rated_power
        C = len(subfilters)
        self.g, self.P = np.zeros(C), np.eye(C)
        # Means of the products of the outputs, before and after the secondary path.
        self.R, self.H = np.zeros((2, C, C))
        self.reduction = np.eye(C)  # from the gains of the Kalman filter to those within the rated power
        self.block, self.memory = np.zeros((2, max(round(BLOCK_S * fs), 1), C)), MEMORY_S * fs
        self.n = 0

    def control_signal(self, reference: float) -> float:
        """Return the control signal for the newest reference sample."""
        self.hear(reference)
        n_taps, length = self.w.size, self.block.shape[1]
        self.block[:, self.n % length] = self.x[:n_taps] @ self.bank.T, self.filtered[:n_taps] @ self.bank.T
        self.row = self.block[1, self.n % length].copy()
        self.n += 1
        if self.n % length == 0:
            rate = max(length / self.n, 1 - np.exp(-length / self.memory))
            for mean, outputs in zip((self.R, self.H), self.block, strict=True):
                mean += rate * (outputs.T @ outputs / length - mean)
            self.reduction = self.within()
        # y = sum_c g'_c (w_c * x)
        self.w = self.reduction @ self.g @ self.bank
        return self.play()

    def within(self) -> np.ndarray:
        """Return the matrix that reduces the gains to the best ones within the rated power."""
        if self.g @ self.R @ self.g <= self.rated_power:
            return np.eye(self.g.size)
        # (H + lambda R) g' = H g,  g'^T R g' = rho, in the coordinates V that make H the identity and R diagonal
        H = self.H + RIDGE * np.trace(self.H) / self.g.size * np.eye(self.g.size)
        nu, V = eigh(self.R, H)
        a = V.T @ self.H @ self.g

        def excess(multiplier: float) -> float:
            return float(np.sum(nu * (a / (1 + multiplier * nu)) ** 2)) - self.rated_power

        highest = 1.0
        while excess(highest) > 0:
            highest *= 10
        multiplier = brentq(excess, 0.0, highest) if excess(0.0) > 0 else 0.0
        return V / (1 + multiplier * nu) @ V.T @ self.H

    def update(self, error: float) -> None:
        """Let the gains adapt to the disturbance that an error reveals."""
        h = self.row
        # P <- P + r I,  K = P h / (h^T P h + q),  g <- g + K (d^ - h^T g),  P <- P - K h^T P
        self.P += self.r * np.eye(h.size)
        K = self.P @ h / (h @ self.P @ h + self.q)
        self.g = self.g + K * (self.disturbance(error) - h @ self.g)
        self.P -= np.outer(K, h @ self.P)
        self.P = (self.P + self.P.T) / 2
