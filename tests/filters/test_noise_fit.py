"""Noises by maximum likelihood: the joint density of the record, closed forms, known truths."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.common import Q_discrete_white_noise
from filterpy.kalman import KalmanFilter
from numpy.testing import assert_allclose
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from kfopc_filterpy import KFOPC
from kfopc_filterpy.filters import fit_noise


def local_level(kind=KalmanFilter):
    """A random level, measured with noise."""
    kf = kind(dim_x=1, dim_z=1)
    kf.H, kf.P = np.eye(1), 100.0 * np.eye(1)
    return kf


def constant_velocity(kind=KalmanFilter, rows=1):
    """A position, and with two rows the velocity too, of a target that is pushed at random."""
    kf = kind(dim_x=2, dim_z=rows)
    kf.F, kf.H = np.array([[1.0, 0.5], [0.0, 1.0]]), np.eye(2)[:rows]
    kf.Q, kf.P = Q_discrete_white_noise(2, dt=0.5, var=1.0), np.diag([50.0, 10.0])
    kf.R = np.array([[1.0, 0.4], [0.4, 2.0]])[:rows, :rows]
    return kf


def drawn(kf, q, r, n_samples, seed, missing=0.0, H=None):
    """A record of the filter's own model with Q and R multiplied by q and r; some of it is masked."""
    rng, n, rows = np.random.default_rng(seed), kf.dim_x, kf.dim_z
    state, z = np.zeros(n), np.zeros((n_samples, rows))
    for k in range(n_samples):
        row = kf.H if H is None else H[k]
        state = kf.F @ state + rng.multivariate_normal(np.zeros(n), q * kf.Q)
        z[k] = row @ state + rng.multivariate_normal(np.zeros(rows), r * kf.R)
    return np.ma.array(z, mask=rng.random(z.shape) < missing)


def log_density(kf, z, Q, R, H=None):
    """Log-density of all that was measured, from the joint covariance of the states: no filter in it."""
    n, N = kf.dim_x, len(z)
    rows = np.broadcast_to(kf.H, (N, *kf.H.shape)) if H is None else H
    powers = [np.linalg.matrix_power(kf.F, k) for k in range(N + 1)]
    marginal, at = [], kf.P
    for _ in range(N):
        at = kf.F @ at @ kf.F.T + Q
        marginal.append(at)
    joint = np.zeros((N, n, N, n))
    for k in range(N):
        for later in range(k, N):
            joint[later, :, k] = powers[later - k] @ marginal[k]
            joint[k, :, later] = joint[later, :, k].T
    mean = np.concatenate([rows[k] @ powers[k + 1] @ kf.x.ravel() for k in range(N)])
    observe = np.zeros((N, kf.dim_z, N, n))
    observe[range(N), :, range(N)] = rows
    observe = observe.reshape(N * kf.dim_z, N * n)
    covariance = observe @ joint.reshape(N * n, N * n) @ observe.T + np.kron(np.eye(N), R)
    there = ~np.ma.getmaskarray(z).ravel()
    return multivariate_normal(mean[there], covariance[np.ix_(there, there)]).logpdf(z.data.ravel()[there])


