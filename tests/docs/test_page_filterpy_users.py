"""What the recipes for filterpy users say of their figures, each copied and run alone."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from helpers.pages import TUTORIALS, Page

HEADINGS = [line[3:] for line in (TUTORIALS / "filterpy_users.md").read_text("utf-8").splitlines() if line[:3] == "## "]


@pytest.fixture
def recipe(request, capsys):
    """The variables of one recipe, run without those before it, and what it printed."""
    page, number = Page("filterpy_users"), request.param
    page.skip(HEADINGS[number - 1])
    variables = page.run(until=HEADINGS[number] if number < len(HEADINGS) else None)
    variables.printed = capsys.readouterr().out
    return variables


def of(number):
    return pytest.mark.parametrize("recipe", [number], indirect=True)


def test_there_are_ten():
    assert [int(heading.split(".")[0]) for heading in HEADINGS] == list(range(1, 11))


@of(1)
def test_the_weights_are_found(recipe):
    np.testing.assert_allclose(recipe.kf.x.ravel(), recipe.weights, atol=0.03)


@of(2)
def test_gaps_are_filled_and_the_smoother_is_better(recipe):
    v = recipe
    theirs = KalmanFilter(dim_x=2, dim_z=2)
    theirs.F, theirs.H, theirs.R, theirs.Q, theirs.P = v.kf.F, v.kf.H, v.kf.R, v.kf.Q, 10 * np.eye(2)
    for k, z in enumerate(v.z):
        there = ~np.isnan(z)
        theirs.predict()
        if there.any():
            theirs.update(z[there].reshape(-1, 1), R=v.kf.R[np.ix_(there, there)], H=theirs.H[there])
        np.testing.assert_allclose(v.xs[k], theirs.x, rtol=1e-9, atol=1e-12)  # rounding
    filtered, smoothed = (np.std(x[10:, 0, 0] - v.position[10:]) for x in (v.xs, v.smoothed))
    assert smoothed < 0.7 * filtered < 0.5 * np.nanstd(v.z[:, 0] - v.position)


@of(3)
def test_limits_are_kept(recipe):
    assert "not below zero:  [0. 0.]\nand a sum of 1:  [0.32 0.68]" in recipe.printed


@of(4)
def test_a_masked_end_of_the_range_does_no_harm(recipe):
    assert recipe.errors["masked"] < 0.1 < 0.2 < recipe.errors["as measured"]


@of(5)
def test_the_noises_are_found(recipe):
    fit = recipe.fit
    assert abs(fit.state_noise[0] - 0.04) < 2 * 0.0096
    assert abs(fit.measurement_noise[0] - 1) < 2 * 0.047


@of(6)
def test_the_wrong_noise_is_noticed(recipe):
    assert "follows too slowly" in str(recipe.results[0.0004])
    assert "too" not in str(recipe.results[0.04])


@of(7)
def test_ten_thousand_steps_find_the_weights(recipe):
    assert np.abs(recipe.xs[-1].ravel() - recipe.weights).max() < 0.01
    assert len(recipe.xs) == 10_000


@of(8)
def test_a_saved_filter_goes_on(recipe):
    assert np.array_equal(recipe.kf.x, recipe.resumed.x)
    assert np.array_equal(recipe.kf.P, recipe.resumed.P)


@of(9)
def test_the_bank_notices_the_manoeuvre(recipe):
    assert recipe.agile[50 : recipe.n // 2].mean() < 0.1 < 0.9 < recipe.agile[recipe.n // 2 :].mean()


@of(10)
def test_a_filter_that_refuses_goes_on(recipe):
    assert recipe.printed.count("z must") == 3
    assert "and on it goes: [0.5 0. ]" in recipe.printed
