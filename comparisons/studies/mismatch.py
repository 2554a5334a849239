"""Study: a secondary path that is not as it was identified, in phase, gain or delay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import gt, lt
from typing import Any

import numpy as np

from kfopc_filterpy import Plant
from kfopc_filterpy.controllers.kf_pb import DEFAULT_UNCERTAINTY
from kfopc_filterpy.paths import path_taps, perturbed_path
from kfopc_filterpy.plot import curve_style

from .. import bench
from ..bench import Claim, FigureItem, Parameter, Runs, Scene, StudyReport, Table, Tuned, algorithms
from . import report_parts as parts
from .cases import BAND_HZ, FS, Case, driven_case, ducts, grid_runs, grids, noise_of
from .rows import Row, column, figure_table, grouped, select, span, worst_claim

ALGORITHMS = ("KF-ANC", "KF-OPC", "KF-PB", "FxRLS", "FxLMS", "MOV-FxLMS", "optimal leaky FxLMS")
KEEPS_POWER = ("KF-OPC", "KF-PB", "MOV-FxLMS")
OVERDRIVE_DB = 3.0
DURATION_S = 4.0
AMOUNTS = {
    "phase": (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0, 105.0, 120.0),
    "gain": (-12.0, -6.0, -3.0, 0.0, 3.0, 6.0, 12.0),
    "delay": (-10.0, -7.0, -4.0, -2.0, 0.0, 2.0, 4.0, 7.0, 10.0),
}
UNITS = {"phase": "degrees", "gain": "dB", "delay": "samples"}
ARGUMENTS = {"phase": "phase_deg", "gain": "gain_db", "delay": "delay_samples"}
EXACT, WRONG = "exact path", "wrong path"  # what an algorithm was tuned with
GAIN_LOSS_DB = 1.0
KEPT = (0.97, 1.02)  # output power over the rated one
BOTTOM_DB = -7.0  # of the figures
POWERS = (0.05, 20.0)

Point = tuple[str, float]  # kind and amount of a mismatch


@dataclass(frozen=True, kw_only=True)
class MismatchRow(Row):
    """The best setting of an algorithm at one mismatch; what it was tuned with is `EXACT` or `WRONG`."""

    kind: str
    amount: float
    tuned_with: str

    def __str__(self) -> str:
        return f"{self.algorithm}, {self.case}, {self.point}"

    @property
    def point(self) -> str:
        """What is wrong with the path, in words."""
        return f"{self.kind} {self.amount:+g} {UNITS[self.kind]}"

    @property
    def loss_db(self) -> float:
        """How much louder the noise gets; infinite if the filter diverged."""
        return np.inf if self.diverged_at_s is not None else -self.noise_reduction_db


def planned_runs() -> int:
    """Return the number of runs of the study."""
    return len(cases(list(ducts()))) * len(points()) * grid_runs(ALGORITHMS)


def main(runs: Runs) -> StudyReport:
    """Run the study on all ducts at hand."""
    plants = ducts()
    known = {name: estimates(plant.secondary[0, 0]) for name, plant in plants.items()}
    rows: list[MismatchRow] = []
    tuned, scenes = {}, {}
    for case in cases(list(plants)):
        scene = scenes[str(case)] = case_scene(case, plants[case.path])
        own, best = run_case(runs, case, scene, known[case.path])
        rows += own
        tuned[str(case)] = {f"{kind} {amount:g}": parts.tuned_in_words(t) for (kind, amount), t in best.items()}
    return parts.report_of_rows(
        rows,
        name="mismatch",
        title="A secondary path that is not as it was identified",
        summary=(
            "The controllers know the secondary path with a wrong phase, gain or delay. The noise asks for "
            f"{OVERDRIVE_DB:g} dB more than the rated power. Settings tuned with the exact path show what a path that "
            "drifts does to a user; settings tuned with the wrong one, the best that each algorithm could do."
        ),
        rated_power=1.0 / 10 ** (OVERDRIVE_DB / 10),
        parameters=parts.driven_parameters(DURATION_S, OVERDRIVE_DB)
        | {
            "mismatch": Parameter({kind: list(own) for kind, own in AMOUNTS.items()}, "degrees, dB and samples"),
            "settings": Parameter(tuned, "best and tried at each mismatch, over the known path's filtered reference"),
        },
        claims=claims(rows),
        figures=[_figure(rows, case) for case in dict.fromkeys(row.case for row in rows)],
        notes=[
            *parts.without_measured(plants),
            f"A delay of {FS / (2 * sum(BAND_HZ)):.1f} samples turns the middle of the band by 90 degrees, one of "
            f"{FS / (4 * BAND_HZ[1]):.0f} its upper edge.",
            "There is one seed and one record for each case: differences of some tenths of a dB mean nothing.",
            parts.ceilings_note(scenes),
        ],
        tables=[
            summary_table(rows),
            _table(rows, "exact", "Noise reduction over the steady half in dB", EXACT, "noise_reduction_db"),
            _table(rows, "wrong", "Noise reduction over the steady half in dB", WRONG, "noise_reduction_db"),
            _table(rows, "power", "Output power over the rated one", EXACT, "power"),
        ],
    )


# ---- Runs


def cases(names: Sequence[str]) -> list[Case]:
    """Return band noise on every path, and a tone on the first: its phase error is one number."""
    return [*(Case(path, "band noise") for path in names), Case(names[0], "tone")]


def points() -> list[Point]:
    """Return all mismatches, the exact path once."""
    return [("phase", 0.0), *((kind, a) for kind, own in AMOUNTS.items() for a in own if a)]


def estimates(secondary: np.ndarray) -> dict[Point, np.ndarray]:
    """Return the secondary path that controllers know at each mismatch."""
    return {
        (kind, amount): path_taps(perturbed_path(secondary, fs=FS, **{ARGUMENTS[kind]: amount}))
        for kind, amount in points()
    }


def case_scene(case: Case, plant: Plant) -> Scene:
    """Return the scene of a case with the exact path, of which KF-PB is not told that it is."""
    scene = driven_case(plant, noise_of(case.noise, DURATION_S), OVERDRIVE_DB)
    return replace(scene, secondary_path_uncertainty=DEFAULT_UNCERTAINTY)


def run_case(
    runs: Runs, case: Case, scene: Scene, known: Mapping[Point, np.ndarray]
) -> tuple[list[MismatchRow], dict[Point, dict[str, Tuned | None]]]:
    """Return every algorithm at every mismatch, at the settings best with the exact path and with the wrong one.

    Settings are relative to the power of the reference filtered by the known path. To FxLMS and KF-ANC an estimate with
    another gain is then the same as a true path that has drifted by the inverse. To an algorithm with a rated power it
    is not, since a true path of less gain asks for more power.
    """
    tried = {
        point: bench.try_settings(runs, replace(scene, secondary_estimate=taps), grids(ALGORITHMS))
        for point, taps in known.items()
    }
    best = {
        point: {name: bench.best_setting(scene, name, trials) for name, trials in own.items()}
        for point, own in tried.items()
    }
    rows = []
    for kind, amount in [(kind, amount) for kind, amounts in AMOUNTS.items() for amount in amounts]:
        point = (kind, amount) if amount else ("phase", 0.0)
        for name in ALGORITHMS:
            trials = {trial.setting: trial for trial in tried[point][name]}
            for tuned_with, tuned in ((EXACT, best["phase", 0.0][name]), (WRONG, best[point][name])):
                # If it diverged at every setting, any of them will do.
                trial = trials[tuned.setting if tuned else algorithms()[name].grid[0]]
                own = {key: getattr(trial, key) for key in ("setting", "noise_reduction_db", "diverged_at_s")}
                own |= {"power": np.nan if trial.diverged else trial.output_power / scene.rated_power}
                own |= {"kind": kind, "amount": amount, "algorithm": name, "tuned_with": tuned_with}
                rows.append(MismatchRow(**case.place, **own))
    return rows, best


# ---- Claims


def claims(rows: Sequence[MismatchRow]) -> list[Claim]:
    """Return the findings, each on all cases."""
    found = []
    for name in ("FxLMS", "KF-ANC"):
        own = select(rows, kind="phase", noise="band noise", algorithm=name, tuned_with=WRONG)
        below, above = ({str(row): -row.loss_db for row in own if turned(row.amount, 90.0)} for turned in (lt, gt))
        text = f"Noise reduction of {name} at phase errors {{}} 90 degrees, tuned with them (dB)"
        found += [
            worst_claim(text.format("below"), below, at_least=0.0),
            worst_claim(text.format("above"), above, at_most=0.0),
        ]
    gains = select(rows, kind="gain", tuned_with=EXACT)
    for name in ("KF-ANC", "KF-PB"):
        own = select(gains, algorithm=name)
        exact = {row.case: row.loss_db for row in own if row.amount == 0.0}
        text = f"Lost by {name} with a wrong gain, not tuned again (dB)"
        found.append(worst_claim(text, {str(row): row.loss_db - exact[row.case] for row in own}, at_most=GAIN_LOSS_DB))
    kept = [row for row in rows if row.algorithm in KEEPS_POWER]
    away = sum(row.diverged_at_s is not None for row in kept)
    text = f"Runs of {', '.join(KEEPS_POWER[:-1])} and {KEEPS_POWER[-1]} that diverge"
    powers = {str(row): row.power for row in select(gains, algorithm="KF-PB")}
    return [
        *found,
        Claim(text, away, at_most=0, note=f"of {len(kept)}"),
        worst_claim("Output power of KF-PB over the rated one, with a wrong gain", powers, at_least=KEPT[0]),
        worst_claim("Output power of KF-PB over the rated one, with a wrong gain", powers, at_most=KEPT[1]),
    ]


# ---- Tables and figures


def summary_table(rows: Sequence[MismatchRow]) -> Table:
    """Return what all mismatches together do to each algorithm, tuned with the exact path."""
    lines: list[list[str | float]] = []
    for (name,), own in grouped(select(rows, tuned_with=EXACT), "algorithm").items():
        gains = select(own, kind="gain")
        exact = {row.case: row.loss_db for row in gains if row.amount == 0.0}
        lost = np.max([row.loss_db - exact[row.case] for row in gains])
        away = sum(row.diverged_at_s is not None for row in own)
        lines.append([name, len(own), away, lost, span([row.power for row in gains if row.diverged_at_s is None])])
    return Table(
        "summary",
        "Tuned with the exact path: runs that diverge; with a wrong gain, noise reduction lost at most and output power over the "
        "rated one",
        ["algorithm", "runs", "diverged", "lost (dB)", "power"],
        lines,
    )


def _table(rows: Sequence[MismatchRow], stem: str, caption: str, tuned_with: str, figure: str) -> Table:
    keys = {"paths": "path", "noise": "noise", "mismatch": "point"}
    chosen = select(rows, tuned_with=tuned_with)
    return figure_table(stem, f"{caption}, tuned with the {tuned_with}", chosen, figure, keys, ALGORITHMS)


def _figure(rows: Sequence[MismatchRow], case: Case) -> FigureItem:
    """Return a figure with a column for each kind of mismatch: noise reduction for both tunings, output power."""
    own = select(rows, case=case)
    figure, axes = parts.new_figure((10.5, 9.0), 3, len(AMOUNTS), sharex="col", sharey="row")
    top = 1.05 * max(row.noise_reduction_db for row in own if row.diverged_at_s is None) + 1.0
    lines = (("noise_reduction_db", EXACT), ("noise_reduction_db", WRONG), ("power", EXACT))
    for line, (measure, tuned_with) in zip(axes, lines, strict=True):
        for ax, kind in zip(line, AMOUNTS, strict=True):
            for k, name in enumerate(ALGORITHMS):
                curve = select(own, kind=kind, algorithm=name, tuned_with=tuned_with)
                _draw(ax, curve, measure, k)
            ax.axhline(1.0 if measure == "power" else 0.0, color=parts.MARK, linewidth=1)
            if kind == "phase":
                ax.axvline(90.0, color=parts.MARK, linewidth=1, linestyle=":")
            ax.set_xticks(AMOUNTS[kind])
            ax.tick_params(axis="x", labelsize="small")
        words = "Output power / rated power" if measure == "power" else "Noise reduction (dB)"
        line[0].set_ylabel(f"{words}\ntuned with the {tuned_with}")
    for ax in axes[:2, 0]:
        ax.set_ylim(BOTTOM_DB - 3.5, top)
    axes[2, 0].set(yscale="log", ylim=(POWERS[0], 4 * POWERS[1]))
    for ax, kind in zip(axes[2], AMOUNTS, strict=True):
        ax.set_xlabel(f"{kind.capitalize()} error ({UNITS[kind]})")
    parts.legend_of(figure, axes[0])
    caption = (
        "Noise reduction and output power over the rated one against what is wrong with the secondary path known to the "
        f"controllers ({case}). Crosses: diverged, below {BOTTOM_DB:g} dB, or above {POWERS[1]:g} times the rated power."
    )
    return FigureItem(f"{case.path} {case.noise}".replace(" ", "-"), caption, figure)


def _draw(ax: Any, rows: Sequence[MismatchRow], measure: str, k: int) -> None:
    """Draw a curve as far as it lies on the scale, and a cross at the edge for each amount at which it does not."""
    amounts, values = column(rows, "amount"), column(rows, measure)
    inside = values <= POWERS[1] if measure == "power" else values >= BOTTOM_DB  # NaN is outside
    style = curve_style(rows[0].algorithm)
    ax.plot(amounts, np.where(inside, values, np.nan), label=rows[0].algorithm, linewidth=1.4, markersize=4.5, **style)
    edge = POWERS[1] * 1.2 ** (k + 1) if measure == "power" else BOTTOM_DB - 0.45 * (k + 1)
    ax.plot(amounts[~inside], np.full(int(np.sum(~inside)), edge), "x", color=style["color"], markersize=5)
