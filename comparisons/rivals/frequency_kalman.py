"""Frequency-domain Kalman filter: the control filter's spectrum is the state, with a variance for each bin.

G. Enzner, P. Vary, "Frequency-domain adaptive Kalman filter for acoustic echo control in hands-free telephones", Signal
Processing 86(6), 2006. There, the gain is applied in one step; here in two causal factors, as in FrequencyDomainFxLMS:
else the weights would settle elsewhere than at the best causal filter.
"""

import numpy as np
from numpy.fft import irfft, rfft

from kfopc_filterpy.controllers.frequency_domain import minimum_phase

from .one_channel import OneChannel


class FrequencyDomainKalman(OneChannel):
    """Kalman filter that adapts once per block of B samples, to transforms of N + B samples, N >= L."""

    name = "frequency-domain KF"

    def __init__(
        self,
        n_taps: int,
        secondary: np.ndarray,
        *,
        block_size: int,
        transition: float,
        initial_variance: float = 1.0,
        forgetting: float = 0.9,
    ) -> None:
        self.B, self.A, self.forgetting = block_size, transition, forgetting
        self.size = (-(-n_taps // block_size) + 1) * block_size
        super().__init__(n_taps, secondary, memory=self.size)
        self.errors: list[float] = []
        self.blocks = 0
        self.P = np.full(self.size // 2 + 1, initial_variance)
        self.noise = np.zeros(self.P.size)  # Psi

    def update(self, error: float) -> None:
        """Take an error, and adapt at the end of a block."""
        # the innovation d^ - w^T x'
        self.errors.append(float(self.disturbance(error) - self.w @ self.filtered[: self.w.size]))
        if len(self.errors) == self.B:
            self.adapt(rfft(np.pad(self.errors, (self.size - self.B, 0))))
            self.errors = []

    def adapt(self, E: np.ndarray) -> None:
        """Correct the spectrum by that of a block's innovations."""
        if not E.any():  # no sound has arrived yet: a noise of zero would make P zero for good
            return
        self.blocks += 1
        X = rfft(self.filtered[: self.size][::-1])
        b = self.B / self.size
        # Psi = E|E|^2
        self.noise += max(1 - self.forgetting, 1 / self.blocks) * (np.abs(E) ** 2 - self.noise)
        # P <- A^2 P + (1 - A^2) |W|^2
        P = self.A**2 * self.P + (1 - self.A**2) * np.abs(rfft(self.w, self.size)) ** 2
        # mu = P / (b |X'|^2 P + Psi)
        mu = P / (b * np.abs(X) ** 2 * P + self.noise + np.finfo(float).tiny)
        # W <- W + C{M C{M* X'* E}},  |M|^2 = mu
        M = minimum_phase(np.sqrt(mu), self.size)
        self.w += self.constrained(M * rfft(self.constrained(M.conj() * X.conj() * E), self.size))
        # P <- (1 - b mu |X'|^2) P
        self.P = (1 - b * mu * np.abs(X) ** 2) * P

    def constrained(self, spectrum: np.ndarray) -> np.ndarray:
        """Return the L taps that are left of a spectrum."""
        return irfft(spectrum, self.size)[: self.w.size]
