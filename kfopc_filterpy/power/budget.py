"""The power budget: from the unconstrained control filter to the best one within the rated power, sample by sample.

`allocation` solves for the control filter; here stand the three things it has to be told: the correlations of the
recent signals, how loud they are becoming, and what the power spent so far has left to spend.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_count, as_number, as_positive, as_signal
from ..kernels.compiling import compiled, part
from ..kernels.covariance import FAST
from ..kernels.delay_lines import delay_line, newest, push
from .allocation import WORK_ROWS, add_scaled, constrained_filter
from .constraint import DEFAULT_FS, SILENCE

DEFAULT_CORRELATION_MEMORY_S = 1.25
DEFAULT_CREDIT_S = 0.1
SHORT, USUAL, LONG = 6, 10, 24  # whole segments that a window may have; one more is being filled
AGREEMENT = 1.0  # squared difference of two windows' levels over the sum of their variances, above which they differ
DEBT_S = 1.0  # overspending beyond this much of the rated power is forgotten, so that no burst can wind the account up
REPAYMENT = 3.0  # 1/s: what the account holds changes the target by this share of itself
PATIENCE = 6.0  # 1/s: and by less, the more of the account chance makes
LARGEST_CHANCE_S = 0.5
UNSPENT_S = 4.0  # memory of the share that was spent
UNSPENT_GAIN, UNSPENT_MOST = 10.0, 1.3  # what is left of 100 % raises the target by ten times that, 30 % at most
TARGET_LEAST, TARGET_MOST = 0.1, 3.0  # target power over rated power
INTERVAL = 128  # samples between two solutions; fewer at the start
STEADY = 6.0  # a trend counts where it is larger than sqrt(this) times its standard error
SHORTEST_PART = 0.25  # of a segment, for its power to count
FORECAST_LEAST, FORECAST_MOST = 0.5, 4.0  # change of power that a trend may foretell; see choose_span for the lower

# Rows of `correlations`: products of samples of one segment, and with samples before it; of x and of x'.
OWN_X, OWN_XF, ACROSS_X, ACROSS_XF = range(4)
(
    RATED_POWER,
    FS,
    CREDIT,
    SEGMENT,  # samples
    CURRENT,  # segment that is being filled
    TAKEN,  # samples since the control was switched on
    WAITED,  # of these, since the last solution
    ACCOUNT,  # seconds of rated power spent beyond what was due
    WEIGHT,  # lambda
    SPAN,  # segments in the window
    CHANCE,  # seconds of rated power: standard deviation that the scatter of levels gives to the account in a second
    SPENT,  # mean share of the rated power spent of late, of the time when the noise needed all of it
) = range(12)


class BudgetState(NamedTuple):
    """What the compiled functions below read and advance."""

    control_filter: np.ndarray  # (L,) v, which makes the control signal
    reference: np.ndarray  # delay line of x
    filtered: np.ndarray  # delay line of x'
    correlations: np.ndarray  # (LONG + 1, 4, L) sums of products at lags 0 ... L - 1
    counts: np.ndarray  # (LONG + 1,) samples in each segment
    table: np.ndarray  # (12,) numbers named above
    work: np.ndarray  # (WORK_ROWS + 2, L)


@part()
def take_correlations(budget, x, xf):
    """Products of the newest x and x' with those before.

    Those that reach back before the segment are kept apart: for the oldest segment of the window they are left out,
    so that the sum is the correlation of a stretch of signal with zeros around it.
    """
    push(budget.reference, x)
    push(budget.filtered, xf)
    L, table = budget.control_filter.size, budget.table
    current = int(table[CURRENT])
    if budget.counts[current] >= table[SEGMENT]:
        current = (current + 1) % len(budget.counts)
        table[CURRENT], budget.counts[current] = current, 0.0
        oldest = budget.correlations[current]
        for row in range(4):
            for k in range(L):
                oldest[row, k] = 0.0
    budget.counts[current] += 1.0
    own = min(int(budget.counts[current]), L)
    rows = budget.correlations[current]
    before, filtered_before = newest(budget.reference, L), newest(budget.filtered, L)
    add_scaled(rows[OWN_X], x, before, 0, own)
    add_scaled(rows[OWN_XF], xf, filtered_before, 0, own)
    if own < L:
        add_scaled(rows[ACROSS_X], x, before, own, L)
        add_scaled(rows[ACROSS_XF], xf, filtered_before, own, L)


@part()
def choose_span(budget):
    """Set the window: long where the level is the same as of late but for chance, short where it has risen.

    Chance is the scatter of neighbouring segments' powers (von Neumann): bursts, which come and go, are averaged over
    long; of a swelling noise neighbours are alike, and any difference between the means of two windows counts. (A rule
    of intersecting confidence intervals, after Goldenshluger and Nemirovski.) That the noise has become softer is believed
    more slowly than that it has become louder: a pause between bursts is no reason to spend more on the next one.
    """
    table = budget.table
    table[SPAN], table[CHANCE] = USUAL, 0.0
    usual, variance, _ = _mean_level(budget, USUAL)
    if not usual > SILENCE:
        return
    # Of a segment it is a dozen times that of the mean; at the start, with fewer segments, this errs towards patience.
    chance = math.sqrt(2.0 * SHORT * variance * table[SEGMENT] / table[FS])
    table[CHANCE] = min(chance, LARGEST_CHANCE_S)
    short, short_variance, _ = _mean_level(budget, SHORT)
    long, long_variance, segments = _mean_level(budget, LONG)
    if short > usual and math.log(short / usual) ** 2 > AGREEMENT * (short_variance + variance):
        table[SPAN] = SHORT
    elif segments >= 0.8 * LONG and math.log(long / usual) ** 2 <= AGREEMENT * (long_variance + variance):
        table[SPAN] = LONG


@part()
def _mean_level(budget, span):
    """Mean power of x' in the newest segments, its relative variance by chance, and how many they are."""
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
    """First rows of R_x and R_x' over the window, as means."""
    count, kept, span, current = 0.0, len(budget.counts), int(budget.table[SPAN]), int(budget.table[CURRENT])
    for k in range(of_x.size):
        of_x[k] = of_xf[k] = 0.0
    for j in range(span + 1):
        i = (current - j) % kept
        rows = budget.correlations[i]
        add_scaled(of_x, 1.0, rows[OWN_X], 0, of_x.size)
        add_scaled(of_xf, 1.0, rows[OWN_XF], 0, of_x.size)
        if j < span:  # the oldest segment knows nothing before it
            add_scaled(of_x, 1.0, rows[ACROSS_X], 0, of_x.size)
            add_scaled(of_xf, 1.0, rows[ACROSS_XF], 0, of_x.size)
        count += budget.counts[i]
    for k in range(of_x.size):
        of_x[k] /= count
        of_xf[k] /= count


