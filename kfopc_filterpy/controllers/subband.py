"""Delayless subband FxLMS: it adapts in subbands and filters in the full band."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.fft import fft, irfft, rfft
from scipy.signal import firwin

from .._types import PathModels
from .._validate import as_count, as_positive
from .block import BlockController
from .frequency_domain import RIDGE

PROTOTYPE_BANDS = 4  # taps of the prototype over the number of bands: its stopband begins where decimation aliases


class SubbandFxLMS(BlockController):
    r"""Delayless subband FxLMS: errors and filtered references are split into bands, in which normalised LMS adapts.

    A filter bank of M bands, each fs/M wide and sampled at 2 fs/M, splits the filtered reference into x'_b and the
    error into e_b. In each band, a complex filter of 2L/M taps adapts once per subband sample,

    .. math:: w_b \leftarrow w_b + \mu\, \frac{e_b\, x_b'^*}{\epsilon + \lVert x'_b \rVert^2}

    At the end of a block, the spectra of these filters are stacked, each bin from the nearest band, and transformed
    back into the control filter of L taps. This filters the reference itself, so the control signal has no delay.

    Parameters
    ----------
    n_taps, secondary_path, n_references
        As for `FxLMS`. `n_taps` must be a multiple of M.
    step_size : float
        Step size mu of a block, above zero and below 1; each subband sample of the block takes an equal share of it.
    n_bands : int
        Number M of bands, even. `n_bands // 2 + 1` of them differ, because the signals are real.
    block_size : int
        Samples B of a block, a multiple of M/2.

    Raises
    ------
    ValueError
        A step size that is not positive and finite; sizes below 1; an odd number of bands; `n_taps` or `block_size`
        that is not the multiple stated above; a path that is all zeros or not FIR.

    Notes
    -----
    The prototype of the bank is a low-pass filter of 4 M taps. The errors pass the bank, which delays the adaptation by
    2 M samples; this limits the step size. The filter of a band lasts as long as the control filter, but a response
    between two bands, or a delay that is no multiple of M/2, needs taps beyond that. So the weights settle near the
    best filter, not at it. For L + 4 M samples after a new `secondary_path` is assigned, the stored references of the
    bands still include the old one. To limit the control signal, wrap the controller in a `LimitedController`.

    References
    ----------
    D. R. Morgan, J. C. Thi, "A delayless subband adaptive filter architecture", IEEE Trans. Signal Processing 43(8),
    1995: the structure, and the stacking of the spectra. There, the bin at fs/2 is zero; here it is kept, because a
    short filter needs it. S. J. Park, J. H. Yun, Y. C. Park, D. H. Youn, "A delayless subband active noise control
    system for wideband noise control", IEEE Trans. Speech and Audio Processing 9(8), 2001, models the secondary path in
    the bands; here the reference is filtered in the full band, by Fourier transforms.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import SubbandFxLMS, noise_reduction_db, simulate
    >>> x = np.random.default_rng(0).standard_normal(32000)
    >>> controller = SubbandFxLMS(128, [0.0, 1.0], step_size=0.2, n_bands=16, block_size=32)
    >>> result = simulate(controller, x, primary_path=np.eye(30)[20], secondary_path=[0.0, 1.0])
    >>> bool(noise_reduction_db(result.error, result.disturbance) > 25)
    True
    """

    name = "delayless subband FxLMS"

    def __init__(
        self,
        n_taps: int,
        secondary_path: PathModels,
        *,
        step_size: float,
        n_bands: int,
        block_size: int,
        n_references: int = 1,
    ) -> None:
        self.step_size = as_positive(step_size, "step_size")
        M = self.n_bands = as_count(n_bands, "n_bands", minimum=2)
        if M % 2:
            raise ValueError(f"n_bands must be even, got {M}")
        for name, size, step in (("n_taps", n_taps, M), ("block_size", block_size, M // 2)):
            if as_count(size, name) % step:
                raise ValueError(f"{name} must be a multiple of {step} with {M} bands, got {size}")
        super().__init__(n_taps, secondary_path, block_size=block_size, partition_size=None, n_references=n_references)
        channels = (self.n_microphones, self.n_loudspeakers, self.n_references)
        self._prototype = firwin(PROTOTYPE_BANDS * M, 1.0 / M)
        self._steps = block_size // (M // 2)  # subband samples of a block
        line, taps, bands = self._prototype.size - M // 2 + block_size, 2 * n_taps // M, M // 2 + 1
        self._x_line, self._e_line = np.zeros((*channels, line)), np.zeros((self.n_microphones, line))
        self._x_bands = np.zeros((*channels, taps + self._steps - 1, bands), dtype=complex)  # the newest last
        self._w_bands = np.zeros((*channels[1:], taps, bands), dtype=complex)  # the newest sample's tap last
        nearest = np.arange(n_taps // 2 + 1)
        self._stacked = nearest % taps, (2 * nearest * M + n_taps) // (2 * n_taps)  # subband bin and band of each bin

    def _analysed(self, line: np.ndarray) -> np.ndarray:
        """Return the subband samples of a block, (..., steps, bands), from a delay line that ends with it."""
        # x_b(m) = sum_k h_k e^{j 2 pi b k/M} x(m M/2 - k)
        size = self._prototype.size
        windows = sliding_window_view(line, size, axis=-1)[..., :: self.n_bands // 2, ::-1]
        folded = (windows * self._prototype).reshape(*windows.shape[:-1], -1, self.n_bands).sum(axis=-2)
        return np.conj(rfft(folded))

    def _follow(self) -> None:
        filtered = self._block_of(self._X_filtered[..., 0, :])
        self._x_line = np.concatenate((self._x_line[..., self.block_size :], filtered), axis=-1)
        self._e_line = np.concatenate((self._e_line[..., self.block_size :], self._errors), axis=-1)
        newest = self._analysed(self._x_line)
        self._x_bands = np.concatenate((self._x_bands[..., self._steps :, :], newest), axis=-2)

    def _adapt(self) -> None:
        errors, taps, least = self._analysed(self._e_line), self._w_bands.shape[-2], self.n_taps * self._least_power()
        for m in range(self._steps):
            x = self._x_bands[..., m : m + taps, :]
            energy = np.sum(x.real**2 + x.imag**2, axis=(0, 1, 2, 3))
            step = self.step_size / self._steps / (energy + RIDGE * energy.mean() + least)
            self._w_bands += np.sum(x.conj() * (step * errors[:, m])[:, None, None, None], axis=0)
        # The newest sample's tap first, as in the control filter.
        spectra = fft(self._w_bands[..., ::-1, :], axis=-2)[..., *self._stacked]
        w = irfft(spectra, self.n_taps)
        padded = np.zeros((*w.shape[:-1], self.n_partitions * self.partition_size))
        padded[..., : self.n_taps] = w
        self._W = self._spectra(padded.reshape(*w.shape[:-1], self.n_partitions, -1))
