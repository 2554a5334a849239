"""Study: how soon KF-PB is at the bound again after the plant, the noise or a microphone has changed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kfopc_filterpy import Plant, kf_opc, kf_pb, mov_fx_lms, output_power, power_constrained_wiener, simulate
from kfopc_filterpy.controllers.kf_pb import BLOCK_S, DEFAULT_AVERAGING_S
from kfopc_filterpy.metrics import overshoot
from kfopc_filterpy.signals import band_limited_noise

from ..bench import Claim, Parameter, Runs, StudyReport, Table
from ..bench.changes import CHANGES
from ..bench.scene import reachable_weights
from .report_parts import report_of_rows

Convert = Callable[[float, int], float]  # a reading, at a sample, to what is delivered

FS, N_TAPS, RATED = 16000.0, 160, 2.1
SECONDARY = np.array([0.0, 0.0, 0.0, 1.0, -0.8])  # a loudspeaker that is weak at low frequencies
PLANT = Plant(SECONDARY, np.eye(60)[40], fs=FS)
BAND_HZ = (100.0, 2000.0)
SENSOR_NOISE = 0.01
AFTER_S = 10.0  # that are judged after an event
DELAYS = (0.0, 0.25, 0.5, 0.75)  # of an event, in blocks of KF-PB
SEED = 1
EVENTS: dict[str, tuple[str, float, dict[str, float]]] = {  # by name: what changes, when in s, settings of KF-PB
    "nothing": ("nothing", 8.0, {}),
    "start without a silent run": ("nothing", 0.0, {}),
    "start, ample power": ("nothing", 0.0, {"rated_power": 20.0}),
    **{f"primary path's sign at {t:g} s": ("primary path's sign", t, {}) for t in (0.4, 1.0, 8.0)},
    **{f"secondary path's sign at {t:g} s": ("secondary path's sign", t, {}) for t in (0.4, 1.0, 8.0)},
    **{f"secondary path late at {t:g} s": ("secondary path 2 samples late", t, {}) for t in (0.4, 8.0)},
    **{
        what: (what, at_s, {})
        for what, at_s in {
            "primary path 5 samples late": 8.0,
            "secondary path 6 dB louder": 8.0,
            "secondary path 6 dB softer": 8.0,
            "noise 12 dB softer": 12.0,
            "noise 12 dB louder": 12.0,
            "reference dead for 10 s": 8.0,
            "another noise, 30 dB louder, for 1 s": 8.0,
            "a reference sample of 1e4": 8.0,
            "soft past, 1e-3": 6.0,
            "soft past, 1e-6": 6.0,
            "fades in over 4 s from 1e-4": 6.0,
            "drift of 2 % of a sample a second": 4.0,
            "drift of 20 % of a sample a second": 4.0,
            "seams of a recording": 3.7,
            "microphone clips at 0.1": 0.0,
            "microphone clips at 0.5": 0.0,
        }.items()
    },
    "averaging_s=600, sign at 30 s": ("primary path's sign", 30.0, {"averaging_s": 600.0}),
    "averaging_s=1, sign at 8 s": ("primary path's sign", 8.0, {"averaging_s": 1.0}),
    "48 kHz, seams": ("seams of a recording", 3.7, {"fs": 48000.0}),
}


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
    limit: float  # at which the error microphone clips
    settings: dict[str, Any]  # of KF-PB


class Converted:
    """A controller that gets the error, or the error and the reference, through a converter."""

    def __init__(self, controller: Any, convert: Convert, *, both: bool = False) -> None:
        self.controller, self.convert, self.both, self.n = controller, convert, both, 0

    def control_signal(self, reference: float) -> float:
        """Return the controller's control signal."""
        y: float = self.controller.control_signal(self.convert(reference, self.n) if self.both else reference)
        return y

    def update(self, error: float) -> None:
        """Let the controller adapt to what the microphone delivers."""
        self.controller.update(self.convert(error, self.n))
        self.n += 1


def clipping(limit: float) -> Convert:
    """Return a converter that clips."""
    return lambda reading, n: min(max(reading, -limit), limit)


CONVERTERS: dict[str, Convert] = {  # of a noise whose rms is 1
    "none": lambda reading, n: reading,
    "clips at 2": clipping(2.0),
    "clips at 1": clipping(1.0),
    "clips at 0.5": clipping(0.5),
    "12 bits, full scale 4": lambda reading, n: round(reading * 512.0) / 512.0,
    "offset of 0.1": lambda reading, n: reading + 0.1,
    "one block of 32 in 100 is lost": lambda reading, n: 0.0 if n // 32 % 100 == 99 else reading,
}
# With a measurement noise down to 1e-3, or steps from 3e-4 to 3e-3, the first line differs by 0.2 dB at most.
CONVERTED: dict[str, Callable[[], Any]] = {
    "KF-PB": lambda: kf_pb(N_TAPS, SECONDARY, rated_power=RATED, fs=FS),
    "KF-OPC": lambda: kf_opc(
        N_TAPS, SECONDARY, rated_power=RATED, fs=FS, state_noise=1e-9, measurement_noise=0.1, initial_variance=0.1
    ),
    "MOV-FxLMS": lambda: mov_fx_lms(N_TAPS, SECONDARY, rated_power=RATED, fs=FS, step_size=1e-3),
}
CONVERTED_S = 5  # of a run, of which the last second counts