@part()
def level_forecast(budget, mean_power):
    """Power of x' now over its mean in the window, where a trend stands out.

    A straight line through the logarithm of the segments' powers. Its slope is shrunk by what its scatter would make
    of a steady noise (James and Stein), so that bursts, which scatter, are averaged and a swelling noise is followed.
    """
    floor, segments = 1e-12 * mean_power, int(budget.table[SPAN]) + 1
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
    mean = 0.0  # of the power along the line, over that at its middle
    for j in range(segments):
        mean += _share(budget, j) / weight * math.exp(slope * (_age(budget, j) - times))
    return min(max(math.exp(-slope * times) / mean, FORECAST_LEAST), FORECAST_MOST)


@part(forceinline=True)
def _share(budget, j):
    """How much of the j-th newest segment is there; the very beginning of one says too little to count."""
    count = budget.counts[(int(budget.table[CURRENT]) - j) % len(budget.counts)] / budget.table[SEGMENT]
    return count if count >= SHORTEST_PART else 0.0


@part(forceinline=True)
def _age(budget, j):
    """Middle of the j-th newest segment, in segments from now (negative)."""
    newest_part = budget.counts[int(budget.table[CURRENT])] / budget.table[SEGMENT]
    return -0.5 * newest_part if j == 0 else -newest_part - j + 0.5


@part(forceinline=True)
def _power(budget, j):
    """Power of x' in the j-th newest segment, of which some is there."""
    i = (int(budget.table[CURRENT]) - j) % len(budget.counts)
    return budget.correlations[i, OWN_XF, 0] / budget.counts[i]


@part()
def target_power(budget, forecast):
    """Power to solve for: the rated one, corrected by the account, over what the level is forecast to become.

    Debt is repaid at once, the more patiently the more of it chance makes; of credit, half of what chance makes in a
    second is left to even out by itself: to chase chance would cost noise reduction.
    """
    table = budget.table
    account, chance = table[ACCOUNT], table[CHANCE]
    excess = account if account > 0.0 else min(account + 0.5 * chance, 0.0)
    share = unspent(table) * math.exp(-REPAYMENT / (1.0 + PATIENCE * chance) * excess)
    return table[RATED_POWER] * min(max(share, TARGET_LEAST), TARGET_MOST) / forecast


