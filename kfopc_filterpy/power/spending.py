"""How much of a rated power to spend now, so that the mean over the averaging time is the rated power.

An output power p reduces the noise best over time if its price, the Lagrange multiplier lambda of the power-constrained
control filter, is the same at all times. For a noise whose spectrum does not change, lambda is constant if the control
filter is, and then p is proportional to the level of the noise. So the law is

    p = u l,

with the level l now, and u such that the noise of the last averaging time T would have used the rated power. A noise
that recurs within T is then controlled as well as by the best fixed filter.

That a noise recurs is a forecast. If it fails, what was spent within the last T, S(n), limits p: no more is spent than
brings S back to T soon. Powers are fractions of the rated power here, and times are in bins, 80 of which make up T.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .._validate import as_positive
from ..kernels.compiling import part
from ..kernels.records import new_record

BINS, FEWEST = 80, 8  # bins in the averaging time; fewer if they would have less than a sample each
NOW = 3  # newest bins, whose mean is the level now; power that is left may be spent within as many
REPAYMENT = 0.25  # of the averaging time, within which overspending is repaid
ALIKE = 0.5  # a level that was at least this share of the present one is taken for the same
LEAST, MOST = 0.1, 2.0  # of the rated power: bounds of the limit that what was spent before sets
LARGEST = 1e200  # a sample's level or power counts as this if it is larger
TOLERANCE = 1e-4  # relative error of u
TRIES = 20


class Spending(NamedTuple):
    """Levels and powers in the averaging time, bin by bin; the bin that is being filled is an extra one."""

    levels: np.ndarray  # (bins + 1,) sums of the level over the samples of a bin
    spent: np.ndarray  # (bins + 1,) sums of the squared control signal over the rated power
    counts: np.ndarray  # (bins + 1,) samples; 0: before the first sample
    numbers: np.ndarray  # record: samples in a full bin, index of the newest one


def new_spending(averaging_samples: float) -> Spending:
    """Return the state before the first sample, as if the rated power had been spent so far."""
    if as_positive(averaging_samples, "averaging_s in samples") < FEWEST:
        raise ValueError(
            f"averaging_s must be at least {FEWEST} samples long, or blocks with several channels, got "
            f"{averaging_samples:g}: lengthen it"
        )
    size = max(math.ceil(averaging_samples / BINS), 1)
    bins = round(averaging_samples / size)
    return Spending(
        np.zeros(bins + 1), np.full(bins + 1, float(size)), np.zeros(bins + 1), new_record(full=float(size), newest=0)
    )


@part()
def book(spending, level, spent):
    """Add a sample's level and what was spent in it."""
    numbers = spending.numbers[0]
    if spending.counts[numbers.newest] >= numbers.full:
        numbers.newest = (numbers.newest + 1) % spending.counts.size
        spending.counts[numbers.newest] = 0.0
    newest = numbers.newest
    if spending.counts[newest] == 0.0:
        spending.levels[newest] = spending.spent[newest] = 0.0
    spending.levels[newest] += min(level, LARGEST)
    spending.spent[newest] += min(spent, LARGEST)
    spending.counts[newest] += 1.0


@part()
def level_of(spending, bins):
    """Return the mean level of the newest bins."""
    total = count = 0.0
    for j in range(bins):
        i = _bin(spending, j)
        total += spending.levels[i]
        count += spending.counts[i]
    return total / max(count, 1.0)


@part()
def power_left(spending):
    """Return T - S, what is left of the averaging time's power; and the mean power of the bins that S loses within T/4."""
    bins, size, filled = _bins(spending), spending.numbers[0].full, _filled(spending)
    first = bins - int(REPAYMENT * bins) + 1
    total = leaving = 0.0
    for j in range(bins + 1):
        share = 1.0 if j < bins else 1.0 - filled  # a part of the oldest bin has left
        spent = share * spending.spent[_bin(spending, j)] / size
        total += spent
        if j >= first:
            leaving += spent
    return bins - total, leaving / (bins - first + 1.0 - filled)


