"""Behind a limiter: the ceiling of the target against a search for the least error, and what it brings in the loop."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.signal
import scipy.stats
from helpers.compiled import from_python

from kfopc_filterpy import OutputLimiter, kf_pb, noise_reduction_db, power_constrained_wiener, simulate
from kfopc_filterpy.power import PowerBudget
from kfopc_filterpy.power import budget as parts
from kfopc_filterpy.power import ceiling as ceiling_parts
from kfopc_filterpy.power.budget import LIMITER_MEMORY_S, LOUDEST
from kfopc_filterpy.power.spending import LEAST, MOST
from kfopc_filterpy.signals import band_limited_noise, tone

balance_of_power, hear_limiter = from_python(ceiling_parts.balance_of_power), from_python(parts.hear_limiter)

FS = 16000
N_TAPS = 16
W = np.random.default_rng(0).standard_normal(N_TAPS) / 4.0
STEEP = scipy.signal.firwin(9, [1000, 3000], pass_zero=False, fs=FS)  # much of the power is wasted on it
FLAT = np.array([0.0, 0.7])


def rows(secondary: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First rows of R_x and R_x' of white noise."""
    of_x, of_xf = np.zeros((2, N_TAPS))
    of_x[0] = 1.0
    lags = np.correlate(secondary, secondary, "full")[secondary.size - 1 :]
    of_xf[: lags.size] = lags[:N_TAPS]
    of_xf[0] *= 1 + 1e-6
    return of_x, of_xf


class Limited:
    """Filters v(lambda) behind a limiter that holds the mean power of each window, whose levels scatter."""

    def __init__(self, secondary: np.ndarray, rated_power: float, scatter_db: float) -> None:
        self.of_x, self.of_xf = rows(secondary)
        self.R_x, self.R_xf = (scipy.linalg.toeplitz(row) for row in (self.of_x, self.of_xf))
        self.rated_power = rated_power
        level = scipy.stats.norm.ppf((np.arange(20_000) + 0.5) / 20_000)  # many windows, so that sums are smooth
        self.windows = 10 ** (scatter_db * level / 10)
        self.windows /= self.windows.mean()

    def filter(self, weight: float) -> np.ndarray:
        return np.linalg.solve(self.R_xf + weight * self.R_x, self.R_xf @ W)

    def gains(self, v: np.ndarray) -> np.ndarray:
        return np.minimum(1.0, np.sqrt(self.rated_power / (self.windows * (v @ self.R_x @ v))))

    def error(self, weight: float) -> float:
        """Mean of (w - g v)' R_x' (w - g v) over windows of level p."""
        v = self.filter(weight)
        g = self.gains(v)
        powers = [W @ self.R_xf @ W, W @ self.R_xf @ v, v @ self.R_xf @ v]
        return float(np.mean(self.windows * (powers[0] - 2 * g * powers[1] + g**2 * powers[2])))

    def balance(self, weight: float) -> float:
        v = self.filter(weight)
        g, power = self.gains(v), v @ self.R_x @ v
        passed, taken = (power * np.mean(self.windows * part) for part in (g == 1.0, g * (1.0 - g)))
        found, q = balance_of_power(self.of_x, self.of_xf, weight, v, passed, taken)
        assert q == pytest.approx(power, rel=1e-9)
        return found


@pytest.mark.parametrize("scatter_db", [0.5, 2.0, 5.0])
@pytest.mark.parametrize("share", [0.1, 0.25, 0.6])
def test_gain_and_loss_balance_where_the_error_is_least(share: float, scatter_db: float) -> None:
    """The least error is found by search, from its definition; more power pays below it, and less above it."""
    limited = Limited(STEEP, share * float(W @ W), scatter_db)
    search = scipy.optimize.minimize_scalar(
        lambda log: limited.error(math.exp(log)), bounds=(-14.0, 3.0), method="bounded", options={"xatol": 1e-4}
    )
    best = math.exp(search.x)
    assert abs(limited.balance(best)) < 0.05
    assert limited.balance(1.3 * best) > 0.1
    assert limited.balance(best / 1.3) < -0.1


def test_of_a_flat_path_nothing_is_lost() -> None:
    limited = Limited(FLAT, 0.25 * float(W @ W), 2.0)
    for weight in (0.01, 0.1, 1.0):
        assert limited.balance(weight) == pytest.approx(1.0, abs=1e-4)
    assert limited.error(0.0) < limited.error(0.1) < limited.error(0.5)


