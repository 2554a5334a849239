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
from ..kernels.delay_lines import delay_line, newest, push
from ..kernels.records import new_record
from ..kernels.vectors import FAST, add_scaled
from .allocation import constrained_filter
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
X, XF = 0, 1  # the reference and the filtered reference, in the correlations
FORECAST_LEAST, FORECAST_MOST = 0.5, 4.0  # change of power that a trend may foretell; see choose_span for the lower


class BudgetState(NamedTuple):
    """What the compiled functions below read and advance."""

    control_filter: np.ndarray  # (L,) v, which makes the control signal
    reference: np.ndarray  # delay line of x
    filtered: np.ndarray  # delay line of x'
    own: np.ndarray  # (2, LONG + 1, L) sums of products of a segment's samples at lags 0 ... L - 1: of x, and of x'
    across: np.ndarray  # (2, LONG + 1, L) the same of its samples with samples before it
    counts: np.ndarray  # (LONG + 1,) samples in each segment
    numbers: np.ndarray  # record: rated power, account, lambda, ...; see `PowerBudget`


@part()
def take_correlations(budget, x, xf):
    """Products of the newest x and x' with those before.

    Those that reach back before the segment are kept apart: for the oldest segment of the window they are left out,
    so that the sum is the correlation of a stretch of signal with zeros around it.
    """
    push(budget.reference, x)
    push(budget.filtered, xf)
    L, numbers = budget.control_filter.size, budget.numbers[0]
    if budget.counts[numbers.current] >= numbers.segment:
        numbers.current = (numbers.current + 1) % len(budget.counts)
        budget.counts[numbers.current] = 0.0
        for signal in (X, XF):
            for k in range(L):
                budget.own[signal, numbers.current, k] = budget.across[signal, numbers.current, k] = 0.0
    current = numbers.current
    budget.counts[current] += 1.0
    own = min(int(budget.counts[current]), L)
    before, filtered_before = newest(budget.reference, L), newest(budget.filtered, L)
    add_scaled(budget.own[X, current], x, before, 0, own)
    add_scaled(budget.own[XF, current], xf, filtered_before, 0, own)
    if own < L:
        add_scaled(budget.across[X, current], x, before, own, L)
        add_scaled(budget.across[XF, current], xf, filtered_before, own, L)


@part()
def choose_span(budget):
    """Set the window: long where the level is the same as of late but for chance, short where it has risen.

    Chance is the scatter of neighbouring segments' powers (von Neumann): bursts, which come and go, are averaged over
    long; of a swelling noise neighbours are alike, and any difference between the means of two windows counts. (A rule
    of intersecting confidence intervals, after Goldenshluger and Nemirovski.) That the noise has become softer is believed
    more slowly than that it has become louder: a pause between bursts is no reason to spend more on the next one.
    """
    numbers = budget.numbers[0]
    numbers.span, numbers.chance = USUAL, 0.0
    usual, variance, _ = _mean_level(budget, USUAL)
    if not usual > SILENCE:
        return
    # Of a segment it is a dozen times that of the mean; at the start, with fewer segments, this errs towards patience.
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
    count, kept, span, current = 0.0, len(budget.counts), budget.numbers[0].span, budget.numbers[0].current
    for k in range(of_x.size):
        of_x[k] = of_xf[k] = 0.0
    for j in range(span + 1):
        i = (current - j) % kept
        add_scaled(of_x, 1.0, budget.own[X, i], 0, of_x.size)
        add_scaled(of_xf, 1.0, budget.own[XF, i], 0, of_x.size)
        if j < span:  # the oldest segment knows nothing before it
            add_scaled(of_x, 1.0, budget.across[X, i], 0, of_x.size)
            add_scaled(of_xf, 1.0, budget.across[XF, i], 0, of_x.size)
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
    mean = 0.0  # of the power along the line, over that at its middle
    for j in range(segments):
        mean += _share(budget, j) / weight * math.exp(slope * (_age(budget, j) - times))
    return min(max(math.exp(-slope * times) / mean, FORECAST_LEAST), FORECAST_MOST)


@part(forceinline=True)
def _share(budget, j):
    """How much of the j-th newest segment is there; the very beginning of one says too little to count."""
    count = budget.counts[(budget.numbers[0].current - j) % len(budget.counts)] / budget.numbers[0].segment
    return count if count >= SHORTEST_PART else 0.0


@part(forceinline=True)
def _age(budget, j):
    """Middle of the j-th newest segment, in segments from now (negative)."""
    newest_part = budget.counts[budget.numbers[0].current] / budget.numbers[0].segment
    return -0.5 * newest_part if j == 0 else -newest_part - j + 0.5


@part(forceinline=True)
def _power(budget, j):
    """Power of x' in the j-th newest segment, of which some is there."""
    i = (budget.numbers[0].current - j) % len(budget.counts)
    return budget.own[XF, i, 0] / budget.counts[i]


