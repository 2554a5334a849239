"""The figures of the pages on constraints, on a path that is not exactly known, and on feedback control.

``python docs/page_figures.py docs/figures`` draws them.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.signal import lfilter

from kfopc_filterpy import (
    Plant,
    SimulationResult,
    kf_opc,
    kf_pb,
    power_constrained_wiener,
    simulate,
)
from kfopc_filterpy.bounds import PowerConstrainedWiener, power_constrained_solution, predictor_reference
from kfopc_filterpy.controllers import with_internal_model
from kfopc_filterpy.paths import PathTolerance, path_taps, perturbed_path
from kfopc_filterpy.plot import curve_style
from kfopc_filterpy.signals import band_limited_noise

FS = 16000.0
RATED_POWER = 2.1  # a quarter of what the unconstrained filter takes
POWERS = tuple(np.linspace(0.3, 2.2, 12).tolist())  # over the rated power
DELAYS = tuple(np.linspace(-1.0, 1.0, 9).tolist())  # error of the estimated path in samples

Reduction = dict[str, list[float]]


class WeakLoudspeaker:
    """The example of the page on constraints: a loudspeaker that is weak at low frequencies."""

    plant = Plant([0.0, 0.0, 0.0, 1.0, -0.8], primary=np.eye(60)[40], fs=FS)

    def __init__(self, duration_s: float = 4.0) -> None:
        self.x = band_limited_noise((100, 2000), duration_s, fs=FS, rng=1)

    def bound(self, rated_power: float) -> PowerConstrainedWiener:
        """Return the best filters of a power."""
        return power_constrained_wiener(
            self.x, self.plant, n_taps=160, rated_power=rated_power, switch_on_s=0.5, ridge=1e-6
        )

    def runs(self) -> dict[str, SimulationResult]:
        """Return the runs of two controllers of the same rated power."""
        settings: dict[str, Any] = {"state_noise": 1e-9, "measurement_noise": 1e-3, "initial_variance": 0.1}
        controllers = [
            kf_opc(160, self.plant, rated_power=RATED_POWER, **settings),
            kf_pb(160, self.plant, rated_power=RATED_POWER),
        ]
        return {run.algorithm: run for run in simulate(controllers, self.x, self.plant, switch_on_s=0.5)}


def constraint() -> Figure:
    """Return the noise reduction that a power buys: the bounds, and what controllers reach."""
    example = WeakLoudspeaker()
    bounds = [example.bound(power * RATED_POWER) for power in POWERS]
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    ax = figure.subplots()
    ax.plot(POWERS, [bound.whole.noise_reduction_db for bound in bounds], "k-", label="bound")
    ax.plot(POWERS, [bound.scaled.noise_reduction_db for bound in bounds], "k--", label="best filter, scaled")
    for name, run in example.runs().items():
        style = curve_style(name) | {"linestyle": "none", "markersize": 9}
        ax.plot(run.output_power / RATED_POWER, run.noise_reduction_db, label=name, **style)
    ax.axvline(1.0, color="0.6", linewidth=1)
    ax.set(xlabel="Output power / rated power", ylabel="Noise reduction (dB)")
    ax.legend(frameon=False)
    ax.grid(alpha=0.3)
    return figure


def delayed_estimates(delays: Sequence[float] = DELAYS, duration_s: float = 5.0) -> Reduction:
    """Return the noise reduction by controller, one for each delay error of the estimated path."""
    secondary, primary, rate = np.array([0.0, 0.0, 0.0, 1.0, -0.6]), np.eye(10)[8] * 0.8 + np.eye(10)[9] * 0.4, 8000.0
    plant = Plant(secondary, primary, fs=rate)
    x = np.random.default_rng(1).standard_normal(int(duration_s * rate))
    tolerances = {
        "KF-OPC, taken as exact": None,
        "KF-OPC, half a sample": PathTolerance(delay_samples=0.5),
        "KF-OPC, one sample": PathTolerance(delay_samples=1),
    }
    found: Reduction = {name: [] for name in (*tolerances, "KF-PB")}
    for delay in delays:
        estimate = path_taps(perturbed_path(secondary, fs=rate, delay_samples=delay)) if delay else secondary
        controllers: dict[str, Any] = {"KF-PB": kf_pb(24, estimate, rated_power=0.3, fs=rate)}
        for name, tolerance in tolerances.items():
            controllers[name] = kf_opc(24, estimate, rated_power=0.3, fs=rate, state_noise=1e-9, measurement_noise=1e-3)
            controllers[name].secondary_path_uncertainty = tolerance
        for name, controller in controllers.items():
            found[name].append(simulate(controller, x, plant).noise_reduction_db)
    return found


def uncertainty() -> Figure:
    """Return the noise reduction against the delay error of the estimated path."""
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    ax = figure.subplots()
    for k, (name, reductions) in enumerate(delayed_estimates().items()):
        ax.plot(DELAYS, reductions, label=name, **curve_style(name if name == "KF-PB" else k + 1))
    ax.set(xlabel="Delay error of the estimated path (samples)", ylabel="Noise reduction (dB)")
    ax.legend(frameon=False)
    ax.grid(alpha=0.3)
    return figure


def predictions(delays: Sequence[int] = range(9), duration_s: float = 10.0) -> Reduction:
    """Return the noise reduction of feedback control, one for each delay of the secondary path in samples."""
    pole, rate, rated = 0.95, 8000.0, 0.3
    d = lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], np.random.default_rng(0).standard_normal(int(duration_s * rate)))
    half = d[d.size // 2 :]
    found: Reduction = {name: [] for name in ("closed form", "bound", "KF-PB", "KF-OPC")}
    for delay in delays:
        plant = Plant(np.eye(delay + 1)[delay], fs=rate)
        bound = power_constrained_solution(
            predictor_reference(half), plant, n_taps=8, rated_power=rated, disturbance=half
        )
        controllers = (
            kf_pb(8, plant, rated_power=rated, averaging_s=4.0),
            kf_opc(8, plant, rated_power=rated, state_noise=1e-12, measurement_noise=0.3),
        )
        runs = simulate([with_internal_model(c) for c in controllers], None, plant, disturbance=d)
        best = -10 * np.log10(1 - pole ** (2 * (delay + 1)))
        reached = [run.noise_reduction_db for run in runs]
        for own, value in zip(found.values(), (best, bound.noise_reduction_db, *reached), strict=True):
            own.append(value)
    return found


def feedback() -> Figure:
    """Return the noise reduction of feedback control against the delay of the secondary path."""
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    ax = figure.subplots()
    limits = {
        "closed form": ("k--", "best predictor, without a limit"),
        "bound": ("k-", "bound within the rated power"),
    }
    for name, reductions in predictions().items():
        if name in limits:
            line, label = limits[name]
            ax.plot(reductions, line, label=label)
        else:
            ax.plot(reductions, label=name, **curve_style(name) | {"linestyle": "none"})
    ax.set(xlabel="Delay of the secondary path (samples)", ylabel="Noise reduction (dB)")
    ax.legend(frameon=False)
    ax.grid(alpha=0.3)
    return figure


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    for draw in (constraint, uncertainty, feedback):
        draw().savefig(folder / f"{draw.__name__}.png", dpi=130)
