"""KF-ANC, KF-OPC and KF-PB for several channels in their direct form: the paper's equations, all weights as one state.

The state contains the control filters of all loudspeakers for all references, (J, I, L). The filtered references of a
microphone are its observation row. R is diagonal, so the K measurements of a sample can correct the state one after the
other, in O(K (J I L)^2) operations per sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_nonnegative, per_channel, per_loudspeaker
from ..filters.random_walk import as_precision
from ..kernels.compiling import inlined, part
from ..kernels.covariance import Covariance, covariance_matrix, kalman_step, new_covariance
from ..kernels.delay_lines import newest
from ..kernels.records import new_record
from ..kernels.vectors import copy_into
from ..paths.channels import secondary_paths
from ..paths.uncertainty import ONE_SAMPLE
from ..power.amplifiers import Amplifier
from ..power.budget import DEFAULT_AVERAGING_S
from ..power.constraint import DEFAULT_FS, ConstraintState, OutputPowerConstraint
from ..power.limiter import OutputLimiter
from .base import OVERFLOW, FilteredReferenceController, constraint_or_none
from .blocks import DEFAULT_MEMORY_S, BlockController
from .channels import ChannelLines, add_squares, least_factor, squares_of_sample
from .compiled_controller import CompiledController
from .step import adapt, advance_powers, control_filter, follow


class Correction(NamedTuple):
    """A Kalman filter of K measurements, with what it takes to undo the corrections of a sample if one fails."""

    gains: Covariance  # of all weights
    measurement_noise: np.ndarray  # (K,)
    row: np.ndarray  # (J I L,) filtered references of a microphone
    before: np.ndarray  # (J I L,) weights before the sample
    directions: np.ndarray  # (K, J I L) g = P x' of each measurement
    variances: np.ndarray  # (K,) S of each measurement
    numbers: np.ndarray  # record: state_noise, failed (microphone whose correction failed, or -1)


class DirectState(NamedTuple):
    """State of `DirectKalman`."""

    lines: ChannelLines
    weights: np.ndarray  # (J, I, L)
    constraint: tuple[ConstraintState, ...]
    correction: Correction


class DirectBudgetState(NamedTuple):
    """State of `DirectPowerBudget`."""

    lines: ChannelLines
    weights: np.ndarray  # (J, I, L), estimate of the unconstrained control filters
    constraint: tuple[ConstraintState, ...]  # computes the powers; its factors are fixed at 1
    correction: Correction
    control_filter: np.ndarray  # (J, I, L)
    numbers: np.ndarray  # record: waiting (samples since the last solution)


@adapt.register(DirectState)
def adapt_direct(state, error, control_signal):
    """Apply eq. 2-13 with the smallest of the loudspeakers' factors."""
    return correct_constrained(state, error)


@adapt.register(DirectBudgetState)
def adapt_direct_budget(state, error, control_signal):
    """Apply eq. 2-8."""
    if not correct_constrained(state, error):
        return False
    state.numbers[0].waiting += 1
    return True


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


@inlined
def correct_constrained(state, error):
    """Apply eq. 2-13; return False, with nothing changed, if that fails."""
    lines = state.lines
    state.correction.numbers[0].failed = -1
    finite, d, x = squares_of_sample(lines, error)
    if not finite:
        return False
    factor = least_factor(lines, state.constraint, d, x)
    if not correct(state.correction, state.weights.reshape(-1), lines, factor, state.weights.shape[2]):
        return False
    add_squares(lines, state.constraint, d, x)
    return True


@inlined
def correct(correction, w, lines, factor, taps):
    """Apply eq. 2-9 to the scaled measurement of each microphone; return False, with nothing changed, if that fails."""
    numbers, gains = correction.numbers[0], correction.gains
    copy_into(correction.before, w)
    for k in range(lines.disturbance.size):
        h, noise = observation(correction.row, lines.filtered[k], taps), correction.measurement_noise[k]
        state_noise = numbers.state_noise if k == 0 else 0.0
        y, S = kalman_step(gains, w, h, factor * lines.disturbance[k], state_noise, noise, 1.0)
        if not np.isfinite(y):
            numbers.failed = k
            take_back_corrections(correction, w, k)
            return False
        copy_into(correction.directions[k], gains.gain_direction)
        correction.variances[k] = S
    observe_guarded(lines.guard, correction, w, taps)
    return True


