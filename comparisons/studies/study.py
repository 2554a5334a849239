"""Parts of a study's report that the studies share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult
from kfopc_filterpy.bench.registry import POWER_MEMORY_S, REGISTRY, setting_value
from kfopc_filterpy.bench.report import FigureItem, Parameter, Sound
from kfopc_filterpy.bench.scene import SENSOR_NOISE_SEED, Scene
from kfopc_filterpy.bench.tuning import RULE, Tuned
from kfopc_filterpy.bounds import power_constrained_solution
from kfopc_filterpy.plot import plot_bode

BANDPASS_PATHS = {
    "primary_path": Parameter("band-pass FIR, 20-5000 Hz, 128 taps", "the paper's; Hamming window"),
    "secondary_path": Parameter("band-pass FIR, 20-5000 Hz, 32 taps", "the paper's; Hamming window"),
}


def draw(stem: str, caption: str, *panels: Callable[[Any], Any]) -> FigureItem:
    """A figure of a panel or several side by side, each drawn by a function of its axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.0) if len(panels) == 1 else (5.5 * len(panels), 3.8), layout="constrained")
    for panel, ax in zip(panels, figure.subplots(1, len(panels), squeeze=False)[0], strict=True):
        panel(ax)
    return FigureItem(stem, caption, figure)


def draw_paths(caption: str, paths: Mapping[str, Any]) -> FigureItem:
    """Bode plot of the paths of a study."""
    return FigureItem("paths", caption, np.ravel(plot_bode(paths))[0].figure)


def ceiling_note(scene: Scene) -> str:
    """The ceiling of every constrained algorithm, as a sentence."""
    bound = power_constrained_solution(*scene.settled, scene.secondary, scene.n_taps, scene.rated_power)
    return (
        f"The ceiling: within the rated power a fixed filter of {scene.n_taps} taps reaches {bound.noise_reduction_db:.2f} "
        "dB with a linear amplifier (power-constrained Wiener solution)."
    )


def common_parameters(scene: Scene, tuned: Mapping[str, Tuned]) -> dict[str, Parameter]:
    """Parameters that every study states, with how each was chosen."""
    parameters = {
        "fs_hz": Parameter(scene.fs, "the rate of the measured duct; the paper does not state its own"),
        "rated_power": Parameter(scene.rated_power, "the paper's"),
        "n_taps": Parameter(scene.n_taps, "not stated in the paper; enough for the primary path's delay and length"),
        "wiener_control_power": Parameter(
            scene.wiener_control_power,
            f"the reference is scaled so that the unconstrained Wiener control power is "
            f"{scene.wiener_control_power / scene.rated_power:g} times the rated power: the constraint has to act",
        ),
        "wiener_noise_reduction_db": Parameter(
            scene.wiener_noise_reduction_db, "batch least squares, unconstrained, without sensor noise"
        ),
        "reference_power": Parameter(float(np.mean(scene.references[0] ** 2)), "follows from the control power"),
        "sensor_noise_std": Parameter(scene.sensor_noise_std, "60 dB below the disturbance"),
        "measurement_noise_q": Parameter(
            scene.measurement_noise, "estimate of eq. 7: residual of a batch fit to a run without control"
        ),
        "initial_variance_P0": Parameter(
            scene.initial_variance, "Wiener control power over n_taps and reference power: the weights' expected square"
        ),
        "power_memory_s": Parameter(POWER_MEMORY_S, "exponential window; the package's default"),
        "secondary_path_estimate": Parameter("exact", "the paper models no mismatch"),
        "switch_on_s": Parameter(
            scene.switch_on_s,
            "the noise runs before the control is switched on, so that delay lines and powers are those of the noise",
        ),
        "nse_window_s": Parameter(scene.nse_window_s, "5 ms; 50 ms where one random run would not settle at 5 ms"),
        "seeds": Parameter(scene.seeds, "of the noise, where it is random"),
        "sensor_noise_seeds": Parameter([SENSOR_NOISE_SEED + seed for seed in scene.seeds], "apart from the noise's"),
    }
    for name, best in tuned.items():
        symbol, kind = REGISTRY[name].symbol, REGISTRY[name].kind
        parameters[f"{name} {symbol}"] = Parameter(
            setting_value(scene, name, best.setting), "follows from the next line"
        )
        parameters[f"{name} {kind}"] = Parameter(best.setting, f"tuned: {RULE}")
        parameters[f"{name} settings tried"] = Parameter(
            [
                (t.setting, round(t.mean_nse_db, 3), round(t.output_power, 4))
                if not t.diverged
                else (t.setting, "diverged")
                for t in best.trials
            ],
            "setting, mean NSE in dB, output power",
        )
    return parameters


def tuning_note(tuned: Mapping[str, Tuned]) -> list[str]:
    """What has to be said of the settings: those that kept no budget."""
    over = [name for name, best in tuned.items() if not best.within_budget]
    notes = [
        f"{name} kept its budget to 2 % at no setting tried; the one of lowest mean NSE is shown." for name in over
    ]
    edge = [f"{name} ({best.setting:g})" for name, best in tuned.items() if best.at_edge]
    if edge:
        notes.append(
            f"At the edge of the grid: {', '.join(edge)}. The grid of the Kalman filters ends where they would hardly "
            "forget in a run; on stationary noise less forgetting is always better, and no longer a random walk."
        )
    return notes


def first_second_db(result: SimulationResult) -> float:
    """Noise reduction over the first second in dB."""
    first = slice(0, int(result.fs))
    return float(-10 * np.log10(np.sum(result.error[first] ** 2) / np.sum(result.disturbance[first] ** 2)))


def milliseconds(time_s: float | None) -> str:
    """A convergence time in words."""
    return "does not settle" if time_s is None or np.isnan(time_s) else f"{1e3 * time_s:.1f} ms"


def sounds(results: Mapping[str, SimulationResult]) -> list[Sound]:
    """The disturbance and what each algorithm leaves of it."""
    first = next(iter(results.values()))
    heard = [Sound("disturbance", "disturbance, control off", first.disturbance)]
    return heard + [Sound(name.lower(), f"residual of {name}", r.error) for name, r in results.items()]
