"""Masked components of a measurement are missing.

The run with None written by hand is the oracle where all are masked, bit for bit. Where some are, it is filterpy's update
with their rows left out of H and R.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import filterpy
import numpy as np
import pytest
from filterpy.common import Saver
from filterpy.kalman import KalmanFilter

from kfopc_filterpy import KFOPC

N, STEPS, MISSING = 4, 40, (0, 7, 8, 39)
NOISES: dict[str, Any] = {"state_noise": 0.01, "measurement_noise": 0.5}
MAKERS: dict[str, Callable[[], KFOPC]] = {
    "general": lambda: KFOPC(N),
    "general, constrained": lambda: KFOPC(N, rated_power=0.5),
    "random walk": lambda: KFOPC.random_walk(N, **NOISES),
    "random walk, constrained": lambda: KFOPC.random_walk(N, rated_power=0.5, **NOISES),
}
rng = np.random.default_rng(4)
ROWS, REFERENCES, Z = rng.normal(size=(STEPS, N)), rng.normal(size=STEPS), 3.0 * rng.normal(size=STEPS)


def masked(values: np.ndarray, behind: float = 1e6) -> np.ma.MaskedArray:
    """The samples with those of MISSING masked, and something wrong behind the mask."""
    result = np.ma.array(values, mask=np.zeros(values.shape, dtype=bool), copy=True)
    result[list(MISSING)] = np.ma.masked
    result.data[list(MISSING)] = behind
    return result


def by_hand(values: np.ndarray) -> list:
    return [None if k in MISSING else z for k, z in enumerate(values)]


def require_same_run(kf: KFOPC, other: KFOPC, zs: Any, others_zs: Any, **arguments: Any) -> None:
    got, expected = kf.batch_filter(zs, **arguments), other.batch_filter(others_zs, **arguments)
    for mine, theirs in zip(got, expected, strict=True):
        assert type(mine) is np.ndarray
        np.testing.assert_array_equal(mine, theirs)
    for name in ("x", "P", "z", "y"):
        np.testing.assert_array_equal(getattr(kf, name), getattr(other, name))
        assert type(getattr(kf, name)) is type(getattr(other, name)), name
    assert kf.constraint_factor == other.constraint_factor
    assert np.abs(got[0]).max() < 100.0, "what is behind the mask was used"


@pytest.mark.parametrize("kind", MAKERS)
@pytest.mark.parametrize("behind", [1e6, np.nan])
@pytest.mark.parametrize("shape", [(STEPS,), (STEPS, 1), (STEPS, 1, 1)])
def test_masked_samples_are_missing_with_references(kind: str, behind: float, shape: tuple[int, ...]) -> None:
    kf, other = MAKERS[kind](), MAKERS[kind]()
    z = Z.reshape(shape)
    require_same_run(kf, other, masked(z, behind), by_hand(z), Hs=list(ROWS), references=REFERENCES)
    in_a_list = [np.ma.masked if z is None else np.ma.array([z]) for z in by_hand(Z)]
    require_same_run(kf, other, in_a_list, by_hand(Z), Hs=list(ROWS), references=REFERENCES)


# Some components of a measurement


STATES, SENSORS = 4, 3


def system(cls: type, x_ndim: int = 2) -> Any:
    """A filter with correlated sensors."""
    rng = np.random.default_rng(8)
    kf = cls(STATES, SENSORS)
    kf.x = rng.normal(size=(STATES, 1)[:x_ndim])
    kf.F = np.eye(STATES) + 0.1 * np.eye(STATES, k=2)
    kf.H = rng.normal(size=(SENSORS, STATES))
    root = rng.normal(size=(SENSORS, SENSORS))
    kf.R, kf.Q = root @ root.T + 0.1 * np.eye(SENSORS), 0.02 * np.eye(STATES)
    return kf


def record(steps: int) -> np.ma.MaskedArray:
    """Measurements of which about 40 % are missing, all of them in some steps, with NaN behind the mask."""
    rng = np.random.default_rng(9)
    z = rng.normal(size=(steps, SENSORS))
    z[rng.random(z.shape) < 0.4] = np.nan
    z[5] = np.nan
    return np.ma.masked_invalid(z)


@pytest.mark.parametrize("x_ndim", [1, 2])
@pytest.mark.parametrize("given", ["nothing", "H", "R", "a number R"])
def test_the_rows_that_are_there_correct_the_state(x_ndim: int, given: str) -> None:
    kf, oracle = system(KFOPC, x_ndim), system(KalmanFilter, x_ndim)
    rng = np.random.default_rng(10)
    for z in record(60):
        H = rng.normal(size=(SENSORS, STATES)) if given == "H" else None
        R = {"R": np.diag(rng.uniform(0.1, 1.0, SENSORS)), "a number R": 0.3}.get(given)
        for f in (kf, oracle):
            f.predict()
        kf.update(z, R=R, H=H)
        there = ~z.mask
        oracle.dim_z = there.sum()  # filterpy 1.4.5 wants as many values
        if there.any():
            noise = 0.3 * np.eye(SENSORS) if given == "a number R" else oracle.R if R is None else R
            row = oracle.H if H is None else H
            oracle.update(z.data[there].reshape((-1, 1)[:x_ndim]), R=noise[np.ix_(there, there)], H=row[there])
            np.testing.assert_allclose(kf.log_likelihood, oracle.log_likelihood, rtol=1e-12, atol=1e-12)
            distance = np.sqrt(oracle.y.ravel() @ oracle.SI @ oracle.y.ravel())  # 1.4.5's own fails on numpy 2
            np.testing.assert_allclose(kf.mahalanobis, distance, rtol=1e-12)
            np.testing.assert_array_equal(kf.z.ravel(), np.where(there, z.data, np.nan))
            assert not kf.y[~there].any()
            assert not kf.K[:, ~there].any()
        else:
            oracle.update(None)
        np.testing.assert_allclose(kf.x, oracle.x, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(kf.P, oracle.P, rtol=1e-12, atol=1e-12)


def test_a_batch_with_gaps_is_its_steps_and_a_saver_keeps_it() -> None:
    kf, steps, zs = system(KFOPC), system(KFOPC), record(30)
    zs[zs.mask.all(axis=1)] = 0.0  # filterpy keeps None in z where all are missing
    saver = Saver(kf)
    means, covariances, _, _ = kf.batch_filter(zs, saver=saver)
    saver.to_array()
    for k, z in enumerate(zs):
        steps.predict()
        steps.update(z)
        np.testing.assert_array_equal(means[k], steps.x)
        np.testing.assert_array_equal(covariances[k], steps.P)
    assert saver.z.shape == (30, SENSORS, 1)
    np.testing.assert_array_equal(np.isnan(saver.z[..., 0]), zs.mask)


@pytest.mark.parametrize(
    ("z", "match"),
    [
        (np.ma.array([1.0, 2.0], mask=[False, True]), r"z must have 3 value\(s\), with the masked ones"),
        (np.ma.array([np.nan, 2.0, 0.0], mask=[False, False, True]), "z must be finite"),
    ],
)
def test_what_is_wrong_beside_a_gap_is_refused(z: np.ma.MaskedArray, match: str) -> None:
    kf, twin = system(KFOPC), system(KFOPC)
    with pytest.raises(ValueError, match=match):
        kf.update(z)
    for name in ("x", "P", "y", "z"):
        np.testing.assert_array_equal(getattr(kf, name), getattr(twin, name))


def test_a_rated_power_needs_all_measurements() -> None:
    """The power of the disturbance cannot be taken from some of the microphones."""
    kf, twin = (KFOPC(STATES, 2, rated_power=1.0) for _ in range(2))
    H = np.ones((2, STATES))
    with pytest.raises(ValueError, match="a rated power needs all measurements at once: mask them all"):
        kf.update(np.ma.array([1.0, 2.0], mask=[False, True]), H=H, reference=1.0)
    kf.update(np.ma.masked_all(2), H=H, reference=1.0)
    twin.update(None)
    for f in (kf, twin):
        f.update([1.0, 2.0], H=H, reference=1.0)
    np.testing.assert_array_equal(kf.x, twin.x)
    assert kf.disturbance_power == twin.disturbance_power


@pytest.mark.skipif(filterpy.__version__ == "1.4.5", reason="filterpy 1.4.5 refuses more rows than dim_z")
def test_a_random_walk_with_several_rows_says_which_are_missing() -> None:
    walk, general = KFOPC.random_walk(N, **NOISES), KFOPC(N, 2)
    general.P, general.Q, general.R = np.array(walk.P), np.array(walk.Q), 0.5 * np.eye(2)
    z = np.ma.masked_invalid([np.nan, 1.0])
    for kf in (walk, general):
        kf.update(z, H=np.eye(2, N), R=0.5 * np.eye(2))
        np.testing.assert_array_equal(kf.z.ravel(), [np.nan, 1.0])
    np.testing.assert_allclose(walk.x, general.x, rtol=0, atol=1e-12)
