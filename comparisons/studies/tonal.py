"""Study 1: a 400 Hz tone and a clipping amplifier (the paper's Fig. 5)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from kfopc_filterpy import HardClipAmplifier, SimulationResult, plot
from kfopc_filterpy.bounds import wiener_solution
from kfopc_filterpy.metrics import peak_control_signal
from kfopc_filterpy.paths import fir_path
from kfopc_filterpy.plot.style import labelled
from kfopc_filterpy.signals import tone

from .. import bench
from ..bench import Claim, FigureItem, Parameter, Runs, Scene, StudyReport, Tuned, algorithms
from . import report_parts as parts
from .cases import AUTHORS, CHOSEN, FS, PAPER, Setting, Setup, grid_runs, run_each
from .weight_growth import Growth, growth_of

KALMAN = ("KF-ANC", "KF-OPC")
TONE_HZ = 400.0
DURATION_S = 10.5
RATED_POWER = 1.0
LIMIT = float(np.sqrt(2 * RATED_POWER))  # of the amplifier: the peak of a sine at rated power
POWER_MULTIPLE = 2.0
OVERDRIVES_DB = np.arange(0.0, 10.5, 1.0)
FORGETFUL = max(algorithms()["KF-ANC"].grid)  # most state noise of the grid: the fastest forgetting
WEIGHTS_EVERY = 160

# Criteria of the claims
HARMONICS_DB = -30.0  # over the disturbance; louder ones are harmonics, 3 % in amplitude
CLEAN_DB = -60.0  # softer ones are none: the sensor noise is as loud
MANY_TIMES = 10.0  # the optimal weight: no filter needs it


def planned_runs() -> int:
    """Return the number of runs of the study."""
    return grid_runs(PAPER) + len(PAPER) + len(KALMAN) * (len(OVERDRIVES_DB) + 1)


def main(runs: Runs) -> StudyReport:
    """Run the study."""
    return _study(runs, "tonal", CHOSEN)


def authors(runs: Runs) -> StudyReport:
    """Run the study with the settings of the authors' code; their tone has an amplitude of 2, as here to 1 %."""
    return _study(runs, "tonal-authors", AUTHORS)


def _study(runs: Runs, name: str, setup: Setup) -> StudyReport:
    plant = setup.plant(amplifier=HardClipAmplifier(LIMIT))
    assert plant.primary is not None
    x = tone(TONE_HZ, DURATION_S, fs=FS)
    scene = setup.scene({0: x}, plant, rated_power=RATED_POWER, power_multiple=POWER_MULTIPLE)
    tuned = bench.tune(runs, scene)

    def run_all(settings: Mapping[str, Setting]) -> dict[str, SimulationResult]:
        return run_each(runs, scene, settings, record_weights_every=WEIGHTS_EVERY)

    results = run_all({name: best.setting for name, best in tuned.items()})
    forgetful = run_all(dict.fromkeys(KALMAN, FORGETFUL))
    merits = {name: bench.figures_of_merit([result], scene, tone_hz=TONE_HZ) for name, result in results.items()}
    x, d = scene.settled
    optimal_weight = float(np.abs(wiener_solution(x, scene.plant, n_taps=scene.n_taps, disturbance=d).weights).max())
    pairs = {tuned["KF-ANC"].setting: results, FORGETFUL: forgetful}
    growths = {setting: [growth_of(pair[name], optimal_weight) for name in KALMAN] for setting, pair in pairs.items()}
    sweep = _overdrive_sweep(runs, scene, tuned)
    crossings = crossings_db(OVERDRIVES_DB, sweep["KF-OPC"] - sweep["KF-ANC"])
    return parts.report_of_paper(
        scene,
        tuned,
        name=name,
        title="Tonal noise and a clipping amplifier",
        summary=(
            f"A {TONE_HZ:g} Hz tone needs {POWER_MULTIPLE:g} times the rated power. The amplifier clips at "
            "sqrt(2 rated power), the peak of a sine at rated power."
        ),
        parameters={
            "noise": Parameter(f"sine, {TONE_HZ:g} Hz", "the paper's"),
            "duration_s": Parameter(DURATION_S - scene.switch_on_s, "long enough for the weights of KF-ANC to grow"),
            "amplifier": Parameter(f"hard clip at {LIMIT:.4f}", "the paper's, sqrt(2 rated power)"),
            "amplitude": Parameter(float(np.abs(scene.references[0]).max()), "follows from the control power"),
        }
        | parts.bandpass_parameters(setup),
        algorithms=merits,
        extra={
            "overdrive_db": OVERDRIVES_DB,
            "noise_reduction_db_over_overdrive": sweep,
            "ordering_flips_at_overdrive_db": crossings,
            "with_most_state_noise": {name: _extremes(own, optimal_weight) for name, own in forgetful.items()},
            "largest_optimal_weight": optimal_weight,
            "largest_weight_over_optimal": growth_of(results["KF-ANC"], optimal_weight).over_optimal,
        },
        claims=claims(merits, peak_control_signal(results["KF-OPC"].control_signal, steady=1.0), growths, crossings),
        figures=[
            *_figures_of(pairs, sweep, crossings),
            parts.draw_paths(
                "The band-pass paths.",
                {"primary path": fir_path(plant.primary[0, 0], FS), "secondary path": fir_path(scene.secondary, FS)},
            ),
        ],
        sounds=parts.sounds(results),
    )


