"""Study: the rated power kept on real paths, and the noise reduction it can buy (docs/constraint.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product

import numpy as np

from kfopc_filterpy.controllers.kf_pb import DEFAULT_AVERAGING_S
from kfopc_filterpy.metrics import convergence_time_s

from .. import bench
from ..bench import Claim, Parameter, Runs, Scene, StudyReport, Table, Tuned
from . import cases
from . import report_parts as parts
from .cases import FS, SWITCH_ON_S, WINDOW_S, Case, noises, plants
from .constraint_amplifiers import LIMITED, ClippedRow, Settings, amplifier_table, controller_of, run_amplifiers
from .rows import WindowRow, column, figures_of, select, worst_claim

N_TAPS = 160
DURATIONS_S = (8.0, 60.0)  # settings are tuned and convergence is measured on the first; the second averages more
SEEDS = (1, 2, 3, 4)
SHARES = (0.25, 0.10)  # rated power over the unconstrained control power
TUNED = ("KF-OPC", "KF-PB")
SHARED = {"KF-ANC": "KF-OPC", "KF-OPC limited": "KF-OPC", "KF-PB limited": "KF-PB"}  # whose setting each has
CLIPPED_NOISES = ("tone", "band noise")

Settled = Mapping[str, Mapping[str, float]]  # convergence times by case and algorithm


@dataclass(frozen=True, kw_only=True)
class ConstraintRow(WindowRow):
    """One run of a case."""

    share: float
    duration_s: float
    seed: int
    bound_db: float  # over the record for a stationary noise, of each second for another

    @property
    def loss_db(self) -> float:
        """Noise reduction below the bound."""
        return self.bound_db - self.noise_reduction_db

    @property
    def place(self) -> str:
        """Where it was run, in words."""
        return f"{self.case}, {100 * self.share:.0f} %, {self.duration_s:g} s, seed {self.seed}"


def planned_runs() -> int:
    """Return the number of jobs of the study."""
    everything = [Case(*names) for names in product(plants(), noises())]
    runs = len(everything) * (cases.grid_runs(TUNED) + len(DURATIONS_S) * len(SEEDS))
    return runs + sum(case.stationary for case in everything) + len(plants()) * len(CLIPPED_NOISES)


def main(runs: Runs) -> StudyReport:
    """Run the study on all plants and noises at hand; the first seed and duration are what settings are tuned on."""
    at_hand, made = plants(), noises()
    everything = [Case(*names) for names in product(at_hand, made)]

    def scene(case: Case, duration_s: float = DURATIONS_S[0], seed: int = SEEDS[0]) -> Scene:
        noise = made[case.noise](duration_s + SWITCH_ON_S, seed)
        return replace(cases.make_case(at_hand[case.path], noise, n_taps=N_TAPS), rated_power=SHARES[0])

    def times(case: Case) -> dict[str, float]:
        return convergence_times([scene(case, seed=seed) for seed in SEEDS], tuned[case])

    def amplified(case: Case) -> list[ClippedRow]:
        return run_amplifiers(scene(case), at_hand[case.path], case, tuned[case])

    tuned: dict[Case, Settings] = {}
    for case in everything:
        own = bench.tune(runs, scene(case), TUNED)
        tuned[case] = own | {name: own[other] for name, other in SHARED.items()}
    jobs = list(product(everything, DURATIONS_S, SEEDS))
    rows = list(chain(*runs.map(lambda job: run_case(scene(*job), *job, tuned[job[0]]), jobs)))
    stationary = [case for case in everything if case.stationary]
    settled = dict(zip(map(str, stationary), runs.map(times, stationary), strict=True))
    clipped = list(chain(*runs.map(amplified, [Case(*names) for names in product(at_hand, CLIPPED_NOISES)])))
    return parts.report_of_rows(
        rows,
        name="constraint",
        title="The constraint that holds",
        summary=(
            "KF-PB and KF-OPC against the power-constrained Wiener solution, on modelled and real paths. The rated power is a share of what full control of each noise would need."
        ),
        rated_power=SHARES[0],
        parameters=parts.case_parameters(Parameter(N_TAPS, "the aim's own"))
        | {
            "rated_power": Parameter(list(SHARES), "shares of the unconstrained control power of each noise"),
            "durations_s": Parameter(list(DURATIONS_S), "from switch-on on; the steady half counts"),
            "seeds": Parameter(list(SEEDS), "of noise; of a tone, its phase; of the recording, where it begins"),
            "limiter_window_s": Parameter(WINDOW_S, "default of OutputLimiter"),
            "KF-PB averaging_s": Parameter(DEFAULT_AVERAGING_S, "default of kf_pb"),
            "r E[x'^2]/q": Parameter(
                {str(case): {name: own[name].setting for name in TUNED} for case, own in tuned.items()},
                f"tuned on the first seed, {DURATIONS_S[0]:g} s, 25 %: {Tuned.RULE}",
            ),
        },
        extra={"convergence_s": settled},
        claims=claims(rows, clipped, settled),
        notes=parts.without_measured(at_hand),
        tables=[_summary_table(rows), amplifier_table(clipped)],
    )


# ---- Runs


def run_case(scene: Scene, case: Case, duration_s: float, seed: int, tuned: Settings) -> list[ConstraintRow]:
    """Run all algorithms on one noise, with each rated power."""
    rows: list[ConstraintRow] = []
    for share in SHARES:
        rated = replace(scene, rated_power=share)
        place = case.place | {"share": share, "seed": seed, "duration_s": duration_s}
        place["bound_db"], _ = cases.bounds_db(rated, case.stationary)
        for name in (*TUNED, *LIMITED):
            figures = figures_of(rated.run(controller_of(rated, name, tuned)), share)
            rows.append(ConstraintRow(**place, algorithm=name, setting=tuned[name].setting, **figures))
    return rows


def convergence_times(scenes: Sequence[Scene], tuned: Settings) -> dict[str, float]:
    """Return convergence times in seconds of KF-ANC and KF-PB, the NSE over 50 ms pooled over the scenes."""
    times = {}
    for name in ("KF-ANC", "KF-PB"):
        results = [scene.run(controller_of(scene, name, tuned)) for scene in scenes]
        errors, disturbances = (np.array([getattr(r, own) for r in results]) for own in ("error", "disturbance"))
        times[name] = convergence_time_s(errors, disturbances, FS, window_s=0.05, runs=True)
    return times


# ---- Claims


def claims(rows: Sequence[ConstraintRow], clipped: Sequence[ClippedRow], settled: Settled) -> list[Claim]:
    """Return the aims; a run without a figure, which diverged, meets none."""
    ours = select(rows, algorithm="KF-PB")
    longest = max(row.duration_s for row in rows)
    steady = [row for row in ours if row.case.stationary]
    varying = [row for row in ours if not row.case.stationary and row.duration_s == longest]
    limited = column([row for row in [*rows, *clipped] if row.algorithm in LIMITED], "worst_window")
    opc, pb = ({row.place: row.noise_reduction_db for row in select(rows, algorithm=name)} for name in LIMITED)
    slower = {where: own["KF-PB"] - 1.5 * np.nan_to_num(own["KF-ANC"], nan=np.inf) for where, own in settled.items()}

    def of(own: Sequence[ConstraintRow], name: str) -> dict[str, float]:
        return {row.place: getattr(row, name) for row in own}

    power, loss = "Output power of KF-PB over the rated one", "Noise reduction of KF-PB below the bound (dB)"
    return [
        worst_claim(f"{power}, stationary noise", of(steady, "power"), at_most=1.02),
        worst_claim(f"{power}, stationary noise", of(steady, "power"), at_least=0.97),
        worst_claim(f"{loss}, stationary noise", of(steady, "loss_db"), at_most=0.5),
        worst_claim(f"{power}, varying noise, {longest:g} s", of(varying, "power"), at_most=1.05),
        worst_claim(f"{loss} of each second, varying noise, {longest:g} s", of(varying, "loss_db"), at_most=1.0),
        Claim(
            f"Power over any {1e3 * WINDOW_S:g} ms over the rated one, behind the limiter",
            limited.max(),
            at_most=1 + 1e-9,
            note=f"{len(limited)} runs, with a level jump, a wrong path and a clipping amplifier among them",
        ),
        worst_claim(
            "Noise reduction of KF-PB below that of KF-OPC, both behind the limiter (dB)",
            {place: opc[place] - pb[place] for place in pb},
            at_most=0.3,
        ),
        worst_claim("Convergence time of KF-PB less 1.5 times that of KF-ANC (s)", slower, at_most=0.0),
    ]


# ---- Tables


def _summary_table(rows: Sequence[ConstraintRow]) -> Table:
    """Return what the longest runs together say of each algorithm."""
    longest = max(row.duration_s for row in rows)
    lines: list[list[str | float]] = []
    for name, kind in product((*TUNED, *LIMITED), ("stationary", "varying")):
        own = select(rows, algorithm=name, duration_s=longest)
        own = [row for row in own if row.case.stationary == (kind == "stationary")]
        losses, powers = column(own, "loss_db"), column(own, "power")
        spent, window = f"{powers.min():.2f}-{powers.max():.2f}", column(own, "worst_window").max()
        lines.append([name, kind, len(own), spent, losses.mean(), losses.max(), window])
    return Table(
        "summary",
        f"Runs of {longest:g} s: output power over the rated one, noise reduction below the bound in dB, and largest mean "
        f"power over {1e3 * WINDOW_S:g} ms over the rated one",
        ["algorithm", "noise", "runs", "power", "below, mean", "below, worst", "worst window"],
        lines,
    )
