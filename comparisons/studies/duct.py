"""Study 3: machine noise in a duct (the paper's Fig. 7), with a modelled and with a measured duct."""

from __future__ import annotations

from textwrap import shorten
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult, nse_db
from kfopc_filterpy.bench import (
    FigureItem,
    Parameter,
    Runs,
    Scene,
    StudyReport,
    Verdict,
    figures_of_merit,
    make_controller,
    make_scene,
    tune,
)
from kfopc_filterpy.bounds import WienerSolution, power_constrained_solution, wiener_solution
from kfopc_filterpy.metrics import overshoot
from kfopc_filterpy.paths import duct_paths, fir_path, identify_secondary_path, secondary_path_gain
from kfopc_filterpy.plot import (
    plot_causality_margin,
    plot_constraint_factor,
    plot_error_spectra,
    plot_group_delay,
    plot_impulse_responses,
    plot_modelling_error,
    plot_nse,
    plot_output_power,
    plot_phase_error,
    plot_required_rated_power,
    plot_secondary_path_gain,
)
from kfopc_filterpy.signals import DataUnavailableError, compressor_noise, load_measured_duct

from .cases import PAPER, grid_runs
from .parts import ceiling_note, common_parameters, draw, draw_paths, first_second_db, milliseconds, sounds, tuning_note

FS = 16000.0
DURATION_S = 10.5
RATED_POWER = 0.5
POWER_MULTIPLE = 4.0
N_TAPS = 256
NSE_WINDOW_S = 0.05
SEED = 1


def planned_runs() -> int:
    """Return the number of runs of the study, of either duct."""
    return grid_runs(PAPER) + len(PAPER)


def main(runs: Runs) -> StudyReport:
    """Run the study with the built-in duct and compressor-like noise."""
    duct = duct_paths(fs=FS)
    noise = compressor_noise(DURATION_S, fs=FS, rng=SEED)
    parameters = {
        "noise": Parameter("compressor-like: shaft harmonics that fluctuate, and broadband noise", "seeded stand-in"),
        "primary_path": Parameter(f"modelled duct, {duct.model.length_m:g} m", "defaults of duct_paths"),
        "secondary_path": Parameter(
            f"modelled duct, loudspeaker at {duct.model.loudspeaker_m:g} m", "defaults of duct_paths"
        ),
    }
    summary = (
        f"Compressor-like noise in a modelled duct needs {POWER_MULTIPLE:g} times the rated power of {RATED_POWER:g}; "
        "linear amplifier."
    )
    return _study(
        runs, "duct", "Machine noise in a modelled duct", summary, noise, (duct.primary, duct.secondary), parameters
    )


def main_measured(runs: Runs) -> StudyReport | str:
    """Run the study with the measured duct and recorded motor noise; without them return a line that says why."""
    try:
        data = load_measured_duct(allow_download=True)
    except DataUnavailableError as error:
        return shorten(f"duct-measured is left out: {error}", 200, placeholder=" ...")
    parameters = {
        "noise": Parameter("recorded motor noise, mean removed", "stands in for the paper's recording"),
        "primary_path": Parameter(f"measured duct, {data.primary.size} taps", "as published, scale arbitrary"),
        "secondary_path": Parameter(
            f"measured duct, {data.secondary.size} taps, scaled to unit gain for white noise", "scale arbitrary"
        ),
    }
    # The scale of the measured paths is arbitrary: both are divided by the secondary path's gain over white noise.
    scale = float(np.sqrt(np.sum(data.secondary**2)))
    summary = (
        "The measured duct and recorded motor noise, in place of the paper's, which are not public; the same rated "
        "power and multiple as with the modelled duct."
    )
    return _study(
        runs,
        "duct-measured",
        "Recorded noise in a measured duct",
        summary,
        data.noise - data.noise.mean(),
        (fir_path(data.primary / scale, data.fs), fir_path(data.secondary / scale, data.fs)),
        parameters,
    )


