"""What a scene hands its controllers: P0, q and sensor noise, against what they stand for."""

from __future__ import annotations

import numpy as np
import pytest

from kfopc_filterpy.bench import algorithms, make_controller, make_scene
from kfopc_filterpy.signals import tone

FS = 16000.0
KALMAN = ["KF-ANC", "KF-OPC", "KF-OPC repaired", "KF-PB"]


def scene_of(n_taps: int, seeds: tuple[int, ...] = (3,)):
    noises = {seed: np.random.default_rng(seed).standard_normal(6000) for seed in seeds}
    return make_scene(
        noises,
        [0.0, 0.0, 1.0, 0.4],
        [0.0, 0.8, 0.2],
        fs=FS,
        rated_power=0.5,
        power_multiple=4.0,
        n_taps=n_taps,
        switch_on_s=0.1,
    )


@pytest.mark.parametrize("n_taps", [8, 32, 128])
def test_initial_variance_makes_weights_that_need_the_wiener_power(n_taps):
    """White reference: weights drawn with P0 have, in the mean, its control power, whatever their number.

    The mean of 4000 draws of `n_taps` squares is known to sqrt(2/(4000 n_taps)), at most 0.8 %; the reference is white
    to some per cent.
    """
    scene = scene_of(n_taps)
    weights = np.sqrt(scene.initial_variance) * np.random.default_rng(0).standard_normal((4000, n_taps))
    reference = scene.references[0]
    power = np.mean(np.sum(weights**2, axis=1)) * np.mean(reference**2)
    assert power == pytest.approx(scene.wiener_control_power, rel=0.03)
    assert scene.wiener_control_power == 4.0 * 0.5


@pytest.mark.parametrize("name", KALMAN)
def test_kalman_filters_start_with_the_variances_of_the_scene(name):
    scene = scene_of(16)
    estimator = make_controller(scene, name, 1e-6).estimator
    np.testing.assert_array_equal(np.diag(estimator.P), np.full(16, scene.initial_variance))
    assert estimator.measurement_noise == scene.measurement_noise
    assert estimator.state_noise == pytest.approx(1e-6 * scene.measurement_noise / scene.filtered_power, rel=1e-12)


def test_recursive_least_squares_start_with_the_same_variance_over_q():
    scene = scene_of(16)
    estimator = make_controller(scene, "FxRLS", 1e-3).estimator
    ratio = scene.initial_variance / scene.measurement_noise
    np.testing.assert_allclose(np.diag(estimator.P), ratio * estimator.measurement_noise, rtol=1e-12)


def test_each_seed_has_its_own_sensor_noise_apart_from_the_noises():
    """With a controller that stays silent the error is the disturbance and the sensor noise."""
    scene = scene_of(8, seeds=(3, 4, 5))
    heard = []
    for k in range(3):
        run = scene.run(make_controller(scene, "FxLMS", algorithms()["FxLMS"].grid[-1] * 1e-9), k)
        heard.append(run.error - run.disturbance)
        assert np.std(heard[-1]) == pytest.approx(scene.sensor_noise_std, rel=0.05)  # 3 standard errors are 3 %
        again = scene.run(make_controller(scene, "FxLMS", algorithms()["FxLMS"].grid[-1] * 1e-9), k)
        np.testing.assert_array_equal(again.error, run.error)
    together = np.corrcoef([*heard, *[x[-heard[0].size :] for x in scene.references]])
    assert np.abs(together - np.eye(6)).max() < 0.06  # 5400 samples: 4 standard errors of an independent pair


def test_runs_together_hear_the_sensor_noise_of_their_seed():
    scene = scene_of(8, seeds=(3, 4))
    for k in range(2):
        alone = scene.run(make_controller(scene, "KF-ANC", 1e-6), k)
        (together,) = scene.run_together([make_controller(scene, "KF-ANC", 1e-6)], k)
        np.testing.assert_allclose(together.error, alone.error, atol=1e-9)
    assert len(set(scene.sensor_noise_seeds)) == 2
    assert not set(scene.sensor_noise_seeds) & set(scene.seeds)


def test_seeds_of_one_scene_are_scaled_alike():
    noises = {seed: tone(400.0, 0.5, fs=FS, amplitude=float(seed)) for seed in (1, 2, 3)}
    scene = make_scene(noises, [0.0, 1.0], [1.0], fs=FS, rated_power=1.0, power_multiple=2.0, n_taps=8, switch_on_s=0.1)
    # Not quite 2: the Wiener solution is of the record after switch-on, the power of the whole record.
    assert [np.mean(x**2) for x in scene.references] == pytest.approx([2.0] * 3, rel=2e-3)
