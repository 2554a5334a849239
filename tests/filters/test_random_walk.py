"""KFOPC.random_walk in O(L²) against filterpy's KalmanFilter with F = I, Q = r I, R = q, and against 50 digits.

Two filters that round differently agree to the rounding times the condition of the problem: 1e-10 relative to the
largest value, over 10⁴ steps, for P0/R up to 1e3 and r > 0. Beyond that filterpy itself has lost the digits, and the
judge is a filter in 50-digit arithmetic.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import mpmath
import numpy as np
import pytest
from filterpy.common import Saver
from filterpy.kalman import IMMEstimator, KalmanFilter
from helpers.rows import rows_of
from hypothesis import given
from hypothesis import strategies as st

from kfopc_filterpy import KFOPC
from kfopc_filterpy.signals import band_limited_noise

HAS_SEQUENTIAL = hasattr(KalmanFilter, "update_sequential")  # not in filterpy 1.4.5
READ = ("x", "P", "x_prior", "P_prior", "x_post", "P_post", "K", "S", "SI", "y", "F", "Q", "R", "log_likelihood")
CLOSE = 1e-10


def pair(n: int, r: float = 1e-4, q: float = 0.5, P0: float = 1.0, x_ndim: int = 2) -> tuple[KalmanFilter, KFOPC]:
    """filterpy's filter and ours."""
    kf = KalmanFilter(n, 1)
    kf.P, kf.Q, kf.R = P0 * np.eye(n), r * np.eye(n), np.array([[q]])
    ours = KFOPC.random_walk(n, state_noise=r, measurement_noise=q, initial_variance=P0)
    for f in (kf, ours):
        f.x = np.zeros((n, 1)[:x_ndim])
        # 1.4.5 makes it (1, 1), which its own update_correlated cannot use. So small that 15 updates without a prediction
        # leave P positive: filterpy keeps a negative P, and ours raises it above zero.
        f.M = np.full((n, 1), 1e-3 / n**0.5)
    return kf, ours


def require_close(kf: KalmanFilter, ours: KalmanFilter, names: tuple[str, ...] = READ) -> None:
    for name in names:
        expected, got = np.asarray(getattr(kf, name), float), np.asarray(getattr(ours, name), float)
        assert got.shape == expected.shape, name
        # y is the small difference of z and H x, which are about 1 to 10 here
        scale = max(np.abs(expected).max(), 1.0 if name in ("y", "log_likelihood") else 1e-3)
        assert np.abs(got - expected).max() <= CLOSE * scale, name
    assert np.array_equal(ours.P, ours.P.T)
    assert np.array_equal(ours.P_prior, ours.P_prior.T)
    assert np.array_equal(ours.P_post, ours.P_post.T)


def both(filters: tuple[KalmanFilter, KFOPC], action: Callable[[Any], Any]) -> None:
    for f in filters:
        action(f)


# Ten thousand steps.


@pytest.mark.parametrize(
    ("n", "kind", "P0", "alpha", "x_ndim"),
    [
        (1, "unrelated", 1e3, 1.0, 2),
        (6, "unrelated", 1e3, 1.0, 1),
        (16, "low-passed line", 1.0, 1.0, 2),
        (7, "line", 10.0, 1.001, 2),
        (34, "line", 1e3, 1.0, 2),
    ],
)
def test_ten_thousand_steps_as_filterpy(n: int, kind: str, P0: float, alpha: float, x_ndim: int) -> None:
    """With noises that change; read at random moments, so that what is made when read is made in every state."""
    steps, rng = 10_000, np.random.default_rng(n)
    rows = rows_of(kind, n, steps, rng)
    kf, ours = filters = pair(n, r=1e-3, q=1.0, P0=P0, x_ndim=x_ndim)
    both(filters, lambda f: setattr(f, "alpha", alpha))
    d = rows @ rng.normal(size=n) + rng.normal(size=steps)
    for k in range(steps):
        if k % 50 == 20:
            r, q = 10.0 ** rng.uniform(-5, -2), rng.uniform(0.5, 2.0)
            kf.Q, kf.R = r * np.eye(n), np.array([[q]])
            ours.state_noise, ours.measurement_noise = r, q
        Q, R = (number if rng.random() < 0.05 else None for number in (0.002, 0.7))
        both(filters, lambda f, Q=Q: f.predict(Q=Q))
        if rng.random() < 0.01:
            require_close(kf, ours)
        z = None if rng.random() < 0.03 else np.full((1, 1)[:x_ndim], d[k])
        both(filters, lambda f, z=z, R=R, k=k: f.update(z, R=R, H=rows[k : k + 1]))
        if k % 997 == 500:
            both(filters, lambda f: f.P.__imul__(3.0))
    require_close(kf, ours)


