"""The covariance kernel against filterpy's filter, against what it owes written out, and against its own undoing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from helpers.comparing import assert_close
from helpers.rows import rows_of

from kfopc_filterpy.kernels.compiling import compiled
from kfopc_filterpy.kernels.covariance import (
    CANCELLATION,
    Covariance,
    copy_covariance,
    covariance_matrix,
    kalman_step,
    new_covariance,
    project_covariance,
)
from kfopc_filterpy.loop.scenarios import SharedGains, advance_gains


def some_covariance(n: int, owed: tuple[float, float, float]) -> tuple[Covariance, np.ndarray]:
    """A covariance that owes (scale, diagonal, inverse S), and P written out."""
    rng = np.random.default_rng(n)
    A, direction = rng.standard_normal((n, n)), rng.standard_normal(n)
    g = A @ direction / (2.0 * np.linalg.norm(direction))  # so that P is positive semidefinite up to inverse_S = 4
    cov, (scale, diagonal, inverse_S) = new_covariance(A @ A.T), owed
    cov.gain_direction[:] = g
    for name, value in zip(("scale", "diagonal", "inverse_S"), owed, strict=True):
        cov.owed[name] = value
    return cov, scale * (A @ A.T - inverse_S * np.outer(g, g)) + diagonal * np.eye(n)


@compiled(cache=False)
def projected(cov, h):
    """Call `project_covariance`."""
    return project_covariance(cov, h)


@compiled(cache=False)
def stepped(cov, w, h, z, r, q, alpha_sq):
    """Call `kalman_step`."""
    return kalman_step(cov, w, h, z, r, q, alpha_sq)


OWED = [(1.0, 0.0, 0.0), (1.0, 2e-3, 0.0), (1.02, 1e-3, 0.4), (0.5, 0.0, 3.0)]


@pytest.mark.parametrize("owed", OWED)
@pytest.mark.parametrize("n", [1, 2, 7, 16])
def test_a_projection_pays_what_is_owed(n: int, owed: tuple[float, float, float]) -> None:
    """P written out, and P h; 4 roundings of numbers up to the largest in P, and of a sum of n."""
    cov, P = some_covariance(n, owed)
    g, h = cov.gain_direction.copy(), np.random.default_rng(99).standard_normal(n)
    assert_close(covariance_matrix(cov), P, 4e-15)
    hPh = projected(cov, h)
    assert cov.owed.item()[:3] == (1.0, 0.0, 0.0)
    np.testing.assert_array_equal(cov.gain_direction, g)
    assert_close(np.tril(cov.triangle[:n, :n]), np.tril(P), 4e-15, np.abs(P).max())
    assert_close(cov.product, P @ h, n * 4e-15, np.abs(P).max() * np.abs(h).max())
    assert hPh == pytest.approx(h @ P @ h, abs=n * n * 4e-15 * np.abs(P).max() * np.abs(h).max() ** 2)
    assert_close(covariance_matrix(cov), P, 4e-15)


@pytest.mark.parametrize("owed", OWED)
@pytest.mark.parametrize("n", [1, 5, 16])
def test_a_copy_owes_the_same_and_shares_nothing(n: int, owed: tuple[float, float, float]) -> None:
    cov, _ = some_covariance(n, owed)
    other = copy_covariance(cov)
    np.testing.assert_array_equal(covariance_matrix(other), covariance_matrix(cov))
    for mine, theirs in zip(cov, other, strict=True):
        assert not np.shares_memory(mine, theirs)
    assert other.triangle.ctypes.data % 64 == cov.triangle.ctypes.data % 64 == 0  # rows begin at cache lines
    before = covariance_matrix(cov)
    projected(other, np.ones(n))
    np.testing.assert_array_equal(covariance_matrix(cov), before)


# ---- Steps, and the gains of a run without weights, against filterpy


class Filterpy:
    """filterpy's filter, which keeps the gain direction g = S K."""

    def __init__(self, P: np.ndarray, r: float, q: float, alpha: float) -> None:
        self.kf, n = KalmanFilter(len(P), 1), len(P)
        self.kf.P, self.kf.Q, self.kf.R, self.kf.alpha = np.array(P), r * np.eye(n), np.array([[q]]), alpha

    def take(self, h: np.ndarray, z: float = 0.0) -> tuple[np.ndarray, float]:
        self.kf.predict()
        self.kf.update(np.array([[z]]), H=h.reshape(1, -1))
        return self.kf.K[:, 0] * self.kf.S[0, 0], self.kf.S[0, 0]


