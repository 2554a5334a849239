"""Power-limited FxLMS: frequency-domain FxLMS with a penalty on the power of y, whose weight lambda (a price) is integrated.

After W. J. Kozacky, T. Ogunfunmi, "An active noise control algorithm with gain and power constraints on the adaptive
filter", EURASIP Journal on Advances in Signal Processing 2013:17, which has penalties on the power in each bin, with fixed
weights; here there is one limit, that of the whole power, and its weight grows until the limit is met. So it settles at
the power-constrained Wiener solution. A tone in the middle of a bin makes it diverge: see SPREAD of FrequencyDomainFxLMS.
"""

import numpy as np
from numpy.fft import irfft, rfft

from kfopc_filterpy.controllers.frequency_domain import minimum_phase

from .one_channel import OneChannel

PRICE_RATE = 1 / 16  # of the step size: the price settles without ringing, also with the averaged powers
MOST_EXCESS = 3.0  # relative to the limit, in a step of the price
RIDGE = 0.01  # of the mean power of all bins


class PowerLimitedFxLMS(OneChannel):
    """FxLMS within a rated power that adapts once per block of B samples, to transforms of N + B samples, N >= L."""

    name = "power-limited FxLMS"

    def __init__(
        self,
        n_taps: int,
        secondary: np.ndarray,
        *,
        step_size: float,
        block_size: int,
        rated_power: float,
        forgetting: float = 0.9,
    ) -> None:
        self.mu, self.B, self.rated_power, self.forgetting = step_size, block_size, rated_power, forgetting
        self.size = (-(-n_taps // block_size) + 1) * block_size
        super().__init__(n_taps, secondary, memory=self.size)
        self.errors: list[float] = []
        self.blocks, self.price = 0, 0.0
        self.X2_filtered, self.X2 = np.zeros((2, self.size // 2 + 1))  # E|X'|^2, E|X|^2
        self.power = 0.0  # of y
        self.window = np.hanning(self.size + 1)[:-1]

    def listen(self, references: np.ndarray, _: np.ndarray) -> None:
        """Hear references before the control is switched on."""
        for reference in references:
            self.hear(reference)

    def update(self, error: float) -> None:
        """Take an error, and adapt at the end of a block."""
        self.errors.append(error)
        if len(self.errors) == self.B:
            self.adapt(*(np.pad(block, (self.size - self.B, 0)) for block in (self.errors, self.y[: self.B][::-1])))
            self.errors = []

    def adapt(self, e: np.ndarray, y: np.ndarray) -> None:
        """Take a step, by the errors and the control signals of a block after zeros."""
        X_filtered, X = (rfft(line[: self.size][::-1]) for line in (self.filtered, self.x))
        self.blocks += 1
        share = max(1 - self.forgetting, 1 / self.blocks)
        self.X2_filtered += share * (np.abs(X_filtered) ** 2 - self.X2_filtered)
        self.X2 += share * (np.abs(X) ** 2 - self.X2)
        self.power += share * (np.sum((self.window * self.y[: self.size]) ** 2) / np.sum(self.window**2) - self.power)
        # lambda <- max{lambda + mu/16 G (p / rho - 1), 0},  G = E|X'|^2 / E|X|^2
        tiny = np.finfo(float).tiny
        G = np.sum(self.X2_filtered) / max(np.sum(self.X2), tiny)
        excess = min(self.power / self.rated_power - 1, MOST_EXCESS)
        self.price = max(self.price + PRICE_RATE * self.mu * G * excess, 0.0)
        # |M|^-2 = E|X'|^2 + lambda E|X|^2
        powers = self.X2_filtered + self.price * self.X2
        M = minimum_phase((powers + RIDGE * np.mean(powers) + tiny) ** -0.5, self.size)
        # W <- W + mu C{M C{M* (X'* E - lambda X* Y)}}
        gradient = X_filtered.conj() * rfft(e) - self.price * X.conj() * rfft(y)
        self.w += self.mu * self.constrained(M * rfft(self.constrained(M.conj() * gradient), self.size))

    def constrained(self, spectrum: np.ndarray) -> np.ndarray:
        """Return the L taps that are left of a spectrum."""
        return irfft(spectrum, self.size)[: self.w.size]
