"""Study 1: a 400 Hz tone and a clipping amplifier (the paper's Fig. 5)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter

from kfopc_filterpy import (
    HardClipAmplifier,
    KalmanController,
    SimulationResult,
    bandpass_path,
    noise_reduction_db,
    output_power,
)
from kfopc_filterpy.bench import (
    Claim,
    FigureItem,
    Parameter,
    Runs,
    Scene,
    StudyReport,
    Tuned,
    algorithms,
    figures_of_merit,
    make_controller,
    make_scene,
    tune,
)
from kfopc_filterpy.bounds import wiener_solution
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
from .report_parts import BANDPASS_PATHS, ceiling_note, common_parameters, draw, draw_paths, sounds, tuning_note

FS = 16000.0
KALMAN = ("KF-ANC", "KF-OPC")
TONE_HZ = 400.0
DURATION_S = 10.5
RATED_POWER = 1.0
POWER_MULTIPLE = 2.0
N_TAPS = 128
OVERDRIVES_DB = np.arange(0.0, 10.5, 1.0)
UNFORGETTING = (1e-10, 1e-12)
FORGETFUL = max(algorithms()["KF-ANC"].grid)  # most state noise of the grid: the fastest forgetting
FILTERPY_SAMPLES = 4000
WEIGHTS_EVERY = 160

# Criteria of the claims
HARMONICS_DB = -30.0  # over the disturbance; louder ones are harmonics, 3 % in amplitude
CLEAN_DB = -60.0  # softer ones are none: the sensor noise is as loud
PEAK_SHARE = 1.01  # of the amplifier's limit
POWER_TOLERANCE = 0.01
MANY_TIMES = 10.0  # the optimal weight
LINEAR_TOLERANCE = 0.1
CONSTANT_TOLERANCE = 0.01


def planned_runs() -> int:
    """Return the number of runs of the study."""
    return grid_runs(PAPER) + len(PAPER) + len(KALMAN) * (len(OVERDRIVES_DB) + len(UNFORGETTING) + 1)


def main(runs: Runs) -> StudyReport:
    """Run the study."""
    primary, secondary = bandpass_path(128, fs=FS), bandpass_path(32, fs=FS)
    scene = _scene(primary, secondary, POWER_MULTIPLE)
    tuned = tune(runs, scene)

    recorded = runs.map(lambda name: _recorded(scene, name, tuned[name].setting), tuned)
    results = dict(zip(tuned, recorded, strict=True))
    merits = {name: _figures(result, scene) for name, result in results.items()}
    forgetful = dict(zip(KALMAN, runs.map(lambda name: _recorded(scene, name, FORGETFUL), KALMAN), strict=True))
    optimal = wiener_solution(*scene.settled, scene.secondary, scene.n_taps)
    optimal_weight = float(np.abs(optimal.weights).max())
    pairs = {tuned["KF-ANC"].setting: results, FORGETFUL: forgetful}
    growths = {setting: [growth_of(pair[name], optimal_weight) for name in KALMAN] for setting, pair in pairs.items()}
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
        algorithms=merits,
        extra={
            "overdrive_db": OVERDRIVES_DB,
            "noise_reduction_db_over_overdrive": sweep,
            "ordering_flips_at_overdrive_db": crossings,
            "with_less_state_noise": unforgetting,
            "with_most_state_noise": {name: _overflow(result, optimal_weight) for name, result in forgetful.items()},
            "largest_optimal_weight": optimal_weight,
            "largest_weight_over_optimal": growth_of(results["KF-ANC"], optimal_weight).over_optimal,
            "filterpy_largest_difference": oracle,
        },
        claims=[
            harmonics_claim(_number(merits["KF-ANC"], "harmonics_db"), _number(merits["KF-OPC"], "harmonics_db")),
            peak_claim(float(np.abs(results["KF-OPC"].control_signal).max()), scene.amplitude_limit),
            power_claim(_number(merits["KF-OPC"], "output_power") / RATED_POWER),
            growth_claim(growths),
            reduction_claim(
                _number(merits["KF-ANC"], "noise_reduction_db"),
                _number(merits["KF-OPC"], "noise_reduction_db"),
                crossings,
            ),
        ],
        figures=_figures_of(
            results, forgetful, tuned["KF-ANC"].setting, scene, sweep, crossings, theirs, primary, secondary
        ),
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
            *_overflow_note(forgetful, optimal_weight, merits),
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


def _recorded(scene: Scene, name: str, setting: Setting) -> SimulationResult:
    return scene.run(make_controller(scene, name, setting), record_weights_every=WEIGHTS_EVERY)


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
        result = _recorded(scene, *job)
        reduction = noise_reduction_db(result.error, result.disturbance)
        return {"noise_reduction_db": reduction, "weight_growth": weight_growth(result)}

    return {f"{name} at {setting:g}": row for (name, setting), row in zip(jobs, runs.map(run, jobs), strict=True)}


def _by_filterpy(scene: Scene, setting: Setting) -> SimulationResult:
    """Run the first part of the study with filterpy's own KalmanFilter as the estimator of KF-ANC."""
    fast = make_controller(scene, "KF-ANC", setting)
    estimator = KalmanFilter(dim_x=scene.n_taps, dim_z=1)
    estimator.P *= scene.initial_variance
    estimator.Q *= fast.state_noise
    estimator.R *= fast.measurement_noise
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


