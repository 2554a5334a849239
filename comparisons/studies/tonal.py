"""Study 1: a 400 Hz tone and a clipping amplifier (the paper's Fig. 5)."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter

from kfopc_filterpy import HardClipAmplifier, KalmanController, SimulationResult, bandpass_path, noise_reduction_db
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
    tune,
)
from kfopc_filterpy.metrics import harmonics_db
from kfopc_filterpy.paths import achieved_band, frequency_response
from kfopc_filterpy.plot import (
    plot_amplifier_output,
    plot_anti_noise,
    plot_error_spectra,
    plot_noise_reduction_against_overdrive,
    plot_weight_history,
)
from kfopc_filterpy.signals import tone

from .cases import PAPER, Setting, grid_runs
from .parts import BANDPASS_PATHS, ceiling_note, common_parameters, draw, draw_paths, sounds, tuning_note

FS = 16000.0
KALMAN = ("KF-ANC", "KF-OPC")
TONE_HZ = 400.0
DURATION_S = 10.5
RATED_POWER = 1.0
POWER_MULTIPLE = 2.0
N_TAPS = 128
OVERDRIVES_DB = np.arange(0.0, 10.5, 1.0)
UNFORGETTING = (1e-10, 1e-12)
FILTERPY_SAMPLES = 4000
WEIGHTS_EVERY = 160


def planned_runs() -> int:
    """Return the number of runs of the study."""
    return grid_runs(PAPER) + len(PAPER) + len(KALMAN) * (len(OVERDRIVES_DB) + len(UNFORGETTING))


def main(runs: Runs) -> StudyReport:
    """Run the study."""
    primary, secondary = bandpass_path(128, fs=FS), bandpass_path(32, fs=FS)
    scene = _scene(primary, secondary, POWER_MULTIPLE)
    tuned = tune(runs, scene)

    def run(name: str) -> SimulationResult:
        controller = make_controller(scene, name, tuned[name].setting)
        return scene.run(controller, record_weights_every=WEIGHTS_EVERY)

    results = dict(zip(tuned, runs.map(run, tuned), strict=True))
    algorithms = {name: _figures(result, scene) for name, result in results.items()}
    sweep = _overdrive_sweep(runs, scene, tuned)
    crossings = crossings_db(OVERDRIVES_DB, sweep["KF-OPC"] - sweep["KF-ANC"])
    unforgetting = _without_forgetting(runs, scene)
    theirs = _by_filterpy(scene, tuned["KF-ANC"].setting)
    oracle = _largest_difference(theirs, results["KF-ANC"])
    band = achieved_band(secondary, fs=FS)
    return StudyReport(
        name="tonal",
        conditions=("a tone", "band-pass paths", "an amplifier that clips"),
        title="Tonal noise and a clipping amplifier",
        summary=(
            f"A {TONE_HZ:g} Hz tone needs {POWER_MULTIPLE:g} times the rated power. The amplifier clips at "
            "sqrt(2 rated power), the peak of a sine at rated power."
        ),
        fs=FS,
        rated_power=RATED_POWER,
        parameters=common_parameters(scene, tuned)
        | {
            "noise": Parameter(f"sine, {TONE_HZ:g} Hz", "the paper's"),
            "duration_s": Parameter(DURATION_S - scene.switch_on_s, "long enough for the weights of KF-ANC to grow"),
            "amplifier": Parameter(f"hard clip at {scene.amplitude_limit:.4f}", "the paper's, sqrt(2 rated power)"),
            "amplitude": Parameter(float(np.abs(scene.references[0]).max()), "follows from the control power"),
        }
        | BANDPASS_PATHS,
        algorithms=algorithms,
        extra={
            "overdrive_db": OVERDRIVES_DB,
            "noise_reduction_db_over_overdrive": sweep,
            "ordering_flips_at_overdrive_db": crossings,
            "with_less_state_noise": unforgetting,
            "filterpy_largest_difference": oracle,
        },
        verdicts=_verdicts(results, algorithms, crossings),
        figures=_figures_of(results, scene, sweep, crossings, theirs, primary, secondary),
        sounds=sounds(results),
        notes=[
            *tuning_note(tuned),
            ceiling_note(scene),
            f"KF-ANC run by filterpy's own KalmanFilter over the first {FILTERPY_SAMPLES} samples: the largest "
            f"difference from the O(L^2) filter is {oracle['error']:.1e} in the error signal and "
            f"{oracle['weights']:.1e} in the weights. That is rounding: S/R starts near "
            f"{_first_S_over_R(scene):.0e}, which costs each that many times 1e-16.",
            "State noise below the grid, which all but stops the forgetting: "
            + "; ".join(
                f"{name}: {row['noise_reduction_db']:.1f} dB, largest weight grew {row['weight_growth']:.2f} times"
                for name, row in unforgetting.items()
            )
            + ". KF-ANC's weights then grow more slowly, and it gains on KF-OPC.",
            f"A path of 32 taps cannot realise a band edge of 20 Hz: the secondary path passes "
            f"{band.low_hz:.0f} to {band.high_hz:.0f} Hz at -3 dB, with {_level_db(secondary, 20.0):.1f} dB at 20 Hz.",
        ],
    )


def _scene(primary: Any, secondary: Any, power_multiple: float) -> Scene:
    scene = make_scene(
        {0: tone(TONE_HZ, DURATION_S, fs=FS)},
        primary,
        secondary,
        fs=FS,
        rated_power=RATED_POWER,
        power_multiple=power_multiple,
        n_taps=N_TAPS,
    )
    return dataclasses.replace(scene, amplifier=HardClipAmplifier(scene.amplitude_limit))


def _level_db(path: Any, frequency_hz: float) -> float:
    return float(20 * np.log10(abs(frequency_response(path, [frequency_hz])[0])))


def _figures(result: SimulationResult, scene: Scene) -> dict[str, float | None]:
    harmonics = harmonics_db(result.error, result.disturbance, TONE_HZ, FS)
    return figures_of_merit([result], scene) | {"harmonics_db": harmonics}


def _overdrive_sweep(runs: Runs, scene: Scene, tuned: dict[str, Tuned]) -> dict[str, np.ndarray]:
    """Return the noise reduction of both Kalman filters over the overdrive, at the settings tuned for the study.

    In decibels a louder noise is the same as a smaller amplifier, so all levels share the gains of one reference.
    """
    powers = scene.wiener_control_power / 10 ** (np.array(OVERDRIVES_DB) / 10)
    amplifiers = [HardClipAmplifier(float(np.sqrt(2 * power))) for power in powers]

    def reductions(name: str) -> list[float]:
        smaller = [dataclasses.replace(scene, rated_power=float(power)) for power in powers]
        controllers = [make_controller(budget, name, tuned[name].setting) for budget in smaller]
        results = scene.run_together(controllers, amplifier=amplifiers)
        return [noise_reduction_db(result.error, result.disturbance) for result in results]

    values = runs.map(reductions, KALMAN, worth=lambda name: len(OVERDRIVES_DB))
    return dict(zip(KALMAN, np.array(values), strict=True))


def crossings_db(levels: np.ndarray, lead: np.ndarray) -> list[float]:
    """Return the overdrives at which `lead` changes sign, by linear interpolation."""
    k = np.flatnonzero(lead[:-1] * lead[1:] < 0)
    return [float(x) for x in levels[k] + (levels[k + 1] - levels[k]) * lead[k] / (lead[k] - lead[k + 1])]


def _without_forgetting(runs: Runs, scene: Scene) -> dict[str, dict[str, float]]:
    """Run both Kalman filters with so little state noise that they hardly forget in a run."""
    jobs = [(name, setting) for setting in UNFORGETTING for name in KALMAN]

    def run(job: tuple[str, float]) -> dict[str, float]:
        result = scene.run(make_controller(scene, *job), record_weights_every=WEIGHTS_EVERY)
        reduction = noise_reduction_db(result.error, result.disturbance)
        return {"noise_reduction_db": reduction, "weight_growth": weight_growth(result)}

    return {f"{name} at {setting:g}": row for (name, setting), row in zip(jobs, runs.map(run, jobs), strict=True)}


def _by_filterpy(scene: Scene, setting: Setting) -> SimulationResult:
    """Run the first part of the study with filterpy's own KalmanFilter as the estimator of KF-ANC."""
    fast = make_controller(scene, "KF-ANC", setting)
    assert isinstance(fast, KalmanController)
    estimator = KalmanFilter(dim_x=scene.n_taps, dim_z=1)
    estimator.P *= scene.initial_variance
    estimator.Q *= fast.estimator.state_noise
    estimator.R *= fast.estimator.measurement_noise
    start = slice(0, int(scene.switch_on_s * scene.fs) + FILTERPY_SAMPLES)
    short = dataclasses.replace(
        scene, references=[scene.references[0][start]], disturbances=[scene.disturbances[0][start]]
    )
    controller = KalmanController(estimator, scene.secondary, name="KF-ANC, filterpy")
    return short.run(controller, record_weights_every=WEIGHTS_EVERY)


