"""Conditions that any right answer of KF-PB meets, whatever the way to it: computed from the signals alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import toeplitz

from kfopc_filterpy import Plant, kf_pb, simulate

FS, L, M = 2000.0, 16, 8
N, BLOCK, T = L + M - 1, 64, 62  # taps of a primary path; samples of a block; blocks in the averaging time
AVERAGING_S = T * BLOCK / FS
MEMORY_S = 5.0  # of the plant
S = np.array([0.0, 0.0, 1.0, -0.4, 0.2, 0.1, 0.0, 0.0])


def paths(rng: np.random.Generator, channels: tuple[int, int], taps: int) -> np.ndarray:
    """Return random paths that fade, with a delay of two samples."""
    drawn = rng.standard_normal((*channels, taps)) * np.exp(-np.arange(taps) / 4)
    drawn[..., :2] = 0.0
    return drawn


def delayed(signal: np.ndarray, taps: int) -> np.ndarray:
    """Return [signal(t - l)], l < taps, (n, taps); silence before."""
    return toeplitz(signal, np.zeros(taps))


@pytest.mark.parametrize(("K", "J", "references"), [(1, 1, 1), (3, 2, 1), (2, 2, 2)])
def test_the_filters_are_stationary_at_the_prices(K: int, J: int, references: int) -> None:
    """They solve min sum_k |d_k - F_k v|^2 + sum_j price_j |X v_j|^2 over a period of the references, and spend the ratings.

    The references repeat themselves, block by block, so the window of the law has the lags of the period. 1 %: the newest
    block fades in, and the path is learned from finite data.
    """
    rng = np.random.default_rng(K)
    period = rng.standard_normal((references, BLOCK))
    s, p = paths(rng, (K, J), M), paths(rng, (K, references), N)
    x = np.tile(period, 600)
    d = np.array([sum(np.convolve(p[k, i], x[i])[: x.shape[1]] for i in range(references)) for k in range(K)])
    rated = np.linspace(0.2, 0.1, J) * np.mean(d**2)
    controller = kf_pb(
        L,
        s,
        rated_power=rated,
        fs=FS,
        averaging_s=AVERAGING_S,
        n_references=references,
        secondary_path_uncertainty=None,
    )
    noisy = d + 1e-3 * rng.standard_normal(d.shape)
    result = simulate(controller, x, Plant(s, fs=FS), disturbance=noisy)
    spent = np.mean(np.atleast_2d(result.control_signal)[:, -T * BLOCK :] ** 2, axis=1)
    np.testing.assert_allclose(spent, rated, rtol=0.03)

    steady = slice(2 * BLOCK, 3 * BLOCK)  # a whole period
    x, d = x[:, : 3 * BLOCK], d[:, steady]
    X = np.concatenate([delayed(signal, L) for signal in x], axis=1)
    F = [[np.array([np.convolve(s[k, j], c)[: len(X)] for c in X.T]).T[steady] for j in range(J)] for k in range(K)]
    own = np.kron(np.diag(np.sqrt(np.ravel(controller.power_weight))), X[steady])
    rows, right = np.concatenate([np.block(F), own]), np.concatenate([d.ravel(), np.zeros(len(own))])
    v = np.ravel(controller.weights)
    gradient = rows.T @ (right - rows @ v)
    assert np.linalg.norm(gradient) < 0.01 * np.linalg.norm(rows.T @ right)
    best = np.linalg.lstsq(rows, right)[0]
    left, least = (np.sum((right - rows @ h) ** 2) for h in (v, best))
    assert left < least + 1e-4 * np.sum(right**2)  # a filter 3 % smaller: 3e-4


def faded_posterior(
    x: np.ndarray, y: np.ndarray, e: np.ndarray, s_hat: np.ndarray, spread: float, q: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean and precision times q of [p, s] after e = p * x - s * y + noise of power q, and s^ as prior mean.

    The data fade with the memory; p is expected to be as large as the disturbance over the reference.
    """
    Z = np.concatenate([delayed(x, N), delayed(-y, M)], axis=1)[N:]  # from where the delay lines are full
    age = np.exp(-np.arange(len(Z))[::-1] / (MEMORY_S * FS))[:, None]
    d = e[N:] + np.convolve(s_hat, y)[N : len(e)]
    size_of_p = (np.mean(d**2) + np.mean(e**2)) / np.mean(x**2)
    precision = np.repeat([N / size_of_p, M / (spread**2 * np.sum(s_hat**2))], [N, M])
    prior = np.concatenate([np.zeros(N), s_hat])
    A = Z.T @ (age * Z) + q * np.diag(precision)
    return np.linalg.solve(A, Z.T @ (age[:, 0] * e[N:]) + q * precision * prior), A, prior


