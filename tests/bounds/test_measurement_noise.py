"""Estimates of q = E[e_o^2] (eq. 7) against the variance put in, and against an independent least-squares fit."""

import numpy as np
import pytest
import scipy.signal
from helpers.channels import delayed

from kfopc_filterpy import Plant
from kfopc_filterpy.bounds import measurement_noise_from_run
from kfopc_filterpy.bounds.wiener import wiener_solution
from kfopc_filterpy.paths import duct_plant
from kfopc_filterpy.signals import band_limited_noise

S = np.array([0.0, 0.9, -0.4, 0.2])
PLANT = Plant(S, fs=16000)


def recording(n, n_taps, q, seed):
    """Return a reference, and d = w' x' + e_o of eq. 1b with white e_o of variance q."""
    rng = np.random.default_rng(seed)
    x = scipy.signal.lfilter([1.0, 0.3], [1.0, -0.7], rng.standard_normal(n))
    w = rng.standard_normal(n_taps)
    return x, np.convolve(np.convolve(x, S), w)[:n] + np.sqrt(q) * rng.standard_normal(n)


def test_has_no_bias_from_the_weights_fitted():
    """64 weights on 300 samples take a fifth of the residual: 40 estimates average to q within 4 sigma."""
    estimates = []
    for seed in range(40):
        x, d = recording(300, 64, 0.5, seed)
        estimates.append(measurement_noise_from_run(x, PLANT, n_taps=64, disturbance=d))
    freedom = 300 - 66 - 64
    assert np.mean(estimates) == pytest.approx(0.5, rel=4 * np.sqrt(2 / freedom / 40))
    assert 4 * np.sqrt(2 / freedom / 40) < 64 / 300 / 2  # an uncorrected mean square would be far outside


@pytest.mark.parametrize("n_taps", [1, 5, 33])
def test_is_the_residual_of_least_squares(n_taps):
    x, d = recording(900, 5, 0.04, 1)
    start = n_taps + S.size - 2  # delay lines full
    rows = delayed(np.convolve(x, S)[None, :900], n_taps)[:, start:].T
    _, (squares,), rank, _ = np.linalg.lstsq(rows, d[start:], rcond=None)
    assert rank == n_taps
    expected = squares / (len(rows) - n_taps)
    assert measurement_noise_from_run(x, PLANT, n_taps=n_taps, disturbance=d) == pytest.approx(expected, rel=1e-9)


def test_what_the_filter_cannot_explain_counts():
    """A disturbance from another source is all measurement error; one too early for the secondary path is nearly so."""
    x, other = np.random.default_rng(2).standard_normal((2, 20_000))
    from_elsewhere = measurement_noise_from_run(x, PLANT, n_taps=16, disturbance=other)
    assert from_elsewhere == pytest.approx(np.var(other), rel=0.01)
    too_early = measurement_noise_from_run(x, Plant([0.0, 0.0, 1.0], [1.0], fs=16000), n_taps=16)
    assert too_early == pytest.approx(np.var(x), rel=0.01)
    assert measurement_noise_from_run(x, Plant([1.0], [1.0], fs=16000), n_taps=16) < 1e-25


def test_each_weight_takes_a_degree_of_freedom_of_the_residual():
    x, d = recording(900, 5, 0.04, 1)
    start = 5 + S.size - 2
    weights = wiener_solution(x, PLANT, n_taps=5, disturbance=d).weights
    residual = (d - np.convolve(np.convolve(x, S), weights)[:900])[start:]
    found = measurement_noise_from_run(x, PLANT, n_taps=5, disturbance=d)
    assert found == pytest.approx(np.sum(residual**2) / (residual.size - 5), rel=1e-14)


X, D = recording(200, 4, 0.1, 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((X, PLANT, D[:-1]), r"disturbance must be .* = \(1, 200\), got \(1, 199\)"),
        ((np.where(X > 2, np.nan, X), PLANT, D), "reference must be finite"),
        ((X[:13], PLANT, D[:13]), r"at least 14 samples for 4 taps and a\s+secondary path of 4, got 13"),
        ((0 * X, PLANT, D), "reference through the secondary path must not be silent"),
        ((X, Plant(0 * S, fs=16000), D), "reference through the secondary path must not be silent"),
        ((X, PLANT, None), "make the plant with a primary path, or give disturbance="),
    ],
)
def test_from_run_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        measurement_noise_from_run(*arguments[:2], n_taps=4, disturbance=arguments[2])


def test_says_when_it_cannot_tell():
    """A narrow-band reference: weights that the correlations do not resolve would explain most of the residual."""
    fs = 16000.0
    x = band_limited_noise((300.0, 400.0), 0.75, fs=fs, rng=0)
    plant = duct_plant(fs=fs)
    x, d = x[3000:], plant.disturbance(x)[3000:]
    with pytest.warns(np.exceptions.RankWarning, match="q cannot be told from this run") as caught:
        too_high = measurement_noise_from_run(x, plant, n_taps=64, disturbance=d)
    assert caught[0].filename == __file__
    assert too_high > 1e-4 * np.mean(d**2)  # although nothing but the length of the filter limits it
    # With much sensor noise the same fit tells q; warnings are errors in these tests.
    q = np.mean(d**2)
    noisy = d + np.sqrt(q) * np.random.default_rng(0).standard_normal(d.size)
    assert measurement_noise_from_run(x, plant, n_taps=64, disturbance=noisy) == pytest.approx(q, rel=0.1)
