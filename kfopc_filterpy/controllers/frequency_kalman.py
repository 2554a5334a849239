"""Frequency-domain Kalman filter: KF-ANC with a covariance for each bin of each partition."""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft, rfft

from .._types import PathModel
from .._validate import as_positive
from .base import as_forgetting
from .block import TINY
from .frequency_domain import FrequencyDomainFxLMS


class FrequencyDomainKalman(FrequencyDomainFxLMS):
    r"""Partitioned-block frequency-domain Kalman filter: frequency-domain FxLMS with the Kalman gain as its step.

    The spectra :math:`W_p` of the control filter's partitions are the state. Their errors are assumed to be
    independent, with a variance :math:`P_p` in each bin, and to grow from block to block. With :math:`X'_p` the spectra
    of the filtered reference, E that of :math:`\hat d - w^T x'` in the block, its mean power :math:`\Psi`, and :math:`b
    = B/(N+B)`,

    .. math::

       P_p \leftarrow A^2 P_p + (1 - A^2) |W_p|^2,

       \mu_p = \frac{P_p}{b \sum_p |X'_p|^2 P_p + \Psi}

    .. math::

       W_p \leftarrow W_p + C\big\{M_p\, C\{M_p^* X_p'^* E\}\big\},

       |M_p|^2 = \mu_p,

       P_p \leftarrow (1 - b\, \mu_p |X'_p|^2)\, P_p

    Parameters
    ----------
    n_taps, block_size, partition_size, constrained
        As for `FrequencyDomainFxLMS`.
    secondary_path : array_like, shape (taps,), or control system
        Estimated secondary path of one channel.
    transition : float, default 0.9999
        Factor A by which the control filter is expected to persist over a block, at most 1.
    initial_variance : float, default 1
        Variance P at the start, about the largest :math:`|W|^2` that is expected.
    forgetting : float, default 0.9
        Forgetting factor, per block, of the power of E.

    Raises
    ------
    ValueError
        As for `FrequencyDomainFxLMS`; a path of several channels; a factor that is not positive or is above 1.

    Notes
    -----
    It needs no step size. For the rest, see the notes of `FrequencyDomainFxLMS`.

    References
    ----------
    G. Enzner, P. Vary, "Frequency-domain adaptive Kalman filter for acoustic echo control in hands-free telephones",
    Signal Processing 86(6), 2006. F. Kuech, E. Mabande, G. Enzner, "State-space architecture of the
    partitioned-block-based acoustic echo controller", ICASSP 2014. Both apply the gain in one step; for its factors M, see
    `FrequencyDomainFxLMS`.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import FrequencyDomainKalman, noise_reduction_db, simulate
    >>> x = np.random.default_rng(0).standard_normal(16000)
    >>> controller = FrequencyDomainKalman(64, [0.0, 1.0], block_size=32)
    >>> result = simulate(controller, x, primary_path=[0.0, 0.0, 0.8, 0.4], secondary_path=[0.0, 1.0])
    >>> bool(noise_reduction_db(result.error, result.disturbance) > 30)
    True
    """

    name = "frequency-domain Kalman filter"

    def __init__(
        self,
        n_taps: int,
        secondary_path: PathModel,
        *,
        block_size: int,
        partition_size: int | None = None,
        transition: float = 0.9999,
        initial_variance: float = 1.0,
        forgetting: float = 0.9,
        constrained: bool = True,
    ) -> None:
        super().__init__(
            n_taps,
            secondary_path,
            step_size=1.0,
            block_size=block_size,
            partition_size=partition_size,
            constrained=constrained,
            forgetting=as_positive(forgetting, "forgetting"),
            n_references=None,
        )
        self.transition = as_forgetting(transition, "transition")
        self._P = np.full(self._W.shape[2:], as_positive(initial_variance, "initial_variance"))
        self._noise = np.zeros(self._W.shape[-1])

    def _adapt(self) -> None:
        W, P, X = self._W[0, 0], self._P, self._X_filtered[0, 0, 0, :: self._every]
        anti_noise = irfft(rfft(self._emitted) * self._S[0, 0], self._window)[:, -self.block_size :]
        error = self._errors + anti_noise - self._block_of(np.sum(W * X, axis=0))
        E = self._block_spectrum(np.where(self._taken, error, 0.0))
        if not E.any():  # no sound has arrived yet: a noise of zero would make P zero for good
            return
        self._noise = self._averaged(self._noise, np.abs(E[0]) ** 2)
        P *= self.transition**2
        P += (1.0 - self.transition**2) * np.abs(W) ** 2
        share, powers = self.block_size / self._size, np.abs(X) ** 2
        step = P / (share * np.sum(powers * P, axis=0) + self._noise + TINY)
        self._descend((X.conj() * E)[None, None], 1.0 / step)
        P *= 1.0 - share * step * powers
