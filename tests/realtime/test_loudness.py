"""Louder than before control: what is taken for it, how soon it is noticed, and what is not taken for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import loadmat
from scipy.signal import resample_poly

from comparisons.bench import noises
from kfopc_filterpy import OutputLimiter, OutputPowerConstraint, Plant, fx_lms, fx_nlms, kf_opc, kf_pb, signals
from kfopc_filterpy.commands.run import summarize
from kfopc_filterpy.controllers import VirtualMicrophones, with_internal_model
from kfopc_filterpy.realtime import SimulatedInterface, Supervisor, run
from kfopc_filterpy.realtime.loudness import Loudness

# ---- The comparison

RATIO = 10**0.2
STEADY = np.ones((4, 2))


def heard(silence: np.ndarray, ratio: float = RATIO) -> Loudness:
    """Return what has heard windows of two samples, with powers (n, 2) of reference and error, in silence."""
    loudness = Loudness(2, 4, ratio)
    for x, e in np.sqrt(silence):
        assert loudness.hear(np.array([[x, -x]]), np.array([[e, e]]))
        loudness.note_silence()
    loudness.begin()
    return loudness


@given(gain_db=st.floats(-9.9, 200.0), louder_db=st.floats(-100.0, 100.0).filter(lambda db: abs(db - 2.0) > 1e-6))
def test_as_much_is_expected_as_the_reference_tells(gain_db: float, louder_db: float) -> None:
    level, loudness = 10 ** (gain_db / 10), heard(3.0 * STEADY)
    windows = level * np.array([[3.0, 3.0 * 10 ** (louder_db / 10)]] * 4)
    assert loudness.is_louder(windows, RATIO) == (louder_db > 2.0)


def test_a_floor_stays_for_noise_that_the_reference_does_not_hear() -> None:
    loudness = heard(STEADY)
    for level, louder in ((0.1 * RATIO - 1e-6, False), (0.1 * RATIO + 1e-6, True)):
        assert loudness.is_louder(np.array([[1e-9, level]] * 4), RATIO) == louder
    assert not heard(STEADY, np.inf).is_louder(1e9 * STEADY * [0, 1], np.inf)


def test_without_a_reference_the_level_of_the_silence_counts() -> None:
    loudness = heard(STEADY * [0.0, 1.0])
    assert not loudness.is_louder(STEADY * [0.0, RATIO - 1e-6], RATIO)
    assert loudness.is_louder(STEADY * [0.0, RATIO + 1e-6], RATIO)
    assert not Loudness(2, 4, RATIO).is_louder(1e9 * STEADY, RATIO)  # no silence was heard


@pytest.mark.parametrize(("bangs", "louder"), [(1, False), (2, True)])
def test_a_bang_counts_as_twice_the_decibels(bangs: int, louder: bool) -> None:
    """(b r^2 + 4 - b) / 4 > r, for r = 10^0.2, from b = 1.55 on."""
    windows = STEADY.copy()
    windows[:bangs, 1] = 1e6
    assert heard(STEADY).is_louder(windows, RATIO) == louder


def test_the_loudest_stretch_of_the_last_silence_counts() -> None:
    loudness = heard(np.array([[1, 1], [1, 1], [1, 3], [1, 3], [1, 3], [1, 3], [1, 1], [1, 1]]))
    np.testing.assert_allclose(np.asarray(loudness.before), [1.0, 3.0])
    for _ in range(4):
        loudness.hear(np.ones((1, 2)), np.ones((1, 2)))
        loudness.note_silence()
    np.testing.assert_allclose(np.asarray(loudness.before), [1.0, 1.0])


# ---- The supervisor

FS, BLOCK = 8000.0, 40
S = np.array([0.0, 0.8, -0.3, 0.1])
PATH = np.concatenate((np.zeros(BLOCK), S))
PRIMARY = np.zeros(60)
PRIMARY[[46, 50, 57]] = 1.0, 0.5, -0.3
SECONDS = 8.0
NOISE = signals.band_limited_noise((100.0, 1500.0), SECONDS, fs=FS, rng=1)
KALMAN: dict[str, Any] = {"state_noise": 1e-7, "measurement_noise": 1e-2, "initial_variance": 1e-2}


def limiter(rated_power: float = 3.0) -> OutputLimiter:
    return OutputLimiter(rated_power, fs=FS, window_s=0.25)


MAKERS: dict[str, Any] = {
    "KF-OPC": lambda path: kf_opc(24, path, constraint=OutputPowerConstraint(3.0, fs=FS), **KALMAN),
    "FxLMS": lambda path: fx_lms(24, path, step_size=1e-3, limiter=limiter()),
}


def controlled(controller: Any, *, x: Any = NOISE, secondary: Any = S, disturbance: Any = None, **changed: Any) -> Any:
    """Return supervisor, errors and disturbances of a run to the end of the noise."""
    plant = Plant(secondary, PRIMARY if disturbance is None else None, fs=FS)
    interface = SimulatedInterface(x, plant, disturbance=disturbance, block=BLOCK, latency=BLOCK)
    supervisor, errors = Supervisor(controller, **{"fs": FS, "amplitude_limit": 20.0} | changed), []
    while (block := interface.read()) is not None:
        errors.append(block.errors[0])
        x = block.references[0] if len(block.references) else None
        interface.write(np.atleast_2d(supervisor.process(x, block.errors[0])))
    e = np.concatenate(errors)
    return supervisor, e, interface.disturbance[0, : e.size]


def times(supervisor: Supervisor, what: str) -> list[float]:
    return [event.time_s for event in supervisor.health.events if event.what == what]


def db(e: np.ndarray, d: np.ndarray, begin_s: float, end_s: float) -> float:
    part = slice(round(begin_s * FS), round(end_s * FS))
    return float(10 * np.log10(np.sum(e[part] ** 2) / np.sum(d[part] ** 2)))


# How soon it is noticed.

WRONG = {"polarity": (-PATH, S)} | {
    f"{n} samples longer": (PATH, np.concatenate((np.zeros(n), S))) for n in (16, 32, 64)
}
LOUDER, BLAMED, CLEARED = (
    "louder than before control",
    "diverged: louder than without control",
    "the noise itself is louder",
)


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("name", MAKERS)
def test_a_controller_whose_path_is_wrong_is_stopped(name: str, wrong: str) -> None:
    """It listens for a second, fades in, and is too loud from then on: noticed a second later. Another second of silence
    shows that it is the control, which is muted for two seconds, then four."""
    estimate, secondary = WRONG[wrong]
    supervisor, e, d = controlled(MAKERS[name](estimate), secondary=secondary)
    louder, blamed = times(supervisor, LOUDER), times(supervisor, BLAMED)
    assert louder[0] == pytest.approx(2.05, abs=0.05)
    assert blamed[0] == pytest.approx(3.15, abs=0.05)
    assert times(supervisor, "muted") == blamed
    assert times(supervisor, "running again")[0] == pytest.approx(blamed[0] + 2.0, abs=0.05)
    assert db(e, d, 1.05, 2.05) > 2.0
    assert db(e, d, louder[0] + 0.1, blamed[0] + 2.0) < 0.1
    assert len(louder) == len(blamed) == len(supervisor.divergence_times_s) == 2
    assert CLEARED not in supervisor.health.counts


def test_a_path_that_became_longer_is_in_the_report_of_a_run() -> None:
    """And three times within ten minutes end it."""
    x = np.tile(NOISE, 3)
    plant = Plant(S, PRIMARY, fs=FS).changed_at(3.0, secondary=np.concatenate((np.zeros(32), S)))
    interface = SimulatedInterface(x, plant, block=BLOCK, latency=BLOCK)
    report = run(
        lambda plant: MAKERS["KF-OPC"](plant.taps), interface, amplitude_limit=20.0, listen_s=1.0, identify_s=2.0
    )
    assert report.health.counts[BLAMED] == report.health.counts[LOUDER] == 3
    assert report.stopped_by == "fault: 3 divergences"
    first, *_, last = (event.time_s for event in report.health.events if event.what == LOUDER)
    assert first == pytest.approx(1.05, abs=0.05)  # it listened before
    told = summarize(report, FS, BLOCK)
    assert "stopped by fault: 3 divergences" in told
    assert f"3 {LOUDER}, 3 {BLAMED}" in told
    assert f"  {last:.2f} s: {LOUDER}\n" in told


# What is no alarm.

LOUD: dict[str, Any] = {
    "steady": lambda: NOISE,
    "swelling": lambda: noises.swelling(NOISE, fs=FS, swing_db=10.0, period_s=3.0),
    "a jump up": lambda: noises.level_jump(NOISE, 3.0, 20.0, fs=FS),
    "a jump down": lambda: noises.level_jump(NOISE, 3.0, -20.0, fs=FS),
    "bursts": lambda: noises.bursty_noise(SECONDS, fs=FS, rng=2),
    "compressor": lambda: signals.compressor_noise(SECONDS, fs=FS, rng=3),
}
SOUND = {
    "KF-OPC": MAKERS["KF-OPC"],
    "FxLMS": lambda path: fx_lms(24, path, step_size=2e-4, limiter=limiter()),  # a larger one is louder than a swell
    "KF-PB": lambda path: kf_pb(24, path, rated_power=3.0, fs=FS, limiter=limiter()),
    "KF-PB, wrong polarity": lambda path: kf_pb(24, -path, rated_power=3.0, fs=FS, limiter=limiter()),
}


@pytest.mark.parametrize("noise", LOUD)
@pytest.mark.parametrize("name", SOUND)
def test_noise_that_changes_by_itself_is_no_alarm(name: str, noise: str) -> None:
    supervisor, e, d = controlled(SOUND[name](PATH), x=LOUD[noise](), amplitude_limit=1e3)
    assert not times(supervisor, LOUDER)
    assert not supervisor.divergence_times_s
    assert db(e, d, 5.0, SECONDS) < -0.3


RECORDED: dict[str, dict[str, Any]] = {
    "motor/Motor.mat": {"fs": 16000.0},
    "compressor/compressor_16kHz.mat": {"fs": 16000.0, "variable": "yr"},
    "tools/drill.wav": {},
}


@pytest.mark.parametrize("noise", RECORDED)
def test_recorded_machines_are_no_alarm(noise: str, shared_data: Path) -> None:
    """On a measured duct, whose gain differs by 40 dB from frequency to frequency."""
    recording = signals.read_recording(shared_data / noise, **RECORDED[noise])
    x = resample_poly(recording.samples, 16000, round(recording.fs))
    primary, secondary = (
        np.concatenate((np.zeros(80), loadmat(shared_data / "author/Path.mat")[p].ravel())) for p in "PS"
    )
    interface = SimulatedInterface(x / np.std(x), Plant(secondary[80:], primary, fs=16000.0), block=80, latency=80)
    supervisor = Supervisor(fx_nlms(128, secondary[:336], step_size=0.02), fs=16000.0, amplitude_limit=1e6)
    while (block := interface.read()) is not None:
        interface.write(supervisor.process(block.references[0], block.errors[0])[np.newaxis])
    assert not times(supervisor, LOUDER)
    assert np.any(supervisor.controller.weights)


@pytest.mark.parametrize("control", ["with a reference that does not hear it", "feedback"])
def test_noise_that_becomes_louder_unheard_by_a_reference_costs_a_silence(control: str) -> None:
    """From 3.5 s on, and twice as loud again from 6 s on. Each time, the same controller goes on afterwards."""
    n, rng = NOISE.size, np.random.default_rng(2)
    own = np.interp(np.arange(n) / FS, [3.5, 3.501, 6.0, 6.001], [0.0, 3.0, 3.0, 6.0]) * rng.standard_normal(n)
    if control == "feedback":
        tone = np.sin(0.2 * np.arange(n)) + 0.1 * rng.standard_normal(n)
        controller: Any = with_internal_model(fx_nlms(24, PATH, step_size=0.02))
        supervisor, e, d = controlled(controller, x=None, disturbance=tone + own)
    else:
        controller = fx_lms(24, PATH, step_size=2e-4)
        supervisor, e, d = controlled(controller, disturbance=np.convolve(NOISE, PRIMARY)[:n] + own)
    assert len(times(supervisor, LOUDER)) == len(times(supervisor, CLEARED)) == 2
    assert times(supervisor, LOUDER)[0] == pytest.approx(4.25, abs=0.26)  # two windows of four are much louder
    assert supervisor.controller is controller
    assert not supervisor.divergence_times_s
    assert db(e, d, 2.0, 3.5) < -3.0


# How it begins.


def test_what_was_heard_before_takes_its_place() -> None:
    """The level, the controller's powers, and faults, whose time is negative."""
    controller = MAKERS["KF-OPC"](-PATH)
    supervisor = Supervisor(controller, fs=FS, amplitude_limit=20.0, window_s=0.05)
    assert repr(supervisor).startswith("<Supervisor of KF-OPC: listening")
    before = np.array([NOISE, 2.0 * NOISE])[:, :8000]
    before[1, 4000] = np.nan
    supervisor.listen(*before)
    assert supervisor.health.events[0].time_s == pytest.approx(-0.5)
    assert controller.disturbance_power > 0.0
    x, e = supervisor._loudness.before  # type: ignore[misc]
    np.testing.assert_allclose(e / x, 4.0, rtol=0.01)
    y = supervisor.process(NOISE[8000:8040], NOISE[8000:8040])
    assert not supervisor.muted
    assert y.shape == (40,)
    with pytest.raises(ValueError, match="what was heard before the first block, but there were blocks already"):
        supervisor.listen(*before)


