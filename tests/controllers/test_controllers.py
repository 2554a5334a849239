"""Controllers one at a time: going on from a state, copies, interruptions, refusals, and what they settle to."""

import copy
import math

import numpy as np
import pytest
import scipy.signal
from filterpy.kalman import KalmanFilter
from helpers.channels import random_paths
from helpers.comparing import assert_same_run
from helpers.simulation import MAKERS, D, X, constraint

from kfopc_filterpy import (
    KFOPC,
    KalmanController,
    MOVFxLMS,
    kf_anc,
    kf_opc,
    noise_reduction_db,
    output_power,
    simulate,
)
from kfopc_filterpy.bounds import wiener_solution
from kfopc_filterpy.loop.simulation import STRETCH
from kfopc_filterpy.signals import band_limited_noise

S = np.array([0.0, 0.9, -0.4])
FS = 16000


# ---- Driven by hand, going on, copied


@pytest.mark.parametrize("name", MAKERS)
def test_a_controller_goes_on_from_its_state(name):
    """The controller keeps all it has; the true paths start silent. With nothing in them, two parts are the whole."""
    memoryless = [0.9]
    one, two = MAKERS[name](memoryless), MAKERS[name](memoryless)
    options = {"secondary_path": memoryless, "record_powers": True}
    whole = simulate(one, X, disturbance=D, **options)
    first = simulate(two, X[:130], disturbance=D[:130], **options)
    second = simulate(two, X[130:], disturbance=D[130:], **options)
    for signal in ("error", "control_signal", "anti_noise", "constraint_factor", "disturbance_power"):
        parts = np.concatenate([getattr(first, signal), getattr(second, signal)])
        np.testing.assert_array_equal(parts, getattr(whole, signal), err_msg=signal)
    np.testing.assert_array_equal(one.weights, two.weights)


@pytest.mark.parametrize("name", MAKERS)
def test_an_interrupted_run_leaves_a_controller_that_goes_on(name):
    x, d = np.random.default_rng(0).standard_normal((2, 2 * STRETCH))
    made, reference = MAKERS[name](), MAKERS[name]()

    def interrupt(n_samples):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(made, x, disturbance=d, secondary_path=S, progress=interrupt)
    simulate(reference, x[:STRETCH], disturbance=d[:STRETCH], secondary_path=S)
    np.testing.assert_array_equal(made.weights, reference.weights)
    one, other = (simulate(c, X, disturbance=D, secondary_path=S) for c in (made, reference))
    assert_same_run(one, other)


@pytest.mark.parametrize("name", ["KF-OPC", "MOV-FxLMS"])
def test_listening_after_a_run_hears_the_loudspeaker_fall_silent(name):
    """Three samples of y are still in s^ * y; then the disturbance is what the microphone hears."""
    made = MAKERS[name](constraint=constraint(memory_s=4 / FS, window="sliding"))
    simulate(made, X, disturbance=D, secondary_path=S)
    made.listen(X[:7], D[:7])
    assert made.disturbance_power == pytest.approx(np.mean(D[3:7] ** 2), rel=1e-14)
    assert made.disturbance_power != 0.0


@pytest.mark.parametrize("rated_power", [None, 0.2])
def test_weights_are_copies_and_the_estimators_state(rated_power):
    made = KalmanController(KFOPC(6, rated_power=rated_power), S)
    simulate(made, X, disturbance=D, secondary_path=S)
    np.testing.assert_array_equal(made.weights, made.estimator.x[:, 0])
    made.weights[:] = 0.0
    assert np.any(made.weights)
    made.estimator.x[:] = 0.0  # the estimator's state is the control filter: an edit counts
    assert made.control_signal(1.0) == 0.0