def _first_S_over_R(scene: Scene) -> float:
    return scene.initial_variance * scene.n_taps * scene.filtered_power / scene.measurement_noise


def _largest_difference(theirs: SimulationResult, ours: SimulationResult) -> dict[str, float]:
    """Return the largest difference from filterpy's run in the error signal and the weights, over its samples."""
    n = theirs.error.size
    assert ours.weights is not None
    assert theirs.weights is not None
    return {
        "samples": n,
        "error": float(np.abs(theirs.error - ours.error[:n]).max()),
        "weights": float(np.abs(theirs.weights - ours.weights[: len(theirs.weights)]).max()),
    }


def _verdicts(
    results: dict[str, SimulationResult], algorithms: dict[str, dict[str, float | None]], crossings: list[float]
) -> list[Verdict]:
    anc, opc = algorithms["KF-ANC"], algorithms["KF-OPC"]
    below = _number(anc, "harmonics_db") - _number(opc, "harmonics_db")
    growth = weight_growth(results["KF-ANC"])
    at, duration = results["KF-ANC"].diverged_at_s, results["KF-ANC"].error.size / FS
    diverged = "it did not diverge" if at is None else f"it diverged after {at:.1f} s"
    peak, power = float(np.abs(results["KF-OPC"].control_signal).max()), _number(opc, "output_power")
    limit = float(np.sqrt(2 * RATED_POWER))
    better = _number(opc, "noise_reduction_db") > _number(anc, "noise_reduction_db")
    flips = " and ".join(f"{level:.1f} dB" for level in crossings)
    order = f"the order flips at {flips} of overdrive" if crossings else "the order is the same at every overdrive"
    return [
        Verdict(
            "KF-ANC produces harmonics, KF-OPC does not",
            below >= 40,
            f"harmonics of KF-OPC {below:.1f} dB below those of KF-ANC ({_number(opc, 'harmonics_db'):.1f} against "
            f"{_number(anc, 'harmonics_db'):.1f} dB over the disturbance)",
        ),
        Verdict(
            "The control signal of KF-OPC stays within what the amplifier can put out",
            peak <= 1.01 * limit,
            f"largest control signal of the whole run {peak:.4f}, limit {limit:.4f}, kept to 1 %",
        ),
        Verdict(
            "The output power of KF-OPC is the rated power",
            abs(power - RATED_POWER) <= 0.01 * RATED_POWER,
            f"output power {power:.4f}, rated power {RATED_POWER:g}",
        ),
        Verdict(
            "The control filter of KF-ANC grows without bound",
            growth > 1.5,
            f"its largest weight grew {growth:.1f} times over the second half of the run, that of KF-OPC "
            f"{weight_growth(results['KF-OPC']):.2f} times; in {duration:g} s {diverged}, and the growth depends on the "
            "state noise (see the notes)",
        ),
        Verdict(
            "KF-OPC reduces the noise more than KF-ANC",
            better,
            f"{_number(opc, 'noise_reduction_db'):.1f} against {_number(anc, 'noise_reduction_db'):.1f} dB at {10 * np.log10(POWER_MULTIPLE):.0f} dB of overdrive; "
            f"{order}, see the figure",
        ),
    ]


