"""What `simulate` refuses, with nothing changed; silence, and updates without a solution."""

import copy

import numpy as np
import pytest
from helpers.comparing import assert_goes_on_as, assert_same_run
from helpers.simulation import FS, MAKERS, PLANT, D, Integrator, S, Stepwise, X

from kfopc_filterpy import KFOPC, KalmanController, Plant, fx_lms, simulate
from kfopc_filterpy.controllers.kalman import KalmanInCore, kalman_settings
from kfopc_filterpy.signals import Recording

PLANT_AND_PRIMARY = Plant(S, [1.0], fs=FS)
REFUSED = [
    ({"reference": X[:, None]}, ValueError, "reference must have its channels first"),
    (
        {"reference": np.stack([X, X]), "plant": PLANT_AND_PRIMARY, "disturbance": None},
        ValueError,
        "must have the 1 ch",
    ),
    ({"reference": None}, ValueError, "reference must be the signal of the reference microphone, got None"),
    ({"reference": Recording(X, 8000)}, ValueError, "reference is sampled at 8000 Hz but fs is 16000 Hz; read it with"),
    ({"disturbance": Recording(D, 8000)}, ValueError, "disturbance is sampled at 8000 Hz but fs is 16000 Hz"),
    ({"disturbance": D[:-1]}, ValueError, r"disturbance must be .* = \(1, 300\), got \(1, 299\)"),
    ({"plant": PLANT_AND_PRIMARY}, ValueError, "gives the disturbance, and so does disturbance=: give one of them"),
    ({"disturbance": None}, ValueError, "make the plant with a primary path, or give disturbance="),
    ({"plant": S}, TypeError, "plant must be a Plant, got ndarray"),
    (
        {"plant": Plant(S, fs=FS, sensor_noise_std=0.1)},
        TypeError,
        r"the plant has sensor noise \(sensor_noise_std=0.1\): give rng=, a seed or a numpy.random.Generator",
    ),
    ({"switch_on_s": 300 / FS}, ValueError, "switch_on_s must be less than the signal's"),
    ({"record_weights_every": 0.5}, TypeError, "record_weights_every must be a whole number"),
]


@pytest.mark.parametrize(("wrong", "kind", "message"), REFUSED, ids=[message[:40] for _, _, message in REFUSED])
def test_refused_with_nothing_changed(wrong, kind, message):
    made = MAKERS["KF-OPC"]()
    simulate(made, X, PLANT, disturbance=D)
    before = copy.deepcopy(made)
    run = {"reference": X, "plant": PLANT, "disturbance": D, "switch_on_s": 0.001} | wrong  # refused before it listens
    with pytest.raises(kind, match=message):
        simulate(made, **run)
    assert_goes_on_as(made, before)


@pytest.mark.parametrize(
    "wrong", [None, 3.0, fx_lms, Integrator, np.sin], ids=["None", "number", "function", "class", "ufunc"]
)
def test_refuses_what_is_no_controller(wrong):
    with pytest.raises(TypeError, match=r"controller must have control_signal\(reference\) and update\(error\)"):
        simulate(wrong, X, PLANT, disturbance=D)


def test_refuses_what_a_users_controller_cannot_do():
    with pytest.raises(ValueError, match="switch_on_s needs a controller with a method listen"):
        simulate(Integrator(), X, PLANT, disturbance=D, switch_on_s=0.001)
    with pytest.raises(ValueError, match="record_weights_every needs a controller with an attribute weights"):
        simulate(Integrator(), X, PLANT, disturbance=D, record_weights_every=1)


@pytest.mark.parametrize("returned", [None, "loud", [1.0, 2.0]])
def test_refuses_what_is_no_sample(returned):
    class Wrong(Integrator):
        def control_signal(self, reference):
            return returned

    with pytest.raises(TypeError, match="control_signal must return one number, got"):
        simulate(Wrong(), X, PLANT, disturbance=D)
    with pytest.raises(TypeError, match="amplifier must return one number, got"):
        simulate(Integrator(), X, Plant(S, amplifier=lambda y: returned, fs=FS), disturbance=D)


