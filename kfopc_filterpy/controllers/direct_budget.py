"""KF-PB for several channels in its direct form: all weights as one state, measured microphone by microphone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_nonnegative, per_channel, per_loudspeaker
from ..kernels.compiling import inlined
from ..kernels.covariance import Covariance, kalman_step, new_covariance, owed_of
from ..kernels.delay_lines import newest
from ..kernels.records import new_record
from ..kernels.vectors import copy_into
from ..paths.channels import secondary_paths
from ..paths.uncertainty import ONE_SAMPLE
from ..power.amplifiers import Amplifier
from ..power.budget import DEFAULT_AVERAGING_S
from ..power.constraint import DEFAULT_FS, ConstraintState
from ..power.limiter import OutputLimiter
from .blocks import DEFAULT_MEMORY_S, BlockController
from .channels import ChannelLines, add_squares, squares_of_sample
from .step import adapt, advance_powers, control_filter, follow


class DirectBudgetState(NamedTuple):
    """State of `DirectPowerBudget`."""

    lines: ChannelLines
    weights: np.ndarray  # (J, I, L), estimate of the unconstrained control filters
    constraint: tuple[ConstraintState, ...]  # computes the powers; its factors are fixed at 1
    gains: Covariance  # of all weights
    measurement_noise: np.ndarray  # (K,)
    row: np.ndarray  # (J I L,) filtered references of a microphone
    control_filter: np.ndarray  # (J, I, L)
    numbers: np.ndarray  # record: state_noise, waiting (samples since the last solution)


@adapt.register(DirectBudgetState)
def adapt_direct_budget(state, error, control_signal):
    """Apply eq. 2-8 to the measurement of each microphone; return False, with nothing changed, if the first fails."""
    lines = state.lines
    finite, d, x = squares_of_sample(lines, error)
    if not finite:
        return False
    w, taps, numbers = state.weights.reshape(-1), state.weights.shape[2], state.numbers[0]
    for k in range(lines.disturbance.size):
        h, r = observation(state.row, lines.filtered[k], taps), numbers.state_noise if k == 0 else 0.0
        y, _ = kalman_step(state.gains, w, h, lines.disturbance[k], r, state.measurement_noise[k], 1.0)
        if np.isnan(y) and k == 0:
            return False
    add_squares(lines, state.constraint, d, x)
    numbers.waiting += 1
    return True


@inlined
def observation(row, filtered, taps):
    """Set `row` to the newest filtered references of a microphone, (J, I, taps)."""
    n = 0
    for j in range(filtered.shape[0]):
        for i in range(filtered.shape[1]):
            copy_into(row[n : n + taps], newest(filtered[j, i], taps))
            n += taps
    return row


@follow.register(DirectBudgetState)
def follow_direct_budget(state, error):
    """Add the sample to the powers."""
    finite, _, _ = advance_powers(state.lines, state.constraint, error)
    if finite:
        state.numbers[0].waiting += 1
    return finite


@control_filter.register(DirectBudgetState)
def filter_of_direct_budget(state):
    """Return the control filters within the rated powers."""
    return state.control_filter


class DirectPowerBudget(BlockController):
    r"""KF-PB for several channels in its direct form: all control filters as one state, a power budget per loudspeaker.

    The Kalman filter of `DirectKalman`, without a constraint factor, estimates the optimal control filters w for
    unlimited power. Every 32 ms, the control filters v within the rated powers are computed from these and from the
    recent correlation of the references:

    .. math:: \Bigl(R_{x'} + \operatorname{blkdiag}_j(\lambda_j R_x)\Bigr) v = R_{x'} \hat w, \qquad
        \lambda_j \ge 0, \qquad \lambda_j (v_j^T R_x v_j - \rho_j) = 0

    Parameters
    ----------
    n_taps, secondary_path, state_noise, initial_variance, n_references, amplifier, limiter
        As for `DirectKalman`.
    measurement_noise : float or array_like, shape (K,)
        Measurement noise variance q of all microphones or of each, above zero. In the sum of the squared errors that
        is minimised, a microphone's weight is inversely proportional to its q.
    rated_power : float or array_like, shape (J,)
        Rated power of each loudspeaker.
    secondary_path_uncertainty : PathTolerance, float or array_like, optional
        Uncertainty of the secondary paths, see `paths.path_uncertainty`; by default a sample of delay. None: the
        paths are exact.
    memory_s : float, default 0.5
        Memory of the correlation of the references in seconds.
    averaging_s : float, default 10
        Time in seconds over which the mean powers are kept to the rated ones, at least 8 blocks; see `PowerBudget`.
    fs : float, default 16000
        Sample rate in Hz.

    Raises
    ------
    ValueError, TypeError
        A setting that is out of range, or whose shape does not fit the secondary paths.

    See Also
    --------
    kf_pb : Returns it with ``form="direct"``.

    Notes
    -----
    `weights` is the estimate of w, and `control_filter` is v; both are (J, I, L).

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.controllers import DirectPowerBudget
    >>> paths = np.zeros((2, 2, 8))
    >>> paths[:, :, 1] = [[1.0, 0.3], [0.2, 1.0]]
    >>> DirectPowerBudget(32, paths, rated_power=0.5, state_noise=1e-8, measurement_noise=0.01)
    <KF-PB: 2 microphones, 2 loudspeakers, 1 reference, 32 taps, rated power 0.5, 0.5>
    """

    name = "KF-PB"

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        rated_power: Any,
        state_noise: float,
        measurement_noise: Any,
        initial_variance: float = 1.0,
        n_references: int = 1,
        secondary_path_uncertainty: Any = ONE_SAMPLE,
        memory_s: float = DEFAULT_MEMORY_S,
        averaging_s: float = DEFAULT_AVERAGING_S,
        fs: float = DEFAULT_FS,
        amplifier: Amplifier | Sequence[Amplifier] | None = None,
        limiter: Sequence[OutputLimiter] | None = None,
    ) -> None:
        secondary, _ = secondary_paths(secondary_path)
        noise = per_channel(measurement_noise, len(secondary), "microphones", "measurement_noise")
        super().__init__(
            n_taps,
            secondary_path,
            rated_power=per_loudspeaker(rated_power, secondary.shape[1], "rated_power"),
            secondary_path_uncertainty=secondary_path_uncertainty,
            microphone_weights=noise.mean() / noise,  # as the Kalman filter weighs the errors
            n_primary=0,
            memory_s=memory_s,
            averaging_s=averaging_s,
            fs=fs,
            n_references=n_references,
            amplifier=amplifier,
            limiter=limiter,
        )
        lines, free, constraint = self._common()
        self._state = DirectBudgetState(
            lines,
            free,
            constraint,
            new_covariance(as_nonnegative(initial_variance, "initial_variance") * np.eye(free.size)),
            noise,
            np.zeros(free.size),
            np.zeros(free.shape),
            new_record(state_noise=as_nonnegative(state_noise, "state_noise"), waiting=0),
        )

    @property
    def control_filter(self) -> np.ndarray:
        """Control filters within the rated powers, which generate y, (J, I, L); a copy."""
        return self._state.control_filter.copy()

    def _after_new_path(self, before: np.ndarray) -> None:
        """Let P grow too, by the variance that the new paths give to the weights."""
        super()._after_new_path(before)
        owed_of(self._state.gains)["diagonal"] += self._variance_by_new_path(before)

    def _end_block(self, references: np.ndarray) -> None:
        """Find the control filters for the present estimate and correlation."""
        self._budget.solve_near(self._correlation.faded, self._state.weights)
        self._state.control_filter[...] = self._budget.weights