def gains_of(cov: Covariance, line: np.ndarray, r: float, q: float, alpha: float) -> tuple[SharedGains, int]:
    """Gains for all rows of a line of samples, newest first, and how many were found."""
    n, m = cov.product.size, line.size - cov.product.size + 1
    gains = SharedGains(np.zeros((m, n)), np.zeros(m), np.full(m, np.nan), np.zeros(1, np.int64))
    return gains, advance_gains(cov, line, r, q, alpha**2, gains)


@pytest.mark.parametrize("alpha", [1.0, 1.01])
@pytest.mark.parametrize("r", [0.0, 1e-4])
@pytest.mark.parametrize("kind", ["unrelated", "line"])
@pytest.mark.parametrize("n", [1, 2, 3, 8, 30, 67])
def test_steps_are_filterpys_filter(n: int, kind: str, r: float, alpha: float) -> None:
    """S stays below 1000 q, which costs three digits: errors were 6e-14 at most."""
    q, rng = 0.5, np.random.default_rng(n)
    rows, w = rows_of(kind, n, 150, rng), np.zeros(n)
    cov, theirs = new_covariance(np.eye(n)), Filterpy(np.eye(n), r, q, alpha)
    for h in rows:
        z = rng.standard_normal()
        y, S = stepped(cov, w, h, z, r, q, alpha**2)
        direction, variance = theirs.take(h, z)
        assert_close(cov.gain_direction, direction, 1e-12)
        assert pytest.approx(variance, rel=1e-12) == S
        assert y == pytest.approx(theirs.kf.y.item(), rel=1e-9, abs=1e-12)
    assert_close(w, theirs.kf.x[:, 0], 1e-11)
    assert_close(covariance_matrix(cov), theirs.kf.P, 1e-11 if alpha > 1.0 else 1e-12)