def _extremes(result: SimulationResult, optimal_weight: float) -> dict[str, float]:
    """Return how far a run goes with its weights, which Fig. 5 d leaves out."""
    growth = growth_of(result, optimal_weight)
    return {
        "largest_weight_over_optimal": growth.over_optimal,
        "weight_growth": growth.over_half,
        "peak_control_signal": peak_control_signal(result.control_signal, steady=1.0),
        "output_power": result.output_power,
        "noise_reduction_db": result.noise_reduction_db,
    }


def _overdrive_sweep(runs: Runs, scene: Scene, tuned: dict[str, Tuned]) -> dict[str, np.ndarray]:
    """Return the noise reduction of both Kalman filters over the overdrive, at the settings tuned for the study.

    In decibels a louder noise is the same as a smaller amplifier, so all levels share the gains of one reference.
    """
    powers = scene.unconstrained_power / 10 ** (OVERDRIVES_DB / 10)
    smaller = [replace(scene, rated_power=float(power)) for power in powers]
    amplified = [replace(one, amplifier=HardClipAmplifier(one.amplitude_limit)).plant for one in smaller]

    def reductions(name: str) -> list[float]:
        controllers = [bench.make_controller(one, name, tuned[name].setting) for one in smaller]
        return [result.noise_reduction_db for result in scene.run_together(controllers, plants=amplified)]

    values = runs.map(reductions, KALMAN, worth=lambda name: len(OVERDRIVES_DB))
    return dict(zip(KALMAN, np.array(values), strict=True))


def crossings_db(levels: np.ndarray, lead: np.ndarray) -> list[float]:
    """Return the overdrives at which `lead` changes sign, by linear interpolation."""
    k = np.flatnonzero(lead[:-1] * lead[1:] < 0)
    return [float(x) for x in levels[k] + (levels[k + 1] - levels[k]) * lead[k] / (lead[k] - lead[k + 1])]


# ---- Claims


def claims(
    merits: Mapping[str, Mapping[str, float | None]],
    peak: float,
    growths: Mapping[Setting, Sequence[Growth]],
    crossings: Sequence[float],
) -> list[Claim]:
    """Return the claims of Fig. 5.

    They are judged by the figures of merit, the largest control signal of KF-OPC, the growth of KF-ANC's and KF-OPC's
    weights at each state noise, and the overdrives at which the order of the two flips.
    """
    anc, opc = ({key: np.nan if own is None else own for key, own in merits[name].items()} for name in KALMAN)
    flips = " and ".join(f"{level:.1f} dB" for level in crossings)
    rows = [
        Claim("Harmonics of KF-ANC, over the disturbance (dB)", anc["harmonics_db"], at_least=HARMONICS_DB),
        Claim("Harmonics of KF-OPC, over the disturbance (dB)", opc["harmonics_db"], at_most=CLEAN_DB),
        Claim("Largest control signal of KF-OPC over the amplifier's limit", peak / LIMIT, at_most=1.01),
        Claim("Output power of KF-OPC over the rated one", opc["output_power"] / RATED_POWER, 1.01, 0.99),
        Claim(
            "Noise reduction of KF-OPC less that of KF-ANC (dB)",
            opc["noise_reduction_db"] - anc["noise_reduction_db"],
            at_least=0.0,
            note=f"the order flips at {flips} of overdrive" if crossings else "at every overdrive",
        ),
    ]
    for setting, (free, kept) in growths.items():
        at = f"r E[x'^2]/q = {setting:g}"
        rows += [
            Claim("Largest weight of KF-ANC over the optimal one", free.over_optimal, at_least=MANY_TIMES, note=at),
            Claim("Its growth in the last quarter over that in the second: a line", free.of_quarters, 1.1, 0.9, at),
            Claim("Largest weight of KF-OPC at the end over that at half of the run", kept.over_half, 1.01, 0.99, at),
        ]
    return rows


