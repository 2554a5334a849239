"""A run in real time, on a simulated plant and on a sound card that is replaced."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from kfopc_filterpy import Plant, fx_lms, suggest_settings
from kfopc_filterpy.bounds import predictor_reference
from kfopc_filterpy.controllers import with_internal_model
from kfopc_filterpy.realtime import (
    Block,
    FaultError,
    IdentifiedPlant,
    Interface,
    NotCausalError,
    RunStatus,
    SimulatedInterface,
    SoundDevice,
    run,
    running,
)

FS = 8000.0
S = np.array([0.0, 0.8, -0.3])
PRIMARY = np.zeros(90)
PRIMARY[[70, 75, 82]] = 1.0, 0.5, -0.3
X = np.random.default_rng(5).standard_normal(round(8 * FS))


def plant(**changed: Any) -> Recorded:
    primary = None if "disturbance" in changed else PRIMARY
    return Recorded(X, Plant(S, primary, fs=FS), **{"block": 32, "latency": 64} | changed)


class Recorded(SimulatedInterface):
    """A simulated plant that remembers what was heard and played."""

    def __init__(self, *signals: Any, **settings: Any) -> None:
        super().__init__(*signals, **settings)
        self.heard: list[Any] = []
        self.played: list[Any] = []

    @property
    def path(self) -> np.ndarray:
        """Secondary path of one channel with the delay of the interface."""
        return np.concatenate((np.zeros(self.latency), S))

    def read(self) -> Block | None:
        block = super().read()
        self.heard.append(block)
        return block

    def write(self, control_signals: Any) -> None:
        self.played.append(np.array(control_signals))
        super().write(control_signals)


def started(interface: Interface, step_size: float = 2e-3, **changed: Any) -> Any:
    settings = {"amplitude_limit": 8.0, "listen_s": 0.5, "identify_s": 1.5, "fade_s": 0.02}
    return run(lambda path: fx_lms(24, path.taps, step_size=step_size), interface, **settings | changed)


def test_a_run_identifies_fades_in_reduces_and_fades_out() -> None:
    reports: list[RunStatus] = []
    interface = plant()
    report = started(interface, seconds=3.0, on_report=reports.append, report_every_s=0.5)
    assert report.stopped_by == "end"
    assert report.round_trip_samples == 65
    assert report.secondary is not None
    # The disturbance is twice as loud as the noise that is played, but the reference explains it.
    np.testing.assert_allclose(report.secondary.taps[64:67], S, atol=1e-3)
    assert report.possible_db > 15.0
    assert report.reduction_db[0] > 10.0
    assert [round(r.seconds, 1) for r in reports] == [0.5, 1.0, 1.5, 2.0, 2.5, 3.0]
    assert reports[-1].reduction_db[0] > reports[0].reduction_db[0] + 3.0
    assert reports[-1].powers.shape == (1,)
    assert report.seconds == pytest.approx(3.0, abs=0.01)
    np.testing.assert_allclose(report.powers, np.sum(lfilter([1.0], [0.8, -0.3], PRIMARY) ** 2), rtol=0.1)
    assert not report.health.counts
    assert not np.any(interface.played[-1])  # silence at the end
    assert report.controller.weights.shape == (24,)


@pytest.mark.parametrize(("several", "white"), [(False, 0.0), (True, 0.05)])
def test_a_run_with_an_internal_model(several: bool, white: float) -> None:
    """A tone that no reference microphone hears can be predicted over the two blocks.

    It is as loud as the noise by which the path is identified. Plain least squares would miss the path by 15 %.
    """
    tone = np.sin(2 * np.pi * 200 * np.arange(X.size) / FS)
    n_heard = int(several)
    paths, d = S, tone + white * X
    if several:
        paths = np.multiply.outer([[0.9, 0.2], [0.1, 0.8]], [0.0, 1.0, 0.0, 0.0])
        d = np.stack((d, np.roll(d, 5)))
    interface = Recorded(X[np.newaxis] if several else None, Plant(paths, fs=FS), disturbance=d, block=32, latency=64)

    def make(plant: IdentifiedPlant) -> Any:
        if not several:
            best = suggest_settings(
                predictor_reference(plant.errors), Plant(plant.taps, fs=FS), disturbance=plant.errors, n_taps=24
            )
            assert plant.suggested(24).noises == best.noises
        return with_internal_model(
            fx_lms(24, plant.taps, step_size=1e-3, n_references=n_heard + interface.n_microphones)
        )

    limits = [8.0, 8.0] if several else 8.0
    report = run(make, interface, amplitude_limit=limits, seconds=3.0, listen_s=0.5, identify_s=2.0)
    assert report.stopped_by == "end"
    assert report.secondary is not None
    exact = np.zeros_like(report.secondary.taps)
    exact[..., 64 : 64 + np.shape(paths)[-1]] = paths
    assert np.linalg.norm(report.secondary.taps - exact) < 0.02 * np.linalg.norm(exact)
    assert report.possible_db > 15.0
    assert np.all(report.reduction_db > 15.0)
    assert not report.health.counts
    assert not np.any(interface.played[-1][:, -1])


def test_noise_that_can_only_be_predicted_over_a_few_samples_needs_a_faster_plant() -> None:
    noise = lfilter([1.0], [1.0, -0.9], X)
    slow = SimulatedInterface(None, Plant(S, fs=FS), disturbance=noise, block=32, latency=64)
    with pytest.raises(NotCausalError, match="place a reference microphone"):
        run(lambda plant: with_internal_model(fx_lms(24, plant.taps, step_size=1e-3)), slow, amplitude_limit=40.0)


def test_a_plant_that_is_not_causal_is_refused_with_the_way_out() -> None:
    with pytest.raises(NotCausalError, match=r"it takes 193 samples .* Use shorter blocks, or place a reference"):
        started(plant(block=64, latency=192))
    tone = np.sin(2 * np.pi * 200 * np.arange(X.size) / FS)  # can be predicted: not refused
    report = started(SimulatedInterface(tone, Plant(S, PRIMARY, fs=FS), block=64, latency=192), seconds=1.0, n_path=200)
    assert report.possible_db > 10.0
    report = started(plant(block=64, latency=192), seconds=0.5, check_causality=False)
    assert np.isnan(report.possible_db)
    known = fx_lms(24, plant(block=64, latency=192).path, step_size=1e-4)
    report = run(known, plant(block=64, latency=192), amplitude_limit=8.0, seconds=0.1, listen_s=0.05)
    assert np.isnan(report.possible_db)  # 400 samples of silence are too few to tell


def test_simulated_noise_may_repeat_itself_from_block_to_block() -> None:
    periodic = np.tile(np.random.default_rng(2).standard_normal(32), 500)
    interface = Recorded(periodic, Plant(S, PRIMARY, fs=FS), block=32, latency=64)
    silent = fx_lms(8, interface.path, step_size=1e-12)  # so that the errors repeat themselves too
    report = run(silent, interface, amplitude_limit=1.0, seconds=1.0, listen_s=0.1, check_causality=False)
    assert not report.health.counts


def test_a_loudspeaker_that_is_not_heard_is_a_fault() -> None:
    with pytest.raises(FaultError, match="no loudspeaker is heard by any error microphone"):
        started(SimulatedInterface(X, Plant([0.0, 0.0], PRIMARY, fs=FS), block=32, latency=64))
    with pytest.raises(FaultError, match="ended before anything was heard"):
        started(SimulatedInterface(X[:4000], Plant(S, PRIMARY, fs=FS), block=32, latency=64))


@pytest.mark.parametrize(("samples", "blocks"), [(319, 11), (320, 11), (321, 12)])
def test_a_run_takes_the_blocks_that_its_time_needs(samples: int, blocks: int) -> None:
    controller = fx_lms(24, plant().path, step_size=1e-3)
    settings = {"amplitude_limit": 8.0, "listen_s": 0.5, "fade_s": 32 / FS, "pause_s": 0.1}
    assert run(controller, plant(), seconds=samples / FS, **settings).blocks == blocks  # the last one fades out


class Louder:
    """A controller that plays more and more, into a loudspeaker that is not heard."""

    rated_power, n = 0.5, 0

    def control_signal(self, reference: float) -> float:
        self.n += 1
        return (self.n // 100) * (-1.0) ** self.n

    def update(self, error: float) -> None:
        pass


def watched(blocks: int, **settings: Any) -> tuple[Any, np.ndarray, np.ndarray, float]:
    """Run with blocks of half a second, louder and louder; return report, powers of both, and that before the control."""
    noise = np.random.default_rng(0).choice([-1.0, 1.0], 100 * (blocks + 2)) * np.arange(2, blocks + 4).repeat(100)
    interface = Recorded(2.0 * noise, Plant([0.0], fs=200.0), disturbance=noise, block=100, latency=100)
    plain = {"listen_s": 1.0, "amplitude_limit": 1e6, "fade_s": 1 / 200.0, "window_s": 1e6, "check_causality": False}
    report = run(Louder(), interface, **plain | settings)
    powers = np.array([np.mean(block.errors**2) for block in interface.heard if block is not None])
    played = np.array([np.mean(y**2) for y in interface.played])
    return report, powers[2:], played[2:], np.mean(powers[:2])


@pytest.mark.parametrize(("blocks", "begin", "parts"), [(1, 0, 8), (3, 2, 8), (4, 2, 8), (101, 50, 2048), (101, 48, 8)])
def test_the_report_is_of_the_second_half_of_a_run_of_any_length(
    blocks: int, begin: int, parts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The half is one of seconds, or of 2, 4, 8 s that are joined where there would be too many parts."""
    monkeypatch.setattr(running, "MOST_PARTS", parts)
    report, errors, played, before = watched(blocks)
    assert report.seconds == blocks / 2
    np.testing.assert_allclose(report.powers, np.mean(played[begin:]), rtol=1e-12)
    np.testing.assert_allclose(before / 10 ** (report.reduction_db / 10), np.mean(errors[begin:]), rtol=1e-12)


