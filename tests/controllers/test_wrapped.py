"""Wrappers pass on what is assigned to them, and settings that are assigned count like those at the beginning."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from helpers.simulation import Integrator

from kfopc_filterpy import (
    KalmanController,
    LimitedController,
    OutputLimiter,
    Plant,
    diagonal_kf,
    fx_lms,
    kf_anc,
    kf_opc,
    kf_pb,
    mov_fx_lms,
    optimal_leaky_fx_lms,
    simulate,
)
from kfopc_filterpy.controllers import FeedbackNeutralizer
from kfopc_filterpy.paths import PathTolerance

FS = 16000.0
PATH = np.array([0.0, 1.0, 0.4, 0.0])
PATHS = np.array([[PATH, 0.3 * PATH], [0.2 * np.roll(PATH, 1), PATH]])
KALMAN: dict[str, Any] = {"state_noise": 1e-8, "measurement_noise": 1e-3}
X = np.random.default_rng(0).standard_normal(2000)

RATED: dict[str, Any] = {
    "KF-OPC": lambda power: kf_opc(8, PATH, rated_power=power, fs=FS, **KALMAN),
    "KF-PB": lambda power: kf_pb(8, PATH, rated_power=power, fs=FS),
    "diagonal": lambda power: diagonal_kf(8, PATH, rated_power=power, fs=FS, **KALMAN),
    "MOV": lambda power: mov_fx_lms(8, PATH, step_size=1e-3, rated_power=power, fs=FS),
    "optimal leaky": lambda power: optimal_leaky_fx_lms(8, PATH, step_size=1e-3, rated_power=power, fs=FS),
    "KF-OPC, several": lambda power: kf_opc(8, PATHS, rated_power=power, fs=FS, **KALMAN),
    "KF-PB, several": lambda power: kf_pb(8, PATHS, rated_power=power, fs=FS),
    "MOV, several": lambda power: mov_fx_lms(8, PATHS, step_size=1e-4, rated_power=power, fs=FS),
}
WRAPPERS: dict[str, Any] = {
    "neutraliser": lambda inner: FeedbackNeutralizer(inner, [0.0, 0.1]),
    "two neutralisers": lambda inner: FeedbackNeutralizer(FeedbackNeutralizer(inner, [0.0, 0.1]), [0.0, 0.0, 0.1]),
}


def control_signal(controller: Any) -> np.ndarray:
    several = controller.multichannel
    path, x = (PATHS, X[np.newaxis]) if several else (PATH, X)
    d = np.stack([np.roll(X, 3), np.roll(X, 4)]) if several else np.roll(X, 3)
    return np.asarray(simulate(controller, x, Plant(path, fs=FS), disturbance=d).control_signal)


@pytest.mark.parametrize("name", RATED)
def test_a_rated_power_that_is_assigned_counts_like_the_first_one(name: str) -> None:
    power: Any = [0.05, 0.02] if "several" in name else 0.05
    first, changed, made = RATED[name](1.0), RATED[name](1.0), RATED[name](power)
    changed.rated_power = power
    with pytest.raises(ValueError, match="rated_power must be greater than 0"):
        changed.rated_power = -1.0
    np.testing.assert_array_equal(changed.rated_power, power)
    np.testing.assert_array_equal(made.rated_power, power)
    np.testing.assert_array_equal(control_signal(changed), control_signal(made))
    assert not np.array_equal(control_signal(made), control_signal(first))


def test_a_users_filter_gets_its_rated_power_as_a_number() -> None:
    class Rated(KalmanFilter):
        rated_power = 1.0

    controller = KalmanController(Rated(4, 1), PATH)
    for value in (2.0, [3.0]):
        controller.rated_power = value
        assert type(controller.rated_power) is float
    assert controller.rated_power == 3.0


def test_a_controller_without_a_rated_power_takes_none() -> None:
    for controller in (kf_anc(8, PATH, **KALMAN), fx_lms(8, PATH, step_size=1e-3)):
        with pytest.raises(ValueError, match="has no rated power that could be changed; kf_opc"):
            controller.rated_power = 1.0


@pytest.mark.parametrize("name", WRAPPERS)
def test_what_is_assigned_to_a_wrapper_reaches_the_controller(name: str) -> None:
    inner = kf_opc(8, PATH, rated_power=1.0, fs=FS, **KALMAN)
    wrapper, limiter = WRAPPERS[name](inner), OutputLimiter(1e-3, fs=FS)
    wrapper.limiter, wrapper.rated_power = limiter, 0.5
    wrapper.secondary, wrapper.secondary_path_uncertainty = 2.0 * PATH, PathTolerance(gain_db=3.0)
    assert inner.limiter is wrapper.limiter is limiter
    assert inner.rated_power == wrapper.rated_power == 0.5
    np.testing.assert_array_equal(inner.secondary, 2.0 * PATH)
    assert inner.secondary_path_uncertainty == PathTolerance(gain_db=3.0)


@pytest.mark.parametrize("setting", ["limiter", "rated_power", "secondary", "secondary_path_uncertainty"])
def test_a_setting_that_the_controller_lacks_is_not_taken(setting: str) -> None:
    wrapper, own = FeedbackNeutralizer(Integrator(), [0.0, 0.1]), Integrator()
    with pytest.raises(AttributeError, match=f"Integrator has no {setting} that could be assigned"):
        setattr(wrapper, setting, 1.0)
    assert not hasattr(wrapper, setting)
    assert not hasattr(own, setting)


def test_the_limiter_of_a_users_controller_can_be_replaced() -> None:
    controller = FeedbackNeutralizer(LimitedController(Integrator(), OutputLimiter(1.0, fs=FS)), [0.0, 0.1])
    controller.limiter = limiter = OutputLimiter(0.5, fs=16000)
    assert controller.controller.limiter is limiter
    with pytest.raises(TypeError, match="limiter must be an OutputLimiter, got 1"):
        controller.limiter = 1
    assert controller.limiter is limiter
