"""`simulate`: what it records, users' own controllers and amplifiers, divergence as a result."""

import math
import sys

import numpy as np
import pytest
from helpers.comparing import SIGNALS
from helpers.simulation import FS, MAKERS, PLANT, D, Integrator, S, Stepwise, X, noises

from kfopc_filterpy import HardClipAmplifier, KalmanController, Plant, SoftSaturationAmplifier, simulate
from kfopc_filterpy.controllers import CoreController
from kfopc_filterpy.filters import RandomWalkKFOPC

# ---- What is recorded


def test_the_result():
    x, d = X.copy(), D.copy()
    result = simulate(MAKERS["KF-OPC"](), x, PLANT, disturbance=d)
    x[:], d[:] = 0.0, 0.0  # the result is no view of what was given
    np.testing.assert_array_equal(result.reference, X)
    np.testing.assert_array_equal(result.disturbance, D)
    np.testing.assert_array_equal(result.error, D - result.anti_noise)
    np.testing.assert_allclose(result.anti_noise, np.convolve(result.amplifier_output, S)[: X.size], atol=1e-14)
    assert (result.algorithm, result.rated_power, result.diverged_at_s) == ("KF-OPC", 0.2, None)
    assert result.weights is result.weights_time_s is None  # not asked for


@pytest.mark.parametrize("every", [1, 2, 7, 299, 300, 1000])
def test_weights_are_recorded_after_samples_0_k_2k(every):
    whole, result = (simulate(MAKERS["KF-OPC"](), X, PLANT, disturbance=D, record_weights_every=k) for k in (1, every))
    np.testing.assert_array_equal(result.weights, whole.weights[::every])
    np.testing.assert_array_equal(result.weights_time_s, whole.time_s[::every])
    np.testing.assert_array_equal(result.error, whole.error)


