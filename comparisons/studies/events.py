"""Study: how soon KF-PB is at the bound again after the plant, the noise or a microphone has changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from kfopc_filterpy import Plant, kf_pb, power_constrained_wiener, simulate
from kfopc_filterpy.controllers.kf_pb import DEFAULT_AVERAGING_S
from kfopc_filterpy.metrics import overshoot
from kfopc_filterpy.signals import band_limited_noise

from ..bench import Claim, Parameter, Runs, StudyReport, Table
from ..bench.noises import level_jump
from ..bench.scene import reachable_weights
from .report_parts import report_of_rows

FS, N_TAPS, RATED = 16000.0, 160, 2.1
SECONDARY = np.array([0.0, 0.0, 0.0, 1.0, -0.8])  # a loudspeaker that is weak at low frequencies
DELAY = 40  # samples of the primary path
BAND_HZ = (100.0, 2000.0)
SENSOR_NOISE = 0.01
AFTER_S = 10.0  # that are judged after an event
SEED = 1


@dataclass(frozen=True)
class Event:
    """A run: what is heard, what becomes of the plant, and what a filter could do that knows all of it."""

    name: str
    reference: np.ndarray  # as the controller hears it
    disturbance: np.ndarray  # with sensor noise
    plant: Plant  # with the secondary path, which may change
    begins: int  # sample of the event
    judged: int  # sample from which on the losses are counted: its end
    sound: np.ndarray  # the reference without faults, of which the bound knows
    limit: float = np.inf  # at which the error microphone clips
    settings: dict[str, Any] = field(default_factory=dict)
    rated_power: float = RATED


class ClippingMicrophone:
    """A controller behind an error microphone that clips."""

    def __init__(self, controller: Any, limit: float) -> None:
        self.controller, self.limit = controller, limit

    def control_signal(self, reference: float) -> float:
        """Return the controller's control signal."""
        y: float = self.controller.control_signal(reference)
        return y

    def update(self, error: float) -> None:
        """Let the controller adapt to what the microphone delivers."""
        self.controller.update(min(max(error, -self.limit), self.limit))


@dataclass(frozen=True)
class EventRow:
    """What KF-PB did after an event."""

    event: str
    alarms: int
    lost_db: list[float]  # of each second, noise reduction less than that of the bound of this second
    loudest_second_db: float  # from the event on: error over disturbance
    loudest_tenth_db: float  # of any 100 ms
    power: float  # largest over any averaging time, over the rated one


def scene(
    name: str,
    before_s: float,
    *,
    primary: Callable[[np.ndarray], np.ndarray] = lambda d: d,
    secondary: np.ndarray | None = None,
    gain: Callable[[np.ndarray], np.ndarray] | None = None,
    heard: Callable[[np.ndarray], np.ndarray] | None = None,
    lasting_s: float = 0.0,
    fs: float = FS,
    drift: float = 0.0,
    **settings: float,
) -> Event:
    """Return an event of the plant of the README. `gain` and `heard` change noise and reference, from the event on."""
    at, end = round(before_s * fs), round((before_s + lasting_s) * fs)
    n = end + round(AFTER_S * fs)
    x = band_limited_noise(BAND_HZ, n / fs, fs=fs, rng=SEED)
    x = x if gain is None else gain(x)
    d = np.concatenate([np.zeros(DELAY), x[: n - DELAY]])
    if drift:  # samples a second
        t = np.arange(n)
        d = np.interp(t - drift * np.maximum(t - at, 0) / fs, t, d)
    d = np.concatenate([d[:at], primary(d)[at:]])
    d += SENSOR_NOISE * np.random.default_rng(SEED + 1).standard_normal(n)
    reference = x if heard is None else heard(x)
    own = {key: settings.pop(key) for key in ("limit", "rated_power") if key in settings}
    plant = Plant(SECONDARY, fs=fs)
    plant = plant if secondary is None else plant.changed_at(before_s, secondary=secondary)
    return Event(name, reference, d, plant, at, end, x, settings=settings, **own)


def _late(d: np.ndarray, taps: int = 5) -> np.ndarray:
    return np.concatenate([np.zeros(taps), d[:-taps]])


def _dead(x: np.ndarray, begin_s: float, end_s: float) -> np.ndarray:
    return np.concatenate(
        [x[: round(begin_s * FS)], np.zeros(round(end_s * FS) - round(begin_s * FS)), x[round(end_s * FS) :]]
    )


