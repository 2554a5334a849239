"""KFOPC without a rated power is filterpy's KalmanFilter bit for bit: filterpy's own filter is the oracle.

Nothing here has a tolerance: every comparison is `np.array_equal`. The scenarios are those that filterpy's
own tests (test_kf, test_rts, test_imm, test_mmae) put its filter through, and more.
"""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt
from typing import Any

import numpy as np
import pytest
from filterpy.common import Q_discrete_white_noise, Saver, inv_diagonal
from filterpy.kalman import FixedLagSmoother, IMMEstimator, MMAEFilterBank
from filterpy.kalman import KalmanFilter as FilterpyKalmanFilter
from filterpy.kalman import kalman_filter as functions
from helpers.pages import ROOT, table_of

from kfopc_filterpy import KFOPC

FILTERPY_2 = hasattr(FilterpyKalmanFilter, "update_sequential")  # 1.4.5 has none


class KalmanFilter(FilterpyKalmanFilter):
    """The oracle: filterpy's filter with the `mahalanobis` of 2.0.0 (1.4.5's raises on numpy 2)."""

    @property
    def mahalanobis(self) -> float:
        if self._mahalanobis is None:
            self._mahalanobis = sqrt(np.dot(np.dot(self.y.T, self.SI), self.y).item())
        return self._mahalanobis


STATE = ("x", "P", "x_prior", "P_prior", "x_post", "P_post", "K", "y", "S", "SI", "z")
ARRAYS = (*STATE, "F", "Q", "R", "H", "B", "M")
OTHERS = ("dim_x", "dim_z", "dim_u", "alpha", "inv", "log_likelihood", "likelihood", "mahalanobis")


def same(a: Any, b: Any) -> bool:
    """Equal in every bit, and of the same kind and shape."""
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return type(a) is type(b) and a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b)
    return type(a) is type(b) and a == b


def require_same(kf: KalmanFilter, ours: KalmanFilter) -> None:
    for name in ARRAYS + OTHERS:
        assert same(getattr(kf, name), getattr(ours, name)), name


def stable_matrix(rng: np.random.Generator, n: int) -> np.ndarray:
    F = rng.normal(size=(n, n))
    return 0.95 * F / np.abs(np.linalg.eigvals(F)).max()


def covariance_matrix(rng: np.random.Generator, n: int) -> np.ndarray:
    root = rng.normal(size=(n, n))
    return root @ root.T / n + 0.1 * np.eye(n)


def random_system(cls: type, n: int, m: int, k: int, x_ndim: int, seed: int) -> KalmanFilter:
    rng = np.random.default_rng(seed)
    kf = cls(n, m, k)
    kf.x = rng.normal(size=(n, 1)[:x_ndim])
    kf.F, kf.H = stable_matrix(rng, n), rng.normal(size=(m, n))
    kf.P, kf.Q, kf.R = (covariance_matrix(rng, size) for size in (n, n, m))
    kf.M = 0.01 * rng.normal(size=(n, m))  # 1.4.5 makes it (m, m), which its own equation cannot use
    kf.B = rng.normal(size=(n, k)) if k else None
    kf.alpha = 1.0 + 0.01 * (seed % 2)
    return kf