def test_a_silence_without_usable_samples_tells_nothing() -> None:
    """It goes on listening, and says after a while that it is silent for that reason."""
    supervisor = Supervisor(MAKERS["FxLMS"](PATH), fs=FS, amplitude_limit=20.0, mute_after_s=0.5)
    for _ in range(400):
        assert not np.any(supervisor.process(np.zeros(40), NOISE[:40]))
    assert supervisor.health.counts["silent: no usable input"] == 1
    for first in range(0, 24000, 40):
        y = supervisor.process(NOISE[first : first + 40], NOISE[first : first + 40])
    assert np.any(y)


def test_virtual_microphones_are_not_watched_and_begin_at_once() -> None:
    paths = np.stack((PATH, PATH))[:, np.newaxis]
    ears = VirtualMicrophones(fx_lms(8, paths[1:], step_size=0.01), paths, [[[1.0]]], physical=[0])
    supervisor = Supervisor(ears, fs=FS, amplitude_limit=20.0)
    assert not supervisor.muted
    errors = np.stack((NOISE, NOISE))
    for first in range(0, 32000, 40):
        level = 1.0 if first < 16000 else 10.0
        supervisor.process(NOISE[np.newaxis, first : first + 40], level * errors[:, first : first + 40])
    assert not supervisor.health.counts.keys() & {LOUDER, CLEARED, BLAMED}