@pytest.mark.parametrize(
    ("weight", "passed", "taken"), [(math.inf, 1.0, 1.0), (0.1, 0.0, 0.0), (0.1, math.inf, 1.0), (0.0, 1.0, 0.0)]
)
def test_without_anything_to_weigh_the_balance_is_not_known(weight: float, passed: float, taken: float) -> None:
    assert math.isnan(balance_of_power(*rows(STEEP), weight, W, passed, taken)[0])


def test_what_passed_and_what_was_taken_are_running_means() -> None:
    """Plain means at first, then exponential ones; what rounding changes has passed, what is absurdly loud is capped."""
    rated_power, fs = 0.25, 100.0
    budget = PowerBudget(2, rated_power, fs=fs)
    budget.state.control_filter[:] = [1.0, 0.0]
    rng = np.random.default_rng(1)
    u = rng.standard_normal(500)
    y = np.where(rng.random(500) < 0.3, 0.6 * u, u * (1 + 1e-13))
    u[400], y[400] = 1e150, 2.0
    passed = taken = 0.0
    for n in range(500):
        budget.listen(u[n], u[n])
        budget.state.numbers["taken"] = float(n)
        hear_limiter(budget.state, u[n], y[n])
        asked, played = (np.clip(z / 0.5, -LOUDEST, LOUDEST) for z in (u[n], y[n]))
        same = abs(y[n] - u[n]) < 1e-9
        share = 1.0 / min(n + 1.0, LIMITER_MEMORY_S * fs + 1.0)
        passed += share * (asked**2 * same - passed)
        taken += share * (played * (asked - played) * (not same) - taken)
    assert budget.state.numbers["passed"][0] == pytest.approx(passed, rel=1e-9)
    assert budget.state.numbers["limited"][0] == pytest.approx(taken, rel=1e-9)


# ---- In the loop


def run(secondary: np.ndarray, x: np.ndarray, rated_power: float, limited: bool):
    """KF-PB whose estimate is W and stays it; W would cancel all."""
    limiter = OutputLimiter(rated_power, fs=FS) if limited else None
    controller = kf_pb(
        N_TAPS,
        secondary,
        secondary_path_uncertainty=None,
        rated_power=rated_power,
        limiter=limiter,
        state_noise=0.0,
        measurement_noise=1.0,
        initial_variance=0.0,
    )
    controller.estimator.x = W.reshape(-1, 1)
    d = np.convolve(x, np.convolve(W, secondary))[: x.size]
    result = simulate(controller, x, disturbance=d, secondary_path=secondary, switch_on_s=0.1)
    return result, controller.estimator.budget


def of_fixed_filters(secondary: np.ndarray, x: np.ndarray, rated_power: float, shares: np.ndarray) -> np.ndarray:
    """Noise reduction over the second half of the best fixed filter of each share of the power, behind the limiter."""
    d = np.convolve(x, np.convolve(W, secondary))[: x.size]
    reached = []
    for share in shares:
        bound = power_constrained_wiener(x, d, secondary, N_TAPS, share * rated_power, fs=FS, ridge=1e-9)
        y = OutputLimiter(rated_power, fs=FS).process(np.convolve(x, bound.whole.weights)[: x.size])
        reached.append(noise_reduction_db(d - np.convolve(y, secondary)[: x.size], d))
    return np.array(reached)


def noise(name: str) -> np.ndarray:
    rng = np.random.default_rng(2)
    if name == "fluctuating":
        level = 10 ** (scipy.signal.lfilter([0.004], [1, -0.996], 900 * rng.standard_normal(6 * FS)) / 250)
        return level * rng.standard_normal(6 * FS)
    return rng.standard_normal(6 * FS)


@pytest.mark.parametrize("name", ["steady", "fluctuating"])
@pytest.mark.parametrize("share", [0.25, 0.9])
def test_the_best_share_is_found(share: float, name: str) -> None:
    """Within 0.5 dB of the best of the fixed filters in hindsight, where that is below or above the rated power."""
    x, rated_power = noise(name), share * float(W @ W)
    result, budget = run(STEEP, x, rated_power, limited=True)
    shares = np.array([0.2, 0.3, 0.45, 0.65, 0.8, 1.0, 1.4])
    fixed = of_fixed_filters(STEEP, x, rated_power, shares)
    assert noise_reduction_db(result.error, result.disturbance) > np.max(fixed) - 0.5
    assert LEAST <= budget.ceiling <= MOST
    if (name, share) == ("steady", 0.9):  # more than enough for most of the noise: the limiter's share is what is left
        assert noise_reduction_db(result.error, result.disturbance) > fixed[shares == 1.0][0] + 3.0


