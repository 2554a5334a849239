"""The built-in scenario of a sweep: one controller in the loop on one noise, and its figures of merit.

Runs on one noise share its scene. Kalman filters without a budget that agree in r, q, P0 and estimated path share one
gain sequence too. The results of a run do not depend, to the last bit, on the runs it shares with: the arithmetic of a
scenario is separate, and a single one goes through `simulate_scenarios` as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult, clipped_fraction, convergence_time_s, noise_reduction_db, output_power
from kfopc_filterpy.metrics import overshoot
from kfopc_filterpy.paths import path_taps, perturbed_path
from kfopc_filterpy.plot.style import decibels

from ..bench import AllDivergedError, Runs, Scene, algorithms, make_controller, run_setting, tune
from ..studies import cases
from ..studies.cases import FS, SWITCH_ON_S, WINDOW_S, Pair, Setting
from .grid import AMPLIFIERS, DEFAULT_SETTING, TUNED_SETTING, Values

# Axes that runs of one scene agree in, and those that a gain sequence depends on besides.
OF_SCENE = ("path", "noise", "duration_s", "n_taps", "sensor_noise_db", "seed")
PATH_ERRORS = ("path_gain_db", "path_delay", "path_phase_deg")
OF_GAINS = (*PATH_ERRORS, "setting")
UNCONSTRAINED_POWER = 1.0  # of every scene; it sets the scale of the divergence limit
SHARED_BYTES = 256e6  # of the signals of runs that go on side by side
MOST_SHARED, MOST_ALONE = 64, 8  # runs of a job
RECORDED = 5  # signals of a run that `simulate_scenarios` keeps
MEASURES: dict[str, Callable[[SimulationResult, Scene], float]] = {
    "noise_reduction_db": lambda run, scene: noise_reduction_db(run.error, run.disturbance),
    "output_power_db": lambda run, scene: float(decibels(output_power(run.control_signal))),
    "power_over_rated": lambda run, scene: output_power(run.control_signal) / scene.rated_power,
    "worst_window_over_rated": lambda run, at: overshoot(run.control_signal, at.rated_power, FS, window_s=WINDOW_S),
    "clipped_fraction": lambda run, scene: clipped_fraction(run.control_signal, scene.amplitude_limit),
    "convergence_time_s": lambda run, at: convergence_time_s(run.error, run.disturbance, FS, window_s=at.nse_window_s),
}

Figures = dict[str, Any]


class ScenarioError(RuntimeError):
    """A scenario raised an exception; the message names the scenario."""


@contextmanager
def naming(scenario: Values) -> Iterator[None]:
    """Name the scenario in an exception that it raises."""
    try:
        yield
    except Exception as error:
        words = ", ".join(f"{name}={value}" for name, value in scenario.items())
        raise ScenarioError(f"scenario {words}: {type(error).__name__}: {error}") from error


def shares_gains(scenario: Values) -> bool:
    """Return whether the gains depend on the reference, path and setting alone. Runs that are tuned go one by one."""
    return algorithms()[scenario["algorithm"]].shares_gains and scenario["setting"] != TUNED_SETTING


def group_of(scenario: Values) -> tuple[Any, ...]:
    """Return what runs must agree in to be done together."""
    shared = (*OF_SCENE, *OF_GAINS) if shares_gains(scenario) else OF_SCENE
    return tuple(scenario[name] for name in shared)


def most_together(scenario: Values) -> int:
    """Return how many runs of a group one job does: enough to share well, within the memory set aside."""
    if not shares_gains(scenario):
        return MOST_ALONE
    fits = int(SHARED_BYTES / (8 * RECORDED * FS * scenario["duration_s"]))
    return max(1, min(fits, MOST_SHARED))


def run_group(scenarios: Sequence[Values], tuning_seed: int) -> list[Figures]:
    """Return the figures of merit of scenarios of one group; settings are tuned on the noise of `tuning_seed`."""
    if len(scenarios) > 1 and shares_gains(scenarios[0]):
        with suppress(Exception):  # raised again below, by the scenario whose it is
            return _run_together(scenarios)
    figures = []
    for scenario in scenarios:
        with naming(scenario):
            figures += _run_together([scenario]) if shares_gains(scenario) else [_run_alone(scenario, tuning_seed)]
    return figures


def _run_together(scenarios: Sequence[Values]) -> list[Figures]:
    scenes, settings = list(map(scene_of, scenarios)), list(map(_given_setting, scenarios))
    algorithms_of = [scenario["algorithm"] for scenario in scenarios]
    results = scenes[0].run_together(
        list(map(make_controller, scenes, algorithms_of, settings)),
        amplifier=[scene.amplifier for scene in scenes],
        rated_power=UNCONSTRAINED_POWER,
    )
    return list(map(_figures, results, scenes, settings))


def _run_alone(scenario: Values, tuning_seed: int) -> Figures:
    scene, algorithm = scene_of(scenario), scenario["algorithm"]
    setting = _given_setting(scenario)
    if setting == TUNED_SETTING:
        exact = scenario | {"seed": tuning_seed} | dict.fromkeys(PATH_ERRORS, 0.0)
        setting = _tuned(tuple(exact.items()))
    if setting is None:
        return _figures(None, scene, np.nan)
    controller = make_controller(scene, algorithm, setting)
    unconstrained = replace(scene, rated_power=UNCONSTRAINED_POWER)
    return _figures(run_setting(unconstrained, algorithm, setting, controller=controller), scene, setting)


def _figures(result: SimulationResult | None, scene: Scene, setting: Setting) -> Figures:
    """Return the figures of merit of a run; NaN if it diverged, with the time unless it refused to go on."""
    first, second = setting if isinstance(setting, tuple) else (setting, np.nan)
    figures: Figures = {"setting_used": first, "second_setting_used": second}
    if result is None or result.diverged_at_s is not None:
        diverged_at_s = np.nan if result is None else result.diverged_at_s
        return dict.fromkeys(MEASURES, np.nan) | figures | {"diverged_at_s": diverged_at_s, "diverged": True}
    measured = {name: measure(result, scene) for name, measure in MEASURES.items()}
    return measured | figures | {"diverged_at_s": np.nan, "diverged": False}


# ---- What a scenario consists of


def scene_of(scenario: Values) -> Scene:
    """Return a scenario's scene, with its rated power, amplifier and estimated path."""
    scene = _noise_scene(*(scenario[name] for name in OF_SCENE))
    rated_power = 10 ** (scenario["rated_power_db"] / 10)
    limit = float(np.sqrt(2 * rated_power) * 10 ** (scenario["amplifier_limit_db"] / 20))
    return replace(
        scene,
        rated_power=rated_power,
        amplifier=AMPLIFIERS[scenario["amplifier"]](limit),
        clips_at=limit,
        secondary_estimate=_estimated_path(scenario["path"], *(scenario[name] for name in PATH_ERRORS)),
    )


