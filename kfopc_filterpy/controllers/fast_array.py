"""The Kalman filter in O(L) per sample, by the fast array of `kernels.fast_array`: growing or finite memory."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .._validate import as_count, as_positive
from ..kernels.compiling import inlined, part
from ..kernels.delay_lines import latest, newest
from ..kernels.fast_array import (
    FastArray,
    array_holds,
    correct_by_rotations,
    new_fast_array,
    restart_array,
    rotate_array,
    stray,
)
from ..kernels.records import new_record
from ..power.amplifiers import Amplifier
from ..power.constraint import ConstraintState, OutputPowerConstraint, advance_constraint, squares_are_finite
from ..power.limiter import OutputLimiter
from .base import constraint_or_none
from .compiled_controller import CompiledController
from .step import Lines, adapt, disturbance_estimate, follow, skip

# Of the finite memory, whose arrays can be restarted:
LARGEST_STRAY = 1e-4  # beyond it an array is lost
LESS, MORE = 0.01, 2.0  # factors of P at the next start, after an array was lost and after one lasted
LEAST_MEMORY = 2  # in filter lengths


class FastArrayState(NamedTuple):
    """State of `FastArrayKalman` without a finite memory."""

    lines: Lines
    weights: np.ndarray
    constraint: ConstraintState
    array: FastArray


class GrowingFilter(NamedTuple):
    """One of the two filters of a finite memory, which remembers all since its start."""

    array: FastArray
    weights: np.ndarray


class FiniteMemoryState(NamedTuple):
    """State of `FastArrayKalman` with a finite memory."""

    lines: Lines
    weights: np.ndarray  # the two filters' weights, mixed
    constraint: ConstraintState
    one: GrowingFilter
    other: GrowingFilter
    numbers: np.ndarray  # record, see `new_pair`


def new_pair(n_taps: int, initial: float, memory: int) -> tuple[GrowingFilter, GrowingFilter, np.ndarray]:
    """Return two growing-memory filters, the first at its start, and the record of their turns."""
    one, other = (
        GrowingFilter(new_fast_array(n_taps, initial, largest_stray=LARGEST_STRAY), np.zeros(n_taps)) for _ in range(2)
    )
    turns = new_record(
        memory=memory,  # N
        elder_is_other=0,
        paired=0,  # whether the younger filter runs
        elder_lost=0,  # whether the elder stands still until the younger has taken over
        initial=initial,  # P at the next start
        largest_initial=initial,
        lost=0,  # arrays lost to rounding so far
    )
    return one, other, turns


@adapt.register(FastArrayState)
def adapt_fast_array(state, error, control_signal):
    """Apply eq. 2-9 by the two rotations."""
    return rotate(state, error)


@follow.register(FastArrayState)
def follow_fast_array(state, error):
    """Adapt while listening: the gains must follow the filtered reference from the first sample on."""
    return rotate(state, error)


@adapt.register(FiniteMemoryState)
def adapt_finite_memory(state, error, control_signal):
    """Apply eq. 2-9 to both filters, and mix them."""
    return rotate_both(state, error)


@follow.register(FiniteMemoryState)
def follow_finite_memory(state, error):
    """Adapt while listening, like the single array."""
    return rotate_both(state, error)


@skip.register(FastArrayState)
def skip_fast_array(state):
    """Advance the array, which must follow each sample of the filtered reference, as if the weights had been right."""
    advance_if_held(state.array, newest(state.lines.filtered, state.weights.size + 1))


@skip.register(FiniteMemoryState)
def skip_finite_memory(state):
    """Advance both arrays."""
    row = newest(state.lines.filtered, state.weights.size + 1)
    advance_if_held(state.one.array, row)
    advance_if_held(state.other.array, row)


@part()
def advance_if_held(array, row):
    """Advance an array without correcting weights; one that rounding has corrupted is left for the next update."""
    if array_holds(array, row):
        rotate_array(array)


@inlined
def rotate(state, error):
    """Apply eq. 2-9 by the two rotations; return False, with nothing changed, if rounding has corrupted the array."""
    row = newest(state.lines.filtered, state.weights.size + 1)
    if not array_holds(state.array, row):
        return False
    d, x = disturbance_estimate(state.lines, error), latest(state.lines.reference)
    if not squares_are_finite(d, row[0], x):
        return False
    factor = advance_constraint(state.constraint, d, row[0], x)
    correct_by_rotations(state.array, state.weights, row, factor * d)
    return True


@inlined
def rotate_both(state, error):
    """Apply eq. 2-9 to both filters, and mix them; return False, with nothing changed, if a square overflows."""
    row = newest(state.lines.filtered, state.weights.size + 1)
    d, x = disturbance_estimate(state.lines, error), latest(state.lines.reference)
    if not squares_are_finite(d, row[0], x):
        return False
    scaled = advance_constraint(state.constraint, d, row[0], x) * d
    if state.numbers[0].elder_is_other == 0:
        correct_pair(state.one, state.other, state.numbers, state.weights, row, scaled)
    else:
        correct_pair(state.other, state.one, state.numbers, state.weights, row, scaled)
    return True


@part()
def correct_pair(elder, younger, numbers, mixed, row, d):
    """Correct the two filters, mix them, and let them take turns.

    The younger filter starts when the elder one has heard N samples, and takes over after N more, when the elder one is
    restarted. Its share of the mixed weights grows in proportion to what it has heard, a/N. If the reference's statistics
    are steady, the variance of the mixed weights is then that of least squares over N samples, at every sample: with
    shares s = a/N and 1 - s of filters that average over a and a + N samples, it is in proportion to
    a (s/a + (1 - s)/(a + N))^2 + N ((1 - s)/(a + N))^2 = 1/N.
    """
    turns = numbers[0]
    if turns.elder_lost == 0 and not corrected(elder, row, d):
        turns.lost += 1
        if turns.paired != 0:
            turns.elder_lost = 1
        else:
            turns.initial *= LESS
            restart_array(elder.array, turns.initial)
    if turns.paired != 0 and not corrected(younger, row, d):
        turns.lost += 1
        turns.initial *= LESS
        restart(younger, elder.weights, turns.initial)
    share = 0.0
    if turns.paired != 0:
        share = min(younger.array.numbers[0].heard / turns.memory, 1.0)  # skipped samples are heard without turns
    for i in range(mixed.size):
        mixed[i] = elder.weights[i] + share * (younger.weights[i] - elder.weights[i])
    if share >= 1.0:
        turns.elder_is_other = 1 - turns.elder_is_other
        turns.elder_lost = 0
        turns.initial = min(MORE * turns.initial, turns.largest_initial)
        restart(elder, mixed, turns.initial)
    elif turns.paired == 0 and elder.array.numbers[0].heard >= turns.memory:
        turns.paired = 1
        restart(younger, mixed, turns.initial)


@part()
def corrected(own, row, d):
    """Correct a filter; return False, with its weights as they were, if rounding has corrupted its array."""
    if not array_holds(own.array, row):
        return False
    correct_by_rotations(own.array, own.weights, row, d)
    return True


@part()
def restart(own, weights, initial):
    """Begin a filter again at `weights`."""
    restart_array(own.array, initial)
    for i in range(weights.size):
        own.weights[i] = weights[i]


class FastArrayKalman(CompiledController):
    r"""Fast-array Kalman filter: eq. 2-9 with r = 0 in O(L), using the shift of the filtered reference.

    With `forgetting` = 1 it is `kf_anc` with ``state_noise=0`` (or `kf_opc`, with a rated power), to rounding. Below 1
    it is `fx_rls` from P = `initial_variance` diag(lambda, ..., lambda^L), which the derivation requires. It has no
    state noise, which would break the structure that makes the filter fast. For a random walk that follows a changing
    path, use the O(L^2) filter.

    Rounding: without forgetting, the weights agree with those of the O(L^2) filter to about 1e-10 over a million
    samples, on white, coloured and band-limited noise. With forgetting, errors grow by 1/lambda per sample until the
    array is lost, after 10 to 20 memories of 1/(1 - lambda) samples: some ten seconds for lambda = 0.9999 at 16 kHz.
    `update` then raises ValueError, and the weights stay as they were. A narrow band with an `initial_variance` far
    above `measurement_noise` can spoil the array without forgetting, too.

    With `memory` = N the filter forgets and still runs for ever, at less than twice the cost. Two filters without
    forgetting take turns: every N samples one of them is restarted from the weights in use, with
    P = `initial_variance`. The weights are a mixture of both that is as accurate as least squares over the last N
    samples, or as `fx_rls` with lambda = 1 - 2/N. A sample counts for 2 N samples. After that it is known only through
    the weights that a restarted filter begins with, which it trusts as if they had explained its first L - 1 samples.
    An array that rounding spoils before its time is restarted with a hundredth of its P, and each later one with twice
    the last, up to `initial_variance`.

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter.
    secondary_path : array_like or control.TransferFunction
        Estimated secondary path, taps or an FIR system.
    measurement_noise, initial_variance
        q and P(0|0) as for `kf_anc`, both above zero.
    forgetting : float, default 1
        Forgetting factor lambda, above 0 and at most 1.
    memory : int, optional
        Memory N in samples, at least 2 L. The excess error is L/N of the measurement noise. Not with `forgetting` below
        1. By default only `forgetting` limits the memory.
    rated_power : float, optional
        Rated output power rho_o: the measurement is scaled by the constraint factor of eq. 13. By default there is no
        constraint.
    constraint : OutputPowerConstraint, optional
        Given instead of `rated_power`: a rated power with the settings of its power estimates. A copy is kept.
    amplifier : callable, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.
    limiter : OutputLimiter, optional
        Limiter of the control signal, not shared with another controller.

    Raises
    ------
    ValueError
        A variance, forgetting factor or memory out of range, a memory beside a forgetting factor, a rated power that is
        not positive and finite, both a rated power and a constraint, fewer than one tap, a path that is not FIR. In a
        run without `memory`: an array that rounding has corrupted.
    TypeError
        An amplifier that is not one of the package's models.

    Notes
    -----
    The gains must follow the filtered reference from the first sample on. The filter therefore also adapts while it
    listens, before the control is switched on: it starts with weights learnt from the noise so far.

    References
    ----------
    R. Fraanje, A. H. Sayed, M. Verhaegen, N. J. Doelman, "A fast-array Kalman filter solution to active noise control",
    Int. J. Adapt. Control Signal Process. 19, 2005. The docstring of the module `kernels.fast_array` has the derivation.

    S. van Ophem, A. P. Berkhoff, "A numerically stable, finite memory, fast array recursive least squares filter for
    broadband active noise control", Int. J. Adapt. Control Signal Process. 30, 2016: two growing memories, mixed so that
    the information used is always the same, and restarted in turn. Of this paper we had only the abstract; the mixture,
    the restart and what is done about a lost array are derived here (`correct_pair`, `restart_array`).

    Examples
    --------
    >>> from kfopc_filterpy import FastArrayKalman
    >>> controller = FastArrayKalman(4, [1.0], measurement_noise=1.0)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)
    >>> round(float(controller.weights[0]), 12)  # K = 1 / (1 + 1)
    1.0
    """

    name = "fast-array KF"
    _refusal = (
        "the fast array is lost to rounding: nothing was changed, and this filter cannot go on. Use memory= instead of "
        "a forgetting factor, or kf_anc, whose O(L^2) form does not lose its covariance"
    )

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        measurement_noise: float,
        initial_variance: float = 1.0,
        forgetting: float = 1.0,
        memory: int | None = None,
        rated_power: float | None = None,
        constraint: OutputPowerConstraint | None = None,
        amplifier: Amplifier | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        q = as_positive(measurement_noise, "measurement_noise")
        variance = as_positive(initial_variance, "initial_variance")
        forgetting = as_positive(forgetting, "forgetting")
        if forgetting > 1.0:
            raise ValueError(f"forgetting must be 1 at most, got {forgetting:g}: 1 forgets nothing")
        if memory is not None:
            memory = as_count(memory, "memory")
            least = LEAST_MEMORY * as_count(n_taps, "n_taps")
            if memory < least:
                raise ValueError(f"memory must be {LEAST_MEMORY} n_taps = {least} samples at least, got {memory}")
            if forgetting < 1.0:
                raise ValueError(f"give either memory or a forgetting factor below 1, got {memory} and {forgetting:g}")
        own = constraint_or_none(rated_power, constraint)
        super().__init__(
            n_taps, secondary_path, amplifier=amplifier, constraint=own, limiter=limiter, filtered_taps=n_taps + 1
        )
        self.name = ("" if memory is None else "finite-memory ") + (
            "fast-array KF" if own is None else "fast-array KF-OPC"
        )
        initial = variance / (q * forgetting)
        self._state: FastArrayState | FiniteMemoryState
        if memory is None:
            self._state = FastArrayState(*self._common(), new_fast_array(self.n_taps, initial, forgetting))
        else:
            self._state = FiniteMemoryState(*self._common(), *new_pair(self.n_taps, initial, memory))

    @property
    def forgetting(self) -> float:
        """Forgetting factor lambda."""
        return float(self._arrays[0].numbers["forgetting"][0])

    @property
    def memory(self) -> int | None:
        """Memory N in samples; None without a finite memory."""
        return int(self._state.numbers["memory"][0]) if isinstance(self._state, FiniteMemoryState) else None

    @property
    def stray(self) -> float:
        """Relative size of what rounding adds to the array, 0 in exact arithmetic; with a finite memory, the larger."""
        return max(stray(array) for array in self._arrays)

    @property
    def arrays_lost(self) -> int:
        """Number of arrays that a finite memory has restarted before their time, because rounding had spoilt them."""
        return int(self._state.numbers["lost"][0]) if isinstance(self._state, FiniteMemoryState) else 0

    @property
    def _arrays(self) -> tuple[FastArray, ...]:
        state = self._state
        return (state.one.array, state.other.array) if isinstance(state, FiniteMemoryState) else (state.array,)

    def _filter_again(self) -> None:
        """Keep the filtered reference: the array needs each row to be the last one, shifted by a sample."""
