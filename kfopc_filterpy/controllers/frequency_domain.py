"""FxLMS in the frequency domain, by overlap-save: the controller that adapts once per block, in numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import irfft, next_fast_len, rfft

from .._types import NumberOrArray
from .._validate import as_count, as_positive
from ..checkpoint import Checkpointed
from ..core.block import LOUDEST, LOUDEST_LEARNT
from ..plant import Secondary
from .base import as_forgetting, calls_of, require_rates
from .channel_samples import require_moderate
from .channels import Channels
from .making import controller_maker
from .processing import BlockProcessing, block_signals, checked_block

RIDGE = 0.01  # of the mean power of all bins, added to that of each: the noise may leave bins empty
SPREAD = 0.5  # a tenth is too little for tones in the middle of a bin; the edges of a band converge slower with more
QUIET = 1e-3  # of the usual power: below it, the weights would follow the noise of the microphones
HELD = 1000.0  # filter lengths in which the usual power, that of what was learned from, changes by a factor of e
RISE, YOUNG = 4.0, 2.0  # for the first YOUNG of them it may rise by e^RISE in each: a bad sample is not usual
UNHEARD = 100.0  # times the usual amplitude: a past that is so soft teaches little but the noise of the microphones
MOST_WEIGHT = 1e80  # a step that leads beyond it is left out; the error of such weights is below LOUDEST: they adapt on
ROUNDING = 1e-12  # -120 dB; rounding errors are at -300 dB
TINY = float(np.finfo(float).tiny)


class FrequencyDomainController(Channels, BlockProcessing, Checkpointed):
    """Frequency-domain FxLMS: a controller that keeps its control filter for a block; see `frequency_domain_fx_lms`."""

    name = "frequency-domain FxLMS"

    def __init__(
        self,
        n_taps: int,
        secondary: Secondary,
        *,
        step_size: float,
        block_size: int,
        partition_size: int | None,
        forgetting: float | None,
        n_references: int,
    ) -> None:
        self.step_size = as_positive(step_size, "step_size")
        self.forgetting = None if forgetting is None else as_forgetting(forgetting)
        self.n_taps = as_count(n_taps, "n_taps")
        path = self._read_paths(secondary, n_references)
        B = self.block_size = as_count(block_size, "block_size")
        N = self.partition_size = B if partition_size is None else as_count(partition_size, "partition_size")
        if N % B:
            raise ValueError(
                f"partition_size must be a multiple of block_size = {B}, got {N}: spectra of earlier blocks are used again"
            )
        K, J, I = self.n_microphones, self.n_loudspeakers, self.n_references  # noqa: E741
        P = self.n_partitions = -(-self.n_taps // N)
        self._every = N // B  # blocks between the spectra of neighbouring partitions
        self._size = N + B  # of the transforms
        spectra, bins = (P - 1) * self._every + 1, self._size // 2 + 1
        self._take_path(path)
        self._references = np.zeros((I, (P - 1) * N + self._window))  # forward in time, up to the end of the last block
        self._now = np.zeros((I, 2 * B - 1))  # the references of this block, after zeros
        self._errors, self._taken = np.zeros((K, B)), np.zeros(B, dtype=bool)  # of this block, and which were taken
        self._n = 0  # samples of this block
        # Spectra, the newest block first.
        self._X = np.zeros((I, spectra, bins), dtype=complex)
        self._X_filtered = np.zeros((K, J, I, spectra, bins), dtype=complex)
        self._W = np.zeros((J, I, P, bins), dtype=complex)
        self._earlier = np.zeros((J, B))  # what the samples before this block contribute to its control signals
        self._first_taps = np.zeros((J, I, B))  # the last of them first
        # Mean squares: of a partition's filtered references by bins; of the references, those of usual blocks.
        self._powers, self._usual, self._blocks = np.zeros(bins), np.zeros(I), 0
        self._age = 0  # blocks since the weights began

    # The secondary path.

    def _take_path(self, path: np.ndarray) -> None:
        self._path = path
        self._window = next_fast_len(self._size + path.shape[-1] - 1, real=True)
        paths = path[:, :, np.newaxis]
        self._S = rfft(paths, self._window)
        # The gain in each bin, summed over all paths: bins are samples of a spectrum, so a longer path is folded.
        folded = np.pad(paths, [(0, 0)] * 3 + [(0, -path.shape[-1] % self._size)])
        folded = folded.reshape(*folded.shape[:3], -1, self._size).sum(axis=3)
        self._path_gain = np.sum(np.abs(rfft(folded)) ** 2, axis=(0, 1, 2))

    @property
    def secondary(self) -> np.ndarray:
        """Estimated secondary path s^, (n_path,), or with several channels (K, J, n_path); a copy.

        A new estimate can be assigned between two samples: taps or an FIR system, with several channels as many paths
        as before, and no longer than the present estimate. The stored references are filtered again with it; the
        weights stay.
        """
        return (self._path if self.multichannel else self._path[0, 0]).copy()

    @secondary.setter
    def secondary(self, path: Secondary) -> None:
        self._take_path(self._checked_estimate(path, self._path.shape))
        for back in range(self._X_filtered.shape[-2]):
            self._X_filtered[..., back, :] = self._filtered_spectrum(back)

    def _filtered_spectrum(self, back: int = 0) -> np.ndarray:
        """Return the spectrum of the filtered references at the end of the block `back` blocks ago, (K, J, I, bins)."""
        end = self._references.shape[1] - back * self.block_size
        x = rfft(self._references[:, end - self._window : end])
        return rfft(self._newest(irfft(x * self._S, self._window)))

    def _newest(self, signal: np.ndarray) -> np.ndarray:
        """Return the newest N + B samples."""
        return signal[..., -self._size :]

    # The control filter.

    @property
    def weights(self) -> np.ndarray:
        """Control filter w, (L,), or with several channels (J, I, L), newest-sample tap first; a copy."""
        w = self._partitions(self._W).reshape(self.n_loudspeakers, self.n_references, -1)[..., : self.n_taps]
        return w if self.multichannel else w[0, 0]

    def _partitions(self, spectra: np.ndarray) -> np.ndarray:
        """Return the taps of partitions, (..., N); the taps beyond N of their transforms are left out."""
        return irfft(spectra, self._size)[..., : self.partition_size]

    def _begin_block(self) -> None:
        """Compute what a block needs; its own samples are zero as yet."""
        heard = np.pad(self._references[:, -self.partition_size :], [(0, 0), (0, self.block_size)])
        X = np.concatenate((rfft(heard)[:, None], self._X[:, self._every - 1 :: self._every]), axis=1)
        filtered = irfft(np.sum(self._W * X[:, : self.n_partitions], axis=(1, 2)), self._size)
        self._earlier = filtered[:, self.partition_size :]  # what overlap-save keeps
        self._first_taps = np.ascontiguousarray(self._partitions(self._W[:, :, 0])[..., self.block_size - 1 :: -1])

    def _end_block(self) -> None:
        self._references = np.concatenate(
            (self._references[:, self.block_size :], self._now[:, self.block_size - 1 :]), axis=1
        )
        for spectra, newest in (
            (self._X, rfft(self._newest(self._references))),
            (self._X_filtered, self._filtered_spectrum()),
        ):
            spectra[..., 1:, :] = spectra[..., :-1, :]
            spectra[..., 0, :] = newest
        self._follow()
        if self._taken.any():
            self._adapt()
        self._errors[:], self._taken[:], self._n = 0.0, False, 0
        self._begin_block()

    # The step.

    def _follow(self) -> None:
        """Follow the powers of a block, also if no error was taken."""
        self._blocks += 1
        share = max(1.0 - (self.forgetting or 0.0), 1.0 / self._blocks)
        self._powers += share * (np.sum(np.abs(self._X_filtered[..., 0, :]) ** 2, axis=(0, 1, 2)) - self._powers)
        self._powers[self._powers < TINY] = 0.0  # denormal numbers are slow
        heard, lengths = self._heard(), self.block_size / self.n_taps
        self._age = self._age + 1 if self._W.any() else 0
        rise = RISE * lengths if self._age * lengths < YOUNG else lengths / HELD
        least, most = np.exp(-lengths / HELD) * self._usual, np.exp(rise) * self._usual
        usual = np.where(self._usual > 0.0, np.clip(heard, least, most), heard)
        self._usual = np.where(heard > 0.0, usual, self._usual)  # nothing is learned in silence

    def _heard(self) -> np.ndarray:
        """Return the mean squares of the newest references, (I,)."""
        return np.asarray(np.mean(self._newest(self._references) ** 2, axis=1))

    def _divisor(self) -> np.ndarray:
        """Return Lambda, (bins,)."""
        # A mean lags behind. The newest references will have this power behind the path, whose delay they still have
        # ahead.
        soon = self._path_gain * np.sum(np.abs(self._X[:, 0]) ** 2, axis=0)
        powers = np.maximum(self._powers, 0.5 * soon)
        # In the time domain, spreading powers over the bins by SPREAD / (2 pi^2 j^2) is a window of their correlation.
        lags = np.arange(self._size) / self._size
        spread = rfft(irfft(powers, self._size) * (1.0 - SPREAD * lags * (1.0 - lags))).real
        heard, mean = self._heard().sum(), float(np.mean(powers))
        least = QUIET * self._usual.sum() / heard * float(np.mean(soon)) if heard > 0.0 else 0.0
        raised = max(least / mean, 1.0) if mean > 0.0 else 1.0
        # Far below the power of the filtered references, but above that of their rounding errors.
        rounding = ROUNDING * self._size * float(np.sum(self._path**2)) * heard / self.n_references + TINY
        return self.n_partitions * (raised * (spread + RIDGE * mean) + rounding)

    def _adapt(self) -> None:
        """Take a step, after a block in which at least one error was taken."""
        E = rfft(np.pad(self._errors, [(0, 0), (self.partition_size, 0)]))[:, None, None, None]
        # X'* E, summed over microphones, (J, I, P, bins): minus half the gradient of the squared errors.
        step = np.sum(self._X_filtered[..., :: self._every, :].conj() * E, axis=0)
        if self.forgetting is not None:
            factor = minimum_phase(self._divisor() ** -0.5, self._size)
            step *= factor.conj()
            self._constrain(step)
            step *= factor
        self._constrain(step)
        W = self._W + self.step_size * step
        if np.abs(W.view(float)).max() <= MOST_WEIGHT:  # NaN is not
            self._W = W

    def _constrain(self, step: np.ndarray) -> None:
        """Set the taps beyond the partitions to zero."""
        taps = self._partitions(step)
        taps[:, :, -1, self.n_taps - (self.n_partitions - 1) * self.partition_size :] = 0.0
        step[:] = rfft(taps, self._size)

    # Samples.

    @property
    def samples_left(self) -> int:
        """Samples until the present block ends, or the next one if it has just ended."""
        return self.block_size - self._n % self.block_size

    def emit(self, x: np.ndarray, limit: np.ndarray | None = None) -> np.ndarray:
        """Return the control signals (J, n) for references x (I, n) of at most `samples_left` samples.

        They end before a sample at which the weights begin anew, and before the first one that is not within a `limit`
        (J, 1), but have at least one sample.
        """
        require_moderate(x, "reference")
        if self._n == self.block_size:  # the error of its last sample was not taken
            self._end_block()
        unheard = np.any(np.abs(x) > UNHEARD * np.sqrt(self._usual)[:, None], axis=0)
        if unheard.any() and self.forgetting is not None and self._W.any():
            if unheard[0]:
                self._W[:] = 0.0
                self._begin_block()
            else:
                x = x[:, : np.argmax(unheard)]
        begin, end = self._n, self._n + x.shape[1]
        self._now[:, self.block_size - 1 + begin : self.block_size - 1 + end] = x
        y = self._earlier[:, begin:end].copy()
        for j, filters in enumerate(self._first_taps):
            for i, taps in enumerate(filters):
                y[j] += np.correlate(self._now[i, begin : end + self.block_size - 1], taps, "valid")
        if limit is not None:
            within = np.all(np.abs(y) <= limit, axis=0)
            end = end if within.all() else begin + max(int(np.argmin(within)), 1)
            y = y[:, : end - begin]
        self._n = end
        return y

    def take(self, errors: np.ndarray, taken: ArrayLike = True) -> None:
        """Take the errors (K, n) that the last n control signals left.

        `taken`, (n,), says which of them to adapt to.
        """
        require_moderate(errors, "error", LOUDEST)
        here = slice(self._n - errors.shape[1], self._n)
        self._taken[here] = taken
        self._errors[:, here] = np.where(self._taken[here], errors, 0.0)
        if self._n == self.block_size and self._taken[-1]:
            self._end_block()

    def control_signal(self, reference: NumberOrArray) -> NumberOrArray:
        """Return the control signal y(n) for the newest reference sample x(n), from the weights of the last block.

        With several channels, x(n) is (I,) and y(n) is (J,).
        """
        x = self._sample(reference, "reference", "references")
        y = self.emit(np.reshape(x, (-1, 1)))[:, 0]
        return y if self.multichannel else float(y[0])

    def update(self, error: NumberOrArray) -> None:
        """Take the error e(n), with several channels (K,), that the last control signal left; adapt after B samples."""
        e = self._sample(error, "error", "microphones")
        if self._n == 0:
            raise ValueError("update must follow the control_signal of its sample, but a new block has just begun")
        self.take(np.reshape(e, (-1, 1)))

    def process(
        self,
        references: ArrayLike | None,
        errors: ArrayLike,
        *,
        adapt: bool | ArrayLike = True,
        out: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the control signals for a block of samples, and adapt to its errors; see `BlockProcessing.process`."""
        x, e, flags, y = checked_block(self, references, errors, adapt, out)
        loud = np.abs(x).max() > LOUDEST_LEARNT or np.abs(e).max() > LOUDEST
        if loud or not runs_in_blocks(self):
            return super().process(x, e, adapt=flags, out=y)  # up to the sample that is refused
        begin, (x_rows, e_rows, y_rows) = 0, (np.atleast_2d(signal) for signal in (x, e, y))
        while begin < flags.size:
            part = self.emit(x_rows[:, begin : begin + self.samples_left])
            end = begin + part.shape[1]
            y_rows[:, begin:end] = part
            self.take(e_rows[:, begin:end], flags[begin:end])
            begin = end
        return y

    def listen(self, references: np.ndarray, errors: np.ndarray) -> None:
        """Follow the noise before the control is switched on, while the loudspeakers are silent; the weights stay.

        Parameters
        ----------
        references : ndarray, shape (n_samples,) or (I, n_samples)
            References.
        errors : ndarray, shape (n_samples,) or (K, n_samples)
            Signals of the error microphones.
        """
        require_moderate(block_signals(self, references, errors)[0], "reference")
        self.process(references, errors, adapt=False)

    def require_sample_rate(self, fs: float) -> None:
        """Raise ValueError if the secondary path is for another sample rate than `fs` in Hz."""
        require_rates(fs, {"secondary path": self._path_fs})

    def __repr__(self) -> str:
        parts = f"{self.n_partitions} partition{'s' if self.n_partitions > 1 else ''} of {self.partition_size}"
        return f"<{self.name}: {self.n_taps} taps in {parts}, blocks of {self.block_size} samples>"


