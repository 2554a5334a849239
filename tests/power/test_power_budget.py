"""The power budget: its windows, forecast and account against definitions written out, and what it settles to.

A Kalman filter of no variance keeps its estimate for good: with one the budget runs on a known estimate at compiled
speed (`of_known_estimate`), where it is not driven sample by sample.
"""

from __future__ import annotations

import copy
import math
import pickle

import numpy as np
import pytest
import scipy.linalg
from helpers.comparing import numbers_of
from helpers.compiled import from_python
from helpers.naming import plain
from hypothesis import given
from hypothesis import strategies as st

from kfopc_filterpy import SimulationResult, kf_pb, simulate
from kfopc_filterpy.controllers import PowerBudgetController
from kfopc_filterpy.power import PowerBudget
from kfopc_filterpy.power import budget as parts
from kfopc_filterpy.power.allocation import POWER_TOLERANCE, RIDGE
from kfopc_filterpy.power.budget import (
    AGREEMENT,
    DEFAULT_AVERAGING_S,
    DEFAULT_CREDIT_S,
    FORECAST_LEAST,
    FORECAST_MOST,
    INTERVAL,
    LARGEST_CHANCE_S,
    LONG,
    PACE,
    PATIENCE,
    REPAYMENT,
    SHORT,
    SHORTEST_PART,
    STEADY,
    TARGET_LEAST,
    TARGET_MOST,
    USUAL,
)
from kfopc_filterpy.signals import band_limited_noise, swelling, tone

choose_span, level_forecast = from_python(parts.choose_span), from_python(parts.level_forecast)
sum_correlations, target_power = from_python(parts.sum_correlations), from_python(parts.target_power)

FS = 16000
SEGMENT = 100
SPANS = [SHORT, USUAL, LONG]
S = np.array([0.0, 0.5, 0.3, -0.1])
W = np.random.default_rng(0).standard_normal(16) / 4.0


def made(n_taps: int = 3, rated_power: float = 1.0, segment: int = SEGMENT, **options: float) -> PowerBudget:
    """A budget at 1 kHz whose usual window has ten segments of `segment` samples, and the one that is being filled."""
    return PowerBudget(n_taps, rated_power, fs=1000.0, memory_s=10 * segment / 1000.0, **options)


def correlations(budget: PowerBudget, span: int | None = None) -> np.ndarray:
    """First rows of R_x and R_x', (2, L), over a window of `span` segments or the one that is chosen."""
    if span is not None:
        budget.state.numbers["span"] = span
    rows = np.full((2, budget.n_taps), np.nan)
    sum_correlations(budget.state, *rows)
    return rows


def stretch(n: int, segment: int = SEGMENT, span: int = USUAL) -> slice:
    """Samples in the window after n samples: `span` whole segments, and a part or the whole of another."""
    return slice(max(n - span * segment - (n - 1) % segment - 1, 0), n)


def correlation(signal: np.ndarray, n_taps: int) -> np.ndarray:
    """Of a stretch of signal with zeros around it, by definition."""
    padded = np.append(signal, np.zeros(n_taps))
    return np.array([padded[k:] @ padded[: padded.size - k] for k in range(n_taps)]) / signal.size


# ---- The window


def test_the_windows_of_the_defaults() -> None:
    """As documented: 0.75 s, 1.25 s or 3 s, in eighths of a second; never shorter segments than the taps."""
    assert [span * PowerBudget(4, 1.0).state.counts.size for span in SPANS] == [150, 250, 600]
    for fs in (8000.0, 16000.0):
        budget = PowerBudget(4, 1.0, fs=fs)
        for _ in range(round(fs / 8)):
            budget.listen(1.0, 1.0)
        assert budget.state.counts[:2].tolist() == [fs / 8, 0.0]
        budget.listen(1.0, 1.0)
        assert budget.state.counts[:2].tolist() == [fs / 8, 1.0]
    assert (budget.memory_s, budget.credit_s, budget.state.numbers["span"][0]) == (1.25, 0.1, USUAL)


@pytest.mark.parametrize(("n_taps", "segment", "asked"), [(1, 7, 7), (4, 9, 9), (12, 30, 30), (12, 12, 3)])
def test_the_correlations_are_those_of_the_stretch_with_zeros_around_it(n_taps: int, segment: int, asked: int) -> None:
    """To the rounding of sums of 750 products at most, in another order. A segment has the taps' length at least."""
    budget = made(n_taps, segment=asked)
    x, xf = np.random.default_rng(1).standard_normal((2, 2 * (LONG + 1) * segment + 3))
    for n in range(1, x.size + 1):
        budget.listen(x[n - 1], xf[n - 1])
        for span in SPANS:
            for got, signal in zip(correlations(budget, span), (x, xf), strict=True):
                expected = correlation(signal[stretch(n, segment, span)], n_taps)
                np.testing.assert_allclose(got, expected, rtol=0, atol=2e-14 * expected[0])


@given(
    levels=st.lists(st.sampled_from([0.0, 1e-3, 1.0, 1e3]), min_size=1, max_size=40),
    frequency=st.floats(0.0, math.pi),
    noise=st.sampled_from([0.0, 1e-6, 1.0]),
)
def test_the_correlations_are_positive_semidefinite(levels: list[float], frequency: float, noise: float) -> None:
    """Whatever the signal does: tones, steps, silence. To 1e-14 of the largest eigenvalue, the rounding of the sums."""
    budget = made(8, segment=8)
    x = np.repeat(levels, 7)
    x *= np.cos(frequency * np.arange(x.size)) + noise * np.random.default_rng(2).standard_normal(x.size)
    for value in x:
        budget.listen(value, 0.5 * value)
    for span in SPANS:
        for row in correlations(budget, span):
            eigenvalues = np.linalg.eigvalsh(scipy.linalg.toeplitz(row))
            assert eigenvalues[0] >= -1e-14 * eigenvalues[-1]


