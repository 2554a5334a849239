"""A masked sample of `batch_filter` is a missing one: the run with None written by hand is the oracle, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

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


@pytest.mark.parametrize("kind", ["general", "random walk"])
@pytest.mark.parametrize("update_first", [False, True])
def test_masked_samples_are_missing_without_references(kind: str, update_first: bool) -> None:
    kf, other = MAKERS[kind](), MAKERS[kind]()
    require_same_run(kf, other, masked(Z), by_hand(Z), Hs=list(ROWS), update_first=update_first)


@pytest.mark.parametrize("shape", [(STEPS, 2), (STEPS, 2, 1)])
def test_a_vector_sample_is_missing_if_any_element_is_masked(shape: tuple[int, ...]) -> None:
    kf, other = KFOPC(N, 2), KFOPC(N, 2)
    for f in (kf, other):
        f.H = np.eye(2, N)
    z = np.random.default_rng(5).normal(size=shape)
    zs = masked(z)
    zs.mask[list(MISSING[1:]), 0] = False  # the second element only
    assert zs[7].mask.sum() == 1
    require_same_run(kf, other, zs, by_hand(z))


def test_a_list_may_hold_masked_samples() -> None:
    kf, other = MAKERS["general"](), MAKERS["general"]()
    zs = [np.ma.masked if z is None else np.ma.array([z]) for z in by_hand(Z)]
    require_same_run(kf, other, zs, by_hand(Z), Hs=list(ROWS))


def test_a_masked_array_without_a_masked_sample() -> None:
    kf, other = MAKERS["general"](), MAKERS["general"]()
    require_same_run(kf, other, np.ma.array(Z), Z, Hs=list(ROWS))
    kf, other = KFOPC(N, 2), KFOPC(N, 2)
    for f in (kf, other):
        f.H = np.eye(2, N)
    require_same_run(kf, other, np.ma.array(Z.reshape(-1, 2)), Z.reshape(-1, 2))


def test_a_batch_of_masked_samples_only_is_a_prediction() -> None:
    kf = KFOPC(N)  # no H is needed
    means, covariances, _, _ = kf.batch_filter(np.ma.masked_all(3))
    assert not means.any()
    np.testing.assert_array_equal(covariances[-1], 4.0 * np.eye(N))