# What is mixed with fast steps: filterpy's own equations take over for a step, or an edit comes in. Each
# is done to both filters with random numbers that start alike.


def assigned_F(f: KalmanFilter, rng: np.random.Generator) -> None:
    f.F = 0.9 * np.eye(f.dim_x) + 0.05 * rng.normal(size=(f.dim_x, f.dim_x))
    f.F[0, -1] = 0.02
    f.predict()
    f.update(0.3, R=0.4)
    f.F = np.eye(f.dim_x)


def assigned_Q(f: KalmanFilter, rng: np.random.Generator) -> None:
    before = f.Q[0, 0]
    f.Q = np.diag(rng.uniform(0, 0.1, size=f.dim_x))
    f.predict()
    f.predict()
    f.Q = before * np.eye(f.dim_x)


def control(f: KalmanFilter, rng: np.random.Generator) -> None:
    f.predict(B=rng.normal(size=(f.dim_x, 2)), u=rng.normal(size=(2, 1)))


def steady(f: KalmanFilter, rng: np.random.Generator) -> None:
    f.predict_steadystate()
    f.update_steadystate(rng.normal())


def replaced(f: KalmanFilter, rng: np.random.Generator) -> None:
    root = rng.normal(size=(f.dim_x, f.dim_x))
    f.P = root @ root.T + np.eye(f.dim_x)
    f.P *= 0.5


def two_rows(f: KalmanFilter, rng: np.random.Generator) -> None:
    f.update(rng.normal(size=(2, 1)), R=np.diag([0.4, 0.6]), H=rng.normal(size=(2, f.dim_x)))


ACTIONS: dict[str, Callable[[KalmanFilter, np.random.Generator], Any]] = {
    "predict": lambda f, rng: f.predict(),
    "missed sample": lambda f, rng: f.update(None),
    "F assigned": assigned_F,
    "Q assigned": assigned_Q,
    "u and B passed": control,
    "steady state": steady,
    "P replaced, then scaled": replaced,
    "fading": lambda f, rng: setattr(f, "alpha", 1.01),
    "update_correlated": lambda f, rng: f.update_correlated(rng.normal()),
    "update_correlated, missed": lambda f, rng: f.update_correlated(None),
}
if HAS_SEQUENTIAL:
    ACTIONS["update_sequential"] = lambda f, rng: f.update_sequential(0, rng.normal())
    ACTIONS["H of two rows"] = two_rows  # 1.4.5 wants dim_z values whatever the rows of H


def act(filters: tuple, name: str, rng: np.random.Generator) -> None:
    seed = rng.integers(2**32)
    both(filters, lambda f: ACTIONS[name](f, np.random.default_rng(seed)))


def fast_step(filters: tuple, rng: np.random.Generator, n: int) -> None:
    h, z = rng.normal(size=(1, n)), rng.normal(size=(1, 1))
    both(filters, lambda f: f.predict())
    both(filters, lambda f: f.update(z, H=h))


