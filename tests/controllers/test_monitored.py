"""The monitor: control that makes the noise louder is stopped, other control goes on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from kfopc_filterpy import (
    FxLMS,
    OutputLimiter,
    OutputPowerConstraint,
    SimulationResult,
    kf_opc,
    noise_reduction_db,
    simulate,
)
from kfopc_filterpy.controllers import MonitoredController
from kfopc_filterpy.signals import compressor_noise

FS = 4000.0
PATH = np.array([0.0, 0.0, 0.0, 1.0, -0.5, 0.2])
PRIMARY = np.array([0.0] * 8 + [0.8, 0.4])


def made(path: np.ndarray = PATH, **changed: Any) -> Any:
    constraint = OutputPowerConstraint(1.0, fs=FS)
    settings: dict[str, Any] = {"constraint": constraint, "state_noise": 1e-8, "measurement_noise": 1e-3}
    return kf_opc(24, path, **settings | changed)


def run(controller: Any, x: np.ndarray, **changed: Any) -> SimulationResult:
    return simulate(controller, x, **({"primary_path": PRIMARY, "secondary_path": PATH, "fs": FS} | changed))


def white(duration_s: float) -> np.ndarray:
    return np.random.default_rng(0).standard_normal(int(duration_s * FS))


def change_db(result: SimulationResult, begin_s: float, end_s: float) -> float:
    part = slice(int(begin_s * FS), int(end_s * FS))
    return -noise_reduction_db(result.error[part], result.disturbance[part], steady=1.0)


@pytest.mark.parametrize(
    "wrong", [-PATH, np.concatenate([np.zeros(8), PATH])], ids=["flipped sign", "eight samples late"]
)
def test_a_wrong_path_is_noticed_muted_and_tried_again(wrong: np.ndarray) -> None:
    x = white(14.0)
    monitored = MonitoredController(made(wrong), fs=FS)
    result = run(monitored, x)
    louder = [event for event in monitored.health if event.what == "louder"]
    assert len(louder) >= 2  # and a retry between them, which fails again
    assert "retry" in [event.what for event in monitored.health]
    assert all(event.change_db > 0.75 for event in louder)
    assert louder[0].time_s < 2.6
    pauses = np.diff([event.time_s for event in louder])
    assert np.all(pauses > 2.0)
    assert np.all(np.diff(pauses) > 0.0)  # longer each time
    seconds = [change_db(result, k, k + 0.5) for k in np.arange(0.0, 14.0, 0.5)]
    assert np.mean(np.array(seconds) > 0.1) < 0.25  # the tries
    plain = run(made(wrong), x)
    assert change_db(plain, 4.0, 14.0) > 0.5  # without the monitor it stays louder


def test_a_right_path_is_left_alone() -> None:
    """After the silent window the run is that of the controller itself, which listened to that window."""
    x = white(5.0)
    monitored = MonitoredController(made(), fs=FS, window_s=0.25)
    result = run(monitored, x)
    np.testing.assert_array_equal(result.control_signal[: int(0.25 * FS)], 0.0)
    assert monitored.health == []
    silent = int(0.25 * FS)
    listened = run(made(), x, switch_on_s=0.25)
    np.testing.assert_array_equal(result.control_signal[silent:], listened.control_signal)
    with_switch = run(MonitoredController(made(), fs=FS, window_s=0.25), x, switch_on_s=0.25)
    np.testing.assert_array_equal(with_switch.control_signal, listened.control_signal)


@pytest.mark.slow
def test_a_noise_that_swells_or_fluctuates_is_not_blamed_on_the_control() -> None:
    """The reference tells how loud the noise is; what it does not tell, a test does, and the control goes on."""
    x = compressor_noise(10.0, fs=FS, rng=1) * np.repeat([1.0, 10.0], int(5 * FS))
    assert MonitoredController(made(), fs=FS).health == []
    monitored = MonitoredController(made(rated_power=30.0), fs=FS)
    run(monitored, x)
    assert "louder" not in [event.what for event in monitored.health]
    other = np.zeros(int(10 * FS))
    other[int(5 * FS) :] = 3.0 * np.random.default_rng(5).standard_normal(int(5 * FS))  # not heard by the reference
    d = np.convolve(x, PRIMARY)[: x.size] / np.std(x) + other
    suspicious = MonitoredController(made(), fs=FS)
    result = run(suspicious, x / np.std(x), primary_path=None, disturbance=d)
    assert [event.what for event in suspicious.health].count("louder") == 0
    assert "not louder" in [event.what for event in suspicious.health]
    assert np.any(result.control_signal[-int(FS) :])


def test_a_control_signal_that_is_not_finite_is_stopped() -> None:
    class Breaks:
        count = 0

        def control_signal(self, reference: float) -> float:
            self.count += 1
            return np.nan if self.count == 300 else 0.1 * reference

        def update(self, error: float) -> None:
            pass

    monitored = MonitoredController(Breaks(), fs=FS, window_s=0.1, pause_s=0.2)
    result = run(monitored, white(1.0))
    assert np.isfinite(result.control_signal).all()
    assert [event.what for event in monitored.health][:2] == ["not finite", "retry"]
    assert monitored.health[0].time_s == pytest.approx(0.1 + 299 / FS)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200, "0.1", [1.0, 2.0]])
def test_a_bad_sample_is_refused_while_muted_too_and_the_monitor_goes_on(bad: Any) -> None:
    x, d = white(6.0), np.convolve(white(6.0), PRIMARY)[: int(6 * FS)]
    monitored, untouched = (MonitoredController(FxLMS(24, -PATH, step_size=1e-3), fs=FS) for _ in range(2))
    for controller in (monitored, untouched):
        played = np.zeros(PATH.size)
        for n in range(x.size):
            if controller is monitored and n % 500 == 100:
                with pytest.raises((ValueError, TypeError), match="reference must"):
                    controller.control_signal(bad)
            played = np.concatenate(([controller.control_signal(float(x[n]))], played[:-1]))
            if controller is monitored and n % 500 == 100:
                with pytest.raises((ValueError, TypeError), match="error must"):
                    controller.update(bad)
            controller.update(float(d[n] - PATH @ played))
    assert repr(monitored.health) == repr(untouched.health)
    assert "louder" in [event.what for event in monitored.health]


@pytest.mark.slow
def test_a_noise_that_comes_and_goes_is_no_reason_to_doubt_the_control() -> None:
    """Silent windows tell nothing: the margin stays, and so does the control."""
    x = white(10.0)
    on = np.arange(x.size) // 2000 % 2 == 1
    d = np.convolve(x * on, PRIMARY)[: x.size] + 0.01 * x[::-1]
    monitored = MonitoredController(made(), fs=FS)
    result = run(monitored, x * on, primary_path=None, disturbance=d)
    assert monitored.health == []
    assert monitored.margin_db == 1.5
    assert noise_reduction_db(result.error, result.disturbance) > 3.0


@pytest.mark.slow
def test_the_margin_has_a_limit() -> None:
    rng = np.random.default_rng(3)
    d = rng.standard_normal(int(40 * FS)) * np.repeat(10.0 ** rng.uniform(0.0, 2.0, 80), int(0.5 * FS))
    monitored = MonitoredController(made(), fs=FS)
    run(monitored, white(40.0), primary_path=None, disturbance=d)  # the reference knows nothing of the noise
    assert len(monitored.health) > 6
    assert monitored.margin_db <= 12.0


def test_a_margin_that_is_never_reached_is_taken() -> None:
    monitored = MonitoredController(made(-PATH), fs=FS, margin_db=1e4)
    run(monitored, white(3.0))
    assert monitored.health == []


def test_what_was_assigned_survives_a_failure_and_no_window_exceeds_the_limiter() -> None:
    limiter = OutputLimiter(0.05, fs=FS, window_s=2.0)
    controller = FxLMS(24, -PATH, step_size=1e-2, limiter=limiter)
    monitored = MonitoredController(controller, fs=FS, window_s=0.1, pause_s=0.1)
    result = run(monitored, white(10.0))
    assert [event.what for event in monitored.health].count("louder") > 2
    assert monitored.limiter is limiter
    power = np.convolve(result.control_signal**2, np.full(int(2 * FS), 0.5 / FS))
    assert power.max() <= 0.05 * (1 + 1e-9)
    rated = MonitoredController(made(-PATH), fs=FS)
    rated.rated_power = 0.1
    run(rated, white(3.0))
    assert "louder" in [event.what for event in rated.health]
    assert rated.controller.rated_power == 0.1


def test_it_may_listen_during_a_pause_without_ending_it() -> None:
    monitored = MonitoredController(made(-PATH), fs=FS)
    run(monitored, white(2.5))
    assert monitored.muted
    x = white(1.0)
    monitored.listen(x, np.convolve(x, PRIMARY)[: x.size])
    assert monitored.muted


def test_several_channels() -> None:
    paths = np.stack([[PATH, 0.3 * PATH], [0.2 * PATH, PATH]])
    primary = np.stack([PRIMARY, 0.7 * PRIMARY])[:, np.newaxis]
    x = white(6.0)[np.newaxis]
    options: dict[str, Any] = {"primary_path": primary, "secondary_path": paths, "fs": FS}
    right = MonitoredController(made(paths), fs=FS)
    result = simulate(right, x, **options)
    assert right.health == []
    assert noise_reduction_db(result.error, result.disturbance) > 3.0
    wrong = MonitoredController(made(-paths), fs=FS)
    simulate(wrong, x, **options)
    assert "louder" in [event.what for event in wrong.health]


def test_what_is_refused() -> None:
    with pytest.raises(TypeError, match="controller must have"):
        MonitoredController(1.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="margin_db must not be negative"):
        MonitoredController(made(), margin_db=-1.0)
    with pytest.raises(ValueError, match="pause_s"):
        MonitoredController(made(), pause_s=0.0)
    with pytest.raises(ValueError, match="make it with the fs of the run"):
        run(MonitoredController(FxLMS(4, PATH, step_size=1e-3), fs=8000.0), white(0.1))