def test_sensor_noise_is_in_the_error_alone():
    noisy = Plant(S, fs=FS, sensor_noise_std=0.3)
    result, again = (
        simulate(MAKERS["FxLMS"](), X, noisy, disturbance=D, rng=rng) for rng in (8, np.random.default_rng(8))
    )
    noise = result.error - (result.disturbance - result.anti_noise)
    np.testing.assert_allclose(noise, 0.3 * np.random.default_rng(8).standard_normal(X.size), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(result.disturbance, D)
    np.testing.assert_array_equal(result.error, again.error)


def calls_of_python(function):
    """Return how many Python functions are called within a call."""
    count = 0

    def profile(frame, event, argument):
        nonlocal count
        count += event == "call"

    sys.setprofile(profile)
    try:
        function()
    finally:
        sys.setprofile(None)
    return count


def test_built_in_controllers_do_run_compiled():
    x, d = noises(20_000)
    for make in MAKERS.values():
        for amplifier in (None, HardClipAmplifier(1.0), SoftSaturationAmplifier(1.0)):
            made, plant = make(), Plant(S, amplifier=amplifier, fs=FS)
            calls = calls_of_python(lambda: simulate(made, x, plant, disturbance=d, progress=lambda n: None))  # noqa: B023
            assert calls < x.size / 10
    assert calls_of_python(lambda: simulate(Stepwise(make()), X, PLANT, disturbance=D)) > X.size


# ---- Users' own parts


def test_a_users_own_controller_plugs_in():
    result = simulate(Integrator(), X, Plant([1.0], [0.7], fs=FS))
    gain, expected = 0.0, []
    for x in X:
        expected.append((0.7 - gain) * x)
        gain += 0.05 * expected[-1] * x
    np.testing.assert_allclose(result.error, expected, rtol=0, atol=1e-14)
    assert (result.algorithm, result.rated_power) == ("Integrator", None)
    assert np.all(np.isnan(result.constraint_factor))  # it does not say
    assert result.disturbance_power is result.secondary_path_gain is result.power_weight is None


def test_a_users_own_controller_may_say_more():
    class Talkative(Integrator):
        name, rated_power, constraint_factor, disturbance_power, secondary_path_gain = "mine", 4.0, 0.5, 2.0, None

        @property
        def weights(self):
            return [[self.gain], [-self.gain]]  # (2, 1), as filterpy's x

        def listen(self, references, errors):
            self.heard = references.copy(), errors.copy()

    made = Talkative()
    result = simulate(made, X, Plant([1.0], [0.7], fs=FS), switch_on_s=100 / FS, record_weights_every=10)
    np.testing.assert_array_equal(made.heard, (X[:100], 0.7 * X[:100]))
    assert (result.algorithm, result.rated_power, result.error.size) == ("mine", 4.0, 200)
    assert result.weights.shape == (20, 2)
    np.testing.assert_array_equal(result.weights[:, 0], -result.weights[:, 1])
    assert {*result.constraint_factor, *result.disturbance_power} == {0.5, 2.0}
    assert np.all(np.isnan(result.secondary_path_gain))


@pytest.mark.parametrize("name", MAKERS)
def test_a_users_own_amplifier(name):
    result = simulate(MAKERS[name](), X, Plant(S, amplifier=math.tanh, fs=FS), disturbance=D)
    np.testing.assert_array_equal(result.amplifier_output, [math.tanh(y) for y in result.control_signal])


@pytest.mark.parametrize("family", [CoreController, KalmanController, RandomWalkKFOPC])
def test_a_subclass_is_asked_not_its_parent(family):
    """What a user's subclass overrides is called: the compiled loop knows the built-in equations only."""
    calls = []

    class Mine(family):
        def update(self, *arguments, **keywords):
            calls.append(arguments)
            super().update(*arguments, **keywords)

    def made(kind):
        if family is CoreController:
            return kind("FxLMS", "fxlms", 6, S, settings={"step_size": 0.01})
        controller, estimator = (kind, RandomWalkKFOPC) if family is KalmanController else (KalmanController, kind)
        return controller(estimator(6, state_noise=1e-6, measurement_noise=0.01), S)

    result, of_parent = (simulate(made(kind), X, PLANT, disturbance=D) for kind in (Mine, family))
    assert len(calls) == X.size
    np.testing.assert_array_equal(result.error, of_parent.error)


# ---- Divergence is a result


@pytest.mark.parametrize("how", [lambda controller: controller, Stepwise], ids=["compiled", "stepwise"])
@pytest.mark.parametrize("name", MAKERS)
def test_divergence_is_a_result(name, how):
    x, d = noises(3000)
    options = {"step_size": 1.0} if "LMS" in name else {"state_noise": 1e-2}
    made = MAKERS[name](-S, **options)  # the wrong sign: the loop feeds back positively
    if name == "KF-OPC":
        made.constraint.factor = 1.0  # left to eq. 13 it does not diverge, see test_controllers
    result = simulate(how(made), x, PLANT, disturbance=d, record_weights_every=10)
    end = round(result.diverged_at_s * FS)
    assert 0 < end < 3000
    for signal in SIGNALS:
        last = -(-end // 10) if signal == "weights" else end
        assert np.all(np.isfinite(getattr(result, signal)[:last])), signal
        assert np.all(np.isnan(getattr(result, signal)[last:])), signal
    np.testing.assert_array_equal(result.disturbance, d)  # what was given stays
    # It goes on from where it is: no exception either.
    assert simulate(how(made), x, PLANT, disturbance=d).diverged_at_s is not None


@pytest.mark.parametrize("how", [lambda controller: controller, Stepwise], ids=["compiled", "stepwise"])
def test_a_step_that_would_overflow_is_refused_and_the_weights_stay(how):
    d = np.where(np.arange(X.size) < 20, 0.0, D)
    made = MAKERS["MOV-FxLMS"](step_size=1e308)
    with pytest.raises(ValueError, match="step of the weights is too large") as refused:
        simulate(how(made), 100 * X, PLANT, disturbance=100 * d)
    assert "in sample 20 of the run" in refused.value.__notes__
    np.testing.assert_array_equal(made.weights, 0.0)


@pytest.mark.parametrize(("rated_power", "end"), [(None, 7), (1e-4, 5), (1e4, 9)])  # 1e6 itself is within
def test_divergence_comes_past_1e6_of_the_rated_amplitude(rated_power, end):
    class Ramp(Integrator):
        def __init__(self):
            super().__init__()
            self.rated_power = rated_power

        def control_signal(self, reference):
            self.gain += 1
            return (-10.0) ** (self.gain - 1)

        def update(self, error):
            pass

    assert simulate(Ramp(), X, PLANT, disturbance=D).diverged_at_s == end / FS


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_users_controller_that_returns_no_number_has_diverged(bad):
    class Broken(Integrator):
        n = 0

        def control_signal(self, reference):
            self.n += 1
            return 0.0 if self.n <= 5 else bad

        def update(self, error):
            assert math.isfinite(error)
            assert self.n <= 5  # not told of a sample that was not played

    result = simulate(Broken(), X, PLANT, disturbance=D)
    assert result.diverged_at_s == 5 / FS
    np.testing.assert_array_equal(np.isnan(result.error), np.arange(X.size) >= 5)