# ---- Claims, of plain figures


def harmonics_claim(anc_db: float, opc_db: float) -> Claim:
    """Return the claim about Fig. 5 a and b from the harmonics of both filters, in dB over the disturbance."""
    return Claim(
        "KF-ANC produces harmonics, KF-OPC does not",
        bool(anc_db >= HARMONICS_DB and opc_db <= CLEAN_DB),
        f"harmonics over the disturbance: KF-ANC {anc_db:.1f} dB, KF-OPC {opc_db:.1f} dB, the sensor noise as a whole "
        f"{CLEAN_DB:.0f} dB",
    )


def peak_claim(peak: float, limit: float) -> Claim:
    """Return the claim about Fig. 5 c from the largest control signal of KF-OPC and the amplifier's limit."""
    return Claim(
        "The control signal of KF-OPC stays within what the amplifier can put out",
        bool(peak <= PEAK_SHARE * limit),
        f"largest control signal of the whole run {peak:.4f}, limit {limit:.4f}, kept to {100 * (PEAK_SHARE - 1):.0f} %",
    )


def power_claim(over_rated: float) -> Claim:
    """Return the claim about the output power of KF-OPC, given over the rated power."""
    return Claim(
        "The output power of KF-OPC is the rated power",
        bool(abs(over_rated - 1.0) <= POWER_TOLERANCE),
        f"output power {over_rated * RATED_POWER:.4f}, rated power {RATED_POWER:g}",
    )


@dataclass(frozen=True)
class Growth:
    """How the largest weight of a control filter went on; all of it but `diverged_at_s` are ratios."""

    over_optimal: float  # at the end, over the largest weight of the Wiener solution
    over_half: float  # at the end, over half of the run
    of_quarters: float  # gained in the last quarter, over what was gained in the second: 1 on a straight line
    diverged_at_s: float | None = None

    @property
    def linear_without_bound(self) -> bool:
        """Whether it grows in a straight line, and is far beyond the optimum."""
        return self.over_optimal >= MANY_TIMES and abs(self.of_quarters - 1.0) <= LINEAR_TOLERANCE

    @property
    def none(self) -> bool:
        """Whether it keeps its size."""
        return abs(self.over_half - 1.0) <= CONSTANT_TOLERANCE


def growth_claim(growths: Mapping[Setting, Sequence[Growth]]) -> Claim:
    """Return the claim about Fig. 5 d from the growth of KF-ANC and of KF-OPC at each state noise."""
    held = [anc.linear_without_bound and opc.none for anc, opc in growths.values()]
    said = "; ".join(
        f"with r E[x'^2]/q = {setting:g} its largest weight is {anc.over_optimal:.0f} times the optimal one at the end, "
        f"{anc.over_half:.2f} times that at half of the run, that of KF-OPC {opc.over_half:.2f} times"
        for setting, (anc, opc) in growths.items()
    )
    times = [anc.diverged_at_s for anc, _ in growths.values() if anc.diverged_at_s is not None]
    number = f"diverged after {min(times):.1f} s" if times else "the numbers do not overflow"
    return Claim(
        "The control filter of KF-ANC grows without bound, that of KF-OPC does not",
        bool(held) and all(held),
        f"{said}. The growth is a straight line; {number}",
    )