@pytest.mark.parametrize("rated", [0.5, 1e-3])
def test_the_posterior_is_that_of_a_batch(rated: float) -> None:
    """Within a fifth of its own standard deviation, all taps together, after two seconds.

    With little power played, s^ counts: without it the mean would be elsewhere.
    """
    rng = np.random.default_rng(3)
    n = 2 * round(FS) // BLOCK * BLOCK
    true = S + 0.1 * rng.standard_normal(M)
    x = rng.standard_normal(n)
    x[0] = 3.0  # sets in at once: no sample is cut as a click
    d = np.convolve(paths(rng, (1, 1), N)[0, 0], x)[:n] + 0.1 * rng.standard_normal(n)
    controller = kf_pb(L, S, rated_power=rated, fs=FS, averaging_s=AVERAGING_S, secondary_path_uncertainty=0.3)
    result = simulate(controller, x, Plant(true, fs=FS), disturbance=d)
    assert controller.alarms == 0
    q = controller.measurement_noise
    assert q == pytest.approx(0.01, rel=0.1)
    mean, A, prior = faded_posterior(x, result.control_signal, result.error, S, 0.3, q)

    def apart(theta: np.ndarray) -> float:
        """Distance from the batch's mean, in standard deviations of the posterior: 1 for a draw from it."""
        return float(np.sqrt((theta - mean) @ A @ (theta - mean) / (mean.size * q)))

    p, s = controller.primary_path, controller.identified_path
    assert apart(np.concatenate([p, s])) < 0.2
    assert apart(prior) > 10.0
    free = faded_posterior(x, result.control_signal, result.error, S, 1e3, q)[0]
    assert (apart(free) > 1.0) == (rated < 0.1)


EVENTS: dict[str, Any] = {
    "steady": (1.0, 1.0, 1.0),  # gains of the reference, of the primary and of the secondary path
    "loud": (20.0, 1.0, 1.0),
    "silent": (0.0, 1.0, 1.0),
    "soft": (0.01, 1.0, 1.0),
    "louder path": (1.0, 10.0, 1.0),
    "other primary path": (1.0, -1.0, 1.0),
    "other secondary path": (1.0, 1.0, -1.0),
    "weak loudspeaker": (1.0, 1.0, 0.1),
}


@settings(max_examples=25, deadline=None)
@given(events=st.lists(st.sampled_from(sorted(EVENTS)), min_size=2, max_size=6), seed=st.integers(0, 100))
def test_no_averaging_time_has_more_than_the_hard_end_whatever_happens(events: list[str], seed: int) -> None:
    """1.04 of the rating over any T blocks, at whatever sample they begin; 1e-9 is rounding."""
    rng, rated = np.random.default_rng(seed), 0.1
    controller = kf_pb(L, S, rated_power=rated, fs=FS, averaging_s=AVERAGING_S)
    played = []
    for event in events:
        reference, primary, secondary = EVENTS[event]
        x = reference * rng.standard_normal(rng.integers(1, 6000))
        x[0] *= 1000.0  # a click
        result = simulate(controller, x, Plant(secondary * S, primary * np.roll(np.pad(S, (0, 8)), 2), fs=FS))
        played.append(result.control_signal)
    y = np.concatenate(played)
    total = np.concatenate([[0.0], np.cumsum(y**2)])
    over = total[T * BLOCK :] - total[: -T * BLOCK] if y.size > T * BLOCK else total[-1:]
    assert np.max(over) / (T * BLOCK) <= 1.04 * rated * (1 + 1e-9)