# ---- Figures


def _figures_of(
    pairs: Mapping[Setting, Mapping[str, SimulationResult]],
    sweep: Mapping[str, np.ndarray],
    crossings: Sequence[float],
) -> list[FigureItem]:
    """Return the figures of both Kalman filters, whose runs are given for each state noise, the tuned one first."""
    groups = {setting: [results[name] for name in KALMAN] for setting, results in pairs.items()}
    pair = next(iter(groups.values()))
    span = (pair[0].time_s[-1] - 0.02, pair[0].time_s[-1])
    assert pair[0].weights is not None
    tap = int(np.argmax(np.abs(pair[0].weights[-1])))

    def weights(setting: Setting, group: Sequence[SimulationResult]) -> Callable[[Any], None]:
        def panel(ax: Any) -> None:
            for run in group:
                assert run.weights is not None
                style = plot.curve_style(run.algorithm) | {"marker": ""}
                ax.plot(run.weights_time_s, run.weights[:, tap], label=run.algorithm, **style)
            labelled(ax, xlabel="Time (s)", ylabel=f"Weight {tap} of the control filter")
            ax.set_title(f"$r\\,E[x'^2]/q$ = {setting:g}", pad=22, fontsize="medium")  # above the legend

        return panel

    def overdrive(ax: Any) -> None:
        for name, levels in sweep.items():
            ax.plot(OVERDRIVES_DB, levels, label=name, **plot.curve_style(name))
        for crossing in crossings:
            ax.axvline(crossing, label=f"Order flips at {crossing:.1f} dB", color="0.15", linestyle=":")
        labelled(ax, xlabel="Overdrive (dB)", ylabel="Noise reduction (dB)").set_ylim(0, 25)

    return [
        parts.draw(
            "a-error-spectra",
            "Power spectra of disturbance and errors over the steady half (Fig. 5 a). At 400 Hz KF-ANC lies behind KF-OPC.",
            lambda ax: plot.plot_error_spectra(pair, ax=ax),
        ),
        parts.draw(
            "b-anti-noise",
            "Anti-noise at the error microphone, last 20 ms (Fig. 5 b).",
            lambda ax: plot.plot_anti_noise(pair, span_s=span, ax=ax),
        ),
        parts.draw(
            "c-amplifier-output",
            "Amplifier output, last 20 ms; dotted: the control signal it was asked for (Fig. 5 c).",
            lambda ax: plot.plot_amplifier_output(pair, span_s=span, limit=LIMIT, ax=ax),
        ),
        parts.draw(
            "d-weight-history",
            f"History of weight {tap}, the largest of KF-ANC at the end (Fig. 5 d). Left: with the state noise r that "
            "KF-ANC is tuned to; right: with the most of the grid. KF-OPC is the same in both.",
            *(weights(*own) for own in groups.items()),
        ),
        parts.draw(
            "overdrive",
            f"Noise reduction over the overdrive: the paper's ordering holds where KF-OPC lies above. At 0 dB, off the "
            f"scale, KF-ANC reaches {sweep['KF-ANC'][0]:.0f} and KF-OPC {sweep['KF-OPC'][0]:.0f} dB.",
            overdrive,
        ),
    ]
