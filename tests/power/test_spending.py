"""How much power to spend: bins, power for a unit of level, and bounds against definitions written out from the samples."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.compiled import from_python
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import brentq

from kfopc_filterpy.power import spending as parts
from kfopc_filterpy.power.spending import (
    ALIKE,
    BINS,
    FEWEST,
    LEAST,
    MOST,
    NOW,
    REPAYMENT,
    TOLERANCE,
    Spending,
    new_spending,
)

book, known, level_of, lasting = map(from_python, (parts.book, parts.known, parts.level_of, parts.lasting))
power_left, power_to_spend, unit_power = map(from_python, (parts.power_left, parts.power_to_spend, parts.unit_power))

SIZE = 4  # samples in a bin
REPAID = REPAYMENT * BINS


def booked(levels: object, spent: object = 1.0) -> Spending:
    """The state after samples of these levels and powers."""
    state = new_spending(SIZE * BINS)
    for level, power in np.broadcast(levels, spent):
        book(state, float(level), float(power))
    return state


def by_bins(values: np.ndarray) -> list[np.ndarray]:
    """The samples of each bin, the newest first, of the averaging time and the bin that is being filled."""
    return [values[i : i + SIZE] for i in range(0, values.size, SIZE)][::-1][: BINS + 1]


def in_bins(levels: list[float]) -> np.ndarray:
    return np.repeat(levels, SIZE).astype(float)


LEVELS = st.lists(st.sampled_from([0.0, 0.01, 0.4, 1.0, 1.0, 2.5, 30.0]), min_size=1, max_size=2 * BINS)


# ---- The bins


@given(levels=LEVELS, part=st.integers(1, SIZE), seed=st.integers(0, 99))
def test_what_is_left_is_what_was_not_spent_in_the_averaging_time(levels: list, part: int, seed: int) -> None:
    """Before the first sample the rated power was spent. A bin that has partly left counts in part. To rounding."""
    samples = in_bins(levels)[: SIZE * (len(levels) - 1) + part] * np.random.default_rng(seed).random()
    bins = by_bins(np.append(np.ones(2 * BINS * SIZE), samples))
    spent = np.array([one.sum() / SIZE for one in bins])
    spent[-1] *= 1.0 - bins[0].size / SIZE
    left, leaving = power_left(booked(1.0, samples))
    assert left == pytest.approx(BINS - spent.sum(), abs=1e-9)
    oldest = spent[-round(REPAID) :]
    assert leaving == pytest.approx(oldest.sum() / (REPAID - bins[0].size / SIZE), abs=1e-9)


@given(levels=LEVELS, part=st.integers(1, SIZE), bins=st.sampled_from([1, NOW]))
def test_the_level_of_the_newest_bins_is_the_mean_of_their_samples(levels: list, part: int, bins: int) -> None:
    samples = in_bins(levels)[: SIZE * (len(levels) - 1) + part]
    newest = np.concatenate(by_bins(samples)[:bins])
    assert level_of(booked(samples), bins) == pytest.approx(newest.mean(), rel=1e-12)


def test_a_sample_that_has_left_is_as_if_it_had_never_been() -> None:
    """Bit for bit."""
    rng = np.random.default_rng(1)
    levels, spent = rng.random((2, (BINS + 1) * SIZE))
    old = booked(np.append(1e30 * np.ones(500), levels), np.append(1e20 * np.ones(500), spent))
    fresh = booked(levels, spent)
    assert power_left(old) == power_left(fresh)
    assert power_to_spend(old, MOST, False) == power_to_spend(fresh, MOST, False)


@pytest.mark.parametrize(
    ("samples", "expected"), [(160000, 80), (312.5, 78), (125, 62), (79, 79), (10, 10), (8.4, 8), (8, 8)]
)
def test_the_bins_make_up_the_averaging_time(samples: float, expected: int) -> None:
    state = new_spending(samples)
    assert state.counts.size == expected + 1
    assert expected * state.numbers["full"][0] == pytest.approx(samples, rel=0.05)


@pytest.mark.parametrize("samples", [7.9, 1.0, 1e-9])
def test_an_averaging_time_of_a_few_samples_is_refused(samples: float) -> None:
    with pytest.raises(ValueError, match=f"averaging_s must be at least {FEWEST} samples long.*got {samples:g}"):
        new_spending(samples)


def test_few_bins_do_as_well() -> None:
    state = new_spending(10)
    rng = np.random.default_rng(3)
    spent = []
    for level in rng.uniform(0.5, 1.5, 1000):
        book(state, level, spent[-1] if spent else 1.0)
        per_level, now = power_to_spend(state, MOST, False)
        spent.append(per_level * now)
    assert np.mean(spent) == pytest.approx(1.0, abs=0.05)


# ---- The power for a unit of level


def unit_power_written_out(levels: np.ndarray, spent: np.ndarray, bound: float | None = None) -> tuple[float, float]:
    """The root of sum a (min(u l, p) - 1), by Brent's method; and that of sum a (u l - 1)."""
    of_level, of_spent = by_bins(levels), by_bins(spent)
    counts = np.array([part.size for part in of_level])
    weights = (1.0 - np.arange(counts.size) / (BINS + 1.0)) * counts
    level = np.array([part.mean() for part in of_level])
    most = np.array(
        [max(MOST, min(part.mean(), REPAID * SIZE / part.size)) if bound is None else bound for part in of_spent]
    )

    def beyond(u: float) -> float:
        return float(weights @ (np.minimum(u * level, most) - 1.0))

    in_full = weights.sum() / (weights @ level) if np.any(level) else math.inf
    high = np.max(most / np.where(level > 0.0, level, np.inf))
    if not high > 0.0 or beyond(high) <= 1e-9 * weights.sum():
        return math.inf, in_full
    return brentq(beyond, 0.0, high, xtol=1e-300, rtol=1e-12), in_full


