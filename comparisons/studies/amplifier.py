"""Study: an amplifier that saturates, and a noise that asks for more than it has."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from kfopc_filterpy import (
    HardClipAmplifier,
    SoftSaturationAmplifier,
    clipped_fraction,
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
    Table,
    Tuned,
    algorithms,
    make_controller,
)
from kfopc_filterpy.metrics import coherence_and_gain, harmonics_db
from kfopc_filterpy.plot import curve_style

from .cases import (
    BAND_HZ,
    FS,
    TONE_HZ,
    Case,
    Pair,
    Row,
    Setting,
    driven_case,
    ducts,
    grids,
    noise_of,
    tune_all,
    with_overdrive,
)
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

FREE = ("KF-ANC", "FxLMS")
POWER_LIMITED = ("KF-OPC", "KF-PB", "MOV-FxLMS")
PEAK_LIMITED = ("clipping FxLMS", "re-scaling FxLMS", "two-gradient FxLMS")
ALGORITHMS = (*FREE, *POWER_LIMITED, *PEAK_LIMITED)
KEEPS_POWER = ("KF-OPC", "KF-PB")
OVERDRIVES_DB = (0.0, 2.0, 5.0, 10.0, 15.0, 20.0)
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
    within_budget: bool
    harmonics_db: float = np.nan  # over the disturbance, a tone's only
    coherence: float = np.nan  # of anti-noise and disturbance over the band, a band noise's only
    clipped_fraction: float = np.nan
    asked_power: float = np.nan  # of the last weights without any limit, over the power that cancels the noise
    weight_growth: float = np.nan  # largest weight at the end over that at half of the run

    @property
    def overruns(self) -> bool:
        """Whether its weights ask for more than it takes to cancel the noise with a linear amplifier."""
        return self.diverged_at_s is not None or self.asked_power > OVERRUN


def planned_runs() -> int:
    """Return the number of runs of the study."""
    return len(cases(list(ducts()))) * runs_of_a_case()


def main(runs: Runs) -> StudyReport:
    """Run the study on all ducts at hand."""
    pairs = ducts()
    rows: list[AmplifierRow] = []
    tuned = {}
    for case in cases(list(pairs)):
        own, best = run_case(runs, case, pairs[case.path])
        rows += own
        tuned[f"{case}, {case.amplifier}"] = {at: tuned_in_words(one) for at, one in best.items()}
    return StudyReport(
        name="amplifier",
        title="An amplifier that saturates",
        summary=(
            "A tone and a band noise that ask for up to 20 dB more than the rated power, and an amplifier that puts out "
            "sqrt(2 rated power) at most, the peak of a sine of rated power: a hard clip, and a soft saturation (Rapp, p = 2). "
            "Settings are tuned again at every overdrive."
        ),
        fs=FS,
        rated_power=1.0,
        parameters=driven_parameters(DURATION_S, list(OVERDRIVES_DB))
        | {
            "amplitude_limits": Parameter(
                list(LIMIT_SHARES),
                "A^2 of the peak-limited algorithms over the amplifier's: up to the amplifier's own; tuned with the step size",
            ),
            "overrun": Parameter(
                OVERRUN, "power that the last weights ask for over what cancels the noise with a linear amplifier"
            ),
            "settings": Parameter(tuned, "best and tried at each overdrive, without and with the amplifier known"),
        },
        algorithms={},
        extra={"rows": [asdict(row) for row in rows]},
        claims=claims(rows),
        figures=amplifier_figures(rows),
        notes=[*_notes(pairs, rows), ceilings_note(_scenes(pairs))],
        tables=[
            _table(rows, "reduction", "noise_reduction_db", "Noise reduction over the steady half in dB (! overruns)"),
            _table(
                rows,
                "harmonics",
                "harmonics_db",
                "Harmonics of a tone: 2f to 10f in the error over f in the disturbance, dB",
            ),
            _table(rows, "coherence", "coherence", "Coherence of anti-noise and disturbance over the band of a noise"),
            _table(rows, "power", "power", "Output power before the amplifier over the rated power"),
            _table(rows, "asked", "asked_power", "Power that the last weights ask for over what cancels the noise"),
        ],
        claims_heading="Findings",
    )


# ---- Runs


def _scenes(pairs: Mapping[str, Pair]) -> dict[str, Scene]:
    """Return every noise at every overdrive."""
    made: dict[str, Scene] = {}
    for path, noise in dict.fromkeys((case.path, case.noise) for case in cases(list(pairs))):
        scene = driven_case(pairs[path], noise_of(noise, DURATION_S), 0.0)
        made |= {f"{path}, {noise}, {level:g} dB": with_overdrive(scene, level) for level in OVERDRIVES_DB}
    return made


def cases(names: Sequence[str]) -> list[Case]:
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
    peaks: list[Setting] = [(mu, share * limit) for mu in step_sizes() for share in LIMIT_SHARES]
    return {name: peaks if name in PEAK_LIMITED else own for name, own in grids(algorithms).items()}


def knowing() -> list[str]:
    """Return the algorithms whose disturbance estimate can know the amplifier."""
    return [name for name in ALGORITHMS if algorithms()[name].knows_amplifier]


def saturating(scene: Scene, case: Case, overdrive_db: float, known: str) -> Scene:
    """Return the scene at an overdrive, with an amplifier that puts out sqrt(2 rated power) at most."""
    driven = with_overdrive(scene, overdrive_db)
    amplifier = AMPLIFIERS[case.amplifier](driven.amplitude_limit)
    return replace(driven, amplifier=amplifier, known_amplifier=amplifier if known == KNOWN else None)


def step_sizes() -> Sequence[float]:
    """Return the step sizes that are tried of an algorithm that limits its amplitude."""
    return algorithms()["FxLMS"].first


def runs_of_a_case() -> int:
    """Return the number of runs that `run_case` takes."""
    sizes = {name: len(own) for name, own in grids(ALGORITHMS).items()}
    sizes |= dict.fromkeys(PEAK_LIMITED, len(step_sizes()) * len(LIMIT_SHARES))
    tuned_and_run = {name: size + 1 for name, size in sizes.items()}
    return len(OVERDRIVES_DB) * (sum(tuned_and_run.values()) + sum(tuned_and_run[name] for name in knowing()))


def run_case(runs: Runs, case: Case, pair: Pair) -> tuple[list[AmplifierRow], dict[str, dict[str, Tuned | None]]]:
    """Return every algorithm at every overdrive, tuned there; those that can know the amplifier without and with it."""
    scene = driven_case(pair, noise_of(case.noise, DURATION_S), 0.0)
    rows: list[AmplifierRow] = []
    best = {}
    for overdrive in OVERDRIVES_DB:
        for known, names in ((UNKNOWN, list(ALGORITHMS)), (KNOWN, knowing())):
            driven = saturating(scene, case, overdrive, known)
            tuned = tune_all(runs, driven, settings_for(driven, names))
            best[f"{overdrive:g} dB, {known}"] = tuned
            place: dict[str, Any] = {
                "path": case.path,
                "noise": case.noise,
                "amplifier": case.amplifier,
                "known": known,
            }
            place |= {"overdrive_db": overdrive}
            jobs = [(driven, name, tuned[name], place) for name in names]
            rows += runs.map(lambda job: _run(*job), jobs)
    return rows, best


def _run(scene: Scene, algorithm: str, best: Tuned | None, place: Mapping[str, Any]) -> AmplifierRow:
    own: dict[str, Any] = {"algorithm": algorithm, "within_budget": best is not None and best.within_budget, **place}
    if best is None:
        return AmplifierRow(**own, diverged_at_s=0.0)
    own["setting"] = best.setting
    result = scene.run(make_controller(scene, algorithm, best.setting), record_weights_every=WEIGHTS_EVERY)
    if result.diverged_at_s is not None:
        return AmplifierRow(**own, diverged_at_s=result.diverged_at_s)
    e, d, y = result.error, result.disturbance, result.control_signal
    assert result.weights is not None
    largest = np.abs(result.weights).max(axis=1)
    asked = np.convolve(result.reference, result.weights[-1])[: e.size]
    tonal = place["noise"] == "tone"
    return AmplifierRow(
        **own,
        noise_reduction_db=noise_reduction_db(e, d),
        harmonics_db=harmonics_db(e, d, TONE_HZ, FS) if tonal else np.nan,
        coherence=np.nan if tonal else coherence_and_gain(d, result.anti_noise, FS, BAND_HZ).coherence,
        power=output_power(y) / scene.rated_power,
        clipped_fraction=clipped_fraction(y, scene.amplitude_limit),
        asked_power=output_power(asked) / scene.unconstrained_power,
        weight_growth=float(largest[-1] / largest[largest.size // 2]),
    )


# ---- Claims and notes


def claims(rows: Sequence[AmplifierRow]) -> list[Claim]:
    """Return the findings, each on all cases."""
    return [
        _overruns(rows, "KF-ANC"),
        _overruns(rows, "clipping FxLMS"),
        _known(rows),
        _clean(rows),
        _power(rows),
        _ordering(rows),
    ]


def _of(
    rows: Iterable[AmplifierRow], algorithm: str, *, noise: str | None = None, known: str = UNKNOWN
) -> list[AmplifierRow]:
    return [r for r in rows if r.algorithm == algorithm and r.known == known and noise in (None, r.noise)]


def _overruns(rows: Sequence[AmplifierRow], algorithm: str) -> Claim:
    driven = [row for row in _of(rows, algorithm, noise="tone") if row.overdrive_db >= 5.0]
    over = [row for row in driven if row.overruns]
    away = [row for row in driven if row.diverged_at_s is not None]
    asked = [row.asked_power for row in driven if row.diverged_at_s is None]
    growth = [row.weight_growth for row in driven if row.diverged_at_s is None]
    return Claim(
        f"A tone of 5 dB of overdrive or more makes {algorithm} overrun, with both amplifiers, if it does not know them",
        len(over) == len(driven) > 0,
        f"{len(over)} of {len(driven)} runs; their weights end up asking for {_span(asked)} times the power that cancels the "
        f"tone, and grow {_span(growth)} times over the second half; {len(away)} passed 1e6 times the rated amplitude in "
        f"{DURATION_S:g} s",
    )


def _span(values: Sequence[float]) -> str:
    return f"{np.min(values):.3g} to {np.max(values):.3g}" if values else "(none)"


def _known(rows: Sequence[AmplifierRow]) -> Claim:
    own = _of(rows, "KF-ANC", known=KNOWN)
    asked = [row.asked_power for row in own if row.diverged_at_s is None]
    over = [row for row in own if row.overruns]
    return Claim(
        "With the amplifier known to its disturbance estimate KF-ANC overruns nowhere",
        not over,
        f"{len(over)} of {len(own)} runs overrun; weights ask for {_span(asked)} times the power that cancels the noise",
    )


def _clean(rows: Sequence[AmplifierRow]) -> Claim:
    free = {_place(row): row.harmonics_db for row in _of(rows, "KF-ANC", noise="tone") if row.overdrive_db > 0.0}
    below = {
        (name, *_place(row)): _ahead(-row.harmonics_db, -free[_place(row)])
        for name in KEEPS_POWER
        for row in _of(rows, name, noise="tone")
        if row.overdrive_db > 0.0 and row.amplifier == "hard clip"
    }
    least = min(below, key=lambda key: below[key])
    return Claim(
        f"With a hard clip the harmonics of {' and '.join(KEEPS_POWER)} are {CLEANER_DB:g} dB below those of KF-ANC at every "
        "overdrive",
        below[least] >= CLEANER_DB,
        f"by {below[least]:.1f} dB at least ({', '.join(map(str, least))} dB), by {max(below.values()):.1f} dB at most",
    )


def _ahead(own: float, other: float) -> float:
    """Return how far one figure is ahead of another; NaN, of a run that diverged, is behind all."""
    if np.isnan(own):
        return -np.inf
    return np.inf if np.isnan(other) else own - other


def _place(row: AmplifierRow) -> tuple[str, str, float]:
    return row.path, row.amplifier, row.overdrive_db


def _power(rows: Sequence[AmplifierRow]) -> Claim:
    powers = {name: [row.power for row in _of(rows, name)] for name in KEEPS_POWER}
    away = any(np.isnan(own).any() for own in powers.values())
    return Claim(
        "KF-OPC and KF-PB keep their rated power to 2 % at every overdrive, although they do not know the amplifier",
        not away and all(max(own) <= 1.02 for own in powers.values()),
        "output power over the rated one: " + ", ".join(f"{name} {_span(own)}" for name, own in powers.items()),
    )


def _ordering(rows: Sequence[AmplifierRow]) -> Claim:
    free = {(_place(r), r.noise): r.noise_reduction_db for r in _of(rows, "KF-ANC")}
    leads = {
        key: _ahead(r.noise_reduction_db, free[key])
        for r in _of(rows, "KF-OPC")
        if r.overdrive_db > 0.0
        for key in [(_place(r), r.noise)]
    }
    behind: dict[str, set[float]] = {}
    for (place, noise), lead in leads.items():
        if not lead > 0.0:
            behind.setdefault(noise, set()).add(place[2])
    where = [f"{noise} at {', '.join(f'{level:g}' for level in sorted(own))} dB" for noise, own in behind.items()]
    return Claim(
        "KF-OPC reduces the noise more than KF-ANC at every overdrive",
        not behind,
        f"by {max(leads.values()):+.1f} dB at best and {min(leads.values()):+.1f} dB at worst"
        + (f"; somewhere not: {'; '.join(where)}" if where else ""),
    )


def _notes(pairs: Iterable[str], rows: Sequence[AmplifierRow]) -> list[str]:
    over = sorted({row.algorithm for row in rows if not row.within_budget and row.setting is not None})
    notes = without_measured(pairs)
    if over:
        notes.append(
            f"{', '.join(over)}: in some cases no setting tried kept the output power to 2 %; the one of lowest mean NSE is shown."
        )
    return [
        *notes,
        "Why KF-ANC overruns: its estimate d^ = e + s^*y counts on an anti-noise that the amplifier never put out, so that "
        "the estimated disturbance grows with the control signal, and the control signal with it. With s^*amp(y) "
        "instead the estimate is the disturbance itself, and the filter asks for what a linear amplifier would need: it "
        "still overdrives the amplifier, but it does not run away.",
        "The weights grow for as long as the run lasts, so the powers asked for are those of this duration.",
        "Far overdriven, a square wave of the amplifier's limit has a fundamental 4/pi as large (2.1 dB) as the sine at "
        "rated power: that is why an overrunning filter can leave less of a tone, and its harmonics with it.",
        "Harmonics near -63 dB are the sensor noise under them, 40 dB below the disturbance in all: a tone that is not "
        "clipped has none of its own.",
        "A hard clip leaves a sine at rated power as it is; a soft saturation distorts it too, so harmonics remain with every "
        "algorithm that uses its rated power.",
        "The peak-limited algorithms were tuned with the amplifier's limit and with the one at which a square wave keeps the "
        "rated power; noise at such a limit has less mean power than the rated one.",
    ]


# ---- Tables and figures


def _table(rows: Sequence[AmplifierRow], stem: str, figure: str, caption: str) -> Table:
    noise = {"harmonics": "tone", "coherence": "band noise"}.get(stem)
    cells = []
    for row in rows:
        value = cell(row, figure)
        if stem == "reduction" and row.overruns and row.diverged_at_s is None:
            value = f"{value:.4g} !"
        if noise in (None, row.noise):
            cells.append(((row.path, row.noise, row.amplifier, row.known, row.overdrive_db), row.algorithm, value))
    headings = ["paths", "noise", "amplifier", "to the estimate", "overdrive dB"]
    return by_algorithm(stem, caption, headings, ALGORITHMS, cells)


def amplifier_figures(rows: Sequence[AmplifierRow]) -> list[FigureItem]:
    """Return figures of noise reduction, distortion and output power against the overdrive."""
    items = []
    for case in dict.fromkeys((row.path, row.noise, row.amplifier) for row in rows):
        own = [row for row in rows if (row.path, row.noise, row.amplifier) == case]
        best = max((r.noise_reduction_db for r in own if r.noise_reduction_db > TOP_DB), default=0.0)
        cut = f" Off the scale at 0 dB: up to {best:.0f} dB." if best else ""
        items.append(
            FigureItem(
                " ".join(case).replace(" ", "-"),
                f"{case[0][0].upper()}{case[0][1:]}, {case[1]}, {case[2]}. Above: the disturbance estimate does not know the amplifier; "
                "below: it does, if it can. Black crosses: the filter overruns; on the axis: it diverged. "
                f"Output power is before the amplifier.{cut}",
                _figure(own, "harmonics_db" if case[1] == "tone" else "coherence"),
            )
        )
    return items


def _figure(rows: Sequence[AmplifierRow], distortion: str) -> Any:
    shown = ("noise_reduction_db", distortion, "power")
    figure, axes = new_figure((11.0, 6.4), 2, 3, sharex=True, sharey="col")
    reductions = [row.noise_reduction_db for row in rows if row.diverged_at_s is None]
    lowest, highest = min(reductions), max(reductions)
    for line, known in zip(axes, (UNKNOWN, KNOWN), strict=True):
        own = [row for row in rows if row.known == known]
        for ax, name in zip(line, shown, strict=True):
            for algorithm in dict.fromkeys(row.algorithm for row in own):
                _draw(ax, [row for row in own if row.algorithm == algorithm], name)
            ax.grid(True, alpha=0.3)
            ax.set_ylabel(f"amplifier {known}\n{LABELS[name]}" if ax is line[0] else LABELS[name])
        line[0].set_ylim(min(0.0, 1.1 * lowest), min(TOP_DB, 1.1 * highest))
        line[2].axhline(1.0, color=MARK, linewidth=1)
        line[2].set_yscale("log")
    for ax in axes[1]:
        ax.set_xlabel("Overdrive (dB)")
    legend_of(figure, [axes[0, 0]])
    return figure


def _draw(ax: Any, rows: Sequence[AmplifierRow], figure: str) -> None:
    levels = np.array([row.overdrive_db for row in rows])
    values = np.array([getattr(row, figure) for row in rows])
    ax.plot(levels, values, label=rows[0].algorithm, linewidth=1.3, markersize=4.5, **curve_style(rows[0].algorithm))
    over = np.array([row.overruns and row.diverged_at_s is None for row in rows])
    ax.plot(levels[over], values[over], "x", color="black", markersize=7, markeredgewidth=0.9)
    lost = levels[[row.diverged_at_s is not None for row in rows]]
    if lost.size:  # an empty line would have no place, which the layout cannot bear
        ax.plot(lost, np.zeros(lost.size), "x", color="black", transform=ax.get_xaxis_transform(), clip_on=False)