def test_a_report_has_the_levels_since_the_last_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """And the share of a block of half a second that its processing took."""
    reports: list[RunStatus] = []
    times = itertools.chain([0.0, 0.3], itertools.count(1.0, 0.2))  # before and after each block
    monkeypatch.setattr(running.time, "perf_counter", times.__next__)
    _, errors, played, before = watched(6, report_every_s=1.0, on_report=reports.append)
    assert [status.seconds for status in reports] == [1.0, 2.0, 3.0]
    error, output = (np.mean(powers.reshape(3, 2), axis=1) for powers in (errors, played))
    np.testing.assert_allclose([status.powers[0] for status in reports], output)
    np.testing.assert_allclose([status.reduction_db[0] for status in reports], 10 * np.log10(before / error))
    assert [status.load for status in reports] == pytest.approx([0.6, 0.4, 0.4])
    assert reports[0].rated_power == [0.5]


def test_an_error_in_a_report_is_raised_after_the_loudspeakers_have_faded_out() -> None:
    def fails(status: RunStatus) -> None:
        raise RuntimeError("disk full")

    interface = plant()
    controller = fx_lms(24, interface.path, step_size=2e-3)
    with pytest.raises(RuntimeError, match="disk full"):
        run(controller, interface, amplitude_limit=8.0, seconds=3.0, listen_s=0.5, on_report=fails, fade_s=0.02)
    assert np.any(interface.played[-6])
    assert not np.any(interface.played[-1])