@pytest.mark.parametrize("name", MAKERS)
def test_refuses_an_amplifier_that_returns_nan(name):
    made = MAKERS[name]()
    with pytest.raises(ValueError, match=r"amplifier must return a finite number, got nan for 0\.0"):
        simulate(made, X, Plant(S, amplifier=lambda y: np.nan, fs=FS), disturbance=D)
    assert np.all(np.isfinite(made.weights))


def test_errors_of_a_users_controller_pass_with_the_sample_named():
    class Failing(Integrator):
        def update(self, error):
            raise KeyError("mine")

    with pytest.raises(KeyError, match="mine") as caught:
        simulate(Failing(), X, PLANT, disturbance=D)
    assert caught.value.__notes__ == ["in sample 0 of the run"]


# ---- Silence, and updates without a solution


@pytest.mark.parametrize("heard", [0, 40])
@pytest.mark.parametrize("name", ["KF-ANC", "KF-OPC"])
def test_without_measurement_noise_silence_corrects_nothing(name, heard):
    x = np.where(np.arange(X.size) < heard, X, 0.0)
    path = [0.5, 0.9, -0.4]  # x' ends two samples after x, and leaves the row six samples later
    silent_from = 0 if heard == 0 else heard + 2 + 6 - 1
    plant, runs = Plant(path, fs=FS), []
    for how in (lambda controller: controller, Stepwise):
        made = MAKERS[name](path, measurement_noise=0.0)
        runs.append(simulate(how(made), x, plant, disturbance=D, record_weights_every=1))
        assert np.all(runs[-1].weights[silent_from:] == runs[-1].weights[max(silent_from - 1, 0)])
        assert np.all(np.isfinite(simulate(made, X, plant, disturbance=D).error))  # it goes on
    assert_same_run(*runs)


def test_an_estimator_that_refuses_a_silent_row_names_the_sample():
    x = np.where(np.arange(X.size) < 40, X, 0.0)
    plant = Plant([0.5, 0.9, -0.4], fs=FS)
    made = KalmanController(KFOPC.random_walk(6, state_noise=1e-6, measurement_noise=0.0), plant)
    with pytest.raises(ValueError, match=r"silent reference .* tells nothing: give R > 0") as caught:
        simulate(made, x, plant, disturbance=D)
    assert caught.value.__notes__ == [f"in sample {40 + 2 + 6 - 1} of the run"]
    made.estimator.R = 0.01  # with the cure it goes on
    assert np.all(np.isfinite(simulate(made, X, plant, disturbance=D).error))


def test_without_any_noise_a_tone_is_cancelled_and_nothing_overflows():
    """r = q = 0: after the first samples of a tone P is singular on x', and S is rounding."""
    x = np.cos(0.3 * np.arange(400))
    made = MAKERS["KF-ANC"]([1.0], state_noise=0.0, measurement_noise=0.0)
    result = simulate(made, x, Plant([1.0], [1.0], fs=FS))
    assert np.max(np.abs(result.error[10:])) < 1e-3
    np.testing.assert_array_equal(made.covariance, made.covariance.T)


@pytest.mark.parametrize(("fading", "rated_power"), [(1.0, 0.2), (1.01, None)])
@pytest.mark.parametrize("how", [lambda controller: controller, Stepwise], ids=["compiled", "stepwise"])
def test_a_covariance_that_could_overflow_is_refused_with_nothing_changed(fading, rated_power, how):
    """At sample 50, with a downdate pending: what the controller has is what 50 samples left."""
    x = np.zeros(X.size)
    x[48], x[50] = 1e-3, 1e24
    quiet = np.zeros(X.size)  # the weights stay 0, or the control signal would diverge first
    plant, settings = Plant([1.0, 0.5], fs=FS), kalman_settings(1e3, 1e6, 1e270, fading)
    made, before = (
        KalmanInCore("Kalman", "kalman", 6, plant, settings=settings, rated_power=rated_power) for _ in range(2)
    )
    with pytest.raises(
        ValueError, match=r"the covariance P is too large: .* could overflow; nothing was changed"
    ) as caught:
        simulate(how(made), x, plant, disturbance=quiet)
    assert caught.value.__notes__ == ["in sample 50 of the run"]
    simulate(before, x[:50], plant, disturbance=quiet[:50])
    before.control_signal(x[50])
    np.testing.assert_array_equal(made.covariance, before.covariance)
    np.testing.assert_array_equal(made.weights, before.weights)
    assert made.disturbance_power == before.disturbance_power
