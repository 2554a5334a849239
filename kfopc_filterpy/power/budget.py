"""The power budget: from the unconstrained control filter to the best one within the rated power, sample by sample.

`allocation` solves for the control filter, `spending` says how much power to spend now. This module computes what they
need from the signals, and listens to a limiter.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_count, as_number, as_positive, as_signal
from ..kernels.compiling import compiled, part
from ..kernels.delay_lines import delay_line, newest, push
from ..kernels.records import new_record
from ..kernels.toeplitz import toeplitz_power
from ..kernels.vectors import FAST, add_scaled, dot
from .allocation import constrained_filter, guarded
from .ceiling import balance_of_power
from .constraint import DEFAULT_FS, SILENCE
from .spending import LEAST, MOST, Spending, book, new_spending, power_left, power_to_spend

DEFAULT_CORRELATION_MEMORY_S = 2.5
DEFAULT_AVERAGING_S = 10.0
SEGMENTS = 10  # in the window of the correlations; one more is being filled
LIMITER_MEMORY_S = 1.0  # memory of what a limiter took
CEILING_RATE = 2.0  # the ceiling moves by exp(2 dt / T) at most, with T = averaging time, or the time so far if shorter
SOFT = 0.5  # a noise for which less than this share of the rated power is spent does not lower the ceiling
SAME = 1e-9  # of the rated amplitude: what comes out as close to what was asked for has passed the limiter
ACTS = 1e-6  # of the rated power, in the mean of what a limiter took: it counts as one that acts, for about 14 s
LOUDEST = 100.0  # rated amplitudes; louder samples count as this loud in what a limiter took
INTERVAL_S = 0.008  # between two solutions; less at the start
X, XF = 0, 1  # the reference and the filtered reference, in the correlations


class BudgetState(NamedTuple):
    """State that the compiled functions below read and update."""

    control_filter: np.ndarray  # (L,) v, which makes the control signal
    reference: np.ndarray  # delay line of x
    filtered: np.ndarray  # delay line of x'
    own: np.ndarray  # (2, SEGMENTS + 1, lags) for x and x': sums of products of a segment's samples at lags 0, 1, ...
    across: np.ndarray  # (2, SEGMENTS + 1, lags) the same, of its samples with samples before it
    counts: np.ndarray  # (SEGMENTS + 1,) samples in each segment
    guard: np.ndarray  # correlation of the guard filter W at lags 0, 1, ...; one zero without a guard
    spending: Spending  # of the averaging time
    numbers: np.ndarray  # record: rated power, lambda, ...; see `PowerBudget`


@part()
def take_correlations(budget, x, xf):
    """Add the products of the newest x and x' with earlier samples to the correlations.

    Products with samples before the segment are stored separately. They are left out for the oldest segment of the
    window, so that the sum is the correlation of a stretch of signal with zeros around it.
    """
    push(budget.reference, x)
    push(budget.filtered, xf)
    lags, numbers = budget.own.shape[2], budget.numbers[0]
    if budget.counts[numbers.current] >= numbers.segment:
        numbers.current = (numbers.current + 1) % len(budget.counts)
        budget.counts[numbers.current] = 0.0
        for signal in (X, XF):
            for k in range(lags):
                budget.own[signal, numbers.current, k] = budget.across[signal, numbers.current, k] = 0.0
    current = numbers.current
    budget.counts[current] += 1.0
    own = min(int(budget.counts[current]), lags)
    before, filtered_before = newest(budget.reference, lags), newest(budget.filtered, lags)
    add_scaled(budget.own[X, current], x, before, 0, own)
    add_scaled(budget.own[XF, current], xf, filtered_before, 0, own)
    if own < lags:
        add_scaled(budget.across[X, current], x, before, own, lags)
        add_scaled(budget.across[XF, current], xf, filtered_before, own, lags)


@part()
def sum_correlations(budget, of_x, of_xf):
    """Set the first rows of R_x and R_x' to the means over the window."""
    count, kept, current = 0.0, len(budget.counts), budget.numbers[0].current
    for k in range(of_x.size):
        of_x[k] = of_xf[k] = 0.0
    for j in range(kept):
        i = (current - j) % kept
        add_scaled(of_x, 1.0, budget.own[X, i], 0, of_x.size)
        add_scaled(of_xf, 1.0, budget.own[XF, i], 0, of_x.size)
        if j < kept - 1:  # zeros precede the oldest segment
            add_scaled(of_x, 1.0, budget.across[X, i], 0, of_x.size)
            add_scaled(of_xf, 1.0, budget.across[XF, i], 0, of_x.size)
        count += budget.counts[i]
    for k in range(of_x.size):
        of_x[k] /= count
        of_xf[k] /= count


