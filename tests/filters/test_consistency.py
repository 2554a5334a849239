"""NIS, NEES and the correlation of innovations: closed forms, and filters that are right or wrong, many times."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from filterpy.common import Saver
from filterpy.kalman import KalmanFilter
from numpy.testing import assert_allclose
from scipy.stats import binom, chi2

from kfopc_filterpy import KFOPC
from kfopc_filterpy.filters import consistency

# filterpy 1.4.5's `mahalanobis`, which a Saver asks for.
pytestmark = pytest.mark.filterwarnings("ignore:Conversion of an array with ndim > 0:DeprecationWarning")

F = np.array([[1.0, 0.5], [0.0, 1.0]])
H = np.array([[1.0, 0.0], [1.0, 1.0]])
Q, R = np.array([[0.02, 0.04], [0.04, 0.16]]), np.array([[1.0, 0.3], [0.3, 0.5]])


def tracked(rng, n_samples, *, factor=1.0, missing=0.0, kind=KalmanFilter):
    """A Saver of a filter whose Q is wrong by a factor, and the true states: the model itself draws them."""
    kf = kind(dim_x=2, dim_z=2)
    kf.F, kf.H, kf.Q, kf.R, kf.P = F, H, factor * Q, R, np.diag([2.0, 1.0])
    state, truth, saver = np.sqrt([2.0, 1.0]) * rng.standard_normal(2), [], Saver(kf)
    moved, noise = np.linalg.cholesky(Q), np.linalg.cholesky(R)
    for _ in range(n_samples):
        state = F @ state + moved @ rng.standard_normal(2)
        z = H @ state + noise @ rng.standard_normal(2)
        kf.predict()
        kf.update(None if rng.random() < missing else z)
        saver.save()
        truth.append(state)
    return saver, np.array(truth)


def test_each_value_is_what_its_formula_says():
    saver, truth = tracked(np.random.default_rng(0), 40)
    result = consistency(saver, truth=truth, max_lag=3, coverage=0.9)
    y, S, x, P = (np.array(getattr(saver, name)) for name in ("y", "S", "x", "P"))
    for k in (0, 17, 39):
        assert_allclose(result.nis[k], y[k, :, 0] @ np.linalg.inv(S[k]) @ y[k, :, 0], rtol=1e-12)
        error = x[k, :, 0] - truth[k]
        assert_allclose(result.nees[k], error @ np.linalg.inv(P[k]) @ error, rtol=1e-10)
    assert_allclose(result.nis_bounds[:, 5], chi2.ppf([0.05, 0.95], 2))
    assert_allclose(result.nees_bounds, chi2.ppf([0.05, 0.95], 2))
    assert_allclose(result.nis_mean, result.nis.mean() / 2)
    assert_allclose(result.nis_mean_bounds, chi2.ppf([0.05, 0.95], 80) / 80)
    assert_allclose(result.nees_mean, result.nees.mean() / 2)
    white = np.linalg.solve(np.linalg.cholesky(S), y)[:, :, 0]
    early, late = white[:-2], white[2:]
    expected = np.sum(early * late) / np.sqrt(np.sum(early**2) * np.sum(late**2))
    assert_allclose(result.autocorrelation[1], expected, rtol=1e-12)
    assert_allclose(result.autocorrelation_bounds, 1.6448536269514722 / np.sqrt(2 * np.array([39, 38, 37])))


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_a_right_filter_is_within_its_bounds_as_often_as_they_say(missing):
    """Monte Carlo: 200 runs, 90 % bounds. The counts are binomial, so they must lie where all but 1e-6 of them do."""
    rng, n_runs = np.random.default_rng(1), 200
    inside = np.zeros((4, n_runs), bool)
    for run in range(n_runs):
        saver, truth = tracked(rng, 30, missing=missing)
        result = consistency(saver, truth=truth, coverage=0.9, max_lag=2)
        low, high = result.nis_mean_bounds
        late = np.flatnonzero(np.isfinite(result.nis))[-1]
        inside[:, run] = (
            low <= result.nis_mean <= high,
            result.nis_bounds[0, late] <= result.nis[late] <= result.nis_bounds[1, late],
            result.nees_bounds[0] <= result.nees[-1] <= result.nees_bounds[1],
            abs(result.autocorrelation[0]) <= result.autocorrelation_bounds[0],
        )
    least, most = binom.ppf([5e-7, 1 - 5e-7], n_runs, 0.9)
    counts = inside.sum(axis=1)
    assert np.all((least <= counts) & (counts <= most)), counts


def test_several_runs_tell_at_each_sample_and_a_wrong_filter_is_outside():
    savers, truths = zip(*(tracked(np.random.default_rng(seed), 50) for seed in range(40)), strict=True)
    right = consistency(list(savers), truth=np.array(truths))
    assert_allclose(right.nees_bounds, chi2.ppf([0.025, 0.975], 80) / 40)
    assert_allclose(right.nis_bounds[:, 3], chi2.ppf([0.025, 0.975], 80) / 40)
    one = consistency(savers[0], truth=truths[0])
    rest = consistency(list(savers[1:]), truth=np.array(truths[1:]))
    assert_allclose(right.nees, (one.nees + 39 * rest.nees) / 40, rtol=1e-12)
    assert_allclose(right.nis, (one.nis + 39 * rest.nis) / 40, rtol=1e-12)
    inside = np.mean((right.nees_bounds[0] <= right.nees) & (right.nees <= right.nees_bounds[1]))
    assert inside > 0.85
    savers, truths = zip(*(tracked(np.random.default_rng(s), 50, factor=0.1) for s in range(40)), strict=True)
    wrong = consistency(list(savers), truth=np.array(truths))
    assert np.all(wrong.nees[10:] > wrong.nees_bounds[1])


@pytest.mark.parametrize(
    ("factor", "says"),
    [
        (0.01, ("S is too small", "follows too slowly, Q is too small relative to R")),
        (100.0, ("S is too large", "follows too fast, Q is too large relative to R")),
    ],
)
def test_a_wrong_q_is_named(factor, says):
    saver, truth = tracked(np.random.default_rng(5), 400, factor=factor)
    text = str(consistency(saver, truth=truth))
    assert all(part in text for part in says)
    saver, truth = tracked(np.random.default_rng(5), 400)
    right = consistency(saver, truth=truth)
    assert "too" not in str(right)
    assert repr(right).startswith("<Consistency: NIS")


def test_samples_that_were_missed_do_not_count():
    saver, _ = tracked(np.random.default_rng(2), 80, missing=0.4, kind=KFOPC)
    result = consistency(saver, max_lag=4)
    missed = np.array([z[0, 0] is None for z in saver.z])
    assert 10 < missed.sum() < 60
    assert np.array_equal(np.isnan(result.nis), missed)
    assert np.isnan(result.nis_bounds[:, missed]).all()
    there = 80 - missed.sum()
    assert_allclose(result.nis_mean_bounds, chi2.ppf([0.025, 0.975], 2 * there) / (2 * there))
    pairs = np.sum(~missed[3:] & ~missed[:-3])
    assert_allclose(result.autocorrelation_bounds[2], 1.959963984540054 / np.sqrt(2 * pairs))
    saver.to_array()
    assert_allclose(consistency(saver, max_lag=4).nis, result.nis)
    assert result.nees is None


def test_a_saver_of_a_filter_that_took_some_components_counts_those():
    kf = KFOPC(dim_x=2, dim_z=2)
    kf.F, kf.H, kf.Q, kf.R = F, H, Q, R
    saver = Saver(kf)
    for hidden in ([0, 0], [1, 0], [1, 1], [0, 1]):
        kf.predict()
        kf.update(np.ma.array([1.0, 2.0], mask=hidden))
        saver.save()
    result = consistency(saver, max_lag=1)
    assert_allclose(result.nis[1], saver.y[1][1, 0] ** 2 / saver.S[1][1, 1])
    assert_allclose(result.nis_bounds[1], chi2.ppf(0.975, [2, 1, np.nan, 1]))
    assert_allclose(result.autocorrelation_bounds, 1.959963984540054)  # one pair: the second component at first


SAVER, TRUTH = tracked(np.random.default_rng(0), 30)


def saved(**other: Any) -> SimpleNamespace:
    return SimpleNamespace(**dict.fromkeys(("z", "y", "S", "x", "P"), np.ones((30, 1, 1))) | other)


@pytest.mark.parametrize(
    ("saver", "arguments", "error", "message"),
    [
        (3, {}, TypeError, "saver must be a filterpy.common.Saver that has saved"),
        ([tracked(np.random.default_rng(0), n)[0] for n in (4, 5)], {}, ValueError, "equally many samples"),
        (saved(S=np.zeros((30, 1, 1))), {}, ValueError, "S must hold positive definite matrices"),
        (saved(z=np.full((30, 1, 1), np.nan)), {}, ValueError, "every sample was missed"),
        (SAVER, {"coverage": 1.0}, ValueError, "coverage must be above 0 and below 1, got 1"),
        (SAVER, {"max_lag": 30}, ValueError, "more than max_lag = 30 samples, got 30; lower max_lag"),
        (SAVER, {"truth": TRUTH[:, 0]}, ValueError, r"truth must be \(1, 30, 2\)"),
        (SAVER, {"truth": np.nan * TRUTH}, ValueError, "truth must be finite"),
    ],
)
def test_what_cannot_be_tested_is_refused(saver, arguments, error, message):
    with pytest.raises(error, match=message):
        consistency(saver, **arguments)
