"""KF-PB in the shared-gain form: the estimate against filterpy and batch least squares, the powers against the bound."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from helpers.channels import random_paths, through

from kfopc_filterpy import kf_pb, noise_reduction_db, output_power, simulate
from kfopc_filterpy.controllers import SharedGainKalman

FS = 4000.0
K, J, TAPS, PRIMARY = 3, 2, 24, 30
SECONDARY = random_paths(K, J, 12, seed=1)
PRIMARY_PATHS = random_paths(K, 2, PRIMARY, seed=2, delay=6)


def references(n_samples: int, count: int = 2, seed: int = 0) -> np.ndarray:
    x = np.random.default_rng(seed).standard_normal((count, n_samples))
    return np.array([np.convolve(row, [1.0, 0.6], "same") for row in x])


def made(**changed: Any) -> SharedGainKalman:
    settings: dict[str, Any] = {"n_references": 2, "n_primary": PRIMARY, "fs": FS} | changed
    return SharedGainKalman(TAPS, SECONDARY, **settings)


# ---- The estimate


@pytest.mark.parametrize("path_memory_s", [0.3, 1e6])
def test_the_paths_are_those_of_filterpys_filter_of_each_microphone(path_memory_s: float) -> None:
    """To 1e-10: the same equations, with one covariance in place of one for each microphone."""
    controller, n_samples = made(path_memory_s=path_memory_s, rated_power=0.3), 600
    x = references(n_samples)
    d = through(PRIMARY_PATHS, x) + 0.1 * np.random.default_rng(5).standard_normal((K, n_samples))
    simulate(controller, x, disturbance=d, secondary_path=SECONDARY, fs=FS)
    power = through_first_block(controller, x)
    rows = np.array(
        [[x[i, n - m] if n >= m else 0.0 for i in range(2) for m in range(PRIMARY)] for n in range(n_samples)]
    )
    for k in range(K):
        kf = KalmanFilter(dim_x=2 * PRIMARY, dim_z=1)
        kf.P *= 1e3 / (2 * PRIMARY * power)
        kf.Q, kf.R = np.eye(2 * PRIMARY) / (power * (path_memory_s * FS) ** 2), np.eye(1)
        for n in range(controller.block, n_samples):
            kf.predict()
            kf.update(d[k, n], H=rows[n : n + 1])
        np.testing.assert_allclose(controller.primary_path[k].ravel(), kf.x.ravel(), rtol=1e-9, atol=1e-10)


def through_first_block(controller: SharedGainKalman, x: np.ndarray) -> float:
    """The mean power of the references, as the controller takes it from its first block."""
    fade = np.exp(-np.arange(controller.block)[::-1] / (controller.memory_s * FS))
    return float(np.mean(x[:, : controller.block] ** 2 @ fade) / fade.sum())


def test_without_state_noise_the_paths_are_batch_least_squares() -> None:
    controller, n_samples = made(path_memory_s=1e8), 3000
    x = references(n_samples)
    d = through(PRIMARY_PATHS, x) + 0.3 * np.random.default_rng(6).standard_normal((K, n_samples))
    simulate(controller, x, disturbance=d, secondary_path=SECONDARY, fs=FS)
    power, start = through_first_block(controller, x), controller.block
    rows = np.array([[x[i, n - m] for i in range(2) for m in range(PRIMARY)] for n in range(start, n_samples)])
    ridge = 2 * PRIMARY * power / 1e3 * np.eye(2 * PRIMARY)
    expected = np.linalg.solve(rows.T @ rows + ridge, rows.T @ d[:, start:].T).T
    np.testing.assert_allclose(controller.primary_path.reshape(K, -1), expected, rtol=1e-7, atol=1e-8)


# ---- One channel


def test_one_loudspeaker_in_the_shared_gain_form_agrees_with_the_direct_one() -> None:
    x, primary, secondary = references(16000, 1)[0], PRIMARY_PATHS[0, 0], SECONDARY[0, 0]
    direct = kf_pb(TAPS, secondary, rated_power=0.05, state_noise=1e-9, measurement_noise=1e-3, fs=FS)
    shared = kf_pb(TAPS, secondary, rated_power=0.05, form="shared gain", fs=FS, n_primary=PRIMARY)
    reductions, powers = [], []
    for controller in (direct, shared):
        result = simulate(controller, x, primary_path=primary, secondary_path=secondary, fs=FS)
        assert result.error.shape == x.shape
        reductions.append(noise_reduction_db(result.error, result.disturbance))
        powers.append(output_power(result.control_signal) / 0.05)
    assert abs(reductions[0] - reductions[1]) < 0.2
    np.testing.assert_allclose(powers, 1.0, atol=0.03)


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"form": "direct"}, TypeError, "give state_noise and measurement_noise"),
        ({"state_noise": 1e-6}, TypeError, "shared gain form takes path_memory_s instead of state_noise"),
        ({"initial_variance": 1.0}, TypeError, "instead of initial_variance"),
        ({"form": "other"}, ValueError, "form must be one of"),
    ],
    ids=["direct", "state noise", "variance", "other"],
)
def test_kf_pb_says_what_a_form_needs(arguments: dict, error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        kf_pb(TAPS, SECONDARY, rated_power=1.0, **arguments)
    with pytest.raises(TypeError, match="give state_noise and measurement_noise"):
        kf_pb(TAPS, SECONDARY[0, 0], rated_power=1.0)
