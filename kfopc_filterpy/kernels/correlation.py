"""Correlation of signals over an exponential window, updated one block of samples at a time."""

from __future__ import annotations

import numpy as np
from scipy import fft


class FadingCorrelation:
    """Correlation of I signals over an exponential window, by FFT.

    Parameters
    ----------
    n_lags, n_signals : int
        Number of lags M, and I.
    keep : float
        Factor by which the weight of a product falls per sample.

    Attributes
    ----------
    total : ndarray, shape (M, I, I)
        Weighted sum of the products x_i(n - m) x_k(n), at [m, i, k].
    mass : float
        Sum of the weights.
    """

    def __init__(self, n_lags: int, n_signals: int, keep: float) -> None:
        self.keep, self.mass = keep, 0.0
        self.total = np.zeros((n_lags, n_signals, n_signals))
        self._before = np.zeros((n_signals, n_lags - 1))  # the samples before the next block, if none is left out
        self._unbroken = 0  # samples since the last one that was left out

    def add(self, signals: np.ndarray) -> None:
        """Add the samples of a block, the last B of `signals`, (I, M - 1 + B).

        If samples between the last block and this one were left out, those before them count as zeros from now on: their
        products with later samples would have no counterpart in the sum, which then would not be that of any signal.
        """
        n_lags = len(self.total)
        if not np.array_equal(signals[:, : n_lags - 1], self._before):
            self._unbroken = 0
        self._before = signals[:, signals.shape[1] - (n_lags - 1) :].copy()
        if self._unbroken < n_lags - 1:
            signals = signals.copy()
            signals[:, : n_lags - 1 - self._unbroken] = 0.0
        block = signals.shape[1] - (n_lags - 1)
        self._unbroken += block
        weights = np.zeros(signals.shape[1])
        weights[n_lags - 1 :] = self.keep ** np.arange(block - 1, -1, -1.0)
        size = fft.next_fast_len(signals.shape[1], real=True)
        spectra, of_late = fft.rfft(signals, size), fft.rfft(signals * weights, size)
        products = fft.irfft(spectra[:, np.newaxis].conj() * of_late, size)  # of lag m at [i, k, m]
        self.total = self.keep**block * self.total + products[..., :n_lags].transpose(2, 0, 1)
        self.mass = self.keep**block * self.mass + weights.sum()

    @property
    def faded(self) -> np.ndarray:
        """Mean products, (M, I, I), of signals that fade into the past, so positive definite; zero in silence."""
        lags = np.arange(len(self.total))
        return self.total * (np.sqrt(self.keep) ** lags / max(self.mass, 1.0))[:, np.newaxis, np.newaxis]
