"""The power budget: from the unconstrained control filter to the best one within the rated power, sample by sample.

`allocation` solves for the control filter. This module computes what it needs: the correlations of the recent signals,
a forecast of their level, and a target power that accounts for the power spent so far.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_count, as_number, as_positive, as_signal
from ..kernels.compiling import compiled, part
from ..kernels.delay_lines import delay_line, newest, push
from ..kernels.records import new_record
from ..kernels.vectors import FAST, add_scaled, dot
from .allocation import constrained_filter, guarded
from .ceiling import balance_of_power
from .constraint import DEFAULT_FS, SILENCE

DEFAULT_CORRELATION_MEMORY_S = 1.25
DEFAULT_CREDIT_S = 0.1
DEFAULT_AVERAGING_S = 10.0
SHORT, USUAL, LONG = 6, 10, 24  # complete segments in a window; one more is being filled
AGREEMENT = 1.0  # levels differ if their squared difference exceeds this multiple of the sum of their variances
REPAYMENT = 3.0  # 1/s: the account changes the target by the factor exp(-REPAYMENT account / (1 + PATIENCE chance))
PATIENCE = 6.0  # 1/s: repayment is slower if much of the account is due to chance
LARGEST_CHANCE_S = 0.5
UNSPENT = 0.4  # of the averaging time: memory of the share of the rated power that was spent
UNSPENT_GAIN, UNSPENT_MOST = 10.0, 1.3  # an unspent share raises the target by ten times itself, 30 % at most
PACE = 0.5  # of the rated power at most repays a debt, more only if the debt exceeds a quarter of the averaging time
TARGET_LEAST, TARGET_MOST = 0.1, 3.0  # target power over rated power
LIMITER_MEMORY_S = 1.0  # memory of what a limiter took
CEILING_RATE = 2.0  # the ceiling moves by exp(2 dt / T) at most, with T = averaging time, or the time so far if shorter
SAME = 1e-9  # of the rated amplitude: what comes out as close to what was asked for has passed the limiter
LOUDEST = 100.0  # rated amplitudes; louder samples count as this loud in what a limiter took
INTERVAL = 128  # samples between two solutions; fewer at the start
STEADY = 6.0  # a trend counts if it is larger than sqrt(STEADY) times its standard error
SHORTEST_PART = 0.25  # of a segment: a shorter part is ignored
X, XF = 0, 1  # the reference and the filtered reference, in the correlations
FORECAST_LEAST, FORECAST_MOST = 0.5, 4.0  # bounds of the forecast change of power; the lower one is cautious


class BudgetState(NamedTuple):
    """State that the compiled functions below read and update."""

    control_filter: np.ndarray  # (L,) v, which makes the control signal
    reference: np.ndarray  # delay line of x
    filtered: np.ndarray  # delay line of x'
    own: np.ndarray  # (2, LONG + 1, lags) for x and x': sums of products of a segment's samples at lags 0, 1, ...
    across: np.ndarray  # (2, LONG + 1, lags) the same, of its samples with samples before it
    counts: np.ndarray  # (LONG + 1,) samples in each segment
    guard: np.ndarray  # correlation of the guard filter W at lags 0, 1, ...; one zero without a guard
    numbers: np.ndarray  # record: rated power, account, lambda, ...; see `PowerBudget`


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
def choose_span(budget):
    """Choose the window: short if the level has risen, long if its changes can be due to chance.

    Chance is estimated from the differences of neighbouring segments' powers (von Neumann). They are large for bursts,
    which are then averaged over a long window. They are small for a noise that swells, so that even a small difference
    between the means of two windows counts. (This is a rule of intersecting confidence intervals, after Goldenshluger
    and Nemirovski.) The estimate follows a fall of the level more slowly than a rise: a pause between bursts is no
    reason to spend more on the next one.
    """
    numbers = budget.numbers[0]
    numbers.span, numbers.chance = USUAL, 0.0
    usual, variance, _ = _mean_level(budget, USUAL)
    if not usual > SILENCE:
        return
    # A segment's variance is 12 times the mean's. With fewer segments, at the start, this overestimates the chance.
    chance = math.sqrt(2.0 * SHORT * variance * numbers.segment / numbers.fs)
    numbers.chance = min(chance, LARGEST_CHANCE_S)
    short, short_variance, _ = _mean_level(budget, SHORT)
    long, long_variance, segments = _mean_level(budget, LONG)
    if short > usual and math.log(short / usual) ** 2 > AGREEMENT * (short_variance + variance):
        numbers.span = SHORT
    elif segments >= 0.8 * LONG and math.log(long / usual) ** 2 <= AGREEMENT * (long_variance + variance):
        numbers.span = LONG


@part()
def _mean_level(budget, span):
    """Return the mean power of x' in the newest segments, its relative variance by chance, and their number."""
    total = weight = 0.0
    for j in range(span + 1):
        share = _share(budget, j)
        if share > 0.0:
            weight += share
            total += share * _power(budget, j)
    if not (total > 0.0 and total < np.inf):
        return 0.0, 0.0, 0.0
    mean = total / weight
    differences = count = 0.0
    last = -1.0
    for j in range(span + 1):
        if _share(budget, j) > 0.0:
            level = _power(budget, j) / mean
            if last >= 0.0:
                differences += (level - last) ** 2
                count += 1.0
            last = level
    return mean, 0.5 * differences / max(count, 1.0) / max(weight, 1.0), weight


