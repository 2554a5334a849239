"""Study: a secondary path that is not as it was identified, in phase, gain or delay."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from kfopc_filterpy.bench import (
    Claim,
    FigureItem,
    Parameter,
    Runs,
    Scene,
    StudyReport,
    Table,
    Trial,
    Tuned,
    algorithms,
    best_setting,
    try_settings,
)
from kfopc_filterpy.paths import frequency_response, group_delay, path_taps, perturbed_path
from kfopc_filterpy.plot import curve_style

from .cases import BAND_HZ, FS, TONE_HZ, Case, Pair, Row, driven_case, ducts, grid_runs, grids, noise_of
from .report_parts import (
    MARK,
    by_algorithm,
    ceilings_note,
    cell,
    driven_parameters,
    legend_of,
    new_figure,
    tuned_in_words,
    without_measured,
)

ALGORITHMS = ("KF-ANC", "KF-OPC", "KF-PB", "FxRLS", "FxLMS", "MOV-FxLMS", "optimal leaky FxLMS")
UNCONSTRAINED = ("KF-ANC", "FxRLS", "FxLMS")
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
BOTTOM_DB = -7.0  # of the figures
POWERS = (0.05, 20.0)

Point = tuple[str, float]  # kind and amount of a mismatch


@dataclass(frozen=True, kw_only=True)
class MismatchRow(Row):
    """The best setting of an algorithm at one mismatch; what it was tuned with is `EXACT` or `WRONG`."""

    kind: str
    amount: float
    tuned_with: str
    within_budget: bool


def planned_runs() -> int:
    """Return the number of runs of the study."""
    return len(cases(list(ducts()))) * len(points()) * grid_runs(ALGORITHMS)


def main(runs: Runs) -> StudyReport:
    """Run the study on all ducts at hand."""
    pairs = ducts()
    known = {name: estimates(secondary) for name, (_, secondary) in pairs.items()}
    rows: list[MismatchRow] = []
    tuned, scenes = {}, {}
    for case in cases(list(pairs)):
        scene = scenes[str(case)] = case_scene(case, pairs[case.path])
        own, best = run_case(runs, case, scene, known[case.path])
        rows += own
        tuned[str(case)] = {f"{kind} {amount:g}": tuned_in_words(t) for (kind, amount), t in best.items()}
    accuracy = {name: phase_accuracy_deg(pairs[name][1], own) for name, own in known.items()}
    return StudyReport(
        name="mismatch",
        title="A secondary path that is not as it was identified",
        summary=(
            "The controllers know the secondary path with a wrong phase, gain or delay; the true path is the same "
            f"throughout, and the amplifier linear. The noise asks for {OVERDRIVE_DB:g} dB more than the rated power. "
            "Settings tuned with the exact path show what a path that drifts does to a user; settings tuned with the "
            "wrong one, the best that each algorithm could do."
        ),
        fs=FS,
        rated_power=1.0 / 10 ** (OVERDRIVE_DB / 10),
        parameters=driven_parameters(DURATION_S, OVERDRIVE_DB)
        | {
            "mismatch": Parameter({kind: list(own) for kind, own in AMOUNTS.items()}, "degrees, dB and samples"),
            "phase_accuracy_deg": Parameter(
                accuracy, f"largest deviation from the phase wanted over {BAND_HZ[0]:g} to {BAND_HZ[1]:g} Hz"
            ),
            "settings": Parameter(
                tuned, "best and tried at each mismatch, relative to the known path's filtered reference"
            ),
        },
        algorithms={},
        extra={"rows": [asdict(row) for row in rows]},
        claims=claims(rows),
        figures=mismatch_figures(rows),
        notes=[*_notes(pairs, rows, accuracy), ceilings_note(scenes)],
        tables=[
            _table("exact", f"{_CAPTION}, at the settings that are best with the exact path", rows, EXACT),
            _table("wrong", f"{_CAPTION}, at the settings that are best with the wrong path", rows, WRONG),
            _table(
                "power",
                "Output power over the rated one, at the settings that are best with the exact path",
                rows,
                EXACT,
                "power",
            ),
        ],
        claims_heading="Findings",
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


def phase_accuracy_deg(secondary: np.ndarray, known: Mapping[Point, np.ndarray]) -> float:
    """Return the largest deviation of the phase over the band from the one wanted, which no causal filter has exactly."""
    f = np.arange(BAND_HZ[0], BAND_HZ[1] + 1.0, 10.0)
    exact = frequency_response(secondary, f, fs=FS)
    wanted = {
        "phase": lambda a: np.deg2rad(a) + 0 * f,
        "gain": lambda a: 0 * f,
        "delay": lambda a: -2 * np.pi * f / FS * a,
    }
    turns = [
        np.angle(frequency_response(taps, f, fs=FS) / exact * np.exp(-1j * wanted[kind](amount)))
        for (kind, amount), taps in known.items()
    ]
    return float(np.max(np.abs(np.degrees(turns))))


def case_scene(case: Case, pair: Pair) -> Scene:
    """Return the scene of a case with the exact path."""
    return driven_case(pair, noise_of(case.noise, DURATION_S), OVERDRIVE_DB)


def run_case(
    runs: Runs, case: Case, scene: Scene, known: Mapping[Point, np.ndarray]
) -> tuple[list[MismatchRow], dict[Point, dict[str, Tuned | None]]]:
    """Return every algorithm at every mismatch, at the settings best with the exact path and with the wrong one.

    Settings are relative to the power of the reference filtered by the known path. To FxLMS and KF-ANC an estimate with
    another gain is then the same as a true path that has drifted by the inverse. To an algorithm with a rated power it
    is not, since a true path of less gain asks for more power.
    """
    tried = {
        point: try_settings(runs, replace(scene, secondary_estimate=taps), grids(ALGORITHMS))
        for point, taps in known.items()
    }
    best = {
        point: {name: best_setting(scene, name, trials) for name, trials in own.items()} for point, own in tried.items()
    }
    rows = []
    for kind, amounts in AMOUNTS.items():
        for amount in amounts:
            point = (kind, amount) if amount else ("phase", 0.0)
            for name in ALGORITHMS:
                trials = {trial.setting: trial for trial in tried[point][name]}
                for tuned_with, tuned in ((EXACT, best["phase", 0.0][name]), (WRONG, best[point][name])):
                    # If it diverged at every setting, any of them will do.
                    trial = trials[tuned.setting if tuned else algorithms()[name].grid[0]]
                    place = {"kind": kind, "amount": amount, "algorithm": name, "tuned_with": tuned_with}
                    within = tuned is not None and tuned.within_budget
                    rows.append(_row(case, scene.rated_power, trial, within_budget=within, **place))
    return rows, best


def _row(case: Case, rated_power: float, trial: Trial, **place: Any) -> MismatchRow:
    return MismatchRow(
        path=case.path,
        noise=case.noise,
        setting=trial.setting,
        noise_reduction_db=trial.noise_reduction_db,
        power=np.nan if trial.diverged else trial.output_power / rated_power,
        diverged_at_s=trial.diverged_at_s,
        **place,
    )


# ---- Claims and notes


def claims(rows: Sequence[MismatchRow]) -> list[Claim]:
    """Return the findings, each on all cases."""
    return [
        *(_quarter_turn(rows, name) for name in ("FxLMS", "KF-ANC")),
        _gain(rows),
        _bounded(rows),
        _power(rows),
    ]


def _quarter_turn(rows: Iterable[MismatchRow], name: str) -> Claim:
    own = [
        row
        for row in rows
        if (row.kind, row.noise, row.algorithm, row.tuned_with) == ("phase", "band noise", name, WRONG)
    ]
    below, above = [r for r in own if r.amount < 90.0], [r for r in own if r.amount > 90.0]
    lost, left = [r for r in below if r.unstable], [r for r in above if not r.unstable]
    worst, best = min(below, key=_value), max(above, key=_value)
    return Claim(
        f"{name} tuned with the wrong path reduces band noise at every phase error below 90 degrees, and at none above",
        not lost and not left,
        f"{len(below) - len(lost)} of {len(below)} runs below reduce it, the least by {_value(worst):.1f} dB "
        f"({_where(worst)}); {len(left)} of {len(above)} above, the best of which is {_value(best):.1f} dB ({_where(best)})",
    )


def _value(row: MismatchRow) -> float:
    return -np.inf if row.diverged_at_s is not None else row.noise_reduction_db


def _where(row: MismatchRow) -> str:
    return f"{row.algorithm}, {row.path}, {row.noise}, {row.kind} {row.amount:+g} {UNITS[row.kind]}"


def _gain(rows: Sequence[MismatchRow]) -> Claim:
    losses = {}
    for name in ("KF-ANC", "KF-PB", "FxLMS", "MOV-FxLMS"):
        own = [row for row in rows if row.kind == "gain" and row.algorithm == name and row.tuned_with == EXACT]
        exact = {(row.path, row.noise): _value(row) for row in own if row.amount == 0.0}
        losses[name] = max(exact[row.path, row.noise] - _value(row) for row in own)
    largest = max(abs(a) for a in AMOUNTS["gain"])
    return Claim(
        f"A gain up to {largest:g} dB off costs KF-ANC and KF-PB at most {GAIN_LOSS_DB:g} dB without tuning again",
        max(losses["KF-ANC"], losses["KF-PB"]) <= GAIN_LOSS_DB,
        "largest loss: " + ", ".join(f"{name} {_loss(loss)}" for name, loss in losses.items()),
    )


def _loss(loss_db: float) -> str:
    return "diverges" if np.isinf(loss_db) else f"{loss_db:.1f} dB"


def _bounded(rows: Sequence[MismatchRow]) -> Claim:
    own = [row for row in rows if row.algorithm in KEEPS_POWER]
    away = [row for row in own if row.diverged_at_s is not None]
    others = [row for row in rows if row.algorithm in UNCONSTRAINED and row.tuned_with == EXACT]
    worst = min(own, key=_value)
    return Claim(
        f"{', '.join(KEEPS_POWER[:-1])} and {KEEPS_POWER[-1]} never diverge, whatever the mismatch and the tuning",
        not away,
        f"{len(away)} of {len(own)} runs diverged; the loudest left {-_value(worst):.1f} dB more than the noise "
        f"({_where(worst)}). Of the unconstrained algorithms tuned with the exact path "
        f"{sum(row.diverged_at_s is not None for row in others)} of {len(others)} diverged",
    )


def _power(rows: Sequence[MismatchRow]) -> Claim:
    powers = {
        name: [row.power for row in rows if row.algorithm == name and row.tuned_with == EXACT and row.kind == "gain"]
        for name in KEEPS_POWER
    }
    ours = powers["KF-PB"]
    return Claim(
        "With a wrong gain KF-PB keeps 0.97 to 1.02 of its rated power, and KF-OPC does not",
        bool(np.min(ours) >= 0.97 and np.max(ours) <= 1.02)
        and not bool(np.min(powers["KF-OPC"]) >= 0.97 and np.max(powers["KF-OPC"]) <= 1.02),
        "output power over the rated one: "
        + ", ".join(f"{name} {np.nanmin(own):.2f} to {np.nanmax(own):.2f}" for name, own in powers.items()),
    )


def _notes(pairs: Mapping[str, Pair], rows: Sequence[MismatchRow], accuracy: Mapping[str, float]) -> list[str]:
    anc = [row for row in rows if row.algorithm == "KF-ANC" and row.tuned_with == EXACT and row.kind == "phase"]
    late = [row.diverged_at_s for row in anc if row.diverged_at_s is not None]
    times = f"after {min(late):.1f} s at the earliest" if late else "at none of the phase errors within the run"
    over = [
        f"{row.algorithm} ({row.path}, {row.noise}: {row.power:.2f})"
        for row in rows
        if (row.kind, row.amount, row.tuned_with) == ("phase", 0.0, EXACT) and not row.within_budget
    ]
    kept = [f"Over its budget with the exact path too, at every setting tried: {', '.join(over)}."] if over else []
    return [
        *without_measured(pairs),
        *kept,
        "The Kalman filters have the bound of 90 degrees too because they trust d^ = e + s^*y, which is off by (s^ - s)*y. "
        "Filter weights that change slowly still settle where E[x' e] = 0, as those of FxLMS do, and move there along "
        "R_x'^-1 E[x' e], per frequency at a rate of s/s^: the gain no longer matters, the sign of its real part does.",
        f"Past 90 degrees KF-ANC runs away as FxLMS does; it passed 1e6 times the rated amplitude {times}. Before that "
        "it is already louder than the noise. Other settings hardly help: the best for FxLMS is its smallest step size, with "
        "which it grows too, only slowly.",
        *_tone_note(pairs),
        "An output constraint works as a leak: per frequency the error is d / (1 + s conj(s^)/lambda), which stays bounded "
        "while the real part of s conj(s^) is above -lambda, and below the noise somewhat past 90 degrees.",
        "Constant phase errors are fitted by causal filters: off by at most "
        + ", ".join(f"{value:.1f} degrees ({name})" for name, value in accuracy.items())
        + f" over the band. A delay of {FS / (2 * sum(BAND_HZ)):.1f} samples turns the middle of the band by 90 degrees, "
        f"one of {FS / (4 * BAND_HZ[1]):.0f} its upper edge.",
        "There is one seed and one record for each case: figures of one algorithm at neighbouring mismatches can be "
        "compared, differences of some tenths of a dB between algorithms cannot.",
    ]


def _tone_note(pairs: Mapping[str, Pair]) -> list[str]:
    """Return what sets a tone apart if the secondary path's phase rises with frequency there."""
    path = next(iter(pairs))
    delay = float(group_delay(pairs[path][1], [TONE_HZ], fs=FS)[0]) * FS
    if delay >= 0.0:
        return []
    return [
        f"A tone can stay in control somewhat past 90 degrees ({path}): 90 degrees is the bound of small step sizes. At "
        f"{TONE_HZ:g} Hz the path has an anti-resonance and a group delay of {delay:.0f} samples; weights that move fast "
        "shift the frequency of the error a little, and there the path's phase helps. At small step sizes the tone grows "
        "past 90 degrees as theory has it (a test of the study runs it on a pure delay)."
    ]


