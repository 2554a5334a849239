"""Study: several loudspeakers and microphones, a rated power for each loudspeaker."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult, output_power
from kfopc_filterpy.plot import curve_style, plot_nse

from .. import bench
from ..bench import FigureItem, Parameter, Runs, Scene, Sound, StudyReport, Table, Tuned, algorithms
from . import multichannel_rooms as rooms
from . import report_parts as parts
from .cases import SENSOR_NOISE_DB, SWITCH_ON_S, Setting, bound_of, run_seeds
from .multichannel_claims import BOUND, EQUAL, FREE, KF_PB, QUARTER, SCALED, ChannelRow, claims, rivals
from .multichannel_rooms import MEASURED, RECORDINGS, Place, equally_rated, make_rated_scene, places
from .rows import column, figure_table, select

DURATION_S, RECORDED_S = 8.0, 20.0  # a recording lasts for twice KF-PB's averaging time
DIRECT = ("KF-ANC", "KF-OPC")  # their state consists of all weights
MOST_WEIGHTS = 256  # limit for them: a sample takes K J^2 L^2 operations
SHOWN = ("4 x 4", "band noise")  # shown over time
NSE_WINDOW_S = 0.25  # of the figure

Results = dict[str, SimulationResult]


def cases() -> list[tuple[Place, str]]:
    """Return the places that are available, each with each of its noises."""
    return [(place, noise) for place in places().values() for noise in place.noises]


def names(place: Place) -> list[str]:
    """Return the algorithms that run in a place: those of all weights only in small systems."""
    weights = place.plant.n_loudspeakers * place.n_taps
    return [name for name in algorithms(several_channels=True) if name not in DIRECT or weights <= MOST_WEIGHTS]


def coarse_grids(place: Place) -> dict[str, list[Setting]]:
    """Return the settings to try first: of grids of two settings every second value, since a finer grid follows."""
    registry = {name: algorithms()[name] for name in names(place)}
    pairs: dict[str, list[Setting]] = {
        name: [(one, two) for one in own.first[::2] for two in own.second[::2]] for name, own in registry.items()
    }
    return {name: pairs[name] or own.grid for name, own in registry.items()}


def planned_runs() -> int:
    """Return the number of runs of the grids; runs of the finer grids are not counted."""
    return sum(len(settings) for place, _ in cases() for settings in coarse_grids(place).values())


def main(runs: Runs) -> StudyReport:
    """Run the study in the places that are available."""
    rows: list[ChannelRow] = []
    tuned: dict[str, dict[str, Tuned]] = {}
    figures: list[FigureItem] = []
    sounds: list[Sound] = []
    for place, noise in cases():
        scene = make_rated_scene(place, noise, RECORDED_S if noise in RECORDINGS else DURATION_S)
        best = bench.tune(runs, scene, names(place), trials=bench.try_settings(runs, scene, coarse_grids(place)))
        finals = run_seeds(runs, scene, best, planned=False)
        results = {name: result for name, [result] in finals.items() if result is not None}
        own = place_rows(place.name, noise, scene, best, results)
        rows += own
        tuned[f"{place.name}, {noise}"] = best
        if (place.name, noise) == SHOWN:
            heard = [KF_PB, "FxLMS", *(row.algorithm for row in rivals(own)[:2])]
            figures = [_course_figure(own, {name: results[name] for name in heard})]
            off = Sound("off", "First microphone, control off", results[KF_PB].disturbance[0], group="room")
            errors = [(f"First microphone, {name}", results[name].error[0]) for name in heard]
            sounds = [off, *(Sound(f"run-{k}", *error, group="room") for k, error in enumerate(errors))]
    return parts.report_of_rows(
        rows,
        name="multichannel",
        title="Several loudspeakers, a rated power for each",
        summary=(
            "Noise reduction over all microphones and power of each loudspeaker, for every algorithm that takes several "
            "channels, each at its best setting, and for the power-constrained Wiener solution. Each rated power is "
            f"{rooms.RATED_SHARE:g} of what the loudspeaker would use without a limit; the tables also have equal ratings."
        ),
        fs=rooms.FS,
        parameters={
            "fs_hz": Parameter({name: place.plant.fs for name, place in places().items()}, "the measured room's own"),
            "n_taps": Parameter({name: place.n_taps for name, place in places().items()}, "of each control filter"),
            "duration_s": Parameter([DURATION_S, RECORDED_S], "from switch-on, of steady noises and of recordings"),
            "rated_power": Parameter(
                rooms.RATED_SHARE, "of each loudspeaker's without a limit: (R_x' + q/(N P0) I) w = r"
            ),
            "switch_on_s": Parameter(SWITCH_ON_S, "for which the noise runs before the control"),
            "sensor_noise_db": Parameter(SENSOR_NOISE_DB, "below the disturbance"),
            "room_m": Parameter(
                list(rooms.SIZE_M), f"built-in room, T60 {rooms.REVERBERATION_S:g} s by Sabine's formula"
            ),
            "tones_hz": Parameter(list(rooms.TONES_HZ), "of equal level"),
            "band_hz": Parameter([list(rooms.BAND_HZ), list(rooms.WIDE_BAND_HZ)], "built-in and measured room"),
            "tuned": Parameter(
                {where: parts.tuned_in_words(own) for where, own in tuned.items()},
                f"{Tuned.RULE}; for each setting tried: the setting, mean NSE in dB, power of each loudspeaker",
            ),
        },
        claims=claims(rows),
        figures=[_reduction_figure(rows), *figures],
        sounds=sounds,
        notes=_notes(tuned),
        tables=[
            _table("reduction", "Noise reduction over the steady half in dB, of all microphones together", rows),
            _table("power", "Largest output power of a loudspeaker over its rated power, steady half", rows, "power"),
        ],
    )


# ---- Runs


def place_rows(path: str, noise: str, scene: Scene, tuned: Mapping[str, Tuned], results: Results) -> list[ChannelRow]:
    """Return the rows of a place and noise; those with one equal rating are of the bounds and of KF-PB."""
    equal, place = equally_rated(scene), {"path": path, "noise": noise}
    repeated = bench.run_setting(equal, KF_PB, tuned[KF_PB].setting)
    rows = _bound_rows(scene, **place)
    for own, best in tuned.items():
        rows.append(channel_row(scene, results.get(own), **place, algorithm=own, setting=best.setting))
    rows += _bound_rows(equal, **place, rating=EQUAL)
    return [*rows, channel_row(equal, repeated, **place, rating=EQUAL, algorithm=KF_PB)]


def channel_row(scene: Scene, result: SimulationResult | None, **place: Any) -> ChannelRow:
    """Return the row of a run; a filter that could not continue counts as diverged at the start."""
    if result is None or result.diverged_at_s is not None:
        at = 0.0 if result is None else result.diverged_at_s
        return ChannelRow(**place, diverged_at_s=at, powers=[np.nan] * scene.rated_power.size)
    return ChannelRow(**place, noise_reduction_db=result.noise_reduction_db, **_powers(scene, result.control_signal))


def _powers(scene: Scene, control_signal: np.ndarray) -> dict[str, Any]:
    powers = output_power(control_signal) / scene.rated_power
    return {"power": float(np.max(powers)), "powers": powers.tolist()}


def _bound_rows(scene: Scene, *, noise: str, **place: Any) -> list[ChannelRow]:
    """Return the rows of the bound, of the scaled solution and of the one without a limit, over the steady half.

    The bound and the scaled solution are one filter for the whole record, or for a recording one filter per second.
    """
    recorded = noise in RECORDINGS
    solutions = {
        BOUND: "per_second" if recorded else "whole",
        SCALED: "scaled_per_second" if recorded else "scaled",
        FREE: "unconstrained",
    }
    bound = bound_of(scene, 1.0 if recorded else 2 * DURATION_S)
    reached = bound.noise_reduction_over(0.5 * bound.whole.end_s)
    rows = []
    for label, solution in solutions.items():
        signal = getattr(bound, solution).control_signal
        figures = {"noise_reduction_db": reached[solution]} | _powers(scene, signal)
        # A rating that limits is used in full over the record. Over half of it, chance makes any power look like that.
        limited = output_power(signal, steady=1.0) > 0.995 * scene.rated_power
        rows.append(ChannelRow(**place, noise=noise, algorithm=label, **figures, limited=limited.tolist()))
    return rows


# ---- Notes and tables


def _notes(tuned: Mapping[str, Mapping[str, Tuned]]) -> list[str]:
    notes = [
        f"{' and '.join(DIRECT)} run only in systems of up to {MOST_WEIGHTS} weights; in larger ones, the scaled Wiener "
        "solution stands for KF-OPC. For recordings, the bound and the scaled solution have one filter per second.",
    ]
    if MEASURED not in places():
        notes.append("The measured room was not available (KFOPC_DATA): it is left out.")
    edges = sorted({name for own in tuned.values() for name, best in own.items() if best.at_edge})
    if edges:
        notes.append(f"In at least one case, the best setting is at the edge of the grid: {', '.join(edges)}.")
    return notes


def _table(stem: str, caption: str, rows: Sequence[ChannelRow], figure: str = "noise_reduction_db") -> Table:
    """Return a table with a line for each rating and algorithm and a column for each place and noise."""
    keys = {"ratings": "rating", "algorithm": "algorithm"}
    return figure_table(stem, caption, rows, figure, keys, dict.fromkeys(row.case for row in rows), "case")


# ---- Figures


def _reduction_figure(rows: Sequence[ChannelRow]) -> FigureItem:
    """Return a figure with a panel for each place: noise reduction of each algorithm, with a mark for each noise."""
    own = select(rows, rating=QUARTER)
    shown = list(dict.fromkeys(row.path for row in own))
    order = list(dict.fromkeys(row.algorithm for row in own))[::-1]
    figure, axes = parts.new_figure((3.1 * len(shown) + 1.6, 5.4), 1, len(shown), sharey=True)
    for name, ax in zip(shown, axes[0], strict=True):
        here = [row for row in select(own, path=name) if row.noise_reduction_db > 0.0]
        for i, noise in enumerate(dict.fromkeys(row.noise for row in own)):
            style = curve_style(i) | {"linestyle": ""}
            hollow = style | {"markerfacecolor": "white", "label": "_over"}
            for kept, marks in ((True, style | {"label": noise}), (False, hollow)):
                mine = select(here, noise=noise, within_ratings=kept)
                ax.plot(column(mine, "noise_reduction_db"), [order.index(row.algorithm) for row in mine], **marks)
        ax.set_title(name, fontsize="medium")
        ax.set_xlabel("Noise reduction (dB)")
        ax.set_yticks(range(len(order)), order)
        ax.set_xlim(0.0, 1.1 * max(row.noise_reduction_db for row in here if row.within_ratings))
    parts.legend_of(figure, axes[0])
    caption = (
        "Noise reduction over the steady half, all microphones together. Hollow marks: a loudspeaker's power exceeds "
        f"{Tuned.BUDGET:g} times its rating; those beyond the axis are in the table."
    )
    return FigureItem("reduction", caption, figure)


def _course_figure(rows: Sequence[ChannelRow], results: Results) -> FigureItem:
    figure, axes = parts.new_figure((7.0, 4.0))
    plot_nse(results, window_s=NSE_WINDOW_S, ax=axes[0, 0])
    reached = {row.algorithm: row.noise_reduction_db for row in select(rows, rating=QUARTER)}
    for name, dashes in ((BOUND, "-"), (SCALED, ":")):
        axes[0, 0].axhline(-reached[name], color=parts.MARK, linestyle=dashes, linewidth=1, label=name)
    axes[0, 0].legend(fontsize="small")
    caption = (
        f"Built-in room, {', '.join(SHOWN)}: the error of all microphones over time, the bound and the scaled solution."
    )
    return FigureItem("course", caption, figure)
