"""What a scene hands its controllers: P0, q and sensor noise, against what they stand for."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.channels import dense_systems, random_paths, through

from comparisons.bench import Scene, Trial, algorithms, best_setting, make_controller, make_scene, run_setting
from kfopc_filterpy import Plant

FS = 16000.0


def scene_of(n_taps: int, seeds: tuple[int, ...] = (3,)):
    noises = {seed: np.random.default_rng(seed).standard_normal(6000) for seed in seeds}
    plant = Plant([0.0, 0.8, 0.2], [0.0, 0.0, 1.0, 0.4], fs=FS)
    return make_scene(noises, plant, rated_power=0.5, power_multiple=4.0, n_taps=n_taps, switch_on_s=0.1)


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
    assert power == pytest.approx(scene.unconstrained_power, rel=0.03)
    assert scene.unconstrained_power == 4.0 * 0.5


def test_filters_start_with_the_variances_of_the_scene():
    scene = scene_of(16)
    controller = make_controller(scene, "KF-OPC", 1e-6)
    np.testing.assert_array_equal(np.diag(controller.covariance), np.full(16, scene.initial_variance))
    assert controller.measurement_noise == scene.measurement_noise
    assert controller.state_noise == pytest.approx(1e-6 * scene.measurement_noise / scene.filtered_power, rel=1e-12)
    least_squares = make_controller(scene, "FxRLS", 1e-3)
    ratio = scene.initial_variance / scene.measurement_noise * least_squares.measurement_noise
    np.testing.assert_allclose(np.diag(least_squares.covariance), ratio, rtol=1e-12)


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


# ---- Several channels


@pytest.fixture(scope="module")
def channels() -> Scene:
    """Two references, three microphones, two loudspeakers of unlike ratings; the second noise is twice as loud."""
    plant = Plant(random_paths(3, 2, 12, seed=2), random_paths(3, 2, 20, seed=1, delay=6), fs=FS)
    noises = {k: k * np.random.default_rng(k).standard_normal((2, 4000)) for k in (1, 2)}
    ratings = np.array([0.2, 0.6])
    return make_scene(noises, plant, rated_power=ratings, power_multiple=3.0, n_taps=8, switch_on_s=0.1)


def test_level_of_several_channels_asks_for_a_multiple_of_all_ratings(channels):
    """Against a batch least-squares fit; 1e-3 for the ridge of 1e-6 of the filtered power."""
    assert np.sum(channels.unconstrained_power) == pytest.approx(3.0 * 0.8, rel=1e-12)
    x, d = channels.settled
    R, of_x, r = dense_systems(x, d, channels.secondary, 8, start=18)
    w = np.linalg.solve(R, r).reshape(2, -1)
    power = np.einsum("ja,ab,jb->j", w, of_x, w)
    np.testing.assert_allclose(channels.unconstrained_power, power, rtol=1e-3)
    unexplained = (np.mean(d[:, 18:] ** 2, axis=1).sum() - r @ w.ravel()) / 3
    assert channels.measurement_noise == pytest.approx(unexplained + channels.sensor_noise_std**2, rel=1e-2)
    of_weights = (
        2 * 8 * np.sum(np.mean(channels.references[0] ** 2, axis=1))
    )  # two filters of variance 1 for each reference
    assert channels.initial_variance == pytest.approx(np.sum(channels.unconstrained_power) / of_weights, rel=1e-9)


def test_signals_of_several_channels(channels):
    x = channels.references[1]
    np.testing.assert_allclose(np.sum(np.mean(x**2, axis=1)), np.sum(np.mean(channels.references[0] ** 2, axis=1)))
    primary = random_paths(3, 2, 20, seed=1, delay=6)
    np.testing.assert_allclose(channels.disturbances[1], through(primary, x), atol=1e-10)
    filtered = [
        [np.convolve(s, one)[:4000] for one in channels.references[0]] for s in channels.secondary.reshape(6, -1)
    ]
    power = np.mean(np.square(filtered), axis=-1).sum() / 2
    assert channels.filtered_power == pytest.approx(power, rel=1e-10)
    assert channels.secondary_gain == pytest.approx(
        power / np.mean(channels.references[0] ** 2, axis=1).sum(), rel=1e-10
    )


@pytest.mark.parametrize("name", algorithms(several_channels=True))
def test_each_algorithm_of_several_channels_is_made_and_runs(channels, name):
    own = algorithms(several_channels=True)[name]
    second = (own.second[0],) if own.second else ()
    setting = (own.first[-1], *second) if own.second else own.first[-1]
    result = run_setting(channels, name, setting)
    assert result.algorithm == name
    assert result.control_signal.shape == (2, 2400)
    assert np.all(np.isfinite(result.error))


def test_budget_is_kept_if_every_loudspeaker_keeps_its_own(channels):
    both, one = (
        Trial(setting, nse, np.array(power))
        for setting, nse, power in ((0.1, -5.0, [0.2, 0.6]), (0.2, -9.0, [0.3, 0.1]))
    )
    assert best_setting(channels, "MOV-FxLMS", [both, one]).setting == 0.1
    assert best_setting(channels, "FxLMS", [both, one]).setting == 0.2
    assert not best_setting(channels, "MOV-FxLMS", [one]).within_budget


def test_an_algorithm_of_one_channel_is_refused_by_name(channels):
    with pytest.raises(ValueError, match="diagonal KF-OPC is not compared with several channels"):
        make_controller(channels, "diagonal KF-OPC", 1e-6)