@pytest.mark.parametrize("alpha", [1.0, 1.01])
@pytest.mark.parametrize(("P0", "q"), [(1.0, 0.5), (1e3, 1e-4)], ids=["", "large start"])
@pytest.mark.parametrize("n", [1, 3, 8, 30])
def test_the_gains_of_a_line_are_those_of_the_steps_bit_for_bit(n: int, P0: float, q: float, alpha: float) -> None:
    """The gain knows nothing of what is measured. A large start takes the downdate in twice the precision."""
    line = np.random.default_rng(n).standard_normal(200)
    one, two, w = new_covariance(P0 * np.eye(n)), new_covariance(P0 * np.eye(n)), np.zeros(n)
    gains, found = gains_of(one, line, 1e-5, q, alpha)
    assert found == gains.variances.size
    largest = 0.0
    for k in range(found):
        h = line[found - 1 - k :][:n].copy()
        _, S = stepped(two, w, h, 1.0, 1e-5, q, alpha**2)
        np.testing.assert_array_equal(gains.directions[k], two.gain_direction)
        assert gains.variances[k] == pytest.approx(S, rel=1e-9)
        assert gains.norms[k] == pytest.approx(np.linalg.norm(two.gain_direction), rel=1e-14)
        largest = max(largest, S / q)
    assert (largest > CANCELLATION) == (P0 > 1.0)
    for mine, theirs in zip(one, two, strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("r", [0.0, 1e-5])
@pytest.mark.parametrize("kind", ["line", "low-passed line", "tonal line"])
@pytest.mark.parametrize("n", [8, 30])
def test_P_stays_symmetric_and_positive_definite(n: int, kind: str, r: float) -> None:
    """3000 rows, some of which leave whole directions unseen, where P keeps its first variance or grows by r."""
    cov, w = new_covariance(np.eye(n)), np.zeros(n)
    for k, h in enumerate(rows_of(kind, n, 3000, np.random.default_rng(n))):
        stepped(cov, w, h, 1.0, r, 0.5, 1.0)
        if k % 50 == 49:
            P = covariance_matrix(cov)
            np.testing.assert_array_equal(P, P.T)
            np.linalg.cholesky(P)  # raises where it is not positive definite
    assert np.linalg.eigvalsh(P)[0] < 0.05  # it did learn


# ---- Steps without a solution


@pytest.mark.parametrize("alpha_sq", [1.0, 1.02])
@pytest.mark.parametrize("owed", OWED)
@pytest.mark.parametrize("cause", ["S overflows", "silent", "indefinite", "weights overflow", "no number"])
@pytest.mark.parametrize("n", [1, 4, 9])
def test_a_step_without_a_solution_changes_nothing(n: int, cause: str, owed: Any, alpha_sq: float) -> None:
    """To rounding of what was paid and is owed again."""
    cov, _ = some_covariance(n, owed)
    h, q, z, r = np.ones(n), 0.5, 1.0, 1e-3
    if cause == "S overflows":
        h = np.full(n, 1e160)
    elif cause == "silent":
        h, q = np.zeros(n), 0.0
    elif cause == "indefinite":
        q = -1e9
    elif cause == "weights overflow":
        z = 1e308
        h = np.full(n, 1e-300)
        q = 1e-320
    else:
        z = np.nan
    w = np.full(n, 0.25)
    P, kept = covariance_matrix(cov), cov.owed.item()
    y, _ = stepped(cov, w, h, z, r, q, alpha_sq)
    assert not np.isfinite(y)
    np.testing.assert_array_equal(w, 0.25)
    assert cov.owed.item() == kept
    assert_close(covariance_matrix(cov), P, 1e-13)


# ---- A P whose small variances are lost in the rounding of its large ones


def split_covariance(small: float, dtype: Any = np.float64) -> tuple[Covariance, np.ndarray, np.ndarray]:
    """A covariance with variance 1 along all directions but one, where it is `small`; P written out, and that direction."""
    direction = np.array([0.6, 0.0, -0.8])
    P = np.eye(3) - (1.0 - small) * np.outer(direction, direction)
    return new_covariance(P, dtype), P, direction


def test_a_negative_variance_is_raised_above_zero() -> None:
    """By twice what is missing, and the last digit of the largest variance."""
    cov, P, h = split_covariance(-1e-13)
    variance = projected(cov, 2.0 * h)
    eps = np.finfo(np.float64).eps
    assert variance == pytest.approx(4.0 * (1e-13 + eps), rel=0.05)
    after = covariance_matrix(cov)
    np.testing.assert_allclose(after - P, (2e-13 + eps) * np.eye(3), rtol=0, atol=2e-15)
    np.testing.assert_allclose(cov.product, after @ (2.0 * h), rtol=0, atol=2e-15)
    assert np.linalg.eigvalsh(after)[0] > 0.0


@pytest.mark.parametrize(("small", "floored"), [(1e-16, True), (1e-13, False)])
def test_state_noise_is_added_only_from_when_a_variance_is_lost_in_rounding(small: float, floored: bool) -> None:
    """16 roundings of the largest variance are 3.6e-15. The state noise is two of them, and begins with the next sample."""
    cov, P, h = split_covariance(small)
    projected(cov, h)
    np.testing.assert_allclose(covariance_matrix(cov), P, rtol=0, atol=4e-16)
    for _ in range(50):
        projected(cov, h)
    expected = P + 50 * 2 * np.finfo(np.float64).eps * np.eye(3) if floored else P
    np.testing.assert_allclose(covariance_matrix(cov), expected, rtol=0, atol=2e-15)


def test_a_small_p_beside_a_large_row_is_not_taken_for_rounding() -> None:
    """What counts is h'P h over h'h and the largest variance now, not the one at the start."""
    cov = new_covariance(np.eye(2))
    w = np.zeros(2)
    for h in (np.array([1e3, 0.0]), np.array([0.0, 1e3])) * 4:
        stepped(cov, w, h, 1.0, 0.0, 1e-12, 1.0)
    assert np.all(np.diagonal(covariance_matrix(cov)) < 1e-17)
    projected(cov, np.array([1.0, 1.0]))
    assert cov.owed["floored"][0] == 0.0
    assert cov.owed["bound"][0] < 1e-17


def test_the_state_noise_against_rounding_does_not_compound() -> None:
    """It is at most what the largest variance at the start asks for: P grows in a line, and not without bound."""
    cov, _, h = split_covariance(1e-16, np.float32)
    for _ in range(3000):
        stepped(cov, np.zeros(3), h, 0.0, 0.0, 1.0, 1.0)
    eps = np.finfo(np.float32).eps
    assert covariance_matrix(cov)[1, 1] == pytest.approx(1.0 + 3000 * 2 * eps, rel=1e-4)


def test_the_gains_of_a_line_stop_where_a_sample_has_no_solution() -> None:
    """A silent row without measurement noise, after ones that are taken."""
    line = np.random.default_rng(0).standard_normal(24)
    line[:15] = 0.0  # the newest
    gains, found = gains_of(new_covariance(np.eye(5)), line, 1e-4, 0.0, 1.0)
    assert found == 20 - 11
    np.testing.assert_array_equal(np.isnan(gains.variances), np.arange(20) >= found)
    before = new_covariance(np.eye(5))
    gains_of(before, line[20 - found :], 1e-4, 0.0, 1.0)
    # the prediction of the refused sample stands
    after = new_covariance(np.eye(5))
    gains_of(after, line, 1e-4, 0.0, 1.0)
    assert_close(covariance_matrix(after), covariance_matrix(before) + 1e-4 * np.eye(5), 1e-12)
