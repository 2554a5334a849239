"""Identification: exact recovery, lstsq as the oracle, what noise and clipping do to it."""

import math
import tracemalloc

import numpy as np
import pytest
import scipy.signal
from helpers.channels import delayed
from scipy.signal import fftconvolve, lfilter

from kfopc_filterpy import HardClipAmplifier, Plant
from kfopc_filterpy._taps import path_matrix
from kfopc_filterpy.paths.identification import estimate_path, identify_secondary_path, misalignment_db
from kfopc_filterpy.paths.models import bandpass_path
from kfopc_filterpy.paths.uncertainty import path_uncertainty

FS = 16000.0
PATH = bandpass_path(32, fs=FS)
PLANT = Plant(PATH)


@pytest.mark.parametrize(("n_loudspeakers", "n_samples"), [(1, 7000), (2, 12000)])
def test_more_taps_than_a_matrix_is_made_for_are_found_by_iteration(n_loudspeakers, n_samples):
    """The gradient of least squares vanishes: an iteration that ends at 1e-9 leaves 1e-7 of it."""
    rng, n_taps, ridge = np.random.default_rng(0), 2100, 1e-5
    x = lfilter([1.0, 0.8], 1.0, rng.standard_normal((n_loudspeakers, n_samples)))
    paths = rng.standard_normal((n_loudspeakers, n_taps)) * np.exp(-np.arange(n_taps) / 300)
    y = sum(fftconvolve(signal, path)[:n_samples] for signal, path in zip(x, paths, strict=True))
    y = y + 0.1 * rng.standard_normal(n_samples)
    taps = estimate_path(x, y[np.newaxis], n_taps, FS, regularization=ridge).taps[0]
    left = y[n_taps - 1 :] - sum(fftconvolve(s, t, "valid") for s, t in zip(x, taps, strict=True))
    for signal, path in zip(x, taps, strict=True):
        gradient = fftconvolve(signal, left[::-1], "valid")[::-1] / left.size
        power = np.mean(signal[n_taps - 1 :] ** 2)
        assert np.abs(gradient - ridge * power * path).max() < 1e-7 * power * np.abs(paths).max()


def test_30_000_taps_take_no_matrix():
    """Which would take 6.7 GiB."""
    n_taps = 30_000
    x, path = np.random.default_rng(0).standard_normal(4 * n_taps), np.exp(-np.arange(n_taps) / 3000)
    tracemalloc.start()
    found = estimate_path(x, fftconvolve(x, path)[: x.size], n_taps, FS)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(found.taps, path, atol=1e-3)  # the ridge leaves 1e-5 of a tap's neighbours
    assert peak < 300e6
    with pytest.raises(ValueError, match=r"30000 weights need a matrix of 6\.71 GiB"):
        estimate_path(x, x, n_taps, FS, regularization=0)


def test_error_measures_have_floors_and_lengths():
    assert misalignment_db([1.0, 2.0], [1.0, 2.0, 0.0]) == pytest.approx(-300)
    assert misalignment_db([3.0, 4.0], [3.0]) == pytest.approx(10 * np.log10(16 / 25))
    with pytest.raises(ValueError, match="path must not be all zeros"):
        misalignment_db([0.0], [1.0])


SHORT_PATH = np.concatenate([np.zeros(3), np.random.default_rng(8).standard_normal(29) * np.exp(-np.arange(29) / 8)])
TWO_BY_TWO = np.random.default_rng(9).standard_normal((2, 2, 24)) * np.exp(-np.arange(24) / 6)


@pytest.mark.parametrize("loudspeakers", ["in turn", "at once"])
@pytest.mark.parametrize("n_taps", ["all", "half"])
@pytest.mark.parametrize("noise", [0.0, 0.02, 0.3])
@pytest.mark.parametrize("path", [SHORT_PATH, TWO_BY_TWO], ids=["one", "two by two"])
def test_the_uncertainty_bounds_the_true_error_and_is_of_its_size(path, noise, n_taps, loudspeakers):
    """Over 257 frequencies and five seeds. The bound of a matrix adds all its errors, so it is wider."""
    taps = path.shape[-1] // (2 if n_taps == "half" else 1)
    plant, ratios = Plant(path, fs=8000, sensor_noise_std=noise), []
    for seed in range(5):
        result = identify_secondary_path(plant, n_taps=taps, duration_s=1.0, rng=seed, loudspeakers=loudspeakers)
        assert result.uncertainty.shape == (257,)
        error = path_uncertainty(np.reshape(path, (1, *path.shape)), result.taps)  # the true path as a measured one
        ratios.append(result.uncertainty / error)
    # What lies beyond the taps is found by its cross-spectrum with the excitation, which scatters.
    assert np.mean(np.array(ratios) < (1.0 if n_taps == "all" else 0.85)) < 0.02
    assert np.median(ratios) < (5.0 if path.ndim == 1 else 10.0)