# ---- Tables and figures


_CAPTION = "Noise reduction over the steady half in dB"


def _table(
    stem: str, caption: str, rows: Sequence[MismatchRow], tuned_with: str, figure: str = "noise_reduction_db"
) -> Table:
    def cells() -> Iterator[tuple[tuple[str, ...], str, Any]]:
        for row in rows:
            if row.tuned_with == tuned_with:
                amount = f"{row.kind} {row.amount:+g} {UNITS[row.kind]}"
                yield (row.path, row.noise, amount), row.algorithm, cell(row, figure)

    return by_algorithm(stem, caption, ["paths", "noise", "mismatch"], ALGORITHMS, cells())


def mismatch_figures(rows: Sequence[MismatchRow]) -> list[FigureItem]:
    """Return figures of the noise reduction and of the output power of each case."""
    items = []
    for path, noise in dict.fromkeys((row.path, row.noise) for row in rows):
        own = [row for row in rows if (row.path, row.noise) == (path, noise)]
        stem = f"{path} {noise}".replace(" ", "-")
        items.append(
            FigureItem(
                f"reduction-{stem}",
                f"Noise reduction against what is wrong with the secondary path known to the controllers ({path}, {noise}). "
                f"Above: settings tuned with the exact path; below: with the wrong one. Crosses: diverged, or below {BOTTOM_DB:g} dB.",
                _reductions(own),
            )
        )
        items.append(
            FigureItem(
                f"power-{stem}",
                f"Output power over the rated one, settings tuned with the exact path ({path}, {noise}). Crosses: "
                f"diverged, or above {POWERS[1]:g} times.",
                _powers(own),
            )
        )
    return items


