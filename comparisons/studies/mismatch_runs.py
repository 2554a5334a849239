"""The runs of the study of mismatch: a secondary path that is not as it was identified."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kfopc_filterpy.bench.registry import REGISTRY, Setting
from kfopc_filterpy.bench.scene import Runs, Scene
from kfopc_filterpy.bench.tuning import Tuned
from kfopc_filterpy.paths import frequency_response, path_taps, perturbed_path

from .cases import BAND_HZ, FS, Measured, chosen, grids, make_case, measure_settings, noise_of

ALGORITHMS = ("KF-ANC", "KF-OPC", "KF-PB", "FxRLS", "FxLMS", "MOV-FxLMS", "optimal leaky FxLMS")
OVERDRIVE_DB = 3.0
DURATION_S = 4.0
AMOUNTS = {
    "phase": (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0, 105.0, 120.0),
    "gain": (-12.0, -6.0, -3.0, 0.0, 3.0, 6.0, 12.0),
    "delay": (-10.0, -7.0, -4.0, -2.0, 0.0, 2.0, 4.0, 7.0, 10.0),
}
UNITS = {"phase": "degrees", "gain": "dB", "delay": "samples"}
ARGUMENTS = {"phase": "phase_deg", "gain": "gain_db", "delay": "delay_samples"}
EXACT, WRONG = "exact path", "wrong path"  # what an algorithm was tuned with


@dataclass(frozen=True)
class Case:
    """Where it is run: a pair of paths and a noise, by name."""

    path: str
    noise: str


@dataclass(frozen=True)
class Row:
    """The best setting of an algorithm at one mismatch; what it was tuned with is `EXACT` or `WRONG`."""

    path: str
    noise: str
    kind: str
    amount: float
    algorithm: str
    tuned_with: str
    setting: Setting
    noise_reduction_db: float  # NaN where it diverged
    power: float  # over the rated one
    within_budget: bool
    diverged_at_s: float | None

    @property
    def unstable(self) -> bool:
        """Whether it ran away, or left more noise than there was."""
        return self.diverged_at_s is not None or not self.noise_reduction_db > 0.0


Points = Mapping[tuple[str, float], Mapping[str, Mapping[Setting, Measured]]]


def points() -> list[tuple[str, float]]:
    """All mismatches, the exact path once."""
    return [("phase", 0.0), *((kind, a) for kind, own in AMOUNTS.items() for a in own if a)]


def estimates(secondary: np.ndarray) -> dict[tuple[str, float], np.ndarray]:
    """What controllers know of the secondary path at each mismatch."""
    return {
        (kind, amount): path_taps(perturbed_path(secondary, fs=FS, **{ARGUMENTS[kind]: amount}))
        for kind, amount in points()
    }


def phase_accuracy_deg(secondary: np.ndarray, known: Mapping[tuple[str, float], np.ndarray]) -> float:
    """Largest deviation of the phase over the band from the one that was wanted: no causal filter has it exactly."""
    f = np.arange(BAND_HZ[0], BAND_HZ[1] + 1.0, 10.0)
    exact = frequency_response(secondary, f, fs=FS)
    wanted = {
        "phase": lambda a: np.deg2rad(a) + 0 * f,
        "gain": lambda a: 0 * f,
        "delay": lambda a: -2 * np.pi * f / FS * a,
    }
    turns = [
        np.angle(frequency_response(taps, f, fs=FS) / exact * np.exp(-1j * wanted[kind](amount)))
        for (kind, amount), taps in known.items()
    ]
    return float(np.max(np.abs(np.degrees(turns))))


def case_scene(case: Case, pair: tuple[np.ndarray, np.ndarray]) -> Scene:
    """Scene of a case with the exact path."""
    return make_case(pair, noise_of(case.noise, DURATION_S), OVERDRIVE_DB)


def run_case(
    runs: Runs, case: Case, scene: Scene, known: Mapping[tuple[str, float], np.ndarray]
) -> tuple[list[Row], dict[tuple[str, float], dict[str, Tuned | None]]]:
    """Every algorithm at every mismatch: at the setting that is best with the exact path, and at its best with the wrong one.

    Settings are relative to the power of the reference filtered by what the controller knows of the path. To FxLMS and
    KF-ANC an estimate with another gain is then the same as a true path that has drifted by the inverse; to one with a rated
    power it is not, since a true path of less gain asks for more power.
    """
    outcomes = {
        point: measure_settings(runs, replace(scene, secondary_estimate=taps), grids(ALGORITHMS))
        for point, taps in known.items()
    }
    best = tuned_at(scene, outcomes)
    rows = []
    for kind, amounts in AMOUNTS.items():
        for amount in amounts:
            point = (kind, amount) if amount else ("phase", 0.0)
            for name in ALGORITHMS:
                exact, wrong = best["phase", 0.0][name], best[point][name]
                own = outcomes[point][name]
                assert exact is not None
                rows.append(_row(case, kind, amount, name, EXACT, own[exact.setting], exact.within_budget))
                if wrong is None:  # diverged at every setting: any of them tells
                    rows.append(_row(case, kind, amount, name, WRONG, own[REGISTRY[name].grid[0]], False))
                else:
                    rows.append(_row(case, kind, amount, name, WRONG, own[wrong.setting], wrong.within_budget))
    return rows, best


def tuned_at(scene: Scene, outcomes: Points) -> dict[tuple[str, float], dict[str, Tuned | None]]:
    """Best setting of each algorithm at each mismatch."""
    return {point: {name: chosen(scene, name, own[name]) for name in own} for point, own in outcomes.items()}


def _row(case: Case, kind: str, amount: float, name: str, tuned_with: str, one: Measured, within: bool) -> Row:
    return Row(
        case.path,
        case.noise,
        kind,
        amount,
        name,
        tuned_with,
        one.trial.setting,
        one.noise_reduction_db,
        one.power,
        within,
        one.diverged_at_s,
    )


def cases(names: Sequence[str]) -> list[Case]:
    """Band noise on every path, and a tone on the first, where a phase error is one number."""
    return [*(Case(path, "band noise") for path in names), Case(names[0], "tone")]