@given(
    levels=LEVELS,
    part=st.integers(1, SIZE),
    spent=st.sampled_from([0.0, 1.0, 5.0]),
    bound=st.sampled_from([None, 0.3, 1.0]),
)
def test_with_it_the_recent_noise_uses_the_rated_power(
    levels: list, part: int, spent: float, bound: float | None
) -> None:
    """To the tolerance of its search, which adds up over the few steps."""
    samples = in_bins(levels)[: SIZE * (len(levels) - 1) + part]
    powers = spent * np.random.default_rng(2).random(samples.size)
    expected, expected_in_full = unit_power_written_out(samples, powers, bound)
    ceiling, limited = (MOST, False) if bound is None else (bound, True)
    got, in_full = unit_power(booked(samples, powers), ceiling, limited)
    assert in_full == pytest.approx(expected_in_full, rel=1e-12)
    assume(math.isfinite(expected) or math.isinf(got))  # all bins at their bounds, to rounding
    assert got == pytest.approx(expected, rel=20 * TOLERANCE)


def test_a_noise_that_recurs_gets_power_in_proportion_to_its_level() -> None:
    """Loud and soft in turn: the mean over both is the rated power."""
    levels = np.tile(in_bins([1.5] * 5 + [0.5] * 5), 20)
    u, in_full = unit_power(booked(levels), MOST, False)
    assert u == in_full == pytest.approx(1.0, rel=0.04)  # newer bins have larger weights


@pytest.mark.parametrize("loud", [10.0, 1e3, 1e6])
def test_a_loud_stretch_leaves_power_for_the_rest(loud: float) -> None:
    """An eighth of the averaging time, however loud, counts with twice the rated power."""
    levels = in_bins([1.0] * 35 + [loud] * 10 + [1.0] * 35)
    u, _ = unit_power(booked(levels), MOST, False)
    assert u == pytest.approx((80 - 2 * 10) / 70, rel=0.02)


def test_silence_has_none() -> None:
    assert unit_power(booked(np.zeros(100)), MOST, False) == (math.inf, math.inf)
    assert unit_power(new_spending(100), MOST, False) == (math.inf, math.inf)
    per_level, level = power_to_spend(booked(np.zeros(100)), MOST, False)
    assert (per_level, level) == (math.inf, 0.0)


# ---- What is known


@pytest.mark.parametrize(
    ("levels", "expected"),
    [
        ([1.0] * 100, True),  # as loud all the time
        ([1.0] * 70, True),  # and since the first sample
        ([0.1] * 60 + [1.0] * 30, False),  # has become louder
        ([1.0] * 60 + [0.1] * 30, True),  # has become softer: it was as loud as this all the time
        ([0.1] * 40 + [1.0] * 10 + [0.1] * 20 + [1.0] * 10, True),  # has come and gone
        ([0.1] * 40 + [0.9 * ALIKE] * 10 + [0.1] * 20 + [1.0] * 10, False),  # that was softer
        ([0.1] * 40 + [1.1 * ALIKE] * 10 + [0.1] * 20 + [1.0] * 10, True),
        ([1.0] * 10 + [0.1] * 90 + [1.0] * 10, False),  # it is too long ago
        ([0.1] * 90 + [1.0, 0.1, 1.0], False),  # the newest bins do not count
    ],
)
def test_a_level_is_known_if_it_has_come_and_gone_or_lasted(levels: list, expected: bool) -> None:
    state = booked(in_bins(levels))
    assert known(state, level_of(state, NOW)) == expected


