"""Wiener filters against numpy.linalg.lstsq on the same data, closed forms and perturbed neighbours."""

import re

import numpy as np
import pytest
import scipy.signal
from helpers.channels import delayed, random_paths, through

from kfopc_filterpy import Plant
from kfopc_filterpy._taps import path_taps
from kfopc_filterpy.bounds import coherence_bound, wiener_solution
from kfopc_filterpy.bounds.power_constrained import power_constrained_solution, power_constrained_wiener
from kfopc_filterpy.paths import duct_plant
from kfopc_filterpy.paths.least_squares import correlation_matrix
from kfopc_filterpy.paths.models import bandpass_path
from kfopc_filterpy.signals import band_limited_noise

FS = 16000.0


def _scene(n=3000, seed=0):
    rng = np.random.default_rng(seed)
    x = scipy.signal.lfilter([1.0], [1.0, -0.7], rng.standard_normal(n))
    d = scipy.signal.lfilter([0, 0, 0, 1.0, 0.5, -0.3], 1.0, x) + 0.1 * rng.standard_normal(n)
    return x, d, np.array([0.0, 0.8, 0.3, -0.1])


@pytest.mark.parametrize(
    ("n_taps", "ridge", "penalty"), [(1, 0.0, 0.0), (16, 0.0, 0.0), (7, 0.01, 0.0), (7, 0.0, 0.5), (2, 0.02, 0.3)]
)
def test_weights_are_those_of_dense_least_squares(n_taps, ridge, penalty):
    x, d, s = _scene()
    start = n_taps + s.size - 2
    filtered = scipy.signal.lfilter(s, 1.0, x)
    rows, control_rows = (delayed(signal[None], n_taps)[:, start:].T for signal in (filtered, x))
    scale = np.sqrt(ridge * np.sum(filtered[start:] ** 2))
    matrix = np.vstack([rows, np.sqrt(penalty) * control_rows, scale * np.eye(n_taps)])
    right = np.concatenate([d[start:], np.zeros(len(control_rows) + n_taps)])
    expected = np.linalg.lstsq(matrix, right, rcond=None)[0]
    found = wiener_solution(
        x, Plant(s, fs=FS), n_taps=n_taps, disturbance=d, regularization=ridge, control_penalty=penalty
    )
    # Normal equations of condition number below 1e4 lose 4 digits of 16.
    np.testing.assert_allclose(found.weights, expected, rtol=1e-9, atol=1e-10)
    y = scipy.signal.lfilter(expected, 1.0, x)
    antinoise = scipy.signal.lfilter(s, 1.0, y)
    assert found.control_power == pytest.approx(np.mean(y[start:] ** 2), rel=1e-9)
    assert found.antinoise_power == pytest.approx(np.mean(antinoise[start:] ** 2), rel=1e-9)
    assert found.disturbance_power == pytest.approx(np.mean(d[start:] ** 2), rel=1e-12)
    residual = np.mean((d - antinoise)[start:] ** 2)
    assert found.noise_reduction_db == pytest.approx(-10 * np.log10(residual / found.disturbance_power))


def test_tone_has_the_minimum_norm_solution():
    n = np.arange(8000)
    x = np.sin(2 * np.pi * 400 * n / FS)
    d = 0.7 * np.sin(2 * np.pi * 400 * n / FS + 1.0)
    s = path_taps(bandpass_path(32, fs=FS))
    found = wiener_solution(x, Plant(s, fs=FS), n_taps=64, disturbance=d)
    start = 64 + 32 - 2
    steady_s = np.exp(-2j * np.pi * 400 / FS * np.arange(32)) @ s
    # s*x without start-up, so that the oracle's matrix has rank two exactly as well.
    filtered = np.imag(steady_s * np.exp(2j * np.pi * 400 * n / FS))
    expected = np.linalg.lstsq(delayed(filtered[None], 64)[:, start:].T, d[start:], rcond=1e-6)[0]
    # The first rows of x' still hold start-up of up to 1e-3 in the filter's first 63 samples.
    np.testing.assert_allclose(found.weights, expected, atol=2e-3)
    assert np.linalg.norm(found.weights) < 1.05 * np.linalg.norm(expected)
    assert found.noise_reduction_db > 40
    assert found.control_power == pytest.approx(0.7**2 / 2 / np.abs(steady_s) ** 2, rel=1e-3)


def test_coherence_bound_is_the_incoherent_share():
    rng = np.random.default_rng(0)
    x = rng.standard_normal(200_000)
    d = scipy.signal.lfilter([0, 1.0, 0.5], 1.0, x)
    noise = 0.2 * np.sqrt(np.mean(d**2)) * rng.standard_normal(x.size)
    bound = coherence_bound(x, d + noise, FS, segment=512)
    # 0.04 of the power is incoherent: 14.1 dB; 780 half-overlapping segments leave 0.1 dB.
    assert bound.overall_db == pytest.approx(10 * np.log10(1.04 / 0.04), abs=0.15)
    assert bound.frequencies_hz.shape == bound.noise_reduction_db.shape == (257,)
    best = wiener_solution(x, Plant([1.0], fs=FS), n_taps=8, disturbance=d + noise)
    assert best.noise_reduction_db <= bound.overall_db + 0.15


