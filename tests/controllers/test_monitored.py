"""The monitor: control that makes the noise louder is stopped, other control goes on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from kfopc_filterpy import FxLMS, SimulationResult, kf_pb, noise_reduction_db, simulate
from kfopc_filterpy.controllers import MonitoredController
from kfopc_filterpy.signals import compressor_noise

FS = 4000.0
PATH = np.array([0.0, 0.0, 0.0, 1.0, -0.5, 0.2])
PRIMARY = np.array([0.0] * 8 + [0.8, 0.4])


def made(path: np.ndarray = PATH, **changed: Any) -> Any:
    settings: dict[str, Any] = {"rated_power": 1.0, "fs": FS, "state_noise": 1e-8, "measurement_noise": 1e-3}
    return kf_pb(24, path, **settings | changed)


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


def test_several_channels() -> None:
    paths = np.stack([[PATH, 0.3 * PATH], [0.2 * PATH, PATH]])
    primary = np.stack([PRIMARY, 0.7 * PRIMARY])[:, np.newaxis]
    x = white(6.0)[np.newaxis]
    options: dict[str, Any] = {"primary_path": primary, "secondary_path": paths, "fs": FS}
    right = MonitoredController(kf_pb(24, paths, rated_power=1.0, fs=FS), fs=FS)
    result = simulate(right, x, **options)
    assert right.health == []
    assert noise_reduction_db(result.error, result.disturbance) > 3.0
    wrong = MonitoredController(kf_pb(24, -paths, rated_power=1.0, fs=FS), fs=FS)
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