def test_what_has_left_the_window_is_as_if_it_had_never_been() -> None:
    """Bit for bit: sums of segments only, and nothing is ever taken off. A past 600 dB louder leaves no rounding."""
    old, fresh = made(5), made(5)
    rng = np.random.default_rng(3)
    for value in 1e30 * rng.standard_normal((LONG + 1) * SEGMENT):
        old.listen(value, 2.0 * value)
    for n, (x, xf) in enumerate(rng.standard_normal(((LONG + 10) * SEGMENT, 2)), start=1):
        for budget in (old, fresh):
            budget.listen(x, xf)
        for span in SPANS:
            if n > span * SEGMENT and n % 17 == 0:
                np.testing.assert_array_equal(correlations(old, span), correlations(fresh, span))
                assert level_forecast(old.state, 1.0) == level_forecast(fresh.state, 1.0)
            if n == span * SEGMENT:
                assert correlations(old, span)[0, 0] > 1e50  # so far it was there
            if n == span * SEGMENT + 1:  # and a bit later no more
                np.testing.assert_array_equal(correlations(old, span), correlations(fresh, span))
        if n > USUAL * SEGMENT and n % 17 == 0:
            chosen = [span_and_chance(budget) for budget in (old, fresh)]
            if n > LONG * SEGMENT:
                assert chosen[0] == chosen[1]
            else:
                assert chosen[0] == (min(chosen[1][0], USUAL), chosen[1][1])  # not the window in which the past is
    for _ in range((LONG + 1) * SEGMENT):
        old.listen(0.0, 0.0)
    for span in SPANS:
        np.testing.assert_array_equal(correlations(old, span), 0.0)


# ---- Which of the windows


def span_and_chance(budget: PowerBudget) -> tuple[int, float]:
    choose_span(budget.state)
    return int(budget.state.numbers["span"][0]), float(budget.state.numbers["chance"][0])


def level_written_out(xf: np.ndarray, segment: int, span: int) -> tuple[float, float, float]:
    """Mean power of the newest segments, its relative variance from neighbours' differences, how many segments."""
    heard = xf[stretch(xf.size, segment, span)]
    parts = np.split(heard, np.arange(segment, heard.size, segment))
    there = np.array([part.size for part in parts]) / segment
    counted = there >= SHORTEST_PART
    powers, shares = np.array([np.mean(part**2) for part in parts])[counted], there[counted]
    if not np.any(powers):
        return 0.0, 0.0, 0.0
    mean, number = np.average(powers, weights=shares), shares.sum()
    of_one = np.mean(np.diff(powers) ** 2) / 2 if powers.size > 1 else 0.0  # von Neumann: the variance of a segment's
    return mean, of_one / mean**2 / max(number, 1.0), number


def chosen_written_out(xf: np.ndarray, segment: int, fs: float = 1000.0) -> tuple[int, float]:
    """Span and chance."""
    (short, of_short, _), (usual, of_usual, _), (long, of_long, number) = (
        level_written_out(xf, segment, span) for span in SPANS
    )
    if usual == 0.0:
        return USUAL, 0.0
    chance = min(math.sqrt(2 * SHORT * of_usual * segment / fs), LARGEST_CHANCE_S)
    if short > usual and math.log(short / usual) ** 2 > AGREEMENT * (of_short + of_usual):
        return SHORT, chance
    if number >= 0.8 * LONG and math.log(long / usual) ** 2 <= AGREEMENT * (of_long + of_usual):
        return LONG, chance
    return USUAL, chance


def heard(xf: np.ndarray, segment: int = SEGMENT, span: int = USUAL) -> PowerBudget:
    """A budget of one tap that has heard xf, with the window set by hand."""
    budget = made(1, segment=segment)
    for value in xf:
        budget.listen(0.3 * value, value)
    budget.state.numbers["span"] = span
    return budget


@given(
    steps=st.lists(st.sampled_from([0.0, 0.0, 0.0, 0.02, 0.5, 2.0, 10.0, 0.0]), min_size=1, max_size=45),
    pause=st.integers(0, 60),
    seed=st.integers(0, 1000),
    part=st.integers(1, 20),
)
def test_the_window_is_the_one_that_the_scatter_of_neighbours_decides(
    steps: list[float], pause: int, seed: int, part: int
) -> None:
    """Noise whose level jumps now and then, and falls silent for a segment; to the rounding of sums of 25 values."""
    rng = np.random.default_rng(seed)
    level = np.cumprod([step or 1.0 for step in steps])
    level[pause : pause + 1] = 0.0
    xf = np.repeat(level, 20)[: 20 * (len(steps) - 1) + part]
    xf *= rng.standard_normal(xf.size)
    span, chance = span_and_chance(heard(xf, segment=20))
    expected = chosen_written_out(xf, 20)
    assert span == expected[0]
    assert chance == pytest.approx(expected[1], rel=1e-9)


