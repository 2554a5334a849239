"""Checkpoints of the filters: saved at any sample, a filter continues to the bit."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.checkpoints import assert_same_contents
from helpers.controllers import FILTERS, N_TAPS
from hypothesis import given, settings
from hypothesis import strategies as st

from kfopc_filterpy import KFOPC

N = 60


def step(kf: Any, n: int) -> tuple[np.ndarray, ...]:
    """Give a filter the sample n, one in seven of which is missing; return what it knows then."""
    rng = np.random.default_rng(n)
    row, z = rng.standard_normal(N_TAPS), float(rng.standard_normal())
    kf.predict()
    budget = {"reference": row[0]} if hasattr(kf, "budget") or kf.rated_power is not None else {}
    kf.update(None if n % 7 == 6 else z, H=row, **budget)
    return kf.x.copy(), kf.P.copy(), np.array(kf.K), np.array(kf.constraint_factor)


@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_that_is_saved_at_any_sample_continues_to_the_bit(
    name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("saved") / "filter.kfopc"

    @given(st.integers(0, N))
    @settings(max_examples=10)
    def check(samples: int) -> None:
        kf = FILTERS[name]()
        for n in range(samples):
            step(kf, n)
        kf.save(path)
        loaded = type(kf).load(path)
        assert_same_contents(loaded, kf)
        for n in range(samples, N):
            for mine, theirs in zip(step(loaded, n), step(kf, n), strict=True):
                np.testing.assert_array_equal(mine, theirs)
        for read in ("P_prior", "P_post", "x_prior", "y", "z", "S", "log_likelihood", "disturbance_power"):
            np.testing.assert_array_equal(getattr(loaded, read), getattr(kf, read))

    check()


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda kf: pickle.loads(pickle.dumps(kf))])
def test_a_copy_continues_and_the_filter_does_not_notice(name: str, copied: Any) -> None:
    kf, alone = FILTERS[name](), FILTERS[name]()
    for n in range(20):
        step(kf, n), step(alone, n)
    twin = copied(kf)
    ahead = [step(twin, n) for n in range(20, 40)]
    for n, there in zip(range(20, 40), ahead, strict=True):
        for mine, theirs, undisturbed in zip(step(kf, n), there, step(alone, n), strict=True):
            np.testing.assert_array_equal(mine, theirs)
            np.testing.assert_array_equal(mine, undisturbed)


def test_what_was_written_into_P_before_it_was_saved_takes_effect_after_it_is_loaded(tmp_path: Path) -> None:
    kf = FILTERS["random walk"]()
    step(kf, 0)
    kf.P[0, 0] *= 4.0
    kf.save(tmp_path / "filter.kfopc")
    loaded = KFOPC.load(tmp_path / "filter.kfopc")
    np.testing.assert_array_equal(step(loaded, 1)[1], step(kf, 1)[1])
    untouched = FILTERS["random walk"]()
    step(untouched, 0)
    assert not np.array_equal(step(untouched, 1)[1], loaded.P)


def test_arrays_of_a_file_can_be_written_into_but_views_that_only_show_cannot(tmp_path: Path) -> None:
    kf = FILTERS["random walk"]()
    assert not kf.Q.flags.writeable
    kf.B = np.ones((N_TAPS, 1))
    kf.B.flags.writeable = False
    kf.save(tmp_path / "filter.kfopc")
    loaded = KFOPC.load(tmp_path / "filter.kfopc")
    assert not loaded.Q.flags.writeable
    assert loaded.B.flags.writeable
    assert loaded.x.flags.writeable