def test_an_excitation_without_high_frequencies_leaves_them_uncertain():
    sent = scipy.signal.lfilter(*scipy.signal.butter(6, 0.25), np.random.default_rng(2).standard_normal(16000))
    heard = np.convolve(sent, SHORT_PATH)[: sent.size]
    uncertainty = estimate_path(sent, heard, 32, 8000.0).uncertainty
    assert uncertainty[:50].max() < 0.01  # up to 0.78 kHz
    assert uncertainty[150:].min() > 0.5  # above 2.3 kHz the ridge decides
    true = path_uncertainty(SHORT_PATH[np.newaxis], estimate_path(sent, heard, 32, 8000.0).taps)
    assert np.mean(uncertainty < true) < 0.02


def test_the_uncertainty_falls_with_the_root_of_the_duration():
    plant = Plant(SHORT_PATH, fs=8000, sensor_noise_std=0.2)

    def mean(duration_s):
        return identify_secondary_path(plant, n_taps=32, duration_s=duration_s, rng=3).uncertainty.mean()

    assert mean(16.0) / mean(4.0) == pytest.approx(0.5, rel=0.1)


# ---- Several loudspeakers and microphones

SLOW = 8000.0
N_TAPS = 12
PATHS = np.random.default_rng(11).standard_normal((3, 2, N_TAPS)) * 0.8 ** np.arange(N_TAPS)
PLANT_OF_TWO = Plant(PATHS, fs=SLOW)


def recordings(n=600, noise=0.05, seed=0):
    """Coloured excitations (2, n) and what each loudspeaker alone adds to each microphone (2, 3, n), with noise."""
    rng = np.random.default_rng(seed)
    sent = scipy.signal.lfilter([1.0], [1.0, -0.6], rng.standard_normal((2, n)))
    sent[1] *= 3.0
    heard = np.array([[scipy.signal.lfilter(PATHS[k, j], 1.0, sent[j]) for k in range(3)] for j in range(2)])
    return sent, heard + noise * rng.standard_normal(heard.shape)


@pytest.mark.parametrize("n_loudspeakers", [1, 2])
@pytest.mark.parametrize("regularization", [0.0, 1e-3])
def test_loudspeakers_at_once_are_one_least_squares_problem(regularization, n_loudspeakers):
    sent, heard = (signals[:n_loudspeakers] for signals in recordings())
    together = heard.sum(axis=0)
    found = estimate_path(sent, together, N_TAPS, SLOW, regularization=regularization)
    rows = delayed(sent, N_TAPS)[:, N_TAPS - 1 :].T
    target = together[:, N_TAPS - 1 :].T
    # A ridge is least squares with a row for each weight.
    powers = [np.mean(signal[N_TAPS - 1 :] ** 2) for signal in sent]
    ridge = np.diag(np.sqrt(len(rows) * regularization * np.repeat(powers, N_TAPS)))
    expected = np.linalg.lstsq(np.vstack([rows, ridge]), np.vstack([target, np.zeros((len(ridge), 3))]), rcond=None)[0]
    np.testing.assert_allclose(found.taps, expected.T.reshape(3, -1, N_TAPS), atol=1e-10)
    left = np.mean((target - rows @ expected) ** 2, axis=0) / np.mean(target**2, axis=0)
    np.testing.assert_allclose(np.ravel(found.residual_db), 10 * np.log10(left), rtol=1e-8)
    taps, rate = path_matrix(found.estimate, fs=None, name="estimate")
    np.testing.assert_array_equal(taps, found.taps)
    assert rate == SLOW


def test_loudspeakers_in_turn_are_a_problem_each():
    sent, heard = recordings()
    found = estimate_path(sent, heard, N_TAPS, SLOW)
    assert found.residual_db.shape == (3, 2)
    for j in range(2):
        for k in range(3):
            alone = estimate_path(sent[j], heard[j, k], N_TAPS, SLOW)
            np.testing.assert_array_equal(found.taps[k, j], alone.taps)
            assert found.residual_db[k, j] == alone.residual_db
    same = recordings(seed=3)[0][0]
    heard = np.array([[scipy.signal.lfilter(PATHS[k, j], 1.0, same) for k in range(3)] for j in range(2)])
    np.testing.assert_allclose(estimate_path(same, heard, N_TAPS, SLOW, regularization=0).taps, PATHS, atol=1e-9)


