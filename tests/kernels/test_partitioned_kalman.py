"""The Kalman filter in the frequency domain against convolutions, dense matrices and least squares."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.channels import correlation, delayed, random_paths, through
from scipy.linalg import block_diag, toeplitz

from kfopc_filterpy.kernels import partitioned_kalman
from kfopc_filterpy.kernels.correlation import FadingCorrelation
from kfopc_filterpy.kernels.partitioned_kalman import SHARE, PartitionedKalman, innovation_spectrum

K, REFERENCES, TAPS, BLOCK = 2, 2, 42, 16  # the last partition is cut


def hear(kalman: PartitionedKalman, x: np.ndarray, begin: int) -> None:
    """Let the filter hear the block from `begin` on, with the blocks before it, at first zeros."""
    past = -(-TAPS // BLOCK) * BLOCK
    kalman.hear(np.pad(x, [(0, 0), (past, 0)])[:, begin : begin + past + BLOCK])


def heard(n_blocks: int, variance_seed: int = 3) -> tuple[PartitionedKalman, np.ndarray]:
    """A filter that has heard coloured inputs, with variances that differ, and these inputs."""
    x = np.random.default_rng(1).standard_normal((REFERENCES, n_blocks * BLOCK))
    x = np.array([np.convolve(row, [1.0, 0.8, 0.4], "same") for row in x])
    kalman = PartitionedKalman(K, REFERENCES, TAPS, BLOCK)
    kalman.variance = np.random.default_rng(variance_seed).uniform(0.01, 1.0, kalman.variance.shape)
    for begin in range(0, x.shape[1], BLOCK):
        hear(kalman, x, begin)
    return kalman, x


def rows_of(x: np.ndarray, taps: int) -> np.ndarray:
    """The inputs that each sample of the last block is a sum of, (B, I * taps)."""
    return delayed(x, taps)[:, -BLOCK:].T


def test_overlap_save_is_the_linear_convolution() -> None:
    kalman, x = heard(6)
    paths = random_paths(K, REFERENCES, TAPS, seed=2)
    padded = np.pad(paths, [(0, 0), (0, 0), (0, 3 * BLOCK - TAPS)]).reshape(K, REFERENCES, 3, BLOCK)
    expected = through(paths, x)[:, -BLOCK:]
    np.testing.assert_allclose(kalman.outputs(np.fft.rfft(padded, 2 * BLOCK)), expected, atol=1e-12)


def prior_of(kalman: PartitionedKalman) -> np.ndarray:
    """The dense covariance of the taps, (I * 3 B, I * 3 B): a Toeplitz matrix for each partition, cut at the path's end."""
    blocks = [toeplitz(np.fft.irfft(v)[:BLOCK]) for input_ in kalman.variance for v in input_]
    dense, kept = block_diag(*blocks), np.tile(np.arange(3 * BLOCK) < TAPS, REFERENCES)
    return dense * np.outer(kept, kept)