def test_a_run_stops_on_a_fault_when_told_to_and_on_ctrl_c() -> None:
    wrong = fx_lms(24, np.concatenate((np.zeros(64), -S)), step_size=5e-3)
    settings: dict[str, Any] = {"amplitude_limit": 3.0, "listen_s": 0.5, "pause_s": 0.1, "check_causality": False}
    report = run(wrong, plant(), **settings)
    assert report.stopped_by == "fault: 3 divergences"
    assert report.secondary is None
    blocks: list[int] = []

    def enough() -> bool:
        blocks.append(1)
        return len(blocks) == 50

    right = fx_lms(24, plant().path, step_size=1e-3)
    assert run(right, plant(), should_stop=enough, **settings).stopped_by == "user"
    assert len(blocks) == 50

    def interrupted(status: RunStatus) -> None:
        raise KeyboardInterrupt

    assert run(right, plant(), on_report=interrupted, **settings).stopped_by == "user"


def test_channels_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="n_microphones = 2, but the interface has 1"):
        run(fx_lms(8, np.ones((2, 1, 70)), step_size=1e-3), plant(), amplitude_limit=1.0, listen_s=0.1)
    with pytest.raises(ValueError, match="latency must be at least a block"):
        plant(latency=31)
    with pytest.raises(ValueError, match="without a reference give disturbance="):
        SimulatedInterface(None, Plant(S, PRIMARY, fs=FS))


