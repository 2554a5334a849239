"""The page of a verdict, with its figures and sounds; its layout is in verdict.html.jinja."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kfopc_filterpy import __version__
from kfopc_filterpy.controllers.base import listed
from kfopc_filterpy.plot import curve_style, plot_error_spectra, plot_nse, plot_output_power
from kfopc_filterpy.plot.style import new_axes, plain_log

from .._writing import write_whole
from .assessment import nominal_hz, percent
from .items import FigureItem, Sound, Table, write_files
from .page import images, players, rendered

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .assessment import Assessment, SoundLevels

TEMPLATE = Path(__file__).with_name("verdict.html.jinja")
NAME = "verdict"  # that the files beside the page begin with
LOWEST_HZ = 20.0  # of the spectra, unless the noise is lower
SWITCHED_ON = "The control is switched on {:g} s into the recording."
CHAIN = (  # what each ceiling may use, and the cause if it is too low
    ("coherence_db", "Everything that the reference explains of the disturbance", "coherence"),
    ("time_db", "A filter of {taps} taps that may look ahead, any power", "filter"),
    ("filter_db", "A filter of {taps} taps, in time, any power", "causality"),
    ("power_db", "The same, within the rated power, which is a mean: its peaks are not clipped", "amplifier"),
)


def write_assessment(verdict: Assessment, folder: str | os.PathLike[str]) -> Path:
    """Write the page, the figures, the sounds and verdict.json into a folder; return the path of the page."""
    path, volts = Path(folder), verdict.volts_per_unit
    figures, tables = list(_figures(verdict)), list(_tables(verdict))
    sounds = list(_sounds(verdict))
    write_files(path, NAME, fs=verdict.fs, figures=figures, sounds=sounds, tables=tables)
    write_whole(path / "verdict.json", verdict.json + "\n")
    origin = {
        **verdict.origin,
        "Sample rate": f"{verdict.fs:g} Hz",
        "Volts for a control signal of 1": "not known, taken as 1 V" if volts is None else f"{listed(volts, 'g')} V",
        "Version": f"kfopc_filterpy {__version__}",
        "Date": datetime.now().astimezone().isoformat(" ", "minutes"),
    }
    page = rendered(
        TEMPLATE,
        verdict=verdict,
        figures=images(path, NAME, figures),
        players=list(players(path, NAME, sounds, verdict.fs, verdict.algorithm)),
        tables=tables,
        checks=_checks(verdict),
        origin=origin,
    )
    write_whole(path / "verdict.html", page)
    return path / "verdict.html"


def _figures(verdict: Assessment) -> Iterator[FigureItem]:
    """Yield the figures: the bound, spectra, noise reduction and power over time, bands."""
    each = "the run of each algorithm at the power it took"
    if verdict.channels is not None:
        each += ", relative to its rating, of the loudspeaker that took most"
    caption = f"What a rated power buys: the least error of any fixed filter of this length, with {each}. "
    caption += "The bound knows the mean power and not the clipping, which the runs meet."
    if np.all(np.isfinite(verdict.least_rated_power)):
        caption += f" Least: the least with which {verdict.algorithm}, which adapts, reaches what is wanted."
    yield FigureItem("bound", caption, _bound(verdict).figure)
    yield from _run_figures(verdict)
    if verdict.levels is not None:
        n_microphones = len(np.atleast_2d(verdict.levels.before_db))
        figure = _one_below_another(n_microphones, "Microphone", (9, 3.6), partial(_draw_bands, verdict.levels))
        yield FigureItem("third-octaves", f"Third-octave bands without control and with {verdict.algorithm}.", figure)


def _run_figures(verdict: Assessment) -> Iterator[FigureItem]:
    """Yield figures of the error spectra, the error power and each loudspeaker's power."""
    runs, rated_power, watt_per_power = verdict.runs, verdict.limits.rated_power, verdict.watt_per_power
    begin = SWITCHED_ON.format(verdict.switch_on_s)
    together = "" if verdict.channels is None else " All microphones together."
    ax: Any = plot_error_spectra(runs, pascal_per_unit=verdict.pascal_per_unit)
    ax.set(xscale="log", xlim=(min(LOWEST_HZ, verdict.band.low_hz / 2), verdict.fs / 2))
    plain_log(ax.xaxis)
    caption = f"Spectra without control and of the errors, over the steady half.{together}"
    yield FigureItem("spectra", caption, ax.figure)
    ax = plot_nse(runs)
    caption = "Error power over that of the disturbance; below 0 dB it is quieter than without control."
    yield FigureItem("nse", f"{caption}{together} {begin}", ax.figure)

    def power(j: int, ax: Any) -> None:
        watt = None if watt_per_power is None else np.ravel(watt_per_power)[j]
        plot_output_power(runs, channel=j, rated_power=np.ravel(rated_power)[j], watt_per_power=watt, ax=ax)

    figure = _one_below_another(np.size(rated_power), "Loudspeaker", (6.4, 4), power)
    yield FigureItem("power", f"Mean power of the control signal, and the rated power. {begin}", figure)