@part()
def observe_guarded(guard, correction, w, taps):
    """Correct w as if the sums of w_ji'x''_kji had been measured as zero, if there is a guard."""
    if guard is not None:
        for k in range(guard.filtered.shape[0]):
            row, noise = observation(correction.row, guard.filtered[k], taps), correction.measurement_noise[k]
            kalman_step(correction.gains, w, row, 0.0, 0.0, noise, 1.0)


@inlined
def observation(row, filtered, taps):
    """Set `row` to the newest filtered references of a microphone, (J, I, taps)."""
    n = 0
    for j in range(filtered.shape[0]):
        for i in range(filtered.shape[1]):
            copy_into(row[n : n + taps], newest(filtered[j, i], taps))
            n += taps
    return row


@part()
def take_back_corrections(correction, w, count):
    """Undo the state noise and the first `count` corrections of a sample.

    The covariance is restored up to rounding: P + sum_k g_k g_k'/S_k - r I. If there is no correction to undo,
    `kalman_step` has already taken back the state noise.
    """
    T, g = correction.gains.triangle, correction.directions
    copy_into(w, correction.before)
    for k in range(count):
        for i in range(w.size):
            for j in range(i + 1):
                T[i, j] += g[k, i] * g[k, j] / correction.variances[k]
    if count > 0:
        for i in range(w.size):
            T[i, i] -= correction.numbers[0].state_noise


class DirectKalman(CompiledController):
    r"""KF-ANC or KF-OPC for several channels: the paper's equations with all control filters as one state.

    `kf_anc` and `kf_opc` return it if there are several channels. The K measurements of a sample have independent
    noises, so they correct the J I L weights one after the other, in O(K (J I L)^2) operations.

    KF-OPC scales all measurements by one factor. Eq. 13 gives a factor for each loudspeaker as if it were alone; the
    smallest of them is used:

    .. math:: \alpha = \min_j \min\{\sqrt{\rho_j G_j / \delta_d^2},\ 1\}, \qquad
        G_j = \frac{\sum_{k,i} E[x_{kji}'^2]}{\sum_i E[x_i^2]}, \qquad \delta_d^2 = \sum_k E[\hat d_k^2]

    This extension is the package's, not the paper's. With one loudspeaker, microphone and reference it reduces to
    eq. 13. A loudspeaker that no microphone hears, :math:`G_j = 0`, is left out: its control filters stay zero.

    Parameters
    ----------
    n_taps : int
        Taps L of each control filter.
    secondary_path : array_like, shape (K, J, n_path), or nested sequence of control systems
        Estimated secondary paths, loudspeaker j to microphone k.
    state_noise : float
        State noise variance r (eq. 4), zero or above.
    measurement_noise : float or array_like, shape (K,)
        Measurement noise variance q (eq. 7) of all microphones or of each, zero or above. The larger its q, the less a
        microphone counts.
    initial_variance : float, default 1
        Variance of each tap before the first sample.
    n_references : int, default 1
        Number of references I.
    rated_power : float or array_like, shape (J,), optional
        Rated output power of all loudspeakers, or of each, for KF-OPC; None for KF-ANC.
    constraint : OutputPowerConstraint or sequence of J of them, optional
        Alternative to `rated_power`: rated powers with the settings of their power estimates. Copies are kept.
    amplifier, limiter
        As for `SharedGainKalman`.
    dtype : {numpy.float64, numpy.float32}, default numpy.float64
        Precision of the covariance, see `KFOPC.random_walk`.

    Raises
    ------
    ValueError, TypeError
        A setting that is out of range, or whose shape does not fit the secondary paths.

    See Also
    --------
    KFOPC : The same equations as a filterpy filter, ``dim_z=K``.
    SharedGainKalman : A form whose cost hardly depends on the numbers of loudspeakers and microphones.

    Notes
    -----
    `weights` is (J, I, L). `constraint_factor` is (J,), each loudspeaker's own factor; the smallest one is applied.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import kf_opc
    >>> paths = np.zeros((2, 2, 8))
    >>> paths[:, :, 1] = [[1.0, 0.3], [0.2, 1.0]]
    >>> kf_opc(32, paths, rated_power=0.5, state_noise=1e-8, measurement_noise=0.01)
    <KF-OPC: 2 microphones, 2 loudspeakers, 1 reference, 32 taps, rated power 0.5, 0.5, constraint factor 1, 1>
    """

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        state_noise: float,
        measurement_noise: Any,
        initial_variance: float = 1.0,
        n_references: int = 1,
        rated_power: Any = None,
        constraint: OutputPowerConstraint | Sequence[OutputPowerConstraint] | None = None,
        amplifier: Amplifier | Sequence[Amplifier] | None = None,
        limiter: Sequence[OutputLimiter] | None = None,
        dtype: Any = np.float64,
    ) -> None:
        own = constraint_or_none(rated_power, constraint)
        super().__init__(
            n_taps,
            secondary_path,
            n_references=n_references,
            multichannel=True,
            constraint=own,
            amplifier=amplifier,
            limiter=limiter,
        )
        noise = per_channel(measurement_noise, self.n_microphones, "microphones", "measurement_noise", as_nonnegative)
        self._state = DirectState(*self._common(), new_correction(self, state_noise, noise, initial_variance, dtype))
        self.name = "KF-ANC" if own is None else "KF-OPC"

    def _takes_guard(self) -> bool:
        return True

    def _after_new_path(self, before: np.ndarray) -> None:
        """Let P grow by the variance that the new paths give to the weights."""
        self._state.correction.gains.owed["diagonal"] += self._variance_by_new_path(before)

    @property
    def covariance(self) -> np.ndarray:
        """State covariance P, (J I L, J I L), in the order of ``weights.ravel()``; a new array."""
        return covariance_matrix(self._state.correction.gains)

    def _reason(self, error: Any) -> str:
        """Return why an update was refused."""
        return reason_of(self._state.correction)


