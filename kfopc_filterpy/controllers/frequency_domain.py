"""FxLMS in the frequency domain, by overlap-save."""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft, rfft

from .._types import PathModels
from .._validate import as_choice, as_positive
from .base import as_forgetting
from .block import BlockController

RIDGE = 0.01  # of the mean power of all bins, added to that of each: the noise may leave bins empty


class FrequencyDomainFxLMS(BlockController):
    r"""FxLMS that adapts once per block of B samples, by Fourier transforms: cheap with many taps.

    With :math:`X'_p` the spectrum of the filtered reference that partition p of the control filter sees, and E that of
    the block's errors after zeros,

    .. math::

       W_p \leftarrow W_p + \mu\, C\big\{M\, C\{M^* X_p'^* E\}\big\},

       |M|^2 = \frac{1}{\Lambda},

       \Lambda = \sum_p |X'_p|^2

    C is the gradient constraint: in the time domain, the taps beyond the partition are set to zero. M is causal, the
    minimum-phase factor of the step. With it, all bins converge at about the same rate, whatever the colour of the
    noise, and the weights settle at the best causal filter; a step :math:`1/\Lambda` applied at once would also weight
    what no causal filter can cancel. Without M this is exactly the block LMS, :math:`w \leftarrow w + \mu \sum_n e(n)\,
    x'(n)`.

    Parameters
    ----------
    n_taps, secondary_path, n_references
        As for `FxLMS`.
    step_size : float
        Step size mu, above zero; below 1 unless `forgetting` is None.
    block_size : int
        Samples B of a block. The weights follow a change no sooner than at the end of a block.
    partition_size : int, optional
        Taps N of a partition, a multiple of B; by default B. With at least `n_taps`, there is one partition. The result
        of the block LMS does not depend on this size.
    constrained : bool, default True
        False leaves out C except in the first partition, where the delayless control signal needs it. This saves most
        of the transforms. But each partition then also has taps that repeat those of its neighbours (`weights` leaves
        them out) and vary within a block, so the secondary path must be much shorter than a block, and the weights
        settle only near the best filter.
    forgetting : float or None, default 0.9
        Forgetting factor, per block, of the powers :math:`\Lambda`. None gives the block LMS, without M.

    Attributes
    ----------
    n_partitions : int
        Number of partitions P.

    Raises
    ------
    ValueError
        A step size that is not positive and finite; sizes below 1; a partition size that is not a multiple of the block
        size; without the constraint, `n_taps` that is not a multiple of the partition size; a path that is all zeros
        or not FIR.

    Notes
    -----
    The control signal has no delay: what earlier samples contribute to it is computed when a block begins, and the
    block's own samples take B multiplications each. A block takes some ``4 P`` transforms of ``N + B`` samples with the
    constraint, and a fixed number without. If the secondary path is longer than a block, the step size must be smaller.
    For a limiter, wrap it in a `LimitedController`. References above 1e20 and errors above 1e100 are refused.

    References
    ----------
    J. J. Shynk, "Frequency-domain and multirate adaptive filtering", IEEE Signal Processing Magazine 9(1), 1992. F.
    Yang, Y. Cao, M. Wu, F. Albu, J. Yang, "Frequency-domain filtered-x LMS algorithms for active noise control: a
    review and new insights", Applied Sciences 8(11), 2018. The spectral factors of the step: S. J. Elliott, B. Rafaely,
    "Frequency-domain adaptation of causal digital filters", IEEE Trans. Signal Processing 48(5), 2000.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import FrequencyDomainFxLMS, noise_reduction_db, simulate
    >>> x = np.random.default_rng(0).standard_normal(16000)
    >>> controller = FrequencyDomainFxLMS(64, [0.0, 1.0], step_size=0.2, block_size=32)
    >>> result = simulate(controller, x, primary_path=[0.0, 0.0, 0.8, 0.4], secondary_path=[0.0, 1.0])
    >>> bool(noise_reduction_db(result.error, result.disturbance) > 60)
    True
    >>> controller.weights[:3].round(6)
    array([0. , 0.8, 0.4])
    """

    name = "frequency-domain FxLMS"

    def __init__(
        self,
        n_taps: int,
        secondary_path: PathModels,
        *,
        step_size: float,
        block_size: int,
        partition_size: int | None = None,
        constrained: bool = True,
        forgetting: float | None = 0.9,
        n_references: int | None = 1,
    ) -> None:
        self.step_size = as_positive(step_size, "step_size")
        self.forgetting = None if forgetting is None else as_forgetting(forgetting)
        self.constrained = as_choice(constrained, "constrained", (True, False))
        super().__init__(
            n_taps,
            secondary_path,
            block_size=block_size,
            partition_size=partition_size,
            n_references=n_references,
        )
        if not self.constrained and self.n_taps % self.partition_size:
            raise ValueError(
                f"n_taps must be a multiple of partition_size = {self.partition_size} without the constraint, "
                f"got {self.n_taps}"
            )
        self._powers, self._blocks = np.zeros(self._W.shape[-1]), 0  # of a partition's filtered references

    def _follow(self) -> None:
        self._blocks += 1
        self._powers = self._averaged(self._powers, np.sum(np.abs(self._X_filtered[..., 0, :]) ** 2, axis=(0, 1, 2)))

    def _averaged(self, mean: np.ndarray, newest: np.ndarray) -> np.ndarray:
        """Return a mean over blocks with the newest one."""
        share = max(1.0 - (self.forgetting or 0.0), 1.0 / self._blocks)
        return mean + share * (newest - mean)

    def _adapt(self) -> None:
        self._descend(self._gradient(), self._divisor(self._powers))

    def _divisor(self, powers: np.ndarray) -> np.ndarray:
        """Return Lambda by the powers that a partition sees in each bin, (..., bins)."""
        least = self._size * self._least_power()
        return self.n_partitions * (powers + RIDGE * np.mean(powers, axis=-1, keepdims=True) + least)

    def _gradient(self) -> np.ndarray:
        """Return X'* E, summed over microphones, (J, I, P, bins): minus half the gradient of the squared errors."""
        E = self._block_spectrum(self._errors)[:, None, None, None]
        return np.sum(self._X_filtered[..., :: self._every, :].conj() * E, axis=0)

    def _descend(self, gradient: np.ndarray, divisor: np.ndarray) -> None:
        """Take a step along a gradient (J, I, P, bins), divided in each bin."""
        if self.forgetting is not None:
            factor = minimum_phase(divisor**-0.5, self._size)
            gradient *= factor.conj()
            self._constrain(gradient)
            gradient *= factor
        self._constrain(gradient)
        self._W = self._W + self.step_size * gradient

    def _constrain(self, gradient: np.ndarray) -> None:
        """Set the taps beyond the partitions to zero."""
        chosen = gradient if self.constrained else gradient[:, :, :1]
        taps = self._partitions(chosen)
        if self.constrained:
            taps[:, :, -1, self.n_taps - (self.n_partitions - 1) * self.partition_size :] = 0.0
        chosen[:] = self._spectra(taps)


def minimum_phase(magnitude: np.ndarray, size: int) -> np.ndarray:
    """Return the spectrum (..., bins) of the causal filter with this magnitude and the least delay, by its cepstrum.

    `size` is that of the transform.
    """
    cepstrum = irfft(np.log(magnitude), size)
    cepstrum[..., 1 : (size + 1) // 2] *= 2.0
    cepstrum[..., size // 2 + 1 :] = 0.0
    return np.exp(rfft(cepstrum))