def _one_below_another(count: int, what: str, size: tuple[float, float], draw: Callable[[int, Any], None]) -> Figure:
    """Return a figure of axes drawn one below another.

    If there are several, each label begins with `what` and a number.
    """
    import matplotlib.pyplot as plt

    height = size[1] * (1.0 if count == 1 else 0.8 * count)
    figure, axes = plt.subplots(count, squeeze=False, figsize=(size[0], height), layout="constrained")
    for i, ax in enumerate(axes[:, 0]):
        draw(i, ax)
        if count > 1:
            ax.set_ylabel(f"{what} {i + 1}\n{ax.get_ylabel()}")
    return figure


def _bound(verdict: Assessment) -> Any:
    """Return axes with the bound against the rated power, with what is wanted, the rating and the runs."""
    ax = new_axes(None)
    several = verdict.channels is not None  # then the powers are multiples of all ratings
    scale = 1.0 if several else verdict.watt_per_power or 1.0
    powers, reached = verdict.curve
    right = 2 * scale * powers.max()  # a run without a constraint may ask for a million times as much
    ax.semilogx(scale * powers, reached, color="0.2", label="best fixed filter")
    plain_log(ax.xaxis)
    rated = 1.0 if several else scale * verdict.limits.rated_power
    ax.axvline(rated, color="0.2", linestyle="--", label="rated power")
    least = rated * np.max(verdict.least_rated_power / verdict.limits.rated_power)
    if 0 < least <= right:
        ax.axvline(least, color="0.5", linestyle="-.", label=f"least for {verdict.algorithm}")
    ax.axhline(verdict.want_db, color="0.5", linestyle=":", label="wanted")
    for name, figures in verdict.figures.items():
        own = figures["noise_reduction_db"]
        power = np.max(figures["of_rated_power"]) if several else figures["output_power"]
        if power and own is not None and np.isfinite(power) and np.isfinite(own):
            style = curve_style(name)
            label = name if scale * power <= right else f"{name}, beyond: {float(f'{scale * power:.2g}'):g}"
            # The verdict's own run is filled and in front: the others often lie within its marker.
            fill, front = (style["color"], 4) if name == verdict.algorithm else ("none", 3)
            ax.plot(
                min(scale * power, right), own, style["marker"], color=style["color"], markerfacecolor=fill,
                markeredgewidth=1.5, markersize=7, label=label, zorder=front, clip_on=False,
            )  # fmt: skip
    ax.set_xlim(right=right)
    ax.set_xlabel("Power / rated power" if several else _power_label(verdict))
    ax.set_ylabel("Noise reduction (dB)")
    ax.grid(True, which="both", alpha=0.25)
    ax.legend(fontsize="small")
    return ax