@given(
    names=st.lists(st.sampled_from(["fast", "fast", "read", *ACTIONS]), min_size=1, max_size=15),
    n=st.integers(1, 9),
    seed=st.integers(0, 10**6),
)
def test_any_sequence_of_steps(names: list[str], n: int, seed: int) -> None:
    """Any number of taps, so that every remainder of the kernel's four-row blocks occurs."""
    rng = np.random.default_rng(seed)
    kf, ours = filters = pair(n)
    both(filters, lambda f: setattr(f, "H", rng.normal(size=(1, n)) if f is kf else kf.H.copy()))
    fast_step(filters, rng, n)
    for name in names:
        if name == "fast":
            fast_step(filters, rng, n)
        elif name == "read":
            require_close(kf, ours, ("x", "P", "P_prior", "P_post", "K"))
        else:
            if name == "update_sequential":  # it writes into z, K and y of one row
                fast_step(filters, rng, n)
            act(filters, name, rng)
            if name == "H of two rows":
                fast_step(filters, rng, n)
    require_close(kf, ours, ("x", "P", "P_prior", "P_post", "K"))
    fast_step(filters, rng, n)
    require_close(kf, ours)


# P, F, Q, R as a user meets them.


def test_an_edit_of_P_counts_however_it_is_made() -> None:
    n, h = 3, np.array([1.0, 2.0, 3.0])
    S = []

    def edit_alias(f: KFOPC) -> None:
        P = f.P
        _ = f.P, f.P_prior, f.K
        P *= 10

    def edit_after_saving(f: KFOPC) -> None:
        P, saver = f.P, Saver(f)
        saver.save()
        P *= 10

    edits: list[Callable[[KFOPC], Any]] = [
        lambda f: setattr(f, "P", 10 * f.P),
        lambda f: f.P.__imul__(10),
        lambda f: f.P.__setitem__(slice(None), 10 * f.P),
        edit_alias,
        edit_after_saving,
    ]
    for edit in edits:
        _, ours = pair(n)
        ours.predict()
        prior = ours.P_prior
        edit(ours)
        assert np.array_equal(ours.P_prior, prior), "what was predicted stays"
        ours.update(1.0, H=h)
        S.append(ours.S.item())
    assert pytest.approx(len(edits) * [10 * (1 + 1e-4) * 14 + 0.5]) == S


def test_P_prior_is_P_post_and_the_gain_direction() -> None:
    rng = np.random.default_rng(1)
    for P0 in (1.0, 1e9):  # the second cancels most of the digits of P
        _, ours = pair(5, P0=P0)
        ours.predict()
        prior = ours.P.copy()
        ours.update(1.0, H=rng.normal(size=5))
        g = ours.K[:, 0] * ours.S.item()
        np.testing.assert_allclose(ours.P_prior, prior, rtol=1e-14, atol=1e-14 * P0)
        np.testing.assert_allclose(ours.P_post + np.outer(g, g) / ours.S, prior, rtol=1e-12, atol=1e-14 * P0)
        assert ours.P_prior is not ours.P_prior, "a fresh array"
        ours.P_prior[:] = 0.0
        np.testing.assert_allclose(ours.P_prior, prior, rtol=1e-14, atol=1e-14 * P0)


@pytest.mark.parametrize("name", ["F", "Q", "R"])
def test_a_write_into_F_Q_R_is_refused_and_what_is_made_from_them_is_a_plain_array(name: str) -> None:
    _, ours = pair(3)
    matrix = getattr(ours, name)
    before = matrix.copy()
    for write in (lambda a: a.__setitem__((0, 0), 2.0), lambda a: np.add(a, 1.0, out=a), lambda a: a.T[0].sort()):
        with pytest.raises(ValueError, match="read-only"):
            write(getattr(ours, name))
    for made in (matrix * 2, matrix @ matrix, np.dot(matrix, matrix), np.array(matrix), matrix.astype(float)):
        assert type(made) is np.ndarray
        made[0, 0] = 7.0  # can be written into
    np.testing.assert_array_equal(getattr(ours, name), before)