# ---- The power to spend


def to_spend(levels: object, spent: object = 1.0, ceiling: float = MOST, limited: bool = False) -> float:
    """The power now."""
    per_level, level = power_to_spend(booked(levels, spent), ceiling, limited)
    return per_level * level


def test_steady_noise_gets_the_rated_power() -> None:
    assert to_spend(np.ones(100 * SIZE)) == pytest.approx(1.0, rel=1e-9)
    assert to_spend(np.ones(10)) == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("gain", [2.5, 10.0, 1e4])
def test_noise_that_has_just_become_louder_gets_the_rated_power_at_most(gain: float) -> None:
    """Even if power is left."""
    levels = in_bins([1.0] * 90 + [gain] * 6)
    assert to_spend(levels) == pytest.approx(1.0, rel=1e-9)
    assert to_spend(levels, 0.5) == pytest.approx(1.0, rel=1e-9)


def test_a_level_that_is_not_known_gets_what_can_last() -> None:
    """What the jump overspent is spread over the rest of the averaging time that began with it."""
    quiet, loud = [1.0] * 90, [100.0] * 20
    spent = np.ones(SIZE * 110)
    spent[: SIZE * 90] = 0.3
    spent[SIZE * 90 : SIZE * 91] += 8.0
    assert to_spend(in_bins(quiet + loud), spent) == pytest.approx(1.0 - 8.0 / (BINS - 19), rel=1e-9)


@given(
    powers=st.lists(st.sampled_from([0.0, 0.5, 0.9, 1.0, 1.1, 3.0]), min_size=1, max_size=3 * BINS),
    part=st.integers(1, SIZE),
)
def test_what_can_last_keeps_the_mean_of_every_averaging_time_that_has_begun(powers: list, part: int) -> None:
    """If it is spent until the end of that time, or for a quarter of it if that is longer. Against sums of samples."""
    spent = in_bins(powers)[: SIZE * (len(powers) - 1) + part]
    lasts = lasting(booked(1.0, spent))
    overspent = np.cumsum([one.sum() - one.size for one in by_bins(spent)])[:BINS] / SIZE
    bounds = [1.0 - over / max(BINS - age, REPAID) for age, over in enumerate(overspent)]
    assert lasts == pytest.approx(min([1.0, *bounds]), rel=1e-9, abs=1e-9)


def test_a_known_level_gets_what_is_left_within_the_newest_bins_time() -> None:
    levels = in_bins(([0.1] * 10 + [2.0] * 10) * 5)
    spent = np.where(levels > 1.0, 1.9, 0.0999)
    left, leaving = power_left(booked(levels, spent))
    assert left > 0.0
    power = to_spend(levels, spent)
    assert power == pytest.approx(min(leaving, 1.0) + left / NOW, rel=1e-9)
    assert power < to_spend(levels, 0.99 * spent) < MOST


@pytest.mark.parametrize(("beyond", "expected"), [(4.0, 0.8), (10.0, 0.5), (17.0, 0.15), (30.0, LEAST), (400.0, LEAST)])
def test_what_was_overspent_is_repaid_within_a_quarter_of_the_averaging_time(beyond: float, expected: float) -> None:
    """`beyond` in bins of rated power."""
    spent = np.ones(100 * SIZE)
    spent[-SIZE:] += beyond
    assert to_spend(np.ones(100 * SIZE), spent) == pytest.approx(expected, rel=1e-9)


def test_power_that_is_left_raises_it_a_little() -> None:
    """Noise that has become softer, and so has used half of the power: half as much again."""
    levels = in_bins([4.0] * 40 + [1.0] * 40)
    spent = np.where(levels > 1.0, 0.8, 0.2)
    per_level, _ = power_to_spend(booked(levels, spent), MOST, False)
    u, _ = unit_power(booked(levels, spent), MOST, False)
    assert per_level == pytest.approx(1.5 * u, rel=1e-9)


# ---- A burst begins


def bursts(length: int, gap: int) -> np.ndarray:
    """Bursts of level 1 after near silence; a sample of the next one at the end."""
    return np.append(in_bins(([1e-4] * gap + [1.0] * length) * 6 + [1e-4] * gap), 1.0)


