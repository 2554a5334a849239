"""Runs of the broadband study with an amplifier that clips, which the paper does not show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult, noise_reduction_db, output_power
from kfopc_filterpy.metrics import peak_control_signal

from ..bench import Claim, Runs, Scene, Tuned
from .cases import Results, run_seeds
from .report_parts import first_second_db
from .rows import span

KNOWING = "KF-OPC, known amplifier"
UNAWARE = "KF-OPC, q without the clipping"
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
        "first_second_noise_reduction_db": [first_second_db(r) for r in results],
        "steady_noise_reduction_db": [noise_reduction_db(r.error, r.disturbance) for r in results],
        "peak_control_signal_of_the_whole_run": [peak_control_signal(r.control_signal, steady=1.0) for r in results],
        "output_power_of_each_seed": [output_power(r.control_signal) for r in results],
    }


def clipped_claim(clipped: Mapping[str, Mapping[str, Any]], limit: float) -> Claim:
    """Return the claim about the amplifier that clips from the figures of each seed, see `starts`."""
    own = {name: {key: np.array(value) for key, value in figures.items()} for name, figures in clipped.items()}
    first, steady = "first_second_noise_reduction_db", "steady_noise_reduction_db"
    peak, power = "peak_control_signal_of_the_whole_run", "output_power_of_each_seed"
    opc, rated_power = own["KF-OPC"], 0.5 * limit**2  # it clips at the peak of a sine of rated power
    begun, kept = opc[first] >= opc[steady] - START_DB, opc[power] <= Tuned.BUDGET * rated_power

    def start(name: str) -> str:
        return f"{span(own[name][first], '.1f')} dB, control signal up to {span(own[name][peak], '.1f')}"

    return Claim(
        "Where the amplifier clips, KF-OPC is stable from the start and keeps to the rated power (runs that the paper does "
        "not show)",
        bool(begun.size and np.all(begun) and np.all(kept)),
        f"over {begun.size} seeds: steady half {span(opc[steady], '.1f')} dB, output power {span(opc[power], '.3f')} of "
        f"{rated_power:g}; first second {start('KF-OPC')} against a limit of {limit:.2f}: "
        f"{100 * opc['clipped_fraction']:.1f} % of the samples are clipped, as Gaussian noise of that power must be. With the q "
        f"of a linear amplifier, first second {start(UNAWARE)}; with the amplifier known to the disturbance estimate "
        f"{start(KNOWING)}",
    )