def reduction_claim(anc_db: float, opc_db: float, crossings: Sequence[float]) -> Claim:
    """Return the claim about the noise reduction of both filters, with the overdrives at which the order flips."""
    flips = " and ".join(f"{level:.1f} dB" for level in crossings)
    order = f"the order flips at {flips} of overdrive" if crossings else "the order is the same at every overdrive"
    return Claim(
        "KF-OPC reduces the noise more than KF-ANC",
        bool(opc_db > anc_db),
        f"{opc_db:.1f} against {anc_db:.1f} dB at {10 * np.log10(POWER_MULTIPLE):.0f} dB of overdrive; {order}, see the "
        "figure",
    )


# ---- Figures of the weights


def growth_of(result: SimulationResult, optimal_weight: float) -> Growth:
    """Return how the largest weight of a run went on."""
    largest = _largest_weights(result)
    quarter, half, three, end = (float(largest[k * (largest.size - 1) // 4]) for k in (1, 2, 3, 4))
    gained = (end - three) / (half - quarter) if half != quarter else np.inf
    return Growth(end / optimal_weight, end / half, gained, result.diverged_at_s)


def weight_growth(result: SimulationResult) -> float:
    """Return the largest weight at the end of a run over the largest at half of it."""
    return growth_of(result, 1.0).over_half


def _largest_weights(result: SimulationResult) -> np.ndarray:
    assert result.weights is not None
    return np.abs(result.weights).max(axis=1)


def _overflow(result: SimulationResult, optimal_weight: float) -> dict[str, float]:
    """Return what Fig. 5 d leaves out: how far the control signal goes with the weights."""
    largest = float(_largest_weights(result)[-1])
    return {
        "setting": FORGETFUL,
        "largest_weight": largest,
        "largest_weight_over_optimal": largest / optimal_weight,
        "peak_control_signal": float(np.abs(result.control_signal).max()),
        "output_power": output_power(result.control_signal),
        "noise_reduction_db": noise_reduction_db(result.error, result.disturbance),
    }


def _overflow_note(
    forgetful: dict[str, SimulationResult], optimal_weight: float, merits: dict[str, dict[str, float | None]]
) -> list[str]:
    anc, opc = (_overflow(forgetful[name], optimal_weight) for name in KALMAN)
    return [
        f"The rule of tuning takes the least state noise, with which KF-ANC's weights grow most slowly. With the most of the "
        f"grid, r E[x'^2]/q = {FORGETFUL:g}, its largest weight ends at {anc['largest_weight']:.1f}, the optimum's is "
        f"{optimal_weight:.3f}; its control signal goes up to {anc['peak_control_signal']:.0f}, its output power is "
        f"{anc['output_power'] / RATED_POWER:.0f} times the rated one and its noise reduction "
        f"{anc['noise_reduction_db']:.2f} dB ({_number(merits['KF-ANC'], 'noise_reduction_db'):.2f} dB as tuned). KF-OPC's "
        f"control signal goes up to {opc['peak_control_signal']:.2f}, and it reduces the noise by "
        f"{opc['noise_reduction_db']:.2f} dB, as before.",
    ]


def _number(figures: dict[str, float | None], key: str) -> float:
    value = figures[key]
    return np.nan if value is None else value


def _figures_of(
    results: dict[str, SimulationResult],
    forgetful: dict[str, SimulationResult],
    setting: Setting,
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
    assert theirs.weights is not None
    as_long = {name: getattr(pair[0], name)[: len(theirs.weights)] for name in ("weights", "weights_time_s")}
    laid_over = {"KF-ANC": dataclasses.replace(pair[0], **as_long), "KF-ANC, filterpy": theirs}

    def amplifier(ax: Any, from_s: float = span[0]) -> None:
        plot_amplifier_output(pair, span_s=(from_s, end), limit=scene.amplitude_limit, ax=ax)

    def weights(group: Sequence[SimulationResult], noise: Setting) -> Callable[[Any], None]:
        def panel(ax: Any) -> None:
            plot_weight_history(group, tap=tap, ax=ax).set_yscale("linear")  # a straight line is the point
            ax.autoscale(axis="y")
            ax.set_title(f"$r\\,E[x'^2]/q$ = {noise:g}", pad=22, fontsize="medium")  # above the legend

        return panel

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
            f"History of weight {tap}, the largest of KF-ANC at the end (Fig. 5 d). Left: with the state noise r that "
            "KF-ANC is tuned to; right: with the most of the grid. KF-OPC is the same in both.",
            weights(pair, setting),
            weights(list(forgetful.values()), FORGETFUL),
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
            lambda ax: plot_weight_history(laid_over, tap=tap, ax=ax).set_xlim(0, FILTERPY_SAMPLES / FS),
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