@part()
def unit_power(spending, ceiling, limited):
    """Return u, the power to spend for each unit of level, and what u would be if every bin counted in full.

    u solves ``sum_j a_j min(u l_j, p_j) = sum_j a_j`` over the bins. Newer ones have larger weights a_j, because the
    future is more like them. A bin counts with at most p_j, which is the power that was spent in it, at least MOST and at
    most what can be repaid: a single loud second, or a click, is not to use up the power of the following ones. Behind a
    limiter that acts, p_j is the ceiling, or the rated power if that is less, because the limiter lets no more pass. If
    even all p_j together are below the rated power, u is Inf.
    """
    bins, full = _bins(spending), spending.numbers[0].full
    u, in_full = 0.0, np.inf
    for tried in range(TRIES):
        count = rest = 0.0
        for j in range(bins + 1):
            i, a = _bin(spending, j), _weight(spending, j)
            if limited:
                most = min(ceiling, 1.0) * spending.counts[i]
            else:
                most = max(MOST * spending.counts[i], min(spending.spent[i], REPAYMENT * bins * full))
            count += a * spending.counts[i]
            if u * spending.levels[i] > most:
                count -= a * most
            else:
                rest += a * spending.levels[i]
        if not rest > 0.0:
            return np.inf, in_full
        last, u = u, count / rest
        if tried == 0:  # no bin has reached its p_j yet
            in_full = u
        if not u < np.inf or abs(u - last) <= TOLERANCE * u:
            break
    return u, in_full


@part()
def known(spending, level):
    """Return whether a level as high as this has come and gone within the averaging time, or was there for all of it.

    Only then is the power that it can have known from the past. A noise that has just become louder may stay so.
    """
    gone = False
    for j in range(NOW, _bins(spending)):
        i = _bin(spending, j)
        if spending.counts[i] == 0.0:  # before the first sample
            break
        loud = spending.levels[i] >= ALIKE * level * spending.counts[i]
        if loud and gone:
            return True
        gone = gone or not loud
    return not gone


@part()
def lasting(spending):
    """Return the largest power, at most the rated one, that can last: each averaging time that has begun keeps the mean.

    What was overspent in one is spread over the rest of it, or over T/4 if that is longer.
    """
    bins, left, power = _bins(spending), 0.0, 1.0
    for j in range(bins):
        i = _bin(spending, j)
        if spending.counts[i] == 0.0:  # before the first sample
            break
        left += (spending.counts[i] - spending.spent[i]) / spending.numbers[0].full
        power = min(power, 1.0 + left / max(bins - j, REPAYMENT * bins))
    return power


@part()
def power_to_spend(spending, ceiling, limited):
    """Return the power to spend for each unit of level, and the level now.

    `ceiling` is another bound of the power, and `limited` says whether a limiter acts on the control signal. Behind one,
    power that is left cannot be spent later: the rated power is spent at most. A level that is not known may last, so it
    gets a power that can be kept up.

    If power is left, u is a little larger: what was left will not all be needed.

    Between rare bursts u is large, because the bursts count with their p_j only. When one begins, the mean level of NOW
    bins shows it late. So the newest bin alone has a bound, too: the limit, or what a burst gets if all bins count
    without the bound p_j.
    """
    bins, level, newest = _bins(spending), level_of(spending, NOW), level_of(spending, 1)
    left, leaving = power_left(spending)
    limit = min(leaving, 1.0) + left / (NOW if left > 0.0 else REPAYMENT * bins)
    limit = min(max(limit, LEAST), MOST, ceiling)
    if limited:
        limit = min(limit, 1.0)
    elif not known(spending, level):
        limit = min(limit, max(lasting(spending), LEAST))
    more = 1.0 + max(left, 0.0) / bins
    u, in_full = unit_power(spending, ceiling, limited)
    per_level = more * u
    if level > 0.0:
        per_level = min(per_level, limit / level)
    if newest > 0.0:
        per_level = min(per_level, max(limit / newest, more * in_full))
    return per_level, level


@part(forceinline=True)
def _bins(spending):
    """Return the number of bins in the averaging time."""
    return spending.counts.size - 1


@part(forceinline=True)
def _bin(spending, j):
    """Return the index of the j-th newest bin."""
    return (spending.numbers[0].newest - j) % spending.counts.size


@part(forceinline=True)
def _weight(spending, j):
    """Return the weight of the j-th newest bin."""
    return 1.0 - j / spending.counts.size


@part(forceinline=True)
def _filled(spending):
    """Return the filled part of the newest bin."""
    return spending.counts[spending.numbers[0].newest] / spending.numbers[0].full