def test_the_coherence_of_several_references_is_what_all_of_them_explain():
    """Bias: each of two references explains one part in some 780 segments by chance, 0.1 dB."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((2, 200_000))
    d = through(random_paths(3, 2, 6, seed=1), x)
    noise = 0.2 * np.sqrt(np.mean(d**2, axis=1, keepdims=True)) * rng.standard_normal(d.shape)
    bound = coherence_bound(x, d + noise, FS, segment=512)
    assert bound.overall_db == pytest.approx(10 * np.log10(1.04 / 0.04), abs=0.3)
    assert coherence_bound(x[:1], d + noise, FS, segment=512).overall_db < 10.0


X, D, S = _scene()
PLANT = Plant(S, fs=FS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reference": X[:9], "disturbance": D[:9]}, "reference must have at least 10 samples"),
        ({"reference": 0 * X}, "reference through the secondary path must not be silent"),
        ({"disturbance": 0 * D}, "disturbance must not be silent"),
        ({"regularization": -1}, "regularization must not be negative"),
        ({"plant": PLANT.changed_at(0.1, secondary=[1.0])}, "wiener_solution needs a plant that does not change"),
    ],
)
def test_wiener_refuses(change, message):
    with pytest.raises(ValueError, match=message):
        wiener_solution(**{"reference": X, "plant": PLANT, "disturbance": D, "n_taps": 4} | change)


def test_coherence_refuses():
    for x, segment, message in ((X, 1024, "reference must have at least 8192"), (0 * X, 64, "must not be silent")):
        with pytest.raises(ValueError, match=message):
            coherence_bound(x, D, FS, segment=segment)


# ---- Directions that float64 correlations do not resolve


def narrow(n=12_000, seed=0):
    """Noise of 300 to 400 Hz through two paths, and what full least squares makes of it."""
    x = band_limited_noise((300.0, 400.0), n / FS, fs=FS, rng=seed)
    plant = duct_plant(fs=FS)
    return x[3000:], plant.disturbance(x)[3000:], plant


def dense_reduction_db(x, d, plant, n_taps):
    s = plant.secondary[0, 0]
    start = n_taps + s.size - 2
    rows = delayed(np.convolve(x, s)[None, : x.size], n_taps)[:, start:].T
    weights = np.linalg.lstsq(rows, d[start:], rcond=None)[0]
    error = d[start:] - rows @ weights
    return -10 * np.log10(np.mean(error**2) / np.mean(d[start:] ** 2)), np.abs(weights).max()


def test_a_narrow_band_reference_warns_that_larger_weights_do_better():
    x, d, plant = narrow()
    reached, largest = dense_reduction_db(x, d, plant, 64)
    with pytest.warns(np.exceptions.RankWarning, match="too narrow-band for this many taps") as caught:
        found = wiener_solution(x, plant, n_taps=64, disturbance=d)
    assert caught[0].filename == __file__
    assert reached > found.noise_reduction_db + 5
    assert largest > 1e4 * np.abs(found.weights).max()
    told = float(re.search(r"lower the error by (\d+\.\d) dB", str(caught[0].message))[1])
    # The warning compares evenly spaced samples, and leaves out the smallest directions by its own measure.
    assert told == pytest.approx(reached - found.noise_reduction_db, abs=6)


def test_the_bounds_within_a_power_warn_too():
    x, d, plant = narrow()
    with pytest.warns(np.exceptions.RankWarning, match="no bound"):
        free = wiener_solution(x, plant, n_taps=64, disturbance=d).control_power
    for bound, options in ((power_constrained_solution, {}), (power_constrained_wiener, {"switch_on_s": 0.1})):
        with pytest.warns(np.exceptions.RankWarning, match="no bound"):
            bound(x, plant, n_taps=64, rated_power=2 * free, disturbance=d, **options)


def test_what_the_cut_does_not_change_does_not_warn():
    """Warnings are errors in these tests."""
    x, d, plant = narrow()
    wiener_solution(x, plant, n_taps=64, disturbance=d, regularization=1e-6)  # nothing is cut
    noise = np.sqrt(np.mean(d**2)) * np.random.default_rng(1).standard_normal(d.size)
    # The reference explains half the disturbance; the cut changes little.
    wiener_solution(x, plant, n_taps=64, disturbance=d + noise)
    n = np.arange(8000)  # a tone: two directions are all there are
    wiener_solution(np.sin(0.2 * n), Plant([0.5, 0.2], fs=FS), n_taps=32, disturbance=np.sin(0.2 * n + 1))


def test_the_tolerance_keeps_directions_of_a_billionth_of_the_energy():
    """A tone and noise 90 dB below its eigenvalues: all directions are resolved, and needed for an exact fit."""
    n = np.arange(8000)
    x = np.sqrt(2) * np.sin(0.3 * n) + 1e-4 * np.random.default_rng(2).standard_normal(n.size)
    d = np.convolve(x, [0.0, 0.5, -0.8, 0.3])[: x.size]
    shares = np.linalg.eigvalsh(correlation_matrix(x, 32))
    assert 1e-10 < shares[0] / shares[-1] < 1e-8
    assert wiener_solution(x[8:], Plant([1.0], fs=FS), n_taps=32, disturbance=d[8:]).noise_reduction_db > 150