@part()
def unspent(table):
    """Factor of the target for power that was left of late, beyond what chance makes of a mean over that time.

    Credit that could not be spent in time is lost to the account. For noise that swells that is a part of the power at
    each swell, since falls of the level are believed slowly; the noise's own past tells how large a part.
    """
    left = 1.0 - table[SPENT] - table[CHANCE] / math.sqrt(2.0 * UNSPENT_S)
    return min(1.0 + UNSPENT_GAIN * max(left, 0.0), UNSPENT_MOST)


@compiled()
def allocate(budget, w):
    """Set the control filter for the estimate w."""
    of_x, of_xf, work = budget.work[WORK_ROWS], budget.work[WORK_ROWS + 1], budget.work[:WORK_ROWS]
    choose_span(budget)
    sum_correlations(budget, of_x, of_xf)
    if not of_x[0] > SILENCE:  # nothing was heard: nothing to go by
        return
    power = target_power(budget, level_forecast(budget, of_xf[0]))
    budget.table[WEIGHT] = constrained_filter(of_x, of_xf, w, power, budget.table[WEIGHT], work, budget.control_filter)


@part()
def advance_budget(budget, w, x, xf, y):
    """Take a sample: reference, filtered reference and emitted control signal; solve anew where it is time to."""
    table = budget.table
    take_correlations(budget, x, xf)
    spent = table[ACCOUNT] + (y * y / table[RATED_POWER] - 1.0) / table[FS]
    table[ACCOUNT] = min(max(spent, -table[CREDIT] - table[CHANCE]), DEBT_S)
    if table[WEIGHT] > 0.0:
        table[SPENT] += (y * y / table[RATED_POWER] - table[SPENT]) / (UNSPENT_S * table[FS])
    table[TAKEN] += 1.0
    table[WAITED] += 1.0
    # At the start, when the estimate grows fast, after every eighth part of the time so far.
    if table[WAITED] >= min(float(INTERVAL), 1.0 + table[TAKEN] // 8.0):
        table[WAITED] = 0.0
        allocate(budget, w)


@part(fastmath=FAST)
def control_sample(budget, x):
    """v' x(n) for a reference sample that the budget has not taken yet."""
    v, before = budget.control_filter, newest(budget.reference, budget.control_filter.size)
    total = v[0] * x
    for k in range(1, v.size):
        total += v[k] * before[k - 1]
    return total


class PowerBudget:
    r"""Best use of a rated power: the control filter for an estimate of the unconstrained one.

    An adaptive filter estimates the control filter w that would be best without a limit; every few milliseconds the
    budget finds the one that is best within the power,

    .. math:: (R_{x'} + \lambda R_x) v = R_{x'} \hat w, \qquad v^T R_x v = \rho

    which minimises :math:`E[e^2]` subject to :math:`E[y^2] \le \rho`: for any :math:`v`,
    :math:`E[e^2] = E[e^2]_{min} + (v - w)^T R_{x'} (v - w)`, so that w is all the disturbance has to say, and its
    conditional mean may stand in its place (certainty equivalence: the error is quadratic in w). The
    constraint never enters the estimate. What it would have to forget when the level changes, it never learnt.

    Three things decide :math:`\lambda`:

    - the correlations of reference and filtered reference over a sliding window that forgets completely: 1.25 s long,
      0.75 s where the noise has become louder, 3 s where its level is the same but for chance;
    - how loud the signal is becoming: where a straight line through the logarithm of the power stands out of its
      scatter, the level it leads to now takes the place of the window's mean;
    - an account of the power spent beyond what was due, in seconds of rated power: the target is the rated power times
      ``exp(-3 excess / (1 + 6 chance))``. It steers the mean power to the rated one, and repays what a surprise has
      overspent, up to a second of rated power. `chance` is the standard deviation in seconds that the scatter of the noise's level gives
      to the account within a second; it adds to the credit, half of which it lets be. Power that was left unspent over some
      four seconds while there was use for it, beyond what chance makes of that, raises the target by up to 30 %.

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter.
    rated_power : float
        Rated output power (mean square of the control signal).
    fs : float, default 16000
        Sample rate in Hz.
    memory_s : float, default 1.25
        Usual length of the window of the correlations in seconds (0.6 and 2.4 times it where it is short or long); at
        least 10 n_taps samples are taken.
    credit_s : float, default 0.1
        Seconds of rated power that may be saved up while the noise needs less.

    Raises
    ------
    ValueError
        A power, rate or time that is not positive and finite, fewer than one tap.

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
    ) -> None:
        n_taps = as_count(n_taps, "n_taps")
        rated_power = as_positive(rated_power, "rated_power")
        self.fs = as_positive(fs, "fs", unit="Hz")
        self.memory_s = as_positive(memory_s, "memory_s", unit="s")
        self.credit_s = as_positive(credit_s, "credit_s", unit="s")
        table = np.zeros(12)
        table[SPENT] = 1.0
        table[RATED_POWER], table[FS], table[CREDIT] = rated_power, self.fs, self.credit_s
        table[SEGMENT] = max(round(self.memory_s * self.fs / USUAL), n_taps)
        table[SPAN] = USUAL
        self._state = BudgetState(
            control_filter=np.zeros(n_taps),
            reference=delay_line(n_taps),
            filtered=delay_line(n_taps),
            correlations=np.zeros((LONG + 1, 4, n_taps)),
            counts=np.zeros(LONG + 1),
            table=table,
            work=np.zeros((WORK_ROWS + 2, n_taps)),
        )

    @property
    def state(self) -> BudgetState:
        """Arrays that the compiled loop advances."""
        return self._state

    @property
    def n_taps(self) -> int:
        """Taps of the control filter."""
        return self._state.control_filter.size

    @property
    def rated_power(self) -> float:
        """Rated output power; can be assigned."""
        return float(self._state.table[RATED_POWER])

    @rated_power.setter
    def rated_power(self, value: float) -> None:
        self._state.table[RATED_POWER] = as_positive(value, "rated_power")

    @property
    def control_filter(self) -> np.ndarray:
        """Control filter v, (L,), newest-sample tap first, zero before the first sample; a copy."""
        return self._state.control_filter.copy()

    @property
    def power_weight(self) -> float:
        """Weight lambda of the control power; 0: the estimate fits the budget as it is, Inf: it was scaled to fit."""
        return float(self._state.table[WEIGHT])

    @property
    def account_s(self) -> float:
        """Power spent beyond what was due, in seconds of rated power; negative: credit."""
        return float(self._state.table[ACCOUNT])

    def control_signal(self, reference: float) -> float:
        """Control signal y(n) for the reference x(n); call it before `advance` with the same x(n)."""
        return float(control_sample(self._state, self._sample(reference, "reference")))

    def advance(
        self, reference: float, filtered_reference: float, weights: Any, control_signal: float | None = None
    ) -> None:
        """Take one sample, and solve for the control filter where it is time to.

        Parameters
        ----------
        reference, filtered_reference : float
            Newest reference x(n) and filtered reference x'(n).
        weights : array_like
            (L,) estimate of the unconstrained control filter.
        control_signal : float, optional
            What was emitted, where it is not `control_signal` of the same reference: after a limiter, say.

        Raises
        ------
        ValueError
            NaN, Inf, a sample whose square overflows, weights of another length. Nothing was changed.
        """
        w = as_signal(weights, "weights", length=self.n_taps)
        y = self.checked_sample(reference, filtered_reference, control_signal)
        advance_budget(self._state, w, float(reference), float(filtered_reference), y)

    def checked_sample(self, reference: Any, filtered_reference: Any, control_signal: Any = None) -> float:
        """Control signal of a sample that `advance` would take, or the error it would raise."""
        self._sample(filtered_reference, "filtered_reference")
        return (
            self.control_signal(reference) if control_signal is None else self._sample(control_signal, "control_signal")
        )

    def listen(self, reference: float, filtered_reference: float) -> None:
        """Take one sample, `reference` x(n) and `filtered_reference` x'(n), while the control is switched off."""
        sample = self._sample(reference, "reference"), self._sample(filtered_reference, "filtered_reference")
        take_correlations(self._state, *sample)

    @staticmethod
    def _sample(value: Any, name: str) -> float:
        number = as_number(value, name)
        if math.isinf(number * number):
            raise ValueError(f"{name} must have a finite square, got {number:g}")
        return number