@part()
def sum_correlations(budget, of_x, of_xf):
    """Set the first rows of R_x and R_x' to the means over the window."""
    count, kept, span, current = 0.0, len(budget.counts), budget.numbers[0].span, budget.numbers[0].current
    for k in range(of_x.size):
        of_x[k] = of_xf[k] = 0.0
    for j in range(span + 1):
        i = (current - j) % kept
        add_scaled(of_x, 1.0, budget.own[X, i], 0, of_x.size)
        add_scaled(of_xf, 1.0, budget.own[XF, i], 0, of_x.size)
        if j < span:  # zeros precede the oldest segment
            add_scaled(of_x, 1.0, budget.across[X, i], 0, of_x.size)
            add_scaled(of_xf, 1.0, budget.across[XF, i], 0, of_x.size)
        count += budget.counts[i]
    for k in range(of_x.size):
        of_x[k] /= count
        of_xf[k] /= count


@part()
def level_forecast(budget, mean_power):
    """Return the ratio of the present power of x' to its mean in the window; 1 unless there is a significant trend.

    The trend is a straight line through the logarithm of the segments' powers. Its slope is shrunk by the part that
    scatter alone would cause (James and Stein). Bursts scatter, so they are averaged; a swelling noise is followed.
    """
    floor, segments = 1e-12 * mean_power, budget.numbers[0].span + 1
    weight = times = levels = 0.0
    for j in range(segments):
        share = _share(budget, j)
        if share > 0.0:
            weight += share
            times += share * _age(budget, j)
            levels += share * math.log(_power(budget, j) + floor)
    if not (weight > 3.0 and floor > SILENCE):
        return 1.0
    times, levels = times / weight, levels / weight
    spread = together = scatter = 0.0
    for j in range(segments):
        share = _share(budget, j)
        if share > 0.0:
            t, level = _age(budget, j) - times, math.log(_power(budget, j) + floor) - levels
            spread += share * t * t
            together += share * t * level
            scatter += share * level * level
    slope = together / spread
    error = max(scatter - slope * together, 0.0) / (weight - 2.0) / spread
    if not slope * slope > STEADY * error:
        return 1.0
    slope *= 1.0 - STEADY * error / (slope * slope)
    mean = 0.0  # mean power along the line, over the power at its middle
    for j in range(segments):
        mean += _share(budget, j) / weight * math.exp(slope * (_age(budget, j) - times))
    return min(max(math.exp(-slope * times) / mean, FORECAST_LEAST), FORECAST_MOST)


@part(forceinline=True)
def _share(budget, j):
    """Return the filled share of the j-th newest segment, 0 if it is too short to count."""
    count = budget.counts[(budget.numbers[0].current - j) % len(budget.counts)] / budget.numbers[0].segment
    return count if count >= SHORTEST_PART else 0.0


@part(forceinline=True)
def _age(budget, j):
    """Return the time of the middle of the j-th newest segment, in segments from now (negative)."""
    newest_part = budget.counts[budget.numbers[0].current] / budget.numbers[0].segment
    return -0.5 * newest_part if j == 0 else -newest_part - j + 0.5


@part(forceinline=True)
def _power(budget, j):
    """Return the power of x' in the j-th newest segment, which must not be empty."""
    i = (budget.numbers[0].current - j) % len(budget.counts)
    return budget.own[XF, i, 0] / budget.counts[i]


@part()
def target_power(budget, forecast):
    """Return the power to solve for: the rated one, corrected by the account, over the forecast change of level.

    A limiter that acts sets a ceiling, which holds whatever credit the account has.

    Repayment of debt starts at once, but is slower the larger `chance` is. The error is convex in the power, so a large
    debt costs least if it is repaid evenly, in what is left of the averaging time. Credit of up to half of `chance` is
    left to even out by itself: to react to chance would cost noise reduction.
    """
    numbers = budget.numbers[0]
    account, chance = numbers.account, numbers.chance
    excess = account if account > 0.0 else min(account + 0.5 * chance, 0.0)
    share = unspent(numbers) * math.exp(-REPAYMENT / (1.0 + PATIENCE * chance) * excess)
    repaid = max(PACE, 2.0 * account / numbers.averaging)
    return numbers.rated_power * min(max(share, 1.0 - repaid, TARGET_LEAST), numbers.ceiling) / forecast


