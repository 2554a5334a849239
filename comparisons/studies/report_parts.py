"""Parts of a study's report that several studies have: parameters, notes, tables, figures, sounds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult, noise_reduction_db
from kfopc_filterpy.bounds import power_constrained_solution
from kfopc_filterpy.plot import curve_style, plot_bode

from ..bench import FigureItem, Parameter, Scene, Sound, StudyReport, Trial, Tuned, algorithms
from .cases import BAND_HZ, FS, N_TAPS, SEED, SENSOR_NOISE_DB, SWITCH_ON_S, TONE_HZ, Setup, bounds_db

MARK = "0.35"  # colour of reference lines


def report_of_rows(rows: Iterable[Any], **report: Any) -> StudyReport:
    """Return the report of a study beyond the paper, with its rows for results.json."""
    own: dict[str, Any] = {"fs": FS, "rated_power": 1.0} | report
    return StudyReport(**own | {"extra": {"rows": [asdict(row) for row in rows]} | own.get("extra", {})})


def report_of_paper(scene: Scene, tuned: Mapping[str, Tuned], **report: Any) -> StudyReport:
    """Return the report of one of the paper's studies; its own parameters follow those that all of them state."""
    common: dict[str, Any] = {"fs": scene.fs, "rated_power": scene.rated_power}
    common["notes"] = [*tuning_note(tuned), ceiling_note(scene)]
    return StudyReport(**common | report | {"parameters": common_parameters(scene, tuned) | report["parameters"]})


# ---- Figures


def draw(stem: str, caption: str, *panels: Callable[[Any], Any]) -> FigureItem:
    """Return a figure of one panel, or of several side by side, each drawn by a function of its axes."""
    figure, axes = new_figure((7.0, 4.0) if len(panels) == 1 else (5.5 * len(panels), 3.8), 1, len(panels))
    for panel, ax in zip(panels, axes[0], strict=True):
        panel(ax)
    return FigureItem(stem, caption, figure)


def draw_paths(caption: str, paths: Mapping[str, Any]) -> FigureItem:
    """Return a Bode plot of the paths of a study."""
    return FigureItem("paths", caption, np.ravel(plot_bode(paths))[0].figure)


def new_figure(
    size: tuple[float, float], rows: int = 1, columns: int = 1, *, grid: str = "both", **shared: Any
) -> tuple[Any, Any]:
    """Return a figure that pyplot does not know, and its axes as an array (rows, columns); `grid` is "" for none."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **shared)
    for ax in axes.flat if grid else ():
        ax.grid(True, axis=grid, alpha=0.3)
    return figure, axes


def thin_style(algorithm: str) -> dict[str, Any]:
    """Return an algorithm's style for a curve of many points: solid, without markers."""
    return {**curve_style(algorithm), "linestyle": "-", "linewidth": 1.1, "marker": ""}