def random_step(rng: np.random.Generator, kf: KalmanFilter) -> list[tuple]:
    """A way to predict and a way to update, for filters of these dimensions, as (method, args, kwargs)."""
    n, m, k, x_ndim = kf.dim_x, kf.dim_z, kf.dim_u, kf.x.ndim
    column = (m, 1)[:x_ndim]
    z = rng.normal(size=column)
    forms = [z, z.reshape(m, 1), z.reshape(m), z.reshape(1, m), z.reshape(m).tolist()]
    if m == 1:
        forms += [z.item(), int(10 * z.item()), np.float32(z.item()), np.array(z.item()), (z.item(),)]
    any_z = forms[rng.integers(len(forms))]
    H = rng.normal(size=(m, n))
    predicts = [{}, {"F": stable_matrix(rng, n)}, {"Q": covariance_matrix(rng, n)}, {"Q": 0.3}]
    if k:
        u = rng.normal(size=(k, 1)[:x_ndim])
        predicts += [{"u": u}, {"u": u, "B": rng.normal(size=(n, k))}, {"B": rng.normal(size=(n, k))}]
    updates: list[tuple] = [
        ("update", (any_z,), {}),
        ("update", (any_z,), {"R": 0.4}),
        ("update", (any_z,), {"R": covariance_matrix(rng, m)}),
        ("update", (z,), {"H": H}),
        ("update", (z,), {"H": H, "R": 0.2}),
        ("update", (None,), {}),
        ("update_correlated", (any_z,), {}),
        ("update_correlated", (z,), {"H": H, "R": 0.7}),
        ("update_correlated", (None,), {}),
        ("update_steadystate", (any_z,), {}),
        ("update_steadystate", (None,), {}),
    ]
    if FILTERPY_2 and x_ndim == 2:
        start = int(rng.integers(m))
        updates += [
            ("update_sequential", (start, z[start].item()), {}),
            ("update_sequential", (0, z), {"R_i": 0.3}),
            ("update_sequential", (start, z[start:]), {"H_i": H[start:]}),
        ]
    predict = ("predict", (), predicts[rng.integers(len(predicts))])
    if rng.random() < 0.1:
        predict = ("predict_steadystate", (), {"u": rng.normal(size=(k, 1)[:x_ndim])} if k else {})
    return [predict, updates[rng.integers(len(updates))]]


def sequential_would_fail(kf: KalmanFilter, name: str) -> bool:
    """filterpy's update_sequential writes into z and cuts R: a number or a list in their place breaks it."""
    return name == "update_sequential" and (np.shape(kf.z) != (kf.dim_z, 1) or np.ndim(kf.R) != 2)


@pytest.mark.parametrize(
    ("n", "m", "k", "x_ndim"),
    [(1, 1, 0, 2), (2, 1, 1, 1), (3, 2, 2, 2), (4, 3, 0, 1), (5, 1, 0, 2), (6, 3, 2, 2), (6, 2, 1, 1)],
)
def test_thousands_of_steps_of_any_kind(n: int, m: int, k: int, x_ndim: int) -> None:
    kf, ours = (random_system(cls, n, m, k, x_ndim, seed=n + m) for cls in (KalmanFilter, KFOPC))
    rng = np.random.default_rng(n)
    for step in range(4000):
        for name, args, kwargs in random_step(rng, kf):
            if sequential_would_fail(kf, name):
                continue
            for f in (kf, ours):
                getattr(f, name)(*args, **kwargs)
        assert np.array_equal(kf.x, ours.x), step
        assert np.array_equal(kf.P, ours.P), step
        if step % 25 == 0:
            require_same(kf, ours)
            z, u = rng.normal(size=kf.y.shape), rng.normal(size=(k, 1)[:x_ndim]) if k else None
            if k or FILTERPY_2:  # without B, 1.4.5 has no prediction
                assert same(kf.get_prediction(u), ours.get_prediction(u))
            assert same(kf.get_update(z), ours.get_update(z))
            assert same(kf.residual_of(z), ours.residual_of(z))
            assert same(kf.log_likelihood_of(z), ours.log_likelihood_of(z))
            assert same(kf.measurement_of_state(kf.x), ours.measurement_of_state(kf.x))
        if step % 500 == 0:
            for f in (kf, ours):  # in place, as filterpy's users do
                f.F[0, -1] *= 0.9
                f.P *= 10
                f.x[0] += 1
                f.R = 0.5 if m == 1 and step % 1000 == 0 else np.eye(m)
    require_same(kf, ours)


# Scenarios: each runs with either class and returns what it saw.


