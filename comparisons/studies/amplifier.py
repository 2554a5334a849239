"""Study: an amplifier that saturates, and a noise that asks for more than it has."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from kfopc_filterpy import HardClipAmplifier, Plant, SoftSaturationAmplifier, output_power
from kfopc_filterpy.metrics import coherence_and_gain, harmonics_db
from kfopc_filterpy.plot import curve_style

from .. import bench
from ..bench import Claim, FigureItem, Parameter, Runs, Scene, StudyReport, Table, Tuned, algorithms
from . import cases
from . import report_parts as parts
from .cases import BAND_HZ, FS, TONE_HZ, Case, Setting
from .rows import Row, column, grouped, select, span, worst_claim

PEAK_LIMITED = ("clipping FxLMS", "re-scaling FxLMS", "two-gradient FxLMS")
ALGORITHMS = ("KF-ANC", "FxLMS", "KF-OPC", "KF-PB", "MOV-FxLMS", *PEAK_LIMITED)
KEEPS_POWER = ("KF-OPC", "KF-PB")
OVERDRIVES_DB = (0.0, 2.0, 5.0, 10.0, 15.0, 20.0)
STEP_SIZES = algorithms()["FxLMS"].first  # that are tried of an algorithm that limits its amplitude
LIMIT_SHARES = (0.5, 1.0)  # squared amplitude limit of the algorithm over the amplifier's: their power, and their peak
DURATION_S = 4.0
WEIGHTS_EVERY = 160
OVERRUN = 2.0  # output power that a filter ends up asking for, over what cancelling needs, beyond which it overruns
CLEANER_DB = 40.0  # as in the tonal study
AMPLIFIERS: dict[str, Any] = {"hard clip": HardClipAmplifier, "soft saturation": SoftSaturationAmplifier}
UNKNOWN, KNOWN = "unknown", "known"  # to the disturbance estimate
TOP_DB = 20.0  # of the figures
LABELS = {
    "noise_reduction_db": "Noise reduction (dB)",
    "harmonics_db": "Harmonics over the disturbance (dB)",
    "coherence": "Coherence of anti-noise and disturbance",
    "power": "Output power / rated power",
}


@dataclass(frozen=True, kw_only=True)
class AmplifierRow(Row):
    """The best setting of an algorithm at one overdrive; its power is before the amplifier."""

    amplifier: str
    overdrive_db: float
    known: str
    within_budget: bool = False
    harmonics_db: float = np.nan  # over the disturbance, a tone's only
    coherence: float = np.nan  # of anti-noise and disturbance over the band, a band noise's only
    asked_power: float = np.nan  # of the last weights without any limit, over the power that cancels the noise
    weight_growth: float = np.nan  # largest weight at the end over that at half of the run

    @property
    def place(self) -> tuple[str, str, str, float]:
        """Where it was run."""
        return self.path, self.noise, self.amplifier, self.overdrive_db

    @property
    def overruns(self) -> bool:
        """Whether its weights ask for more than it takes to cancel the noise with a linear amplifier."""
        return self.diverged_at_s is not None or self.asked_power > OVERRUN


def planned_runs() -> int:
    """Return the number of runs of the study."""
    tried = {name: len(grid) for name, grid in cases.grids(ALGORITHMS).items()}
    tried |= dict.fromkeys(PEAK_LIMITED, len(STEP_SIZES) * len(LIMIT_SHARES))
    of_a_case = sum(tried[name] + 1 for name in [*ALGORITHMS, *knowing()])
    return len(all_cases(list(cases.ducts()))) * len(OVERDRIVES_DB) * of_a_case


def main(runs: Runs) -> StudyReport:
    """Run the study on all ducts at hand."""
    plants = cases.ducts()
    rows: list[AmplifierRow] = []
    tuned = {}
    for case in all_cases(list(plants)):
        own, best = run_case(runs, case, plants[case.path])
        rows += own
        tuned[f"{case}, {case.amplifier}"] = {at: parts.tuned_in_words(one) for at, one in best.items()}
    return parts.report_of_rows(
        rows,
        name="amplifier",
        title="An amplifier that saturates",
        summary=(
            "A tone and a band noise that ask for up to 20 dB more than the rated power, and an amplifier, hard clip or soft "
            "saturation (Rapp, p = 2), that puts out sqrt(2 rated power) at most. Settings are tuned at every overdrive."
        ),
        parameters=parts.driven_parameters(DURATION_S, list(OVERDRIVES_DB))
        | {
            "amplitude_limits": Parameter(
                list(LIMIT_SHARES), "A^2 of the peak-limited algorithms over the amplifier's"
            ),
            "overrun": Parameter(OVERRUN, "power that the last weights ask for over what cancels the noise"),
            "settings": Parameter(tuned, "best and tried at each overdrive, without and with the amplifier known"),
        },
        claims=claims(rows),
        figures=[_figure(case, own) for case, own in grouped(rows, "path", "noise", "amplifier").items()],
        notes=parts.without_measured(plants),
        tables=[_table(rows)],
    )


# ---- Runs


def all_cases(names: Sequence[str]) -> list[Case]:
    """Return both amplifiers on the first paths, and the hard clip on the others."""
    return [
        Case(path, noise, amplifier)
        for path in names
        for amplifier in AMPLIFIERS
        if path == names[0] or amplifier == "hard clip"
        for noise in ("tone", "band noise")
    ]


def settings_for(scene: Scene, algorithms: Sequence[str]) -> dict[str, list[Setting]]:
    """Return the settings that are tried.

    An algorithm that limits its amplitude is given the amplifier's limit, and the one at which even a square wave keeps
    the rated power.
    """
    limit = scene.amplitude_limit**2 / scene.unconstrained_power
    peaks: list[Setting] = [(mu, share * limit) for mu in STEP_SIZES for share in LIMIT_SHARES]
    return {name: peaks if name in PEAK_LIMITED else own for name, own in cases.grids(algorithms).items()}


def knowing() -> list[str]:
    """Return the algorithms whose disturbance estimate can know the amplifier."""
    return [name for name in ALGORITHMS if algorithms()[name].knows_amplifier]


def saturating(scene: Scene, case: Case, overdrive_db: float, known: str) -> Scene:
    """Return the scene at an overdrive, with an amplifier that puts out sqrt(2 rated power) at most."""
    driven = cases.with_overdrive(scene, overdrive_db)
    amplifier = AMPLIFIERS[case.amplifier](driven.amplitude_limit)
    return replace(driven, amplifier=amplifier, known_amplifier=amplifier if known == KNOWN else None)


def run_case(runs: Runs, case: Case, plant: Plant) -> tuple[list[AmplifierRow], dict[str, dict[str, Tuned | None]]]:
    """Return every algorithm at every overdrive, tuned there; those that can know the amplifier without and with it."""
    scene = cases.driven_case(plant, cases.noise_of(case.noise, DURATION_S), 0.0)
    rows: list[AmplifierRow] = []
    best = {}
    for overdrive, known in product(OVERDRIVES_DB, (UNKNOWN, KNOWN)):
        names = list(ALGORITHMS) if known == UNKNOWN else knowing()
        driven = saturating(scene, case, overdrive, known)
        tuned = cases.tune_all(runs, driven, settings_for(driven, names))
        best[f"{overdrive:g} dB, {known}"] = tuned
        rows += runs.map(partial(_run, driven, case, tuned, overdrive, known), names)
    return rows, best


def _run(
    scene: Scene, case: Case, tuned: Mapping[str, Tuned | None], overdrive_db: float, known: str, algorithm: str
) -> AmplifierRow:
    own: dict[str, Any] = asdict(case) | {"algorithm": algorithm, "overdrive_db": overdrive_db, "known": known}
    best = tuned[algorithm]
    if best is None:
        return AmplifierRow(**own, diverged_at_s=0.0)
    own |= {"setting": best.setting, "within_budget": best.within_budget}
    result = scene.run(bench.make_controller(scene, algorithm, best.setting), record_weights_every=WEIGHTS_EVERY)
    if result.diverged_at_s is not None:
        return AmplifierRow(**own, diverged_at_s=result.diverged_at_s)
    e, d = result.error, result.disturbance
    assert result.weights is not None
    largest = np.abs(result.weights).max(axis=1)
    asked = np.convolve(result.reference, result.weights[-1])[: e.size]
    tonal = case.noise == "tone"
    return AmplifierRow(
        **own,
        noise_reduction_db=result.noise_reduction_db,
        harmonics_db=harmonics_db(e, d, TONE_HZ, FS) if tonal else np.nan,
        coherence=np.nan if tonal else coherence_and_gain(d, result.anti_noise, FS, BAND_HZ).coherence,
        power=result.output_power / scene.rated_power,
        asked_power=output_power(asked) / scene.unconstrained_power,
        weight_growth=float(largest[-1] / largest[largest.size // 2]),
    )


# ---- Claims


def claims(rows: Sequence[AmplifierRow]) -> list[Claim]:
    """Return the findings, each on all cases; a figure that is NaN, of a run that diverged, meets none."""
    anc, known = _of(rows, "KF-ANC"), _of(rows, "KF-ANC", KNOWN)
    harmonics = {row.place: np.nan_to_num(row.harmonics_db, nan=np.inf) for row in anc}
    free = {row.place: np.nan_to_num(row.noise_reduction_db, nan=-np.inf) for row in anc}
    cleaner: dict[str, float] = {}
    powers: dict[str, float] = {}
    for name in KEEPS_POWER:
        own = [row for row in _of(rows, name, noise="tone", amplifier="hard clip") if row.overdrive_db > 0.0]
        cleaner |= {_told(row): row.harmonics_db - harmonics[row.place] for row in own}
        powers |= {_told(row): row.power for row in _of(rows, name)}
    leads = {
        _told(row): row.noise_reduction_db - free[row.place] for row in _of(rows, "KF-OPC") if row.overdrive_db > 0.0
    }
    return [
        *(_overruns(rows, name) for name in ("KF-ANC", "clipping FxLMS")),
        Claim(
            "Share of the runs in which KF-ANC overruns with the amplifier known",
            np.mean(column(known, "overruns")),
            at_most=0.0,
            note=f"{len(known)} runs",
        ),
        worst_claim(
            f"Harmonics of {' and '.join(KEEPS_POWER)} less those of KF-ANC, hard clip (dB)",
            cleaner,
            at_most=-CLEANER_DB,
        ),
        worst_claim(
            f"Output power of {' and '.join(KEEPS_POWER)} over the rated one, amplifier unknown", powers, at_most=1.02
        ),
        worst_claim("Noise reduction of KF-OPC less that of KF-ANC (dB)", leads, at_least=0.0),
    ]


def _told(row: AmplifierRow) -> str:
    return f"{row.algorithm}, {', '.join(map(str, row.place))} dB"


def _of(rows: Iterable[AmplifierRow], algorithm: str, known: str = UNKNOWN, **values: str) -> list[AmplifierRow]:
    return select(rows, algorithm=algorithm, known=known, **values)


def _overruns(rows: Sequence[AmplifierRow], algorithm: str) -> Claim:
    driven = [row for row in _of(rows, algorithm, noise="tone") if row.overdrive_db >= 5.0]
    text = f"Share of the runs with a tone from 5 dB of overdrive on in which {algorithm} overruns, amplifier unknown"
    return Claim(text, np.mean(column(driven, "overruns")), at_least=1.0, note=f"{len(driven)} runs")


# ---- Table and figures


def _table(rows: Sequence[AmplifierRow]) -> Table:
    """Return what all runs together say of each algorithm."""
    lines: list[list[str | float]] = []
    for (known, name), own in grouped(rows, "known", "algorithm").items():
        went_on = [row for row in own if row.diverged_at_s is None]
        spans = [span(column(went_on, figure)) for figure in ("power", "asked_power")]
        lines.append([name, known, len(own), sum(row.overruns for row in own), len(own) - len(went_on), *spans])
    return Table(
        "summary",
        "Runs that overrun and that diverge, output power before the amplifier over the rated power, and the power that the "
        "last weights ask for over what cancels the noise",
        ["algorithm", "amplifier", "runs", "overrun", "diverged", "power", "asked for"],
        lines,
    )


def _figure(case: tuple[str, ...], rows: Sequence[AmplifierRow]) -> FigureItem:
    """Return a figure of noise reduction, distortion and output power against the overdrive."""
    figure, axes = parts.new_figure((11.0, 6.4), 2, 3, sharex=True, sharey="col")
    shown = ("noise_reduction_db", "harmonics_db" if case[1] == "tone" else "coherence", "power")
    for line, known in zip(axes, (UNKNOWN, KNOWN), strict=True):
        for ax, value in zip(line, shown, strict=True):
            for name in ALGORITHMS:
                _draw(ax, _of(rows, name, known), value)
            ax.set_ylabel(LABELS[value])
        line[0].set_ylabel(f"amplifier {known}\n{LABELS[shown[0]]}")
    axes[0, 0].set_ylim(top=TOP_DB)
    axes[0, 2].set_yscale("log")
    for ax in axes[1]:
        ax.set_xlabel("Overdrive (dB)")
    parts.legend_of(figure, [axes[0, 0]])
    caption = (
        f"{', '.join(case).capitalize()}. Above: the disturbance estimate does not know the amplifier; below: it does, if "
        "it can. Black crosses: the filter overruns. A gap: it diverged. Output power is before the amplifier."
    )
    return FigureItem("-".join(case).replace(" ", "-"), caption, figure)


def _draw(ax: Any, rows: Sequence[AmplifierRow], figure: str) -> None:
    """Draw a figure of an algorithm against the overdrive; there are no rows of one that cannot know the amplifier."""
    if not rows:
        return
    levels, values, over = (column(rows, name) for name in ("overdrive_db", figure, "overruns"))
    ax.plot(levels, values, label=rows[0].algorithm, linewidth=1.3, markersize=4.5, **curve_style(rows[0].algorithm))
    ax.plot(levels[over], values[over], "x", color="black", markersize=7, markeredgewidth=0.9)
