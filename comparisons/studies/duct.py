"""Study 3: machine noise in a duct (the paper's Fig. 7), with a modelled duct and with measured ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from textwrap import shorten
from typing import Any

import numpy as np

from kfopc_filterpy import Plant, SimulationResult
from kfopc_filterpy.bounds import power_constrained_solution, wiener_solution
from kfopc_filterpy.metrics import overshoot
from kfopc_filterpy.paths import Duct, duct_plant, fir_path, secondary_path_gain
from kfopc_filterpy.plot import curve_style, plot_error_spectra, plot_nse, plot_output_power
from kfopc_filterpy.plot.style import labelled
from kfopc_filterpy.signals import compressor_noise

from .. import bench
from ..bench import Claim, FigureItem, Parameter, Runs, Scene, StudyReport, Table
from ..bench.measured import DataUnavailableError, MeasuredDuct, load_measured_duct
from . import report_parts as parts
from .cases import AUTHORS, CHOSEN, FS, PAPER, SEED, grid_runs, of_unit_gain, run_each
from .duct_start import Start, faster_claims, start_table, start_under_constraint

DURATION_S = 10.5
RATED_POWER = 0.5
POWER_MULTIPLE = 4.0
N_TAPS = 256
NSE_WINDOW_S = 0.05
FIXED = "MOV-FxLMS by variance"
ALGORITHMS = (*PAPER, FIXED, "KF-PB")
RATED = ("KF-OPC", "KF-PB", "MOV-FxLMS", FIXED)  # those with a rated power

# What the claims call keeping the rated power, over the steady half and over the worst second, and disregarding it.
KEPT, KEPT_OVER_1_S, DISREGARDED = 1.02, 1.1, 1.5

OWNERS = {"author": "the paper's first author", "gfanc": "GFANC-Kalman"}
MEASURED = {  # duct, noise, and whether they are the paper's
    "duct-measured": (
        "author",
        "compressor",
        "duct and noise are probably the paper's, because its first author published both, the duct eight days before the "
        "preprint; no source says so",
    ),
    "duct-authors": (
        "author",
        "compressor",
        "the same with the levels and the power estimates of the authors' code",
    ),
    "duct-second": ("gfanc", "compressor", "published by the paper's first author; the duct is of other authors"),
    "duct-motor": ("gfanc", "motor", "a noise whose level varies; not the paper's"),
}


@dataclass(frozen=True)
class Figures:
    """What the claims need of a run; powers are over the rated power."""

    noise_reduction_db: float  # over the steady half, by energy
    mean_nse_db: float  # over the whole run, the measure of the paper's figure
    power: float  # over the steady half
    worst_second: float
    worst_50_ms: float


def planned_runs() -> int:
    """Return the number of runs of the study, of either duct."""
    return grid_runs(ALGORITHMS) + len(ALGORITHMS)


def main(runs: Runs) -> StudyReport:
    """Run the study with the built-in duct and compressor-like noise."""
    duct = Duct()
    parameters = {
        "noise": Parameter("fluctuating shaft harmonics and broadband noise, as of a compressor", "seeded stand-in"),
        "primary_path": Parameter(f"modelled duct, {duct.length_m:g} m", "defaults of duct_plant"),
        "secondary_path": Parameter(f"loudspeaker at {duct.loudspeaker_m:g} m", "defaults of duct_plant"),
    }
    noise = compressor_noise(DURATION_S, fs=FS, rng=SEED)
    return _study(runs, "duct", "Machine noise in a modelled duct", noise, duct_plant(duct, fs=FS), parameters)


def at_hand(study: str, name: str) -> MeasuredDuct | str:
    """Return the duct and noise of a study with a measured duct, or a line that says why another study is left out."""
    duct, noise, _ = MEASURED[name]
    try:
        return load_measured_duct(noise, duct)
    except DataUnavailableError as error:
        return (
            f"{study} is left out: set KFOPC_DATA to a folder with the measured data, or run again with a network "
            f"({shorten(str(error), 120, placeholder=' ...')})"
        )


def measured(runs: Runs, name: str) -> StudyReport | str:
    """Run the study with a measured duct and a recorded noise; without them return a line that says why."""
    data = at_hand(name, name)
    if isinstance(data, str):
        return data
    duct, noise, remark = MEASURED[name]
    owner = OWNERS[duct]
    parameters = {
        "noise": Parameter(f"recorded {noise} noise, mean removed", remark),
        "primary_path": Parameter(f"duct of {owner}, {data.primary.size} taps", "as published, scale arbitrary"),
        "secondary_path": Parameter("of the same duct", "scaled to unit gain for white noise"),
    }
    title = f"Recorded {noise} noise in the duct of {owner}"
    return _study(runs, name, title, data.noise - data.noise.mean(), of_unit_gain(data), parameters)


def scene_of(noise: np.ndarray, plant: Plant, *, as_authors: bool = False) -> Scene:
    """Return the scene of a noise in a duct, which takes the multiple of the rated power, or has their unit variance."""
    setup, multiple = (AUTHORS, None) if as_authors else (replace(CHOSEN, n_taps=N_TAPS), POWER_MULTIPLE)
    levels: dict[str, Any] = {"rated_power": RATED_POWER, "power_multiple": multiple, "nse_window_s": NSE_WINDOW_S}
    return setup.scene({SEED: noise / np.std(noise)}, plant, **levels)


def _study(
    runs: Runs, name: str, title: str, noise: np.ndarray, plant: Plant, parameters: dict[str, Parameter]
) -> StudyReport:
    scene = scene_of(noise, plant, as_authors=name == "duct-authors")
    tuned = bench.tune(runs, scene, ALGORITHMS)
    results = run_each(runs, scene, {name: best.setting for name, best in tuned.items()})
    figures = {algorithm: figures_of(result, RATED_POWER) for algorithm, result in results.items()}
    start = start_under_constraint(scene, tuned, results["KF-OPC"].constraint_factor)
    x, d = scene.settled
    wiener = wiener_solution(x, plant, n_taps=scene.n_taps, disturbance=d)
    reference_gain = float(secondary_path_gain(scene.secondary, reference=x))
    control_gain = float(wiener.antinoise_power / wiener.control_power)
    bound = power_constrained_solution(x, plant, n_taps=scene.n_taps, rated_power=RATED_POWER, disturbance=d)
    return parts.report_of_paper(
        scene,
        tuned,
        name=name,
        title=title,
        summary=(
            f"The noise needs {scene.unconstrained_power / RATED_POWER:.3g} times the rated power of {RATED_POWER:g}; the "
            "amplifier is linear. "
            f"The noise: {parameters['noise'].value} ({parameters['noise'].chosen})."
        ),
        parameters=parameters
        | {
            "duration_s": Parameter(results["KF-OPC"].error.size / FS, "10 s, or what the recording holds"),
            "amplifier": Parameter("linear", "the paper names no clipping here"),
        },
        algorithms={algorithm: bench.figures_of_merit([result], scene) for algorithm, result in results.items()},
        extra={
            "gain_of_the_reference_eq_11": reference_gain,
            "gain_of_the_wiener_control_signal": control_gain,
            "best_noise_reduction_within_the_power_db": bound.noise_reduction_db,
            "figures": {algorithm: asdict(own) for algorithm, own in figures.items()},
            "start_under_constraint": None if start is None else asdict(start),
        },
        claims=claims(figures, start),
        tables=[
            _rating_table(figures),
            Table(
                "gains",
                "Power gain of the secondary path, which eq. 11 takes from the reference, and the ceiling",
                [
                    "for the reference",
                    "for the unconstrained control signal",
                    "best noise reduction within the power (dB)",
                ],
                [[reference_gain, control_gain, bound.noise_reduction_db]],
            ),
            *start_table(start),
        ],
        figures=_figures_of(results, plant),
        sounds=parts.sounds({algorithm: results[algorithm] for algorithm in PAPER}),
    )


def figures_of(result: SimulationResult, rated_power: float) -> Figures:
    """Return the figures that the claims need of a run."""
    return Figures(
        noise_reduction_db=result.noise_reduction_db,
        mean_nse_db=float(np.mean(result.nse_db(NSE_WINDOW_S))),
        power=float(result.output_power / rated_power),
        worst_second=overshoot(result.control_signal, rated_power, FS, window_s=1.0),
        worst_50_ms=overshoot(result.control_signal, rated_power, FS),
    )


# ---- Claims


def claims(figures: Mapping[str, Figures], start: Start | None) -> list[Claim]:
    """Return the paper's claims; a figure that is NaN, of a run that diverged, meets none."""
    anc, opc, mov = (figures[name] for name in ("KF-ANC", "KF-OPC", "MOV-FxLMS"))
    others = max(figures[name].noise_reduction_db for name in PAPER if name != "KF-ANC")
    return [
        Claim("Noise reduction of KF-ANC less the next best (dB)", anc.noise_reduction_db - others, at_least=0.0),
        Claim("Output power of KF-ANC over the rated one", anc.power, at_least=DISREGARDED),
        Claim("Output power of KF-OPC over the rated one, steady half", opc.power, at_most=KEPT),
        Claim("The same over the worst second", opc.worst_second, at_most=KEPT_OVER_1_S),
        *faster_claims(start),
        Claim(
            "KF-OPC's distance from the rated power, over it, less MOV-FxLMS's",
            abs(opc.power - 1.0) - abs(mov.power - 1.0),
            at_most=0.0,
        ),
        Claim(
            "Mean NSE of KF-OPC less that of MOV-FxLMS (dB)",
            opc.mean_nse_db - mov.mean_nse_db,
            at_most=0.0,
            note="the measure of the paper's figure",
        ),
    ]