@pytest.mark.parametrize("loudspeakers", ["in turn", "at once"])
def test_noise_gives_the_error_of_least_squares(loudspeakers):
    # Variance of each tap: noise power / (samples * excitation power), however many loudspeakers play.
    noise, level, n_samples = 0.3, 2.0, 4000
    plant = Plant(PATHS, fs=SLOW, sensor_noise_std=noise)
    settings = {"n_taps": N_TAPS, "duration_s": n_samples / SLOW, "level": level, "loudspeakers": loudspeakers}
    results = [identify_secondary_path(plant, **settings, rng=seed) for seed in range(20)]
    error = np.mean([10 ** (result.misalignment_db / 10) for result in results], axis=0) * np.sum(PATHS**2, axis=2)
    # 20 runs of 12 taps in 6 pairs: a standard deviation of 4 % in the mean, 9 % in a pair.
    expected = N_TAPS * noise**2 / (n_samples * level**2)
    assert np.mean(error) == pytest.approx(expected, rel=0.15)
    np.testing.assert_allclose(error, expected, rtol=0.4)
    residual = np.mean([10 ** (result.residual_db / 10) for result in results], axis=0)
    heard = level**2 * np.sum(PATHS**2, axis=2)
    heard = heard if loudspeakers == "in turn" else heard.sum(axis=1)
    np.testing.assert_allclose(residual, noise**2 / (heard + noise**2), rtol=0.1)


def test_each_loudspeaker_has_its_amplifier():
    settings = {"n_taps": N_TAPS, "duration_s": 1.0, "rng": 0}

    clip = HardClipAmplifier(1.0)
    result = identify_secondary_path(Plant(PATHS, amplifier=[None, clip], fs=SLOW), **settings, loudspeakers="at once")
    gains = np.sum(result.taps * PATHS, axis=2) / np.sum(PATHS**2, axis=2)
    np.testing.assert_allclose(gains[:, 0], 1.0, atol=0.05)
    np.testing.assert_allclose(gains[:, 1], 0.682689, atol=0.05)  # Bussgang: erf(1/sqrt(2))
    both, of_a_sample = (
        identify_secondary_path(Plant(PATHS, amplifier=amplifier, fs=SLOW), **settings)
        for amplifier in (clip, lambda y: max(-1.0, min(y, 1.0)))
    )
    np.testing.assert_allclose(np.sum(both.taps * PATHS, axis=2) / np.sum(PATHS**2, axis=2), 0.682689, atol=0.02)
    np.testing.assert_array_equal(of_a_sample.taps, both.taps)


NOISES = np.random.default_rng(0).standard_normal((3, 100))


@pytest.mark.parametrize(
    ("sent", "heard", "message"),
    [
        (np.ones(10), np.ones(9), "response must have 10 samples"),
        (np.ones(4), np.ones(4), "excitation must have at least 7"),
        (np.zeros(10), np.ones(10), "excitation must not be silent"),
        (NOISES[[0, 0]], NOISES, r"excitation\[1\] must not be correlated with excitation\[0\]"),
        ([NOISES[0, 2:], -NOISES[0, :-2]], NOISES[:, 2:], r"excitation\[1\] must not be correlated"),
        (NOISES[:2] * [[1], [0]], NOISES, r"excitation\[1\] must not be silent"),
        (NOISES[:2], NOISES * [[1], [1], [0]], r"response\[2\] must not be silent"),
        (NOISES[:2], NOISES[:, :-1], "response must have 100 samples, as excitation has, got 99"),
        (NOISES[:2], NOISES[np.newaxis].repeat(3, 0), r"excitation must be .* = \(3, 100\) for a response of shape .*"),
        (NOISES[0], NOISES[:2, np.newaxis] * [[[1]], [[0]]], r"response\[1\]\[0\] must not be silent"),
        (NOISES[0], np.zeros((0, 2, 100)), r"response must be \(J loudspeakers, K microphones, n_samples\), got shape"),
    ],
)
def test_estimate_refuses(sent, heard, message):
    with pytest.raises(ValueError, match=message):
        estimate_path(sent, heard, 4, SLOW)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"duration_s": 0.001}, "duration_s must be at least 0.00394 s for 32 taps"),
        ({"level": 0.0}, "level must be greater than 0"),
        ({"plant": Plant(PATH, amplifier=lambda u: math.nan)}, "amplifier must return a finite number, got nan"),
        ({"plant": Plant(PATH, amplifier=lambda u: 0 * u)}, "response must not be silent"),
        ({"plant": PLANT_OF_TWO.changed_at(1.0, secondary=-PATHS)}, "needs a plant that does not change"),
        (
            {"plant": PLANT_OF_TWO, "n_taps": 12, "duration_s": 0.004, "loudspeakers": "at once"},
            "duration_s must be at least 0.00438 s for 12 taps",
        ),
        ({"plant": Plant(PATHS * [[1.0], [0.0]], fs=SLOW)}, "secondary path 0, 1 must not be all zeros.*unplugged"),
    ],
)
def test_identification_refuses(changes, message):
    with pytest.raises(ValueError, match=message):
        identify_secondary_path(**{"plant": PLANT, "n_taps": 32, "duration_s": 0.1, "rng": 0} | changes)
