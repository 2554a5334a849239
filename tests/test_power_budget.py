"""The power budget: its window, its forecast and its account against definitions written out, and what it settles to.

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
from hypothesis import given
from hypothesis import strategies as st

from kfopc_filterpy import KalmanController, PowerBudget, SimulationResult, band_limited_noise, kf_pb, simulate, tone
from kfopc_filterpy.allocation import POWER_TOLERANCE, RIDGE
from kfopc_filterpy.power_budget import (
    DEBT_S,
    FORECAST_MOST,
    INTERVAL,
    SHORTEST_PART,
    STEADY,
    TARGET_LEAST,
    TARGET_MOST,
    level_forecast,
    sum_correlations,
    target_power,
)

FS = 16000
SEGMENT = 100
S = np.array([0.0, 0.5, 0.3, -0.1])
W = np.random.default_rng(0).standard_normal(16) / 4.0


def made(n_taps: int = 3, rated_power: float = 1.0, segment: int = SEGMENT, **options: float) -> PowerBudget:
    """A budget whose window has six segments of `segment` samples, and the one that is being filled."""
    return PowerBudget(n_taps, rated_power, fs=1000.0, window_s=6 * segment / 1000.0, **options)


def correlations(budget: PowerBudget) -> np.ndarray:
    """First rows of R_x and R_x', (2, L)."""
    rows = np.full((2, budget.n_taps), np.nan)
    sum_correlations(budget.state, *rows)
    return rows


def stretch(n: int, segment: int = SEGMENT) -> slice:
    """Samples in the window after n samples: six whole segments, and a part or the whole of another."""
    return slice(max(n - 6 * segment - (n - 1) % segment - 1, 0), n)


# ---- The window


@pytest.mark.parametrize(("n_taps", "segment", "asked"), [(1, 7, 7), (4, 9, 9), (12, 40, 40), (12, 12, 3)])
def test_the_correlations_are_those_of_the_stretch_with_zeros_around_it(n_taps: int, segment: int, asked: int) -> None:
    """To the rounding of sums of 280 products at most, in another order. A segment has the taps' length at least."""
    budget = made(n_taps, segment=asked)
    x, xf = np.random.default_rng(1).standard_normal((2, 17 * segment + 3))
    for n in range(1, x.size + 1):
        budget.listen(x[n - 1], xf[n - 1])
        for got, signal in zip(correlations(budget), (x, xf), strict=True):
            heard = np.concatenate((signal[stretch(n, segment)], np.zeros(n_taps)))
            expected = [heard[k:] @ heard[: heard.size - k] for k in range(n_taps)]
            count = heard.size - n_taps
            np.testing.assert_allclose(got, np.array(expected) / count, rtol=0, atol=1e-14 * expected[0] / count)