# ---- Table and figures


def _rating_table(figures: Mapping[str, Figures]) -> Table:
    return Table(
        "rated",
        "The algorithms with a rated power; powers are over it",
        ["algorithm", "noise reduction dB", "mean NSE dB", "power", "worst second", "worst 50 ms"],
        [[name, *astuple(own)] for name, own in figures.items() if name in RATED],
    )


def _figures_of(results: Mapping[str, SimulationResult], plant: Plant) -> list[FigureItem]:
    group = list(results.values())
    assert plant.primary is not None
    paths = {"primary path": plant.primary[0, 0], "secondary path": plant.secondary[0, 0]}

    def spectra(names: Sequence[str], ax: Any) -> None:
        # With longer segments the harmonics are so sharp that the curves hide each other.
        plot_error_spectra([results[name] for name in names], band=(0, 3000), segment_s=0.05, ax=ax)

    def factors(ax: Any) -> None:
        for name in ("KF-OPC", "MOV-FxLMS"):
            run, style = results[name], curve_style(name) | {"marker": ""}
            ax.plot(run.time_s[::100], run.constraint_factor[::100], label=name, **style)
        labelled(ax, xlabel="Time (s)", ylabel="Constraint factor α").set_ylim(0, 1.05)

    return [
        parts.draw(
            "a-nse",
            "Normalised squared error over 50 ms (Fig. 7 a).",
            lambda ax: plot_nse(group, window_s=NSE_WINDOW_S, ax=ax),
        ),
        parts.draw(
            "b-error-spectra",
            "Power spectra of disturbance and error signals over the steady half, in steps of 20 Hz (Fig. 7 b). Left: "
            "without a rated power; right: with one. MOV-FxLMS by variance is in the table.",
            lambda ax: spectra([name for name in PAPER if name not in RATED], ax),
            lambda ax: spectra([name for name in RATED if name != FIXED], ax),
        ),
        parts.draw(
            "output-power",
            "Output power over 0.25 s, and the rated power.",
            lambda ax: plot_output_power(group, rated_power=RATED_POWER, ax=ax),
        ),
        parts.draw(
            "constraint-factor",
            "Constraint factor. Both follow the same powers, so the lines coincide if the residuals are alike.",
            factors,
        ),
        parts.draw_paths(
            "Primary and secondary path.", {name: fir_path(taps, plant.fs) for name, taps in paths.items()}
        ),
    ]