def chosen_along(xf: np.ndarray, every: int = 50) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples heard, span and chance along a signal; each as written out."""
    budget, times, chosen = made(1), [], []
    for n, value in enumerate(xf, start=1):
        budget.listen(0.3 * value, value)
        if n % every == 0:
            span, chance = span_and_chance(budget)
            expected = chosen_written_out(xf[:n], SEGMENT)
            assert span == expected[0]
            assert chance == pytest.approx(expected[1], rel=1e-9)
            times.append(n)
            chosen.append((span, chance))
    spans, chances = np.array(chosen).T
    return np.array(times), spans, chances


def test_of_steady_noise_the_window_is_long_as_soon_as_it_is_nearly_full() -> None:
    """Levels of 10.5 and of 24.5 segments in common differ by less than if they were not in 7 of 8 cases."""
    times, spans, chances = chosen_along(np.random.default_rng(20).standard_normal(60_000))
    assert np.all(spans[times < 0.8 * LONG * SEGMENT] != LONG)
    full = spans[times >= LONG * SEGMENT]
    assert np.mean(full == LONG) > 0.75
    assert np.mean(full == SHORT) < 0.1
    # chi-squared of 100 samples: a segment's power scatters by 0.14, ten of them a second
    assert np.median(chances) == pytest.approx(math.sqrt(2 / SEGMENT * SEGMENT / 1000), rel=0.15)


def test_bursts_are_averaged_over_long() -> None:
    """Segments now 10 dB louder and now not, in no order: their levels are chance too, and more of it."""
    rng = np.random.default_rng(21)
    xf = np.repeat(np.where(rng.random(600) < 0.3, 10**0.5, 1.0), SEGMENT) * rng.standard_normal(60_000)
    times, spans, chances = chosen_along(xf)
    full = spans[times >= LONG * SEGMENT]
    assert np.mean(full == LONG) > 0.75
    assert np.mean(full == SHORT) < 0.1
    assert np.median(chances) > 0.2


@pytest.mark.parametrize("gain_db", [3.0, 6.0, 20.0])
def test_after_a_rise_the_window_is_short_and_after_a_fall_the_usual_one(gain_db: float) -> None:
    """A level that scatters by 1 %. In segments from the change: one may be a burst, three are believed."""
    change, steady = 40, []
    for seed, sign in enumerate([1.0, -1.0] * 5):
        scatter = 1.0 + 0.01 * np.random.default_rng(seed).standard_normal(80)
        xf = np.where(np.arange(8000) % 2, 1.0, -1.0) * np.repeat(scatter, SEGMENT)
        xf[change * SEGMENT :] *= 10 ** (sign * gain_db / 20)
        times, spans, _ = chosen_along(xf, every=25)
        ages = times / SEGMENT - change
        assert np.all(spans[(ages > 0) & (ages <= 1)] != SHORT)
        assert np.all(spans[(ages >= 3) & (ages <= USUAL)] == (SHORT if sign > 0 else USUAL))
        left = spans[(ages > USUAL + SHORTEST_PART) & (ages <= LONG - 1)]  # the long window only
        assert np.all(left != LONG)
        assert np.mean(left == USUAL) > 0.7
        steady.append(spans[(ages <= 0) & (ages > LONG - change) | (ages > LONG + SHORTEST_PART)])
    assert np.mean(np.concatenate(steady) == LONG) > 0.7


@pytest.mark.parametrize(("db_per_s", "expected"), [(8.0, SHORT), (3.0, SHORT), (-3.0, USUAL), (-8.0, USUAL)])
def test_of_a_swelling_noise_the_window_is_short_and_of_a_fading_one_the_usual_one(
    db_per_s: float, expected: int
) -> None:
    """Its neighbours are alike, so that little is chance."""
    n = np.arange(5000)
    times, spans, chances = chosen_along(np.cos(np.pi * n) * 10 ** (db_per_s * n / 1000.0 / 20), every=30)
    assert np.all(spans[times > USUAL * SEGMENT] == expected)
    assert np.max(chances) < 0.015 * abs(db_per_s)  # no more than neighbours differ


def test_one_louder_segment_is_no_rise() -> None:
    """However loud: of what stands alone, its scatter tells that it may be chance."""
    for gain in (2.0, 10.0, 1e3):
        xf = np.random.default_rng(23).standard_normal(5000)
        xf[-SEGMENT:] *= gain
        assert span_and_chance(heard(xf))[0] != SHORT


def test_silence_leaves_the_usual_window_and_no_chance() -> None:
    assert span_and_chance(made()) == (USUAL, 0.0)
    assert span_and_chance(heard(np.zeros(4000), span=LONG)) == (USUAL, 0.0)
    assert span_and_chance(heard(np.full(4000, 1e-160))) == (USUAL, 0.0)  # its power is no number
    loud = np.random.default_rng(24).standard_normal(3000)
    assert span_and_chance(heard(np.append(loud, np.zeros(1100)))) == (USUAL, 0.0)
    budget = heard(np.append(loud, np.zeros(800)))
    span, chance = span_and_chance(budget)
    assert span != SHORT
    assert 0.0 < chance <= LARGEST_CHANCE_S
    for _ in range(400):
        budget.listen(0.0, 0.0)
    assert span_and_chance(budget) == (USUAL, 0.0)  # and what was chance before is none now


@pytest.mark.parametrize("scatter_db", [0.0, 2.0, 4.0])
def test_chance_is_what_the_scatter_of_levels_makes_of_the_account_in_a_second(scatter_db: float) -> None:
    """Root mean square of chance against the spread of a second's sums of independent levels, within a quarter.

    A filter that keeps the mean power emits a power in proportion to x'^2.
    """
    rng = np.random.default_rng(25)
    level = 10 ** (scatter_db * rng.standard_normal(3000) / 20)
    xf = np.repeat(level, 20) * rng.standard_normal(60_000)
    budget, chances = made(1, segment=20), []
    for n, value in enumerate(xf, start=1):
        budget.listen(value, value)
        if n > 220 and n % 20 == 0:
            chances.append(span_and_chance(budget)[1])
    seconds = np.sum((xf**2 / np.mean(xf**2) - 1.0).reshape(-1, 1000), axis=1) / 1000.0
    assert np.sqrt(np.mean(np.square(chances))) == pytest.approx(np.std(seconds), rel=0.25)
    assert max(chances) < LARGEST_CHANCE_S


def test_of_violent_bursts_chance_is_bounded() -> None:
    xf = np.random.default_rng(26).standard_normal(1100)
    xf[500:520] *= 1e6
    assert span_and_chance(heard(xf))[1] == LARGEST_CHANCE_S


# ---- The forecast


def forecast_written_out(x: np.ndarray, segment: int, span: int, floor: float) -> float:
    """Weighted line through the logarithm of the segments' powers, with numpy's polyfit, and its shrunk slope."""
    heard = x[stretch(x.size, segment, span)]
    parts = np.split(heard, np.arange(segment, heard.size, segment))
    there = np.array([part.size for part in parts]) / segment
    shares = np.where(there >= SHORTEST_PART, there, 0.0)
    if shares.sum() <= 3.0:
        return 1.0
    ends = np.cumsum(there)
    ages, levels = ends - 0.5 * there - ends[-1], np.log([np.mean(part**2) + floor for part in parts])
    slope, offset = np.polyfit(ages, levels, 1, w=np.sqrt(shares))
    middle = np.average(ages, weights=shares)
    error = shares @ (levels - offset - slope * ages) ** 2 / (shares.sum() - 2) / (shares @ (ages - middle) ** 2)
    if slope**2 <= STEADY * error:
        return 1.0
    slope *= 1 - STEADY * error / slope**2
    mean = np.average(np.exp(slope * (ages - middle)), weights=shares)
    return float(np.clip(np.exp(-slope * middle) / mean, FORECAST_LEAST, FORECAST_MOST))


@given(trend=st.floats(-0.02, 0.02), seed=st.integers(0, 1000), samples=st.integers(1, 700))
def test_the_forecast_is_the_line_through_the_levels(trend: float, seed: int, samples: int) -> None:
    """To the rounding of logarithms and of sums of 25 values; some lines are so steep that they meet a bound."""
    x = np.random.default_rng(seed).standard_normal(samples) * np.exp(trend * np.arange(samples))
    budget = heard(x, segment=20)
    for span in SPANS:
        budget.state.numbers["span"] = span
        mean = np.mean(x[stretch(samples, 20, span)] ** 2)
        expected = forecast_written_out(x, 20, span, floor=1e-12 * mean)
        assert level_forecast(budget.state, mean) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("span", SPANS)
def test_of_steady_noise_no_change_is_foretold(span: int) -> None:
    """A line of no slope passes F(1, 4 to 23) > 6 in 2 to 7 of 100 cases; then little is foretold."""
    x = np.random.default_rng(5).standard_normal(40_000)
    budget, told = made(1), []
    budget.state.numbers["span"] = span
    for n, value in enumerate(x, start=1):
        budget.listen(value, value)
        if n > span * SEGMENT and n % 50 == 0:
            told.append(level_forecast(budget.state, 1.0))
    assert np.mean(np.array(told) == 1.0) > 0.9
    assert 0.75 < min(told) <= max(told) < 1.33  # the level of 100 samples scatters by 0.14


@pytest.mark.parametrize("span", SPANS)
@pytest.mark.parametrize("db_per_s", [-15.0, -8.0, -3.0, 3.0, 8.0, 15.0])
@pytest.mark.parametrize("part", [1, 50, 100])
def test_a_swelling_noise_is_followed_to_now(db_per_s: float, part: int, span: int) -> None:
    """A sign that alternates, whose level does not scatter: its power now over its mean in the window."""
    n = np.arange(30 * SEGMENT + part)
    power = 10 ** (db_per_s * (n - n.size) / 1000.0 / 10)
    budget = heard(np.cos(np.pi * n) * np.sqrt(power), span=span)
    # a line through the segments' means for the curve within them, and the least part not counted
    now = np.clip(power[-1] / np.mean(power[stretch(n.size, span=span)]), FORECAST_LEAST, FORECAST_MOST)
    assert level_forecast(budget.state, 1.0) == pytest.approx(now, rel=1e-2)


@pytest.mark.parametrize("span", SPANS)
@pytest.mark.parametrize(("db_per_s", "expected"), [(200.0, 4.0), (-200.0, 0.5)])
def test_no_more_is_foretold_than_the_bounds(db_per_s: float, expected: float, span: int) -> None:
    """A fall is believed more slowly than a rise."""
    assert expected in (FORECAST_LEAST, FORECAST_MOST)
    n = np.arange(700)
    budget = heard(np.sin(2 * np.pi * 0.1 * n) * 10 ** (db_per_s * n / 1000.0 / 20), span=span)
    assert level_forecast(budget.state, 1.0) == pytest.approx(expected, rel=1e-12)


def test_a_burst_is_averaged_and_silence_foretells_nothing() -> None:
    x = np.random.default_rng(6).standard_normal(700)
    x[300:400] *= 100.0
    assert level_forecast(heard(x).state, np.mean(x**2)) == 1.0
    swelling = np.exp(0.01 * np.arange(300))
    assert level_forecast(heard(swelling).state, 1.0) == 1.0  # three segments: too few
    assert level_forecast(heard(np.append(swelling, 1.0)).state, 1.0) == 1.0  # a part too short to count
    assert level_forecast(heard(np.exp(0.01 * np.arange(330))).state, 1.0) > 1.0
    assert level_forecast(heard(np.zeros(700)).state, 0.0) == 1.0
    assert level_forecast(heard(1e-155 * np.exp(0.01 * np.arange(700))).state, 1e-305) == 1.0  # its floor is no number


# ---- The account and the target

DEBT_S = 1.0  # the most that is remembered: an averaging time of 1 s


def test_the_account_is_what_was_spent_beyond_what_was_due() -> None:
    """In seconds of rated power, to the bit; a rated power assigned counts from there on. Nothing is left to chance."""
    budget = PowerBudget(2, 0.7, fs=50.0, credit_s=0.4, averaging_s=DEBT_S)
    rng, account, clipped = np.random.default_rng(7), 0.0, set()
    for n, y in enumerate(rng.standard_normal(600) * np.repeat([0.5, 4.0, 0.1], 200)):
        if n == 100:
            budget.rated_power = 0.5
        rated = 0.7 if n < 100 else 0.5
        budget.advance(1.0, 0.5, [0.1, 0.2], control_signal=y)
        account += (y * y / rated - 1.0) / 50.0
        clipped |= {account > DEBT_S, account < -0.4}
        account = min(max(account, -0.4), DEBT_S)
        assert budget.account_s == account
        assert budget.state.numbers["chance"][0] == 0.0
        clipped.add(account)
    assert {DEBT_S, -0.4} <= clipped
    assert budget.rated_power == 0.5


def solutions(n: int) -> list[int]:
    """Samples after which it is solved, of the first n."""
    due, last = [], 0
    for i in range(1, n + 1):
        if i - last >= min(INTERVAL, 1 + i // 8):
            due.append(i)
            last = i
    return due


def test_chance_adds_to_the_credit_and_not_to_the_debt() -> None:
    """As it was at the last solution; where it shrinks, what was saved beyond it is lost."""
    budget = PowerBudget(1, 0.7, fs=80.0, credit_s=0.05, averaging_s=DEBT_S)  # segments of ten samples
    rng, account, chance, limits = np.random.default_rng(12), 0.0, 0.0, []
    xf = np.repeat(10 ** (np.repeat([0.0, 0.25, 1.0, 0.0], 15) * rng.standard_normal(60)), 10)
    xf *= rng.standard_normal(600)
    due = set(solutions(600))
    for n, y in enumerate(np.where(np.arange(600) % 150 < 10, 4.0, 0.1), start=1):
        budget.advance(xf[n - 1], xf[n - 1], [0.2], control_signal=y)
        account = min(max(account + (y * y / 0.7 - 1.0) / 80.0, -(0.05 + chance)), DEBT_S)
        assert budget.account_s == pytest.approx(account, abs=1e-12)
        if account in (-(0.05 + chance), DEBT_S):
            limits.append(account)
        if n in due:
            chance = chosen_written_out(xf[:n], 10, fs=80.0)[1]
        assert budget.state.numbers["chance"][0] == pytest.approx(chance, rel=1e-9)
    assert {DEBT_S, -(0.05 + LARGEST_CHANCE_S)} <= set(limits)
    assert len(set(limits)) > 5


def test_without_a_control_signal_its_own_is_booked() -> None:
    budget = PowerBudget(2, 0.5, fs=100.0, credit_s=10.0)
    account, rng = 0.0, np.random.default_rng(8)
    for x in rng.standard_normal(300):
        y = budget.control_signal(x)
        budget.advance(x, x, [2.0, -1.0])
        account += (y * y / 0.5 - 1.0) / 100.0
        assert budget.account_s == pytest.approx(account, abs=1e-13)


@given(spent=st.floats(-3.0, 3.0), rated_power=st.floats(1e-6, 1e6), forecast=st.floats(FORECAST_LEAST, FORECAST_MOST))
def test_the_target_repays_what_the_account_holds(spent: float, rated_power: float, forecast: float) -> None:
    """Of a single sample nothing is chance."""
    budget = PowerBudget(1, rated_power, fs=1.0, credit_s=2.0)
    budget.advance(1.0, 1.0, [1.0], control_signal=math.sqrt(max(spent + 1.0, 0.0) * rated_power))
    least = max(TARGET_LEAST, 1.0 - max(0.5, 2.0 * budget.account_s / 10.0))
    share = np.clip(math.exp(-3.0 * budget.account_s), least, TARGET_MOST)
    assert target_power(budget.state, forecast) == pytest.approx(rated_power * share / forecast, rel=1e-12)


@pytest.mark.parametrize(
    ("spent", "chance", "factor"),
    [
        (1.0, 0.0, 1.0),
        (1.7, 0.0, 1.0),  # overspending is the account's affair
        (0.98, 0.0, 1.2),
        (0.97, 0.0, 1.3),
        (0.5, 0.0, 1.3),
        (0.98, 0.02 * math.sqrt(8.0), 1.0),  # what chance makes of a mean over 2 * 4 s
        (0.95, 0.03 * math.sqrt(8.0), 1.2),
    ],
)
def test_power_left_unspent_beyond_chance_raises_the_target(spent: float, chance: float, factor: float) -> None:
    budget = PowerBudget(1, 0.5)
    budget.state.numbers["spent"], budget.state.numbers["chance"] = spent, chance
    budget.state.numbers["account"] = -0.5 * chance  # a credit that chance makes: no part in the target
    assert target_power(budget.state, 1.0) == pytest.approx(0.5 * factor, rel=1e-12)


def test_the_share_that_is_spent_is_followed_while_there_is_use_for_more() -> None:
    """An exponential mean over 4 s, of the samples at which lambda was above zero."""
    budget, rng, expected, used = PowerBudget(2, 0.5, fs=100.0), np.random.default_rng(4), 1.0, 0
    for n, x in enumerate(rng.standard_normal(3000)):
        needed = budget.power_weight > 0.0
        y = budget.control_signal(x)
        budget.advance(x, x, [0.0, 0.1] if 1000 <= n < 2000 else [2.0, -1.0])  # a third of it asks for little
        expected += needed * (y * y / 0.5 - expected) / 400.0
        used += needed
        assert budget.state.numbers["spent"][0] == pytest.approx(expected, rel=1e-9)
    assert 1500 < used < 2500


def test_most_of_the_power_is_spent_on_noise_that_swells() -> None:
    """0.99 of the rated one; without what returns of the unspent power it was 0.92."""
    w, powers = np.array([0.0, 2.0, -1.0]), []
    for seed in range(3):
        x = swelling(np.random.default_rng(seed).standard_normal(20 * 2000), fs=2000.0, swing_db=6.0, period_s=4.0)
        budget = PowerBudget(3, 0.6, fs=2000.0)
        y = np.zeros(x.size)
        for n in range(x.size):
            y[n] = budget.control_signal(x[n])
            budget.advance(x[n], x[n], w)
        powers.append(np.mean(y[x.size // 2 :] ** 2) / 0.6)
    assert 0.96 < np.mean(powers) < 1.02
    assert max(powers) <= 1.05


def target(account: float, chance: float, forecast: float = 1.0, rated_power: float = 1.0) -> float:
    budget = PowerBudget(1, rated_power)
    budget.state.numbers["account"], budget.state.numbers["chance"] = account, chance
    return target_power(budget.state, forecast)


@given(
    account=st.floats(-(DEFAULT_CREDIT_S + LARGEST_CHANCE_S), DEFAULT_AVERAGING_S),
    chance=st.floats(0.0, LARGEST_CHANCE_S),
    rated_power=st.floats(1e-6, 1e6),
    forecast=st.floats(FORECAST_LEAST, FORECAST_MOST),
)
def test_the_target_is_patient_with_what_chance_makes(
    account: float, chance: float, rated_power: float, forecast: float
) -> None:
    beyond = 0.0 if -account <= chance / 2 else account + chance / 2
    excess = account if account >= 0.0 else beyond
    least = max(TARGET_LEAST, 1.0 - max(PACE, 2.0 * account / DEFAULT_AVERAGING_S))
    share = np.clip(np.exp(-REPAYMENT * excess / (1 + PATIENCE * chance)), least, TARGET_MOST)
    got = target(account, chance, forecast, rated_power)
    assert got == pytest.approx(rated_power * share / forecast, rel=1e-12)


def test_debt_is_repaid_at_once_and_credit_spent_beyond_half_of_chance() -> None:
    assert target(0.0, 0.0) == target(0.0, 0.4) == 1.0
    assert target(0.01, 0.2) == pytest.approx(math.exp(-0.03 / 2.2), rel=1e-12)  # however little
    assert target(0.2, 0.0) == pytest.approx(math.exp(-0.6), rel=1e-12)
    assert target(0.4, 0.5) == pytest.approx(math.exp(-0.3), rel=1e-12)  # four times as patiently
    assert target(-0.05, 0.0) == pytest.approx(math.exp(0.15), rel=1e-12)
    assert target(-0.05, 0.2) == target(-0.1, 0.2) == 1.0
    assert target(-0.3, 0.2) == pytest.approx(math.exp(0.6 / 2.2), rel=1e-12)
    assert target(1.0, 0.0) == target(2.4, 0.0) == 0.5  # evenly, in the averaging time
    assert target(3.0, 0.0) == pytest.approx(0.4, rel=1e-12)  # which takes more
    assert target(8.0, 0.0) == 0.1
    assert target(-1.0, 0.0) == 3.0  # exp(3) is more
    assert target(1.0, 0.0, forecast=4.0, rated_power=8.0) == pytest.approx(1.0, rel=1e-12)  # over the forecast


@pytest.mark.parametrize(
    ("levels", "expected"),
    [([1.0] * 30, LONG), ([1.0] * 20 + [3.0] * 5, SHORT), ([1.0] * 20 + [0.3] * 8, USUAL)],
    ids=["steady", "risen", "fallen"],
)
def test_the_control_filter_is_that_of_the_chosen_window_forecast_and_target(levels: list, expected: int) -> None:
    """Dense matrices; to the tolerance of the power, and for its filter to the accuracy of Levinson's recursion."""
    n_taps, segment, w = 6, 80, np.array([3.0, -1.0, 0.5, 0.2, 0.0, -0.3])
    budget, rng = made(n_taps, 0.7, segment=segment), np.random.default_rng(13)
    x = np.convolve(rng.standard_normal(len(levels) * segment) * np.repeat(levels, segment), [1.0, 0.6])
    x = x[: max(solutions(len(levels) * segment))]  # solved for after the last sample
    xf = np.convolve(x, [0.0, 0.8, 0.3])[: x.size]
    for n in range(x.size):
        budget.advance(x[n], xf[n], w, control_signal=0.84 * (1.0 + 0.3 * (n % 3 - 1)))
    span, chance = chosen_written_out(xf, segment)
    assert budget.state.numbers["span"][0] == span == expected
    assert budget.state.numbers["chance"][0] == pytest.approx(chance, rel=1e-9)
    R_x, R_xf = (scipy.linalg.toeplitz(correlation(u[stretch(x.size, segment, span)], n_taps)) for u in (x, xf))
    v, weight = budget.control_filter, budget.power_weight
    assert weight > 0.1
    power = target(budget.account_s, chance, forecast_written_out(xf, segment, span, floor=0.0), 0.7)
    assert v @ R_x @ v == pytest.approx(power, rel=1.001 * POWER_TOLERANCE)
    ridge = RIDGE * R_xf[0, 0] * np.eye(n_taps)
    np.testing.assert_allclose(v, np.linalg.solve(R_xf + weight * R_x + ridge, (R_xf + ridge) @ w), rtol=0, atol=1e-10)