class PortAudioError(Exception):
    """As sounddevice's: no error of Python's own."""


class Card:
    """Stands for sounddevice.Stream: a simulated plant behind the channels of a card, which asks for blocks."""

    def __init__(self, interface: SimulatedInterface) -> None:
        self.interface = interface
        self.fails: Sequence[str] = ()
        self.asked: dict[str, Any] = {}
        self.states: list[str] = []
        self.blocks, self.lost_at, self.dry_at, self.repeated_at = 0, [100], [120, 700, 701], []  # block numbers

    def __call__(self, **asked: Any) -> Card:
        self.asked = asked
        self.enter("open")
        return self

    def enter(self, state: str) -> None:
        if state in self.fails:
            raise PortAudioError(f"Error in {state}: Invalid sample rate")
        self.states.append(state)

    def start(self) -> None:
        self.enter("start")
        self.blocks_before_control = self.blocks

    def ask(self) -> None:
        """Hand over a block and take one, as PortAudio's thread does."""
        block, n = self.interface.read(), self.asked["blocksize"]
        assert block is not None
        self.blocks += 1
        if self.blocks not in self.repeated_at:
            self.heard = np.zeros((n, 4), np.float32)
            self.heard[:, 2], self.heard[:, 3] = 0.1 * block.references[0], 0.1 * block.errors[0]
        played = np.full((n, 2), np.nan, np.float32)
        status = SimpleNamespace(
            input_overflow=self.blocks in self.lost_at, output_underflow=self.blocks in self.dry_at
        )
        self.asked["callback"](self.heard, played, n, None, status)
        assert not np.any(played[:, 0])
        self.interface.write(10.0 * played[:, 1:].T.astype(float))

    def stop(self) -> None:
        self.enter("stop")

    def close(self) -> None:
        self.enter("close")


class PluggedDevice(SoundDevice):
    """A sound card that asks for a block whenever one is read."""

    def __init__(self, card: Card, references: Sequence[int] = (2,), **settings: Any) -> None:
        super().__init__(references, [3], [1], fs=FS, block=32, ahead=1, **settings)
        self.card = card

    def read(self) -> Any:
        self.card.ask()
        return super().read()


@pytest.fixture
def plugged(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Card]:
    """Return what plugs a card in, with settings of the plant behind it."""

    def plug(**changed: Any) -> Card:
        card = Card(plant(**({"latency": 32} | changed)))
        known = {"PortAudioError": PortAudioError, "query_devices": lambda *_: {"default_samplerate": 44100.0}}
        monkeypatch.setitem(sys.modules, "sounddevice", SimpleNamespace(Stream=card, **known))
        return card

    return plug


def test_a_sound_card_is_driven_through_its_stream(plugged: Callable[..., Card]) -> None:
    card = plugged()
    device = PluggedDevice(card, device="duplex")
    assert isinstance(device, Interface)
    report = started(device, step_size=0.2, amplitude_limit=0.8, seconds=2.0)
    assert card.asked["channels"] == (4, 2)
    assert (card.asked["samplerate"], card.asked["blocksize"], card.asked["device"]) == (FS, 32, "duplex")
    assert card.states == ["open", "start", "stop", "close"] * 2
    assert report.reduction_db[0] > 6.0
    assert (device.dry, report.underflows) == (3, 3)
    assert report.lost == 32
    assert report.round_trip_samples == 65
    # Those under control are in the health record: the two blocks follow each other, and are one event.
    assert report.health.samples == {"output underflow": 2 * 32}
    assert report.health.counts == {"output underflow": 1}
    (event,) = report.health.events
    assert event.time_s == pytest.approx((700 - card.blocks_before_control) * 32 / FS)