def converter_line(converter: str) -> list[str | float]:
    """Return each algorithm's noise reduction in dB and its power over the rated one, behind a converter."""
    n, last = round(CONVERTED_S * FS), slice(-round(FS), None)
    x = band_limited_noise(BAND_HZ, CONVERTED_S, fs=FS, rng=SEED)
    d = PLANT.disturbance(x) + SENSOR_NOISE * np.random.default_rng(SEED + 1).standard_normal(n)
    line: list[str | float] = [converter]
    for make in CONVERTED.values():
        run = simulate(Converted(make(), CONVERTERS[converter], both=True), x, Plant(SECONDARY, fs=FS), disturbance=d)
        reduced = 10 * np.log10(np.mean(d[last] ** 2) / np.mean(run.error[last] ** 2))
        line += [round(float(reduced), 1) + 0.0, round(output_power(run.control_signal[last]) / RATED, 2)]
    return line


def converter_table(runs: Runs) -> Table:
    """Return what a converter of both microphones does to algorithms that keep a rated power."""
    headings = [word for name in CONVERTED for word in (f"{name} (dB)", "power")]
    caption = "What a converter does: noise reduction after some seconds, and output power over the rated one"
    return Table("converters", caption, ["converter", *headings], list(runs.map(converter_line, CONVERTERS)))


@dataclass(frozen=True)
class EventRow:
    """What KF-PB did after an event: the worst figures of all delays."""

    event: str
    alarms: int
    lost_db: list[float]  # of each second, noise reduction less than that of the bound of this second
    loudest_second_db: float  # from the event on: error over disturbance
    loudest_tenth_db: float  # of any 100 ms
    power: float  # largest over any averaging time, over the rated one


def event(name: str, delay: float = 0.0) -> Event:
    """Return a run of the plant of the README, with an event that is delayed by a part of a block of KF-PB."""
    what, at_s, own = EVENTS[name]
    change, settings = CHANGES[what], {"fs": FS, "rated_power": RATED} | own
    fs = settings["fs"]
    at_s += delay * BLOCK_S
    at, end = round(at_s * fs), round((at_s + change.lasting_s) * fs)
    n = end + round(AFTER_S * fs)
    x = change.noise(band_limited_noise(BAND_HZ, n / fs, fs=fs, rng=SEED), at, fs)
    d = change.disturbance(PLANT.disturbance(x), at, fs)
    d = d + SENSOR_NOISE * np.random.default_rng(SEED + 1).standard_normal(n)
    plant = change.plant(Plant(SECONDARY, fs=fs), at_s)
    return Event(name, change.reference(x, at, fs), d, plant, at, end, x, change.limit, settings)


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
            rated_power=event.settings["rated_power"],
        )
    error: np.ndarray = bound.per_second.error
    return error


def played(event: Event, controller: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the error and the control signal of a run, from the first sample on."""
    heard = controller if event.limit == np.inf else Converted(controller, clipping(event.limit))
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
        overshoot(y, event.settings["rated_power"], event.plant.fs, window_s=averaging_s),
    )


def event_row(name: str, delays: Sequence[float] = DELAYS) -> EventRow:
    """Run KF-PB through an event with each delay, or at the start of the run, and return its worst figures."""
    rows = []
    for delay in delays if EVENTS[name][1] > 0 else (0.0,):
        own = event(name, delay)
        controller = kf_pb(N_TAPS, SECONDARY, **own.settings)
        rows.append(judge(own, *played(own, controller), controller.alarms))
    return EventRow(
        name,
        max(row.alarms for row in rows),
        [max(lost) for lost in zip(*(row.lost_db for row in rows), strict=True)],
        max(row.loudest_second_db for row in rows),
        max(row.loudest_tenth_db for row in rows),
        max(row.power for row in rows),
    )


def planned_runs() -> int:
    """Return the number of events and converters."""
    return len(EVENTS) + len(CONVERTERS)


def main(runs: Runs) -> StudyReport:
    """Run KF-PB through all events."""
    rows = list(runs.map(event_row, list(EVENTS)))
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
            "without control; the largest power over any averaging time, over the rated one. Each figure is the worst of four "
            "noises, with which the event begins in different parts of a block of KF-PB; events at the start are run once."
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
        tables=[Table("events", "KF-PB after a change", headings, lines), converter_table(runs)],
    )
