"""A Kalman filter of FIR paths in the frequency domain: partitions, overlap-save and a diagonal covariance.

The paths from I inputs to K outputs are cut into partitions of B taps. Each partition has a spectrum of 2B points, and
so has each frame of the last 2B samples of an input: the last B samples of their product are a linear convolution
(overlap-save). The variance of the taps is a spectrum for each input and partition. All outputs share it, since they
have the same observation rows, and variances are relative to their measurement noise, which counts as 1.

Published forms assume the covariance of the innovation to be diagonal, too. They neglect that the frequencies of a
frame leak into each other: for band-limited noise they converge slowly, and a tone can make them diverge. Here only the
covariance of the taps is diagonal. The covariance of the innovation that follows from it is used in full: a system of B
unknowns, solved by a few steps of conjugate gradients with the diagonal form as the preconditioner. Its solution never
increases the error of the block.

References
----------
G. Enzner and P. Vary, "Frequency-domain adaptive Kalman filter for acoustic echo control in hands-free telephones",
Signal Processing 86(6), 2006.
F. Kuech, E. Mabande and G. Enzner, "State-space architecture of the partitioned-block-based acoustic echo controller",
Proc. IEEE ICASSP, 2014.
"""

from __future__ import annotations

import numpy as np
from scipy import fft

from .block_toeplitz import conjugate_gradients

STEPS = 6  # of conjugate gradients in a block
SHARE = 0.5  # block over frame: the share of a frame's information that a diagonal covariance may assume


class PartitionedKalman:
    """Kalman filter that estimates the paths from I inputs to K outputs.

    Parameters
    ----------
    n_outputs, n_inputs, n_taps : int
        K, I, and the taps of a path.
    block : int
        Samples B of a block and of a partition.
    """

    def __init__(self, n_outputs: int, n_inputs: int, n_taps: int, block: int) -> None:
        self.block, self.n_taps = block, n_taps
        partitions = -(-n_taps // block)
        self.span = (partitions + 1) * block  # samples of the inputs that the frames of all partitions need
        shape = (n_inputs, partitions, block + 1)
        self.variance = np.zeros(shape)  # of a tap, at each frequency
        self.state_noise = 0.0  # of a tap and sample
        self._spectra = np.zeros((n_outputs, *shape), complex)
        self._frames = np.zeros(shape, complex)  # the newest first
        self._cut = np.arange(partitions * block).reshape(partitions, block) >= n_taps

    @property
    def paths(self) -> np.ndarray:
        """Estimated paths, (K, I, n_taps)."""
        taps = fft.irfft(self._spectra)[..., : self.block]
        return taps.reshape(*taps.shape[:2], -1)[..., : self.n_taps]

    def hear(self, inputs: np.ndarray) -> None:
        """Take the inputs, (I, n), which end with those of the present block; n is at least `span`."""
        blocks = inputs[:, -self.span :].reshape(len(inputs), -1, self.block)[:, ::-1]  # the newest first
        self._frames = fft.rfft(np.concatenate([blocks[:, 1:], blocks[:, :-1]], axis=-1))

    def learn(self, outputs: np.ndarray) -> bool:
        """Correct the paths by the outputs of the present block, (K, B); return False if that overflows."""
        variance = self.variance + self.block * self.state_noise
        spectra, frames = self._spectra, self._frames
        own = 0.5 * variance * np.abs(frames) ** 2  # the variance of the output that each partition explains
        innovation = innovation_spectrum(own.sum(axis=(0, 1)))

        def correction(z: np.ndarray) -> np.ndarray:
            return self._constrained(variance * self._constrained(frames.conj() * _late(z)[:, np.newaxis, np.newaxis]))

        def covariance(z: np.ndarray) -> np.ndarray:
            return self.outputs(correction(z)) + z

        def precondition(z: np.ndarray) -> np.ndarray:
            return fft.irfft(_late(z) / innovation)[:, self.block :]

        error = outputs - self.outputs(spectra)
        z = conjugate_gradients(covariance, precondition, error, np.zeros_like(error), STEPS, axis=-1)
        corrected, reduced = spectra + correction(z), variance * np.maximum(1.0 - SHARE * own / innovation, 0.0)
        if not (np.isfinite(corrected).all() and np.isfinite(reduced).all()):
            return False
        self._spectra, self.variance = corrected, reduced
        return True

    def outputs(self, spectra: np.ndarray) -> np.ndarray:
        """Return the outputs of paths for the present frames, (K, B)."""
        return fft.irfft(np.einsum("ipf,kipf->kf", self._frames, spectra))[:, self.block :]

    def _constrained(self, spectra: np.ndarray) -> np.ndarray:
        """Return spectra without the taps past the end of a partition or of the path."""
        taps = fft.irfft(spectra)[..., : self.block]
        taps[..., self._cut] = 0.0
        return fft.rfft(taps, 2 * self.block)


def innovation_spectrum(explained: np.ndarray) -> np.ndarray:
    """Return the spectrum per sample of the innovation in the second half of a frame, with measurement noise of 1.

    `explained`, (B + 1,), is the spectrum for the whole frame, without measurement noise. Half a frame has fewer pairs
    of samples at each lag, which spreads a spectral line over its neighbours.
    """
    block = explained.size - 1
    lags = fft.irfft(explained)
    lags[: block + 1] *= 1.0 - np.arange(block + 1) / block
    lags[block + 1 :] *= np.arange(1, block) / block
    return np.maximum(fft.rfft(lags).real, 0.0) + 1.0


def _late(block: np.ndarray) -> np.ndarray:
    """Return the spectra of frames that are silent before the block, (K, B + 1)."""
    return fft.rfft(np.concatenate([np.zeros_like(block), block], axis=-1))