def test_it_is_solved_often_at_the_start_and_every_128_samples_later() -> None:
    """Where the estimate fits it is the control filter, as it was when it was last solved for."""
    budget, last, solved = PowerBudget(1, 1e9), 0.0, []
    x = np.random.default_rng(9).standard_normal(4000)
    for n, value in enumerate(x, start=1):
        budget.advance(value, value, [float(n)])
        if budget.control_filter[0] != last:
            last = budget.control_filter[0]
            assert last == n
            solved.append(n)
    assert solved == solutions(4000)
    assert solved[:8] == [1, 2, 3, 4, 5, 6, 7, 9]
    assert np.diff(solved)[-1] == INTERVAL


def test_what_is_heard_before_it_is_switched_on_counts_for_the_correlations_only() -> None:
    ours, other = made(), made()
    x = np.random.default_rng(10).standard_normal(250)
    for value in x:
        ours.listen(value, 0.5 * value)
        other.advance(value, 0.5 * value, [1.0, 0.0, 0.0], control_signal=3.0)
    np.testing.assert_array_equal(correlations(ours), correlations(other))
    assert span_and_chance(ours) == span_and_chance(other)
    assert (ours.account_s, ours.power_weight) == (0.0, 0.0)
    np.testing.assert_array_equal(ours.control_filter, 0.0)
    assert other.account_s == pytest.approx(250 * (3.0**2 - 1.0) / 1000.0)
    assert other.power_weight > 0.0


