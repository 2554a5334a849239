"""The runs of the study of the constraint, and what is kept of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kfopc_filterpy import (
    HardClipAmplifier,
    OutputLimiter,
    SimulationResult,
    convergence_time_s,
    noise_reduction_db,
    output_power,
)
from kfopc_filterpy.bench.registry import BUDGETED, make_controller
from kfopc_filterpy.bench.scene import Scene
from kfopc_filterpy.bench.tuning import Tuned
from kfopc_filterpy.metrics import overshoot
from kfopc_filterpy.paths import path_taps, perturbed_path
from kfopc_filterpy.plot.style import decibels

from .constraint_cases import FS, SWITCH_ON_S, Setting, bound_of, make_case, with_jump

SHARES = (0.25, 0.10)  # rated power over the unconstrained control power
LIMITED = ("KF-OPC", "KF-PB")  # also run behind the limiter
WINDOW_S = 0.1
JUMPS_DB = (20.0, -20.0)
JUMP_S = (6.0, 7.0)  # of a run of JUMP_RUN_S, from switch-on on
JUMP_RUN_S = 12.0
LONGEST_KEPT_S = 10.0  # a run whose signals are kept for its convergence time
BACK_S = 2.0  # after which all is to be as without the jump


@dataclass(frozen=True)
class Row:
    """One run of a case: noise reduction in dB, output power and its largest over 100 ms, both over the rated one."""

    setting: Setting
    share: float
    duration_s: float
    seed: int
    algorithm: str
    noise_reduction_db: float
    power: float
    worst_window: float
    bound_db: float  # over the record for a stationary noise, of each second for another
    scaled_db: float  # what scaling the Wiener control filter reaches

    @property
    def loss_db(self) -> float:
        """Noise reduction below the bound."""
        return self.bound_db - self.noise_reduction_db


def with_rated_power(scene: Scene, share: float) -> Scene:
    """The scene, whose unconstrained control power is 1, with a rated power."""
    return replace(scene, rated_power=share)


def _controller(
    scene: Scene, algorithm: str, tuned: Mapping[str, Tuned], *, limited: bool = False, amplifier: Any = None
) -> Any:
    """A fresh controller; KF-ANC has the setting of KF-OPC."""
    setting = tuned["KF-OPC" if algorithm == "KF-ANC" else algorithm].setting
    controller = make_controller(scene, algorithm, setting, amplifier=amplifier)
    if limited:
        controller.limiter = OutputLimiter(scene.rated_power, fs=FS, window_s=WINDOW_S)
    return controller


def run_case(
    scene: Scene, setting: Setting, duration_s: float, seed: int, tuned: Mapping[str, Tuned]
) -> tuple[list[Row], dict[str, tuple[np.ndarray, np.ndarray]]]:
    """All algorithms on one noise, with each rated power; and where it is short, what `convergence_times` needs."""
    rows: list[Row] = []
    kept: dict[str, SimulationResult] = {}
    for share in SHARES:
        rated = with_rated_power(scene, share)
        anc, opc = rated.run_together([_controller(rated, name, tuned) for name in ("KF-ANC", "KF-OPC")])
        results = {"KF-OPC": opc}
        results |= {name: rated.run(_controller(rated, name, tuned)) for name in BUDGETED}
        results |= {f"{name} limited": rated.run(_controller(rated, name, tuned, limited=True)) for name in LIMITED}
        bound = bound_of(rated)
        reached = bound.noise_reduction_over(0.5 * bound.whole.end_s)
        limit, scaled = (
            reached[name]
            for name in (("whole", "scaled") if setting.stationary else ("per_second", "scaled_per_second"))
        )
        for name, result in results.items():
            measured = (
                noise_reduction_db(result.error, result.disturbance),
                output_power(result.control_signal) / rated.rated_power,
                overshoot(result.control_signal, rated.rated_power, FS, window_s=WINDOW_S),
            )
            rows.append(Row(setting, share, duration_s, seed, name, *measured, bound_db=limit, scaled_db=scaled))
        if duration_s <= LONGEST_KEPT_S and not kept:  # longer ones would fill the memory
            kept = {"KF-ANC": anc, "KF-PB": results["KF-PB"]}
    return rows, {name: (result.error, result.disturbance) for name, result in kept.items()}


def convergence_times(
    kept: Sequence[dict[str, tuple[np.ndarray, np.ndarray]]],
) -> dict[str, float | None]:
    """Convergence times in seconds of the runs that `run_case` kept, the NSE over 50 ms pooled over seeds."""
    times: dict[str, float | None] = {}
    for name in ("KF-ANC", "KF-PB"):
        errors, disturbances = (np.array([one[name][i] for one in kept]) for i in (0, 1))
        times[name] = convergence_time_s(errors, disturbances, FS, window_s=0.05, runs=True)
    return times


@dataclass(frozen=True)
class Jump:
    """What a second of another level leaves behind, against the same run without it."""

    setting: Setting
    share: float
    jump_db: float
    loss_db: float  # noise reduction without the jump minus that with it, over 0.5 s from BACK_S after it on
    weight_db: float  # lambda with the jump over that without, there
    power_in_jump: float  # over the rated power
    worst_window_limited: float
    time_s: np.ndarray
    power_weight: np.ndarray


def run_jumps(
    pair: tuple[np.ndarray, np.ndarray], noise: Any, setting: Setting, tuned: Mapping[str, Tuned]
) -> list[Jump]:
    """KF-PB through a second that is 20 dB louder or softer."""
    steady = noise(JUMP_RUN_S + SWITCH_ON_S, 1)
    scene = make_case(pair, steady)
    jumps = []
    for share in SHARES:
        rated = with_rated_power(scene, share)
        without = rated.run(_controller(rated, "KF-PB", tuned), record_powers=True)
        for gain_db in JUMPS_DB:
            begin, end = (t + SWITCH_ON_S for t in JUMP_S)
            x = with_jump(rated.references[0], gain_db, begin, end)
            d = np.convolve(x, pair[0])[: x.size]
            jumped = replace(rated, references=[x], disturbances=[d])
            result = jumped.run(_controller(rated, "KF-PB", tuned), record_powers=True)
            limited = jumped.run(_controller(rated, "KF-PB", tuned, limited=True))
            after = slice(round((JUMP_S[1] + BACK_S) * FS), round((JUMP_S[1] + BACK_S + 0.5) * FS))
            within = slice(round(JUMP_S[0] * FS), round(JUMP_S[1] * FS))
            jumps.append(
                Jump(
                    setting,
                    share,
                    gain_db,
                    _reduction(without, after) - _reduction(result, after),
                    _decibels(_mean_weight(result, after), _mean_weight(without, after)),
                    float(np.mean(result.control_signal[within] ** 2)) / rated.rated_power,
                    overshoot(limited.control_signal, rated.rated_power, FS, window_s=WINDOW_S),
                    result.time_s[:: round(FS / 100)],
                    _weights(result)[:: round(FS / 100)],
                )
            )
    return jumps


def _weights(result: SimulationResult) -> np.ndarray:
    assert result.power_weight is not None
    return result.power_weight


def _mean_weight(result: SimulationResult, part: slice) -> float:
    return float(np.mean(_weights(result)[part]))


def _decibels(one: float, other: float) -> float:
    """Ratio in dB, 0 where both are 0."""
    return float(decibels(one) - decibels(other))


def _reduction(result: SimulationResult, part: slice) -> float:
    return noise_reduction_db(result.error[part], result.disturbance[part], steady=1.0)


@dataclass(frozen=True)
class Clipped:
    """A run with an amplifier that clips at the peak of a sine of rated power."""

    setting: Setting
    algorithm: str
    known: str  # how the estimate of the disturbance knows the amplifier
    noise_reduction_db: float
    power: float
    worst_window: float
    diverged_at_s: float | None


def run_amplifiers(scene: Scene, setting: Setting, tuned: Mapping[str, Tuned]) -> list[Clipped]:
    """Kalman controllers with an amplifier that clips: unknown to the disturbance estimate, known, and known wrongly."""
    rated = with_rated_power(scene, SHARES[0])
    limit = rated.amplitude_limit
    known = {
        "unknown": None,
        "known": HardClipAmplifier(limit),
        "limit 20 % too high": HardClipAmplifier(1.2 * limit),
        "limit 20 % too low": HardClipAmplifier(0.8 * limit),
    }
    rows = []
    for algorithm in ("KF-ANC", "KF-OPC", "KF-PB"):
        for name, model in known.items():
            controller = _controller(rated, algorithm, tuned, amplifier=model)
            rows.append(_clipped(rated, setting, algorithm, name, controller, limit))
    wrong = replace(rated, secondary=path_taps(perturbed_path(rated.secondary, fs=FS, gain_db=6.0, phase_deg=45.0)))
    for algorithm in LIMITED:
        controller = _controller(wrong, algorithm, tuned, limited=True)
        rows.append(_clipped(rated, setting, f"{algorithm} limited", "path 6 dB, 45° off", controller, limit))
    return rows


def _clipped(scene: Scene, setting: Setting, algorithm: str, known: str, controller: Any, limit: float) -> Clipped:
    result = replace(scene, amplifier=HardClipAmplifier(limit)).run(controller)
    y = result.control_signal
    if result.diverged_at_s is not None:
        return Clipped(setting, algorithm, known, np.nan, np.nan, np.nan, result.diverged_at_s)
    reduction = noise_reduction_db(result.error, result.disturbance)
    worst = overshoot(y, scene.rated_power, FS, window_s=WINDOW_S)
    return Clipped(setting, algorithm, known, reduction, output_power(y) / scene.rated_power, worst, None)


@dataclass(frozen=True)
class Course:
    """Runs of a noise that swells, for the figures of what happens over time."""

    setting: Setting
    rated_power: float
    results: dict[str, SimulationResult]


def run_course(scene: Scene, setting: Setting, tuned: Mapping[str, Tuned]) -> Course:
    """KF-OPC, KF-PB and KF-PB behind the limiter over half a minute."""
    rated = with_rated_power(scene, SHARES[0])
    results = {
        name: rated.run(_controller(rated, name, tuned), record_powers=True)
        for name in ("KF-OPC", "KF-OPC repaired", "KF-PB")
    }
    limited = rated.run(_controller(rated, "KF-PB", tuned, limited=True))
    return Course(setting, rated.rated_power, results | {"KF-PB limited": limited})