def _click(x: np.ndarray, at_s: float, size: float) -> np.ndarray:
    x = x.copy()
    x[round(at_s * FS)] = size * np.sqrt(np.mean(x**2))
    return x


def _soft(x: np.ndarray, until_s: float, level: float, fade_s: float = 0.0) -> np.ndarray:
    t = np.arange(x.size) / FS
    grown = (
        np.interp(t, [until_s - fade_s, until_s], [np.log(level), 0.0])
        if fade_s
        else np.where(t < until_s, np.log(level), 0.0)
    )
    return x * np.exp(grown)


def _seams(x: np.ndarray, each_s: float, fs: float = FS) -> np.ndarray:
    return np.resize(x[: round(each_s * fs)], x.size)


def events() -> dict[str, Callable[[], Event]]:
    """Return how each event is made, by its name."""
    louder = partial(level_jump, fs=FS)
    made = {
        "nothing": partial(scene, before_s=8.0),
        "start without a silent run": partial(scene, before_s=0.0),
        "start, ample power": partial(scene, before_s=0.0, rated_power=20.0),
        **{
            f"primary path's sign at {t:g} s": partial(scene, before_s=t, primary=np.negative)
            for t in (0.4, 0.7, 1.0, 8.0)
        },
        **{
            f"secondary path's sign at {t:g} s": partial(scene, before_s=t, secondary=-SECONDARY)
            for t in (0.4, 1.0, 8.0)
        },
        "primary path 5 samples late": partial(scene, before_s=8.0, primary=_late),
        "secondary path 2 samples late": partial(
            scene, before_s=8.0, secondary=np.concatenate([np.zeros(2), SECONDARY])
        ),
        "secondary path 6 dB louder": partial(scene, before_s=8.0, secondary=2.0 * SECONDARY),
        "secondary path 6 dB softer": partial(scene, before_s=8.0, secondary=0.5 * SECONDARY),
        "noise 12 dB softer": partial(scene, before_s=12.0, gain=lambda x: louder(x, 12.0, -12.0)),
        "noise 12 dB louder": partial(scene, before_s=12.0, gain=lambda x: louder(x, 12.0, 12.0)),
        "averaging_s=600, sign at 30 s": partial(scene, before_s=30.0, primary=np.negative, averaging_s=600.0),
        "averaging_s=1, sign at 8 s": partial(scene, before_s=8.0, primary=np.negative, averaging_s=1.0),
        "reference dead for 10 s": partial(scene, before_s=8.0, lasting_s=10.0, heard=lambda x: _dead(x, 8.0, 18.0)),
        "a reference sample of 1e4": partial(scene, before_s=8.0, heard=lambda x: _click(x, 8.0, 1e4)),
        "soft past, 1e-3": partial(scene, before_s=6.0, gain=lambda x: _soft(x, 6.0, 1e-3)),
        "soft past, 1e-6": partial(scene, before_s=6.0, gain=lambda x: _soft(x, 6.0, 1e-6)),
        "fades in over 4 s from 1e-4": partial(scene, before_s=6.0, gain=lambda x: _soft(x, 6.0, 1e-4, 4.0)),
        "drift of 2 % of a sample a second": partial(scene, before_s=4.0, drift=0.02),
        "drift of 20 % of a sample a second": partial(scene, before_s=4.0, drift=0.2),
        "seams of a recording": partial(scene, before_s=3.7, gain=lambda x: _seams(x, 3.7)),
        "48 kHz": partial(scene, before_s=4.0, fs=48000.0),
        "48 kHz, seams": partial(scene, before_s=3.7, fs=48000.0, gain=lambda x: _seams(x, 3.7, 48000.0)),
        "microphone clips at 0.1": partial(scene, before_s=0.0, limit=0.1),
        "microphone clips at 0.5": partial(scene, before_s=0.0, limit=0.5),
    }
    return {name: partial(make, name) for name, make in made.items()}