class DirectPowerBudget(BlockController):
    r"""KF-PB for several channels in its direct form: all control filters as one state, a power budget per loudspeaker.

    The Kalman filter of `DirectKalman`, without a constraint factor, estimates the optimal control filters w for
    unlimited power. Every 32 ms, the control filters v within the rated powers are computed from these and from the
    recent correlation of the references:

    .. math:: \Bigl(R_{x'} + \operatorname{blkdiag}_j(\lambda_j R_x)\Bigr) v = R_{x'} \hat w, \qquad
        \lambda_j \ge 0, \qquad \lambda_j (v_j^T R_x v_j - \rho_j) = 0

    Parameters
    ----------
    n_taps, secondary_path, state_noise, initial_variance, n_references, amplifier, limiter, dtype
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
        dtype: Any = np.float64,
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
            new_correction(self, state_noise, noise, initial_variance, dtype),
            np.zeros(free.shape),
            new_record(waiting=0),
        )

    @property
    def control_filter(self) -> np.ndarray:
        """Control filters within the rated powers, which generate y, (J, I, L); a copy."""
        return self._state.control_filter.copy()

    def _after_new_path(self, before: np.ndarray) -> None:
        """Let P grow too, by the variance that the new paths give to the weights."""
        super()._after_new_path(before)
        self._state.correction.gains.owed["diagonal"] += self._variance_by_new_path(before)

    def _end_block(self, references: np.ndarray) -> None:
        """Find the control filters for the present estimate and correlation."""
        self._budget.solve_near(self._correlation.faded, self._state.weights)
        self._state.control_filter[...] = self._budget.weights

    def _reason(self, error: Any) -> str:
        """Return why an update was refused."""
        return reason_of(self._state.correction)


def new_correction(
    controller: FilteredReferenceController, state_noise: Any, noise: np.ndarray, initial_variance: Any, dtype: Any
) -> Correction:
    """Return the Kalman filter of a controller's weights, before the first sample."""
    size = controller.n_loudspeakers * controller.n_references * controller.n_taps
    return Correction(
        gains=new_covariance(as_nonnegative(initial_variance, "initial_variance") * np.eye(size), as_precision(dtype)),
        measurement_noise=noise,
        row=np.zeros(size),
        before=np.zeros(size),
        directions=np.zeros((noise.size, size)),
        variances=np.zeros(noise.size),
        numbers=new_record(state_noise=as_nonnegative(state_noise, "state_noise"), failed=-1),
    )


def reason_of(correction: Correction) -> str:
    """Return why a correction was refused."""
    microphone = int(correction.numbers["failed"][0])
    if microphone < 0:
        return OVERFLOW
    return (
        f"the update has no solution for microphone {microphone}: S = x' P x' + q must be positive and finite. With "
        "measurement_noise = 0, S is zero if no loudspeaker reaches the microphone or the reference is silent: give "
        "measurement_noise > 0. Nothing was changed"
    )