CASES = {
    "local level": (local_level, 0.5, 4.0, 60, 0.0),
    "local level with gaps": (local_level, 0.5, 4.0, 80, 0.3),
    "constant velocity": (constant_velocity, 0.3, 2.0, 60, 0.0),
    "two rows with gaps": (lambda: constant_velocity(rows=2), 0.3, 2.0, 50, 0.3),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_the_noises_are_at_the_peak_of_the_joint_density(case):
    """Tolerances: log-density 1e-9 of rounding; Nelder and Mead stop within 1e-8 of log-variances, but a density that is
    flat to rounding leaves them known to 1e-5 or so. Standard errors from differences of 1e-2 of the joint density are
    good to 1e-4."""
    make, q, r, n_samples, missing = case
    kf = make()
    z = drawn(kf, q, r, n_samples, seed=4, missing=missing)
    fit = fit_noise(kf, z)
    assert_allclose(fit.log_likelihood, log_density(kf, z, fit.Q, fit.R), rtol=1e-9)

    def negative(logs):
        return -log_density(kf, z, np.exp(logs[0]) * kf.Q, np.exp(logs[1]) * kf.R)

    start = np.log([q, r])
    found = minimize(negative, start, method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-12, "maxiter": 500})
    assert_allclose([fit.state_noise[0], fit.measurement_noise[0]], np.exp(found.x), rtol=1e-4)
    h, information = 1e-2 * np.eye(2), np.zeros((2, 2))
    for i in range(2):
        for j in range(2):
            corners = [negative(found.x + a * h[i] + b * h[j]) for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
            information[i, j] = (corners[0] - corners[1] - corners[2] + corners[3]) / (4 * 1e-4)
    errors = np.sqrt(np.diag(np.linalg.inv(information))) * np.exp(found.x)
    assert_allclose([fit.state_noise_errors[0], fit.measurement_noise_errors[0]], errors, rtol=1e-3)


def test_a_random_walk_without_measurement_noise_has_the_closed_form():
    """The steps are then measured themselves: q is their mean square, with the standard error q sqrt(2/N)."""
    kf = local_level()
    kf.P, kf.R = np.zeros((1, 1)), np.zeros((1, 1))
    z = np.cumsum(1.7 * np.random.default_rng(0).standard_normal(400))
    fit = fit_noise(kf, z, R_parts=[])
    q = np.mean(np.diff(z, prepend=0.0) ** 2)
    assert_allclose(fit.state_noise[0], q, rtol=1e-6)
    assert_allclose(fit.state_noise_errors[0], q * np.sqrt(2 / 400), rtol=1e-5)
    assert fit.measurement_noise.size == 0
    assert np.array_equal(fit.R, [[0.0]])


def test_parts_are_told_apart_and_found_within_their_errors():
    """Two levels of their own, with sensors of their own noises: four standard errors of each, and shown as text."""
    kf = KFOPC(dim_x=2, dim_z=2)
    kf.H, kf.P = np.array([[1.0, 0.0], [1.0, 1.0]]), 10 * np.eye(2)
    kf.Q, kf.R = np.diag([0.2, 1.5]), np.diag([3.0, 0.5])
    z = drawn(kf, 1.0, 1.0, 1500, seed=3, missing=0.1)
    unit = [np.diag([1.0, 0.0]), np.diag([0.0, 1.0])]
    fit = fit_noise(kf, z, Q_parts=unit, R_parts=unit)
    for values, errors, true in (
        (fit.state_noise, fit.state_noise_errors, [0.2, 1.5]),
        (fit.measurement_noise, fit.measurement_noise_errors, [3.0, 0.5]),
    ):
        assert np.all(np.abs(values - true) < 4 * errors)
        assert np.all(errors < 0.5 * np.array(true))
    assert_allclose(fit.Q, np.diag(fit.state_noise))
    assert_allclose(fit.R, np.diag(fit.measurement_noise))
    assert str(fit).splitlines()[3].startswith("measurement_noise[1] = 0.")
    assert repr(fit).startswith("<NoiseFit: state_noise[0] = 0.")


def test_an_observation_that_changes_with_time_is_used():
    kf = constant_velocity()
    H = np.random.default_rng(1).standard_normal((60, 1, 2))
    z = drawn(kf, 0.5, 1.0, 60, seed=2, missing=0.2, H=H)
    fit = fit_noise(kf, z, H=H)
    assert_allclose(fit.log_likelihood, log_density(kf, z, fit.Q, fit.R, H), rtol=1e-9)
    assert abs(fit_noise(kf, z).log_likelihood - fit.log_likelihood) > 1


def test_a_noise_that_the_record_does_not_show_is_zero():
    fit = fit_noise(local_level(), 2.0 * np.random.default_rng(0).standard_normal(500))
    assert fit.state_noise[0] == 0
    assert np.isnan(fit.state_noise_errors[0])
    assert abs(fit.measurement_noise[0] - 4.0) < 4 * fit.measurement_noise_errors[0]
    assert_allclose(
        fit.measurement_noise_errors[0], fit.measurement_noise[0] * np.sqrt(2 / 500), rtol=0.01
    )  # of a white noise


def test_a_list_with_none_is_a_masked_record_and_the_filter_is_not_changed():
    kf = local_level(KFOPC)
    z = drawn(kf, 0.5, 1.0, 80, seed=6, missing=0.3)[:, 0]
    before = {name: np.copy(getattr(kf, name)) for name in ("x", "P", "Q", "R")}
    expected = fit_noise(kf, z)
    as_list = [None if hidden else value for value, hidden in zip(z.data, z.mask, strict=True)]
    for record in (as_list, z[:, None], np.ma.array(z)[:, None, None], list(z[:, None])):
        assert fit_noise(kf, record).log_likelihood == expected.log_likelihood
    assert all(np.array_equal(value, getattr(kf, name)) for name, value in before.items())


RECORD = np.random.default_rng(0).standard_normal(40)


@pytest.mark.parametrize(
    ("z", "arguments", "message"),
    [
        (np.array([1.0, np.nan, 2.0, 3.0]), {}, r"z must be finite.*np.ma.masked_invalid\(z\)"),
        (np.ones((10, 2)), {}, r"z must be a record \(n_samples, 1\), for the 1 row"),
        ([1.0, [1.0, 2.0]], {}, r"z must hold None or 1 value\(s\) for each sample"),
        (RECORD[:2], {}, "z must hold more than 2 measurements for 2 noises, got 2"),
        (RECORD, {"Q_parts": [], "R_parts": []}, "nothing to learn"),
        (RECORD, {"Q_parts": [np.eye(2)]}, r"Q_parts\[0\] must have shape \(1, 1\), got \(2, 2\)"),
        (RECORD, {"R_parts": [[[-1.0]]]}, r"R_parts\[0\] must be positive semidefinite"),
        (RECORD, {"Q_parts": [np.zeros((1, 1))]}, r"Q_parts\[0\] must not be zero"),
        (RECORD, {"H": np.zeros((1, 1))}, "H must not be zero"),
        (RECORD, {"R_parts": [[[1.0]], [[2.0]]]}, "R_parts must not be sums of multiples"),
        (RECORD, {"H": np.ones((39, 1, 1))}, "one matrix for each of the 40 samples of z, got 39"),
        (RECORD, {"H": np.ones((1, 3))}, r"F must be \(1, 1\) and H \(dim_z, 1\)"),
        (np.zeros(40), {}, "the likelihood has no peak"),
    ],
)
def test_a_record_or_a_model_that_cannot_be_used_is_refused(z, arguments, message):
    with pytest.raises(ValueError, match=message):
        fit_noise(local_level(), z, **arguments)


def test_a_noise_that_does_not_reach_the_measurement_is_not_said_to_be_zero():
    kf = constant_velocity()
    kf.F = np.eye(2)  # the velocity moves nothing
    with pytest.raises(ValueError, match=r"the record does not determine state_noise\[1\]: the likelihood is the same"):
        fit_noise(kf, np.cumsum(RECORD), Q_parts=[np.diag([1.0, 0.0]), np.diag([0.0, 1.0])])


def test_noises_that_only_their_sum_reaches_are_not_told_apart():
    kf = constant_velocity(rows=2)
    kf.F, kf.H = np.eye(2), np.array([[1.0, 1.0], [2.0, 2.0]])
    z = np.cumsum(RECORD)[:, None] * [1, 2] + RECORD[::-1, None] * [1, -1]
    with pytest.raises(ValueError, match=r"does not determine state_noise\[0\] and state_noise\[1\]"):
        fit_noise(kf, z, Q_parts=[np.diag([1.0, 0.0]), np.diag([0.0, 1.0])])


def test_a_fading_memory_is_refused():
    kf = local_level()
    kf.alpha = 1.02
    with pytest.raises(ValueError, match=r"kf.alpha must be 1, got 1.02"):
        fit_noise(kf, RECORD)
