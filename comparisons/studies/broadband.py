"""Study 2: noise from 200 to 2000 Hz (the paper's Fig. 6)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from kfopc_filterpy import HardClipAmplifier, KalmanController, SimulationResult, bandpass_path, nse_db, output_power
from kfopc_filterpy.bench import (
    FigureItem,
    Parameter,
    Runs,
    Scene,
    StudyReport,
    Tuned,
    Verdict,
    figures_of_merit,
    make_controller,
    make_scene,
    run_settings,
    tune,
)
from kfopc_filterpy.metrics import coherence_and_gain, peak_control_signal
from kfopc_filterpy.plot import (
    plot_disturbance_and_anti_noise,
    plot_error_spectra,
    plot_nse,
    plot_output_power,
)
from kfopc_filterpy.signals import band_limited_noise

from .cases import PAPER, grid_runs
from .parts import (
    BANDPASS_PATHS,
    ceiling_note,
    common_parameters,
    draw,
    first_second_db,
    milliseconds,
    sounds,
    tuning_note,
)

FS = 16000.0
BAND = (200.0, 2000.0)
DURATION_S = 10.5
RATED_POWER = 0.8
POWER_MULTIPLE = 4.0
N_TAPS = 128
OTHER_N_TAPS = 256
CONSTRAINED = ("KF-OPC", "MOV-FxLMS")
SEEDS = tuple(range(1, 9))
TUNING_SEEDS = 2

Results = dict[str, list[SimulationResult]]


def planned_runs() -> int:
    """Return the number of runs of the study."""
    tuning = TUNING_SEEDS * grid_runs(PAPER) + grid_runs(CONSTRAINED)
    return tuning + len(PAPER) * (len(SEEDS) + 1) + len(CONSTRAINED) * len(SEEDS)


def main(runs: Runs) -> StudyReport:
    """Run the study."""
    scene = _scene(N_TAPS)
    tuned = tune(runs, scene, seeds=TUNING_SEEDS)
    results = _run_all(runs, scene, tuned)
    algorithms = {name: figures_of_merit(rows, scene) for name, rows in results.items()}
    clipped_scene = dataclasses.replace(scene, amplifier=HardClipAmplifier(scene.amplitude_limit))
    clipped = _run_all(runs, clipped_scene, tuned, seeds=1)
    clipped["KF-OPC, known amplifier"] = [_knowing_the_amplifier(clipped_scene, tuned["KF-OPC"])]
    clipped_figures = {
        name: {**figures_of_merit(rows, clipped_scene), **_switch_on(rows[0])} for name, rows in clipped.items()
    }
    other = _other_length(runs)
    opc = results["KF-OPC"]
    coherence = coherence_and_gain(opc[0].disturbance, opc[0].anti_noise, FS, BAND)
    return StudyReport(
        name="broadband",
        conditions=("broadband noise", "band-pass paths"),
        title="Broadband noise and a linear amplifier",
        summary=(
            f"Noise from {BAND[0]:g} to {BAND[1]:g} Hz needs {POWER_MULTIPLE:g} times the rated power of "
            f"{RATED_POWER:g}. The amplifier is linear, as the paper's must be for its KF-ANC to have the best noise "
            "reduction; a run with a clipping amplifier stands beside it."
        ),
        fs=FS,
        rated_power=RATED_POWER,
        parameters=common_parameters(scene, tuned)
        | {
            "noise": Parameter(f"Gaussian, {BAND[0]:g}-{BAND[1]:g} Hz", "the paper's band"),
            "duration_s": Parameter(DURATION_S - scene.switch_on_s, "10 s"),
            "tuning_seeds": Parameter(scene.seeds[:TUNING_SEEDS], "the settings are tuned on these"),
            "amplifier": Parameter("linear", "see the summary"),
        }
        | BANDPASS_PATHS,
        algorithms=algorithms,
        extra={
            "output_power_of_each_seed": {
                n: [output_power(r.control_signal) for r in rows] for n, rows in results.items()
            },
            "anti_noise_coherence": coherence.coherence,
            "anti_noise_gain": coherence.gain,
            "with_clipping_amplifier": clipped_figures,
            f"convergence_time_s_at_{OTHER_N_TAPS}_taps": other,
        },
        verdicts=[*_verdicts(results, algorithms, coherence), _clipped_verdict(clipped_figures, clipped_scene)],
        figures=_figures_of(results, clipped, clipped_scene),
        sounds=sounds({name: rows[0] for name, rows in results.items()}),
        notes=[*tuning_note(tuned), ceiling_note(scene), *_notes(algorithms, clipped_figures, other)],
    )


def _scene(n_taps: int) -> Scene:
    noises = {seed: band_limited_noise(BAND, DURATION_S, fs=FS, rng=seed) for seed in SEEDS}
    return make_scene(
        noises,
        bandpass_path(128, fs=FS),
        bandpass_path(32, fs=FS),
        fs=FS,
        rated_power=RATED_POWER,
        power_multiple=POWER_MULTIPLE,
        n_taps=n_taps,
    )


def _run_all(runs: Runs, scene: Scene, tuned: dict[str, Tuned], seeds: int = len(SEEDS)) -> Results:
    jobs = [(name, tuned[name].setting, k) for name in tuned for k in range(seeds)]
    outcomes = run_settings(runs, scene, jobs, lambda result: result)
    results: Results = {name: [] for name in tuned}
    for (name, _, _), result in zip(jobs, outcomes, strict=True):
        assert result is not None  # none of these algorithms refuses
        results[name].append(result)
    return results


def _knowing_the_amplifier(scene: Scene, tuned: Tuned) -> SimulationResult:
    """Run KF-OPC with the disturbance estimate e + s^ * amplifier(y)."""
    estimator = make_controller(scene, "KF-OPC", tuned.setting)
    assert isinstance(estimator, KalmanController)
    return scene.run(
        KalmanController(
            estimator.estimator, scene.secondary, amplifier=scene.amplifier, name="KF-OPC, known amplifier"
        )
    )


def _other_length(runs: Runs) -> dict[str, float | None]:
    """Return the convergence times of the constrained methods with another length, tuned again on the first seed."""
    scene = _scene(OTHER_N_TAPS)
    tuned = tune(runs, scene, CONSTRAINED)
    results = _run_all(runs, scene, tuned)
    return {name: figures_of_merit(rows, scene)["convergence_time_s"] for name, rows in results.items()}


def _verdicts(results: Results, algorithms: dict[str, dict[str, Any]], coherence: Any) -> list[Verdict]:
    powers = np.array([output_power(r.control_signal) for r in results["KF-OPC"]]) / RATED_POWER
    anc, opc, mov = (algorithms[name] for name in ("KF-ANC", "KF-OPC", "MOV-FxLMS"))
    times = {name: algorithms[name]["convergence_time_s"] for name in PAPER}
    best = max(PAPER, key=lambda name: algorithms[name]["noise_reduction_db"])
    return [
        Verdict(
            "KF-OPC keeps its output power to the rated power (the paper: 0.79971 of 0.8)",
            bool(abs(powers.mean() - 1) <= 0.005 and np.all(np.abs(powers - 1) <= 0.015)),
            f"mean over {len(powers)} seeds {powers.mean() * RATED_POWER:.5f}, each within "
            f"{100 * np.abs(powers - 1).max():.2f} % of {RATED_POWER:g}",
        ),
        Verdict(
            "KF-ANC has the best noise reduction, at an output power far over the rated one",
            bool(best == "KF-ANC" and anc["output_power"] > 1.5 * RATED_POWER),
            f"{anc['noise_reduction_db']:.1f} dB at {anc['output_power'] / RATED_POWER:.2f} times the rated power; "
            f"KF-OPC {opc['noise_reduction_db']:.2f} dB at {opc['output_power'] / RATED_POWER:.3f} times",
        ),
        Verdict(
            "The constraint factor does not slow KF-ANC's convergence",
            bool(times["KF-OPC"] <= times["KF-ANC"]),
            f"convergence after {1e3 * times['KF-OPC']:.1f} ms, KF-ANC {1e3 * times['KF-ANC']:.1f} ms, each to its own "
            f"steady value; -3 dB is passed for good after {1e3 * _time_below(results['KF-OPC'], -3):.1f} and "
            f"{1e3 * _time_below(results['KF-ANC'], -3):.1f} ms",
        ),
        Verdict(
            "KF-OPC converges faster than MOV-FxLMS, at least twice as fast",
            bool(2 * times["KF-OPC"] <= times["MOV-FxLMS"]),
            f"convergence after {1e3 * times['KF-OPC']:.1f} ms, MOV-FxLMS {1e3 * times['MOV-FxLMS']:.1f} ms, "
            f"{times['MOV-FxLMS'] / times['KF-OPC']:.2f} times as long",
        ),
        Verdict(
            "KF-OPC's anti-noise is highly linear with the disturbance",
            bool(coherence.coherence > 0.99),
            f"coherence {coherence.coherence:.4f}, gain {coherence.gain:.3f} ({POWER_MULTIPLE**-0.5:g} is eq. 13's factor for a flat path); "
            f"MOV-FxLMS reduces by {mov['noise_reduction_db']:.2f} dB",
        ),
    ]


def _time_below(results: Sequence[SimulationResult], level_db: float) -> float:
    """Return the time from which the NSE, pooled over seeds, stays below a level."""
    curve = nse_db([r.error for r in results], [r.disturbance for r in results], FS, runs=True)
    above = np.flatnonzero(curve > level_db)
    return (above[-1] + 1) / FS if above.size else 0.0


def _switch_on(result: SimulationResult) -> dict[str, float]:
    """Return figures of the start, which the steady half does not show."""
    return {
        "first_second_noise_reduction_db": first_second_db(result),
        "peak_control_signal_of_the_whole_run": peak_control_signal(result.control_signal, steady=1.0),
    }


def _clipped_verdict(clipped: dict[str, dict[str, Any]], scene: Scene) -> Verdict:
    opc, mov, known = (clipped[name] for name in ("KF-OPC", "MOV-FxLMS", "KF-OPC, known amplifier"))
    start, peak = "first_second_noise_reduction_db", "peak_control_signal_of_the_whole_run"
    return Verdict(
        "KF-OPC prevents saturation where the amplifier clips (the second run, which the paper does not show)",
        bool(opc[start] >= opc["noise_reduction_db"] - 1.0),
        f"steady half: {opc['noise_reduction_db']:.1f} dB, output power {opc['output_power']:.3f}. From switch-on: "
        f"noise reduction over the first second {opc[start]:.1f} dB (MOV-FxLMS {mov[start]:.1f}), control signal up to "
        f"{opc[peak]:.0f} against a limit of {scene.amplitude_limit:.2f} (MOV-FxLMS {mov[peak]:.1f}). The clipped "
        f"part of the first samples is taken for disturbance; with the amplifier known to the estimate it is {known[start]:.1f} dB and {known[peak]:.1f}",
    )


def _notes(
    algorithms: dict[str, dict[str, Any]], clipped: dict[str, dict[str, Any]], other: dict[str, float | None]
) -> list[str]:
    rows = "; ".join(
        f"{name} {_decibels(figures)}, output power {_power(figures)}" for name, figures in clipped.items()
    )
    times = "; ".join(f"{name} {milliseconds(t)}" for name, t in other.items())
    here = "; ".join(f"{name} {milliseconds(f['convergence_time_s'])}" for name, f in algorithms.items())
    return [
        f"With an amplifier that clips at sqrt(2 rated power), first seed, same settings, steady half: {rows}.",
        f"Convergence depends on the length of the control filter. {N_TAPS} taps: {here}. {OTHER_N_TAPS} taps, tuned "
        f"again: {times}.",
    ]


def _decibels(figures: dict[str, Any]) -> str:
    if figures["diverged_at_s"] is not None:
        return f"diverged after {figures['diverged_at_s']:.2f} s"
    return f"{figures['noise_reduction_db']:.1f} dB"


def _power(figures: dict[str, Any]) -> str:
    return "undefined" if not np.isfinite(figures["output_power"]) else f"{figures['output_power']:.3g}"


def _figures_of(results: Results, clipped: Results, clipped_scene: Scene) -> list[FigureItem]:
    def firsts(group: Results) -> Sequence[SimulationResult]:
        return [rows[0] for rows in group.values()]

    return [
        draw(
            "a-nse",
            f"Normalised squared error over 5 ms, pooled over {len(SEEDS)} seeds, first 0.25 s (Fig. 6 a).",
            lambda ax: plot_nse(results, ax=ax).set_xlim(0, 0.25),
        ),
        draw(
            "b-error-spectra",
            "Power spectra of disturbance and error signals over the steady half (Fig. 6 b).",
            lambda ax: plot_error_spectra(firsts(results), band=(0, 4000), ax=ax),
        ),
        draw(
            "c-waveform",
            "Disturbance and KF-OPC's anti-noise, with their coherence and gain (Fig. 6 c).",
            lambda ax: plot_disturbance_and_anti_noise(results["KF-OPC"][0], span_s=(9.0, 9.02), band=BAND, ax=ax),
        ),
        draw(
            "output-power",
            "Output power over 0.25 s, first seed. KF-OPC and MOV-FxLMS coincide, as KF-ANC and FxLMS do.",
            lambda ax: plot_output_power(firsts(results), rated_power=RATED_POWER, ax=ax),
        ),
        draw(
            "clipped-nse",
            f"Normalised squared error over 50 ms with an amplifier that clips at {clipped_scene.amplitude_limit:.3f}, "
            "first seed.",
            lambda ax: plot_nse(firsts(clipped), window_s=0.05, time_axis="log", ax=ax),
        ),
    ]
