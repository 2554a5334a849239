"""What the studies of mismatch, tracking and the amplifier share: paths, noises, scenes, tuning, what a run is worth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult, noise_reduction_db, nse_db, output_power
from kfopc_filterpy.bench.registry import REGISTRY, Setting
from kfopc_filterpy.bench.report import Parameter
from kfopc_filterpy.bench.scene import Runs, Scene
from kfopc_filterpy.bench.tuning import RULE, Trial, Tuned, _best, run_settings
from kfopc_filterpy.signals import band_limited_noise, tone

from . import constraint_cases
from .constraint_cases import FS, SENSOR_NOISE_DB, SWITCH_ON_S, Noise

N_TAPS = 128
SEED = 1
TONE_HZ = 300.0
BAND_HZ = (200.0, 1000.0)
WORST_WINDOW_S = 0.1
NOISES: dict[str, Noise] = {
    "tone": lambda duration, seed: tone(TONE_HZ, duration, fs=FS, phase_rad=float(seed)),
    "band noise": lambda duration, seed: band_limited_noise(BAND_HZ, duration, fs=FS, rng=seed),
}


def paths() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Primary and secondary taps of the built-in duct, and of the measured one where it is at hand."""
    return {name: pair for name, pair in constraint_cases.paths().items() if name != "band-pass"}


def noise_of(name: str, duration_s: float, seed: int = SEED) -> np.ndarray:
    """A noise, and as much before it as runs before the control is switched on."""
    return NOISES[name](duration_s + SWITCH_ON_S, seed)


def make_case(pair: tuple[np.ndarray, np.ndarray], noise: np.ndarray, overdrive_db: float) -> Scene:
    """Scene whose unconstrained control power is 1, and so many dB above the rated one."""
    return with_overdrive(constraint_cases.make_case(pair, noise, n_taps=N_TAPS), overdrive_db)


def with_overdrive(scene: Scene, overdrive_db: float) -> Scene:
    """The scene with a rated power so many dB below the unconstrained control power."""
    return replace(scene, rated_power=scene.unconstrained_power / 10 ** (overdrive_db / 10))


def ceilings_note(scenes: Mapping[str, Scene]) -> str:
    """The ceiling of every constrained algorithm in each scene, as a sentence."""
    reached = [f"{name}: {_ceiling_db(scene):.1f} dB" for name, scene in scenes.items()]
    return (
        "The ceiling within the rated power, of one fixed filter for the whole run, over the steady half, with a linear "
        f"amplifier and no sensor noise (power-constrained Wiener solution): {'; '.join(reached)}."
    )


def _ceiling_db(scene: Scene) -> float:
    bound = constraint_cases.bound_of(scene)
    return bound.noise_reduction_over(0.5 * bound.whole.end_s)["whole"]


@dataclass(frozen=True)
class Measured:
    """What is kept of a run: its trial, and over the steady half noise reduction in dB and power over the rated one."""

    trial: Trial
    noise_reduction_db: float
    power: float
    diverged_at_s: float | None

    @property
    def unstable(self) -> bool:
        """Whether it ran away, or left more noise than there was."""
        return self.diverged_at_s is not None or not self.noise_reduction_db > 0.0


def measured(result: SimulationResult | None, setting: Setting, scene: Scene) -> Measured:
    """Measure a run; one that could not go on diverged at its start."""
    if result is None or result.diverged_at_s is not None:
        at = 0.0 if result is None else result.diverged_at_s
        return Measured(Trial(setting, np.inf, np.inf, True), np.nan, np.nan, at)
    # Before the first sound is through the primary path there is no NSE.
    nse = float(np.nanmean(nse_db(result.error, result.disturbance, scene.fs, scene.nse_window_s)))
    power = output_power(result.control_signal)
    trial = Trial(setting, nse, power, False)
    return Measured(trial, noise_reduction_db(result.error, result.disturbance), power / scene.rated_power, None)


def measure_settings(
    runs: Runs, scene: Scene, settings: Mapping[str, Sequence[Setting]]
) -> dict[str, dict[Setting, Measured]]:
    """A run of each setting of each algorithm."""
    jobs = [(name, setting, 0) for name, own in settings.items() for setting in own]
    # The outcomes know no setting: it is put in after.
    outcomes = run_settings(runs, scene, jobs, lambda result: measured(result, np.nan, scene))
    found: dict[str, dict[Setting, Measured]] = {name: {} for name in settings}
    for (name, setting, _), outcome in zip(jobs, outcomes, strict=True):
        found[name][setting] = replace(outcome, trial=replace(outcome.trial, setting=setting))
    return found


def chosen(scene: Scene, algorithm: str, outcomes: Mapping[Setting, Measured]) -> Tuned | None:
    """The best setting by the rule of all studies; None where every setting diverged."""
    trials = [outcome.trial for outcome in outcomes.values()]
    if all(trial.diverged for trial in trials):
        return None
    return _best(trials, scene.rated_power if REGISTRY[algorithm].keeps_budget else np.inf, algorithm)


def tune_all(runs: Runs, scene: Scene, settings: Mapping[str, Sequence[Setting]]) -> dict[str, Tuned | None]:
    """`tuning.tune` for settings of one's own, and for algorithms all of whose settings may diverge."""
    outcomes = measure_settings(runs, scene, settings)
    return {name: chosen(scene, name, outcomes[name]) for name in settings}


def grids(algorithms: Iterable[str]) -> dict[str, list[Setting]]:
    """Settings that are tried of each algorithm."""
    return {name: REGISTRY[name].grid for name in algorithms}


def shared_parameters(duration_s: Any, overdrive_db: Any) -> dict[str, Parameter]:
    """Parameters that the three studies state."""
    return {
        "fs_hz": Parameter(FS, "the rate of the measured duct"),
        "n_taps": Parameter(N_TAPS, "the tonal study's"),
        "rated_power": Parameter(overdrive_db, "overdrive in dB: the unconstrained control power over the rated power"),
        "unconstrained_control_power": Parameter(
            1.0, "every noise is scaled to it: (R_x' + q/(N P0) I) w = r over the record"
        ),
        "duration_s": Parameter(duration_s, "from switch-on on; the steady half counts"),
        "switch_on_s": Parameter(SWITCH_ON_S, "the noise runs before"),
        "sensor_noise_db": Parameter(SENSOR_NOISE_DB, "below the disturbance"),
        "tone_hz": Parameter(TONE_HZ, "within the band"),
        "band_hz": Parameter(list(BAND_HZ), "where both ducts carry sound"),
        "seed": Parameter(SEED, "of noise; of a tone, its phase"),
        "rule": Parameter(RULE, "for all algorithms; the settings tried and the best are below"),
    }


def tuned_in_words(tuned: Mapping[str, Tuned | None]) -> dict[str, Any]:
    """Best setting of each algorithm and all that were tried, for results.json."""
    return {
        name: None
        if best is None
        else {
            "kind": REGISTRY[name].kind,
            "setting": best.setting,
            "within_budget": best.within_budget,
            "at_edge": best.at_edge,
            "tried": [
                (t.setting, "diverged")
                if t.diverged
                else (t.setting, round(t.mean_nse_db, 3), round(t.output_power, 4))
                for t in best.trials
            ],
        }
        for name, best in tuned.items()
    }


def without_measured(names: Iterable[str]) -> list[str]:
    """The note that the measured duct is left out, where it is."""
    if "measured duct" in names:
        return []
    return ["The measured duct was not at hand (KFOPC_DATA): it is left out."]
