"""What the tutorial for filterpy users says of its figures."""

from __future__ import annotations

import re

import numpy as np
from helpers.pages import TUTORIALS, Page


def test_the_figures_say_what_the_page_says():
    page = Page("filterpy_users")

    v = page.run(until="Batches, masked samples, a smoother and a Saver")
    assert np.array_equal(v.ours.x, v.theirs.x)
    assert np.array_equal(v.ours.P, v.theirs.P)
    assert v.ours.log_likelihood == v.theirs.log_likelihood
    assert 0.05 < np.mean(np.isnan(v.measured)) < 0.15

    v = page.run(until="Gaps in a vector measurement")
    assert np.array_equal(v.xs, v.their_xs)
    assert np.array_equal(v.smoothed, v.their_smoothed)
    np.testing.assert_array_equal(v.saver.P, v.Ps)
    errors = [v.rms(signal - v.position) for signal in (v.masked, v.xs[:, 0, 0], v.smoothed[:, 0, 0])]
    assert errors[0] > 1.5 * errors[1] > 1.5 * errors[2]

    v = page.run(until="Banks of filters: IMM and MMAE")
    np.testing.assert_allclose(v.kf.x, v.theirs.x, rtol=1e-12)
    assert np.array_equal(v.in_a_batch[-1], v.kf.x)
    assert 0.3 < np.mean(v.pair_of_sensors.mask[:, 1]) < 0.7

    v = page.run(until="A bank with a rated power")
    for got, expected in zip(v.banks(v.KFOPC), v.banks(v.KalmanFilter), strict=True):
        assert np.array_equal(got, expected)
    calm, agile, *both = v.errors["straight"]
    assert max(both) < 1.2 * calm < 0.6 * agile
    calm, agile, *both = v.errors["manoeuvre"]
    assert max(both) < 1.1 * agile < 0.3 * calm
    before, after = (v.probability[half].mean() for half in v.halves.values())
    assert before < 0.1 < 0.9 < after

    v = page.run(until="Speed")
    free, known, wrong = v.bank_runs.values()
    for part in v.settled:
        assert np.mean(free[0][part] ** 2) > 3 * v.rated
        assert abs(np.mean(known[0][part] ** 2) / v.rated - 1) < 0.05
        assert abs(np.mean(wrong[0][part] ** 2) / v.rated - 0.25) < 0.02
        assert wrong[2][part].mean() > 0.9
    after = slice(v.n // 2 + 5, v.n // 2 + 30)
    for _, _, fast, _ in (free, known):
        assert fast[after].mean() > 0.8 > 0.2 > fast[v.settled[0]].mean()
    assert np.ptp(v.factors, axis=1).max() == 0
    assert np.ptp(v.factors) > 0.1

    v = page.run()
    assert v.timed[128, "filterpy"] > 2 * v.timed[128, "random_walk"]


def test_it_shows_two_rows_of_the_table_on_speed():
    text = (TUTORIALS / "filterpy_users.md").read_text(encoding="utf-8")
    chosen = re.search(r"\.\./speed\.txt\n:language: text\n:lines: (.*)", text)[1]
    lines = (TUTORIALS.parent / "speed.txt").read_text(encoding="utf-8").splitlines()
    shown = [
        line for item in chosen.split(", ") for line in lines[int(item.split("-")[0]) - 1 : int(item.split("-")[-1])]
    ]
    assert [line[:20].strip() for line in shown] == ["µs a sample", "filterpy API of KFOP", "filterpy"]
