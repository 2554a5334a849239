"""The core's covariance as numba and Python step it: against filterpy, 50 digits, and P written out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from helpers.comparing import assert_close
from helpers.rows import rows_of

from kfopc_filterpy.core.block import LOUD_STEP, NO_SOLUTION
from kfopc_filterpy.kernels.compiling import compiled
from kfopc_filterpy.kernels.covariance import (
    Covariance,
    copy_covariance,
    covariance_matrix,
    covariance_update,
    direction_of,
    full_covariance,
    kalman_step,
    new_covariance,
    owed_of,
)
from kfopc_filterpy.signals import band_limited_noise

DONE = 0
EPS = np.finfo(np.float64).eps
SIZES = [1, 2, 7, 8, 9, 33]  # around a group of 8 rows
OWED = [(1.0, 0.0, 0.0), (1.0, 2e-3, 0.0), (1.02, 1e-3, 1.0), (0.5, 0.0, 1.0)]


@compiled(cache=False)
def stepped(cov, w, h, z, r, q, alpha_sq):
    """Call `kalman_step`."""
    return kalman_step(cov, w, h, z, r, q, alpha_sq)


def updated(cov: Covariance, w: np.ndarray, h: np.ndarray, z: float, q: float) -> int:
    """Call `covariance_update`."""
    w_at, h_at = w.ctypes.data, h.ctypes.data
    return covariance_update(cov.memory.ctypes.data, w.size, w_at, h_at, z, q, cov.result.ctypes.data)


def some_covariance(n: int, owed: tuple[float, float, float]) -> tuple[Covariance, np.ndarray]:
    """A covariance that owes (scale, diagonal, pending), and P written out."""
    rng = np.random.default_rng(n)
    A, direction = rng.standard_normal((n, n)), rng.standard_normal(n)
    u = A @ direction / (2.0 * np.linalg.norm(direction))  # so that P stays positive semidefinite
    cov, (scale, diagonal, pending) = new_covariance(A @ A.T), owed
    direction_of(cov, n)[:] = u
    for name, value in zip(("scale", "diagonal", "pending"), owed, strict=True):
        owed_of(cov)[name] = value
    return cov, scale * (A @ A.T - pending * np.outer(u, u)) + diagonal * np.eye(n)


# ---- Memory


@pytest.mark.parametrize("n", SIZES)
def test_a_covariance_is_the_array_that_it_was_made_of(n: int) -> None:
    """To the bit. Of an array that is not symmetric, the lower triangle counts."""
    A = np.random.default_rng(n).standard_normal((n, n))
    P = A @ A.T
    P = np.tril(P) + np.tril(P, -1).T
    np.testing.assert_array_equal(covariance_matrix(new_covariance(P), n), P)
    np.testing.assert_array_equal(covariance_matrix(new_covariance(P + np.triu(A, 1)), n), P)


@pytest.mark.parametrize("owed", OWED)
@pytest.mark.parametrize("n", SIZES)
def test_what_is_owed_is_part_of_p(n: int, owed: tuple[float, float, float]) -> None:
    cov, P = some_covariance(n, owed)
    full = covariance_matrix(cov, n)
    assert_close(full, P, 4 * EPS)
    np.testing.assert_array_equal(full, full.T)
    assert not np.shares_memory(full, cov.memory)


def test_a_triangle_is_rows_that_end_with_their_group() -> None:
    """Of 8 rows. Beside T, P has a multiple of u u' and of I."""
    n = 10
    T = np.arange(256.0).reshape(16, 16)
    T = np.tril(T) + np.tril(T, -1).T
    triangle = np.concatenate([T[i, : 8 * (i // 8 + 1)] for i in range(16)])
    u = np.arange(1.0, n + 1)
    P = full_covariance(triangle, u, 2.0, 3.0, -0.5)
    np.testing.assert_array_equal(P, 2.0 * T[:n, :n] - 0.5 * np.outer(u, u) + 3.0 * np.eye(n))


@pytest.mark.parametrize("owed", OWED)
@pytest.mark.parametrize("n", SIZES)
def test_a_copy_owes_the_same_and_shares_nothing(n: int, owed: tuple[float, float, float]) -> None:
    cov, _ = some_covariance(n, owed)
    other = copy_covariance(cov, n)
    np.testing.assert_array_equal(other.memory, cov.memory)
    assert not np.shares_memory(other.memory, cov.memory)
    assert other.memory.ctypes.data % 64 == cov.memory.ctypes.data % 64 == 0  # rows begin at cache lines
    before = cov.memory.copy()
    stepped(other, np.zeros(n), np.ones(n), 1.0, 1e-3, 0.5, 1.0)
    np.testing.assert_array_equal(cov.memory, before)


# ---- Steps


@pytest.mark.parametrize("owed", OWED)
@pytest.mark.parametrize("n", SIZES)
def test_a_step_is_eq_4_to_8(n: int, owed: tuple[float, float, float]) -> None:
    """Written out in numpy: a few roundings of numbers up to the largest in P, and of a sum of n."""
    cov, P = some_covariance(n, owed)
    rng = np.random.default_rng(99)
    h, w, r, q, alpha_sq, z = rng.standard_normal(n), rng.standard_normal(n), 1e-3, 0.5, 1.01, 2.0
    before, P = w.copy(), alpha_sq * P + r * np.eye(n)
    y, S = stepped(cov, w, h, z, r, q, alpha_sq)
    g = P @ h
    assert pytest.approx(h @ g + q, rel=1e-12) == S
    assert y == pytest.approx(z - h @ before, rel=1e-12)
    scale = np.abs(P).max()
    assert_close(direction_of(cov, n) * np.sqrt(S), g, n * 8 * EPS, scale * np.abs(h).max())
    assert_close(covariance_matrix(cov, n), P - np.outer(g, g) / S, n * 8 * EPS, scale)
    assert_close(w, before + g / S * y, n * 8 * EPS, np.abs(g / S * y).max() + np.abs(before).max())


@pytest.mark.parametrize("alpha", [1.0, 1.01])
@pytest.mark.parametrize("r", [0.0, 1e-4])
@pytest.mark.parametrize("kind", ["unrelated", "line"])
@pytest.mark.parametrize("n", [*SIZES, 67])
def test_steps_are_filterpys_filter(n: int, kind: str, r: float, alpha: float) -> None:
    """S stays below 1000 q, which costs three digits: errors were 6e-14 at most."""
    q, rng = 0.5, np.random.default_rng(n)
    rows, w = rows_of(kind, n, 150, rng), np.zeros(n)
    cov, kf = new_covariance(np.eye(n)), KalmanFilter(n, 1)
    kf.P, kf.Q, kf.R, kf.alpha = np.eye(n), r * np.eye(n), np.array([[q]]), alpha
    for h in rows:
        z = rng.standard_normal()
        y, S = stepped(cov, w, h, z, r, q, alpha**2)
        kf.predict()
        kf.update(np.array([[z]]), H=h.reshape(1, -1))
        assert_close(direction_of(cov, n) / np.sqrt(S), kf.K[:, 0], 1e-12)
        assert pytest.approx(kf.S.item(), rel=1e-12) == S
        assert y == pytest.approx(kf.y.item(), rel=1e-9, abs=1e-12)
    assert_close(w, kf.x[:, 0], 1e-11)
    assert_close(covariance_matrix(cov, n), kf.P, 1e-11 if alpha > 1.0 else 1e-12)


@pytest.mark.parametrize("P0", [1.0, 1e6])
@pytest.mark.parametrize("n", SIZES)
def test_an_update_is_a_step_without_a_prediction_bit_for_bit(n: int, P0: float) -> None:
    """The function that Python calls, and the one that numba's code calls; a large start takes twice the precision."""
    rng = np.random.default_rng(n)
    one, two, w, v = new_covariance(P0 * np.eye(n)), new_covariance(P0 * np.eye(n)), np.zeros(n), np.zeros(n)
    for h in rng.standard_normal((60, n)):
        z = rng.standard_normal()
        stepped(one, w, h, z, 0.0, 0.1, 1.0)
        assert updated(two, v, h, z, 0.1) == DONE
        np.testing.assert_array_equal(one.memory, two.memory)
        np.testing.assert_array_equal(one.result, two.result)
        np.testing.assert_array_equal(w, v)


# ---- A large initial variance: the downdate in twice the precision


@pytest.mark.parametrize(("ratio", "careful"), [(900.0, False), (1100.0, True)])
def test_the_downdate_is_careful_where_s_is_above_a_thousand_q(ratio: float, careful: bool) -> None:
    """Then it is applied at once, and nothing is pending."""
    cov = new_covariance(np.eye(9))
    h = np.zeros(9)
    h[4] = 1.0
    stepped(cov, np.zeros(9), h, 0.0, 0.0, 1.0 / ratio, 1.0)
    assert owed_of(cov)["pending"][0] == (0.0 if careful else 1.0)


def fifty_digits(P: Any, h: np.ndarray, q: float) -> Any:
    """Eq. 8 in 50 digits."""
    row = mpmath.matrix([mpmath.mpf(v) for v in h.tolist()])
    g = P * row
    return P - g * g.T / ((row.T * g)[0] + mpmath.mpf(q))


def as_array(P: Any) -> np.ndarray:
    return np.array([[float(P[i, j]) for j in range(P.cols)] for i in range(P.rows)])


@pytest.mark.parametrize("P0", [1e6, 1e12, 1e15])
@pytest.mark.parametrize("n", SIZES)
def test_a_careful_downdate_has_every_digit_of_each_element(n: int, P0: float) -> None:
    """Whatever cancels. q = 1; a plain downdate would leave P0 times the rounding."""
    h = np.random.default_rng(n).standard_normal(n)
    cov = new_covariance(P0 * np.eye(n))
    stepped(cov, np.zeros(n), h, 0.0, 0.0, 1.0, 1.0)
    with mpmath.workdps(50):
        exact = as_array(fifty_digits(mpmath.mpf(P0) * mpmath.eye(n), h, 1.0))
    got = covariance_matrix(cov, n)
    np.testing.assert_array_equal(got, got.T)
    assert np.all(np.abs(got - exact) <= 2 * EPS * np.abs(exact))


@pytest.mark.parametrize("n", [2, 7, 9])
def test_a_large_start_is_forgotten(n: int) -> None:
    """After as many rows as there are weights, P is of the size of q, to as many digits as P0 leaves it: P0/q is 1e9."""
    rows, P0 = np.linalg.qr(np.random.default_rng(n).standard_normal((n, n)))[0], 1e9
    rows = np.concatenate((rows, rows[::-1]))
    cov = new_covariance(P0 * np.eye(n))
    with mpmath.workdps(50):
        exact = mpmath.mpf(P0) * mpmath.eye(n)
        for h in rows:
            stepped(cov, np.zeros(n), np.ascontiguousarray(h), 0.0, 0.0, 1.0, 1.0)
            exact = fifty_digits(exact, h, 1.0)
    wanted = as_array(exact)
    assert np.abs(wanted).max() < 1.0
    assert_close(covariance_matrix(cov, n), wanted, 4 * P0 * EPS)


# ---- Many steps


@pytest.mark.parametrize("r", [0.0, 1e-5])
@pytest.mark.parametrize("kind", ["line", "low-passed line", "tonal line"])
@pytest.mark.parametrize("n", [8, 30])
def test_p_stays_symmetric_and_positive_definite(n: int, kind: str, r: float) -> None:
    """3000 rows, some of which leave whole directions unseen, where P keeps its first variance or grows by r."""
    cov, w = new_covariance(np.eye(n)), np.zeros(n)
    for k, h in enumerate(rows_of(kind, n, 3000, np.random.default_rng(n))):
        stepped(cov, w, h, 1.0, r, 0.5, 1.0)
        if k % 50 == 49:
            P = covariance_matrix(cov, n)
            np.testing.assert_array_equal(P, P.T)
            np.linalg.cholesky(P)  # raises where it is not positive definite
    assert np.linalg.eigvalsh(P)[0] < 0.05  # it did learn


@pytest.mark.parametrize("n", [5, 8, 20])
def test_p_stays_symmetric_for_a_hundred_memories(n: int) -> None:
    """With forgetting, nothing makes an unsymmetric part smaller: a rounding would grow by 1/lambda in each sample.

    P as in the last 500 rows alone, five memories of 100.
    """
    forgetting, rng = 0.99, np.random.default_rng(n)
    cov, w, rows = new_covariance(np.eye(n)), np.zeros(n), rng.standard_normal((10_000, n))
    for h in rows:
        stepped(cov, w, h, h[0], 0.0, 1.0, 1.0 / forgetting)
    P = covariance_matrix(cov, n)
    np.testing.assert_array_equal(P, P.T)
    weighted = rows[::-1][:4000] * forgetting ** (0.5 * np.arange(4000))[:, None]
    assert_close(P, np.linalg.inv(weighted.T @ weighted), 1e-9)
    assert_close(w, np.eye(n)[0], 1e-9)


@pytest.mark.parametrize("n", [8, 30])
def test_p_stays_semidefinite_where_rounding_hides_what_is_known(n: int) -> None:
    """P0/q = 1e12, no state noise, and a narrow band of noise, for 8000 rows."""
    cov, w, q = new_covariance(1e12 * np.eye(n)), np.zeros(n), 1.0
    x = band_limited_noise((250.0, 350.0), 0.6, fs=16000.0, rng=n)
    for k, h in enumerate(np.lib.stride_tricks.sliding_window_view(x, n)[:8000, ::-1].copy()):
        y, S = stepped(cov, w, h, h[-1], 0.0, q, 1.0)
        assert q <= S
        if k % 100 == 99:
            values = np.linalg.eigvalsh(covariance_matrix(cov, n))
            assert values[0] >= -1e-12 * values[-1]
    assert owed_of(cov)["floored"][0] == 1.0
    assert abs(y) < 1.0


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("n_microphones", "n_references"), [(2, 2), (1, 1)])
def test_rounding_of_a_large_start_does_not_grow(n_microphones: int, n_references: int, seed: int) -> None:
    """P0/q = 1e15, r = 0, rows of several paths: what rounding made negative in P stays small, and so do the weights."""
    rng, taps, q = np.random.default_rng(seed), 12, 1e-3
    paths = rng.standard_normal((n_microphones, 2, 5))
    x = rng.standard_normal((n_references, 400))
    filtered = [[np.convolve(one, path) for path in own for one in x] for own in paths]
    cov, w = new_covariance(1e12 * np.eye(2 * n_references * taps)), np.zeros(2 * n_references * taps)
    for k in range(taps, 400):
        for own in filtered:
            row = np.concatenate([signal[k : k - taps : -1] for signal in own])
            stepped(cov, w, row, rng.standard_normal(), 0.0, q, 1.0)
    values = np.linalg.eigvalsh(covariance_matrix(cov, w.size))
    assert values[0] >= -1e-14 * values[-1]
    assert np.abs(w).max() < 100.0


# ---- A P whose small variances are lost in the rounding of its large ones

SMALL_NOISE = 1e-9  # so that a step changes next to nothing of P along the direction


def split_covariance(small: float) -> tuple[Covariance, np.ndarray, np.ndarray]:
    """A covariance with variance 1 along all directions but one, where it is `small`; P written out, and that direction."""
    direction = np.array([0.6, 0.0, -0.8])
    P = np.eye(3) - (1.0 - small) * np.outer(direction, direction)
    return new_covariance(P), P, direction


def test_a_negative_variance_is_raised_above_zero() -> None:
    """By twice what is missing, and the last digit of the largest variance."""
    cov, P, h = split_covariance(-1e-13)
    _, S = stepped(cov, np.zeros(3), 2.0 * h, 0.0, 0.0, SMALL_NOISE, 1.0)
    assert pytest.approx(4.0 * (1e-13 + EPS), rel=0.05) == S - SMALL_NOISE
    after = covariance_matrix(cov, 3)
    np.testing.assert_allclose(after - P, (2e-13 + EPS) * np.eye(3), rtol=0, atol=2e-15)
    assert np.linalg.eigvalsh(after)[0] > 0.0


@pytest.mark.parametrize(("small", "floored"), [(1e-16, True), (1e-13, False)])
def test_state_noise_is_added_only_from_when_a_variance_is_lost_in_rounding(small: float, floored: bool) -> None:
    """16 roundings of the largest variance are 3.6e-15. The state noise is two of them, and begins with the next sample."""
    cov, P, h = split_covariance(small)
    stepped(cov, np.zeros(3), h, 0.0, 0.0, SMALL_NOISE, 1.0)
    np.testing.assert_allclose(covariance_matrix(cov, 3), P, rtol=0, atol=5e-16)
    for _ in range(50):
        stepped(cov, np.zeros(3), h, 0.0, 0.0, SMALL_NOISE, 1.0)
    expected = P + 50 * 2 * EPS * np.eye(3) if floored else P
    np.testing.assert_allclose(covariance_matrix(cov, 3), expected, rtol=0, atol=2e-15)


def test_a_small_p_beside_a_large_row_is_not_taken_for_rounding() -> None:
    """What counts is h'P h over h'h and the largest variance now, not the one at the start."""
    cov, w = new_covariance(np.eye(2)), np.zeros(2)
    for h in (np.array([1e3, 0.0]), np.array([0.0, 1e3])) * 4:
        stepped(cov, w, h, 1.0, 0.0, 1e-12, 1.0)
    assert np.all(np.diagonal(covariance_matrix(cov, 2)) < 1e-17)
    stepped(cov, w, np.array([1.0, 1.0]), 1.0, 0.0, 1e-12, 1.0)
    assert owed_of(cov)["floored"][0] == 0.0
    assert owed_of(cov)["bound"][0] < 1e-17


def test_the_state_noise_against_rounding_does_not_compound() -> None:
    """It is at most what the largest variance at the start asks for: P grows in a line, and not without bound."""
    cov, _, h = split_covariance(1e-16)
    for _ in range(3000):
        stepped(cov, np.zeros(3), h, 0.0, 0.0, 1.0, 1.0)
    assert covariance_matrix(cov, 3)[1, 1] - 1.0 == pytest.approx(3000 * 2 * EPS, rel=1e-3)


# ---- Steps without a solution

Step = Callable[[Covariance, np.ndarray], Any]
TOO_LARGE: dict[str, Step] = {
    "a loud row": lambda cov, w: stepped(cov, w, np.full(w.size, 1e160), 1.0, 1e-3, 0.5, 1.0),
    "state noise": lambda cov, w: stepped(cov, w, np.ones(w.size), 1.0, 1e301, 0.5, 1.0),
    "fading": lambda cov, w: stepped(cov, w, np.ones(w.size), 1.0, 1e-3, 0.5, 1e302),
    "an update with a loud row": lambda cov, w: updated(cov, w, np.full(w.size, 1e160), 1.0, 0.5),
}


@pytest.mark.parametrize("owed", OWED)
@pytest.mark.parametrize("cause", TOO_LARGE)
@pytest.mark.parametrize("n", SIZES)
def test_a_p_that_could_overflow_is_refused_with_nothing_changed(n: int, cause: str, owed: Any) -> None:
    cov, _ = some_covariance(n, owed)
    w, before = np.full(n, 0.25), cov.memory.tobytes()
    answer = TOO_LARGE[cause](cov, w)
    assert answer == NO_SOLUTION if cause.startswith("an update") else np.isnan(answer).all()
    assert cov.memory.tobytes() == before
    np.testing.assert_array_equal(w, 0.25)


@pytest.mark.parametrize("owed", OWED)
@pytest.mark.parametrize(
    ("cause", "answer"), [("silent", NO_SOLUTION), ("indefinite", NO_SOLUTION), ("loud", LOUD_STEP)]
)
@pytest.mark.parametrize("n", SIZES)
def test_an_update_without_a_solution_leaves_p(n: int, cause: str, answer: int, owed: Any) -> None:
    """To the rounding of what was paid; u, of which the gain before is made, to the bit."""
    cov, P = some_covariance(n, owed)
    u, w = direction_of(cov, n).copy(), np.full(n, 0.25)
    h, z, q = {
        "silent": (np.zeros(n), 1.0, 0.0),
        "indefinite": (np.ones(n), 1.0, -1e9),
        "loud": (np.full(n, 1e-160), 1e200, 1e-319),
    }[cause]
    assert updated(cov, w, h, z, q) == answer
    np.testing.assert_array_equal(w, 0.25)
    np.testing.assert_array_equal(direction_of(cov, n), u)
    assert owed_of(cov).item()[:3] == (1.0, 0.0, 0.0)
    assert_close(covariance_matrix(cov, n), P, 8 * EPS)


@pytest.mark.parametrize("n", SIZES)
def test_a_silent_step_without_measurement_noise_corrects_nothing(n: int) -> None:
    """S = 0. The prediction stands."""
    cov, P = some_covariance(n, (1.0, 0.0, 1.0))
    w = np.full(n, 0.25)
    assert stepped(cov, w, np.zeros(n), 3.0, 1e-3, 0.0, 1.0) == (3.0, 0.0)
    np.testing.assert_array_equal(w, 0.25)
    np.testing.assert_array_equal(direction_of(cov, n), 0.0)
    assert_close(covariance_matrix(cov, n), P + 1e-3 * np.eye(n), 8 * EPS)