def test_a_sound_card_needs_no_reference_microphone(plugged: Callable[..., Card]) -> None:
    device = PluggedDevice(plugged(), references=[])
    device.start()
    block = device.read()
    device.stop()
    assert (block.references.shape, block.errors.shape, device.n_references) == ((0, 32), (1, 32), 0)


def test_lost_and_repeated_blocks_of_a_card_are_in_the_health_record(plugged: Callable[..., Card]) -> None:
    card = plugged()
    card.lost_at, card.dry_at, card.repeated_at = [640, 641], [], [680]
    reports: list[RunStatus] = []
    device = PluggedDevice(card)
    report = started(
        device, step_size=0.2, amplitude_limit=0.8, seconds=1.6, on_report=reports.append, report_every_s=0.8
    )
    assert report.health.samples == {"lost": 2 * 32, "repeated": 2 * 32}  # of the reference and of the error
    assert report.lost == reports[-1].lost == 64
    # The time goes on while samples are lost; a report is due after so many that were heard.
    assert [status.seconds for status in reports] == [0.8 + 64 / FS, 1.6 + 64 / FS]
    assert report.seconds == pytest.approx(1.6 + 64 / FS)


@pytest.mark.parametrize(("what", "message"), [("lost_at", "32 samples were lost"), ("dry_at", "the output ran dry")])
def test_no_path_is_identified_across_a_gap(what: str, message: str, plugged: Callable[..., Card]) -> None:
    card = plugged()
    setattr(card, what, [200])
    with pytest.raises(FaultError, match=f"{message}.* while the path was identified"):
        started(PluggedDevice(card), amplitude_limit=0.8)
    assert card.states == ["open", "start", "stop", "close"]


def test_a_block_that_comes_too_late_is_left_out_and_the_next_is_in_time(plugged: Callable[..., Card]) -> None:
    card = plugged()
    played: list[float] = []
    card.interface.write = lambda y: played.append(float(y[0, 0]))  # type: ignore[method-assign]
    device = PluggedDevice(card)
    device.start()
    for sample in range(1, 6):
        if sample != 3:
            card.ask()
        SoundDevice.read(device)
        if sample == 2:
            card.ask()  # again, before anything was written
        device.write(np.full((1, 32), 0.1 * sample))
    card.ask()
    assert np.round(played).tolist() == [0, 1, 0, 3, 4, 5]  # the second would have been played a block too late
    assert device.dry == 1
    device.stop()


@pytest.mark.parametrize(
    ("fails", "states"),
    [
        (["open"], []),
        (["start"], ["open", "stop", "close"]),
        (["start", "stop"], ["open"]),
        (["stop"], ["open", "start"]),
    ],
)
def test_a_card_that_fails_is_one_error_which_names_both_rates(
    plugged: Callable[..., Card], fails: list[str], states: list[str]
) -> None:
    card = plugged()
    card.fails, card.lost_at, card.dry_at = fails, [], []
    message = rf"opened at {FS:g} Hz: Error in {fails[0]}: Invalid .* Its own rate is 44100 Hz.* lists the devices"
    if fails == ["stop"]:
        message = "did not stop as it should: Error in stop"
    with pytest.raises((ValueError, FaultError), match=message):
        started(PluggedDevice(card), amplitude_limit=10.0, seconds=0.5)
    assert card.states == states


def test_a_card_that_is_gone_is_an_error_which_one_of_stopping_does_not_hide(plugged: Callable[..., Card]) -> None:
    plugged().fails = ["stop"]
    device = SoundDevice([2], [3], [1], fs=FS, block=32)
    device.patience_s = 0.01
    with pytest.raises(FaultError, match="no block came from the sound card"):
        run(fx_lms(32, S, step_size=1e-3), device, amplitude_limit=10.0)


def test_without_sounddevice_or_portaudio_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sounddevice", None)
    with pytest.raises(ImportError, match=r"pip install -e .\.\[realtime\]."):
        SoundDevice([0], [1], fs=FS).start()


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        (([0], []), "error_channels must be"),
        (([0], [0]), "must be different inputs"),
        (([0], [1], [-1]), "output_channels must be"),
    ],
)
def test_channels_that_a_card_cannot_have_are_refused(channels: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SoundDevice(*channels, fs=FS)
