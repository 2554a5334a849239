"""The built-in scenario of a sweep: one controller in the loop on one noise, and its figures of merit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from kfopc_filterpy import Plant, SimulationResult, noise_reduction_db, output_power
from kfopc_filterpy._validate import as_number
from kfopc_filterpy.metrics import convergence_time_s, overshoot
from kfopc_filterpy.paths import path_taps, perturbed_path
from kfopc_filterpy.plot.style import decibels
from kfopc_filterpy.verdict.runs import AllDivergedError

from ..bench import Runs, Scene, algorithms, run_setting, tune
from ..studies import cases
from ..studies.cases import FS, SWITCH_ON_S, WINDOW_S, Setting

DEFAULTS: dict[str, Any] = {
    "path": "duct",
    "noise": "band noise",
    "duration_s": 4.0,  # under control
    "n_taps": 128,
    "sensor_noise_db": -40.0,  # over the disturbance
    "path_gain_db": 0.0,  # error of the estimated path, as the next two
    "path_delay": 0.0,  # samples
    "path_phase_deg": 0.0,
    "algorithm": "KF-OPC",
    "setting": "default",  # r E[x'²]/q, μ L E[x'²] or 1 - λ; or "tuned"
    "rated_power_db": -10.0,  # over the unconstrained control power
}
PATH_ERRORS = ("path_gain_db", "path_delay", "path_phase_deg")
CHOICES = {
    "path": (*cases.modelled_plants(), "measured duct"),
    "noise": (*cases.made_noises(), "motor"),
    "algorithm": tuple(algorithms()),
}
TUNING_SEED = 0  # of the noise on which settings are tuned; those of a sweep begin with 1
MEASURES: dict[str, Callable[[SimulationResult, Scene], float]] = {
    "noise_reduction_db": lambda run, scene: noise_reduction_db(run.error, run.disturbance),
    "output_power_db": lambda run, scene: float(decibels(output_power(run.control_signal))),
    "power_over_rated": lambda run, scene: output_power(run.control_signal) / scene.rated_power,
    "worst_window_over_rated": lambda run, at: overshoot(run.control_signal, at.rated_power, FS, window_s=WINDOW_S),
    "convergence_time_s": lambda run, at: convergence_time_s(run.error, run.disturbance, FS, window_s=at.nse_window_s),
}


def checked_axes(axes: Mapping[str, list[Any]]) -> Mapping[str, list[Any]]:
    """Return axes of this scenario; refuse a name that is none, and a value that its axis cannot have."""
    for name, values in axes.items():
        if name not in DEFAULTS:
            raise ValueError(f"no axis called {name}; there are {', '.join(DEFAULTS)}")
        for value in values:
            if name in CHOICES and value not in CHOICES[name]:
                raise ValueError(f"{name} must be one of {', '.join(CHOICES[name])}, got {value!r}")
            if name not in CHOICES and not (name == "setting" and value in ("default", "tuned")):
                as_number(value, name)
    return axes


def in_the_loop(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of merit of a controller on a noise; none but its setting if it diverged."""
    values = DEFAULTS | dict(values)
    algorithm, setting = values["algorithm"], values["setting"]
    if setting == "tuned":
        tuning = values | {"seed": TUNING_SEED} | dict.fromkeys(PATH_ERRORS, 0.0)
        setting = _tuned(tuple(tuning.items()))
    elif setting == "default":  # the middle of those that the studies tune on
        grid = sorted(algorithms()[algorithm].grid)
        setting = grid[len(grid) // 2]
    if setting is None:
        return {"diverged": True}
    used = dict(zip(("setting_used", "second_setting_used"), np.atleast_1d(setting).tolist(), strict=False))
    scene = scene_of(values)
    result = run_setting(scene, algorithm, setting)
    if result is None or result.diverged_at_s is not None:
        return used | {"diverged": True}
    return {name: measure(result, scene) for name, measure in MEASURES.items()} | used | {"diverged": False}


def scene_of(values: Mapping[str, Any]) -> Scene:
    """Return the scene of some values, with its rated power and estimated path."""
    of_noise = ("path", "noise", "duration_s", "n_taps", "sensor_noise_db", "seed")
    return replace(
        _noise_scene(*(values[name] for name in of_noise)),
        rated_power=10 ** (values["rated_power_db"] / 10),
        secondary_estimate=_estimated_path(values["path"], *(values[name] for name in PATH_ERRORS)),
    )


@lru_cache(maxsize=4)
def _noise_scene(path: str, noise: str, duration_s: float, n_taps: int, sensor_noise_db: float, seed: int) -> Scene:
    """Return the scene of one noise, of unconstrained control power 1."""
    made = cases.made_noises()
    signal = (made if noise in made else _measured(cases.noises(), noise))[noise](duration_s + SWITCH_ON_S, seed)
    return cases.make_case(_plant(path), signal, n_taps=n_taps, sensor_noise_db=sensor_noise_db, seed=seed)


@lru_cache(maxsize=256)  # a phase is fitted by least squares: seconds for a long path
def _estimated_path(path: str, gain_db: float, delay: float, phase_deg: float) -> np.ndarray:
    taps = _plant(path).secondary[0, 0]
    if not (gain_db or delay or phase_deg):
        return taps
    return path_taps(perturbed_path(taps, fs=FS, gain_db=gain_db, delay_samples=delay, phase_deg=phase_deg))


def _plant(name: str) -> Plant:
    modelled = cases.modelled_plants()
    plant: Plant = (modelled if name in modelled else _measured(cases.plants(), name))[name]
    return plant


def _measured(found: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    if name not in found:
        raise ValueError(f"{name} needs the measured data: set KFOPC_DATA to their folder")
    return found


@lru_cache(maxsize=256)
def _tuned(values: tuple[tuple[str, Any], ...]) -> Setting | None:
    """Return the best setting by the studies' rule; None if all diverge."""
    own = dict(values)
    with suppress(AllDivergedError):
        (best,) = tune(Runs(workers=1), scene_of(own), (own["algorithm"],)).values()  # other cores have runs
        return best.setting
    return None