# ---- What it settles to


def of_known_estimate(rated_power: float, **budget: float) -> PowerBudgetController:
    """KF-PB whose estimate is W and stays it: no variance, no gain."""
    controller = kf_pb(
        W.size,
        S,
        rated_power=rated_power,
        state_noise=0.0,
        measurement_noise=1.0,
        initial_variance=0.0,
        secondary_path_uncertainty=None,
        **budget,
    )
    controller.estimator.x = W.reshape(-1, 1)
    return controller


def run(x: np.ndarray, rated_power: float = 0.25, **budget: float) -> SimulationResult:
    """W would cancel all. Switched on after 0.1 s: result times are 0.1 s less than those of x."""
    controller, d = of_known_estimate(rated_power, **budget), np.convolve(x, np.convolve(W, S))[: x.size]
    result = simulate(controller, x, disturbance=d, secondary_path=S, record_powers=True, switch_on_s=0.1)
    np.testing.assert_array_equal(controller.weights, W)
    return result


def between(result: SimulationResult, begin_s: float, end_s: float) -> tuple[float, float, np.ndarray]:
    """Power, noise reduction in dB, and lambda."""
    q = slice(round(begin_s * FS), round(end_s * FS))
    reduction = -10 * np.log10(np.sum(result.error[q] ** 2) / np.sum(result.disturbance[q] ** 2))
    return float(np.mean(result.control_signal[q] ** 2)), float(reduction), result.power_weight[q]


