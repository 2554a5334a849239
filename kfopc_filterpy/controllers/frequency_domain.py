"""KF-PB for paths of thousands of taps: the primary paths are estimated in the frequency domain, block by block.

The control signals are still computed sample by sample, by convolution with the control filters, so they have no delay.
Only the learning is done in blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import fft

from .._validate import as_count, as_positive
from ..kernels.partitioned_kalman import PartitionedKalman
from ..kernels.records import new_record
from ..paths.uncertainty import ONE_SAMPLE
from ..power.amplifiers import Amplifier
from ..power.budget import DEFAULT_AVERAGING_S
from ..power.constraint import DEFAULT_FS
from ..power.limiter import OutputLimiter
from .blocks import BLOCK_S, DEFAULT_MEMORY_S
from .channels import ChannelLines, sample_is_finite
from .primary_paths import DEFAULT_PATH_MEMORY_S, PrimaryPathController, read_paths
from .step import adapt, follow

PRIOR = 10.0  # energy of the references in the unknown paths, relative to the measurement noise
PARTITIONS = 2  # of a long primary path; with a fixed number, the work per sample grows with the logarithm of the taps
MEMORY_LENGTHS = 16  # the shortest default memory, in durations of what is estimated


class FrequencyDomainState(NamedTuple):
    """State of `FrequencyDomainKalman` that changes with every sample."""

    lines: ChannelLines
    weights: np.ndarray  # (J, I, L) control filters
    disturbances: np.ndarray  # (K, B) estimates of this block
    numbers: np.ndarray  # record: waiting (samples of this block), silent (how many of them were without control)


@adapt.register(FrequencyDomainState)
def adapt_frequency_domain(state, error, control_signal):
    """Store the disturbance estimates until the block has ended."""
    if not sample_is_finite(state.lines, error):
        return False
    numbers = state.numbers[0]
    for k in range(state.disturbances.shape[0]):
        state.disturbances[k, numbers.waiting] = state.lines.disturbance[k]
    numbers.waiting += 1
    return True


@follow.register(FrequencyDomainState)
def follow_frequency_domain(state, error):
    """Count the sample; its references are in the delay lines."""
    if not sample_is_finite(state.lines, error):
        return False
    numbers = state.numbers[0]
    numbers.waiting += 1
    numbers.silent += 1
    return True


class FrequencyDomainKalman(PrimaryPathController):
    """KF-PB for paths of thousands of taps: a Kalman filter estimates the primary paths in the frequency domain.

    It does what `SharedGainKalman` does, but its cost of learning per sample grows with log L instead of L^2. Learning
    takes place at the end of each block. The control signals do not wait for it: they are computed sample by sample, by
    convolution with the control filters (J I L multiplications per sample), and have no delay.

    Parameters
    ----------
    n_taps : int
        Taps L of each control filter.
    secondary_path : array_like, shape (K, J, n_path), or nested sequence of control systems
        Estimated secondary paths, loudspeaker j to microphone k.
    rated_power : float or array_like, shape (J,), optional
        Rated power of each loudspeaker; by default unlimited.
    n_references : int, default 1
        Number of references I.
    n_primary : int, optional
        Taps L_p of the estimated primary paths; by default ``n_taps`` plus the taps of the secondary paths.
    secondary_path_uncertainty : PathTolerance, float or array_like, optional
        Uncertainty of the secondary paths, see `paths.path_uncertainty`; by default a sample of delay. None: the
        paths are exact.
    path_memory_s : float, optional
        Time in seconds over which the primary paths are averaged; by default 1 s, or the duration of 16 primary paths
        if that is longer.
    memory_s : float, optional
        Memory of the correlation of the references in seconds; by default 0.5 s, or the duration of 16 control filters
        if that is longer.
    averaging_s : float, default 10
        Time in seconds over which the mean powers are kept to the rated ones, at least 8 blocks; see `PowerBudget`.
    fs : float, default 16000
        Sample rate in Hz.
    block : int, optional
        Samples B of a block, and taps of a partition; by default 32 ms, or half a primary path if that is longer,
        rounded up to a length that suits the FFT.
    microphone_weights : array_like, shape (K,), optional
        Weight of each microphone's squared error; 0 leaves a microphone out. By default 1.
    amplifier, limiter
        As for `FilteredReferenceController`.

    Raises
    ------
    ValueError, TypeError
        A setting that is out of range, or whose shape does not fit the secondary paths.

    See Also
    --------
    SharedGainKalman : The exact filter, for paths of some hundred taps.

    Notes
    -----
    The filter is based on the partitioned-block frequency-domain Kalman filter [1]_ [2]_. As there, the covariance of
    the paths is assumed to be diagonal over frequencies, partitions and references, and it is the same for all
    microphones. Unlike there, the covariance of the innovation is not assumed to be diagonal: for each microphone, a
    block is a system of B unknowns, solved by conjugate gradients. This matters for tones and band noise, whose
    frequencies are not independent of each other within a block. With 128 taps, the noise reduction in the steady half
    is at most 0.1 dB below that of `SharedGainKalman` for white noise, band noise, tones and a compressor
    (``tests/controllers/test_frequency_domain.py``).

    Errors and references of a block belong together: a block in which `update` refused an error, or was not called once
    for each reference, is not learned from.

    State noise and initial variance are those of `SharedGainKalman`, except that the initial variance has the factor 10
    instead of 1000: after too large a gain, a diagonal covariance averages out the measurement noise more slowly.

    The work of learning and solving comes as a burst at the end of each block. ``python -m comparisons speed`` prints
    the time per sample with everything included, and the time that the slowest block takes as a fraction of its
    duration.

    References
    ----------
    .. [1] G. Enzner and P. Vary, "Frequency-domain adaptive Kalman filter for acoustic echo control in hands-free
       telephones", Signal Processing 86(6), 2006.
    .. [2] F. Kuech, E. Mabande and G. Enzner, "State-space architecture of the partitioned-block-based acoustic echo
       controller", Proc. IEEE ICASSP, 2014.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.controllers import FrequencyDomainKalman
    >>> paths = np.zeros((2, 2, 512))
    >>> paths[:, :, 40] = [[1.0, 0.3], [0.2, 1.0]]
    >>> controller = FrequencyDomainKalman(2048, paths, rated_power=0.5)
    >>> controller
    <KF-PB (frequency domain): 2 microphones, 2 loudspeakers, 1 reference, 2048 taps, rated power 0.5, 0.5>
    >>> controller.block, controller.primary_path.shape
    (1280, (2, 1, 2560))
    """

    name = "KF-PB (frequency domain)"

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        rated_power: Any = None,
        n_references: int = 1,
        n_primary: int | None = None,
        secondary_path_uncertainty: Any = ONE_SAMPLE,
        path_memory_s: float | None = None,
        memory_s: float | None = None,
        averaging_s: float = DEFAULT_AVERAGING_S,
        fs: float = DEFAULT_FS,
        block: int | None = None,
        microphone_weights: Any = None,
        amplifier: Amplifier | Sequence[Amplifier] | None = None,
        limiter: Sequence[OutputLimiter] | None = None,
    ) -> None:
        secondary, n_taps, n_primary = read_paths(secondary_path, n_taps, n_primary)
        fs = as_positive(fs, "fs", unit="Hz")
        block = _block(n_primary, fs) if block is None else as_count(block, "block")
        paths = PartitionedKalman(len(secondary), as_count(n_references, "n_references"), n_primary, block)
        super().__init__(
            n_taps,
            secondary_path,
            rated_power=rated_power,
            n_references=n_references,
            n_primary=n_primary,
            secondary_path_uncertainty=secondary_path_uncertainty,
            path_memory_s=_memory_s(DEFAULT_PATH_MEMORY_S, n_primary / fs) if path_memory_s is None else path_memory_s,
            memory_s=_memory_s(DEFAULT_MEMORY_S, n_taps / fs) if memory_s is None else memory_s,
            averaging_s=averaging_s,
            fs=fs,
            block=block,
            history=paths.span,
            microphone_weights=microphone_weights,
            amplifier=amplifier,
            limiter=limiter,
        )
        self._last_references = np.zeros((self.n_references, block))
        self._paths = paths
        self._state = FrequencyDomainState(
            lines=self._lines,
            weights=np.zeros((self.n_loudspeakers, self.n_references, self.n_taps)),
            disturbances=np.zeros((self.n_microphones, self.block)),
            numbers=new_record(waiting=0, silent=0),
        )

    @property
    def primary_path(self) -> np.ndarray:
        """Estimated primary paths, (K, I, L_p); a copy."""
        return self._paths.paths

    def _end_block(self, references: np.ndarray) -> None:
        """Learn from the block, unless the control was off in a part of it, and solve for the control filters."""
        numbers, paths = self._state.numbers, self._paths
        learnable = numbers["silent"][0] == 0 and self._is_one_of_each(references)
        numbers["silent"], self._last_references = 0, references[:, -self.block :]
        paths.hear(references)
        power = self._reference_power()
        if not power > 0.0:
            return
        before, paths.state_noise = paths.state_noise, self._state_noise(paths.state_noise, power)
        if paths.state_noise != before:  # the first references, or much louder ones
            most = self._first_variance(PRIOR, power)
            paths.variance[...] = most if before == 0.0 else np.minimum(paths.variance, most)
        if learnable and not paths.learn(self._state.disturbances):
            raise ValueError(
                "nothing was learned from the last block: errors or references are too large to be squared"
            )
        self._solve()

    def _is_one_of_each(self, references: np.ndarray) -> bool:
        """Return whether the block had one reference for each error: otherwise the two do not belong together."""
        return np.array_equal(references[:, -2 * self.block : -self.block], self._last_references)


def _memory_s(shortest: float, duration_s: float) -> float:
    """Return the default memory for filters or paths of a duration; a shorter average would follow chance."""
    return max(shortest, MEMORY_LENGTHS * duration_s)


def _block(n_primary: int, fs: float) -> int:
    """Return the number of samples of a block, chosen so that its FFT is fast."""
    return fft.next_fast_len(max(round(BLOCK_S * fs), 1, -(-n_primary // PARTITIONS)), real=True)
