"""Identification of the paths of several loudspeakers: numpy's least squares as the oracle, and what noise does to it."""

import numpy as np
import pytest
import scipy.signal
from helpers.channels import delayed

from kfopc_filterpy import HardClipAmplifier, Plant
from kfopc_filterpy._taps import path_matrix
from kfopc_filterpy.paths import estimate_path, identify_secondary_path

FS = 8000.0
N_TAPS = 12
PATHS = np.random.default_rng(11).standard_normal((3, 2, N_TAPS)) * 0.8 ** np.arange(N_TAPS)
PLANT = Plant(PATHS, fs=FS)


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
    found = estimate_path(sent, together, N_TAPS, FS, regularization=regularization)
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
    assert rate == FS


def test_loudspeakers_in_turn_are_a_problem_each():
    sent, heard = recordings()
    found = estimate_path(sent, heard, N_TAPS, FS)
    assert found.residual_db.shape == (3, 2)
    for j in range(2):
        for k in range(3):
            alone = estimate_path(sent[j], heard[j, k], N_TAPS, FS)
            np.testing.assert_array_equal(found.taps[k, j], alone.taps)
            assert found.residual_db[k, j] == alone.residual_db
    same = recordings(seed=3)[0][0]
    heard = np.array([[scipy.signal.lfilter(PATHS[k, j], 1.0, same) for k in range(3)] for j in range(2)])
    np.testing.assert_allclose(estimate_path(same, heard, N_TAPS, FS, regularization=0).taps, PATHS, atol=1e-9)


@pytest.mark.parametrize("loudspeakers", ["in turn", "at once"])
def test_noise_gives_the_error_of_least_squares(loudspeakers):
    # Variance of each tap: noise power / (samples * excitation power), however many loudspeakers play.
    noise, level, n_samples = 0.3, 2.0, 4000
    plant = Plant(PATHS, fs=FS, sensor_noise_std=noise)
    settings = {"n_taps": N_TAPS, "duration_s": n_samples / FS, "level": level, "loudspeakers": loudspeakers}
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
    result = identify_secondary_path(Plant(PATHS, amplifier=[None, clip], fs=FS), **settings, loudspeakers="at once")
    gains = np.sum(result.taps * PATHS, axis=2) / np.sum(PATHS**2, axis=2)
    np.testing.assert_allclose(gains[:, 0], 1.0, atol=0.05)
    np.testing.assert_allclose(gains[:, 1], 0.682689, atol=0.05)  # Bussgang: erf(1/sqrt(2))
    both, of_a_sample = (
        identify_secondary_path(Plant(PATHS, amplifier=amplifier, fs=FS), **settings)
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
        estimate_path(sent, heard, 4, FS)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"plant": PLANT.changed_at(1.0, secondary=-PATHS)}, "needs a plant that does not change"),
        ({"duration_s": 0.004, "loudspeakers": "at once"}, "duration_s must be at least 0.00438 s for 12 taps"),
        ({"plant": Plant(PATHS * [[1.0], [0.0]], fs=FS)}, "secondary path 0, 1 must not be all zeros.*unplugged"),
    ],
)
def test_identification_refuses(changes, message):
    settings = {"plant": PLANT, "n_taps": N_TAPS, "duration_s": 0.1, "rng": 0} | changes
    with pytest.raises(ValueError, match=message):
        identify_secondary_path(**settings)
