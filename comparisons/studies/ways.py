"""Study: ten ways to keep a rated power, on the duct of the paper's first author."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from kfopc_filterpy.bounds import power_constrained_solution

from .. import bench
from ..bench import Algorithm, Parameter, Runs, Scene, StudyReport, Table, Tuned
from ..bench.registry import REGISTRY, registered
from ..rivals import ImprovedMOV
from . import report_parts as parts
from .cases import grids, of_unit_gain
from .duct import POWER_MULTIPLE, at_hand, scene_of

IMPROVED = "improved MOV-FxLMS"
N_PRIMARY = 512  # taps of the identified primary path: 32 ms
MULTIPLES = (POWER_MULTIPLE, 10.0)  # of the rated power, that full control needs
KEEPS_IF_FLAT = "power, if the path is flat"
WAYS = {  # law, what it must know beside the secondary path, and what it keeps
    "KF-PB": ("(R' + g R) w = p of learned paths", "rated power", "power, over 10 s"),
    "KF-OPC": ("Kalman filter of a d^", "rated power, q, r, P0", KEEPS_IF_FLAT),
    "MOV-FxLMS": ("w += mu (e x' - g y x), g from d^", "rated power, mu", KEEPS_IF_FLAT),
    "MOV-MFxLMS": ("the same with d^ - w x' for e", "rated power, mu", KEEPS_IF_FLAT),
    IMPROVED: ("as MOV-FxLMS, g from p^ * x", "rated power, mu, primary path", KEEPS_IF_FLAT),
    "MOV-FxLMS by variance": ("the same, g from E[d^2] in advance", "E[d^2], mu", "power, if flat and steady"),
    "MOV-FxLMS fixed": ("the same, g tuned", "g and mu, by trials", "what the trials kept"),
    "optimal leaky FxLMS": ("w += mu (e x' - g w), g from d^", "rated power, mu", "power, if flat and white"),
    "power-limited FxLMS": ("MOV-FxLMS in bins, g integrated", "rated power, mu", "power"),
    "two-gradient FxLMS": ("w -= mu y x if |y| > A, else FxLMS", "A and mu, by trials", "a peak, roughly"),
}


def planned_runs() -> int:
    """Return the number of runs of the study."""
    with registered(_improved()):
        seen = {name: len(grid) * (len(MULTIPLES) if REGISTRY[name].sees_budget else 1) for name, grid in _grids()}
    return sum(seen.values())


def main(runs: Runs) -> StudyReport | str:
    """Run the study; without the data return a line that says why not."""
    data = at_hand("ways", "duct-measured")
    if isinstance(data, str):
        return data
    scene = scene_of(data.noise - data.noise.mean(), of_unit_gain(data))
    scenes = {multiple: replace(scene, rated_power=scene.unconstrained_power / multiple) for multiple in MULTIPLES}
    with registered(_improved()):
        once = {name: grid for name, grid in _grids() if not REGISTRY[name].sees_budget}
        trials = bench.try_settings(runs, scene, once)
        tuned = {multiple: bench.tune(runs, at, list(WAYS), trials=trials) for multiple, at in scenes.items()}
        settings = {f"{100 / multiple:g} %": parts.tuned_in_words(own) for multiple, own in tuned.items()}
    return StudyReport(
        name="ways",
        title="Ten ways to keep a rated power",
        summary="The first author's compressor and duct; each way at its best setting for each rated power.",
        fs=scene.fs,
        rated_power=scene.rated_power,
        parameters={name: Parameter(own, f"best and tried; {Tuned.RULE}") for name, own in settings.items()},
        tables=[_table(scenes, tuned)],
    )


def _grids() -> list[tuple[str, Any]]:
    return list(grids(WAYS).items())


def _improved() -> dict[str, Algorithm]:
    """Return the entry of the rival, which identifies its primary path in the half second before the control."""

    def settings(scene: Scene, mu: float, _: float) -> dict[str, Any]:
        return {"step_size": mu, "rated_power": scene.rated_power, "primary": [0.0] * N_PRIMARY}

    steps = REGISTRY["MOV-FxLMS"].first
    return {IMPROVED: Algorithm(ImprovedMOV, settings, "mu", "mu L E[x'^2]", steps)}


def _table(scenes: dict[float, Scene], tuned: dict[float, dict[str, Tuned]]) -> Table:
    """Return a line for each way, with noise reduction and power over the rated one at each rated power."""
    bounds: list[str | float] = ["bound", "(R' + g R) w = p", "the whole record", "power"]
    lines = {name: [name, *WAYS[name]] for name in WAYS}
    for multiple, at in scenes.items():
        x, d = at.settled
        bound = power_constrained_solution(x, at.plant, n_taps=at.n_taps, rated_power=at.rated_power, disturbance=d)
        bounds += [f"{bound.noise_reduction_db:.1f}", "1.00"]
        for name, best in tuned[multiple].items():
            chosen = next(trial for trial in best.trials if trial.setting == best.setting)
            lines[name] += [f"{chosen.noise_reduction_db:.1f}", f"{chosen.output_power / at.rated_power:.2f}"]
    headings = ["way", "law", "must know", "keeps, by derivation"]
    for multiple in scenes:
        headings += [f"dB at {100 / multiple:g} %", "power"]
    return Table(
        "ways",
        "Noise reduction in dB and power over the rated one, over the steady half, if the rated power is 25 % and 10 % of what "
        "full control takes",
        headings,
        [bounds, *lines.values()],
    )