@compiled()
def allocate(budget, w):
    """Set the control filter for the estimate w."""
    L, lags, numbers = budget.control_filter.size, budget.own.shape[2], budget.numbers[0]
    of_x, of_xf = np.empty(lags), np.empty(lags)
    sum_correlations(budget, of_x, of_xf)
    if not of_x[0] > SILENCE:  # silence so far: nothing to solve
        return
    per_level, level = power_to_spend(budget.spending, numbers.ceiling, numbers.limited > ACTS)
    mean = of_x[0]
    share = per_level * mean if per_level < np.inf else 1.0
    if lags > L:
        of_xf, w = guarded(of_xf, budget.guard, w)
    numbers.weight = constrained_filter(
        of_x[:L], of_xf, w, share * numbers.rated_power, numbers.weight, budget.control_filter
    )
    numbers.gain = toeplitz_power(of_x[:L], budget.control_filter) / mean
    if numbers.limited > 0.0 and level > 0.0:
        move_ceiling(budget, of_x[:L], of_xf, level / mean)
        numbers.acts = False


@part()
def asked_for(budget, y):
    """Return what the control filter asked for: y, unless a limiter changed it. (Two sums of it differ by rounding.)"""
    v = budget.control_filter
    asked = dot(v, newest(budget.reference, v.size))
    return y if abs(asked - y) <= SAME * math.sqrt(budget.numbers[0].rated_power) else asked


@part()
def hear_limiter(budget, asked, y):
    """Add the newest sample to the means of what a limiter left as it was, and of what it took (see `ceiling`)."""
    numbers = budget.numbers[0]
    amplitude = math.sqrt(numbers.rated_power)
    asked = min(max(asked / amplitude, -LOUDEST), LOUDEST)
    played = min(max(y / amplitude, -LOUDEST), LOUDEST)
    passed, limited = asked * asked, 0.0
    if abs(asked - played) > SAME:
        passed, limited, numbers.acts = 0.0, played * (asked - played), True
    share = 1.0 / min(numbers.taken + 1.0, LIMITER_MEMORY_S * numbers.fs + 1.0)
    numbers.passed += share * (passed - numbers.passed)
    numbers.limited += share * (limited - numbers.limited)


@part()
def move_ceiling(budget, of_x, of_xf, relative_level):
    """Move the ceiling to where the limiter takes as much from the noise reduction as more power would add.

    It moves fast at the start and then slowly, so that single bursts do not move it. It falls only if the limiter acts
    now or the noise is loud: what the limiter took from a louder noise says nothing about a soft one.
    """
    numbers = budget.numbers[0]
    balance, power = balance_of_power(
        of_x, of_xf, numbers.weight, budget.control_filter, numbers.passed, numbers.limited
    )
    if not abs(balance) <= 1.0:
        return
    if balance < 0.0 and not (numbers.acts or power * relative_level >= SOFT * numbers.rated_power):
        return
    step = CEILING_RATE * balance * numbers.interval / min(numbers.taken, numbers.averaging)
    numbers.ceiling = min(max(numbers.ceiling * math.exp(step), LEAST), MOST)


@part()
def take_sample(budget, x, xf, y):
    """Add a sample of reference, filtered reference and emitted control signal to correlations, account and limiter."""
    numbers = budget.numbers[0]
    take_correlations(budget, x, xf)
    asked = asked_for(budget, y)
    # The level of the noise as the control filter sees it: the power it asks for, over what it asks for at level 1.
    book(budget.spending, asked * asked / numbers.gain if numbers.gain > 0.0 else x * x, y * y / numbers.rated_power)
    hear_limiter(budget, asked, y)
    numbers.taken += 1.0
    numbers.waited += 1.0


