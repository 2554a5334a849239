"""What `simulate` refuses, with nothing changed; silence, and updates without a solution."""

import copy

import control
import numpy as np
import pytest
from helpers.comparing import assert_goes_on_as, assert_same_run
from helpers.naming import plain
from helpers.simulation import MAKERS, D, Integrator, S, X, constraint

from kfopc_filterpy import KFOPC, FxLMS, KalmanController, simulate
from kfopc_filterpy.controllers import DirectKalman
from kfopc_filterpy.paths import fir_path

REFUSED = [
    ({"reference": X[:, None]}, ValueError, "reference must have its channels first"),
    ({"disturbance": D[:-1]}, ValueError, "disturbance must have 300 values, got 299"),
    ({"primary_path": [1.0]}, ValueError, "either primary_path= or disturbance=, not both"),
    ({"disturbance": None}, ValueError, "either primary_path= or disturbance=.* not neither"),
    ({"secondary_path": []}, ValueError, "secondary_path must have at least 1 value"),
    ({"secondary_path": fir_path(S, 8000.0)}, ValueError, "secondary_path is sampled at 8000 Hz but fs is 16000 Hz"),
    ({"disturbance": None, "primary_path": fir_path(S, 44100.0)}, ValueError, "primary_path is sampled at 44100 Hz"),
    ({"feedback_path": fir_path(S, 8000.0)}, ValueError, "feedback_path is sampled at 8000 Hz"),
    ({"secondary_path": control.TransferFunction([1.0], [1.0, 2.0])}, ValueError, "must be a discrete-time system"),
    ({"feedback_path": [0.1, 0.2]}, ValueError, "feedback_path must have a delay .* first tap is 0.1, not 0"),
    ({"amplifier": 2.0}, TypeError, "amplifier must be a function of a sample, or None, got 2.0"),
    ({"sensor_noise_std": 0.1}, TypeError, "rng must be a seed or a numpy.random.Generator"),
    ({"switch_on_s": 300 / 16000}, ValueError, "switch_on_s must leave samples to control"),
    ({"record_weights_every": 0.5}, TypeError, "record_weights_every must be a whole number"),
]


@pytest.mark.parametrize(("wrong", "kind", "message"), REFUSED, ids=[message[:40] for _, _, message in REFUSED])
def test_refused_with_nothing_changed(wrong, kind, message):
    made = MAKERS["KF-OPC"]()
    simulate(made, X, disturbance=D, secondary_path=S)
    before = copy.deepcopy(made)
    arguments = {"reference": X, "disturbance": D, "secondary_path": S} | wrong
    if "switch_on_s" not in arguments:
        arguments["switch_on_s"] = 0.001  # it must be refused before it listens
    with pytest.raises(kind, match=message):
        simulate(made, arguments.pop("reference"), **arguments)
    assert_goes_on_as(made, before)


@pytest.mark.parametrize("wrong", [None, 3.0, FxLMS, Integrator, object(), np.sin], ids=plain)
def test_refuses_what_is_no_controller(wrong):
    with pytest.raises(TypeError, match=r"controller must have control_signal\(reference\) and update\(error\)"):
        simulate(wrong, X, disturbance=D, secondary_path=S)


def test_refuses_what_a_users_controller_cannot_do():
    with pytest.raises(ValueError, match="switch_on_s needs a controller with a method listen"):
        simulate(Integrator(), X, disturbance=D, secondary_path=S, switch_on_s=0.001)
    with pytest.raises(ValueError, match="record_weights_every needs a controller with an attribute weights"):
        simulate(Integrator(), X, disturbance=D, secondary_path=S, record_weights_every=1)


@pytest.mark.parametrize("returned", [None, "loud", [1.0, 2.0]])
def test_refuses_what_is_no_sample(returned):
    class Wrong(Integrator):
        def control_signal(self, reference):
            return returned

    with pytest.raises(TypeError, match="control_signal must return one number, got"):
        simulate(Wrong(), X, disturbance=D, secondary_path=S)
    with pytest.raises(TypeError, match="amplifier must return one number, got"):
        simulate(Integrator(), X, disturbance=D, secondary_path=S, amplifier=lambda y: returned)


@pytest.mark.parametrize("name", MAKERS)
def test_refuses_an_amplifier_that_returns_nan(name):
    made = MAKERS[name]()
    with pytest.raises(ValueError, match=r"amplifier must return a finite number, got nan for 0\.0"):
        simulate(made, X, disturbance=D, secondary_path=S, amplifier=lambda y: np.nan)
    assert np.all(np.isfinite(made.weights))


def test_errors_of_a_users_controller_pass_with_the_sample_named():
    class Failing(Integrator):
        def update(self, error):
            raise KeyError("mine")

    with pytest.raises(KeyError, match="mine") as caught:
        simulate(Failing(), X, disturbance=D, secondary_path=S)
    assert caught.value.__notes__ == ["in sample 0 of the run"]


@pytest.mark.parametrize("name", MAKERS)
def test_refuses_a_controller_made_for_another_sample_rate(name):
    run = {"reference": X, "disturbance": D, "secondary_path": S}
    with pytest.raises(ValueError, match="fs is 16000 Hz but the controller's secondary path is for 8000 Hz"):
        simulate(MAKERS[name](fir_path(S, 8000.0)), **run)
    simulate(MAKERS[name](fir_path(S, 16000.0)), **run)
    if name in ("KF-ANC", "FxLMS"):  # they know no seconds
        simulate(MAKERS[name](), **run, fs=8000)
        return
    with pytest.raises(ValueError, match="fs is 16000 Hz but the controller's power memory is for 8000 Hz"):
        simulate(MAKERS[name](constraint=constraint(fs=8000)), **run)
    simulate(MAKERS[name](constraint=constraint(fs=8000)), **run, fs=8000)


