"""Study: KF-PB with a secondary path that is not as it knows it, and what it gains by allowing for that."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from kfopc_filterpy import Plant, SimulationResult, noise_reduction_db
from kfopc_filterpy.controllers.kf_pb import DEFAULT_UNCERTAINTY
from kfopc_filterpy.paths import PathTolerance, identify_secondary_path, path_taps, perturbed_path
from kfopc_filterpy.signals import band_limited_noise, tone

from ..bench import Claim, Parameter, Runs, Scene, StudyReport, Table, Tuned, run_setting
from . import cases
from . import report_parts as parts
from .cases import FS, SEED, SENSOR_NOISE_DB, SWITCH_ON_S, Noise, noises, plants
from .rows import WindowRow, column, figure_table, figures_of, grouped, worst_claim

ALGORITHM = "KF-PB"
N_TAPS = 128
DURATION_S = 5.0
RATED_SHARE = 0.25  # of the unconstrained control power
WIDE_HZ, HIGH_TONE_HZ = (100.0, 6000.0), 4000.0
LOW = ("compressor", "band noise", "motor")  # their power lies below a sixth of the sample rate
BEYOND = "white"  # its power reaches beyond three eighths of the sample rate
ERRORS: dict[str, dict[str, float]] = {  # of the estimate
    "a sample late": {"delay_samples": 1.0},
    "a sample early": {"delay_samples": -1.0},
    "3 dB too high": {"gain_db": 3.0},
    "3 dB too low": {"gain_db": -3.0},
    "45 degrees ahead": {"phase_deg": 45.0},
    "45 degrees behind": {"phase_deg": -45.0},
}
EXACT, IDENTIFIED = "exact", "identified"
IDENTIFICATION_S = 5.0
NOTHING, DEFAULT, STATED = "nothing", "default", "stated"
ALLOWANCES = (NOTHING, DEFAULT, STATED)
COST_DB = 0.5
Knowledge = tuple[np.ndarray, Any]  # taps of the estimate, and what is stated of its uncertainty


@dataclass(frozen=True, kw_only=True)
class AllowanceRow(WindowRow):
    """KF-PB with an estimate that is wrong by `error`, and an allowance; the noise reduction is over the steady half."""

    error: str
    allowance: str
    worst_second_db: float = np.nan  # least noise reduction over a second after the first

    @property
    def louder_db(self) -> float:
        """How much louder the worst second is than without control; infinite if the filter diverged."""
        return np.inf if self.diverged_at_s is not None else -self.worst_second_db


def planned_runs() -> int:
    """Return the number of runs of the study."""
    return len(plants()) * len(study_noises()) * (cases.grid_runs([ALGORITHM]) + len(jobs()))


def main(runs: Runs) -> StudyReport:
    """Run the study on all plants and noises at hand."""
    at_hand = plants()
    rows: list[AllowanceRow] = []
    settings = {}
    for path, plant in at_hand.items():
        estimates = known_paths(plant)
        for noise, make in study_noises().items():
            scene = cases.make_case(plant, make(DURATION_S + SWITCH_ON_S, SEED), n_taps=N_TAPS)
            scene = replace(scene, rated_power=RATED_SHARE * scene.unconstrained_power)
            best = cases.tune_all(runs, scene, cases.grids([ALGORITHM]))
            settings[f"{path}, {noise}"] = parts.tuned_in_words(best)
            rows += runs.map(partial(run_job, scene, estimates, best[ALGORITHM], path, noise), jobs())
    return parts.report_of_rows(
        rows,
        name="uncertain-path",
        title="A secondary path that is known within a tolerance",
        summary=(
            f"KF-PB at {100 * RATED_SHARE:g} % of the power that the unconstrained filter needs. Its estimate of the "
            "secondary path is a sample, 3 dB or 45 degrees off at all frequencies, or was identified. It allows for "
            "nothing, which takes the estimate for exact, for its default, or for the error as it is, or the uncertainty "
            "that the identification returned, as stated."
        ),
        rated_power=RATED_SHARE,
        parameters=parts.case_parameters(Parameter(N_TAPS, "as in the other studies of wrong estimates"))
        | {
            "duration_s": Parameter(DURATION_S, "from switch-on on"),
            "errors": Parameter(ERRORS, "of the estimate: samples of delay, dB and degrees"),
            "identification_s": Parameter(IDENTIFICATION_S, "of white noise, for the estimate that is identified"),
            "wide_band_hz": Parameter(list(WIDE_HZ), "up to three eighths of the sample rate"),
            "high_tone_hz": Parameter(HIGH_TONE_HZ, "a quarter of the sample rate: a sample is 90 degrees"),
            "seed": Parameter(SEED, "of noise and sensor noise"),
            "settings": Parameter(settings, "with the exact path"),
        },
        claims=claims(rows),
        notes=[*parts.without_measured(at_hand), _power_note(rows), "There is one seed and one record for each case."],
        tables=[
            louder_table(rows),
            _table(rows, "worst", "Least noise reduction in dB over any second after the first", "worst_second_db"),
            _table(rows, "steady", "Noise reduction in dB over the steady half", "noise_reduction_db"),
        ],
    )


# ---- Runs


def study_noises() -> dict[str, Noise]:
    """Return the noises by name: those at hand that are steady or recorded, and some that reach high frequencies."""
    return {name: noise for name, noise in noises().items() if name in LOW} | {
        "wide band": lambda duration, seed: band_limited_noise(WIDE_HZ, duration, fs=FS, rng=seed),
        BEYOND: lambda duration, seed: np.random.default_rng(seed).standard_normal(round(duration * FS)),
        "high tone": lambda duration, seed: tone(HIGH_TONE_HZ, duration, fs=FS, phase_rad=float(seed)),
    }


def known_paths(plant: Plant) -> dict[str, Knowledge]:
    """Return the estimates of the secondary path, by what is wrong with them."""
    secondary = plant.secondary[0, 0]
    std = float(np.sqrt(np.sum(secondary**2)) * 10 ** (SENSOR_NOISE_DB / 20))
    noisy = Plant(secondary, fs=FS, sensor_noise_std=std)
    found = identify_secondary_path(noisy, n_taps=secondary.size, duration_s=IDENTIFICATION_S, rng=SEED)
    wrong = {error: path_taps(perturbed_path(secondary, fs=FS, **own)) for error, own in ERRORS.items()}
    return {
        EXACT: (secondary, None),
        IDENTIFIED: (found.taps, found.uncertainty),
        **{error: (taps, stated(error)) for error, taps in wrong.items()},
    }


def jobs() -> list[tuple[str, str]]:
    """Return what is run of each case: error of the estimate, and what is allowed for. Nothing is to be stated of an exact path."""
    wrong = [(error, allowance) for error in (IDENTIFIED, *ERRORS) for allowance in ALLOWANCES]
    return [(EXACT, NOTHING), (EXACT, DEFAULT), *wrong]


def run_job(
    scene: Scene, estimates: Mapping[str, Knowledge], best: Tuned | None, path: str, noise: str, job: tuple[str, str]
) -> AllowanceRow:
    """Run KF-PB with an estimate and an allowance."""
    error, allowance = job
    place: dict[str, Any] = {"path": path, "noise": noise, "algorithm": ALGORITHM}
    estimate, uncertainty = estimates[error]
    allowed = {NOTHING: None, DEFAULT: DEFAULT_UNCERTAINTY, STATED: uncertainty}[allowance]
    known = replace(scene, secondary_estimate=estimate, secondary_path_uncertainty=allowed)
    result = None if best is None else run_setting(known, ALGORITHM, best.setting)
    figures = figures_of(result, scene.rated_power)
    if result is not None and result.diverged_at_s is None:
        figures["worst_second_db"] = min(seconds_db(result)[1:])
    return AllowanceRow(**place, error=error, allowance=allowance, **figures)


def stated(error: str) -> PathTolerance:
    """Return the tolerance that covers an error of the estimate."""
    return PathTolerance(**{name: abs(value) for name, value in ERRORS[error].items()})


def seconds_db(result: SimulationResult) -> list[float]:
    """Return the noise reduction of each whole second in dB."""
    second = round(result.fs)
    begins = range(0, result.error.size - second + 1, second)
    parts = [slice(begin, begin + second) for begin in begins]
    return [noise_reduction_db(result.error[part], result.disturbance[part], steady=1.0) for part in parts]


# ---- Claims and notes


def claims(rows: Sequence[AllowanceRow]) -> list[Claim]:
    """Return the findings, each on all cases."""
    wrong = [row for row in rows if row.error != EXACT]
    low, beyond = ([row for row in rows if (row.noise == BEYOND) == high] for high in (False, True))
    cost = "Noise reduction that the default uncertainty costs with an exact path (dB)"
    return [
        *(
            worst_claim(
                f"How much louder a second after the first becomes (dB); allowed for: {allowance}",
                {f"{row.case}, {row.error}": row.louder_db for row in wrong if row.allowance == allowance},
                at_most=0.0,
            )
            for allowance in (DEFAULT, STATED)
        ),
        worst_claim(
            f"{cost}, noises below three eighths of the sample rate", _costs(low, EXACT, DEFAULT), at_most=COST_DB
        ),
        worst_claim(f"{cost}, white noise", _costs(beyond, EXACT, DEFAULT), at_most=COST_DB),
        worst_claim(
            "Noise reduction lost with a path that was identified and its uncertainty (dB)",
            _costs(rows, IDENTIFIED, STATED),
            at_most=COST_DB,
        ),
    ]


def _costs(rows: Iterable[AllowanceRow], error: str, allowance: str) -> dict[str, float]:
    """Return what is lost in comparison with an exact path that is taken for exact, by case."""
    reduction = {(row.case, row.error, row.allowance): row.noise_reduction_db for row in rows}
    cases = dict.fromkeys(case for case, *_ in reduction)
    return {str(case): reduction[case, EXACT, NOTHING] - reduction[case, error, allowance] for case in cases}


def louder_table(rows: Iterable[AllowanceRow]) -> Table:
    """Return in how many runs with a wrong path a second after the first is louder, and by how much at most."""
    wrong = [row for row in rows if row.error != EXACT]
    return Table(
        "louder",
        "Runs with a wrong path in which a second after the first is louder than without control, and by how much at most",
        ["allowed for", "runs", "louder", "most (dB)"],
        [
            [allowance, len(own), int(np.sum(~(column(own, "louder_db") <= 0.0))), column(own, "louder_db").max()]
            for (allowance,), own in grouped(wrong, "allowance").items()
        ],
    )


def _power_note(rows: Sequence[AllowanceRow]) -> str:
    powers = [row.power for row in rows if row.diverged_at_s is None and row.allowance == DEFAULT]
    return (
        f"With its default uncertainty KF-PB spends {min(powers):.2f} to {max(powers):.2f} of its rated power over the steady "
        "half, whatever is wrong with the estimate."
    )


# ---- Tables


def _table(rows: Sequence[AllowanceRow], stem: str, caption: str, figure: str) -> Table:
    keys = {"paths": "path", "noise": "noise", "estimate": "error"}
    return figure_table(stem, caption, rows, figure, keys, ALLOWANCES, "allowance")