def test_a_block_is_learned_as_by_a_dense_kalman_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gain is exact for taps whose covariance is diagonal in the frequency domain, with enough steps."""
    monkeypatch.setattr(partitioned_kalman, "STEPS", 60)
    kalman, x = heard(6)
    d = np.random.default_rng(4).standard_normal((K, BLOCK))
    prior, H = prior_of(kalman), rows_of(x, 3 * BLOCK)
    gain = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + np.eye(BLOCK))
    assert kalman.learn(d)
    found = np.pad(kalman.paths, [(0, 0), (0, 0), (0, 3 * BLOCK - TAPS)])
    np.testing.assert_allclose(found.reshape(K, -1), d @ gain.T, rtol=1e-6, atol=1e-9)


def test_the_variance_follows_the_recursion_of_each_frequency() -> None:
    """Enzner and Vary's, written bin by bin: P <- P (1 - 1/2 * 1/2 |X|^2 P / S), S from the frame's correlation."""
    kalman, x = heard(6)
    kalman.state_noise = 0.01
    before = kalman.variance + BLOCK * 0.01
    frames = np.zeros((REFERENCES, 3, BLOCK + 1), complex)
    for i in range(REFERENCES):
        for p in range(3):
            end = x.shape[1] - p * BLOCK
            frames[i, p] = np.fft.rfft(x[i, end - 2 * BLOCK : end])
    explained = 0.5 * np.sum(before * np.abs(frames) ** 2, axis=(0, 1))
    matrix = toeplitz(np.fft.irfft(explained)[:BLOCK])
    expected = np.empty_like(before)
    for f in range(BLOCK + 1):
        wave = np.exp(-2j * np.pi * f * np.arange(BLOCK) / (2 * BLOCK))
        S = (wave.conj() @ matrix @ wave).real / BLOCK + 1.0
        for i in range(REFERENCES):
            for p in range(3):
                expected[i, p, f] = before[i, p, f] * (
                    1 - SHARE * 0.5 * before[i, p, f] * abs(frames[i, p, f]) ** 2 / S
                )
    assert kalman.learn(np.zeros((K, BLOCK)))
    np.testing.assert_allclose(kalman.variance, expected, rtol=1e-10)


def test_the_innovation_spectrum_of_white_noise_is_flat() -> None:
    np.testing.assert_allclose(innovation_spectrum(np.full(9, 3.0)), 4.0)


@pytest.mark.parametrize("noise", ["tone", "tone and its octave", "white"])
def test_a_block_never_increases_its_own_error(noise: str) -> None:
    n = np.arange(40 * BLOCK)
    x = {
        "tone": np.sin(0.37 * n),
        "tone and its octave": np.sin(0.2 * n) + np.sin(0.4 * n + 1.0),
        "white": np.random.default_rng(0).standard_normal(n.size),
    }[noise][np.newaxis]
    d = through(random_paths(1, 1, TAPS, seed=5), x)
    kalman = PartitionedKalman(1, 1, TAPS, BLOCK)
    kalman.variance[...] = 100.0  # large: every block is cancelled as far as it can be
    for begin in range(0, n.size, BLOCK):
        block = d[:, begin : begin + BLOCK]
        hear(kalman, x, begin)
        before = np.linalg.norm(block - kalman.outputs(kalman._spectra))
        assert kalman.learn(block)
        assert np.linalg.norm(block - kalman.outputs(kalman._spectra)) <= before + 1e-12
    assert before < 1e-3 * np.linalg.norm(block)


def test_white_noise_is_averaged_nearly_as_by_least_squares() -> None:
    """The gain falls as 2/t in place of 1/t (half of a frame's information counts): about sqrt(4/3) of the error."""
    n_samples = 800 * BLOCK
    x = np.random.default_rng(0).standard_normal((REFERENCES, n_samples))
    paths = random_paths(K, REFERENCES, TAPS, seed=2)
    d = through(paths, x) + 0.3 * np.random.default_rng(6).standard_normal((K, n_samples))
    kalman = PartitionedKalman(K, REFERENCES, TAPS, BLOCK)
    kalman.variance[...] = 1.0
    for begin in range(0, n_samples, BLOCK):
        hear(kalman, x, begin)
        kalman.learn(d[:, begin : begin + BLOCK])
    rows = delayed(x, TAPS)
    batch = np.linalg.solve(rows @ rows.T, rows @ d.T).T.reshape(paths.shape)
    of_batch, of_kalman = (np.linalg.norm(found - paths) for found in (batch, kalman.paths))
    assert of_batch < 0.02 * np.linalg.norm(paths)
    assert of_batch < of_kalman < 1.35 * of_batch


def test_what_overflows_is_refused_with_nothing_changed() -> None:
    kalman, _ = heard(3)
    kalman.learn(np.ones((K, BLOCK)))
    paths, variance = kalman.paths, kalman.variance.copy()
    with np.errstate(over="ignore", invalid="ignore"):
        hear(kalman, np.full((REFERENCES, BLOCK), 1e200), 0)
        assert not kalman.learn(np.ones((K, BLOCK)))
    np.testing.assert_array_equal(kalman.paths, paths)
    np.testing.assert_array_equal(kalman.variance, variance)


def test_the_correlation_is_the_faded_sum_of_products() -> None:
    n_lags, n_samples, keep = 37, 8 * BLOCK, 0.97
    x = np.random.default_rng(7).standard_normal((REFERENCES, n_samples))
    found = FadingCorrelation(n_lags, REFERENCES, keep)
    past = np.concatenate([np.zeros((REFERENCES, n_lags - 1)), x], axis=1)
    for end in range(BLOCK, n_samples + 1, BLOCK):
        found.add(past[:, end - BLOCK : end + n_lags - 1])
    weights = keep ** np.arange(n_samples - 1, -1, -1.0)
    expected = np.zeros((n_lags, REFERENCES, REFERENCES))
    for m in range(n_lags):
        for i in range(REFERENCES):
            for k in range(REFERENCES):
                expected[m, i, k] = np.sum(weights[m:] * x[i, : n_samples - m] * x[k, m:])
    np.testing.assert_allclose(found.total, expected, atol=1e-11)
    np.testing.assert_allclose(found.mass, weights.sum())
    lasting = FadingCorrelation(n_lags, REFERENCES, 1.0)
    lasting.add(past)
    np.testing.assert_allclose(lasting.total / lasting.mass, correlation(x, n_lags), atol=1e-12)


def test_a_stretch_that_is_left_out_of_the_correlation_separates_two_signals() -> None:
    """The sum is that of both, each with zeros around it."""
    n_lags, n_samples = 37, 6 * BLOCK
    x = np.random.default_rng(8).standard_normal((REFERENCES, n_samples))
    past = np.concatenate([np.zeros((REFERENCES, n_lags - 1)), x], axis=1)
    found, first, second = (FadingCorrelation(n_lags, REFERENCES, 1.0) for _ in range(3))
    for end in range(BLOCK, n_samples + 1, BLOCK):
        if not 2 * BLOCK < end <= 3 * BLOCK + 5:
            found.add(past[:, end - BLOCK : end + n_lags - 1])
    first.add(past[:, : 2 * BLOCK + n_lags - 1])
    second.add(np.concatenate([np.zeros((REFERENCES, n_lags - 1)), x[:, 3 * BLOCK :]], axis=1))
    np.testing.assert_allclose(found.total, first.total + second.total, atol=1e-11)
    assert found.mass == n_samples - BLOCK
