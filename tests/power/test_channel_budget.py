"""The control filters within each loudspeaker's power: against dense solves and the conditions of optimality."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.channels import constrained_filters, correlation, random_paths
from scipy.linalg import block_diag

from kfopc_filterpy.power.budget import left_of
from kfopc_filterpy.power.channels import RIDGE, ChannelBudget

K, J, REFERENCES, TAPS, PATH, PRIMARY = 4, 3, 2, 20, 8, 14


def scene(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Secondary and primary paths, and coloured references that are correlated with each other."""
    x = np.random.default_rng(seed).standard_normal((REFERENCES, 20000))
    x = np.array([np.convolve(row, [1.0, 0.5, -0.3], "same") for row in x])
    x[1] += 0.5 * np.roll(x[0], 3)
    primary = random_paths(K, REFERENCES, PRIMARY, seed=seed + 1, delay=4)
    return random_paths(K, J, PATH, seed=seed + 2), primary, x


def dense(secondary: np.ndarray, primary: np.ndarray, D: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R_x', R_x and r as sums over the taps of the paths; D[m] is that of lag m, D[-m].T of lag -m."""

    def at(lag: np.ndarray) -> np.ndarray:
        lag = np.asarray(lag)
        return np.where((lag >= 0)[..., None, None], D[np.abs(lag)], D[np.abs(lag)].swapaxes(-1, -2))

    steps, s, p = np.arange(TAPS), np.arange(PATH), np.arange(PRIMARY)
    lags = at(steps[:, None, None, None] - steps[None, :, None, None] + s[:, None] - s[None, :])  # l m t u i k
    R = np.einsum("cat,cbu,lmtuik->ailbkm", secondary, secondary, lags)
    cross = at(steps[:, None, None] + s[None, :, None] - p[None, None, :])  # l t u i k
    r = np.einsum("cat,cku,ltuik->ail", secondary, primary, cross)
    of_x = at(steps[:, None] - steps[None, :]).transpose(2, 0, 3, 1).reshape(REFERENCES * TAPS, -1)
    return R.reshape(J * REFERENCES * TAPS, -1), of_x, r.ravel()


def test_it_converges_to_the_dense_solution_with_complementary_slackness() -> None:
    secondary, primary, x = scene()
    rated = np.array([0.1, 0.2, 50.0])  # the last one does not bind
    budget = ChannelBudget(secondary, TAPS, PRIMARY, REFERENCES, rated, 100.0)
    D = correlation(x, budget.n_lags)
    for _ in range(40):
        budget.solve(D, primary)
    R, of_x, r = dense(secondary, primary, D)
    w, _, power = constrained_filters(R, of_x, r, rated, RIDGE)
    np.testing.assert_allclose(budget.weights.reshape(J, -1), w, rtol=1e-5, atol=1e-6 * np.abs(w).max())
    np.testing.assert_allclose(power[:2], rated[:2], rtol=1e-6)
    assert power[2] < rated[2]
    assert budget.penalty is not None
    assert budget.penalty[2] < 1e-4 * budget.penalty[0]  # the power that is not used up has no price
    penalties = block_diag(*(p * of_x for p in budget.penalty)) + RIDGE * np.trace(R) / len(R) * np.eye(len(R))
    residual = (R + penalties) @ budget.weights.ravel() - r
    assert np.abs(residual).max() < 1e-9 * np.abs(r).max()


def test_from_the_control_filters_without_a_limit_it_finds_the_same_as_from_the_paths() -> None:
    """r = R_x' w, for any w; for the w that is best without a limit it is the r of the primary paths."""
    secondary, primary, x = scene()
    rated = np.array([0.1, 0.2, 50.0])
    D = correlation(x, TAPS + PATH + PRIMARY)
    R, of_x, r = dense(secondary, primary, D)
    best = np.linalg.solve(R, r)
    other = best * np.random.default_rng(3).uniform(0.5, 1.5, r.size)
    for free, right in ((best, r), (other, R @ other)):
        budget = ChannelBudget(secondary, TAPS, 0, REFERENCES, rated, 100.0)
        for _ in range(60):
            budget.solve_near(D[: budget.n_lags], free.reshape(J, REFERENCES, TAPS))
        w, penalty, power = constrained_filters(R, of_x, right, rated, RIDGE)
        np.testing.assert_allclose(budget.weights.reshape(J, -1), w, rtol=1e-5, atol=1e-5 * np.abs(w).max())
        np.testing.assert_allclose(power[:2], rated[:2], rtol=1e-5)
        assert budget.penalty is not None
        np.testing.assert_allclose(budget.penalty[:2], penalty[:2], rtol=1e-4)
        assert power[2] < 0.9 * rated[2]
        assert budget.penalty[2] < 1e-4 * budget.penalty[0]  # the power that is not used up has no price


@pytest.mark.parametrize("coupling", [0.0, 0.9, 0.99, 0.99999])
def test_coupled_loudspeakers_settle_within_ten_solves(coupling: float) -> None:
    """One takes over what the other leaves: their penalties must not swing."""
    secondary, primary, x = scene()
    secondary[:, 1] = coupling * secondary[:, 0] + (1.0 - coupling) * secondary[:, 1]
    secondary, rated = secondary[:, :2], np.array([0.05, 0.05])
    budget = ChannelBudget(secondary, TAPS, PRIMARY, REFERENCES, rated, 100.0)
    D = correlation(x, budget.n_lags)
    for _ in range(10):
        budget.solve(D, primary)
    filters = budget.weights.reshape(2, -1)
    _, of_x, _ = dense(np.repeat(secondary, 2, axis=1)[:, :J], primary, D)
    np.testing.assert_allclose(np.einsum("ja,ab,jb->j", filters, of_x, filters), rated, rtol=0.02)


@pytest.mark.parametrize("fault", ["unplugged", "identical", "silent"])
def test_a_singular_case_stays_finite(fault: str) -> None:
    secondary, primary, x = scene()
    if fault == "unplugged":
        secondary[:, 1] = 0.0
    if fault == "identical":
        secondary[:, 1] = secondary[:, 0]
    budget = ChannelBudget(secondary, TAPS, PRIMARY, REFERENCES, np.array([0.1, 0.1, 0.1]), 100.0)
    D = correlation(x, budget.n_lags) * (fault != "silent")
    for _ in range(30):
        budget.solve(D, primary)
    assert np.isfinite(budget.weights).all()
    if fault == "unplugged":
        np.testing.assert_allclose(budget.weights[1], 0.0, atol=1e-9)
    if fault == "identical":  # the least norm: both share the work
        np.testing.assert_allclose(budget.weights[0], budget.weights[1], rtol=1e-6, atol=1e-9)
    if fault == "silent":
        np.testing.assert_array_equal(budget.weights, 0.0)


RATED, BLOCKS = np.array([0.1, 0.2, np.inf]), 160.0  # the last loudspeaker is not limited


def spent_on(levels: np.ndarray, wrong: np.ndarray, budget: ChannelBudget) -> np.ndarray:
    """Powers over the rated ones, (blocks, J); each loudspeaker spends `wrong` times what is expected."""
    _, primary, x = scene()
    D = correlation(x, budget.n_lags)
    blocks = []
    for level in levels:
        budget.solve(level * D, primary)
        expected = np.einsum("jit,jku,tuik->j", budget.weights, budget.weights, lagged(level * D))
        budget.spend(level * np.trace(D[0]), wrong * expected)
        blocks.append(wrong * expected / RATED)
    return np.array(blocks)


def lagged(D: np.ndarray) -> np.ndarray:
    """R_x as blocks of the taps, (t, u, i, k)."""
    lag = np.subtract.outer(np.arange(TAPS), np.arange(TAPS))
    return np.where((lag >= 0)[..., None, None], D[np.abs(lag)], D[np.abs(lag)].swapaxes(-1, -2))


def limited_budget() -> ChannelBudget:
    return ChannelBudget(scene()[0], TAPS, PRIMARY, REFERENCES, RATED, BLOCKS)


def test_the_mean_power_is_kept_although_every_prediction_is_wrong() -> None:
    """What was spent corrects the level, so a factor is found in one averaging time; to a hundredth."""
    budget = limited_budget()
    mean = spent_on(np.ones(500), np.array([1.3, 0.7, 1.0]), budget)[-int(BLOCKS) :].mean(axis=0)
    np.testing.assert_allclose(mean, [1.0, 1.0, 0.0], atol=0.01)
    assert budget.target_power[2] == np.inf


def test_noise_that_recurs_gets_power_in_proportion_to_its_level() -> None:
    """Loud and soft in turn: the same control filters, and the rated power on average."""
    levels = np.tile(np.repeat([1.5, 0.5], 20), 15)
    power = spent_on(levels, np.ones(J), limited_budget())[-160:, :2]
    np.testing.assert_allclose(power.mean(axis=0), 1.0, atol=0.03)
    soft, loud = power[levels[-160:] == 0.5], power[levels[-160:] == 1.5]
    np.testing.assert_allclose(loud.mean(axis=0) / soft.mean(axis=0), 3.0, rtol=0.15)


def test_nothing_is_saved_while_the_control_is_off_or_before_the_first_solution() -> None:
    """After it, a loudspeaker that emits nothing saves all of the power. In bins, of which 80 are the averaging time."""
    budget = limited_budget()

    def left_after(power: np.ndarray | None) -> list[float]:
        for _ in range(200):
            budget.spend(1.0, power)
        return [left_of(spending)[0] for spending in budget._spending]

    assert left_after(np.zeros(J)) == [0.0] * J
    limits(budget)  # solves
    assert left_after(None) == [0.0] * J
    assert left_after(np.zeros(J)) == [80.0] * J


def test_several_blocks_count_as_many() -> None:
    one, several = limited_budget(), limited_budget()
    for n in range(1, 30):
        power = np.array([0.1, 0.3, 0.2]) * n / 15
        several.spend(n / 15, power, n)
        for _ in range(n):
            one.spend(n / 15, power)
    np.testing.assert_array_equal(limits(several), limits(one))
    several.spend(1.0, power, 10**9)  # at once
    for _ in range(200):
        one.spend(1.0, power)
    np.testing.assert_allclose(limits(several), limits(one), rtol=1e-9)


def limits(budget: ChannelBudget) -> np.ndarray:
    """The powers that a solution at level 1 aims at."""
    _, primary, x = scene()
    D = correlation(x, budget.n_lags)
    budget.solve(D / np.trace(D[0]), primary)
    return budget.target_power