# ---- Silence, and updates without a solution


@pytest.mark.parametrize("name", MAKERS)
def test_a_silent_reference_leaves_everything_alone(name):
    made, run = MAKERS[name](), {"disturbance": D, "secondary_path": S, "record_powers": True}
    result = simulate(made, np.zeros(X.size), **run)
    np.testing.assert_array_equal(result.control_signal, 0.0)
    np.testing.assert_array_equal(result.error, D)
    np.testing.assert_array_equal(result.constraint_factor, 1.0)  # no gain known: alpha = 1
    assert np.all(np.isnan(result.secondary_path_gain))
    np.testing.assert_array_equal(made.weights, 0.0)


def test_noise_that_has_not_come_through_the_path_yet_does_no_harm():
    """Disturbance and reference from the first sample on, filtered reference zero: G_s = 0 and alpha = 0."""
    late = np.concatenate([np.zeros(5), [1.0]])
    for name in ("KF-OPC", "MOV-FxLMS"):
        result = simulate(MAKERS[name](late), X, disturbance=D + 1.0, secondary_path=late, record_powers=True)
        assert result.diverged_at_s is None
        np.testing.assert_array_equal(result.secondary_path_gain[:5], 0.0)
        np.testing.assert_array_equal(result.constraint_factor[:5], 0.0)
        assert np.all(np.isfinite(result.error))


@pytest.mark.parametrize("heard", [0, 40])
@pytest.mark.parametrize("name", ["KF-ANC", "KF-OPC"])
def test_without_measurement_noise_silence_corrects_nothing(name, heard):
    x = np.where(np.arange(X.size) < heard, X, 0.0)
    path = [0.5, 0.9, -0.4]  # x' ends two samples after x, and leaves the row six samples later
    silent_from = 0 if heard == 0 else heard + 2 + 6 - 1
    runs = []
    for compiled in (True, False):
        made = MAKERS[name](path, measurement_noise=0.0)
        options = {"disturbance": D, "secondary_path": path, "compiled": compiled, "record_weights_every": 1}
        runs.append(simulate(made, x, **options))
        assert np.all(runs[-1].weights[silent_from:] == runs[-1].weights[max(silent_from - 1, 0)])
        assert np.all(np.isfinite(simulate(made, X, disturbance=D, secondary_path=path).error))  # it goes on
    assert_same_run(*runs)


def test_an_estimator_that_refuses_a_silent_row_names_the_sample():
    x = np.where(np.arange(X.size) < 40, X, 0.0)
    path = [0.5, 0.9, -0.4]
    made = KalmanController(KFOPC.random_walk(6, state_noise=1e-6, measurement_noise=0.0), path)
    with pytest.raises(ValueError, match=r"silent reference .* tells nothing: give R > 0") as caught:
        simulate(made, x, disturbance=D, secondary_path=path)
    assert caught.value.__notes__ == [f"in sample {40 + 2 + 6 - 1} of the run"]
    made.estimator.R = 0.01  # with the cure it goes on
    assert np.all(np.isfinite(simulate(made, X, disturbance=D, secondary_path=path).error))


def test_without_any_noise_a_tone_is_cancelled_and_nothing_overflows():
    """r = q = 0: after the first samples of a tone P is singular on x', and S is rounding."""
    x = np.cos(0.3 * np.arange(400))
    made = MAKERS["KF-ANC"]([1.0], state_noise=0.0, measurement_noise=0.0)
    result = simulate(made, x, disturbance=x, secondary_path=[1.0])
    assert np.max(np.abs(result.error[10:])) < 1e-3
    np.testing.assert_array_equal(made.covariance, made.covariance.T)


@pytest.mark.parametrize(("fading", "rated_power"), [(1.0, 0.2), (1.01, None)])
@pytest.mark.parametrize("compiled", [True, False])
def test_a_covariance_that_could_overflow_is_refused_with_nothing_changed(fading, rated_power, compiled):
    """At sample 50, with a downdate pending: what the controller has is what 50 samples left."""
    x = np.zeros(X.size)
    x[48], x[50] = 1e-3, 1e24
    quiet = np.zeros(X.size)  # the weights stay 0, or the control signal would diverge first
    settings = {"state_noise": 1e3, "measurement_noise": 1e6, "initial_variance": 1e270, "fading": fading}
    made, before = (DirectKalman(6, [1.0, 0.5], rated_power=rated_power, **settings) for _ in range(2))
    with pytest.raises(
        ValueError, match=r"the covariance P is too large: .* could overflow; nothing was changed"
    ) as caught:
        simulate(made, x, disturbance=quiet, secondary_path=[1.0, 0.5], compiled=compiled)
    assert caught.value.__notes__ == ["in sample 50 of the run"]
    simulate(before, x[:50], disturbance=quiet[:50], secondary_path=[1.0, 0.5])
    before.control_signal(x[50])
    np.testing.assert_array_equal(made.covariance, before.covariance)
    np.testing.assert_array_equal(made.weights, before.weights)
    assert made.disturbance_power == before.disturbance_power
