"""What else of filterpy uses a filter, with KFOPC in the place of KalmanFilter: the same bits.

The steps themselves are compared in `test_against_filterpy.py`. The page's last table lists the parts of both files.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from filterpy.common import Q_discrete_white_noise, Saver, inv_diagonal
from filterpy.kalman import FixedLagSmoother, IMMEstimator, KalmanFilter, MMAEFilterBank
from filterpy.kalman import kalman_filter as functions
from helpers.filterpys import Oracle
from helpers.pages import ROOT, table_of

from kfopc_filterpy import KFOPC

Z = (np.arange(60) + 20 * np.random.default_rng(5).normal(size=60)).tolist()


def same(a: Any, b: Any) -> bool:
    """Equal in every bit, and of the same kind and shape."""
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return type(a) is type(b) and a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b)
    return type(a) is type(b) and a == b


def constant_velocity(kind: type) -> Any:
    kf = kind(dim_x=2, dim_z=1)
    kf.x, kf.F, kf.H = np.array([[2.0, 0.0]]).T, np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    kf.P *= 1000.0
    kf.R, kf.Q = kf.R * 5.0, Q_discrete_white_noise(2, 1.0, 0.01)
    return kf


def numbers(kind: type) -> list:
    """A batch takes a number in Q as a multiple of the identity; steps and the smoother add it to every element."""
    kf = constant_velocity(kind)
    kf.P, kf.R, kf.Q = 0.01, 5, 0.001
    means, covariances, _, _ = kf.batch_filter(Z, update_first=True)
    kf.predict()
    return [means, covariances, kf.P, *kf.rts_smoother(means, covariances, Fs=[kf.F] * len(Z))]


def pair_of_models(kind: type) -> list[Any]:
    """Constant acceleration, with much noise and with little."""
    filters = []
    for var in (0.02, 0.5):
        kf = kind(3, 1)
        kf.x, kf.H = np.zeros(3), np.array([[1.0, 0, 0]])
        kf.P *= 3
        kf.R *= 0.36
        kf.F, kf.Q = np.array([[1, 0.1, 0.005], [0, 1, 0.1], [0, 0, 1]]), Q_discrete_white_noise(3, 0.1, var)
        filters.append(kf)
    return filters


def multiple_models(kind: type) -> list:
    filters = pair_of_models(kind)
    filters[0].F[:, 2] = 0
    filters[0].P[2, 2] = filters[0].Q[2, 2] = 0
    bank = MMAEFilterBank(filters, (0.5, 0.5), dim_x=3, H=filters[0].H)
    seen = []
    for z in Z[:20]:
        bank.predict()
        bank.update(z)
        seen += [bank.x, bank.P, np.array(bank.p), filters[0].likelihood]
    return seen


def fixed_lag(kind: type) -> list:
    kf, smoother = constant_velocity(kind), FixedLagSmoother(dim_x=2, dim_z=1, N=5)
    for name in ("x", "P", "F", "H", "Q", "R"):
        setattr(smoother, name, getattr(kf, name))
    for z in Z[:30]:
        kf.predict()
        kf.update(z)
        smoother.smooth(z)
    return [kf.x, smoother.x, *smoother.xSmooth, *smoother.smooth_batch(Z[:30], N=5)]


def procedural(kind: type) -> list:
    kf, n = constant_velocity(kind), 20
    x, P = functions.predict(kf.x, kf.P, F=kf.F, Q=kf.Q)
    x, P = functions.update(x, P, 4.0, kf.R, kf.H)
    means, covariances, _, _ = functions.batch_filter(x, P, Z[:n], [kf.F] * n, [kf.Q] * n, [kf.H] * n, [kf.R] * n)
    return [x, P, means, covariances, *functions.rts_smoother(means, covariances, [kf.F] * n, [kf.Q] * n)]


USES: dict[str, Callable[[type], list]] = {
    "`batch_filter`, `rts_smoother`": numbers,
    "`FixedLagSmoother`": fixed_lag,
    "`MMAEFilterBank`": multiple_models,
    "`predict`, `update`, `batch_filter`, `rts_smoother` as functions": procedural,
}
IN_THE_MACHINE = [
    "`predict`, `update`",
    "`predict_steadystate`, `update_steadystate`",
    "`update_correlated`",
    "`update_sequential`",
    "`get_prediction`, `get_update`",
    "`residual_of`, `log_likelihood_of`, `measurement_of_state`",
    "`copy`, `deepcopy`, `pickle`",
    "`alpha`",
    "`Saver`",
]


@pytest.mark.parametrize("use", USES)
def test_a_filterpy_use_gives_the_same_bits(use: str) -> None:
    expected, got = (USES[use](kind) for kind in (Oracle, KFOPC))
    assert same(expected, got)
    assert expected, "the use saw nothing"


# Uses that have a random walk, too: they get a function that makes a filter with a state noise.


def interacting_models(make: Callable[[float], Any], estimator: type = IMMEstimator) -> list:
    bank = estimator([make(1e-4), make(1e-1)], (0.5, 0.5), np.array([[0.97, 0.03], [0.03, 0.97]]))
    saver, seen = Saver(bank, ignore=("filters",)), []
    for z in Z:
        bank.predict()
        bank.update(np.array([[z]]))
        saver.save()
        seen += [bank.x, bank.P, bank.mu, bank.filters[0].x, bank.filters[1].P, bank.filters[0].likelihood]
    return seen


def inverses(make: Callable[[float], Any]) -> list:
    seen = []
    for inverse in (np.linalg.pinv, inv_diagonal):
        kf = make(0.5)
        kf.inv = inverse
        for z in Z[:10]:
            kf.predict()
            kf.update(np.array([[z]]))
        if inverse is np.linalg.pinv:
            kf.update(np.array([[3.0]]), H=np.zeros((1, 2)), R=np.zeros((1, 1)))  # S = 0: its gain is 0
        seen += [kf.x, kf.P, kf.SI]
    return seen


def make_general(kind: type, r: float) -> Any:
    kf = kind(2, 1)
    kf.Q, kf.R, kf.H = r * np.eye(2), np.array([[0.5]]), np.array([[1.0, 0.5]])
    return kf


def make_walk(r: float) -> Any:
    kf = KFOPC.random_walk(2, state_noise=r, measurement_noise=0.5)
    kf.H = np.array([[1.0, 0.5]])
    return kf


OF_WALKS = {"`IMMEstimator`": interacting_models, "`inv`": inverses}


@pytest.mark.parametrize("use", OF_WALKS)
def test_a_filterpy_use_gives_the_same_bits_and_with_the_random_walk_the_same_numbers(use: str) -> None:
    expected, got = (OF_WALKS[use](partial(make_general, kind)) for kind in (Oracle, KFOPC))
    assert same(expected, got)
    for theirs, ours in zip(expected, OF_WALKS[use](make_walk), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-11)


def test_the_page_lists_these_uses() -> None:
    page = (ROOT / "docs" / "filterpy.md").read_text(encoding="utf-8")
    assert {row[0] for row in table_of(page, "Parts of filterpy that were compared")} == {
        *IN_THE_MACHINE,
        *USES,
        *OF_WALKS,
    }


def test_the_imm_of_the_fork_runs_KFOPCs() -> None:
    fork = pytest.importorskip("bayesian_filters.kalman", reason="needs bayesian-filters (the extra `test`)")
    makers = (partial(make_general, kind) for kind in (fork.KalmanFilter, KFOPC))
    assert same(*(interacting_models(make, fork.IMMEstimator) for make in makers))


def test_the_smoother_takes_gaps_and_the_inputs_that_filterpys_leaves_out() -> None:
    """The oracle is least squares over all states, noises and measurements at once."""
    n, rng = 6, np.random.default_rng(3)
    F, B, H = np.array([[1.0, 0.5], [0.0, 0.9]]), np.array([[0.1], [1.0]]), np.array([[1.0, 0.3], [0.2, 2.0]])
    us, hidden = rng.normal(size=(n, 1, 1)) * 10.0, np.arange(2 * n).reshape(n, 2) % 5 == 3
    hidden[4] = True
    z = np.ma.array(rng.normal(size=(n, 2)), mask=hidden)
    kf = KFOPC(2, 2, 1)
    kf.F, kf.B, kf.H, kf.Q, kf.R = F, B, H, np.diag([0.1, 0.2]), np.diag([0.5, 0.4])
    means, covariances, _, _ = kf.batch_filter(z, us=us)
    means.flags.writeable = covariances.flags.writeable = False
    smoothed, P, _, _ = kf.rts_smoother(means, covariances, us=us)
    # x(0) = F x0 + B u(0) + w with x0 ~ (0, I); x(k) = F x(k-1) + B u(k) + w; z = H x + v
    start = np.linalg.cholesky(np.linalg.inv(F @ F.T + kf.Q)).T
    noise = np.linalg.cholesky(np.linalg.inv(kf.Q)).T
    A, b = np.zeros((4 * n, 2 * n)), np.zeros(4 * n)
    for k in range(n):
        rows, own = slice(2 * k, 2 * k + 2), start if k == 0 else noise
        A[rows, rows], b[rows] = own, own @ (B @ us[k]).ravel()
        if k:
            A[rows, 2 * k - 2 : 2 * k] = -own @ F
        measured = slice(2 * n + 2 * k, 2 * n + 2 * k + 2)
        weights = ~hidden[k] / np.sqrt([0.5, 0.4])
        A[measured, rows], b[measured] = weights[:, None] * H, weights * z.data[k]
    states = np.linalg.lstsq(A, b, rcond=None)[0]
    np.testing.assert_allclose(smoothed.ravel(), states, rtol=1e-9)
    np.testing.assert_allclose(P[2], np.linalg.inv(A.T @ A)[4:6, 4:6], rtol=1e-9)
    given = {"us": [None if k == 2 else u for k, u in enumerate(us)], "Bs": [B] * n, "Fs": [F] * n}
    means, covariances, _, _ = kf.batch_filter(z, **given)
    kf.B = None
    with_zero = kf.rts_smoother(means, covariances, us=[0.0 * u if k == 2 else u for k, u in enumerate(us)], Bs=[B] * n)
    np.testing.assert_allclose(kf.rts_smoother(means, covariances, **given)[0], with_zero[0], rtol=1e-12)
    still = KFOPC(2, 2, 1)
    still.B = B
    still.predict_steadystate()
    still.predict(u=np.zeros((1, 1)))
    still.rts_smoother(means, covariances)  # no input moved this filter


def test_it_is_a_filterpy_filter_with_its_signature_and_its_repr() -> None:
    assert issubclass(KFOPC, KalmanFilter)
    kf = KFOPC(4, 2, 1)
    assert (kf.dim_x, kf.dim_z, kf.dim_u, kf.rated_power, kf.constraint_factor) == (4, 2, 1, None, 1.0)
    assert KFOPC(dim_x=3).dim_z == 1
    with pytest.raises(TypeError):
        KFOPC(2, 1, 0, 1.0)  # a rated power is named
    for bad in ((0, 1, 0), (1, 0, 0), (1, 1, -1)):
        with pytest.raises(ValueError, match="dim_"):
            KFOPC(*bad)
    shown = repr(KFOPC.random_walk(2, state_noise=1.0, measurement_noise=1.0, rated_power=2.0, fs=8000))
    assert shown.startswith("RandomWalkKFOPC object\ndim_x = 2\n")
    assert "\nP = [[1. 0.]" in shown
    assert "\nrated_power = 2.0\nconstraint_factor = 1.0\n" in shown