@given(
    levels=st.lists(st.sampled_from([0.0, 1e-3, 1.0, 1e3]), min_size=1, max_size=30),
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
    for row in correlations(budget):
        eigenvalues = np.linalg.eigvalsh(scipy.linalg.toeplitz(row))
        assert eigenvalues[0] >= -1e-14 * eigenvalues[-1]


def test_what_has_left_the_window_is_as_if_it_had_never_been() -> None:
    """Bit for bit: sums of segments only, and nothing is ever taken off. A past 600 dB louder leaves no rounding."""
    old, fresh = made(5), made(5)
    rng = np.random.default_rng(3)
    for value in 1e30 * rng.standard_normal(7 * SEGMENT):
        old.listen(value, 2.0 * value)
    for n, (x, xf) in enumerate(rng.standard_normal((2000, 2)), start=1):
        for budget in (old, fresh):
            budget.listen(x, xf)
        if n > 6 * SEGMENT and n % 17 == 0:
            np.testing.assert_array_equal(correlations(old), correlations(fresh))
            assert level_forecast(old.state, 1.0) == level_forecast(fresh.state, 1.0)
        if n == 6 * SEGMENT - 1:
            assert correlations(old)[0, 0] > 1e50  # so far it was there
    for _ in range(7 * SEGMENT):
        old.listen(0.0, 0.0)
    np.testing.assert_array_equal(correlations(old), 0.0)


# ---- The forecast


def forecast_written_out(x: np.ndarray, segment: int) -> float:
    """Weighted line through the logarithm of the segments' powers, with numpy's polyfit, and its shrunk slope."""
    heard = x[stretch(x.size, segment)]
    parts = np.split(heard, np.arange(segment, heard.size, segment))
    there = np.array([part.size for part in parts]) / segment
    shares = np.where(there >= SHORTEST_PART, there, 0.0)
    if shares.sum() <= 3.0:
        return 1.0
    ends = np.cumsum(there)
    ages, levels = ends - 0.5 * there - ends[-1], np.log([np.mean(part**2) for part in parts])
    slope, offset = np.polyfit(ages, levels, 1, w=np.sqrt(shares))
    middle = np.average(ages, weights=shares)
    error = shares @ (levels - offset - slope * ages) ** 2 / (shares.sum() - 2) / (shares @ (ages - middle) ** 2)
    if slope**2 <= STEADY * error:
        return 1.0
    slope *= 1 - STEADY * error / slope**2
    mean = np.average(np.exp(slope * (ages - middle)), weights=shares)
    return float(np.clip(np.exp(-slope * middle) / mean, 1 / FORECAST_MOST, FORECAST_MOST))


def heard(x: np.ndarray, segment: int = SEGMENT) -> PowerBudget:
    budget = made(1, segment=segment)
    for value in x:
        budget.listen(value, value)
    return budget


@given(trend=st.floats(-0.03, 0.03), seed=st.integers(0, 1000), samples=st.integers(1, 400))
def test_the_forecast_is_the_line_through_the_levels(trend: float, seed: int, samples: int) -> None:
    """To the rounding of logarithms and of sums of seven values."""
    x = np.random.default_rng(seed).standard_normal(samples) * np.exp(trend * np.arange(samples))
    budget = heard(x, segment=20)
    mean = np.mean(x[stretch(samples, 20)] ** 2)
    assert level_forecast(budget.state, mean) == pytest.approx(forecast_written_out(x, 20), rel=1e-9)


def test_of_steady_noise_no_change_is_foretold() -> None:
    """A line of no slope passes F(1, 4 to 5) > 6 in 6 to 7 of 100 cases; then little is foretold."""
    x = np.random.default_rng(5).standard_normal(40_000)
    budget, told = made(1), []
    for n, value in enumerate(x):
        budget.listen(value, value)
        if n >= 700 and n % 50 == 0:
            told.append(level_forecast(budget.state, 1.0))
    assert np.mean(np.array(told) == 1.0) > 0.9
    assert 0.75 < min(told) <= max(told) < 1.33  # the level of 100 samples scatters by 0.14


@pytest.mark.parametrize("db_per_s", [-15.0, -8.0, 8.0, 15.0])
@pytest.mark.parametrize("part", [1, 50, 100])
def test_a_swelling_noise_is_followed_to_now(db_per_s: float, part: int) -> None:
    """A sign that alternates, whose level does not scatter: its power now over its mean in the window."""
    n = np.arange(6 * SEGMENT + part)
    power = 10 ** (db_per_s * n / 1000.0 / 10)
    budget = heard(np.cos(np.pi * n) * np.sqrt(power))
    # a line through seven segments' means for the curve within them, and the least part not counted
    now = max(power[-1] / np.mean(power), 1 / FORECAST_MOST)
    assert level_forecast(budget.state, 1.0) == pytest.approx(now, rel=1e-2)


@pytest.mark.parametrize(("db_per_s", "expected"), [(200.0, FORECAST_MOST), (-200.0, 1 / FORECAST_MOST)])
def test_no_more_is_foretold_than_the_bound(db_per_s: float, expected: float) -> None:
    n = np.arange(700)
    budget = heard(np.sin(2 * np.pi * 0.1 * n) * 10 ** (db_per_s * n / 1000.0 / 20))
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


def test_the_account_is_what_was_spent_beyond_what_was_due() -> None:
    """In seconds of rated power, to the bit; a rated power assigned counts from there on."""
    budget = PowerBudget(2, 0.7, fs=50.0, credit_s=0.4)
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
        clipped.add(account)
    assert {DEBT_S, -0.4} <= clipped
    assert budget.rated_power == 0.5


def test_without_a_control_signal_its_own_is_booked() -> None:
    budget = PowerBudget(2, 0.5, fs=100.0, credit_s=10.0)
    account, rng = 0.0, np.random.default_rng(8)
    for x in rng.standard_normal(300):
        y = budget.control_signal(x)
        budget.advance(x, x, [2.0, -1.0])
        account += (y * y / 0.5 - 1.0) / 100.0
        assert budget.account_s == pytest.approx(account, abs=1e-13)


@given(
    spent=st.floats(-3.0, 3.0), rated_power=st.floats(1e-6, 1e6), forecast=st.floats(1 / FORECAST_MOST, FORECAST_MOST)
)
def test_the_target_repays_what_the_account_holds(spent: float, rated_power: float, forecast: float) -> None:
    budget = PowerBudget(1, rated_power, fs=1.0, credit_s=2.0)
    budget.advance(1.0, 1.0, [1.0], control_signal=math.sqrt(max(spent + 1.0, 0.0) * rated_power))
    share = np.clip(math.exp(-budget.account_s), TARGET_LEAST, TARGET_MOST)
    assert target_power(budget.state, forecast) == pytest.approx(rated_power * share / forecast, rel=1e-12)


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
    expected, due = [], 0
    for n in range(1, 4001):
        if n - due >= min(INTERVAL, 1 + n // 8):
            expected.append(n)
            due = n
    assert solved == expected
    assert solved[:8] == [1, 2, 3, 4, 5, 6, 7, 9]
    assert np.diff(solved)[-1] == INTERVAL


def test_what_is_heard_before_it_is_switched_on_counts_for_the_correlations_only() -> None:
    ours, other = made(), made()
    x = np.random.default_rng(10).standard_normal(250)
    for value in x:
        ours.listen(value, 0.5 * value)
        other.advance(value, 0.5 * value, [1.0, 0.0, 0.0], control_signal=3.0)
    np.testing.assert_array_equal(correlations(ours), correlations(other))
    assert (ours.account_s, ours.power_weight) == (0.0, 0.0)
    np.testing.assert_array_equal(ours.control_filter, 0.0)
    assert other.account_s == DEBT_S
    assert other.power_weight > 0.0


# ---- What it settles to


def of_known_estimate(rated_power: float, **budget: float) -> KalmanController:
    """KF-PB whose estimate is W and stays it: no variance, no gain."""
    controller = kf_pb(
        W.size, S, rated_power=rated_power, state_noise=0.0, measurement_noise=1.0, initial_variance=0.0, **budget
    )
    controller.estimator.x = W.reshape(-1, 1)
    return controller


def run(x: np.ndarray, rated_power: float = 0.25) -> SimulationResult:
    """W would cancel all. Switched on after 0.1 s: result times are 0.1 s less than those of x."""
    controller, d = of_known_estimate(rated_power), np.convolve(x, np.convolve(W, S))[: x.size]
    result = simulate(controller, x, disturbance=d, secondary_path=S, record_powers=True, switch_on_s=0.1)
    np.testing.assert_array_equal(controller.weights, W)
    return result


def between(result: SimulationResult, begin_s: float, end_s: float) -> tuple[float, float, np.ndarray]:
    """Power, noise reduction in dB, and lambda."""
    q = slice(round(begin_s * FS), round(end_s * FS))
    reduction = -10 * np.log10(np.sum(result.error[q] ** 2) / np.sum(result.disturbance[q] ** 2))
    return float(np.mean(result.control_signal[q] ** 2)), float(reduction), result.power_weight[q]


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
    assert np.std(weight) < 0.05 * np.mean(weight)  # powers of 0.75 s of a band of 4900 Hz scatter by 2 %


@pytest.mark.parametrize("gain_db", [20.0, -20.0])
def test_two_seconds_after_a_level_jump_nothing_is_left_of_it(gain_db: float) -> None:
    """No winding up, no swinging: lambda and the noise reduction are those of the noise without a jump."""
    jumped = STEADY_NOISE.copy()
    jumped[: round(3.1 * FS)] *= 10 ** (-gain_db / 20)
    result, steady = run(jumped), run(STEADY_NOISE)
    before, usual_before = (np.mean(between(r, 2.0, 3.0)[2]) for r in (result, steady))
    assert not usual_before / 3 < before < 3 * usual_before
    (power, reduction, weight), (_, usual, usual_weight) = (between(r, 5.0, 7.0) for r in (result, steady))
    assert np.max(np.abs(10 * np.log10(weight / usual_weight))) < 0.5
    assert reduction == pytest.approx(usual, abs=0.3)
    assert power == pytest.approx(0.25, rel=0.06)


@pytest.mark.parametrize(("seconds", "gain_db"), [(0.05, 20.0), (0.5, 20.0), (0.5, -math.inf)])
def test_two_seconds_after_a_burst_or_a_pause_nothing_is_left_of_it(seconds: float, gain_db: float) -> None:
    jumped = STEADY_NOISE.copy()
    jumped[round(3.1 * FS) : round((3.1 + seconds) * FS)] *= 10 ** (gain_db / 20)
    result, steady = run(jumped), run(STEADY_NOISE)
    assert np.all(np.isfinite(result.error))
    (_, reduction, weight), (_, usual, usual_weight) = (between(r, 5.0 + seconds, 7.0) for r in (result, steady))
    assert np.max(np.abs(10 * np.log10(weight / usual_weight))) < 1.0
    assert reduction == pytest.approx(usual, abs=0.5)


def test_in_silence_nothing_happens() -> None:
    result = run(np.zeros(FS))
    for signal in (result.control_signal, result.error, result.power_weight):
        np.testing.assert_array_equal(signal, 0.0)


def test_what_no_noise_needs_is_saved_up_to_the_credit_and_no_further() -> None:
    quiet = 0.1 * STEADY_NOISE
    controller = of_known_estimate(0.25, credit_s=0.15)
    simulate(controller, quiet, disturbance=quiet, secondary_path=S, switch_on_s=0.1)
    assert controller.estimator.budget.account_s == pytest.approx(-0.15, abs=1e-3)
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
    ids=str,
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


@pytest.mark.parametrize("name", ["rated_power", "fs", "window_s", "credit_s"])
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
    twin, state = clone(budget), pickle.dumps(budget)
    ahead = go_on(budget, 700, 1500)
    assert pickle.dumps(twin) == state
    assert go_on(twin, 700, 1500) == ahead
    assert (twin.account_s, twin.power_weight) == (budget.account_s, budget.power_weight)
    twin.control_filter[:] = 0.0  # a copy
    np.testing.assert_array_equal(twin.control_filter, budget.control_filter)
    assert RIDGE < budget.power_weight < 10.0