def constant_velocity(cls: type, *, x_ndim: int = 2, dim: int = 1, dt: float = 1.0) -> KalmanFilter:
    """Position and velocity in one or two directions, positions measured."""
    kf = cls(dim_x=2 * dim, dim_z=dim)
    kf.x = np.array([2.0, 0.0] * dim) if x_ndim == 1 else np.array([[2.0, 0.0] * dim]).T
    block = np.array([[1.0, dt], [0.0, 1.0]])
    kf.F = np.kron(np.eye(dim), block)
    kf.H = np.kron(np.eye(dim), [[1.0, 0.0]])
    kf.P *= 1000.0
    kf.R = kf.R * 5.0
    kf.Q = np.kron(np.eye(dim), Q_discrete_white_noise(2, dt, 0.01))
    return kf


def noisy_line(n: int = 100) -> list[float]:
    return (np.arange(n) + 20 * np.random.default_rng(5).normal(size=n)).tolist()


def recursive_then_batch(cls: type, x_ndim: int) -> list:
    """test_noisy_1d, test_noisy_11d: scalars for R and Q, update first, then a batch with a Saver."""
    kf = constant_velocity(cls, x_ndim=x_ndim)
    kf.R, kf.Q = 5, 0.0001
    seen = []
    for z in noisy_line():
        kf.update(z)
        seen += [kf.x, kf.P, kf.y, kf.S, kf.log_likelihood]
        kf.predict()
    kf.x, kf.P = np.array([[2.0, 0]]).T, np.eye(2) * 100.0
    return [seen, list(kf.batch_filter(noisy_line(), update_first=False))]


def batch(cls: type, **kwargs: Any) -> list:
    kf = constant_velocity(cls)
    return [list(kf.batch_filter([None, 1.0, 2.0, None, 7.5], **kwargs)), kf.x, kf.P_post]


def batch_of_lists(cls: type, update_first: bool) -> list:
    n, kf = 20, constant_velocity(cls)
    kf.B = np.array([[0.5], [1.0]])
    rng = np.random.default_rng(2)
    Fs = [np.array([[1.0, dt], [0.0, 1.0]]) for dt in rng.uniform(0.5, 2, n)]
    Qs = [0.1 * covariance_matrix(rng, 2) for _ in range(n)]
    Hs = [np.array([[1.0, 0.1 * i]]) for i in range(n)]
    Rs = [5.0 + i for i in range(n)]
    us = [np.array([[i]]) for i in range(n)]
    zs: list[float | None] = [*noisy_line(n - 1), None]
    return list(kf.batch_filter(zs, Fs=Fs, Qs=Qs, Hs=Hs, Rs=Rs, Bs=[kf.B] * n, us=us, update_first=update_first))


def smoothed(cls: type, x_ndim: int) -> list:
    """test_rts, with its P given as a number."""
    kf = constant_velocity(cls, x_ndim=x_ndim)
    kf.P, kf.R, kf.Q = 0.01, 5, 0.001
    means, covariances, _, _ = kf.batch_filter(noisy_line(40))
    return [
        means,
        covariances,
        *kf.rts_smoother(means, covariances),
        *kf.rts_smoother(means, covariances, Fs=[kf.F] * 40),
    ]


def saved(cls: type) -> list:
    kf = constant_velocity(cls)
    saver = Saver(kf)
    for z in noisy_line(30):
        kf.predict()
        kf.update(z)
        saver.save()
    saver.to_array()
    assert len(saver) == len(saver.x) == 30
    names = ("x", "P", "K", "y", "S", "P_prior", "likelihood", "log_likelihood", "z")
    return [getattr(saver, name) for name in names]


def custom_inverse(cls: type, inverse: Callable) -> list:
    kf = constant_velocity(cls)
    kf.inv = inverse
    for z in noisy_line(10):
        kf.predict()
        kf.update(z)
    kf.H, kf.R = np.zeros((1, 2)), np.zeros((1, 1))
    if inverse is np.linalg.pinv:
        kf.update(3.0)  # S = 0: a pseudo-inverse has an answer, which is kept
    return [kf.x, kf.P, kf.SI]