@part()
def target_power(budget, forecast):
    """Power to solve for: the rated one, corrected by the account, over what the level is forecast to become.

    Debt is repaid at once, the more patiently the more of it chance makes; of credit, half of what chance makes in a
    second is left to even out by itself: to chase chance would cost noise reduction.
    """
    numbers = budget.numbers[0]
    account, chance = numbers.account, numbers.chance
    excess = account if account > 0.0 else min(account + 0.5 * chance, 0.0)
    share = unspent(numbers) * math.exp(-REPAYMENT / (1.0 + PATIENCE * chance) * excess)
    return numbers.rated_power * min(max(share, TARGET_LEAST), TARGET_MOST) / forecast


@part()
def unspent(numbers):
    """Factor of the target for power that was left of late, beyond what chance makes of a mean over that time.

    Credit that could not be spent in time is lost to the account. For noise that swells that is a part of the power at
    each swell, since falls of the level are believed slowly; the noise's own past tells how large a part.
    """
    left = 1.0 - numbers.spent - numbers.chance / math.sqrt(2.0 * UNSPENT_S)
    return min(1.0 + UNSPENT_GAIN * max(left, 0.0), UNSPENT_MOST)


@compiled()
def allocate(budget, w):
    """Set the control filter for the estimate w."""
    of_x, of_xf = np.empty(budget.control_filter.size), np.empty(budget.control_filter.size)
    choose_span(budget)
    sum_correlations(budget, of_x, of_xf)
    if not of_x[0] > SILENCE:  # nothing was heard: nothing to go by
        return
    power = target_power(budget, level_forecast(budget, of_xf[0]))
    budget.numbers[0].weight = constrained_filter(
        of_x, of_xf, w, power, budget.numbers[0].weight, budget.control_filter
    )


@part()
def advance_budget(budget, w, x, xf, y):
    """Take a sample: reference, filtered reference and emitted control signal; solve anew where it is time to."""
    numbers = budget.numbers[0]
    take_correlations(budget, x, xf)
    spent = numbers.account + (y * y / numbers.rated_power - 1.0) / numbers.fs
    numbers.account = min(max(spent, -numbers.credit - numbers.chance), DEBT_S)
    if numbers.weight > 0.0:
        numbers.spent += (y * y / numbers.rated_power - numbers.spent) / (UNSPENT_S * numbers.fs)
    numbers.taken += 1.0
    numbers.waited += 1.0
    # At the start, when the estimate grows fast, after every eighth part of the time so far.
    if numbers.waited >= min(float(INTERVAL), 1.0 + numbers.taken // 8.0):
        numbers.waited = 0.0
        allocate(budget, w)


@compiled(fastmath=FAST)
def control_sample(budget, x):
    """v' x(n) for a reference sample that the budget has not taken yet."""
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
        self._state = BudgetState(
            control_filter=np.zeros(n_taps),
            reference=delay_line(n_taps),
            filtered=delay_line(n_taps),
            own=np.zeros((2, LONG + 1, n_taps)),
            across=np.zeros((2, LONG + 1, n_taps)),
            counts=np.zeros(LONG + 1),
            numbers=new_record(
                rated_power=rated_power,
                fs=self.fs,
                credit=self.credit_s,
                segment=float(max(round(self.memory_s * self.fs / USUAL), n_taps)),  # samples
                current=0,  # segment that is being filled
                taken=0.0,  # samples since the control was switched on
                waited=0.0,  # of these, since the last solution
                account=0.0,  # seconds of rated power spent beyond what was due
                weight=0.0,  # lambda
                span=USUAL,  # segments in the window
                chance=0.0,  # s of rated power: what the scatter of levels does to the account in a second (std)
                spent=1.0,  # mean share of the rated power spent of late, while the noise needed all of it
            ),
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
    def account_s(self) -> float:
        """Power spent beyond what was due, in seconds of rated power; negative: credit."""
        return float(self._state.numbers["account"][0])

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
        advance_sample(self._state, w, float(reference), float(filtered_reference), y)

    def checked_sample(self, reference: Any, filtered_reference: Any, control_signal: Any = None) -> float:
        """Control signal of a sample that `advance` would take, or the error it would raise."""
        self._sample(filtered_reference, "filtered_reference")
        return (
            self.control_signal(reference) if control_signal is None else self._sample(control_signal, "control_signal")
        )

    def listen(self, reference: float, filtered_reference: float) -> None:
        """Take one sample, `reference` x(n) and `filtered_reference` x'(n), while the control is switched off."""
        sample = self._sample(reference, "reference"), self._sample(filtered_reference, "filtered_reference")
        listen_sample(self._state, *sample)

    @staticmethod
    def _sample(value: Any, name: str) -> float:
        number = as_number(value, name)
        if math.isinf(number * number):
            raise ValueError(f"{name} must have a finite square, got {number:g}")
        return number
