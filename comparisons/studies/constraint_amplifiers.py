"""Runs of the constraint study with an amplifier that clips, and behind a limiter with further faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from kfopc_filterpy import HardClipAmplifier, OutputLimiter, Plant
from kfopc_filterpy.paths import path_taps, perturbed_path

from ..bench import Scene, Table, Tuned, make_controller
from .cases import FS, WINDOW_S, Case, jumping
from .rows import WindowRow, cell, figures_of

LIMITED = ("KF-OPC limited", "KF-PB limited")
JUMP_DB, JUMP_S = 20.0, (1.0, 2.0)  # of a louder second of a recording, which begins before switch-on

Settings = Mapping[str, Tuned]


@dataclass(frozen=True, kw_only=True)
class ClippedRow(WindowRow):
    """A run with an amplifier that clips at the peak of a sine of rated power."""

    known: str  # what the disturbance estimate knows of the amplifier, or what else is wrong


def controller_of(scene: Scene, name: str, tuned: Settings, amplifier: Any = None) -> Any:
    """Return a fresh controller, behind the limiter if its name says so."""
    algorithm = name.removesuffix(" limited")
    controller = make_controller(scene, algorithm, tuned[name].setting, amplifier=amplifier)
    if algorithm != name:
        controller.limiter = OutputLimiter(scene.rated_power, fs=FS, window_s=WINDOW_S)
    return controller


def run_amplifiers(scene: Scene, plant: Plant, case: Case, tuned: Settings) -> list[ClippedRow]:
    """Run with an amplifier that clips: known, unknown or known wrongly; behind a limiter, with a wrong path or a level jump."""
    limit = scene.amplitude_limit
    clipping = replace(scene, amplifier=HardClipAmplifier(limit))
    known = {
        "unknown": None,
        "known": HardClipAmplifier(limit),
        "limit 20 % too high": HardClipAmplifier(1.2 * limit),
        "limit 20 % too low": HardClipAmplifier(0.8 * limit),
    }
    jobs = [
        (clipping, name, words, controller_of(scene, name, tuned, amplifier))
        for name in ("KF-ANC", "KF-OPC", "KF-PB")
        for words, amplifier in known.items()
    ]
    estimate = path_taps(perturbed_path(scene.secondary, fs=FS, gain_db=6.0, phase_deg=45.0))
    wrong, loud = replace(scene, secondary_estimate=estimate), jumping(clipping, plant, JUMP_S, JUMP_DB)
    for name in LIMITED:
        jobs.append((clipping, name, "path 6 dB, 45° off", controller_of(wrong, name, tuned)))
        jobs.append((loud, name, f"{JUMP_DB:g} dB louder for a second", controller_of(scene, name, tuned)))
    return [
        ClippedRow(**case.place, algorithm=name, known=words, **figures_of(at.run(controller), scene.rated_power))
        for at, name, words, controller in jobs
    ]


def amplifier_table(clipped: Sequence[ClippedRow]) -> Table:
    """Return a line for each run."""
    return Table(
        "amplifier",
        "An amplifier that clips at the peak of a sine of rated power (25 %), and what the disturbance estimate knows of it",
        ["paths", "noise", "algorithm", "amplifier or path", "noise reduction dB", "power", "worst 100 ms"],
        [
            [row.path, row.noise, row.algorithm, row.known]
            + [cell(row, figure) for figure in ("noise_reduction_db", "power", "worst_window")]
            for row in clipped
        ],
    )