def legend_of(figure: Any, axes: Any) -> None:
    """Draw one legend for several axes of a figure above them, with each name once."""
    entries: dict[str, Any] = {}
    for ax in axes:
        entries |= {label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    room = 13.5 * figure.get_figwidth()  # characters of a row, the lines before the names included
    rows = int(np.ceil(sum(len(label) + 7 for label in entries) / room))
    columns = int(np.ceil(len(entries) / rows))
    figure.legend(entries.values(), entries, loc="outside upper center", ncols=columns, frameon=False, fontsize="small")


# ---- Parameters and notes


def bandpass_parameters(setup: Setup) -> dict[str, Parameter]:
    """Return the band-pass paths of the paper's first two studies."""
    band = f"band-pass FIR, {setup.band_hz[0]:g}-{setup.band_hz[1]:g} Hz"
    taps = {"primary_path": setup.primary_taps, "secondary_path": setup.secondary_taps}
    return {name: Parameter(f"{band}, {n} taps", f"{setup.source}; Hamming window") for name, n in taps.items()}


def ceiling_note(scene: Scene) -> str:
    """Return the ceiling of every constrained algorithm as a sentence."""
    x, d = scene.settled
    n_taps, rated_power = scene.n_taps, scene.rated_power
    bound = power_constrained_solution(x, scene.plant, n_taps=n_taps, rated_power=rated_power, disturbance=d)
    return (
        f"The ceiling: within the rated power a fixed filter of {scene.n_taps} taps reaches {bound.noise_reduction_db:.2f} "
        "dB with a linear amplifier (power-constrained Wiener solution)."
    )


def common_parameters(scene: Scene, tuned: Mapping[str, Tuned]) -> dict[str, Parameter]:
    """Return the parameters that the paper's studies state, with how each was chosen."""
    parameters = {
        "fs_hz": Parameter(scene.fs, "the rate of the measured duct; the paper does not state its own"),
        "rated_power": Parameter(scene.rated_power, "the paper's"),
        "n_taps": Parameter(
            scene.n_taps,
            "not stated in the paper; enough for the primary path's delay and length, or as in its authors' code",
        ),
        "wiener_control_power": Parameter(
            scene.unconstrained_power, "the reference is scaled to it: the constraint acts"
        ),
        "wiener_noise_reduction_db": Parameter(scene.wiener_noise_reduction_db, "unconstrained, without sensor noise"),
        "reference_power": Parameter(float(np.mean(scene.references[0] ** 2)), "follows from the control power"),
        "sensor_noise_std": Parameter(scene.sensor_noise_std, "60 dB below the disturbance"),
        "measurement_noise_q": Parameter(scene.measurement_noise, "eq. 7: residual of a batch fit without control"),
        "initial_variance_P0": Parameter(scene.initial_variance, "Wiener control power over L times the reference's"),
        "power_memory_s": Parameter(scene.power_memory_s, f"{scene.power_window} window"),
        "secondary_path_estimate": Parameter("exact", "the paper models no mismatch"),
        "switch_on_s": Parameter(scene.switch_on_s, "the noise runs before, and fills delay lines and powers"),
        "nse_window_s": Parameter(scene.nse_window_s, "5 ms; 50 ms if one random run would not settle at 5 ms"),
        "seeds": Parameter(scene.seeds, "of the noise, if it is random"),
        "sensor_noise_seeds": Parameter(scene.sensor_noise_seeds, "apart from the noise's"),
    }
    for name, best in tuned.items():
        own = algorithms()[name]
        parameters |= {
            f"{name} {own.symbol}": Parameter(own.value(scene, best.setting), "follows from the next line"),
            f"{name} {own.kind}": Parameter(best.setting, f"tuned: {Tuned.RULE}"),
            f"{name} settings tried": Parameter(tried(best.trials), "setting, mean NSE in dB, output power"),
        }
    return parameters


def tried(trials: Iterable[Trial]) -> list[tuple[Any, ...]]:
    """Return what was tried for results.json: setting, mean NSE in dB and output power, or that it diverged."""
    return [
        (t.setting, *(("diverged",) if t.diverged else (round(t.mean_nse_db, 3), np.round(t.output_power, 5).tolist())))
        for t in trials
    ]


def tuned_in_words(tuned: Mapping[str, Tuned | None]) -> dict[str, Any]:
    """Return settings for results.json: the best and all that were tried; None if every one diverged."""
    words: dict[str, Any] = dict.fromkeys(tuned)
    for name, best in tuned.items():
        if best is not None:
            own = {name: getattr(best, name) for name in ("setting", "within_budget", "at_edge")}
            words[name] = {"kind": algorithms()[name].kind, **own, "tried": tried(best.trials)}
    return words


def case_parameters(n_taps: Parameter) -> dict[str, Parameter]:
    """Return the parameters that the studies beyond the paper state."""
    return {
        "fs_hz": Parameter(FS, "the rate of the measured duct"),
        "n_taps": n_taps,
        "unconstrained_control_power": Parameter(1.0, "every noise is scaled to it: (R_x' + q/(N P0) I) w = r"),
        "switch_on_s": Parameter(SWITCH_ON_S, "the noise runs before"),
        "sensor_noise_db": Parameter(SENSOR_NOISE_DB, "below the disturbance"),
    }


def driven_parameters(duration_s: Any, overdrive_db: Any) -> dict[str, Parameter]:
    """Return the parameters of the studies that drive a noise beyond the rated power."""
    return case_parameters(Parameter(N_TAPS, "the tonal study's")) | {
        "duration_s": Parameter(duration_s, "from switch-on on; the steady half counts"),
        "rated_power": Parameter(overdrive_db, "overdrive in dB: the unconstrained control power over the rated power"),
        "tone_hz": Parameter(TONE_HZ, "within the band"),
        "band_hz": Parameter(list(BAND_HZ), "where both ducts carry sound"),
        "seed": Parameter(SEED, "of noise; of a tone, its phase"),
        "rule": Parameter(Tuned.RULE, "for all algorithms; the settings tried and the best are below"),
    }


def ceilings_note(scenes: Mapping[str, Scene]) -> str:
    """Return the ceiling of every constrained algorithm in each scene as a sentence."""
    reached = [f"{name}: {bounds_db(scene, True)[0]:.1f} dB" for name, scene in scenes.items()]
    return (
        "The ceiling within the rated power, of one fixed filter for the whole run, over the steady half, with a linear "
        f"amplifier and no sensor noise (power-constrained Wiener solution): {'; '.join(reached)}."
    )


def without_measured(names: Iterable[str]) -> list[str]:
    """Return the note that the measured duct is left out, if it is."""
    if "measured duct" in names:
        return []
    return ["The measured duct was not at hand (KFOPC_DATA): it is left out."]


def tuning_note(tuned: Mapping[str, Tuned]) -> list[str]:
    """Return the notes on the settings: which kept no budget, and which lie at the edge of the grid."""
    over = [name for name, best in tuned.items() if not best.within_budget]
    notes = [f"{name} kept its budget at no setting tried; the one of lowest mean NSE is shown." for name in over]
    edge = [f"{name} ({best.setting:g})" for name, best in tuned.items() if best.at_edge]
    if edge:
        notes.append(
            f"At the edge of the grid: {', '.join(edge)}. The grid of the Kalman filters ends where they would hardly "
            "forget in a run; on stationary noise less forgetting is always better, and no longer a random walk."
        )
    return notes


def first_second_db(result: SimulationResult) -> float:
    """Return the noise reduction over the first second in dB."""
    first = slice(0, int(result.fs))
    return noise_reduction_db(result.error[first], result.disturbance[first], steady=1.0)


def milliseconds(time_s: float | None) -> str:
    """Return a convergence time in words."""
    return "does not settle" if time_s is None or np.isnan(time_s) else f"{1e3 * time_s:.1f} ms"


def sounds(results: Mapping[str, SimulationResult]) -> list[Sound]:
    """Return the disturbance, and what each algorithm leaves of it."""
    first = next(iter(results.values()))
    heard = [Sound("disturbance", "Control off", first.disturbance)]
    return heard + [Sound(name.lower(), name, r.error) for name, r in results.items()]
