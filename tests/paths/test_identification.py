"""Identification: exact recovery, lstsq as the oracle, what noise and clipping do to it."""

import math
import tracemalloc

import numpy as np
import pytest
import scipy.signal
from scipy.signal import fftconvolve, lfilter

from kfopc_filterpy import Plant
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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"duration_s": 0.001}, "duration_s must be at least 0.00394 s for 32 taps"),
        ({"level": 0.0}, "level must be greater than 0"),
        ({"plant": Plant(PATH, amplifier=lambda u: math.nan)}, "amplifier must return a finite number, got nan"),
        ({"plant": Plant(PATH, amplifier=lambda u: 0 * u)}, "response must not be silent"),
    ],
)
def test_identification_refuses(changes, message):
    with pytest.raises(ValueError, match=message):
        identify_secondary_path(**{"plant": PLANT, "n_taps": 32, "duration_s": 0.1, "rng": 0} | changes)


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
