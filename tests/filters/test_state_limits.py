"""Estimates within limits: closed forms, optimality conditions, scipy's minimiser, and KF-PB's price."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.testing import assert_allclose

from kfopc_filterpy import KFOPC
from kfopc_filterpy.filters import constrained


def made(n: int, seed: int, kind=KalmanFilter):
    """A filter with a random estimate and covariance."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((n, n))
    kf = kind(dim_x=n, dim_z=1)
    kf.x, kf.P = rng.standard_normal((n, 1)), root @ root.T + 0.1 * np.eye(n)
    return kf


def everything(n: int, seed: int):
    """Limits of every kind that a random state keeps, some of them by little."""
    rng = np.random.default_rng(1000 + seed)
    inside, root = 0.3 * rng.standard_normal(n), rng.standard_normal((n, n))
    D, A, M = rng.standard_normal((1, n)), rng.standard_normal((3, n)), root @ root.T
    return {
        "equalities": (D, D @ inside),
        "inequalities": (A, A @ inside + rng.uniform(0.0, 0.5, 3)),
        "lower": inside - rng.uniform(0.05, 1.0, n),
        "upper": inside + rng.uniform(0.05, 1.0, n),
        "power": (M, 1.1 * inside @ M @ inside),
    }


def optimality(kf, x, limits):
    """Largest violation of a limit, and of the Karush-Kuhn-Tucker conditions, relative to the gradient.

    The gradient of the distance must be a combination of the normals of the limits that are active, with weights of the
    right sign for inequalities: non-negative least squares finds how much of it is none.
    """
    from scipy.optimize import nnls

    x, n = x.ravel(), x.size
    D, d = limits.get("equalities", (np.zeros((0, n)), np.zeros(0)))
    rows, room = [], []
    if "inequalities" in limits:
        A, b = limits["inequalities"]
        rows, room = [*A], [*(b - A @ x)]
    for i in range(n):
        for name, sign in (("lower", -1), ("upper", 1)):
            if name in limits:
                rows.append(sign * np.eye(n)[i])
                room.append(sign * (np.broadcast_to(limits[name], n)[i] - x[i]))
    if "power" in limits:
        M, rho = limits["power"]
        rows.append(M @ x / rho)
        room.append(1 - x @ M @ x / rho)
    room = np.array(room)
    gradient = np.linalg.solve(kf.P, kf.x.ravel() - x)
    normals = [row for row, left in zip(rows, room, strict=True) if left < 1e-7]
    basis = np.array([*normals, *D, *(-D)]).reshape(-1, n).T
    left = nnls(basis, gradient)[1] if basis.size else np.linalg.norm(gradient)
    broken = max(np.max(-room, initial=0.0), np.max(np.abs(D @ x - d), initial=0.0))
    return broken, left / max(np.linalg.norm(gradient), 1.0)


KINDS = ["equalities", "inequalities", "lower", "upper", "power"]


@pytest.mark.parametrize("kind", [KalmanFilter, KFOPC])
@pytest.mark.parametrize("names", [KINDS, KINDS[:1], KINDS[1:2], KINDS[2:4], KINDS[4:], KINDS[:4], KINDS[1:]])
def test_the_state_keeps_the_limits_and_the_optimality_conditions(kind, names):
    """Tolerance 1e-8: 1e-9 is promised of linear limits; the weights of the normals round with the condition of P."""
    moved = 0
    for seed in range(25):
        n = 2 + seed % 5
        kf, limits = made(n, seed, kind), {name: everything(n, seed)[name] for name in names}
        x = constrained(kf, **limits)
        assert x.shape == kf.x.shape
        assert max(optimality(kf, x, limits)) < 1e-8, seed
        moved += not np.allclose(x, kf.x)
    assert moved > 12


def test_equalities_have_the_closed_form_and_projection_its_covariance():
    kf = made(5, 3)
    D, d = np.random.default_rng(0).standard_normal((2, 5)), np.array([1.0, -2.0])
    P, x = kf.P.copy(), kf.x.copy()
    gain = P @ D.T @ np.linalg.inv(D @ P @ D.T)
    expected = x - gain @ (D @ x - d[:, None])
    assert_allclose(constrained(kf, equalities=(D, d)), expected, rtol=1e-12, atol=1e-12)
    assert np.array_equal(kf.x, x) and np.array_equal(kf.P, P)  # noqa: PT018
    constrained(kf, equalities=(D, d), project=True)
    assert_allclose(kf.x, expected, rtol=1e-12, atol=1e-12)
    assert_allclose(kf.P, P - gain @ D @ P, atol=1e-12 * np.abs(P).max())
    assert_allclose(D @ kf.P, 0, atol=1e-12 * np.abs(P).max())
    assert_allclose(constrained(kf, equalities=(D, d)), kf.x, atol=1e-12)  # a P that is singular, and already there