def _reductions(rows: Sequence[MismatchRow]) -> Any:
    figure, axes = new_figure((10.5, 6.4), 2, len(AMOUNTS), sharey=True, sharex="col")
    top = 1.05 * max(row.noise_reduction_db for row in rows if row.diverged_at_s is None) + 1.0
    for line, tuned_with in zip(axes, (EXACT, WRONG), strict=True):
        for ax, kind in zip(line, AMOUNTS, strict=True):
            own = [row for row in rows if (row.kind, row.tuned_with) == (kind, tuned_with)]
            for k, name in enumerate(ALGORITHMS):
                _draw(ax, [row for row in own if row.algorithm == name], "noise_reduction_db", k)
            ax.axhline(0.0, color=MARK, linewidth=1)
            ax.set_ylim(BOTTOM_DB - 3.5, top)
            _mismatch_axis(ax, kind)
        line[0].set_ylabel(f"Noise reduction (dB)\ntuned with the {tuned_with}")
    for ax in axes[0]:
        ax.set_xlabel("")
    legend_of(figure, axes.flat)
    return figure


def _powers(rows: Sequence[MismatchRow]) -> Any:
    figure, axes = new_figure((10.5, 4.0), 1, len(AMOUNTS), sharey=True)
    for ax, kind in zip(axes[0], AMOUNTS, strict=True):
        own = [row for row in rows if (row.kind, row.tuned_with) == (kind, EXACT)]
        for k, name in enumerate(ALGORITHMS):
            _draw(ax, [row for row in own if row.algorithm == name], "power", k)
        ax.axhline(1.0, color=MARK, linewidth=1)
        ax.set_yscale("log")
        ax.set_ylim(POWERS[0], 4 * POWERS[1])
        _mismatch_axis(ax, kind)
    axes[0, 0].set_ylabel("Output power / rated power")
    legend_of(figure, axes[0])
    return figure