def bound_error(event: Event) -> np.ndarray:
    """Return the error of each second's own best filter within the rating, with the plant as it is after the event."""
    fs, n = round(event.plant.fs), event.disturbance.size
    a, past = event.judged, min(event.judged, 4 * N_TAPS)
    part = slice(a - past, a + (n - a) // fs * fs)
    with reachable_weights():
        bound = power_constrained_wiener(
            event.sound[part],
            event.plant.at(n / fs),
            n_taps=N_TAPS,
            disturbance=event.disturbance[part],
            switch_on_s=past / fs,
            rated_power=event.rated_power,
        )
    error: np.ndarray = bound.per_second.error
    return error


def played(event: Event, controller: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the error and the control signal of a run, from the first sample on."""
    heard = controller if event.limit == np.inf else ClippingMicrophone(controller, event.limit)
    run = simulate(heard, event.reference, event.plant, disturbance=event.disturbance)
    return run.error, run.control_signal


def over_seconds(signal: np.ndarray, n: int) -> np.ndarray:
    """Return the energies of whole stretches of n samples."""
    return np.sum(signal[: signal.size // n * n].reshape(-1, n) ** 2, axis=1)


def judge(event: Event, error: np.ndarray, y: np.ndarray, alarms: int) -> EventRow:
    """Return the figures of a run."""
    fs = round(event.plant.fs)
    best = bound_error(event)
    own = error[event.judged : event.judged + best.size]
    lost = 10 * np.log10(over_seconds(own, fs) / over_seconds(best, fs))
    e, d = error[event.begins :], event.disturbance[event.begins :]

    def loudest(window: int) -> float:
        E, D = (np.concatenate([[0.0], np.cumsum(a**2)]) for a in (e, d))
        return float(10 * np.log10(np.max((E[window:] - E[:-window]) / (D[window:] - D[:-window]))))

    averaging_s = min(event.settings.get("averaging_s", DEFAULT_AVERAGING_S), y.size / fs)
    return EventRow(
        event.name,
        alarms,
        [float(v) for v in lost],
        loudest(fs),
        loudest(fs // 10),
        overshoot(y, event.rated_power, event.plant.fs, window_s=averaging_s),
    )


def event_row(name: str) -> EventRow:
    """Run KF-PB through an event."""
    event = events()[name]()
    controller = kf_pb(N_TAPS, SECONDARY, rated_power=event.rated_power, fs=event.plant.fs, **event.settings)
    return judge(event, *played(event, controller), controller.alarms)


def planned_runs() -> int:
    """Return the number of events."""
    return len(events())


def main(runs: Runs) -> StudyReport:
    """Run KF-PB through all events."""
    rows = list(runs.map(event_row, list(events())))
    headings = [
        "event",
        "lost, second 1 (dB)",
        "2",
        "3",
        "4",
        "10",
        "loudest second (dB)",
        "loudest 100 ms",
        "power",
        "alarms",
    ]
    lines: list[list[str | float]] = [
        [
            row.event,
            *(round(level, 1) + 0.0 for level in (*row.lost_db[:4], row.lost_db[-1])),
            *(round(level, 1) + 0.0 for level in (row.loudest_second_db, row.loudest_tenth_db)),
            round(row.power, 2),
            row.alarms,
        ]
        for row in rows
    ]
    return report_of_rows(
        rows,
        name="events",
        title="KF-PB after a change",
        summary=(
            "KF-PB with its default settings, when the plant, the noise or a microphone changes: noise reduction lost to the "
            "bound of each second, for the plant as it is after the change; the loudest second and 100 ms, over the noise "
            "without control; the largest power over any averaging time, over the rated one."
        ),
        parameters={
            "n_taps": Parameter(N_TAPS, "of KF-PB and of the bound"),
            "rated_power": Parameter(RATED, "mean square of the control signal"),
            "sensor_noise": Parameter(SENSOR_NOISE, "rms, of a disturbance of 1"),
            "seed": Parameter(SEED, "of the noise; that of the sensor noise is the next one"),
        },
        claims=[
            Claim(
                "Events that lose at most 1 dB in the third and the fourth second after them",
                float(np.mean([max(row.lost_db[2:4]) <= 1.0 for row in rows])),
                at_least=0.9,
            ),
            Claim("Loudest second of all (dB)", max(row.loudest_second_db for row in rows), at_most=1.0),
            Claim("Loudest 100 ms of all (dB)", max(row.loudest_tenth_db for row in rows), at_most=3.0),
            Claim("Power over any averaging time", max(row.power for row in rows), at_most=1.05),
        ],
        tables=[Table("events", "KF-PB after a change", headings, lines)],
    )