def test_Q_and_R_take_numbers_and_multiples_of_the_identity() -> None:
    _, ours = pair(3)
    for Q in (0.3, 0.3 * np.eye(3), np.float64(0.3), np.array(0.3)):
        ours.Q = 1.0
        ours.Q = Q
        assert ours.state_noise == 0.3
        assert np.array_equal(ours.Q, 0.3 * np.eye(3))
    for R in (0.3, [0.3], [[0.3]], np.array(0.3)):
        ours.R = 1.0
        ours.R = R
        assert ours.measurement_noise == 0.3
    ours.Q = np.diag([1.0, 2.0, 3.0])
    assert ours.state_noise is None
    assert np.array_equal(ours.Q, np.diag([1.0, 2.0, 3.0]))
    ours.state_noise = 0.1
    assert np.array_equal(ours.Q, 0.1 * np.eye(3))


# Copies, batches, savers, banks.


def test_batch_filter_stays_fast_and_saves() -> None:
    n, steps, rng = 4, 50, np.random.default_rng(6)
    rows, zs = rng.normal(size=(steps, n)), [*rng.normal(size=steps - 1).tolist(), None]
    kf, ours = pair(n)
    saver = Saver(ours)
    with patch.object(KalmanFilter, "predict"), patch.object(KalmanFilter, "update"):  # filterpy's would do nothing
        got = ours.batch_filter(zs, Hs=list(rows), saver=saver)
    expected = kf.batch_filter(zs, Hs=[row.reshape(1, n) for row in rows])
    for a, b in zip(expected, got, strict=True):
        np.testing.assert_allclose(b, a, rtol=CLOSE, atol=CLOSE)
    saver.to_array()
    np.testing.assert_array_equal(saver.P, got[1])
    smoothed = ours.rts_smoother(got[0], got[1]), kf.rts_smoother(*expected[:2])
    for a, b in zip(*smoothed, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("cause", ["NaN", "silent", "square overflows", "S overflows", "x overflows", "no covariance"])
@pytest.mark.parametrize("moment", ["predicted", "updated", "updated twice"])
def test_a_refused_update_leaves_every_P(cause: str, moment: str) -> None:
    """P, P_prior and P_post, whatever is owed to the triangle at that moment; to rounding, since it may be paid."""
    ours, rng = KFOPC.random_walk(4, state_noise=0.01, measurement_noise=0.5), np.random.default_rng(0)
    if cause != "x overflows":  # the square of z would, too
        ours.rated_power, ours.secondary_path_gain = 0.5, 1.0
    for _ in range(3):
        ours.predict()
        ours.update(1.0, H=rng.normal(size=4))
    if moment == "predicted":
        ours.predict()
    if moment == "updated twice":
        ours.update(1.0, H=rng.normal(size=4))
    z, H, R = {
        "NaN": (np.nan, np.ones(4), None),
        "silent": (1.0, np.zeros(4), 0.0),
        "square overflows": (1e200, np.ones(4), None),
        "S overflows": (1.0, np.r_[1.0, np.full(3, 1e160)], None),
        "x overflows": (1e200, np.full(4, 1e-160), 1e-310),
        "no covariance": (1.0, np.full(4, 1e-170), 0.0),
    }[cause]
    names = ("P", "P_prior", "P_post", "K", "S", "x", "x_prior", "y")
    before = {name: np.copy(getattr(ours, name)) for name in names}
    with pytest.raises(ValueError):  # noqa: PT011 - the messages have tests of their own
        ours.update(z, R=R, H=H)
    for name, value in before.items():
        np.testing.assert_allclose(getattr(ours, name), value, rtol=0, atol=1e-14, err_msg=name)


def test_a_saver_keeps_public_names_only() -> None:
    """And what it kept stays, whatever is written into the filter's arrays afterwards."""
    _, ours = pair(3)
    ours.rated_power, ours.secondary_path_gain = 0.5, 1.0
    saver = Saver(ours)
    for z in (1.0, 2.0):
        ours.predict()
        ours.update(z, H=np.ones(3))
        saver.save()
    assert not [key for key in saver.keys if key.startswith("_")]
    assert {"x", "P", "K", "S", "rated_power", "constraint_factor", "disturbance_power"} <= set(saver.keys)
    kept = {key: copy.deepcopy(getattr(saver, key)) for key in saver.keys if key not in ("inv", "constraint")}
    ours.P *= 10.0
    ours.P[0, 0] = 99.0
    ours.x[:] = 7.0
    ours.update(3.0, H=np.ones(3))
    for key, values in kept.items():
        for value, now in zip(values, getattr(saver, key), strict=True):
            np.testing.assert_array_equal(now, value, err_msg=key)


def test_P_read_twice_is_two_arrays_and_the_newest_that_was_edited_counts() -> None:
    _, ours = pair(3)
    ours.predict()
    first, second, third = ours.P, ours.P, ours.P
    assert not np.shares_memory(first, second)
    before = first.copy()
    first *= 2.0
    np.testing.assert_array_equal(second, before)
    np.testing.assert_array_equal(third, before)
    second *= 3.0
    ours.update(1.0, H=np.ones(3))
    assert ours.S.item() == pytest.approx(3.0 * before.sum() + 0.5, rel=1e-14)
    left = ours.P.copy()
    for edited in (first, second, third):  # they were of an earlier step
        edited[:] = 1e6
    np.testing.assert_array_equal(ours.P, left)
    ours.update(1.0, H=np.ones(3))
    assert ours.S.item() == pytest.approx(left.sum() + 0.5, rel=1e-12)


def test_an_imm_bank_of_random_walks() -> None:
    rng = np.random.default_rng(8)
    banks = []
    for which in (0, 1):
        filters = [pair(2, r=r)[which] for r in (1e-4, 1e-1)]
        for f in filters:
            f.H = np.array([[1.0, 0.5]])
        banks.append(IMMEstimator(filters, (0.5, 0.5), np.array([[0.97, 0.03], [0.03, 0.97]])))
    for z in rng.normal(size=(50, 1, 1)).cumsum(axis=0):
        for bank in banks:
            bank.predict()
            bank.update(z)
        for name in ("x", "P", "mu"):
            np.testing.assert_allclose(getattr(banks[1], name), getattr(banks[0], name), rtol=1e-9, atol=1e-12)


# Conditioning: against 50 digits.


def fifty_digits(rows: np.ndarray, d: np.ndarray, P0: float, r: float, q: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weights and P after each sample, eq. 2-8 in 50-digit arithmetic."""
    n = rows.shape[1]
    with mpmath.workdps(50):
        w, P, history = mpmath.zeros(n, 1), P0 * mpmath.eye(n), []
        for row, z in zip(rows, d, strict=True):
            P += mpmath.mpf(r) * mpmath.eye(n)
            h = mpmath.matrix([mpmath.mpf(float(v)) for v in row])
            g = P * h
            S = (h.T * g)[0] + mpmath.mpf(q)
            w += g * ((mpmath.mpf(float(z)) - (h.T * w)[0]) / S)
            P -= g * g.T / S
            history.append(
                (np.array([float(v) for v in w]), np.array([[float(P[i, j]) for j in range(n)] for i in range(n)]))
            )
    return history


@pytest.mark.parametrize("kind", ["unrelated", "line", "low-passed line", "tonal line"])
@pytest.mark.parametrize("P0", [1e3, 1e9, 1e12])
def test_predictions_after_a_large_initial_variance(kind: str, P0: float) -> None:
    """They err by the rounding of P, which is seen relative to q: up to 47 roundings of P0/q over these seeds.

    That is 1 % of the noise's deviation at P0/q = 1e12. On the tonal lines, filterpy's predictions err by 80 % of it.
    """
    n, steps, q = 6, 100, 1.0
    r = 0.0 if P0 == 1e9 else 1e-2
    for seed in range(7):
        rng = np.random.default_rng(seed)
        rows = rows_of(kind, n, steps, rng)
        d = rows @ rng.normal(size=n) + rng.normal(size=steps)
        _, ours = pair(n, r=r, q=q, P0=P0)
        exact = np.zeros(n)
        for row, z, (next_exact, _) in zip(rows, d, fifty_digits(rows, d, P0, r, q), strict=True):
            assert abs(row @ (ours.x[:, 0] - exact)) <= 200 * np.finfo(float).eps * P0 / q**0.5
            exact = next_exact
            ours.predict()
            ours.update(np.array([[z]]), H=row.reshape(1, -1))
        assert np.array_equal(ours.P, ours.P.T)
        assert np.linalg.eigvalsh(ours.P).min() > 0


def test_a_silent_filter_of_no_variance_is_refused() -> None:
    ours = KFOPC.random_walk(3, state_noise=0.0, measurement_noise=0.0, initial_variance=0.0)
    with pytest.raises(ValueError, match="must be positive"):
        ours.update(1.0, H=np.ones(3))
    ours.state_noise = 1.0
    ours.predict()
    ours.update(1.0, H=np.ones(3))
    np.testing.assert_allclose(ours.x[:, 0], np.full(3, 1 / 3))


@pytest.mark.parametrize("x", [[np.nan, 0.0, 0.0], [0.0, 0.0]])
def test_weights_that_are_no_weights_are_refused_by_both_steps(x: list[float]) -> None:
    kf = KFOPC.random_walk(3, state_noise=1e-3, measurement_noise=1.0)
    kf.predict()
    kf.x = np.array(x)
    P = kf.P.copy()
    with pytest.raises(ValueError, match="x must have 3 finite values"):
        kf.predict()
    with pytest.raises(ValueError, match="x must have 3 finite values"):
        kf.update(1.0, H=np.ones(3))
    assert np.array_equal(kf.P, P)


def test_an_inverse_of_ones_own_is_used() -> None:
    """A silent reference with R = 0 and the pseudo-inverse: filterpy's filter goes on, its gain is 0."""
    ours, theirs = KFOPC.random_walk(2, state_noise=0.5, measurement_noise=0.0), KalmanFilter(2, 1)
    theirs.Q, theirs.R = 0.5 * np.eye(2), np.zeros((1, 1))
    for kf in (ours, theirs):
        kf.inv = np.linalg.pinv
        kf.predict()
        kf.update(1.0, H=np.zeros((1, 2)))
        kf.update(1.0, H=np.array([[1.0, 2.0]]))
    np.testing.assert_allclose(ours.x, theirs.x, atol=1e-15)
    np.testing.assert_allclose(ours.P, theirs.P, atol=1e-15)


# ---- Long runs of a band of noise


@pytest.mark.parametrize("band", [(250.0, 350.0), (200.0, 2000.0)])
def test_p_stays_semidefinite_at_a_large_initial_variance(band):
    """P(0|0)/q = 1e12, no state noise: the variances along the noise are below the last digit of the others.

    The innovations must stay near the measurement noise, of variance q: within 3 dB.
    """
    q, taps, n = 1e-4, 32, 12000
    x = band_limited_noise(band, n / 16000.0, fs=16000.0, rng=0)
    d = 2.0 * np.roll(x, 5) + np.sqrt(q) * np.random.default_rng(1).standard_normal(n)
    kf = KFOPC.random_walk(taps, state_noise=0.0, measurement_noise=q, initial_variance=1e12 * q)
    innovations = []
    for k in range(taps, n):
        kf.predict()
        kf.update(d[k], H=x[k - taps + 1 : k + 1][::-1])
        innovations.append(kf.y[0, 0])
        if k % 400 == 0:
            values = np.linalg.eigvalsh(kf.P)
            assert values[0] >= -1e-12 * values[-1], k
    assert np.mean(np.square(innovations[-2000:])) < 2.0 * q


def test_the_state_noise_is_what_was_given_however_small():
    kf = KFOPC.random_walk(4, state_noise=1e-9, measurement_noise=1.0)
    for _ in range(100):
        kf.predict()
        kf.update(0.0, H=[0.0, 0.0, 0.0, 1e-6])
    assert kf.P[0, 0] - 1.0 == pytest.approx(1e-7, rel=1e-7)