def test_the_estimator_may_keep_a_flat_state():
    flat, column = KalmanFilter(dim_x=6, dim_z=1), KalmanFilter(dim_x=6, dim_z=1)
    flat.x = np.zeros(6)
    one, other = (simulate(KalmanController(kf, S), X, disturbance=D, secondary_path=S) for kf in (flat, column))
    np.testing.assert_allclose(one.error, other.error, rtol=0, atol=1e-12)
    assert flat.x.shape == (6,)


@pytest.mark.parametrize("by_block", [False, True])
def test_a_refused_update_leaves_no_prediction_behind(by_block):
    """S could overflow: each attempt would add the state noise to P."""
    options = {"state_noise": 1e280, "measurement_noise": 1e-2, "initial_variance": 1e290}
    controller = kf_opc(8, [1.0], rated_power=1.0, **options)
    controller.control_signal(1e20)
    before = copy.deepcopy(controller)
    for _ in range(3):
        with pytest.raises(ValueError, match="the covariance P is too large"):
            controller.process([1e20], [0.5]) if by_block else controller.update(0.5)
    np.testing.assert_array_equal(controller.covariance, before.covariance)
    np.testing.assert_array_equal(controller.weights, before.weights)
    assert controller.constraint.disturbance_power == before.constraint.disturbance_power


@pytest.mark.parametrize("kind", ["random walk", "full", "filterpy"])
def test_a_refused_update_of_an_estimator_leaves_no_prediction_behind(kind):
    """A silent reference without measurement noise has no solution."""
    if kind == "random walk":
        kf = KFOPC.random_walk(3, state_noise=0.1, measurement_noise=0.0)
    else:
        kf = KFOPC(3, 1) if kind == "full" else KalmanFilter(3, 1)
        kf.R[:] = 0.0
    controller = KalmanController(kf, [1.0])
    controller.control_signal(1.0)
    controller.update(1.0)
    for _ in range(3):
        controller.control_signal(0.0)
    before = copy.deepcopy(kf)
    for _ in range(3):
        with pytest.raises((ValueError, np.linalg.LinAlgError)):
            controller.update(1.0)
    for name in ("x", "P", "x_prior", "P_prior", "P_post", "K"):
        np.testing.assert_array_equal(getattr(kf, name), getattr(before, name), err_msg=name)
    controller.control_signal(2.0)
    controller.update(1.0)
    assert kf.x[0] != before.x[0]


# ---- What they settle to


def test_kf_opc_of_a_flat_path_keeps_its_rated_power():
    """The control signal that cancels all has four times the rated power; alpha = 1/2 leaves it the rated power."""
    rated_power = 0.8
    x = band_limited_noise((200.0, 2000.0), 6.0, fs=FS, rng=3)
    x *= math.sqrt(4 * rated_power / np.mean(x**2))
    path = np.array([0.0, 0.0, 0.7])
    d = np.concatenate([np.zeros(2), 0.7 * x[:-2]])
    made = kf_opc(16, path, rated_power=rated_power, state_noise=1e-8, measurement_noise=1e-2)
    result = simulate(made, x, disturbance=d, secondary_path=path)
    # the power estimate of 0.5 s of a band of 1800 Hz spreads by some 2 %, its mean by less
    assert output_power(result.control_signal) == pytest.approx(rated_power, rel=0.015)
    assert np.mean(result.constraint_factor[FS:]) == pytest.approx(0.5, rel=0.01)
    # e = (1 - alpha) d
    assert noise_reduction_db(result.error, d) == pytest.approx(20 * math.log10(2), abs=0.1)
    free = kf_anc(16, path, state_noise=1e-8, measurement_noise=1e-2)
    free_result = simulate(free, x, disturbance=d, secondary_path=path)
    assert output_power(free_result.control_signal) == pytest.approx(4 * rated_power, rel=0.02)


