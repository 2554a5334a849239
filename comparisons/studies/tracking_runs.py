"""The runs of the study of tracking: noises and paths that change, and what is kept of each run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult, convergence_time_s, noise_reduction_db, nse_db, output_power
from kfopc_filterpy.bench.registry import REGISTRY
from kfopc_filterpy.bench.scene import Runs, Scene
from kfopc_filterpy.bench.tuning import Tuned, run_setting, went_through
from kfopc_filterpy.metrics import overshoot, short_time_power
from kfopc_filterpy.paths import Duct, duct_paths, path_taps

from .cases import FS, SEED, SWITCH_ON_S, WORST_WINDOW_S, grids, make_case, noise_of, tune_all
from .constraint_cases import with_jump

ALGORITHMS = ("KF-ANC", "KF-OPC", "KF-PB", "FxRLS", "FxLMS", "MOV-FxLMS", "optimal leaky FxLMS")
OVERDRIVE_DB = 3.0
JUMP_DB = 20.0
JUMP_S = (1.5, 3.0)  # of a run of JUMP_RUN_S, from switch-on on
JUMP_RUN_S = 7.0
CHANGE_S, CHANGE_RUN_S = 2.0, 6.0
DELAY_SAMPLES = 16
OTHER_LENGTH_M = 2.6
CHIRP_HZ, SWEEP_S, SWEEPS = (20.0, 1600.0), 0.25, 16
START_SHARES = (1.0, 0.01)  # of the usual initial variance, to see what a start from little knowledge costs
SEEDS = (SEED, 2, 3)  # the first is tuned on
NSE_WINDOW_S = 0.05
SWEEP_NSE_S = 0.01
POINTS_A_SECOND = 200  # of the curves that are kept

Pair = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Event:
    """What happens in a run: its scene from paths and a seed, and the stretches in which the filter has to settle.

    A stretch ends where the next change comes. Sweeps have none: the noise never comes to rest.
    """

    name: str
    scene: Callable[[Pair, int], Scene]
    stretches: dict[str, tuple[float, float]]
    paths: tuple[str, ...] | None = None  # None: all
    seeds: tuple[int, ...] | None = None  # None: SEEDS
    nse_window_s: float = NSE_WINDOW_S
    shown_window_s: float = NSE_WINDOW_S  # of the NSE in the figure


def events() -> list[Event]:
    """All of them."""
    loud = {"louder": JUMP_S, "back": (JUMP_S[1], JUMP_RUN_S)}
    soft = {"softer": JUMP_S, "back": (JUMP_S[1], JUMP_RUN_S)}
    changed = {"changed": (CHANGE_S, CHANGE_RUN_S)}
    return [
        Event("20 dB louder", lambda pair, seed: jump_scene(pair, seed, JUMP_DB), loud),
        Event("20 dB softer", lambda pair, seed: jump_scene(pair, seed, -JUMP_DB), soft),
        Event("sign", lambda pair, seed: change_scene(pair, seed, -pair[0]), changed),
        Event("delay", lambda pair, seed: change_scene(pair, seed, np.pad(pair[0], (DELAY_SAMPLES, 0))), changed),
        Event("longer duct", lambda pair, seed: change_scene(pair, seed, _longer_duct()), changed, paths=("duct",)),
        Event("one sweep", lambda pair, _: sweep_scene(pair, 1), {}, None, (SEED,), SWEEP_NSE_S, SWEEP_NSE_S),
        Event("sweeps", lambda pair, _: sweep_scene(pair, SWEEPS), {}, None, (SEED,), SWEEP_NSE_S, SWEEP_S),
    ]


def jump_scene(pair: Pair, seed: int, gain_db: float) -> Scene:
    """Band noise that is louder or softer for a while; the rated power is that of its usual level."""
    scene = make_case(pair, noise_of("band noise", JUMP_RUN_S, seed), OVERDRIVE_DB)
    x = with_jump(scene.references[0], gain_db, *(t + SWITCH_ON_S for t in JUMP_S))
    return replace(scene, references=[x], disturbances=[np.convolve(x, pair[0])[: x.size]])


def change_scene(pair: Pair, seed: int, other: np.ndarray) -> Scene:
    """Band noise whose primary path is another from `CHANGE_S` on: what is on its way then arrives by the new one."""
    scene = make_case(pair, noise_of("band noise", CHANGE_RUN_S, seed), OVERDRIVE_DB)
    x, d = scene.references[0], scene.disturbances[0].copy()
    at = round((CHANGE_S + SWITCH_ON_S) * FS)
    d[at:] = np.convolve(x, other)[at : x.size]
    return replace(scene, disturbances=[d])


def sweep_scene(pair: Pair, sweeps: int) -> Scene:
    """Sweeps from a standing start: silence until the control is switched on."""
    silence = np.zeros(round(SWITCH_ON_S * FS))
    return make_case(pair, np.concatenate([silence, np.tile(sweep(CHIRP_HZ, SWEEP_S, FS), sweeps)]), OVERDRIVE_DB)


def sweep(band_hz: tuple[float, float], duration_s: float, fs: float) -> np.ndarray:
    """Sine whose frequency rises linearly from one frequency to another."""
    t = np.arange(round(duration_s * fs)) / fs
    rise = (band_hz[1] - band_hz[0]) / duration_s
    return np.sin(2 * np.pi * (band_hz[0] * t + 0.5 * rise * t**2))


def _longer_duct() -> np.ndarray:
    return path_taps(duct_paths(Duct(length_m=OTHER_LENGTH_M), fs=FS).primary)


@dataclass(frozen=True)
class Row:
    """An algorithm through an event; powers are over the rated one, the steady half comes after all changes."""

    path: str
    event: str
    algorithm: str
    setting: Any
    within_budget: bool
    mean_nse_db: float
    noise_reduction_db: float  # over the whole run
    steady_noise_reduction_db: float
    power: float
    worst_window: float
    settled_s: dict[str, float | None]  # by stretch: from its start until the NSE stays within 3 dB of where it ends
    stretch_worst_window: dict[str, float]
    diverged_at_s: float | None


@dataclass(frozen=True)
class Course:
    """NSE in dB and output power over the rated one, over time, of all seeds together."""

    time_s: np.ndarray
    nse_db: np.ndarray
    power: np.ndarray


def run_event(
    event: Event, path: str, scenes: Sequence[Scene], algorithm: str, best: Tuned | None
) -> tuple[Row, Course | None, SimulationResult | None]:
    """The best setting of an algorithm on every seed; the signals of the first seed are kept for listening."""
    results = [] if best is None else [run_setting(scene, algorithm, best.setting) for scene in scenes]
    kept = [result for result in results if result is not None]
    if best is None or len(kept) < len(scenes):
        nothing: dict[str, float | None] = dict.fromkeys(event.stretches)
        lost = dict.fromkeys(event.stretches, np.nan)
        return Row(path, event.name, algorithm, None, False, *(5 * (np.nan,)), nothing, lost, 0.0), None, None
    e, d, y = (np.array([getattr(r, name) for r in kept]) for name in ("error", "disturbance", "control_signal"))
    at = [r.diverged_at_s for r in kept if r.diverged_at_s is not None]
    rated = scenes[0].rated_power
    parts = {name: slice(*(round(t * FS) for t in span)) for name, span in event.stretches.items()}
    row = Row(
        path,
        event.name,
        algorithm,
        best.setting,
        best.within_budget,
        float(np.nanmean(nse_db(e, d, FS, event.nse_window_s, runs=True))),
        noise_reduction_db(e, d, steady=1.0, runs=True),
        noise_reduction_db(e, d, runs=True),
        output_power(y, runs=True) / rated,
        overshoot(y, rated, FS, window_s=WORST_WINDOW_S, runs=True),
        {name: _settled(e[:, part], d[:, part], event.nse_window_s) for name, part in parts.items()},
        {name: overshoot(y[:, part], rated, FS, window_s=WORST_WINDOW_S, runs=True) for name, part in parts.items()},
        min(at) if at else None,
    )
    return row, _course(e, d, y, rated, event), kept[0]


def _settled(e: np.ndarray, d: np.ndarray, window_s: float) -> float | None:
    time = convergence_time_s(e, d, FS, window_s=window_s, runs=True)
    return None if np.isnan(time) else time


def _course(e: np.ndarray, d: np.ndarray, y: np.ndarray, rated_power: float, event: Event) -> Course:
    every = max(1, round(FS / POINTS_A_SECOND * min(1.0, e.shape[1] / FS)))
    nse = nse_db(e, d, FS, event.shown_window_s, runs=True)
    power = short_time_power(y, FS, min(WORST_WINDOW_S, 0.1 * e.shape[1] / FS), runs=True) / rated_power
    points = np.arange(every - 1, nse.size, every)
    return Course((points + 1) / FS, nse[points], power[points])


def scenes_of(event: Event, pair: Pair) -> list[Scene]:
    """One for each seed, whose sensor noise is its own."""
    return [
        replace(event.scene(pair, seed), seeds=[seed], nse_window_s=event.nse_window_s) for seed in event.seeds or SEEDS
    ]


def run_start(scene: Scene, share: float) -> float:
    """Noise reduction of KF-ANC over a whole run, with its least state noise and a share of the initial variance."""
    started = replace(scene, initial_variance=share * scene.initial_variance)
    result = went_through(run_setting(started, "KF-ANC", REGISTRY["KF-ANC"].grid[0]))
    return noise_reduction_db(result.error, result.disturbance, steady=1.0)


def tune_event(runs: Runs, scenes: Sequence[Scene]) -> dict[str, Tuned | None]:
    """Best settings on the first seed."""
    return tune_all(runs, scenes[0], grids(ALGORITHMS))


def jobs(names: Mapping[str, Any]) -> list[tuple[Event, str]]:
    """Events on the paths that have them."""
    return [(event, path) for event in events() for path in names if event.paths is None or path in event.paths]
