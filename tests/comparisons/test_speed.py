"""The speed study: what is compared does the same, and the page shows today's tables. The times are the machine's."""

from __future__ import annotations

import time

import numpy as np
import pytest
from helpers.pages import ROOT
from helpers.studies import smaller

from comparisons.__main__ import main
from comparisons.speed import controllers, estimator, study, timing


def run(kf, steps):
    """Run a filter through its steps, and return it."""
    estimator.stepping(kf, steps)[0]()
    return kf


def test_every_kind_of_input_gives_filterpys_estimate():
    filters = estimator.random_walks(16)
    del filters["rated power"]
    theirs = run(*filters["filterpy"])
    for name in ("float", "np.float64", "0-d", "(1,)", "row (1, L)"):
        ours = run(*filters[name])
        # The same equations in another order of sums, over 50 steps.
        np.testing.assert_allclose(ours.x, theirs.x, rtol=1e-10, atol=1e-14, err_msg=name)
        np.testing.assert_allclose(ours.P, theirs.P, rtol=1e-10, atol=1e-14, err_msg=name)


def test_the_rated_power_acts_on_the_filter_that_is_timed():
    assert run(*estimator.random_walks(16)["rated power"]).constraint_factor < 0.9


@pytest.mark.parametrize("filters", [estimator.trackers(6, 3), estimator.banks()], ids=["tracker", "bank"])
def test_trackers_give_filterpys_estimate(filters):
    theirs, ours = (run(*filters[name]).x for name in ("filterpy", "KFOPC"))
    np.testing.assert_allclose(ours, theirs, rtol=1e-10)


def test_a_time_is_the_best_turn_of_a_sample_without_the_first():
    clock = iter([0.0, 1.0, 0.0, 8.0, 0.0, 4.0, 0.0, 6.0])  # turns of 1 s, which warms up, then 8 s, 4 s and 6 s
    with smaller(timing, ROUNDS=3), pytest.MonkeyPatch.context() as patch:
        patch.setattr(time, "process_time", lambda: next(clock))
        assert timing.microseconds({"a": (lambda: None, 2)}) == {"a": 2e6}


@pytest.mark.slow
def test_the_command_prints_every_table(capsys):
    few = {"SAMPLES": {name: controllers.SAMPLES[name] for name in ("KF-PB, simulate", "filterpy")}, "TAPS": (16, 32)}
    with (
        smaller(timing, ROUNDS=2),
        smaller(study, BLOCK_SAMPLES=1024),
        smaller(estimator, TAPS=(2, 16)),
        smaller(controllers, LONG_TAPS=(512,), **few),
    ):
        assert main(["speed"]) == 0
    printed = capsys.readouterr().out
    for name in (*few["SAMPLES"], *controllers.BLOCK_CONTROLLERS, *controllers.LONG, "random walk, µs", "32"):
        assert name in printed


def test_a_table_that_is_not_there_is_refused(capsys):
    with pytest.raises(SystemExit):
        main(["speed", "weather"])
    assert "no table called weather; there are estimator, samples, blocks, long" in capsys.readouterr().err


def test_the_page_shows_the_tables_of_today():
    printed = (ROOT / "docs" / "speed.txt").read_text(encoding="utf-8")
    walks, trackers, samples, blocks, long = printed.rstrip().split("\n\n")
    assert column(walks) == [str(taps) for taps in estimator.TAPS]
    assert len(column(trackers)) == len(estimator.TRACKERS) + 1
    assert column(samples)[:-1] == list(controllers.SAMPLES)
    assert list(dict.fromkeys(column(blocks))) == list(controllers.BLOCK_CONTROLLERS)
    assert column(long) == list(controllers.LONG)


def column(table):
    """Return the names of a table's rows."""
    return [line.split("  ")[0] for line in table.splitlines()[1:]]
