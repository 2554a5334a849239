"""The built-in scenario of a sweep: one controller in the loop on one noise, and its figures of merit.

Runs on one noise share its scene; Kalman filters without a budget that agree in r, q, P0 and estimated path share one
gain sequence too. The results of a run do not depend, to the last bit, on the runs it shares with: the arithmetic of a
scenario is separate, and a single one goes through `simulate_scenarios` as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from kfopc_filterpy import (
    HardClipAmplifier,
    SimulationResult,
    SoftSaturationAmplifier,
    clipped_fraction,
    convergence_time_s,
    noise_reduction_db,
    nse_db,
    output_power,
)
from kfopc_filterpy.bench import AllDivergedError, Scene, algorithms, make_controller, run_setting, tune
from kfopc_filterpy.metrics import overshoot
from kfopc_filterpy.paths import path_taps, perturbed_path

from ..studies.cases import (
    FS,
    SWITCH_ON_S,
    WINDOW_S,
    Setting,
    decibels,
    made_noises,
    make_case,
    modelled_paths,
    noises,
    paths,
)
from .grid import AMPLIFIERS, DEFAULT_SETTING, TUNED_SETTING, Values

# Axes that runs of one scene agree in, and those that a gain sequence depends on besides.
OF_SCENE = ("path", "noise", "duration_s", "n_taps", "sensor_noise_db", "seed")
OF_GAINS = ("path_gain_db", "path_delay", "path_phase_deg", "setting")
UNCONSTRAINED_POWER = 1.0  # of every scene; it sets the scale of the divergence limit
NSE_WINDOW_S = 0.05
SHARED_BYTES = 256e6  # of the signals of runs that go on side by side
MOST_SHARED, MOST_ALONE = 64, 8  # runs of a job
MEASURED = (
    "noise_reduction_db",
    "output_power_db",
    "power_over_rated",
    "worst_window_over_rated",
    "output_power",
    "clipped_fraction",
    "mean_nse_db",
    "convergence_time_s",
)
FIGURES = (*MEASURED, "setting_used", "second_setting_used", "diverged_at_s")
RECORDED = 5  # signals of a run that `simulate_scenarios` keeps

Figures = dict[str, Any]


def group_of(scenario: Values) -> tuple[Any, ...]:
    """Return what runs must agree in to be done together."""
    scene = tuple(scenario[name] for name in OF_SCENE)
    shares = algorithms()[scenario["algorithm"]].shares_gains
    return (*scene, *(scenario[name] for name in OF_GAINS)) if shares else (*scene, None)


def most_together(scenario: Values) -> int:
    """Return how many runs of a group one job does: enough to share well, within the memory set aside."""
    if not algorithms()[scenario["algorithm"]].shares_gains:
        return MOST_ALONE
    fits = int(SHARED_BYTES / (8 * RECORDED * FS * scenario["duration_s"]))
    return int(np.clip(fits, 1, MOST_SHARED))


def run_group(scenarios: Sequence[Values], tuning_seed: int) -> list[Figures]:
    """Return the figures of merit of scenarios of one scene; settings are tuned on the noise of `tuning_seed`."""
    made = [_Prepared(scenario, tuning_seed) for scenario in scenarios]
    sharing: dict[Any, list[int]] = {}
    for i, one in enumerate(made):
        key = (*group_of(one.scenario), one.setting) if one.shares else i
        sharing.setdefault(key, []).append(i)
    figures: list[Figures] = [{}] * len(made)
    for members in sharing.values():
        for i, own in zip(members, _run([made[i] for i in members]), strict=True):
            figures[i] = own
    return figures


class _Prepared:
    """A scenario's scene, setting, and amplifier."""

    def __init__(self, scenario: Values, tuning_seed: int) -> None:
        self.scenario = scenario
        with naming(scenario):
            self.scene = scene_of(*(scenario[name] for name in OF_SCENE))
            self.rated_power = UNCONSTRAINED_POWER * 10 ** (scenario["rated_power_db"] / 10)
            self.limit = float(np.sqrt(2 * self.rated_power) * 10 ** (scenario["amplifier_limit_db"] / 20))
            self.amplifier = _amplifier(scenario["amplifier"], self.limit)
            self.setting = self._setting(tuning_seed)

    @property
    def shares(self) -> bool:
        """Whether its gains depend on the reference alone."""
        return algorithms()[self.scenario["algorithm"]].shares_gains

    def controller(self) -> Any:
        """Return a fresh controller, which knows the path as well as the scenario says."""
        errors = (self.scenario[axis] for axis in ("path_gain_db", "path_delay", "path_phase_deg"))
        estimate = estimated_path(self.scenario["path"], *errors)
        known = replace(self.scene, secondary_estimate=estimate, rated_power=self.rated_power)
        assert self.setting is not None
        return make_controller(known, self.scenario["algorithm"], self.setting)

    def _setting(self, tuning_seed: int) -> Setting | None:
        setting, algorithm = self.scenario["setting"], algorithms()[self.scenario["algorithm"]]
        if setting != TUNED_SETTING:
            return middle(algorithm.first) if setting == DEFAULT_SETTING else setting
        scene = (*(self.scenario[name] for name in OF_SCENE[:-1]), tuning_seed)
        return _tuned(scene, self.scenario["algorithm"], self.rated_power, self.amplifier)


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