@lru_cache(maxsize=4)
def _noise_scene(path: str, noise: str, duration_s: float, n_taps: int, sensor_noise_db: float, seed: int) -> Scene:
    """Return the scene of one noise, of unconstrained control power 1."""
    made = cases.made_noises()
    signal = (made if noise in made else cases.noises())[noise](duration_s + SWITCH_ON_S, seed)
    return cases.make_case(_path_pair(path), signal, n_taps=n_taps, sensor_noise_db=sensor_noise_db, seed=seed)


@lru_cache(maxsize=256)  # a phase is fitted by least squares: seconds for a long path
def _estimated_path(path: str, gain_db: float, delay: float, phase_deg: float) -> np.ndarray:
    taps = _path_pair(path)[1]
    if not (gain_db or delay or phase_deg):
        return taps
    return path_taps(perturbed_path(taps, fs=FS, gain_db=gain_db, delay_samples=delay, phase_deg=phase_deg))


def _path_pair(name: str) -> Pair:
    modelled = cases.modelled_paths()
    return modelled[name] if name in modelled else cases.paths()[name]


def _given_setting(scenario: Values) -> Any:
    """Return the setting that a scenario names, by default the middle of those that the studies tune on."""
    first = sorted(algorithms()[scenario["algorithm"]].first)
    return first[len(first) // 2] if scenario["setting"] == DEFAULT_SETTING else scenario["setting"]


@lru_cache(maxsize=256)
def _tuned(scenario: tuple[tuple[str, Any], ...]) -> Setting | None:
    """Return the best setting of a scenario by the studies' rule; None if all diverge."""
    values = dict(scenario)
    with suppress(AllDivergedError):
        algorithm = values["algorithm"]
        return tune(Runs(workers=1), scene_of(values), (algorithm,))[algorithm].setting  # the other cores have jobs too
    return None