def _study(
    runs: Runs,
    name: str,
    title: str,
    summary: str,
    noise: np.ndarray,
    paths: tuple[Any, Any],
    parameters: dict[str, Parameter],
) -> StudyReport:
    scene = make_scene(
        {SEED: noise},
        *paths,
        fs=FS,
        rated_power=RATED_POWER,
        power_multiple=POWER_MULTIPLE,
        n_taps=N_TAPS,
        nse_window_s=NSE_WINDOW_S,
    )
    tuned = tune(runs, scene)

    def run(algorithm: str) -> SimulationResult:
        return scene.run(make_controller(scene, algorithm, tuned[algorithm].setting), record_powers=True)

    results = dict(zip(tuned, runs.map(run, tuned), strict=True))
    algorithms = {algorithm: figures_of_merit([result], scene) for algorithm, result in results.items()}
    wiener = wiener_solution(*scene.settled, scene.secondary, scene.n_taps)
    extra = _why(scene, wiener, results)
    return StudyReport(
        name=name,
        conditions=("machine noise in a duct",),
        title=title,
        summary=summary,
        fs=FS,
        rated_power=RATED_POWER,
        parameters=common_parameters(scene, tuned)
        | parameters
        | {
            "duration_s": Parameter(results["KF-OPC"].error.size / FS, "10 s, or what the recording holds"),
            "amplifier": Parameter("linear", "the paper names no clipping here"),
        },
        algorithms=algorithms,
        extra=extra,
        verdicts=_verdicts(algorithms, results, extra),
        figures=_figures_of(scene, wiener, results, *paths),
        sounds=sounds(results),
        notes=[*tuning_note(tuned), ceiling_note(scene), _power_note(algorithms, extra)],
    )


def _why(scene: Scene, wiener: WienerSolution, results: dict[str, SimulationResult]) -> dict[str, Any]:
    """Return what explains the output power: the gain that eq. 11 sees, and the one that the control signal sees."""
    x, d = scene.settled
    bound = power_constrained_solution(x, d, scene.secondary, scene.n_taps, RATED_POWER)
    d2 = np.convolve(d**2, np.full(int(FS), 1 / FS), mode="valid")
    return {
        "disturbance_power_over_1_s_largest_over_smallest": float(d2.max() / d2.min()),
        "gain_of_the_reference_eq_11": secondary_path_gain(scene.secondary, reference=x),
        "gain_of_the_wiener_control_signal": wiener.antinoise_power / wiener.control_power,
        "wiener_antinoise_share_of_disturbance": wiener.antinoise_power / wiener.disturbance_power,
        "best_noise_reduction_within_the_power_db": bound.noise_reduction_db,
        "largest_output_power_over_1_s": {
            name: overshoot(r.control_signal, 1.0, FS, window_s=1.0) for name, r in results.items()
        },
        "overshoot_of_50_ms_power": {name: overshoot(r.control_signal, RATED_POWER, FS) for name, r in results.items()},
        "mean_nse_db": {
            name: float(np.mean(nse_db(r.error, r.disturbance, FS, NSE_WINDOW_S))) for name, r in results.items()
        },
    }


def _power_note(algorithms: dict[str, dict[str, Any]], extra: dict[str, Any]) -> str:
    power = algorithms["KF-OPC"]["output_power"] / RATED_POWER
    second = extra["largest_output_power_over_1_s"]["KF-OPC"] / RATED_POWER
    seen, assumed = extra["gain_of_the_wiener_control_signal"], extra["gain_of_the_reference_eq_11"]
    share = extra["wiener_antinoise_share_of_disturbance"]
    return (
        f"KF-OPC puts out {power:.2f} times its rated power over the steady half and up to {second:.2f} times over 1 s. "
        f"Eq. 13 takes the secondary path's gain for the reference ({assumed:.3g}) for that of the control signal "
        f"({seen:.3g}) and the whole disturbance for what the control filter can cancel ({100 * share:.0f} % of it): by "
        f"these two the power of a steady noise would be {assumed / seen * share:.2f} times the rated one. The rest is "
        "the noise's level, whose power over 1 s varies "
        f"{extra['disturbance_power_over_1_s_largest_over_smallest']:.1f} times here while the power estimates remember "
        f"{Scene.power_memory_s:g} s, and its spectrum, which varies with it."
    )