def middle(grid: Sequence[float]) -> float:
    """Return the middle of the settings that the studies tune an algorithm on."""
    return sorted(grid)[len(grid) // 2]


def path_pair(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return primary and secondary taps."""
    modelled = modelled_paths()
    return modelled[name] if name in modelled else paths()[name]


@lru_cache(maxsize=256)  # a phase is fitted by least squares: seconds for a long path
def estimated_path(path: str, gain_db: float, delay: float, phase_deg: float) -> np.ndarray:
    """Return the taps of a secondary path estimated with an error."""
    taps = path_pair(path)[1]
    if not (gain_db or delay or phase_deg):
        return taps
    return path_taps(perturbed_path(taps, fs=FS, gain_db=gain_db, delay_samples=delay, phase_deg=phase_deg))


@lru_cache(maxsize=4)
def scene_of(path: str, noise: str, duration_s: float, n_taps: int, sensor_noise_db: float, seed: int) -> Scene:
    """Return the scene of one noise, of unconstrained control power 1."""
    made = made_noises()
    signal = (made if noise in made else noises())[noise](duration_s + SWITCH_ON_S, seed)
    return make_case(path_pair(path), signal, n_taps=n_taps, sensor_noise_db=sensor_noise_db, seed=seed)


class _OneByOne:
    """A `Runs` for `tune` that stays in this process, since the others have jobs too."""

    def map(self, job: Callable[[Any], Any], items: Iterable[Any], worth: Any = None) -> list[Any]:
        return [job(item) for item in items]


@lru_cache(maxsize=256)
def _tuned(of_scene: tuple[Any, ...], algorithm: str, rated_power: float, amplifier: Any) -> Setting | None:
    """Return the best setting by the studies' rule on one seed, with the exact path; None if all diverge."""
    scene = replace(scene_of(*of_scene), rated_power=rated_power, amplifier=amplifier)
    try:
        return tune(_OneByOne(), scene, (algorithm,))[algorithm].setting  # type: ignore[arg-type]
    except AllDivergedError:
        return None


def _amplifier(name: str, limit: float) -> Any:
    hard, soft = AMPLIFIERS[1:]
    return HardClipAmplifier(limit) if name == hard else SoftSaturationAmplifier(limit) if name == soft else None


def _run(members: list[_Prepared]) -> list[Figures]:
    """Run scenarios that share a gain sequence, or a single one; without a stable setting there is no run."""
    setting = members[0].setting
    if setting is None:
        return [_figures(one, None) for one in members]
    if not members[0].shares:
        (alone,) = members
        with naming(alone.scenario):
            scene = replace(alone.scene, amplifier=alone.amplifier)
            algorithm, controller = alone.scenario["algorithm"], alone.controller()
            result = run_setting(scene, algorithm, setting, controller=controller)
            return [_figures(alone, result)]
    try:
        results = members[0].scene.run_together(
            [one.controller() for one in members], amplifier=[one.amplifier for one in members]
        )
    except Exception as error:
        if len(members) > 1:  # which of them it was
            return [own for one in members for own in _run([one])]
        with naming(members[0].scenario):
            raise error
    return [_figures(one, result) for one, result in zip(members, results, strict=True)]


def _figures(one: _Prepared, result: SimulationResult | None) -> Figures:
    """Return the figures of merit of a run; NaN if it diverged, with the time unless it refused to go on."""
    diverged = result is None or result.diverged_at_s is not None
    values = [np.nan] * len(MEASURED) if result is None or diverged else _measured(one, result)
    first, second = one.setting if isinstance(one.setting, tuple) else (one.setting, np.nan)
    first = np.nan if first is None else first
    return dict(zip(MEASURED, values, strict=True)) | {
        "setting_used": first,
        "second_setting_used": second,
        "diverged_at_s": result.diverged_at_s if result is not None and diverged else np.nan,
        "diverged": diverged,
    }


def _measured(one: _Prepared, result: SimulationResult) -> list[float]:
    e, d, y = result.error, result.disturbance, result.control_signal
    power = output_power(y)
    return [
        noise_reduction_db(e, d),
        float(decibels(power / UNCONSTRAINED_POWER)),
        power / one.rated_power,
        overshoot(y, one.rated_power, FS, window_s=WINDOW_S),
        power,
        clipped_fraction(y, one.limit),
        float(np.mean(nse_db(e, d, FS, NSE_WINDOW_S))),
        convergence_time_s(e, d, FS, window_s=NSE_WINDOW_S),
    ]