def _draw(ax: Any, rows: Sequence[MismatchRow], figure: str, k: int) -> None:
    """Draw a curve as far as it lies on the scale, and a cross at the edge for each amount at which it does not."""
    amounts = np.array([row.amount for row in rows])
    values = np.array([getattr(row, figure) for row in rows], dtype=np.float64)
    inside = values >= BOTTOM_DB if figure == "noise_reduction_db" else values <= POWERS[1]  # NaN is outside
    own = curve_style(rows[0].algorithm)
    ax.plot(amounts, np.where(inside, values, np.nan), label=rows[0].algorithm, linewidth=1.4, markersize=4.5, **own)
    edge = BOTTOM_DB - 0.45 * (k + 1) if figure == "noise_reduction_db" else POWERS[1] * 1.2 ** (k + 1)
    ax.plot(amounts[~inside], np.full(int(np.sum(~inside)), edge), "x", color=own["color"], markersize=5)


def _mismatch_axis(ax: Any, kind: str) -> None:
    labels = {"phase": "Phase error", "gain": "Gain error", "delay": "Delay error"}
    ax.set_xticks(AMOUNTS[kind])
    ax.tick_params(axis="x", labelsize="small")
    ax.set_xlabel(f"{labels[kind]} ({UNITS[kind]})")
    if kind == "phase":
        ax.axvline(90.0, color=MARK, linewidth=1, linestyle=":")
    ax.grid(True, alpha=0.3)