def _draw_bands(levels: SoundLevels, microphone: int, ax: Any) -> None:
    """Draw a microphone's third-octave levels without and with control, from 60 dB below the loudest on."""
    centres_hz = levels.centres_hz
    before_db, after_db = (np.atleast_2d(own)[microphone] for own in (levels.before_db, levels.after_db))
    floor = max(np.max(before_db), np.max(after_db)) - 60
    places = np.arange(centres_hz.size)
    for offset, values, label, colour in (
        (-0.2, before_db, "without control", "0.6"),
        (0.2, after_db, "with control", curve_style("KF-OPC")["color"]),
    ):
        ax.bar(places + offset, np.maximum(values - floor, 0.0), 0.4, bottom=floor, label=label, color=colour)
    ax.set_xticks(places[::3], [nominal_hz(f) for f in centres_hz[::3]])
    ax.set_xlabel("Third-octave band (Hz)")
    ax.set_ylabel("Level (dB re 20 µPa)")
    ax.grid(True, axis="y", alpha=0.25)
    ax.legend(fontsize="small")


def _sounds(verdict: Assessment) -> Iterator[Sound]:
    """Yield the sounds at each microphone, without control and of each run; the verdict's own run is called "after"."""
    first = verdict.runs[verdict.algorithm]
    settled = 0.5 * first.n_samples / first.fs
    for k, disturbance in enumerate(np.atleast_2d(first.disturbance)):
        group, end = "at the error microphone", ""
        if first.disturbance.ndim > 1:
            group, end = f"at microphone {k + 1}", f"-{k + 1}"
        yield Sound(f"before{end}", "Without control", disturbance, group, settled)
        for name, run in verdict.runs.items():
            stem = "after" if name == verdict.algorithm else name.lower().replace(" ", "-")
            yield Sound(f"{stem}{end}", name, np.atleast_2d(run.error)[k], group, settled)


def _tables(verdict: Assessment) -> Any:
    """Yield the tables: what limits, the algorithms, the bands."""
    taps = verdict.settings.n_taps
    rows: list[list[str | float]] = []
    limit = "adaptation" if verdict.limited_by_run else verdict.limited_by
    for name, what, cause in CHAIN:
        value = getattr(verdict.ceilings, name)
        mark = "limits" if cause == limit else ""
        rows.append([what.format(taps=taps), "not measured" if value is None else f"{value:.1f} dB", mark])
    run = f"The run of {verdict.algorithm}"
    if verdict.unclipped_db is not None:
        rows.append([f"{run}, with an amplifier that does not clip", f"{verdict.unclipped_db:.1f} dB", ""])
    rows.append([run, f"{verdict.noise_reduction_db:.1f} dB", "limits" if limit == "adaptation" else ""])
    rows.append(["Wanted", f"{verdict.want_db:.1f} dB", ""])
    yield Table("ceilings", "What limits", ["Ceiling", "Noise reduction", ""], rows)
    yield algorithms_table(verdict)
    if (settings := settings_table(verdict)).rows:
        yield settings
    if verdict.channels is not None:
        yield Table(
            "microphones",
            "Noise reduction at each microphone (dB)",
            ["Controller", *(f"Microphone {k + 1}" for k in range(verdict.channels[2]))],
            [
                [name, *(_number(one) for one in own["noise_reduction_by_microphone_db"])]
                for name, own in verdict.figures.items()
            ],
        )
    if (levels := verdict.levels) is not None:
        headings = ["Microphone", "Centre (Hz)", "Without control (dB)", "With control (dB)", "Less by (dB)"]
        pairs = zip(np.atleast_2d(levels.before_db), np.atleast_2d(levels.after_db), strict=True)
        rows = [
            [str(k), nominal_hz(centre), float(before), float(after), float(before - after)]
            for k, (before_db, after_db) in enumerate(pairs, 1)
            for centre, before, after in zip(levels.centres_hz, before_db, after_db, strict=True)
        ]
        left_out = 1 if verdict.channels is None else 0  # one microphone needs no number
        yield Table("levels", "Third-octave bands", headings[left_out:], [row[left_out:] for row in rows])