def test_without_a_limit_that_acts_the_estimate_is_returned():
    kf = made(4, 2)
    assert_allclose(constrained(kf), kf.x, rtol=0, atol=0)
    assert_allclose(constrained(kf, lower=-50.0, upper=np.full(4, np.inf), power=(np.eye(4), 1e4)), kf.x, atol=1e-14)


@pytest.mark.parametrize("size", [1e-30, 1e-20, 1e-10, 1e10, 1e20])
def test_the_size_of_the_covariance_does_not_matter(size):
    """Limits are then up to 1e15 deviations away; the state is the same to the rounding of the two solutions."""
    for seed in range(60):
        kf, limits = made(2 + seed % 6, seed), everything(2 + seed % 6, seed)
        limits = {name: limits[name] for name in ("inequalities", "lower", "upper")}
        expected = constrained(kf, **limits)
        kf.P *= size
        assert_allclose(constrained(kf, **limits), expected, rtol=1e-6, atol=1e-8)


def test_a_state_that_is_known_does_not_move():
    kf = made(2, 1)
    kf.x, kf.P = np.array([1.0, 2.0]), np.diag([0.0, 1.0])
    assert_allclose(constrained(kf, equalities=([1.0, 1.0], 2.0)), [1.0, 1.0])
    with pytest.raises(ValueError, match="contradict"):
        constrained(kf, upper=0.5)
    with pytest.raises(ValueError, match="contradict"):
        constrained(kf, equalities=([1.0, 0.0], 0.5))
    kf.x[0] = np.nextafter(3e8, np.inf)
    assert_allclose(constrained(kf, upper=[3e8, 1.5]), [3e8, 1.5], rtol=1e-15)  # above by rounding alone
    kf.x, kf.P = np.array([1.0, 2.0]), np.zeros((2, 2))
    assert_allclose(constrained(kf, upper=5.0, equalities=([1.0, 0.0], 1.0)), kf.x)


@pytest.mark.parametrize(
    ("limits", "error", "message"),
    [
        ({"upper": -1.0, "lower": 1.0}, ValueError, r"lower\[0\] = 1 must not be above upper\[0\] = -1"),
        ({"upper": [1.0, 2.0]}, ValueError, r"upper must be one number or \(3,\), inf for a state without one"),
        ({"equalities": np.eye(3)}, TypeError, r"equalities must be a pair of a matrix \(m, 3\)"),
        ({"equalities": (np.eye(3), 1.0)}, ValueError, "one row and one value for each limit"),
        ({"inequalities": ([1.0, np.nan, 0.0], 1.0)}, ValueError, r"inequalities\[0\] must be finite"),
        ({"power": np.eye(3)}, TypeError, "power must be a pair"),
        ({"power": (np.eye(2), 1.0)}, ValueError, r"power\[0\] must have shape \(3, 3\), got \(2, 2\)"),
        ({"power": (np.eye(3), 0.0)}, ValueError, r"power\[1\] must be greater than 0"),
        ({"power": (-np.eye(3), 1.0)}, ValueError, "positive semidefinite.*negative variances"),
        ({"inequalities": ([[1, 0, 0], [-1, 0, 0]], [-1.0, -1.0])}, ValueError, "contradict"),
        ({"equalities": ([1, 0, 0], 1.0), "upper": 0.5}, ValueError, "contradict"),
        ({"lower": 1.0, "power": (np.eye(3), 2.0)}, ValueError, r"x' M x <= 2 keeps the other limits: raise rho"),
    ],
)
def test_limits_that_cannot_be_kept_or_read_are_refused_and_change_nothing(limits, error, message):
    kf = made(3, 6)
    x, P = kf.x.copy(), kf.P.copy()
    with pytest.raises(error, match=message):
        constrained(kf, project=True, **limits)
    assert np.array_equal(kf.x, x)
    assert np.array_equal(kf.P, P)


@pytest.mark.parametrize(
    ("x", "P", "message"),
    [
        (np.zeros((1, 2)), np.eye(2), r"kf.x must have shape \(n,\) or \(n, 1\), got \(1, 2\)"),
        (np.zeros(3), np.eye(2), r"kf.P must have shape \(3, 3\), got \(2, 2\)"),
        (np.zeros(2), np.array([[1.0, 2.0], [2.0, 1.0]]), "positive semidefinite"),
        (np.zeros(2), np.full((2, 2), np.inf), "P must be finite"),
    ],
)
def test_a_filter_whose_state_is_no_estimate_is_refused(x, P, message):
    with pytest.raises(ValueError, match=message):
        constrained(SimpleNamespace(x=x, P=P), upper=1.0)