@pytest.mark.parametrize(("length", "gap", "expected"), [(1, 9, 10.0), (2, 8, 5.0), (4, 16, 5.0)])
def test_a_burst_begins_with_what_it_gets_if_all_count_in_full(length: int, gap: int, expected: float) -> None:
    """A burst in a tenth of the time gets ten times the rated power, and not what u would give; to the weights."""
    levels = bursts(length, gap)
    state = booked(levels, np.minimum(levels, 1.0))
    per_level, _ = power_to_spend(state, MOST, False)
    left, _ = power_left(state)
    assert per_level == pytest.approx(expected * (1.0 + left / BINS), rel=0.25)
    u, _ = unit_power(state, MOST, False)
    assert u > 100.0 * per_level


def test_the_beginning_of_a_burst_gets_at_least_the_limit() -> None:
    """Here it would get 1.2 times the rated power if all counted in full, but so much power is left that it gets 2."""
    levels = np.append(in_bins(([0.2] * 6 + [1.0] * 4) * 16 + [0.2] * 6), [1.0] * SIZE)
    state = booked(levels, 0.3)
    per_level, level = power_to_spend(state, MOST, False)
    _, in_full = unit_power(state, MOST, False)
    assert in_full < MOST < per_level * 1.001
    assert per_level * level < MOST


def test_what_will_leave_counts_as_the_rated_power_at_most() -> None:
    """Overspending that is about to leave the averaging time is no reason to overspend again."""
    levels = in_bins([1.0] * BINS)
    spent = np.repeat([1.5] * 20 + [0.95] * 60, SIZE)
    left, leaving = power_left(booked(levels, spent))
    assert leaving > 1.3
    assert -8.0 < left < 0.0
    assert to_spend(levels, spent) == pytest.approx(1.0 + left / REPAID, rel=1e-9)


def test_after_a_jump_that_overspent_by_more_than_the_averaging_time_a_little_is_left_to_spend() -> None:
    spent = np.ones(SIZE * 110)
    spent[SIZE * 90 : SIZE * 91] += 3.0 * BINS
    assert to_spend(in_bins([1.0] * 90 + [100.0] * 20), spent) == pytest.approx(LEAST, rel=1e-9)


@pytest.mark.parametrize("click", [1e2, 1e4, 1e8])
def test_a_click_leaves_power_for_the_steady_noise_after_it(click: float) -> None:
    """However much was spent in its sample: never below the least power."""
    levels, spent = np.ones(100 * SIZE), np.ones(100 * SIZE)
    levels[60 * SIZE] = spent[60 * SIZE] = click
    assert to_spend(levels, spent) * (1 + 1e-9) >= LEAST


@pytest.mark.parametrize("ceiling", [1.3, MOST])
def test_behind_a_limiter_no_more_than_the_rated_power_is_spent(ceiling: float) -> None:
    levels = in_bins(([0.1] * 10 + [2.0] * 10) * 5)
    assert to_spend(levels, 0.5, ceiling, False) > 1.2
    assert to_spend(levels, 0.5, ceiling, True) == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("ceiling", [0.3, 0.9])
def test_behind_a_limiter_the_ceiling_bounds_the_power_and_counts_for_the_bins(ceiling: float) -> None:
    """No more could be used in any bin, so that this is used in all."""
    levels = in_bins(([0.5] * 5 + [1.5] * 5) * 10)
    assert to_spend(levels, 0.5, ceiling, True) == pytest.approx(ceiling, rel=1e-9)
    soft = levels[: -5 * SIZE]
    assert to_spend(soft, 0.5, ceiling, True) == pytest.approx(ceiling, rel=1e-9)
    assert to_spend(soft, 0.5, ceiling, False) < to_spend(levels, 0.5, MOST, False)


@given(levels=LEVELS, spent=LEVELS, ceiling=st.floats(LEAST, MOST), limited=st.booleans())
def test_the_power_is_within_its_bounds(levels: list, spent: list, ceiling: float, limited: bool) -> None:
    size = min(len(levels), len(spent))
    state = booked(in_bins(levels[:size]), in_bins(spent[:size]))
    per_level, level = power_to_spend(state, ceiling, limited)
    assert per_level > 0.0
    if level > 0.0:
        assert per_level * level <= min(ceiling, MOST) * (1 + 1e-12)
        if not known(state, level):
            assert per_level * level <= 1.0 + 1e-12