LONG_NOISE = band_limited_noise((100.0, 5000.0), 13.1, fs=FS, rng=1)
STEADY_NOISE = band_limited_noise((100.0, 5000.0), 7.1, fs=FS, rng=1)  # W asks for a power of 1.05


@pytest.mark.parametrize("overdrive", [1.3, 4.0, 30.0])
def test_of_a_tone_the_amplitude_is_what_the_rated_power_allows(overdrive: float) -> None:
    """(g + lambda) v = g w: lambda = g (sqrt(overdrive) - 1), to the tolerance of the power."""
    zero = np.exp(-2j * np.pi * 400 / FS * np.arange(16))
    rated_power, gain = abs(W @ zero) ** 2 / 2 / overdrive, abs(S @ zero[:4]) ** 2
    power, reduction, weight = between(run(tone(400, 3.1, fs=FS), rated_power), 1.0, 3.0)
    assert power == pytest.approx(rated_power, rel=2e-3)  # the account: 2 s against a debt or credit of some ms
    root = math.sqrt(overdrive)
    # half of the tolerance is v's; that of the account, which moves the target by as much, comes on top
    np.testing.assert_allclose(weight, gain * (root - 1), rtol=2 * POWER_TOLERANCE * root / (root - 1))
    assert reduction == pytest.approx(-20 * math.log10(1 - 1 / root), abs=0.1)


