"""The start of KF-OPC and MOV-FxLMS in a duct, at a time at which the constraint acts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from kfopc_filterpy import SimulationResult

from ..bench import Claim, Scene, Table, Tuned, make_controller
from .cases import FS
from .report_parts import first_second_db

TIME_WINDOW_S = 0.02  # of the times to a common level, which are shorter than 50 ms would resolve


@dataclass(frozen=True)
class Start:
    """The second after the control is switched on, at a time at which the constraint acts throughout that second.

    Noise reductions and powers are over that second, the powers over the rated power. Times are those at which the NSE
    first comes within 1 dB of the lesser of the two steady reductions: a level that both reach.
    """

    at_s: float
    noise_reduction_db: Mapping[str, float]
    power: Mapping[str, float]
    equal_power: float  # of KF-OPC with another rated power, chosen so that it puts out as much as MOV-FxLMS
    equal_power_db: float
    time_s: float  # of KF-OPC
    mov_time_s: float
    equal_time_s: float  # of KF-OPC with equal power, to the level that it has in common with MOV-FxLMS there
    mov_equal_time_s: float


def first_second_below_one(factor: np.ndarray, fs: float) -> int | None:
    """Return the first whole second in which the constraint factor is below 1 throughout; None if there is none."""
    second = int(fs)
    seconds = factor[: factor.size // second * second].reshape(-1, second)
    below = np.flatnonzero(seconds.max(axis=1) < 1.0)
    return int(below[0]) if below.size else None


def start_under_constraint(scene: Scene, tuned: Mapping[str, Tuned], factor: np.ndarray) -> Start | None:
    """Return what happens if the control is switched on where the constraint acts; None if it never does for a second.

    A constraint factor of 1 makes KF-OPC the same as KF-ANC, so a start with it says nothing about the constraint.
    """
    at_s = first_second_below_one(factor, scene.fs)
    if at_s is None:
        return None
    switch_on_s = scene.switch_on_s + at_s
    end = int((switch_on_s + 1.0) * scene.fs)
    second = replace(
        scene,
        references=[x[:end] for x in scene.references],
        disturbances=[d[:end] for d in scene.disturbances],
        switch_on_s=switch_on_s,
    )

    def run(algorithm: str, rated_power: float = scene.rated_power) -> SimulationResult:
        # The settings are in the units of the whole noise.
        whole = replace(scene, rated_power=rated_power)
        return second.run(make_controller(whole, algorithm, tuned[algorithm].setting))

    results = {algorithm: run(algorithm) for algorithm in ("KF-OPC", "MOV-FxLMS")}
    power = {algorithm: float(np.mean(r.control_signal**2)) for algorithm, r in results.items()}
    # KF-OPC's power is proportional to its rated power as long as the factor is below 1.
    equal = run("KF-OPC", scene.rated_power * power["MOV-FxLMS"] / power["KF-OPC"])
    time, mov_time = times_to_a_common_level(results["KF-OPC"], results["MOV-FxLMS"])
    equal_time, mov_equal_time = times_to_a_common_level(equal, results["MOV-FxLMS"])
    return Start(
        at_s=float(at_s),
        noise_reduction_db={algorithm: first_second_db(r) for algorithm, r in results.items()},
        power={algorithm: own / scene.rated_power for algorithm, own in power.items()},
        equal_power=float(np.mean(equal.control_signal**2)) / scene.rated_power,
        equal_power_db=first_second_db(equal),
        time_s=time,
        mov_time_s=mov_time,
        equal_time_s=equal_time,
        mov_equal_time_s=mov_equal_time,
    )


def times_to_a_common_level(one: SimulationResult, other: SimulationResult) -> tuple[float, float]:
    """Return when the NSE of each first comes within 1 dB of the lesser of their steady noise reductions, in seconds."""
    level = 1.0 - min(r.noise_reduction_db for r in (one, other))

    def first(result: SimulationResult) -> float:
        below = result.nse_db(TIME_WINDOW_S) <= level
        return float(np.argmax(below)) / FS if below.any() else np.inf

    return first(one), first(other)


def faster_claims(start: Start | None) -> list[Claim]:
    """Return the claims about the start: KF-OPC is sooner as it is, and with as much power as MOV-FxLMS."""
    text = "Time of KF-OPC to a common level less that of MOV-FxLMS, after a start where the constraint acts (s)"
    if start is None:  # without the constraint KF-OPC is KF-ANC
        return [Claim(text, np.nan, at_most=0.0, note="not tested: the constraint acts throughout no second")]
    return [
        Claim(text, start.time_s - start.mov_time_s, at_most=0.0, note=f"a start at {start.at_s:g} s"),
        Claim("The same with equal output power", start.equal_time_s - start.mov_equal_time_s, at_most=0.0),
    ]


def start_table(start: Start | None) -> list[Table]:
    """Return the times and the first second after the start."""
    if start is None:
        return []
    caption = f"A start at {start.at_s:g} s: time to a common level, and the first second"
    names = ("KF-OPC", "MOV-FxLMS")
    times = {"KF-OPC": start.time_s, "MOV-FxLMS": start.mov_time_s}
    rows: list[list[str | float]] = [
        [name, 1e3 * times[name], start.power[name], start.noise_reduction_db[name]] for name in names
    ]
    equal = [1e3 * start.equal_time_s, start.equal_power, start.equal_power_db]
    return [
        Table(
            "start",
            caption,
            ["algorithm", "time (ms)", "power over the rated one", "noise reduction (dB)"],
            [
                *rows,
                ["KF-OPC, equal power", *equal],
                ["MOV-FxLMS, to the level of that", 1e3 * start.mov_equal_time_s, "", ""],
            ],
        )
    ]
