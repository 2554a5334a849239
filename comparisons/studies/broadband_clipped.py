"""Runs of the broadband study with an amplifier that clips, which the paper does not show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult
from kfopc_filterpy.metrics import peak_control_signal

from ..bench import Claim, Runs, Scene, Table, Tuned
from .cases import Results, run_seeds
from .report_parts import first_second_db
from .rows import span

KNOWING = "KF-OPC, known amplifier"
UNAWARE = "KF-OPC, q without the clipping"
# Figures of each seed, with which a run's start is judged.
FIRST, STEADY = "first_second_noise_reduction_db", "steady_noise_reduction_db"
PEAK, POWER = "peak_control_signal_of_the_whole_run", "output_power_of_each_seed"
START_DB = 1.0  # that the first second may lack


def run_clipped(runs: Runs, scene: Scene, clipped: Scene, tuned: Mapping[str, Tuned]) -> Results:
    """Return the runs with the amplifier that clips, and those of KF-OPC with the q of a linear amplifier.

    That q is right if the disturbance estimate knows the amplifier, e + s^ * amplifier(y).
    """
    unaware = replace(clipped, measurement_noise=scene.measurement_noise)
    knowing = replace(unaware, known_amplifier=clipped.amplifier)
    own = {"KF-OPC": tuned["KF-OPC"]}
    return run_seeds(runs, clipped, tuned) | {
        name: run_seeds(runs, other, own)["KF-OPC"] for name, other in ((UNAWARE, unaware), (KNOWING, knowing))
    }


def starts(results: Sequence[SimulationResult]) -> dict[str, list[float]]:
    """Return each seed's figures of the start, which the steady half does not show."""
    return {
        FIRST: [first_second_db(r) for r in results],
        STEADY: [r.noise_reduction_db for r in results],
        PEAK: [peak_control_signal(r.control_signal, steady=1.0) for r in results],
        POWER: [r.output_power for r in results],
    }


def clipped_claims(clipped: Mapping[str, Mapping[str, Any]], rated_power: float) -> list[Claim]:
    """Return the claims about the amplifier that clips, which the paper does not make, from figures of each seed."""
    opc = {key: np.array(clipped["KF-OPC"][key]) for key in (FIRST, STEADY, POWER)}
    where = "the amplifier clips; the seed for which it is worst"
    return [
        Claim(
            "KF-OPC's noise reduction in the first second less the steady one (dB)",
            np.min(opc[FIRST] - opc[STEADY]),
            at_least=-START_DB,
            note=where,
        ),
        Claim(
            "KF-OPC's output power over the rated one",
            np.max(opc[POWER]) / rated_power,
            at_most=Tuned.BUDGET,
            note=where,
        ),
    ]


def starts_table(clipped: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return the least and the largest figures of all seeds with the amplifier that clips."""
    shown = {FIRST: "first second (dB)", STEADY: "steady half (dB)", PEAK: "peak", POWER: "output power"}
    return Table(
        "clipped",
        "The amplifier clips: noise reduction and control signal, least and most of all seeds",
        ["algorithm", *shown.values()],
        [[name, *(span(own[key]) for key in shown)] for name, own in clipped.items()],
    )