def pairs_of_models(cls: type) -> list[KalmanFilter]:
    """The banks of test_imm and test_mmae: constant acceleration, with much noise and with little."""
    filters = []
    for var in (0.02, 0.5):
        kf = cls(3, 1)
        kf.x = np.zeros(3)
        kf.P *= 3
        kf.R *= 0.36
        kf.F = np.array([[1, 0.1, 0.005], [0, 1, 0.1], [0, 0, 1]])
        kf.H = np.array([[1.0, 0, 0]])
        kf.Q = Q_discrete_white_noise(dim=3, dt=0.1, var=var)
        filters.append(kf)
    return filters


def interacting_models(cls: type, estimator: type = IMMEstimator) -> list:
    filters = pairs_of_models(cls)
    bank = estimator(filters, (0.5, 0.5), np.array([[0.97, 0.03], [0.03, 0.97]]))
    saver, seen = Saver(bank, ignore=("filters",)), []
    for z in noisy_line(100):
        bank.predict()
        bank.update(np.array([z]))
        saver.save()
        seen += [bank.x, bank.P, bank.mu, filters[0].x, filters[1].P, filters[0].likelihood]
    return [*seen, repr(bank)[:40]]


def multiple_models(cls: type) -> list:
    filters = pairs_of_models(cls)
    filters[0].F[:, 2] = 0
    filters[0].P[2, 2] = filters[0].Q[2, 2] = 0
    bank = MMAEFilterBank(filters, (0.5, 0.5), dim_x=3, H=filters[0].H)
    seen = []
    for z in noisy_line(20):
        bank.predict()
        bank.update(z)
        seen += [bank.x, bank.P, np.array(bank.p), filters[0].likelihood]
    return seen


def fixed_lag(cls: type) -> list:
    """test_fls: the smoother has the filter's matrices, and smooths the same measurements."""
    kf, smoother = constant_velocity(cls), FixedLagSmoother(dim_x=2, dim_z=1, N=5)
    for name in ("x", "P", "F", "H", "Q", "R"):
        setattr(smoother, name, getattr(kf, name))
    for z in noisy_line(30):
        kf.predict()
        kf.update(z)
        smoother.smooth(z)
    assert len(smoother.xSmooth) == 30
    return [kf.x, smoother.x, *smoother.xSmooth, *smoother.smooth_batch(noisy_line(30), N=5)]


def procedural(cls: type) -> list:
    """test_procedure_form: filterpy's functions, with a filter's arrays."""
    kf = constant_velocity(cls)
    kf.predict()
    kf.update(3.0)
    x, P = functions.predict(kf.x, kf.P, F=kf.F, Q=kf.Q)
    x, P = functions.update(x, P, 4.0, kf.R, kf.H)
    zs, n = noisy_line(20), 20
    means, covariances, _, _ = functions.batch_filter(x, P, zs, [kf.F] * n, [kf.Q] * n, [kf.H] * n, [kf.R] * n)
    return [x, P, means, covariances, *functions.rts_smoother(means, covariances, [kf.F] * n, [kf.Q] * n)]


# The rows of the page's last table: those of `test_thousands_of_steps_of_any_kind` and of test_saved_filters.py, and scenarios.
ELSEWHERE = [
    "`predict`, `update`",
    "`predict_steadystate`, `update_steadystate`",
    "`update_correlated`",
    "`update_sequential`",
    "`get_prediction`, `get_update`",
    "`residual_of`, `log_likelihood_of`, `measurement_of_state`",
    "`copy`, `deepcopy`, `pickle`",
]
USES: dict[str, list[Callable[[type], list]]] = {
    "`batch_filter`": [
        lambda cls: recursive_then_batch(cls, 2),
        lambda cls: recursive_then_batch(cls, 1),
        batch,
        lambda cls: batch(cls, update_first=True),
        lambda cls: batch_of_lists(cls, False),
        lambda cls: batch_of_lists(cls, True),
    ],
    "`rts_smoother`": [lambda cls: smoothed(cls, 2), lambda cls: smoothed(cls, 1)],
    "`FixedLagSmoother`": [fixed_lag],
    "`Saver`": [saved],
    "`IMMEstimator`": [interacting_models],
    "`MMAEFilterBank`": [multiple_models],
    "`predict`, `update`, `batch_filter`, `rts_smoother` as functions": [procedural],
    "`inv`, `alpha`": [
        lambda cls: custom_inverse(cls, np.linalg.pinv),
        lambda cls: custom_inverse(cls, inv_diagonal),
    ],
}


