"""Delayless subband FxLMS: it adapts in subbands and filters in the full band.

D. R. Morgan, J. C. Thi, "A delayless subband adaptive filter architecture", IEEE Trans. Signal Processing 43(8), 1995: the
structure, and the stacking of the spectra. There, the bin at fs/2 is zero; here it is kept, because a short filter needs it.
The errors pass the bank, which delays the adaptation by 2 M samples; this limits the step size. A response between two
bands, or a delay that is no multiple of M/2, needs longer subband filters, so the weights settle only near the best ones.
"""

import numpy as np
from numpy.fft import fft, irfft, rfft

from .one_channel import OneChannel, push

RIDGE = 0.01  # of the mean energy of all bands


class SubbandFxLMS(OneChannel):
    """FxLMS in M bands, each fs/M wide and sampled at 2 fs/M; M is even and divides L."""

    name = "subband FxLMS"

    def __init__(self, n_taps: int, secondary: np.ndarray, *, step_size: float, n_bands: int) -> None:
        M = self.M = n_bands
        super().__init__(n_taps, secondary, memory=4 * M)
        self.mu, self.n, self.e = step_size, 0, np.zeros(4 * M)
        # h, a low-pass filter of 4 M taps and the bandwidth fs/M
        self.h = np.hamming(4 * M) * np.sinc((np.arange(4 * M) - (4 * M - 1) / 2) / M)
        self.h /= np.sum(self.h)
        taps = 2 * n_taps // M  # of a band's filter, which so lasts as long as the control filter
        self.x_bands, self.w_bands = np.zeros((2, taps, M // 2 + 1), dtype=complex)
        bins = np.arange(n_taps // 2 + 1)
        self.stacked = bins % taps, (2 * bins * M + n_taps) // (2 * n_taps)  # bin of a band's filter, nearest band

    def update(self, error: float) -> None:
        """Take an error, and adapt once per sample of the bands."""
        push(self.e, error)
        self.n += 1
        if self.n % (self.M // 2) == 0:
            self.adapt(self.analysed(self.filtered[: 4 * self.M]), self.analysed(self.e))

    def analysed(self, line: np.ndarray) -> np.ndarray:
        """Return the newest sample of each band."""
        # x_b(m) = sum_k h_k e^{j 2 pi b k/M} x(m M/2 - k)
        return np.conj(rfft((self.h * line).reshape(4, self.M).sum(axis=0)))

    def adapt(self, x: np.ndarray, e: np.ndarray) -> None:
        """Take a step in each band, and stack the spectra of the bands."""
        push(self.x_bands, x)
        energy = np.sum(np.abs(self.x_bands) ** 2, axis=0)
        # w_b <- w_b + mu e_b x'_b* / (|x'_b|^2 + epsilon)
        epsilon = RIDGE * np.mean(energy) + np.finfo(float).tiny
        self.w_bands += self.mu * e * self.x_bands.conj() / (energy + epsilon)
        # W(f) = W_b(f), with b the band that is nearest to f
        self.w = irfft(fft(self.w_bands, axis=0)[self.stacked], self.w.size)