@part()
def advance_budget(budget, w, x, xf, y):
    """Process a sample to which the estimate was adapted; solve again if it is due."""
    numbers = budget.numbers[0]
    numbers.noted = False
    take_sample(budget, x, xf, y)
    # At the start the estimate grows fast, so the interval is an eighth of the time so far.
    if numbers.due or numbers.waited >= min(numbers.longest, 1.0 + numbers.taken // 8.0):
        numbers.interval, numbers.waited, numbers.due = min(numbers.waited, numbers.longest), 0.0, False
        allocate(budget, w)


@part()
def note_sample(budget, x, xf, y):
    """Store a sample that was played. If the estimate does not adapt to it, `take_noted` processes it."""
    take_noted(budget)
    numbers = budget.numbers[0]
    numbers.noted, numbers.noted_x, numbers.noted_xf, numbers.noted_y = True, x, xf, y


@part()
def take_noted(budget):
    """Process the last sample that was played, if the estimate did not adapt to it: its power was spent all the same.

    One whose square overflows counts as silence.
    """
    numbers = budget.numbers[0]
    if numbers.noted:
        numbers.noted = False
        x, xf, y = numbers.noted_x, numbers.noted_xf, numbers.noted_y
        if np.isfinite(x * x + xf * xf + y * y):
            take_sample(budget, x, xf, y)
        else:
            take_correlations(budget, 0.0, 0.0)


@part()
def follow_noise(budget, x, xf):
    """Process a sample while the control is switched off: no power is saved in this time."""
    take_noted(budget)
    take_correlations(budget, x, xf)
    book(budget.spending, x * x, 1.0)


@compiled(fastmath=FAST)
def control_sample(budget, x):
    """Return v' x(n) for a reference sample that the budget has not processed yet."""
    v, before = budget.control_filter, newest(budget.reference, budget.control_filter.size)
    total = v[0] * x
    for k in range(1, v.size):
        total += v[k] * before[k - 1]
    return total


@compiled()
def advance_sample(budget, w, x, xf, y):
    """Call `advance_budget` from Python."""
    advance_budget(budget, w, x, xf, y)


@compiled()
def listen_sample(budget, x, xf):
    """Call `follow_noise` from Python."""
    follow_noise(budget, x, xf)


@compiled()
def left_of(spending):
    """Call `power_left` from Python."""
    return power_left(spending)


def correlation_of(guard: Any) -> np.ndarray:
    """Return the correlation of a guard filter at lags 0, 1, ..., (n_guard,); one zero without a guard."""
    if guard is None:
        return np.zeros(1)
    taps = as_signal(guard, "guard")
    return np.correlate(taps, taps, "full")[taps.size - 1 :]


class PowerBudget:
    r"""Best use of a rated power: the power-constrained control filter for an estimate of the unconstrained one.

    An adaptive filter estimates the control filter w that would be best without a limit. Every few milliseconds the
    budget finds the filter v that is best within the power,

    .. math:: (R_{x'} + \lambda R_x) v = R_{x'} \hat w, \qquad v^T R_x v = \rho

    It minimises :math:`E[e^2]` subject to :math:`E[y^2] \le \rho`. For any :math:`v`,
    :math:`E[e^2] = E[e^2]_{min} + (v - w)^T R_{x'} (v - w)`, so w contains all that matters of the disturbance. The
    error is quadratic in w, so the conditional mean of w can replace it (certainty equivalence). The constraint never
    enters the estimate, so the estimate has nothing to forget when the level changes.

    The power :math:`\rho` follows the level of the noise, so that :math:`\lambda` stays the same while the spectrum does.
    This is the best way to spend a mean power: a noise that recurs within the averaging time is controlled as well as
    by the best fixed filter with the same mean power. Each unit of level gets so much power that the noise of the last
    `averaging_s` would have used the rated power. Newer noise counts more, and a loud second counts only in part.

    - If power of the last `averaging_s` is left, up to twice the rated power is spent, but only on a level that has
      come and gone within this time, or has been there for all of it. A noise that has just become louder may stay so:
      it gets the rated power at most, and less if the jump has spent more.
    - If more than the rated power was spent, it is repaid within a quarter of `averaging_s`.
    - The beginning of a burst gets what keeps the mean if such bursts recur, or what the rules above allow if that is
      more.

    So after a noise becomes softer for good, the power rises only slowly to the rated one, within `averaging_s`. The
    correlations are those of a sliding window of `memory_s`.

    If a limiter follows the budget (the `control_signal` given to `advance` then differs from the budget's own), the
    target has a ceiling. At the ceiling, more power would lower the error in samples that pass the limiter by as much
    as it would raise it in the others (see `power.ceiling`). The ceiling is found within seconds and then changes
    slowly.

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter.
    rated_power : float
        Rated output power (mean square of the control signal).
    fs : float, default 16000
        Sample rate in Hz.
    memory_s : float, default 2.5
        Length of the window of the correlations in seconds, at least 10 n_taps samples.
    averaging_s : float, default 10
        Time in seconds over which the mean power is kept to the rated one. The control filter is solved for every 8 ms,
        so choose 50 times as long; 8 samples are the least.
    guard : array_like, shape (n_guard,), optional
        Short filter W against an uncertain secondary path, see `paths.guard_filter`: the system above gets a third
        term, :math:`R_{W x'}`, the correlation of the filtered reference after W. By default none.

    Raises
    ------
    ValueError
        A power, rate or time that is not positive and finite, `averaging_s` below 8 samples, fewer than one tap, a guard
        with NaN or Inf.

    See Also
    --------
    PowerBudgetKalmanFilter : a filterpy filter with a budget.

    References
    ----------
    M. D. Hebden, "An algorithm for minimization using exact second derivatives", AERE report TP515, 1973, and
    J. J. More, D. C. Sorensen, "Computing a trust region step", SIAM J. Sci. Stat. Comput. 4(3), 1983, for the search
    for lambda. N. Levinson, "The Wiener RMS error criterion in filter design and prediction", J. Math. Phys. 25, 1947.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.power import PowerBudget
    >>> budget = PowerBudget(n_taps=2, rated_power=0.25)
    >>> for x in np.random.default_rng(0).standard_normal(16000):
    ...     y = budget.control_signal(x)
    ...     budget.advance(x, x, weights=[1.0, 0.0])  # the secondary path is a wire: x' = x
    >>> budget.control_filter.round(1) + 0.0  # half the amplitude: a quarter of the power
    array([0.5, 0. ])
    """

    def __init__(
        self,
        n_taps: int,
        rated_power: float,
        *,
        fs: float = DEFAULT_FS,
        memory_s: float = DEFAULT_CORRELATION_MEMORY_S,
        averaging_s: float = DEFAULT_AVERAGING_S,
        guard: Any = None,
    ) -> None:
        n_taps = as_count(n_taps, "n_taps")
        of_guard = correlation_of(guard)
        lags = n_taps + of_guard.size - 1
        rated_power = as_positive(rated_power, "rated_power")
        self.fs = as_positive(fs, "fs", unit="Hz")
        self.memory_s = as_positive(memory_s, "memory_s", unit="s")
        self.averaging_s = as_positive(averaging_s, "averaging_s", unit="s")
        memory = as_positive(self.memory_s * self.fs, "memory_s in samples")
        self._state = BudgetState(
            control_filter=np.zeros(n_taps),
            reference=delay_line(lags),
            filtered=delay_line(lags),
            own=np.zeros((2, SEGMENTS + 1, lags)),
            across=np.zeros((2, SEGMENTS + 1, lags)),
            counts=np.zeros(SEGMENTS + 1),
            guard=of_guard,
            spending=new_spending(self.averaging_s * self.fs),
            numbers=new_record(
                rated_power=rated_power,
                fs=self.fs,
                averaging=self.averaging_s * self.fs,  # samples
                segment=float(max(round(memory / SEGMENTS), lags)),  # samples
                current=0,  # segment that is being filled
                taken=0.0,  # samples since the control was switched on
                waited=0.0,  # of these, since the last solution
                due=False,  # whether to solve at the next sample, however few have waited
                interval=0.0,  # and between the last two
                longest=float(max(round(INTERVAL_S * self.fs), 1)),  # and at most
                weight=0.0,  # lambda
                gain=0.0,  # power of the control signal for each unit of level
                ceiling=MOST,  # of the target over the rated power, behind a limiter
                passed=0.0,  # recent mean, over the rated power, of what a limiter left as it was
                limited=0.0,  # the same, of y (u - y) for what it changed from u to y
                acts=False,  # whether it changed anything since the last solution
                noted=False,  # whether the following sample was played, and the estimate has not adapted to it so far
                noted_x=0.0,
                noted_xf=0.0,
                noted_y=0.0,
            ),
        )

    @property
    def state(self) -> BudgetState:
        """Arrays that the compiled loop updates."""
        return self._state

    @property
    def n_taps(self) -> int:
        """Taps of the control filter."""
        return self._state.control_filter.size

    @property
    def rated_power(self) -> float:
        """Rated output power; can be assigned."""
        return float(self._state.numbers["rated_power"][0])

    @rated_power.setter
    def rated_power(self, value: float) -> None:
        self._state.numbers["rated_power"] = as_positive(value, "rated_power")
        self._state.numbers["due"] = True

    @property
    def control_filter(self) -> np.ndarray:
        """Control filter v, (L,), newest-sample tap first, zero before the first sample; a copy."""
        return self._state.control_filter.copy()

    @property
    def power_weight(self) -> float:
        """Weight lambda of the control power; 0: the estimate fits the budget as it is, Inf: it was scaled to fit."""
        return float(self._state.numbers["weight"][0])

    @property
    def ceiling(self) -> float:
        """Ceiling of the target power behind a limiter, over the rated power; 2 if no limiter ever acts."""
        return float(self._state.numbers["ceiling"][0])

    @property
    def account_s(self) -> float:
        """Excess of the power spent in the averaging time, in seconds of rated power; negative if power is left.

        The time before the first sample counts as if the rated power had been spent.
        """
        left, _ = left_of(self._state.spending)
        return -float(left) * float(self._state.spending.numbers["full"][0]) / self.fs

    def use_guard(self, guard: Any) -> None:
        """Solve with another guard filter, as long as the present one; None: no guard from now on.

        Raises
        ------
        ValueError
            A guard of another length, or with NaN or Inf. Nothing was changed.
        """
        of_guard, present = correlation_of(guard), self._state.guard
        if guard is not None and of_guard.size != present.size:
            raise ValueError(
                f"guard must have the {present.size} taps of the present one, got {of_guard.size}: make a new budget"
            )
        present[:] = of_guard if guard is not None else 0.0

    def control_signal(self, reference: float) -> float:
        """Return the control signal y(n) for the `reference` x(n); call it before `advance` with the same x(n)."""
        return float(control_sample(self._state, self._sample(reference, "reference")))

    def advance(
        self, reference: float, filtered_reference: float, weights: Any, control_signal: float | None = None
    ) -> None:
        """Process one sample, and solve for the control filter if it is due.

        Parameters
        ----------
        reference, filtered_reference : float
            Newest reference x(n) and filtered reference x'(n).
        weights : array_like
            (L,) estimate of the unconstrained control filter.
        control_signal : float, optional
            Emitted control signal, if it is not `control_signal` of the same reference, for example after a limiter.

        Raises
        ------
        ValueError
            NaN, Inf, a sample whose square overflows, weights of another length. Nothing was changed.
        """
        w = as_signal(weights, "weights", length=self.n_taps)
        y = self.checked_sample(reference, filtered_reference, control_signal)
        advance_sample(self._state, w, float(reference), float(filtered_reference), y)

    def checked_sample(self, reference: Any, filtered_reference: Any, control_signal: Any = None) -> float:
        """Return the control signal that `advance` would use for these arguments, or raise its error."""
        self._sample(filtered_reference, "filtered_reference")
        return (
            self.control_signal(reference) if control_signal is None else self._sample(control_signal, "control_signal")
        )

    def listen(self, reference: float, filtered_reference: float) -> None:
        """Process a sample, `reference` x(n) and `filtered_reference` x'(n), while the control is switched off."""
        sample = self._sample(reference, "reference"), self._sample(filtered_reference, "filtered_reference")
        listen_sample(self._state, *sample)

    @staticmethod
    def _sample(value: Any, name: str) -> float:
        number = as_number(value, name)
        if math.isinf(number * number):
            raise ValueError(f"{name} must have a finite square, got {number:g}")
        return number