@part()
def unspent(numbers):
    """Return the factor that raises the target if, beyond what chance explains, power was recently left unspent.

    The account loses credit that could not be spent in time. A noise that swells loses a part of the power at each
    swell, since falls of the level are followed slowly. How large a part is measured from the noise's own past.
    """
    left = 1.0 - numbers.spent - numbers.chance / math.sqrt(2.0 * UNSPENT * numbers.averaging)
    return min(1.0 + UNSPENT_GAIN * max(left, 0.0), UNSPENT_MOST)


@compiled()
def allocate(budget, w):
    """Set the control filter for the estimate w."""
    L, lags = budget.control_filter.size, budget.own.shape[2]
    of_x, of_xf = np.empty(lags), np.empty(lags)
    choose_span(budget)
    sum_correlations(budget, of_x, of_xf)
    if not of_x[0] > SILENCE:  # silence so far: nothing to solve
        return
    forecast = level_forecast(budget, of_xf[0])
    power = target_power(budget, forecast)
    if lags > L:
        of_xf, w = guarded(of_xf, budget.guard, w)
    budget.numbers[0].weight = constrained_filter(
        of_x[:L], of_xf, w, power, budget.numbers[0].weight, budget.control_filter
    )
    if budget.numbers[0].limited > 0.0:
        move_ceiling(budget, of_x[:L], of_xf, forecast)
        budget.numbers[0].acts = False


@part()
def hear_limiter(budget, y):
    """Add the newest sample to the means of what a limiter left as it was, and of what it took (see `ceiling`)."""
    numbers, v = budget.numbers[0], budget.control_filter
    amplitude = math.sqrt(numbers.rated_power)
    asked = min(max(dot(v, newest(budget.reference, v.size)) / amplitude, -LOUDEST), LOUDEST)
    played = min(max(y / amplitude, -LOUDEST), LOUDEST)
    passed, limited = asked * asked, 0.0
    if abs(asked - played) > SAME:
        passed, limited, numbers.acts = 0.0, played * (asked - played), True
    share = 1.0 / min(numbers.taken + 1.0, LIMITER_MEMORY_S * numbers.fs + 1.0)
    numbers.passed += share * (passed - numbers.passed)
    numbers.limited += share * (limited - numbers.limited)


@part()
def move_ceiling(budget, of_x, of_xf, forecast):
    """Move the ceiling to where the limiter takes as much from the noise reduction as more power would add.

    It moves fast at the start and then slowly, so that single bursts do not move it. It falls from the power in use,
    because a ceiling above that has no effect. If the whole estimate fits, it falls only if the limiter acts now: what
    the limiter took from a louder noise says nothing about a quiet one.
    """
    numbers = budget.numbers[0]
    balance, power = balance_of_power(
        of_x, of_xf, numbers.weight, budget.control_filter, numbers.passed, numbers.limited
    )
    if not abs(balance) <= 1.0:
        return
    if balance < 0.0:
        if numbers.weight == 0.0 and not numbers.acts:
            return
        numbers.ceiling = min(numbers.ceiling, power * forecast / numbers.rated_power)
    step = CEILING_RATE * balance * numbers.interval / min(numbers.taken, numbers.averaging * numbers.fs)
    numbers.ceiling = min(max(numbers.ceiling * math.exp(step), TARGET_LEAST), TARGET_MOST)


