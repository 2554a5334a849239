"""filterpy's IMM with KFOPC in the place of KalmanFilter, and the smoother of samples with gaps.

The steps themselves are compared in `test_against_filterpy.py`. What else uses a filter is in filterpy's own tests, which
`test_filterpy_own_tests.py` runs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from filterpy.common import Saver
from filterpy.kalman import IMMEstimator, KalmanFilter
from helpers.filterpys import Oracle

from kfopc_filterpy import KFOPC

Z = (np.arange(60) + 20 * np.random.default_rng(5).normal(size=60)).tolist()


def interacting_models(make: Callable[[float], Any], estimator: type = IMMEstimator) -> list:
    bank = estimator([make(1e-4), make(1e-1)], (0.5, 0.5), np.array([[0.97, 0.03], [0.03, 0.97]]))
    saver, seen = Saver(bank, ignore=("filters",)), []
    for z in Z:
        bank.predict()
        bank.update(np.array([[z]]))
        saver.save()
        seen += [bank.x, bank.P, bank.mu, bank.filters[0].x, bank.filters[1].P, bank.filters[0].likelihood]
    return seen


def make_general(kind: type, r: float) -> Any:
    kf = kind(2, 1)
    kf.Q, kf.R, kf.H = r * np.eye(2), np.array([[0.5]]), np.array([[1.0, 0.5]])
    return kf


def make_walk(r: float) -> Any:
    kf = KFOPC.random_walk(2, state_noise=r, measurement_noise=0.5)
    kf.H = np.array([[1.0, 0.5]])
    return kf


def test_the_imm_gives_the_same_bits_and_with_the_random_walk_the_same_numbers() -> None:
    expected, got = (interacting_models(partial(make_general, kind)) for kind in (Oracle, KFOPC))
    for theirs, ours, of_walk in zip(expected, got, interacting_models(make_walk), strict=True):
        np.testing.assert_array_equal(ours, theirs)
        np.testing.assert_allclose(of_walk, theirs, rtol=1e-10, atol=1e-11)


def test_the_imm_of_the_fork_runs_KFOPCs() -> None:
    fork = pytest.importorskip("bayesian_filters.kalman", reason="needs bayesian-filters (the extra `test`)")
    makers = (partial(make_general, kind) for kind in (fork.KalmanFilter, KFOPC))
    for theirs, ours in zip(*(interacting_models(make, fork.IMMEstimator) for make in makers), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_the_smoother_takes_gaps() -> None:
    """The oracle is least squares over all states, noises and measurements at once."""
    n, rng = 6, np.random.default_rng(3)
    F, H = np.array([[1.0, 0.5], [0.0, 0.9]]), np.array([[1.0, 0.3], [0.2, 2.0]])
    hidden = np.arange(2 * n).reshape(n, 2) % 5 == 3
    hidden[4] = True
    z = np.ma.array(rng.normal(size=(n, 2)), mask=hidden)
    kf = KFOPC(2, 2, 1)
    kf.F, kf.H, kf.Q, kf.R = F, H, np.diag([0.1, 0.2]), np.diag([0.5, 0.4])
    kf.B = np.array([[0.1], [1.0]])
    means, covariances, _, _ = kf.batch_filter(z, us=np.zeros((n, 1, 1)))  # which move nothing
    means.flags.writeable = covariances.flags.writeable = False
    smoothed, P, _, _ = kf.rts_smoother(means, covariances)
    # x(0) = F x0 + w with x0 ~ (0, I); x(k) = F x(k-1) + w; z = H x + v
    start = np.linalg.cholesky(np.linalg.inv(F @ F.T + kf.Q)).T
    noise = np.linalg.cholesky(np.linalg.inv(kf.Q)).T
    A, b = np.zeros((4 * n, 2 * n)), np.zeros(4 * n)
    for k in range(n):
        rows, own = slice(2 * k, 2 * k + 2), start if k == 0 else noise
        A[rows, rows] = own
        if k:
            A[rows, 2 * k - 2 : 2 * k] = -own @ F
        measured = slice(2 * n + 2 * k, 2 * n + 2 * k + 2)
        weights = ~hidden[k] / np.sqrt([0.5, 0.4])
        A[measured, rows], b[measured] = weights[:, None] * H, weights * z.data[k]
    np.testing.assert_allclose(smoothed.ravel(), np.linalg.lstsq(A, b, rcond=None)[0], rtol=1e-9)
    np.testing.assert_allclose(P[2], np.linalg.inv(A.T @ A)[4:6, 4:6], rtol=1e-9)


def test_a_table_with_none_in_its_gaps_is_one_with_masks() -> None:
    """As pandas gives it with ``df.replace(nan, None)``; a row of None is a missed sample."""
    table = np.array([[1.0, 2.0], [None, None], [3.0, None], [4.0, 5.0]], dtype=object)
    masked = np.ma.masked_invalid(table.astype(float))
    results = []
    for zs in (masked, table, table.tolist()):
        kf = KFOPC(dim_x=2, dim_z=2)
        kf.H = np.eye(2)
        results.append(kf.batch_filter(zs))
    for one in results[1:]:
        for found, expected in zip(one, results[0], strict=True):
            np.testing.assert_array_equal(found, expected)


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