def _verdicts(
    algorithms: dict[str, dict[str, Any]], results: dict[str, SimulationResult], extra: dict[str, Any]
) -> list[Verdict]:
    anc, opc, mov = (algorithms[name] for name in ("KF-ANC", "KF-OPC", "MOV-FxLMS"))
    best = max(algorithms, key=lambda name: algorithms[name]["noise_reduction_db"])
    closer = abs(opc["output_power"] - RATED_POWER) < abs(mov["output_power"] - RATED_POWER)
    early = {name: first_second_db(results[name]) for name in ("KF-OPC", "MOV-FxLMS")}
    return [
        Verdict(
            "KF-ANC has the best noise reduction and disregards the rated power",
            bool(best == "KF-ANC" and anc["output_power"] > 1.5 * RATED_POWER),
            f"{anc['noise_reduction_db']:.1f} dB at {anc['output_power'] / RATED_POWER:.2f} times the rated power",
        ),
        Verdict(
            "KF-OPC confines the output power to the rated power",
            bool(
                opc["output_power"] <= 1.02 * RATED_POWER
                and extra["largest_output_power_over_1_s"]["KF-OPC"] <= 1.1 * RATED_POWER
            ),
            f"output power {opc['output_power']:.3f} of {RATED_POWER:g} over the steady half, at most "
            f"{extra['largest_output_power_over_1_s']['KF-OPC']:.3f} over 1 s, and "
            f"{extra['overshoot_of_50_ms_power']['KF-OPC']:.1f} times the rated power over 50 ms",
        ),
        Verdict(
            "KF-OPC converges faster than MOV-FxLMS",
            bool(early["KF-OPC"] > early["MOV-FxLMS"]),
            f"noise reduction over the first second {early['KF-OPC']:.2f} against {early['MOV-FxLMS']:.2f} dB; "
            f"convergence (NSE over 50 ms) {milliseconds(opc['convergence_time_s'])} against "
            f"{milliseconds(mov['convergence_time_s'])}. Over the steady half KF-OPC draws "
            f"{opc['output_power'] / mov['output_power']:.1f} times the power of MOV-FxLMS",
        ),
        Verdict(
            "KF-OPC's output power is closer to the rated power than MOV-FxLMS's, and its noise reduction better",
            bool(closer and opc["noise_reduction_db"] > mov["noise_reduction_db"]),
            f"output power {opc['output_power']:.3f} against {mov['output_power']:.3f} of {RATED_POWER:g}, noise "
            f"reduction {opc['noise_reduction_db']:.2f} against {mov['noise_reduction_db']:.2f} dB (a fixed filter "
            f"within the power reaches {extra['best_noise_reduction_within_the_power_db']:.2f} dB)",
        ),
    ]


def _figures_of(
    scene: Scene, wiener: WienerSolution, results: dict[str, SimulationResult], primary: Any, secondary: Any
) -> list[FigureItem]:
    group = list(results.values())
    return [
        draw(
            "a-nse",
            "Normalised squared error over 50 ms (Fig. 7 a).",
            lambda ax: plot_nse(group, window_s=NSE_WINDOW_S, ax=ax),
        ),
        draw(
            "b-error-spectra",
            "Power spectra of disturbance and error signals over the steady half (Fig. 7 b).",
            lambda ax: plot_error_spectra(group, band=(0, 3000), ax=ax),
        ),
        draw(
            "output-power",
            "Output power over 0.25 s, and the rated power.",
            lambda ax: plot_output_power(group, rated_power=RATED_POWER, ax=ax),
        ),
        draw(
            "constraint-factor",
            "Constraint factor. Both follow the same powers, so the lines coincide where the residuals are alike.",
            lambda ax: plot_constraint_factor([results["KF-OPC"], results["MOV-FxLMS"]], ax=ax),
        ),
        draw(
            "required-power",
            "Rated power needed for a noise reduction, by scaling the Wiener control filter.",
            lambda ax: plot_required_rated_power(wiener, rated_power=RATED_POWER, ax=ax),
        ),
        *_path_figures(scene, primary, secondary),
    ]


def _path_figures(scene: Scene, primary: Any, secondary: Any) -> list[FigureItem]:
    """Return what a practitioner looks at before any control: the paths, and an identification of the secondary one."""
    both = {"primary path": primary, "secondary path": secondary}
    identified = {
        f"{n_taps} taps": identify_secondary_path(
            secondary, n_taps=n_taps, duration_s=5.0, rng=SEED, level=0.5, sensor_noise_std=scene.sensor_noise_std
        )
        for n_taps in (scene.secondary.size // 4, scene.secondary.size)
    }
    estimates = {name: result.estimate for name, result in identified.items()}
    return [
        draw_paths("Primary and secondary path.", both),
        draw(
            "impulse-responses",
            "Impulse responses, and the delay of the primary path over the secondary one: the causality margin.",
            lambda ax: plot_impulse_responses(both, ax=ax),
            lambda ax: plot_causality_margin(primary, secondary, ax=ax),
        ),
        draw(
            "delay-and-gain",
            "Group delay, and the secondary path's gain, for white noise and for the reference (eq. 11).",
            lambda ax: plot_group_delay(both, frequencies_hz=np.geomspace(50, 4000, 400), ax=ax),
            lambda ax: plot_secondary_path_gain(secondary, reference=scene.references[0], ax=ax),
        ),
        draw(
            "identification",
            "Secondary path identified with 5 s of white noise: phase error with its 90-degree bound, modelling error.",
            lambda ax: plot_phase_error(secondary, estimates, ax=ax),
            lambda ax: plot_modelling_error(identified, ax=ax),
        ),
    ]