def algorithms_table(verdict: Assessment) -> Table:
    """Return the figures of merit of each run."""
    volts = verdict.volts_per_unit
    columns = [
        ("Noise reduction (dB)", "noise_reduction_db", None),
        ("A-weighted (dB)", "noise_reduction_dba", None),
        (_power_label(verdict), "output_power", verdict.watt_per_power),
        ("Power / rated power", "of_rated_power", None),
        ("Worst window", "worst_window", None),
        ("Highest peak" if volts is None else "Highest peak (V)", "peak_control_signal", volts),
    ]
    rows: list[list[str | float]] = []
    for name, own in verdict.figures.items():
        limiter = "yes" if name == verdict.algorithm else "no"
        rows.append([name, limiter, *(_number(own[key], scale) for _, key, scale in columns)])
    headings = ["Controller", "Limiter", *(heading for heading, *_ in columns)]
    return Table("algorithms", "The controllers", headings, rows)


def settings_table(verdict: Assessment) -> Table:
    """Return the settings with which each controller ran that has any."""
    rows = [
        [name, ", ".join(f"{key}={value:.6g}" for key, value in own["settings"].items())]
        for name, own in verdict.figures.items()
        if own["settings"]
    ]
    return Table("settings", "Settings of the controllers", ["Controller", "Settings"], rows)


def _number(value: Any, scale: Any = None) -> Any:
    """Return a figure of merit, in the unit that a scale gives if there is one; NaN if it is not defined.

    Of several loudspeakers the figures become one text.
    """
    if value is None:
        return float("nan")
    own = np.asarray(value, dtype=float) * (1.0 if scale is None else scale)
    return float(own) if own.ndim == 0 else listed(own, ".4g")


def _power_label(verdict: Assessment) -> str:
    if verdict.watt_per_power is None:
        return "Power (mean square)"
    return f"Power (W into {listed(np.unique(verdict.ohm), 'g')} ohm)"


def _checks(verdict: Assessment) -> dict[str, str]:
    """Return what was checked, and what was found, in words."""
    band, limits, late = verdict.band, verdict.limits, verdict.causality_margin_s
    decided = dict.fromkeys(one.decided_by for one in limits.each)
    causality, least = "unknown without a primary path", f"Least power for {verdict.want_db:g} dB"
    if verdict.feedback:
        causality = "the error microphone hears each control signal only after the delay of the secondary path"
    elif late is not None:
        causality = f"the anti-noise is {abs(1e3 * late):.2g} ms {'early' if late >= 0 else 'late'}"
    checks = {
        "Rating": f"{verdict.power(limits.rated_power)}, decided by the {', '.join(decided)}; "
        f"{f'peaks up to {verdict.peak}' if limits.has_peaks else 'no peak limit'}; "
        f"windows of {limits.window_s:g} s",
        "Power of the best fixed filter, without a limit": verdict.power(verdict.unlimited_power),
        f"{least}, best fixed filter": _or_none(verdict, verdict.required_rated_power),
        f"{least}, {verdict.algorithm}, found by runs": _or_none(verdict, verdict.least_rated_power),
        "Causality": causality,
        "Band of the noise": f"90 % of its power from {band.low_hz:.0f} to {band.high_hz:.0f} Hz; "
        f"{percent(band.weak_share, '.1f')} where the loudspeaker is 20 dB weaker than its mean there",
    }
    if verdict.stability:
        checks["Stability"] = verdict.stability
    if verdict.levels is not None:
        before, after = (listed(one, ".1f") for one in (verdict.levels.before_dba, verdict.levels.after_dba))
        checks["A-weighted level"] = f"{before} dBA without control, {after} dBA with it"
    return checks


def _or_none(verdict: Assessment, power: Any) -> str:
    return verdict.power(power) if np.all(np.isfinite(power)) else "none would do"
