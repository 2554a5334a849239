"""The base class of the controllers that adapt once per block, in numpy: signals, spectra, delayless output."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import irfft, next_fast_len, rfft

from .._types import NumberOrArray, PathModels
from .._validate import as_count
from ..checkpoint import Checkpointed
from ..core.block import LOUDEST, LOUDEST_LEARNT
from .base import calls_of, require_rates
from .channel_samples import require_moderate
from .channels import Channels
from .processing import BlockProcessing, checked_block

MOST_WEIGHT = 1e80  # a step that leads beyond it is left out; the error of such weights is below LOUDEST: they adapt on
ROUNDING = 1e-12  # -120 dB; rounding errors are at -300 dB
TINY = float(np.finfo(float).tiny)


class BlockController(Channels, BlockProcessing, Checkpointed):
    r"""Base class of the block controllers: they keep the control filter for B samples, then `_adapt` changes it.

    The control filter is kept as spectra of P partitions with N taps each. A block of B samples is filtered by
    overlap-save with transforms of N + B samples. The control signal has no delay: what the samples before the block
    contribute to it is computed when the block begins, and what the block's own samples contribute takes B
    multiplications per sample,

    .. math:: y(n_0 + i) = \sum_{l=0}^{i} w_l\, x(n_0 + i - l) + \sum_{l>i} w_l\, x(n_0 + i - l)

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter, or of each control filter.
    secondary_path : array_like, shape (taps,) or (K, J, taps), or control system
        Estimated secondary path, as for `FxLMS`.
    block_size : int
        Samples B of a block.
    partition_size : int
        Taps N of a partition, a multiple of B.
    n_references : int
        Number of references I.
    """

    name = "block controller"

    def __init__(
        self,
        n_taps: int,
        secondary_path: PathModels,
        *,
        block_size: int,
        partition_size: int | None,
        n_references: int | None,
    ) -> None:
        self.n_taps = as_count(n_taps, "n_taps")
        path = self._read_paths(secondary_path, n_references, None)
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
        # Signals run forward in time, up to the end of the last block.
        self._references = np.zeros((I, (P - 1) * N + self._window))
        self._emitted = np.zeros((J, self._window))
        self._now = np.zeros((I, 2 * B - 1))  # the references of this block, after zeros
        self._played, self._errors = np.zeros((J, B)), np.zeros((K, B))  # control signals and errors of this block
        self._n, self._taken = 0, np.zeros(B, dtype=bool)  # samples of this block; whose errors were taken
        # Spectra, the newest block first.
        self._X = np.zeros((I, spectra, bins), dtype=complex)
        self._X_filtered = np.zeros((K, J, I, spectra, bins), dtype=complex)
        self._W = np.zeros((J, I, P, bins), dtype=complex)
        self._earlier = np.zeros((J, B))  # what the samples before this block contribute to its control signals
        self._first_taps = np.zeros((J, I, B))  # the last of them first

    # The secondary path.

    def _take_path(self, path: np.ndarray) -> None:
        self._path = path
        self._window = next_fast_len(self._size + path.shape[-1] - 1, real=True)
        paths = path.reshape(self.n_microphones, self.n_loudspeakers, 1, -1)
        self._S = rfft(paths, self._window)

    @property
    def secondary_path(self) -> np.ndarray:
        """Estimated secondary path s^, (n_path,), or with several channels (K, J, n_path); a copy.

        A new estimate can be assigned between two samples: taps or an FIR system, with several channels as many paths
        as before, and no longer than the present estimate. The stored references are filtered again with it; the
        weights stay.
        """
        return self._path.copy()

    @secondary_path.setter
    def secondary_path(self, path: PathModels) -> None:
        self._take_path(self._checked_estimate(path, self._path.shape))
        for back in range(self._X_filtered.shape[-2]):
            self._X_filtered[..., back, :] = self._filtered_spectrum(back)

    def _filtered_spectrum(self, back: int = 0) -> np.ndarray:
        """Return the spectrum of the filtered references at the end of the block `back` blocks ago, (K, J, I, bins)."""
        end = self._references.shape[1] - back * self.block_size
        x = rfft(self._references[:, end - self._window : end])
        return rfft(self._newest(irfft(x * self._S, self._window)))

    def _least_power(self) -> float:
        """Return a power far below that of the filtered references, but above that of their rounding errors."""
        return ROUNDING * float(np.sum(self._path**2) * np.mean(self._newest(self._references) ** 2)) + TINY

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

    def _spectra(self, partitions: np.ndarray) -> np.ndarray:
        """Return the spectra of partitions (..., N)."""
        return rfft(partitions, self._size)

    def _block_spectrum(self, block: np.ndarray) -> np.ndarray:
        """Return the spectra of blocks (..., B) with zeros in place of the samples before them."""
        return rfft(np.concatenate((np.zeros((*block.shape[:-1], self.partition_size)), block), axis=-1))

    def _block_of(self, spectra: np.ndarray) -> np.ndarray:
        """Return what overlap-save keeps of filtered spectra, the last B samples, (..., B)."""
        return irfft(spectra, self._size)[..., self.partition_size :]

    def _adapt(self) -> None:
        """Replace the control filter's spectra after a block in which at least one error was taken."""
        raise NotImplementedError

    def _follow(self) -> None:
        """Follow the filtered references of a block, also if no error was taken."""

    def _end_block(self) -> None:
        B, N = self.block_size, self.partition_size
        self._references = np.concatenate((self._references[:, B:], self._now[:, B - 1 :]), axis=1)
        self._emitted = np.concatenate((self._emitted, self._played), axis=1)[:, -self._window :]
        for spectra, newest in (
            (self._X, rfft(self._newest(self._references))),
            (self._X_filtered, self._filtered_spectrum()),
        ):
            spectra[..., 1:, :] = spectra[..., :-1, :]
            spectra[..., 0, :] = newest
        self._follow()
        before = self._W
        if self._taken.any():
            self._adapt()
        if not np.abs(self._W.view(float)).max() <= MOST_WEIGHT:  # NaN is not
            self._W = before
        self._errors[:], self._taken[:], self._n = 0.0, False, 0
        # The next block: its own samples are zero as yet.
        heard = np.concatenate((self._references[:, -N:], np.zeros((self.n_references, B))), axis=1)
        X = np.concatenate((rfft(heard)[:, None], self._X[:, self._every - 1 :: self._every]), axis=1)
        self._earlier = self._block_of(np.sum(self._W * X[:, : self.n_partitions], axis=(1, 2)))
        self._first_taps = np.ascontiguousarray(self._partitions(self._W[:, :, 0])[..., B - 1 :: -1])

    # Samples.

    @property
    def samples_left(self) -> int:
        """Samples until the present block ends, or the next one if it has just ended."""
        return self.block_size - self._n % self.block_size

    def emit(self, x: np.ndarray, limit: np.ndarray | None = None) -> np.ndarray:
        """Return the control signals (J, n) for references x (I, n) of at most `samples_left` samples.

        They end before the first sample that is not within a `limit` (J, 1), but have at least one sample.
        """
        require_moderate(x, "reference")
        if self._n == self.block_size:  # the error of its last sample was not taken
            self._end_block()
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
        self._played[:, begin:end] = y
        self._n = end
        return y

    def take(self, errors: np.ndarray, taken: ArrayLike = True) -> None:
        """Take the errors (K, n) that the last n control signals left; `taken`, (n,), says which of them to adapt to."""
        require_moderate(errors, "error", LOUDEST)
        here = slice(self._n - errors.shape[1], self._n)
        self._taken[here] = taken
        self._errors[:, here] = np.where(self._taken[here], errors, 0.0)
        if self._n == self.block_size and self._taken[-1]:
            self._end_block()

    def emitted(self, control_signal: float) -> None:
        """Take `control_signal`, to which a limiter changed the last one; `LimitedController` calls this."""
        self._played[:, self._n - 1] = control_signal

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
        begin, signals = 0, [np.atleast_2d(signal) for signal in (x, e, y)]
        while begin < flags.size:
            part = slice(begin, begin + self.samples_left)
            references, errors, out_part = (signal[:, part] for signal in signals)
            out_part[:] = self.emit(references)
            self.take(errors, flags[part])
            begin = part.stop
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
        self.process(references, errors, adapt=False)
        self._played[:] = self._emitted[:] = 0.0

    def require_sample_rate(self, fs: float) -> None:
        """Raise ValueError if the secondary path is for another sample rate than `fs` in Hz."""
        require_rates(fs, {"secondary path": self._path_fs})

    def __repr__(self) -> str:
        parts = f"{self.n_partitions} partition{'s' if self.n_partitions > 1 else ''} of {self.partition_size}"
        return f"<{self.name}: {self.n_taps} taps in {parts}, blocks of {self.block_size} samples>"


def runs_in_blocks(controller: object) -> bool:
    """Return whether a controller keeps its control filter for a block, and no subclass changes what a sample does."""
    return isinstance(controller, BlockController) and calls_of(type(controller)) == calls_of(BlockController)
