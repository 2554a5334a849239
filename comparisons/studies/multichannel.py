"""Study: several loudspeakers and microphones, a rated power for each loudspeaker."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult, convergence_time_s, noise_reduction_db, output_power
from kfopc_filterpy.bench import (
    Claim,
    FigureItem,
    Parameter,
    Runs,
    Scene,
    Sound,
    StudyReport,
    Table,
    Tuned,
    algorithms,
    run_setting,
    try_settings,
    tune,
)
from kfopc_filterpy.plot import curve_style, plot_nse

from . import multichannel_rooms as rooms
from .cases import SENSOR_NOISE_DB, SWITCH_ON_S, Row, Setting, bound_of
from .multichannel_rooms import (
    MEASURED,
    RECORDINGS,
    SIZES,
    Place,
    equally_rated,
    level_map_db,
    make_rated_scene,
    places,
)
from .report_parts import MARK, first_second_db, legend_of, new_figure, tuned_in_words

DURATION_S, RECORDED_S = 8.0, 20.0  # a recording lasts for twice KF-PB's averaging time
BOUND, SCALED, FREE = "bound", "scaled Wiener", "no limit"
KF_PB = "KF-PB"
DIRECT = ("KF-ANC", "KF-OPC")  # their state consists of all weights
MOST_WEIGHTS = 256  # limit for them: a sample takes K J^2 L^2 operations
CONVERGENCE_WINDOW_S, CONVERGENCE_DB = 0.25, 1.0
SHOWN = ("4 x 4", "band noise")  # shown in the figures over time and in the map
EQUAL = "one equal rating"

Where = tuple[str, str]  # a place and a noise


@dataclass(frozen=True, kw_only=True)
class ChannelRow(Row):
    """One algorithm in one place; each power is that of a loudspeaker over its rated power."""

    rating: str = "a quarter each"
    powers: list[float] = field(default_factory=list)
    limited: list[bool] = field(default_factory=list)  # of the bound: whether the rating limits the loudspeaker
    within_budget: bool = True
    first_second_db: float = np.nan
    settled_s: float = np.nan


@dataclass
class Outcome:
    """All results for one place and noise."""

    place: Place
    scene: Scene
    rows: list[ChannelRow]
    tuned: dict[str, Tuned]
    results: dict[str, SimulationResult]


def names(place: Place) -> list[str]:
    """Return the algorithms that run in a place: those of all weights only in small systems."""
    weights = place.secondary.shape[1] * place.n_taps
    return [name for name in algorithms(several_channels=True) if name not in DIRECT or weights <= MOST_WEIGHTS]


def wheres() -> list[Where]:
    """Return the places and noises that are available."""
    return [(name, noise) for name, place in places().items() for noise in place.noises]


def planned_runs() -> int:
    """Return the number of runs of the grids; runs of the finer grids are not counted."""
    return sum(len(own) for name, _ in wheres() for own in coarse_grids(places()[name]).values())


def coarse_grids(place: Place) -> dict[str, list[Setting]]:
    """Return the settings to try first: of grids of two settings every second value, since a finer grid follows."""
    registry = algorithms(several_channels=True)
    return {
        name: [(one, two) for one in registry[name].first[::2] for two in registry[name].second[::2]]
        if registry[name].second
        else registry[name].grid
        for name in names(place)
    }


def main(runs: Runs) -> StudyReport | str:
    """Run the study in the places that are available."""
    if not places():
        return (
            "multichannel: left out. The built-in room needs pyroomacoustics (pip install kfopc-filterpy[rooms]), the "
            "measured room its data (KFOPC_DATA)."
        )
    outcomes = {where: _outcome(runs, *where) for where in wheres()}
    rows = [row for outcome in outcomes.values() for row in outcome.rows]
    return StudyReport(
        name="multichannel",
        title="Several loudspeakers, a rated power for each",
        summary=(
            "Noise reduction over all microphones and power of each loudspeaker, for every algorithm that takes "
            "several channels, each at its best setting, and for the power-constrained Wiener solution. Each "
            f"loudspeaker's rated power is {rooms.RATED_SHARE:g} of the power that it would use without a limit; the "
            "tables also have a case with one equal rating for all."
        ),
        fs=rooms.FS,
        rated_power=1.0,
        parameters=_parameters(outcomes),
        algorithms={},
        extra={"rows": [asdict(row) for row in rows]},
        claims=claims(rows),
        figures=_figures(outcomes, rows),
        sounds=_sounds(outcomes),
        notes=_notes(rows, outcomes),
        tables=[_reduction_table(rows), _power_table(rows), _settling_table(rows)],
        claims_heading="Aims",
    )


# ---- Runs


def _outcome(runs: Runs, name: str, noise: str) -> Outcome:
    place = places()[name]
    scene = make_rated_scene(place, noise, RECORDED_S if noise in RECORDINGS else DURATION_S)
    tuned = tune(runs, scene, names(place), trials=try_settings(runs, scene, coarse_grids(place)))
    results = dict(_final_runs(runs, scene, tuned))
    rows = _bound_rows(name, noise, scene) + [
        channel_row(name, noise, scene, results.get(own), algorithm=own, setting=best.setting)
        for own, best in tuned.items()
    ]
    rows += _equal_rows(name, noise, equally_rated(scene), tuned[KF_PB].setting)
    return Outcome(place, scene, rows, tuned, results if (name, noise) == SHOWN else {})


def _final_runs(runs: Runs, scene: Scene, tuned: dict[str, Tuned]) -> Iterable[tuple[str, SimulationResult]]:
    finals = runs.map(lambda item: run_setting(scene, item[0], item[1].setting), tuned.items(), worth=lambda item: 0)
    return [(name, result) for name, result in zip(tuned, finals, strict=True) if result is not None]


def channel_row(name: str, noise: str, scene: Scene, result: SimulationResult | None, **more: Any) -> ChannelRow:
    """Return the row of a run; a filter that could not continue counts as diverged at the start."""
    if result is None or result.diverged_at_s is not None:
        at = 0.0 if result is None else result.diverged_at_s
        return ChannelRow(path=name, noise=noise, diverged_at_s=at, within_budget=False, **more)
    powers = output_power(result.control_signal) / scene.rated_power
    return ChannelRow(
        path=name,
        noise=noise,
        noise_reduction_db=noise_reduction_db(result.error, result.disturbance),
        power=float(np.max(powers)),
        powers=powers.tolist(),
        within_budget=bool(np.all(powers <= Tuned.BUDGET)),
        first_second_db=first_second_db(result),
        settled_s=convergence_time_s(
            result.error,
            result.disturbance,
            result.fs,
            window_s=CONVERGENCE_WINDOW_S,
            tolerance_db=CONVERGENCE_DB,
        ),
        **more,
    )


def _bound_rows(name: str, noise: str, scene: Scene, **more: Any) -> list[ChannelRow]:
    """Return the rows of the bound, of the scaled solution and of the one without a limit, over the steady half.

    The bound and the scaled solution are one filter for the whole record, or for a recording one filter per second.
    """
    recorded = noise in RECORDINGS
    bound = bound_of(scene, 1.0 if recorded else 2 * DURATION_S)
    reached = bound.noise_reduction_over(0.5 * bound.whole.end_s)
    of = {
        BOUND: (bound.per_second if recorded else bound.whole, reached["per_second" if recorded else "whole"]),
        SCALED: (
            bound.scaled_per_second if recorded else bound.scaled,
            reached["scaled_per_second" if recorded else "scaled"],
        ),
        FREE: (bound.unconstrained, reached["unconstrained"]),
    }
    rows = []
    for label, (solution, reduction) in of.items():
        powers = output_power(solution.control_signal) / scene.rated_power
        figures: dict[str, Any] = {"noise_reduction_db": reduction, "power": float(np.max(powers))}
        # A rating that limits is used in full over the record. Over half of it, chance makes any power look like that.
        limited = output_power(solution.control_signal, steady=1.0) > 0.995 * scene.rated_power
        lists = {"powers": powers.tolist(), "limited": limited.tolist()}
        rows.append(ChannelRow(path=name, noise=noise, algorithm=label, **lists, **figures, **more))
    return rows


def _equal_rows(name: str, noise: str, scene: Scene, setting: Setting) -> list[ChannelRow]:
    """Return the rows of the bounds and of KF-PB in a scene with one equal rating for all loudspeakers."""
    more = {"rating": EQUAL}
    own = channel_row(name, noise, scene, run_setting(scene, KF_PB, setting), algorithm=KF_PB, **more)
    return [*_bound_rows(name, noise, scene, **more), own]


# ---- Claims and notes


def claims(rows: Sequence[ChannelRow]) -> list[Claim]:
    """Return the aims of KF-PB, and whether they are met."""
    own = {_key(row): row for row in rows if row.algorithm == KF_PB}
    bound = {_key(row): row for row in rows if row.algorithm == BOUND}
    steady = [key for key in own if key[1] not in RECORDINGS]
    recorded = [key for key in own if key[1] in RECORDINGS]
    found = [
        _power_claim("Steady noise", "0.97 to 1.02", 0.97, 1.02, own, bound, steady),
        _loss_claim("On steady noise KF-PB reaches the bound to within 0.5 dB", 0.5, own, bound, steady),
    ]
    if recorded:
        found += [
            _power_claim("Recordings", "at most 1.05", 0.0, 1.05, own, bound, recorded),
            _loss_claim(
                "On recordings KF-PB reaches the bound of each second to within 1 dB", 1.0, own, bound, recorded
            ),
        ]
    return [*found, _rivals_claim(rows)]


def _key(row: ChannelRow) -> tuple[str, str, str]:
    return row.path, row.noise, row.rating


def _power_claim(
    what: str,
    aim: str,
    least: float,
    most: float,
    own: dict[Any, ChannelRow],
    bound: dict[Any, ChannelRow],
    keys: Sequence[Any],
) -> Claim:
    """Judge the powers, above all of loudspeakers that their rating limits."""
    text = f"{what}: every loudspeaker's power is {aim} of its rating if that limits it, and never more"
    if diverged := _diverged(own, keys):
        return Claim(text, False, diverged)
    binding = [
        power for key in keys for power, limited in zip(own[key].powers, bound[key].limited, strict=True) if limited
    ]
    free = [power for key in keys for power in own[key].powers]
    kept = bool(binding) and min(binding) >= least and max(free) <= most
    return Claim(
        text,
        kept,
        f"{min(binding, default=np.nan):.3f} to {max(binding, default=np.nan):.3f} if the rating limits, "
        f"{max(free, default=np.nan):.3f} at most of all",
    )


def _diverged(own: dict[Any, ChannelRow], keys: Sequence[Any]) -> str:
    """Return where KF-PB diverged in words, "" if it never did."""
    where = [", ".join(key) for key in keys if not np.isfinite(own[key].noise_reduction_db)]
    return f"KF-PB diverged: {'; '.join(where)}" if where else ""


def _loss_claim(
    text: str, most_db: float, own: dict[Any, ChannelRow], bound: dict[Any, ChannelRow], keys: Sequence[Any]
) -> Claim:
    if diverged := _diverged(own, keys):
        return Claim(text, False, diverged)
    losses = {key: bound[key].noise_reduction_db - own[key].noise_reduction_db for key in keys}
    worst = max(losses, key=lambda key: losses[key])
    return Claim(
        text,
        losses[worst] <= most_db,
        f"{np.mean(list(losses.values())):.2f} dB below it on average, "
        f"{losses[worst]:.2f} dB at worst ({', '.join(worst)})",
    )


def _rivals_claim(rows: Sequence[ChannelRow]) -> Claim:
    """Judge KF-PB against the best other method that keeps the budget, for each place and noise with one."""
    text = "No method of another kind that keeps every rating is more than 0.3 dB better"
    own = {_key(row): row for row in rows if row.algorithm == KF_PB and row.rating != EQUAL}
    if diverged := _diverged(own, list(own)):
        return Claim(text, False, diverged)
    registry = algorithms(several_channels=True)
    ahead = {}
    for key, row in own.items():
        rivals = [other for other in rows if _key(other) == key and _is_rival(other)]
        rivals = [other for other in rivals if registry[other.algorithm].keeps_budget]
        if rivals:
            best = max(rivals, key=lambda other: other.noise_reduction_db)
            ahead[f"{row.case}: {best.algorithm}"] = row.noise_reduction_db - best.noise_reduction_db
    if not ahead:
        return Claim(text, False, "no other method keeps the ratings anywhere: nothing to compare with")
    worst, most = min(ahead, key=lambda key: ahead[key]), max(ahead.values())
    alone = f"; in {len(own) - len(ahead)} of {len(own)} cases no other keeps them" if len(ahead) < len(own) else ""
    return Claim(
        text,
        ahead[worst] >= -0.3,
        f"KF-PB is {np.mean(list(ahead.values())):+.2f} dB ahead of the best other on average, "
        f"{ahead[worst]:+.2f} dB at worst ({worst}), {most:+.2f} dB at best{alone}",
    )


def _is_rival(row: ChannelRow) -> bool:
    """Return whether a row belongs to an algorithm, other than KF-PB, that kept every rating."""
    return (
        row.algorithm in algorithms(several_channels=True)
        and row.algorithm != KF_PB
        and row.within_budget
        and np.isfinite(row.noise_reduction_db)
    )


def _notes(rows: Sequence[ChannelRow], outcomes: dict[Where, Outcome]) -> list[str]:
    notes = [
        f"{' and '.join(DIRECT)}, whose state consists of all J L weights, run only in systems of up "
        f"to {MOST_WEIGHTS} weights. In larger ones, the scaled Wiener solution stands for KF-OPC: it is what KF-OPC "
        "would reach in the steady state if its factor kept the ratings.",
        f"'{FREE}' is the Wiener solution without a limit, with a small ridge: directions of the weights in which the "
        "noise has hardly any energy are left out. The ratings are a quarter of its powers.",
    ]
    left_out = [str(size) for size in SIZES if f"{size} x {size}" not in places()]
    if left_out:
        notes.append("pyroomacoustics is not installed: the built-in rooms are left out.")
    if MEASURED not in places():
        notes.append("The measured room was not available (KFOPC_DATA): it is left out.")
    for name, own in algorithms(several_channels=True).items():
        over = [row for row in rows if row.algorithm == name and not row.within_budget and row.diverged_at_s is None]
        count = sum(row.algorithm == name for row in rows)
        if own.keeps_budget and over:
            most = max(row.power for row in over)
            notes.append(
                f"{name} exceeds {Tuned.BUDGET:g} times a rating in {len(over)} of {count} cases, and reaches "
                f"{most:.2f} times a rating."
            )
    for name in FREE_ALGORITHMS:
        gained = [row.noise_reduction_db for row in rows if row.algorithm == name]
        if gained:
            notes.append(
                f"{name} has no constraint and need not keep the ratings ({min(gained):.1f} to {max(gained):.1f} dB)."
            )
    edges = sorted({name for outcome in outcomes.values() for name, best in outcome.tuned.items() if best.at_edge})
    if edges:
        notes.append(f"In at least one case, the best setting is at the edge of the grid: {', '.join(edges)}.")
    return notes


FREE_ALGORITHMS = tuple(name for name, own in algorithms(several_channels=True).items() if not own.keeps_budget)


# ---- Tables and parameters


def _columns(rows: Sequence[ChannelRow]) -> list[tuple[str, str]]:
    return list(dict.fromkeys((row.path, row.noise) for row in rows))


def _table(stem: str, caption: str, rows: Sequence[ChannelRow], figure: str, ratings: Sequence[str]) -> Table:
    """Return a table with a row for each rating and algorithm and a column for each place and noise."""
    columns = _columns(rows)
    found = {(row.rating, row.algorithm, row.path, row.noise): row for row in rows}
    lines: list[list[str | float]] = []
    for rating, name in dict.fromkeys((row.rating, row.algorithm) for row in rows if row.rating in ratings):
        own = [found.get((rating, name, *column)) for column in columns]
        lines.append([rating, name, *("" if row is None else _cell(row, figure) for row in own)])
    return Table(stem, caption, ["ratings", "algorithm", *(", ".join(column) for column in columns)], lines)


def _cell(row: ChannelRow, figure: str) -> str | float:
    if row.diverged_at_s is not None:
        return "diverged"
    value = getattr(row, figure)
    return value if np.isfinite(value) else "–"


def _reduction_table(rows: Sequence[ChannelRow]) -> Table:
    caption = (
        "Noise reduction over the steady half in dB, all microphones together. For recordings, the bound and the "
        "scaled solution have one filter per second"
    )
    return _table("reduction", caption, rows, "noise_reduction_db", ["a quarter each", EQUAL])


def _power_table(rows: Sequence[ChannelRow]) -> Table:
    caption = "Output power in the steady half over the rated power, for the loudspeaker with the largest ratio"
    return _table("power", caption, rows, "power", ["a quarter each", EQUAL])


def _settling_table(rows: Sequence[ChannelRow]) -> Table:
    caption = (
        f"Time in s after which the NSE over {CONVERGENCE_WINDOW_S:g} s stays within {CONVERGENCE_DB:g} dB of its "
        "steady value; a dash if it never does"
    )
    ran = [row for row in rows if row.algorithm in algorithms(several_channels=True)]
    return _table("settling", caption, ran, "settled_s", ["a quarter each"])


def _parameters(outcomes: dict[Where, Outcome]) -> dict[str, Parameter]:
    registry = algorithms(several_channels=True)
    return {
        "fs_hz": Parameter({name: place.fs for name, place in places().items()}, "the measured room's own"),
        "n_taps": Parameter({name: place.n_taps for name, place in places().items()}, "of each control filter"),
        "duration_s": Parameter(DURATION_S, "from switch-on; the steady half counts"),
        "recorded_duration_s": Parameter(RECORDED_S, "the same, of the recordings"),
        "rated_power": Parameter(
            rooms.RATED_SHARE, "of the power that each loudspeaker uses without a limit: (R_x' + q/(N P0) I) w = r"
        ),
        "switch_on_s": Parameter(SWITCH_ON_S, "for which the noise runs before the control"),
        "sensor_noise_db": Parameter(SENSOR_NOISE_DB, "below the disturbance"),
        "room_m": Parameter(list(rooms.SIZE_M), f"built-in room, T60 {rooms.REVERBERATION_S:g} s by Sabine's formula"),
        "tones_hz": Parameter(list(rooms.TONES_HZ), "of equal level"),
        "band_hz": Parameter([list(rooms.BAND_HZ), list(rooms.WIDE_BAND_HZ)], "built-in and measured room"),
        "settings": Parameter(
            {name: [own.kind, own.second_kind] for name, own in registry.items()}, "meaning of the settings of each"
        ),
        "tuned": Parameter(
            {", ".join(where): tuned_in_words(outcome.tuned) for where, outcome in outcomes.items()},
            f"{Tuned.RULE}; for each setting tried: the setting, mean NSE in dB, power of each loudspeaker",
        ),
    }


# ---- Figures and sounds


def _figures(outcomes: dict[Where, Outcome], rows: Sequence[ChannelRow]) -> list[FigureItem]:
    figures = [_reduction_figure(rows)]
    if SHOWN in outcomes and outcomes[SHOWN].results:
        own = outcomes[SHOWN]
        best = _heard(own)
        figures += [_course_figure(own, best), _power_figure(own, best), _map_figure(own, best)]
    return figures


def _heard(outcome: Outcome) -> list[str]:
    """Return the algorithms in the figures over time: KF-PB, FxLMS, and the two best others that keep the ratings."""
    kept = [row for row in outcome.rows if row.rating != EQUAL and _is_rival(row)]
    constrained = [row for row in kept if row.algorithm not in FREE_ALGORITHMS]
    ranked = sorted(constrained, key=lambda row: -row.noise_reduction_db)
    return [KF_PB, "FxLMS", *(row.algorithm for row in ranked[:2])]


def _reduction_figure(rows: Sequence[ChannelRow]) -> FigureItem:
    """Return a figure with a panel for each place: noise reduction of each algorithm, with a mark for each noise."""
    own = [row for row in rows if row.rating != EQUAL]
    shown = list(dict.fromkeys(row.path for row in own))
    order = list(dict.fromkeys(row.algorithm for row in own))[::-1]
    figure, axes = new_figure((3.1 * len(shown) + 1.6, 5.4), 1, len(shown), sharey=True)
    for name, ax in zip(shown, axes[0], strict=True):
        here = [row for row in own if row.path == name]
        for i, noise in enumerate(dict.fromkeys(row.noise for row in own)):
            mine = [row for row in here if row.noise == noise and row.noise_reduction_db > 0.0]
            style = curve_style(i) | {"linestyle": "", "label": noise}
            places_of = [order.index(row.algorithm) for row in mine]
            ax.plot([row.noise_reduction_db for row in mine], places_of, **style)
            over = [(row, at) for row, at in zip(mine, places_of, strict=True) if not _within(row)]
            hollow = style | {"markerfacecolor": "white", "label": "_over"}
            ax.plot([row.noise_reduction_db for row, _ in over], [at for _, at in over], **hollow)
        ax.set_title(name, fontsize="medium")
        ax.set_xlabel("Noise reduction (dB)")
        ax.set_yticks(range(len(order)), order)
        ax.set_xlim(0.0, 1.1 * max(row.noise_reduction_db for row in here if row.algorithm == BOUND or _within(row)))
        ax.grid(True, alpha=0.3)
    legend_of(figure, axes[0])
    caption = (
        "Noise reduction over the steady half, all microphones together. Each loudspeaker is rated at a quarter of the "
        "power that it would use without a limit. Hollow marks: a loudspeaker's power exceeds "
        f"{Tuned.BUDGET:g} times its rating; those beyond the axis are in the table."
    )
    return FigureItem("reduction", caption, figure)


def _within(row: ChannelRow) -> bool:
    return row.power <= Tuned.BUDGET


def _course_figure(outcome: Outcome, shown: Sequence[str]) -> FigureItem:
    figure, axes = new_figure((7.0, 4.0))
    plot_nse({name: outcome.results[name] for name in shown}, window_s=CONVERGENCE_WINDOW_S, ax=axes[0, 0])
    for row, dashes in ((_row(outcome, BOUND), "-"), (_row(outcome, SCALED), ":")):
        axes[0, 0].axhline(-row.noise_reduction_db, color=MARK, linestyle=dashes, linewidth=1, label=row.algorithm)
    axes[0, 0].legend(fontsize="small")
    caption = (
        f"{_place_in_words()}: the error over time, over all microphones ({CONVERGENCE_WINDOW_S:g} s), with the bound "
        "within the ratings and the scaled solution."
    )
    return FigureItem("course", caption, figure)


def _row(outcome: Outcome, name: str) -> ChannelRow:
    return next(row for row in outcome.rows if row.algorithm == name)


def _place_in_words() -> str:
    return f"Built-in room, {SHOWN[0]}, {SHOWN[1]}"


def _power_figure(outcome: Outcome, shown: Sequence[str]) -> FigureItem:
    figure, axes = new_figure((7.0, 3.6))
    ax, bars = axes[0, 0], [BOUND, SCALED, *shown]
    for k, name in enumerate(bars):
        powers = np.array(_row(outcome, name).powers)
        at = np.arange(powers.size) + 0.8 * (k - (len(bars) - 1) / 2) / len(bars)
        colour = {BOUND: "black", SCALED: "0.6"}.get(name) or curve_style(name)["color"]
        ax.bar(at, powers, width=0.75 / len(bars), color=colour, label=name)
    ax.axhline(1.0, color=MARK, linewidth=1, linestyle="--")
    ax.set_xticks(range(powers.size), [str(j + 1) for j in range(powers.size)])
    ax.set(xlabel="Loudspeaker", ylabel="Output power / rated power")
    top = max(1.1, *(row.power for row in outcome.rows if row.algorithm in bars and row.algorithm != "FxLMS"))
    ax.set_ylim(0.0, 1.2 * top)  # without a constraint, FxLMS takes several times the rated power
    ax.legend(fontsize="small", frameon=False, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.2))
    ax.grid(True, alpha=0.3, axis="y")
    caption = f"{_place_in_words()}: power of each loudspeaker over its rating; FxLMS has no constraint."
    return FigureItem("powers", caption, figure)


def _map_figure(outcome: Outcome, shown: Sequence[str]) -> FigureItem:
    size = int(SHOWN[0].split()[0])
    reference = outcome.scene.settled[0]
    panels: dict[str, SimulationResult | None] = {"Without control": None}
    panels |= {name: outcome.results[name] for name in (shown[0], shown[2])}
    maps = {name: level_map_db(size, reference, result) for name, result in panels.items()}
    room = rooms.built_in_room(size)
    figure, axes = new_figure((4.1 * len(maps), 3.4), 1, len(maps), sharey=True)
    for (name, (level, (x, y))), ax in zip(maps.items(), axes[0], strict=True):
        mesh = ax.pcolormesh(x, y, level, cmap="viridis", vmin=-15.0, vmax=10.0, shading="nearest", rasterized=True)
        for points, mark in ((room.sources_m, "*"), (room.loudspeakers_m, "s"), (room.microphones_m, "o")):
            ax.plot(*points[:, :2].T, mark, color="white", markeredgecolor="black", markersize=7)
        ax.set_title(name, fontsize="medium")
        ax.set(xlabel="x (m)", aspect="equal")
    axes[0, 0].set_ylabel("y (m)")
    figure.colorbar(mesh, ax=axes[0].tolist(), label="Level (dB)", shrink=0.8)
    caption = (
        f"{_place_in_words()}: sound level over the last second in a plane {rooms.HEIGHT_M:g} m above the floor, in dB "
        "relative to the mean without control. Star: noise source; squares: loudspeakers; circles: error microphones."
    )
    return FigureItem("map", caption, figure)


def _sounds(outcomes: dict[Where, Outcome]) -> list[Sound]:
    if SHOWN not in outcomes or not outcomes[SHOWN].results:
        return []
    own = outcomes[SHOWN]
    heard = [Sound("off", "First microphone, control off", own.results[KF_PB].disturbance[0], group="room")]
    return heard + [
        Sound(f"run-{k}", f"First microphone, {name}", own.results[name].error[0], group="room")
        for k, name in enumerate(_heard(own))
    ]