@controller_maker
def frequency_domain_fx_lms(
    n_taps: int,
    secondary: Secondary,
    *,
    step_size: float,
    block_size: int,
    partition_size: int | None = None,
    forgetting: float | None = 0.9,
    n_references: int = 1,
) -> FrequencyDomainController:
    r"""Return FxLMS that adapts once per block of B samples, by Fourier transforms: cheap with many taps.

    The control filter is kept as spectra of P partitions with N taps each, and blocks are filtered by overlap-save with
    transforms of N + B samples. The control signal has no delay: what the samples before the block contribute to it is
    computed when the block begins, and what the block's own samples contribute takes B multiplications per sample,

    .. math:: y(n_0 + i) = \Big(\sum_{l=0}^{i} + \sum_{l>i}\Big) w_l\, x(n_0 + i - l)

    With :math:`X'_p` the spectrum of the filtered reference that partition p of the control filter sees, and E that of
    the block's errors after zeros,

    .. math::

       W_p \leftarrow W_p + \mu\, C\big\{M\, C\{M^* X_p'^* E\}\big\},

       |M|^2 = \frac{1}{\Lambda}

    C is the gradient constraint: in the time domain, the taps beyond the partition are set to zero. M is causal, the
    minimum-phase factor of the step. With it, all bins converge at about the same rate, whatever the colour of the
    noise, and the weights settle at the best causal filter; a step :math:`1/\Lambda` applied at once would also weight
    what no causal filter can cancel. Without M this is exactly the block LMS, :math:`w \leftarrow w + \mu \sum_n e(n)\,
    x'(n)`.

    :math:`\Lambda` is the power of the filtered reference as the N taps of a partition see it. Their spectra are
    coarser than the transform's: a tone in the middle of a bin has no power in the next one, but a filter that cancels
    it has. So the mean power :math:`\overline{|X'|^2}` of a bin is spread over the others,

    .. math::

       \Lambda_k = P g \Big(\frac{11}{12}\, \overline{|X'_k|^2} +
       \sum_{j \ne 0} \frac{\overline{|X'_{k-j}|^2}}{4 \pi^2 j^2} + \text{ridge}\Big)

    The factor g is 1 in steady noise. It raises a mean that lags behind: to the power that the newest references will
    have behind the secondary path, and in a quiet passage to a thousandth of the usual power.

    Parameters
    ----------
    n_taps, secondary, n_references
        As for `fx_lms`.
    step_size : float
        Step size mu, above zero; below 1 unless `forgetting` is None.
    block_size : int
        Samples B of a block. The weights follow a change no sooner than at the end of a block.
    partition_size : int, optional
        Taps N of a partition, a multiple of B; by default B. With at least `n_taps`, there is one partition. The result
        of the block LMS does not depend on this size.
    forgetting : float or None, default 0.9
        Forgetting factor, per block, of the mean powers. None gives the block LMS, without M.

    Returns
    -------
    Controller
        A controller named frequency-domain FxLMS; it tells its number of partitions P as `n_partitions`.

    Raises
    ------
    ValueError
        A step size that is not positive and finite; sizes below 1; a partition size that is not a multiple of the block
        size; a path that is all zeros or not FIR.

    Notes
    -----
    A block takes some ``4 P`` transforms of ``N + B`` samples. If the
    secondary path is longer than a block, the step size must be smaller. For a limiter, wrap it in a
    `LimitedController`. References above 1e20 and errors above 1e100 are refused.

    A reference sample that is more than 40 dB above the usual level sets the weights to zero, unless `forgetting` is
    None: the noise has just begun. What was learned in the near silence before it was the noise of the microphones, and
    the control signal would now be louder than this noise by as much.

    References
    ----------
    J. J. Shynk, "Frequency-domain and multirate adaptive filtering", IEEE Signal Processing Magazine 9(1), 1992. F.
    Yang, Y. Cao, M. Wu, F. Albu, J. Yang, "Frequency-domain filtered-x LMS algorithms for active noise control: a
    review and new insights", Applied Sciences 8(11), 2018. The spectral factors of the step: S. J. Elliott, B. Rafaely,
    "Frequency-domain adaptation of causal digital filters", IEEE Trans. Signal Processing 48(5), 2000.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import Plant, frequency_domain_fx_lms, simulate
    >>> plant = Plant([0.0, 1.0], [0.0, 0.0, 0.8, 0.4], fs=16000)
    >>> controller = frequency_domain_fx_lms(64, plant, step_size=0.2, block_size=32)
    >>> simulate(controller, np.random.default_rng(0).standard_normal(16000), plant).noise_reduction_db > 60
    True
    >>> controller.weights[:3].round(6)
    array([0. , 0.8, 0.4])
    """
    return FrequencyDomainController(
        n_taps,
        secondary,
        step_size=step_size,
        block_size=block_size,
        partition_size=partition_size,
        forgetting=forgetting,
        n_references=n_references,
    )


def runs_in_blocks(controller: object) -> bool:
    """Return whether a controller keeps its control filter for a block, and no subclass changes what a sample does."""
    kind = type(controller)
    return isinstance(controller, FrequencyDomainController) and calls_of(kind) == calls_of(FrequencyDomainController)


def minimum_phase(magnitude: np.ndarray, size: int) -> np.ndarray:
    """Return the spectrum (..., bins) of the causal filter with this magnitude and the least delay, by its cepstrum.

    `size` is that of the transform.
    """
    cepstrum = irfft(np.log(magnitude), size)
    cepstrum[..., 1 : (size + 1) // 2] *= 2.0
    cepstrum[..., size // 2 + 1 :] = 0.0
    return np.exp(rfft(cepstrum))