def test_the_constraint_bounds_the_control_even_with_the_secondary_path_of_the_wrong_sign():
    x = np.random.default_rng(0).standard_normal(FS)
    d = np.concatenate([np.zeros(2), x[:-2]])
    path = np.array([0.0, 0.9])
    made = kf_opc(6, -path, rated_power=0.2, state_noise=1e-2, measurement_noise=0.01)
    result = simulate(made, x, disturbance=d, secondary_path=path)
    assert result.diverged_at_s is None
    assert output_power(result.control_signal) == pytest.approx(0.2, rel=0.05)
    free = kf_anc(6, -path, state_noise=1e-2, measurement_noise=0.01)
    assert simulate(free, x, disturbance=d, secondary_path=path).diverged_at_s is not None


def test_kf_anc_reaches_the_wiener_solution():
    rng = np.random.default_rng(7)
    n, n_taps, std, q, p0 = 8000, 24, 0.1, 0.01, 100.0
    x = scipy.signal.lfilter([1.0], [1.0, -0.5], rng.standard_normal(n))
    d = np.convolve(x, [0.0, 0.0, 0.8, 0.5, -0.3, 0.2])[:n]
    made = kf_anc(n_taps, S, state_noise=0.0, measurement_noise=q, initial_variance=p0)
    result = simulate(made, x, disturbance=d, secondary_path=S, sensor_noise_std=std, rng=1)
    measured = d + std * np.random.default_rng(1).standard_normal(n)  # d^ = e + s^ * y where s^ = s
    # r = 0: the filter is least squares on d^, with the ridge q / P0 of its start. Exactly, but for rounding.
    rows = scipy.linalg.toeplitz(np.convolve(x, S)[:n], np.zeros(n_taps))
    exact = np.linalg.solve(rows.T @ rows + q / p0 * np.eye(n_taps), rows.T @ measured)
    np.testing.assert_allclose(made.weights, exact, rtol=0, atol=1e-9)
    wiener = wiener_solution(x, measured, S, n_taps)
    # the first 25 samples of 8000, which that leaves out, and the ridge
    np.testing.assert_allclose(made.weights, wiener.weights, rtol=0, atol=2e-3)
    assert noise_reduction_db(result.error, measured) == pytest.approx(wiener.noise_reduction_db, abs=0.15)


def test_listening_goes_on_where_nothing_may_be_put_out():
    """A constraint factor of 0, held or from a rated power that underflows: the powers are followed all the same."""
    x = np.random.default_rng(0).standard_normal(4000)
    held = kf_opc(8, [0.0, 0.8, 0.3], rated_power=1.0, state_noise=1e-6, measurement_noise=1e-3)
    held.constraint.factor = 0.0
    tiny = MOVFxLMS(8, [0.0, 0.8, 0.3], rated_power=1e-320, step_size=0.1)
    for controller, scale in ((held, 1.0), (tiny, 1e24)):
        controller.listen(scale * x, scale * x)
        # half a second's memory over a quarter of one: nearly the plain mean
        assert controller.disturbance_power == pytest.approx(scale**2 * np.mean(x**2), rel=0.1)
        assert controller.constraint_factor == 0.0


def test_a_microphone_that_is_not_reached_tells_nothing_without_measurement_noise():
    """Sound reaches microphone 2 later than the others: until then S is zero, and the weights are those without it."""
    paths = random_paths(3, 2, 4, seed=1)
    paths[2] = np.roll(paths[2], 2, axis=-1) * [0.0, 0.0, 0.0, 1.0]
    settings = {"initial_variance": 100.0, "state_noise": 1e-3, "n_references": 2}
    three = kf_anc(5, paths, measurement_noise=[0.01, 0.01, 0.0], **settings)
    two = kf_anc(5, paths[:2], measurement_noise=0.01, **settings)
    for n, x in enumerate(np.random.default_rng(3).standard_normal((40, 2))):
        np.testing.assert_array_equal(three.control_signal(x), two.control_signal(x)) if n < 4 else None
        three.update([1.0, 2.0, 3.0])
        two.update([1.0, 2.0])
        assert np.array_equal(three.weights, two.weights) == (n < 3), n
    assert np.any(three.weights)
    assert np.all(np.isfinite(three.weights))