@part()
def advance_budget(budget, w, x, xf, y):
    """Process a sample of reference, filtered reference and emitted control signal; solve again if it is due."""
    numbers = budget.numbers[0]
    take_correlations(budget, x, xf)
    hear_limiter(budget, y)
    spent = numbers.account + (y * y / numbers.rated_power - 1.0) / numbers.fs
    numbers.account = min(max(spent, -numbers.credit - numbers.chance), numbers.averaging)
    if numbers.weight > 0.0:
        numbers.spent += (y * y / numbers.rated_power - numbers.spent) / (UNSPENT * numbers.averaging * numbers.fs)
    numbers.taken += 1.0
    numbers.waited += 1.0
    # At the start the estimate grows fast, so the interval is an eighth of the time so far.
    if numbers.waited >= min(float(INTERVAL), 1.0 + numbers.taken // 8.0):
        numbers.interval, numbers.waited = numbers.waited, 0.0
        allocate(budget, w)


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
    """Call `take_correlations` from Python."""
    take_correlations(budget, x, xf)


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

    Three things determine :math:`\lambda`:

    - the correlations of reference and filtered reference over a sliding window. The window is usually 1.25 s long,
      0.75 s if the noise has become louder, and 3 s if changes of its level can be due to chance;
    - a forecast of the level. If a straight line through the logarithm of the power differs significantly from a
      constant, its present value replaces the mean of the window;
    - an account of the power spent beyond the rated power, in seconds of rated power. The target is the rated power
      times ``exp(-3 excess / (1 + 6 chance))``. This steers the mean power to the rated one and repays overspending. A
      large debt is repaid evenly within the averaging time, because the error is convex in the power. Half of the rated
      power repays it, or up to 90 % if the debt exceeds a quarter of the averaging time. `chance` is the standard
      deviation, in seconds, that random changes of the noise's level give to the account within a second. It enlarges
      the credit that can be saved, and a credit of up to half of `chance` is left to even out by itself. If more power
      than chance explains was left unspent over about 0.4 of the averaging time, although it could have been used, the
      target rises by up to 30 %.

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
    memory_s : float, default 1.25
        Usual length of the window of the correlations in seconds, at least 10 n_taps samples. A short window is 0.6
        times as long, a long one 2.4 times.
    credit_s : float, default 0.1
        Seconds of rated power that can be saved while the noise needs less.
    averaging_s : float, default 10
        Time in seconds over which the mean power is kept to the rated one, even if the noise suddenly gets louder. Debt
        beyond this many seconds of rated power is forgotten.
    guard : array_like, shape (n_guard,), optional
        Short filter W against an uncertain secondary path, see `paths.guard_filter`: the system above gets a third
        term, :math:`R_{W x'}`, the correlation of the filtered reference after W. By default none.

    Raises
    ------
    ValueError
        A power, rate or time that is not positive and finite, fewer than one tap, a guard with NaN or Inf.

    See Also
    --------
    PowerBudgetKalmanFilter : a filterpy filter with a budget.

    References
    ----------
    M. D. Hebden, "An algorithm for minimization using exact second derivatives", AERE report TP515, 1973, and
    J. J. More, D. C. Sorensen, "Computing a trust region step", SIAM J. Sci. Stat. Comput. 4(3), 1983, for the search
    for lambda. N. Levinson, "The Wiener RMS error criterion in filter design and prediction", J. Math. Phys. 25, 1947.
    A. Goldenshluger, A. Nemirovski, "On spatially adaptive estimation of nonparametric regression", Math. Methods
    Statist. 6, 1997, for the window.

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
        credit_s: float = DEFAULT_CREDIT_S,
        averaging_s: float = DEFAULT_AVERAGING_S,
        guard: Any = None,
    ) -> None:
        n_taps = as_count(n_taps, "n_taps")
        of_guard = correlation_of(guard)
        lags = n_taps + of_guard.size - 1
        rated_power = as_positive(rated_power, "rated_power")
        self.fs = as_positive(fs, "fs", unit="Hz")
        self.memory_s = as_positive(memory_s, "memory_s", unit="s")
        self.credit_s = as_positive(credit_s, "credit_s", unit="s")
        self.averaging_s = as_positive(averaging_s, "averaging_s", unit="s")
        self._state = BudgetState(
            control_filter=np.zeros(n_taps),
            reference=delay_line(lags),
            filtered=delay_line(lags),
            own=np.zeros((2, LONG + 1, lags)),
            across=np.zeros((2, LONG + 1, lags)),
            counts=np.zeros(LONG + 1),
            guard=of_guard,
            numbers=new_record(
                rated_power=rated_power,
                fs=self.fs,
                credit=self.credit_s,
                averaging=self.averaging_s,
                segment=float(max(round(self.memory_s * self.fs / USUAL), lags)),  # samples
                current=0,  # segment that is being filled
                taken=0.0,  # samples since the control was switched on
                waited=0.0,  # of these, since the last solution
                interval=0.0,  # and between the last two
                account=0.0,  # seconds of rated power spent beyond the rated power
                weight=0.0,  # lambda
                span=USUAL,  # segments in the window
                chance=0.0,  # seconds of rated power: std that the scatter of levels gives the account in a second
                ceiling=TARGET_MOST,  # of the target over the rated power, behind a limiter
                passed=0.0,  # recent mean, over the rated power, of what a limiter left as it was
                limited=0.0,  # the same, of y (u - y) for what it changed from u to y
                acts=False,  # whether it changed anything since the last solution
                spent=1.0,  # recent mean share of the rated power spent while the noise needed all of it
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
        """Ceiling of the target power behind a limiter, over the rated power; 3 if no limiter ever acts."""
        return float(self._state.numbers["ceiling"][0])

    @property
    def account_s(self) -> float:
        """Power spent beyond the rated power, in seconds of rated power; negative: credit."""
        return float(self._state.numbers["account"][0])

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
