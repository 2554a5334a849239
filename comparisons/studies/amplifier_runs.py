"""The runs of the study of the amplifier: a noise that asks for more than the amplifier has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kfopc_filterpy import (
    HardClipAmplifier,
    SoftSaturationAmplifier,
    clipped_fraction,
    noise_reduction_db,
    output_power,
)
from kfopc_filterpy.bench.registry import REGISTRY, STEP_SIZE_GRID, Setting, make_controller
from kfopc_filterpy.bench.scene import Runs, Scene
from kfopc_filterpy.bench.tuning import Tuned
from kfopc_filterpy.metrics import coherence_and_gain, harmonics_db
from kfopc_filterpy.power.amplifiers import Amplifier

from .cases import BAND_HZ, FS, TONE_HZ, grids, make_case, noise_of, tune_all, with_overdrive

FREE = ("KF-ANC", "FxLMS")
POWER_LIMITED = ("KF-OPC", "KF-PB", "MOV-FxLMS")
PEAK_LIMITED = ("clipping FxLMS", "re-scaling FxLMS", "two-gradient FxLMS")
ALGORITHMS = (*FREE, *POWER_LIMITED, *PEAK_LIMITED)
OVERDRIVES_DB = (0.0, 2.0, 5.0, 10.0, 15.0, 20.0)
LIMIT_SHARES = (0.5, 1.0)  # squared amplitude limit of the algorithm over the amplifier's: their power, and their peak
DURATION_S = 4.0
WEIGHTS_EVERY = 160
OVERRUN = 2.0  # output power that a filter ends up asking for, over what cancelling needs, beyond which it overruns
AMPLIFIERS: dict[str, Any] = {"hard clip": HardClipAmplifier, "soft saturation": SoftSaturationAmplifier}
FIGURES = (
    "noise_reduction_db",
    "harmonics_db",
    "coherence",
    "power",
    "clipped_fraction",
    "asked_power",
    "weight_growth",
)
UNKNOWN, KNOWN = "unknown", "known"  # to the disturbance estimate


@dataclass(frozen=True)
class Case:
    """Where it is run: a pair of paths, a noise and an amplifier, by name."""

    path: str
    noise: str
    amplifier: str


@dataclass(frozen=True)
class Row:
    """The best setting of an algorithm at one overdrive."""

    path: str
    noise: str
    amplifier: str
    overdrive_db: float
    algorithm: str
    known: str
    setting: Any
    within_budget: bool
    noise_reduction_db: float
    harmonics_db: float  # over the disturbance, a tone's only
    coherence: float  # of anti-noise and disturbance over the band, a band noise's only
    power: float  # before the amplifier, over the rated one
    clipped_fraction: float
    asked_power: float  # of the last weights without any limit, over the power that cancels the noise
    weight_growth: float  # largest weight at the end over that at half of the run
    diverged_at_s: float | None

    @property
    def overruns(self) -> bool:
        """Whether its weights ask for more than cancelling the noise with a linear amplifier would take."""
        return self.diverged_at_s is not None or self.asked_power > OVERRUN


def cases(names: Sequence[str]) -> list[Case]:
    """Both amplifiers on the first paths, the hard clip on the others."""
    return [
        Case(path, noise, amplifier)
        for path in names
        for amplifier in AMPLIFIERS
        if path == names[0] or amplifier == "hard clip"
        for noise in ("tone", "band noise")
    ]


def settings_for(scene: Scene, algorithms: Sequence[str]) -> dict[str, list[Setting]]:
    """Settings that are tried. An algorithm that limits its amplitude is given the amplifier's limit, and the one at
    which even a square wave keeps the rated power.
    """
    limit = scene.amplitude_limit**2 / scene.unconstrained_power
    peaks: list[Setting] = [(mu, share * limit) for mu in STEP_SIZE_GRID for share in LIMIT_SHARES]
    return {name: peaks if name in PEAK_LIMITED else own for name, own in grids(algorithms).items()}


def knowing() -> list[str]:
    """Algorithms whose disturbance estimate can know the amplifier."""
    return [name for name in ALGORITHMS if REGISTRY[name].knows_amplifier]


def saturating(scene: Scene, case: Case, overdrive_db: float, known: str) -> Scene:
    """The scene at an overdrive, with an amplifier that puts out sqrt(2 rated power) at most."""
    driven = with_overdrive(scene, overdrive_db)
    amplifier: Amplifier = AMPLIFIERS[case.amplifier](driven.amplitude_limit)
    return replace(driven, amplifier=amplifier, known_amplifier=amplifier if known == KNOWN else None)


def run_case(
    runs: Runs, case: Case, pair: tuple[np.ndarray, np.ndarray]
) -> tuple[list[Row], dict[str, dict[str, Tuned | None]]]:
    """Every algorithm at every overdrive, tuned there; those that can know the amplifier without and with it."""
    scene = make_case(pair, noise_of(case.noise, DURATION_S), 0.0)
    rows: list[Row] = []
    best = {}
    for overdrive in OVERDRIVES_DB:
        for known, names in ((UNKNOWN, list(ALGORITHMS)), (KNOWN, knowing())):
            driven = saturating(scene, case, overdrive, known)
            tuned = tune_all(runs, driven, settings_for(driven, names))
            best[f"{overdrive:g} dB, {known}"] = tuned
            jobs = [(driven, case, overdrive, known, name, tuned[name]) for name in names]
            rows += runs.map(lambda job: _run(*job), jobs)
    return rows, best


def _run(scene: Scene, case: Case, overdrive_db: float, known: str, algorithm: str, best: Tuned | None) -> Row:
    def diverged(at_s: float) -> Row:
        nothing: dict[str, Any] = dict.fromkeys(FIGURES, np.nan)
        return Row(**place, **nothing, diverged_at_s=at_s)

    place: dict[str, Any] = {"path": case.path, "noise": case.noise, "amplifier": case.amplifier, "known": known}
    place |= {"overdrive_db": overdrive_db, "algorithm": algorithm}
    place |= {"setting": best and best.setting, "within_budget": best is not None and best.within_budget}
    if best is None:
        return diverged(0.0)
    result = scene.run(make_controller(scene, algorithm, best.setting), record_weights_every=WEIGHTS_EVERY)
    if result.diverged_at_s is not None:
        return diverged(result.diverged_at_s)
    e, d, y = result.error, result.disturbance, result.control_signal
    assert result.weights is not None
    largest = np.abs(result.weights).max(axis=1)
    asked = np.convolve(result.reference, result.weights[-1])[: e.size]
    tonal = case.noise == "tone"
    return Row(
        **place,
        noise_reduction_db=noise_reduction_db(e, d),
        harmonics_db=harmonics_db(e, d, TONE_HZ, FS) if tonal else np.nan,
        coherence=np.nan if tonal else coherence_and_gain(d, result.anti_noise, FS, BAND_HZ).coherence,
        power=output_power(y) / scene.rated_power,
        clipped_fraction=clipped_fraction(y, scene.amplitude_limit),
        asked_power=output_power(asked) / scene.unconstrained_power,
        weight_growth=float(largest[-1] / largest[largest.size // 2]),
        diverged_at_s=None,
    )


def runs_of_a_case() -> int:
    """Runs that `run_case` takes."""
    sizes = {name: len(REGISTRY[name].grid) for name in ALGORITHMS}
    sizes |= dict.fromkeys(PEAK_LIMITED, len(STEP_SIZE_GRID) * len(LIMIT_SHARES))
    return len(OVERDRIVES_DB) * (
        sum(sizes.values()) + len(sizes) + sum(sizes[name] for name in knowing()) + len(knowing())
    )
