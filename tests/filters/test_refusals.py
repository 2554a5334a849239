"""Mistakes that would go unnoticed: a covariance that is none, dimensions that are no numbers.

Each is refused with a message that says what to do. The filter is unchanged and goes on like one that never saw it.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from kfopc_filterpy import KFOPC

N = 3
ROW = np.array([1.0, 0.5, -0.25])
NOISES: dict[str, Any] = {"state_noise": 0.01, "measurement_noise": 0.5}


def require_same_course(kf: KFOPC, twin: KFOPC) -> None:
    """Both are in the same state, and stay so."""
    for z in (1.0, -2.0, 0.5):
        for name in ("x", "P", "K", "S"):
            np.testing.assert_array_equal(getattr(kf, name), getattr(twin, name), err_msg=name)
        for f in (kf, twin):
            f.predict()
            f.update(z, H=ROW, reference=1.0)
    assert kf.x.any()


# P


def rotated(*eigenvalues: float) -> np.ndarray:
    """A matrix with these eigenvalues and a positive diagonal."""
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(N, N)))[0]
    return rotation @ np.diag(eigenvalues) @ rotation.T


NOT_COVARIANCES = {
    "a negative number": -2.0,
    "indefinite": np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "indefinite and tiny": 1e-200 * np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "indefinite and huge": 1e300 * np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "a negative list": (-np.eye(N)).tolist(),
}
COVARIANCES = {
    "singular to rounding": rotated(1.0, 0.3, -1e-15),
    "of very different sizes": np.diag([1e12, 1.0, 1e-12]),
    "a number": 3.0,
    "tiny": 1e-300 * np.eye(N),
    "huge": 1e200 * np.eye(N),  # the squares overflow
}


@pytest.mark.parametrize("name", NOT_COVARIANCES)
@pytest.mark.parametrize(
    ("step", "arguments"),
    [
        ("predict", []),
        ("update", [1.0]),
        ("update_correlated", [1.0]),
        ("predict_steadystate", []),
        ("batch_filter", [[1.0, 2.0]]),
    ],
)
def test_a_P_that_is_no_covariance_is_refused_at_the_next_step(name: str, step: str, arguments: list) -> None:
    kf = KFOPC(N)
    kf.H = ROW
    kf.predict()
    kf.update(1.0)
    twin = copy.deepcopy(kf)
    good, kf.P = kf.P, NOT_COVARIANCES[name]
    with pytest.raises(ValueError, match=r"P must be positive semidefinite.* smallest eigenvalue is -.*Nothing was"):
        getattr(kf, step)(*arguments)
    assert kf.P is NOT_COVARIANCES[name]
    kf.P = good
    require_same_course(kf, twin)


def test_the_random_walk_filter_refuses_it_when_it_is_assigned_or_at_the_next_step() -> None:
    kf = KFOPC.random_walk(N, **NOISES)
    twin = copy.deepcopy(kf)
    for P in NOT_COVARIANCES.values():
        with pytest.raises(ValueError, match="P must"):
            kf.P = P
        require_same_course(copy.deepcopy(kf), copy.deepcopy(twin))
    kf.P[0, 1] = kf.P[1, 0] = 5.0
    with pytest.raises(ValueError, match=r"P must be positive semidefinite.* eigenvalue is -4"):
        kf.predict()
    kf.P[0, 1] = kf.P[1, 0] = 0.0
    require_same_course(kf, twin)


@pytest.mark.parametrize("name", COVARIANCES)
def test_any_covariance_is_accepted(name: str) -> None:
    """As filterpy's filter uses it, bit for bit."""
    filters = [KalmanFilter(N, 1), KFOPC(N)]
    for kf in [*filters, KFOPC.random_walk(N, **NOISES)]:
        kf.P = COVARIANCES[name]
        kf.predict()
        kf.update(1.0, H=ROW.reshape(1, -1))
    np.testing.assert_array_equal(filters[0].P, filters[1].P)


# F and H as nested lists


def test_F_and_H_may_be_nested_lists() -> None:
    """filterpy fails at its `F.T` and `H.T`; with arrays it is the oracle."""
    F, H, B = [[1, 0.5], [0, 1]], [[1, 0]], np.array([[1.0], [0.0]])
    kf, attributes, arguments = KalmanFilter(2, 1), KFOPC(2), KFOPC(2)
    kf.F, kf.H = np.array(F), np.array(H)
    attributes.F, attributes.H = F, H
    for z in (1.0, 2.0, None, 4.0):
        for f in (kf, attributes):
            f.predict(u=1.0, B=B)
            f.update(z)
        arguments.predict(u=1.0, B=B, F=F)
        arguments.update(z, H=H)
        for f in (attributes, arguments):
            np.testing.assert_array_equal(f.x, kf.x)
            np.testing.assert_array_equal(f.P, kf.P)
    assert isinstance(attributes.F, np.ndarray)


# Dimensions


@pytest.mark.parametrize("bad", ["4", 4.0, None, [4], np.float64(4.0)])
@pytest.mark.parametrize("name", ["dim_x", "dim_z"])
def test_dimensions_are_whole_numbers(name: str, bad: Any) -> None:
    with pytest.raises(TypeError, match=f"{name} must be a whole number, got "):
        KFOPC(**{"dim_x": 4, "dim_z": 1} | {name: bad})
    assert KFOPC(**{"dim_x": 4, "dim_z": 1} | {name: np.int64(2)}).x.any() == 0