def test_steady_noise_is_given_its_rated_power_and_lambda_keeps_still() -> None:
    power, _, weight = between(run(STEADY_NOISE), 2.0, 7.0)
    assert power == pytest.approx(0.25, rel=0.01)
    assert np.std(weight) < 0.05 * np.mean(
        weight
    )  # powers of 0.75 s of a band of 4900 Hz scatter by 2 %, of 3 s by 1 %


@pytest.mark.parametrize("gain_db", [20.0, -20.0])
def test_after_a_level_jump_that_is_paid_for_nothing_is_left_of_it(gain_db: float) -> None:
    """No winding up, no swinging: lambda and the noise reduction are those of the noise without a jump."""
    jumped = LONG_NOISE.copy()
    jumped[: round(3.1 * FS)] *= 10 ** (-gain_db / 20)
    result, steady = run(jumped), run(LONG_NOISE)
    before, usual_before = (np.mean(between(r, 2.0, 3.0)[2]) for r in (result, steady))
    assert not usual_before / 3 < before < 3 * usual_before
    (power, reduction, weight), (_, usual, usual_weight) = (between(r, 10.0, 12.0) for r in (result, steady))
    assert np.max(np.abs(10 * np.log10(weight / usual_weight))) < 0.5
    assert reduction == pytest.approx(usual, abs=0.3)
    assert power == pytest.approx(0.25, rel=0.06)


@pytest.mark.parametrize(("seconds", "gain_db"), [(0.05, 20.0), (0.5, 20.0), (1.0, 20.0), (0.5, -math.inf)])
def test_after_a_burst_that_is_paid_for_or_a_pause_nothing_is_left_of_it(seconds: float, gain_db: float) -> None:
    """Although the long window reaches back to it: it is not chosen while it does."""
    jumped = LONG_NOISE.copy()
    jumped[round(3.1 * FS) : round((3.1 + seconds) * FS)] *= 10 ** (gain_db / 20)
    result, steady = run(jumped), run(LONG_NOISE)
    assert np.all(np.isfinite(result.error))
    (_, reduction, weight), (_, usual, usual_weight) = (between(r, 10.0, 12.0) for r in (result, steady))
    assert np.max(np.abs(10 * np.log10(weight / usual_weight))) < 1.0
    assert reduction == pytest.approx(usual, abs=0.5)