def weight_growth(result: SimulationResult) -> float:
    """Return the largest weight at the end of a run over the largest at half of it."""
    assert result.weights is not None
    largest = np.abs(result.weights).max(axis=1)
    return float(largest[-1] / largest[largest.size // 2])


def _number(figures: dict[str, float | None], key: str) -> float:
    value = figures[key]
    return np.nan if value is None else value


def _figures_of(
    results: dict[str, SimulationResult],
    scene: Scene,
    sweep: dict[str, np.ndarray],
    crossings: list[float],
    theirs: SimulationResult,
    primary: Any,
    secondary: Any,
) -> list[FigureItem]:
    pair = [results[name] for name in KALMAN]
    end = pair[0].time_s[-1]
    span = (end - 0.02, end)
    assert pair[0].weights is not None
    tap = int(np.argmax(np.abs(pair[0].weights[-1])))
    laid_over = {"KF-ANC": pair[0], "KF-ANC, filterpy": theirs}

    def amplifier(ax: Any, from_s: float = span[0]) -> None:
        plot_amplifier_output(pair, span_s=(from_s, end), limit=scene.amplitude_limit, ax=ax)

    def overdrive(ax: Any) -> None:
        plot_noise_reduction_against_overdrive(OVERDRIVES_DB, sweep, flip_db=crossings, ax=ax)
        ax.set_ylim(0, 25)

    return [
        draw(
            "a-error-spectra",
            "Power spectra of disturbance and error signals over the steady half (Fig. 5 a). At 400 Hz KF-ANC lies behind "
            "KF-OPC.",
            lambda ax: plot_error_spectra(pair, ax=ax),
        ),
        draw(
            "b-anti-noise",
            "Anti-noise at the error microphone, last 20 ms (Fig. 5 b).",
            lambda ax: plot_anti_noise(pair, span_s=span, ax=ax),
        ),
        draw(
            "c-amplifier-output",
            "Amplifier output, last 20 ms; dotted: the control signal it was asked for (Fig. 5 c).",
            amplifier,
        ),
        draw(
            "d-weight-history",
            f"History of weight {tap}, the largest of KF-ANC at the end (Fig. 5 d).",
            lambda ax: plot_weight_history(pair, tap=tap, ax=ax),
        ),
        draw(
            "overdrive",
            f"Noise reduction over the overdrive: the paper's ordering holds where KF-OPC lies above. At 0 dB, off the "
            f"scale, KF-ANC reaches {sweep['KF-ANC'][0]:.0f} and KF-OPC {sweep['KF-OPC'][0]:.0f} dB.",
            overdrive,
        ),
        draw(
            "filterpy",
            f"Weight {tap} of KF-ANC by filterpy's own KalmanFilter over the first {FILTERPY_SAMPLES} samples, laid "
            "over the O(L^2) filter's.",
            lambda ax: plot_weight_history(laid_over, tap=tap, ax=ax).set_xlim(0, 1.2 * FILTERPY_SAMPLES / FS),
        ),
        draw(
            "overview",
            "Amplifier output and noise reduction over the overdrive, in one.",
            lambda ax: amplifier(ax, end - 0.006),
            overdrive,
        ),
        draw_paths(
            "The band-pass paths: what 128 and 32 taps realise of 20-5000 Hz.",
            {"primary path, 128 taps": primary, "secondary path, 32 taps": secondary},
        ),
    ]
