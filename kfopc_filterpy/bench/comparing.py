"""All algorithms on one's own recordings, tuned by the common rule, as a report."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from kfopc_filterpy import suggest_settings
from kfopc_filterpy._validate import as_choice, as_count, as_positive
from kfopc_filterpy.bounds import wiener_solution
from kfopc_filterpy.power import output_limits

from .assessed_runs import recorded_scene
from .assessing import LONGEST, recorded_signals, switch_on_sample
from .items import FigureItem, Parameter, Sound, StudyReport
from .registry import REGISTRY, algorithms
from .scene import Runs, figures_of_merit, one_blas_thread
from .tuning import RULE, AllDivergedError, run_setting, tune


@one_blas_thread()
def compare_recordings(
    noise: Any,
    primary: Any,
    secondary: Any,
    *,
    rating: Any,
    fs: float,
    disturbance: Any = None,
    names: Sequence[str] = ("KF-PB", "KF-OPC", "MOV-FxLMS", "FxLMS"),
    n_taps: int | None = None,
    seconds: float | None = None,
    bar: Any = None,
) -> StudyReport:
    """Return a comparison of algorithms on recordings, each tuned by the rule of the studies.

    They are tuned and judged on the same recording, which gives every algorithm the same advantage. No algorithm has a
    limiter; the amplifier clips if the rating has a peak.

    Parameters
    ----------
    noise, primary, secondary, rating, fs, disturbance, n_taps
        As for `assess`.
    names : sequence of str, default ("KF-PB", "KF-OPC", "MOV-FxLMS", "FxLMS")
        Algorithms, see `algorithms`.
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
    import matplotlib.pyplot as plt

    from kfopc_filterpy.plot import plot_error_spectra, plot_nse, plot_output_power

    fs = as_positive(fs, "fs", unit="Hz")
    if not names:
        raise ValueError("names must hold at least one algorithm, got none")
    for name in names:
        as_choice(name, "names", algorithms())
    x, d, s = recorded_signals(noise, primary, secondary, disturbance, fs)
    if s.ndim > 1:
        raise ValueError(
            "noise, primary, secondary and disturbance must have one channel for a comparison: choose one. `assess` runs "
            "KF-PB, KF-OPC and FxLMS with several"
        )
    if seconds is not None:
        kept = slice(0, round(as_positive(seconds, "seconds", unit="s") * fs))
        x, d = x[kept], d[kept]
    limits = output_limits(rating)
    start = switch_on_sample(None, fs, x.size)
    taps = None if n_taps is None else as_count(n_taps, "n_taps")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", np.exceptions.RankWarning)  # about weights that no controller reaches
        settings = suggest_settings(x[start:], d[start:], s, fs=fs, n_taps=taps, max_taps=LONGEST)
        free = wiener_solution(x[start:], d[start:], s, settings.n_taps)
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
            notes.append(f"{name}: the best setting is at the edge of those tried.")
    if not results:
        raise ValueError(f"every algorithm diverged: {' '.join(notes)} Check the secondary path, and its sign")
    figures = []
    for stem, draw, caption in (
        ("nse", plot_nse, "Error power over that of the disturbance."),
        ("spectra", plot_error_spectra, "Spectra without control and of the errors, over the steady half."),
        ("power", plot_output_power, "Mean power of the control signal, and the rated power."),
    ):
        figure, ax = plt.subplots(figsize=(7, 4.5), layout="constrained")
        draw(results, ax=ax)
        figures.append(FigureItem(stem, caption, figure))
    first = next(iter(results.values()))
    settled = first.n_samples / fs / 2
    sounds = [Sound("before", "Without control", first.disturbance, "at the error microphone", settled)]
    for name, result in results.items():
        sounds.append(Sound(name.lower().translate(_FILE), name, result.error, "at the error microphone", settled))
    return StudyReport(
        "own-data",
        "Your recordings",
        f"{x.size / fs:.3g} s of the recordings, {settings.n_taps} taps; full control would take "
        f"{free.control_power / limits.rated_power:.3g} times the rated power.",
        fs,
        limits.rated_power,
        {"n_taps": Parameter(settings.n_taps, settings.reasons["n_taps"]), **parameters},
        {name: figures_of_merit([result], scene) for name, result in results.items()},
        figures=figures,
        sounds=sounds,
        notes=notes,
        extra={"amplitude_limit": limits.amplitude_limit, "rating_decided_by": limits.decided_by},
    )


_FILE = str.maketrans({" ": "-", "(": None, ")": None})
