"""All algorithms on one's own recordings, tuned by the common rule, as a report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.typing import ArrayLike

from kfopc_filterpy import output_power, suggest_settings
from kfopc_filterpy._validate import as_choice, as_count, as_positive
from kfopc_filterpy.controllers.base import listed
from kfopc_filterpy.signals.quality import clipping_remarks, recording_remarks

from .._types import PathModels, ProgressBar
from .assessed_runs import recorded_scene
from .assessing import recorded_signals, switch_on_sample
from .assessment_page import run_figures, run_sounds
from .fixed_filters import longest_filter
from .limits import ChannelLimits, Ratings, limits_of, ratings_of_each, watt_per_power
from .registry import REGISTRY, algorithms
from .scene import Runs, figures_of_merit, one_blas_thread, reachable_solution, reachable_weights
from .study_report import Parameter, StudyReport, Table
from .tuning import RULE, AllDivergedError, run_setting, tune

OF_ONE_CHANNEL = ("KF-PB", "KF-OPC", "MOV-FxLMS", "FxLMS")
OF_SEVERAL_CHANNELS = ("KF-PB", "MOV-FxLMS", "FxLMS")
SCALED = (
    " The rated powers are {}. Powers are relative to the rated power, and peaks to its square root, of the loudspeaker "
    "for which they are largest."
)


@one_blas_thread()
def compare_recordings(
    noise: ArrayLike,
    primary: PathModels,
    secondary: PathModels,
    *,
    rating: Ratings,
    fs: float,
    disturbance: ArrayLike | None = None,
    names: Sequence[str] | None = None,
    n_taps: int | None = None,
    seconds: float | None = None,
    bar: ProgressBar | None = None,
) -> StudyReport:
    """Return a comparison of algorithms on recordings, each tuned by the rule of the studies.

    They are tuned and judged on the same recording, which gives every algorithm the same advantage. No algorithm has a
    limiter; the amplifier clips if the rating has a peak. With several loudspeakers, the report gives the largest ratio
    of output power to rated power of any loudspeaker, and a table with all of them.

    Parameters
    ----------
    noise, primary, secondary, rating, fs, disturbance, n_taps
        As for `assess`.
    names : sequence of str, optional
        Algorithms, see `algorithms`; by default "KF-PB", "KF-OPC", "MOV-FxLMS" and "FxLMS". With several channels, by
        default "KF-PB", "MOV-FxLMS" and "FxLMS": the filters that estimate all weights together take long.
    seconds : float, optional
        Part of the record that is used, from its start; by default all of it.
    bar : tqdm bar, optional
        Bar that advances as runs end; its total is set.

    Returns
    -------
    StudyReport
        Figures of merit, settings, figures and sounds; `results_table` prints it and `write_report` writes it.

    Raises
    ------
    TypeError, ValueError
        As for `assess`; an unknown algorithm.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.bench import compare_recordings
    >>> from kfopc_filterpy.signals import tone
    >>> x = tone(400.0, 1.0, fs=8000)
    >>> report = compare_recordings(x, np.eye(32)[20], [0, 1.0], rating=0.1, fs=8000, names=["FxLMS"], n_taps=8)
    >>> list(report.algorithms)
    ['FxLMS']
    """
    fs = as_positive(fs, "fs", unit="Hz")
    x, d, s = recorded_signals(noise, primary, secondary, disturbance, fs)
    remarks = recording_remarks(noise, fs, "noise")
    if disturbance is not None:
        remarks += clipping_remarks(disturbance, "disturbance")
    several = s.ndim == 3
    if names is None:
        names = OF_SEVERAL_CHANNELS if several else OF_ONE_CHANNEL
    if not names:
        raise ValueError("names must hold at least one algorithm, got none")
    for name in names:
        as_choice(name, "names", algorithms(several_channels=several))
    if seconds is not None:
        kept = slice(0, round(as_positive(seconds, "seconds", unit="s") * fs))
        x, d = x[..., kept], d[..., kept]
    n_loudspeakers, n_references = (s.shape[1], len(x)) if several else (1, 1)
    n_filters = n_loudspeakers * n_references
    ratings = ratings_of_each(rating, n_loudspeakers)
    limits, watts = limits_of(ratings, several), watt_per_power(ratings, several)
    start = switch_on_sample(None, fs, x.shape[-1])
    taps = None if n_taps is None else as_count(n_taps, "n_taps")
    with reachable_weights():
        settings = suggest_settings(
            x[..., start:], d[..., start:], s, fs=fs, n_taps=taps, max_taps=longest_filter(n_filters)
        )
        free = reachable_solution(x[..., start:], d[..., start:], s, settings.n_taps, fs)
    scene = recorded_scene(x, d, s, fs, start, limits, settings, free.control_power)
    if bar is not None:
        bar.total = sum(len(REGISTRY[name].grid) for name in names)
    runs, results, parameters, notes = Runs(bar), {}, {}, []
    for name in names:
        if bar is not None:
            bar.set_description(name)
        try:
            tuned = tune(runs, scene, [name])[name]
        except AllDivergedError as error:
            notes.append(f"{error}.")
            continue
        result = run_setting(scene, name, tuned.setting)
        if result is None:
            notes.append(f"{name} could not continue at its best setting.")
            continue
        results[name] = result
        parameters[f"{name} {REGISTRY[name].symbol}"] = Parameter(REGISTRY[name].value(scene, tuned.setting), RULE)
        if not tuned.within_budget and REGISTRY[name].keeps_budget:
            notes.append(f"{name} keeps the rated power at no setting tried.")
        if tuned.at_edge:
            notes.append(_edge(name, tuned.setting))
    if not results:
        raise ValueError(f"every algorithm diverged: {' '.join(notes)} Check the secondary path, and its sign")
    tables = []
    if several:
        headings = ["", *(f"loudspeaker {j + 1}" for j in range(n_loudspeakers))]
        rows = [[name, *(output_power(run.control_signal) / scene.rated_power)] for name, run in results.items()]
        caption = "Output power of each loudspeaker over its rated power, in the steady half"
        tables.append(Table("powers", caption, headings, rows))
    return StudyReport(
        "own-data",
        "Your recordings",
        f"{x.shape[-1] / fs:.3g} s of the recordings, {settings.n_taps} taps; full control would take "
        f"{listed(free.control_power / limits.rated_power, '.3g')} times the rated power."
        + _clipping(limits.amplitude_limit)
        + (SCALED.format(_powers(limits.rated_power, watts)) if several else ""),
        fs,
        1.0 if isinstance(limits, ChannelLimits) else limits.rated_power,
        {"n_taps": Parameter(settings.n_taps, settings.reasons["n_taps"]), **parameters},
        {name: figures_of_merit([result], scene) for name, result in results.items()},
        figures=list(run_figures(results, limits.rated_power, watts, start / fs)),
        sounds=list(run_sounds(results)),
        notes=[*notes, *remarks],
        tables=tables,
        watt_per_power=None if several else watts,
        extra={
            "rated_powers": limits.rated_power,
            "watt_per_power": watts,
            "amplitude_limit": limits.amplitude_limit,
            "rating_decided_by": limits.decided_by,
        },
    )


def _edge(name: str, setting: Any) -> str:
    """Return what to do about a best setting at the edge of those tried."""
    own = REGISTRY[name]
    kinds = " and ".join(filter(None, (own.kind, own.second_kind)))
    advice = "a setting beyond it may do better: try one in Python, with simulate"
    if own.symbol == "r" and setting == min(own.first):
        advice = "the noise is so steady that the filter hardly has to forget, and nothing is to be done"
    return f"{name}: the best setting, {kinds} = {listed(setting, '.3g')}, is at the edge of those tried; {advice}."


def _clipping(limit: Any) -> str:
    """Return as a sentence where the amplifier clips: a limit of the control signal, None, or one for each loudspeaker."""
    if not isinstance(limit, tuple):
        return " The amplifier does not clip." if limit is None else f" The amplifier clips beyond ±{limit:.3g}."
    if all(one is None for one in limit):
        return " The amplifiers do not clip."
    return f" The amplifiers clip beyond: {', '.join('never' if one is None else f'±{one:.3g}' for one in limit)}."


def _powers(rated_powers: Any, watts: Any) -> str:
    """Return rated powers in words, in W if that is known."""
    return listed(rated_powers, ".3g") if watts is None else f"{listed(rated_powers * watts, '.3g')} W"