@pytest.mark.parametrize(("averaging_s", "kept"), [(DEFAULT_AVERAGING_S, True), (1.0, False)])
def test_the_mean_over_the_averaging_time_is_kept_after_a_loud_second(averaging_s: float, kept: bool) -> None:
    """20 dB louder for a second, which spends more than two seconds' power before the budget knows. Every 10 s count."""
    x = LONG_NOISE.copy()
    x[round(2.1 * FS) : round(3.1 * FS)] *= 10.0
    spent = np.concatenate([[0.0], np.cumsum(run(x, averaging_s=averaging_s).control_signal ** 2)]) / FS / 0.25
    over_ten, loud = spent[10 * FS :] - spent[: -10 * FS], spent[3 * FS] - spent[2 * FS]
    assert loud > 2.0
    assert (over_ten.max() / 10.0 < 1.02) == kept


def test_in_silence_nothing_happens() -> None:
    result = run(np.zeros(FS))
    for signal in (result.control_signal, result.error, result.power_weight):
        np.testing.assert_array_equal(signal, 0.0)


def test_what_no_noise_needs_is_saved_up_to_the_credit_and_chance_and_no_further() -> None:
    quiet = 0.1 * STEADY_NOISE
    controller = of_known_estimate(0.25, credit_s=0.15)
    simulate(controller, quiet, disturbance=quiet, secondary_path=S, switch_on_s=0.1)
    budget = controller.estimator.budget
    chance = budget.state.numbers["chance"][0]
    assert 0.005 < chance < 0.05  # of a band of 4900 Hz: 0.01 s and, for its slopes, more
    assert budget.account_s == pytest.approx(-0.15 - chance, abs=1e-3)
    assert controller.power_weight == 0.0
    np.testing.assert_array_equal(controller.control_filter, W)


# ---- Refusals, copies


@pytest.mark.parametrize(
    "bad",
    [
        {"reference": math.nan}, {"reference": math.inf}, {"reference": 1e200},
        {"filtered_reference": math.nan}, {"filtered_reference": -1e200}, {"filtered_reference": None},
        {"control_signal": math.nan}, {"control_signal": 1e200}, {"weights": [1.0, 2.0]},
        {"weights": [1.0, math.nan, 0.0]}, {"weights": [[1.0, 2.0, 3.0]]}, {"weights": "loud"},
    ],
    ids=plain,
)  # fmt: skip
def test_a_bad_sample_changes_nothing(bad: dict) -> None:
    budget, untouched = made(), made()
    good = {"reference": 1.0, "filtered_reference": 0.5, "weights": [1.0, 2.0, 3.0]}
    for one in (budget, untouched):
        one.advance(**good)
    before = pickle.dumps(budget)
    with pytest.raises((ValueError, TypeError), match=next(iter(bad))):
        budget.advance(**good | bad)
    assert pickle.dumps(budget) == before
    for one in (budget, untouched):
        one.advance(**good)
    np.testing.assert_array_equal(budget.control_filter, untouched.control_filter)
    assert budget.account_s == untouched.account_s


@pytest.mark.parametrize("method", ["listen", "control_signal"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e200, None])
def test_listening_and_playing_refuse_a_bad_sample(method: str, bad: object) -> None:
    budget = made()
    before = pickle.dumps(budget)
    with pytest.raises((ValueError, TypeError), match="reference"):
        getattr(budget, method)(*((bad, 1.0) if method == "listen" else (bad,)))
    assert pickle.dumps(budget) == before


@pytest.mark.parametrize("name", ["rated_power", "fs", "memory_s", "credit_s", "averaging_s"])
@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf, None])
def test_settings_out_of_range(name: str, bad: object) -> None:
    with pytest.raises((ValueError, TypeError), match=name):
        PowerBudget(**{"n_taps": 2, "rated_power": 1.0} | {name: bad})  # type: ignore[arg-type]
    budget = PowerBudget(2, 1.0)
    with pytest.raises((ValueError, TypeError), match="rated_power"):
        budget.rated_power = bad  # type: ignore[assignment]
    assert budget.rated_power == 1.0
    with pytest.raises((ValueError, TypeError), match="n_taps"):
        PowerBudget(bad, 1.0)  # type: ignore[arg-type]


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda budget: pickle.loads(pickle.dumps(budget))])
def test_a_copy_goes_on_by_itself(clone) -> None:
    budget = made()
    x = np.random.default_rng(11).standard_normal(1500)

    def go_on(one: PowerBudget, begin: int, end: int) -> list[float]:
        played = []
        for n in range(begin, end):
            played.append(one.control_signal(x[n]))
            one.advance(x[n], 0.5 * x[n], [3.0, -1.0, 0.5])
        return played

    go_on(budget, 0, 700)
    twin, state = clone(budget), numbers_of(budget.state)
    ahead = go_on(budget, 700, 1500)
    for now, then in zip(numbers_of(twin.state), state, strict=True):
        np.testing.assert_array_equal(now, then)
    for name in ("fs", "memory_s", "credit_s", "averaging_s"):
        assert getattr(twin, name) == getattr(budget, name)
    assert go_on(twin, 700, 1500) == ahead
    assert (twin.account_s, twin.power_weight) == (budget.account_s, budget.power_weight)
    twin.control_filter[:] = 0.0  # a copy
    np.testing.assert_array_equal(twin.control_filter, budget.control_filter)
    assert RIDGE < budget.power_weight < 10.0