@pytest.mark.parametrize("signal", ["noise", "tone"])
def test_of_a_flat_path_no_power_is_given_away(signal: str) -> None:
    """There the limiter's scaling in time is as good as any: less power would only reduce less."""
    x = band_limited_noise((100, 900), 6.0, fs=FS, rng=3) if signal == "noise" else tone(300, 6.0, fs=FS)
    rated_power = 0.25 * float(np.mean(np.convolve(x, W)[: x.size] ** 2))
    result, _ = run(FLAT, x, rated_power, limited=True)
    fixed = of_fixed_filters(FLAT, x, rated_power, np.array([0.6, 0.8, 1.0]))
    assert noise_reduction_db(result.error, result.disturbance) > np.max(fixed) - 0.1


def test_without_a_limiter_there_is_no_ceiling() -> None:
    _, budget = run(STEEP, noise("steady")[: 2 * FS], 0.25 * float(W @ W), limited=False)
    assert budget.ceiling == MOST
    assert budget.state.numbers["limited"][0] == 0.0
    assert budget.power_weight > 0.0


def limited_then_quiet(factor: float | None) -> tuple[PowerBudget, float, float]:
    """A loud noise, with a limiter or a factor behind the budget, then a quiet one; the ceiling after the loud one."""
    budget, limiter = PowerBudget(2, 0.25, fs=1000.0, memory_s=0.3), OutputLimiter(0.25, fs=1000.0)
    x = np.random.default_rng(4).standard_normal(20_000) * np.repeat([1.0, 0.2], 10_000)
    after = np.nan
    for n, value in enumerate(x):
        u = budget.control_signal(value)
        y = u * factor if factor is not None and n < 10_000 else limiter(u)
        budget.advance(value, value - 0.9 * x[n - 1] if n else 0.0, [1.0, 0.5], control_signal=y)
        if n == 9_999:
            after = budget.ceiling
    return budget, after, 1.25 * 0.2**2 / 0.25  # what the whole estimate needs of the quiet noise


def test_a_quiet_noise_does_not_lower_the_ceiling() -> None:
    """The loud one would otherwise find it there."""
    budget, after, _ = limited_then_quiet(None)
    assert budget.power_weight == 0.0
    assert after > 0.5
    assert budget.ceiling == pytest.approx(after, rel=0.05)


def test_a_ceiling_too_low_rises_until_the_estimate_fits() -> None:
    """What takes half of every sample leaves nothing that more power could add to, so the ceiling falls to its least."""
    budget, after, needed = limited_then_quiet(0.5)
    assert after == LEAST < needed
    assert budget.power_weight < 1e-3
    assert needed < budget.ceiling < 1.4 * needed  # what 0.4 s of the quiet noise need scatters by a tenth


def test_a_limiter_that_no_longer_acts_is_forgotten() -> None:
    """Noise that is loud and soft in turn; for five samples after 3 s, half of the control signal is limited."""
    means = []
    for limited in (False, True):
        budget = PowerBudget(2, 0.25, fs=1000.0, memory_s=0.3, averaging_s=2.0)
        x = np.random.default_rng(5).standard_normal(40_000) * np.tile(np.repeat([1.0, 0.2], 500), 40)
        spent = np.zeros(x.size)
        for n, value in enumerate(x):
            u = budget.control_signal(value)
            y = 0.5 * u if limited and 3000 <= n < 3005 else u
            budget.advance(value, value, [1.0, 0.0], control_signal=y)
            spent[n] = y * y / 0.25
        means.append(spent[-20_000:].mean())
    assert means[1] == pytest.approx(means[0], rel=0.01)


def test_a_rated_power_that_is_assigned_does_not_hurry_the_ceiling() -> None:
    """It is solved for at the next sample, but no more time has passed: the ceiling moves by the samples in between."""
    budget = PowerBudget(2, 0.25, fs=1000.0)
    for x in np.random.default_rng(6).standard_normal(3000):
        budget.advance(x, x, [2.0, -0.5])
    numbers, last = budget.state.numbers, int(budget.state.numbers["waited"][0])
    budget.rated_power = 0.0625
    before = budget.control_filter
    budget.advance(0.1, 0.1, [2.0, -0.5])
    assert np.sum(budget.control_filter**2) < 0.5 * np.sum(before**2)
    assert (numbers["interval"][0], numbers["waited"][0]) == (last + 1, 0.0)
    assert 0 < last < 100