@pytest.mark.parametrize(
    "scenario", [pytest.param(one, id=f"{use} {k}") for use, several in USES.items() for k, one in enumerate(several)]
)
def test_a_filterpy_use_gives_the_same_bits(scenario: Callable[[type], list]) -> None:
    expected, got = (scenario(cls) for cls in (KalmanFilter, KFOPC))
    assert same(expected, got)
    assert expected, "the scenario saw nothing"


def test_the_page_lists_these_uses() -> None:
    page = (ROOT / "docs" / "filterpy.md").read_text(encoding="utf-8")
    assert {row[0] for row in table_of(page, "Parts of filterpy that were compared")} == {*ELSEWHERE, *USES}


def test_the_imm_of_the_fork_runs_KFOPCs() -> None:
    fork = pytest.importorskip("bayesian_filters.kalman", reason="needs bayesian-filters (the extra `test`)")
    assert same(*(interacting_models(cls, fork.IMMEstimator) for cls in (fork.KalmanFilter, KFOPC)))


# Shapes of z that filterpy's test_z_dim and test_z_checks accept and refuse.

ACCEPTED = [
    (1, 3.0), (1, [3]), (1, (3,)), (1, [[3]]), (1, np.array([[3]])), (1, np.array(3)), (1, True),
    (2, [3, 4]), (2, [[3, 4]]), (2, np.array([[3, 4]])), (2, np.array([[3, 4]]).T),
]  # fmt: skip
REFUSED = [(1, np.array([[[3]]])), (1, [[3, 3]]), (1, []), (2, 3), (2, [3]), (2, [3, 3, 3]), (2, np.eye(2))]


@pytest.mark.parametrize("x_ndim", [1, 2])
@pytest.mark.parametrize("pass_H", [False, True])
@pytest.mark.parametrize(("dim", "z"), ACCEPTED)
def test_shapes_of_z_that_filterpy_accepts(dim: int, z: Any, pass_H: bool, x_ndim: int) -> None:
    """With H passed, too: filterpy 2.0.0 then broadcasts x to (n, 2) for some of these, so its H attribute is the oracle."""
    kf, ours = (constant_velocity(cls, dim=dim, x_ndim=x_ndim) for cls in (KalmanFilter, KFOPC))
    for f in (kf, ours):
        f.predict()
    kf.update(z)
    ours.update(z, **({"H": kf.H} if pass_H else {}))
    for name in ("x", "P", "K", "y", "S") if pass_H else ARRAYS + OTHERS:
        assert same(getattr(kf, name), getattr(ours, name)), name


@pytest.mark.parametrize(("dim", "z"), REFUSED)
def test_shapes_of_z_that_filterpy_refuses(dim: int, z: Any) -> None:
    for cls in (KalmanFilter, KFOPC):
        with pytest.raises(ValueError, match="z"):
            constant_velocity(cls, dim=dim).update(z)


def test_it_is_a_filterpy_filter_with_its_signature() -> None:
    assert issubclass(KFOPC, FilterpyKalmanFilter)
    kf = KFOPC(4, 2, 1)
    assert (kf.dim_x, kf.dim_z, kf.dim_u, kf.rated_power, kf.constraint_factor) == (4, 2, 1, None, 1.0)
    assert KFOPC(dim_x=3).dim_z == 1
    with pytest.raises(TypeError):
        KFOPC(2, 1, 0, 1.0)  # a rated power is named
    for bad in ((0, 1, 0), (1, 0, 0), (1, 1, -1)):
        with pytest.raises(ValueError, match="dim_"):
            KFOPC(*bad)
    with pytest.raises(ValueError, match="alpha"):
        kf.alpha = 0.5
