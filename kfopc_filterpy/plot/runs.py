"""Figures of runs over time: convergence and output power.

These rules hold for the functions here and in `kfopc_filterpy.plot.signals`:

- `results` is one `SimulationResult`, a sequence of them, named in the legend by their `algorithm`, or a mapping of
  legend entry to result. Each algorithm has one colour, line style and marker in every figure.
- If a function says so, a mapping may hold a list of several runs (seeds) of one length under a name; powers are then
  averaged over them before any ratio or logarithm is taken.
- `channel` picks one microphone or loudspeaker of runs with several, counted from 0. Each function says what it shows
  without it; for runs with one channel it is not needed.
- `ax` is where to draw; None makes a new figure. The axes drawn into are returned; their figure is `ax.figure`.
- The part of a run after its divergence is left out; its legend entry says when it diverged.
- Signals are in the unit of the results' signals, powers are mean squares in that unit squared; times are in s,
  frequencies in Hz, levels in dB.
- Times begin when the control is switched on, as results do: with ``simulate(..., switch_on_s=2.0)``, a plant that
  changes at 5 s does so at 3 s in a figure.
- Results or settings that are not as described raise TypeError or ValueError, and the message names the argument.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .._validate import as_choice, as_positive, as_sample_count
from .._writing import made_folder, replacing
from ..metrics import nse_db, short_time_power
from .results import DISTURBANCE, RATED, Curve, Results, curves, thinned
from .style import labelled, new_axes, plain_log

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..loop.result import SimulationResult


def plot_nse(
    results: Results,
    *,
    window_s: float | None = None,
    time_axis: str = "linear",
    noise_reduction: bool = False,
    channel: int | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the normalised squared error (NSE) over time (the paper's Fig. 6 a and 7 a), or the noise reduction.

    The axis says how long the window is. Over seconds of noise, a window of 5 ms, as in the figures of merit, fills the
    figure with a solid block; over the first tenths of a second, a longer one hides how fast a controller converges.

    Parameters
    ----------
    results : SimulationResult, sequence or mapping
        Runs; squares are summed over several under a name.
    window_s : float, optional
        Sliding window in seconds. By default a fiftieth of the longest run, rounded down to 1, 2 or 5 times a power of
        ten, and at least 5 ms: 5 ms for 0.25 s, 20 ms for 2 s, 1 s for a minute. With a logarithmic axis 5 ms.
    time_axis : {"linear", "log"}, default "linear"
        "log" shows the start.
    noise_reduction : bool, default False
        Draw the noise reduction in dB, which is the NSE with the other sign: higher is better.
    channel : int, optional
        Microphone to show, from 0; by default all together, as `nse_db` takes them.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into, by default new ones.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    ValueError
        If the window is shorter than a sample.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> from kfopc_filterpy import Plant, fx_lms, simulate
    >>> from kfopc_filterpy.signals import tone
    >>> x = tone(400.0, 0.1, fs=16000)
    >>> result = simulate(fx_lms(8, [1.0], step_size=0.01), x, Plant([1.0], [0.5], fs=16000))
    >>> ax = plot_nse(result, time_axis="log")
    >>> ax.get_ylabel()
    'Normalised squared error (dB)\\nover 5 ms'
    >>> plt.close(ax.figure)
    >>> ax = plot_nse(result, noise_reduction=True)
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('Time since switch-on (s)', 'Noise reduction (dB)\\nover 5 ms')
    >>> plt.close(ax.figure)
    """
    shown = curves(results)
    scale = as_choice(time_axis, "time_axis", ("linear", "log"))
    sign, quantity = (-1.0, "Noise reduction") if noise_reduction else (1.0, "Normalised squared error")
    if window_s is None:
        longest = max(curve.run.n_samples / curve.run.fs for curve in shown)
        window_s = SHORT_WINDOW_S if scale == "log" else readable_window_s(longest)
    width = as_sample_count(window_s, shown[0].run.fs, "window_s")
    levels = []
    for curve in shown:
        e, d = (curve.stack(name, channel=channel) for name in ("error", "disturbance"))
        levels.append(sign * nse_db(e, d, curve.run.fs, window_s, runs=True))
    ax = new_axes(ax)
    for i, (curve, level) in enumerate(zip(shown, levels, strict=True)):
        # Neighbouring values share their window.
        rows = thinned(level.size, width // 4, most=8000)
        if scale == "log":
            rows = np.unique(np.geomspace(1, level.size, 2000).astype(int)) - 1
        curve.draw(ax, level, i, rows)
    ax.axhline(0.0, color=DISTURBANCE["color"], linewidth=1.0, zorder=1.5)
    _over_time(ax, shown, f"{quantity} (dB)\nover {_window_in_words(window_s)}")
    if scale == "log":
        ax.set_xscale("log")
        ax.set_xlim(left=window_s / 5)  # before the first sound has come through the paths
    return ax


SHORT_WINDOW_S = 0.005  # that of the figures of merit


def readable_window_s(duration_s: float) -> float:
    """Return a window for a figure of a run: at most fifty to a hundred and twenty-five of them side by side."""
    longest = duration_s / 50 * (1 + 1e-9)  # a window of exactly a fiftieth is not lost to rounding
    decade = 10.0 ** math.floor(math.log10(longest))
    return max(SHORT_WINDOW_S, *(step * decade for step in (1, 2, 5) if step * decade <= longest))


def plot_output_power(
    results: Results,
    *,
    rated_power: float | None = None,
    window_s: float = 0.25,
    channel: int | None = None,
    watt_per_power: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the short-time output power, the mean square of the control signal before the amplifier, over time.

    The axis says how long the window is. It is logarithmic if the highest power is more than ten times the rated
    power, or less than a tenth.

    Parameters
    ----------
    results : SimulationResult, sequence or mapping
        Runs; powers are averaged over several under a name.
    rated_power : float, optional
        Rated output power to mark, above 0; by default those of the results.
    window_s : float, default 0.25
        Sliding window in seconds; the first values look at the samples there are.
    channel : int, optional
        Loudspeaker to show, from 0; by default a curve for each.
    watt_per_power : float, optional
        Power in W of a mean square of 1, above 0: (V per unit)² / ohm. With it, powers are drawn in W.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into, by default new ones.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    ValueError
        If the window is shorter than a sample.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> from kfopc_filterpy import Plant, fx_lms, simulate
    >>> from kfopc_filterpy.signals import tone
    >>> x = tone(400.0, 0.1, fs=16000)
    >>> result = simulate(fx_lms(8, [1.0], step_size=0.01), x, Plant([1.0], [0.5], fs=16000))
    >>> ax = plot_output_power(result, rated_power=0.2, window_s=0.02)
    >>> ax.get_legend_handles_labels()[1]
    ['FxLMS', 'Rated power 0.2']
    >>> plt.close(ax.figure)
    """
    shown = curves(results)
    if rated_power is None:
        powers = [curve.run.rated_power for curve in shown if curve.run.rated_power is not None]
        rated = sorted({float(power) for each in powers for power in np.atleast_1d(each)})
    else:
        rated = [as_positive(rated_power, "rated_power")]
    scale = 1.0 if watt_per_power is None else as_positive(watt_per_power, "watt_per_power")
    unit = "" if watt_per_power is None else " W"
    rated = [scale * value for value in rated]
    short_time = [
        scale * short_time_power(curve.stack("control_signal", channel=channel), curve.run.fs, window_s, runs=True)
        for curve in shown
    ]
    ax = new_axes(ax)
    highest = 0.0
    for i, (curve, power) in enumerate(zip(shown, short_time, strict=True)):
        curve.draw(ax, power, i)
        highest = max(highest, np.max(power, initial=0.0, where=~np.isnan(power)))
    for value in rated:
        ax.axhline(value, label=f"Rated power {value:.4g}{unit}", **RATED)
    if rated and highest > 0 and not rated[-1] / 10 <= highest <= 10 * rated[-1]:
        ax.set_yscale("log")
        plain_log(ax.yaxis)
        ax.set_ylim(min(rated[0], highest) / 10, 2 * max(rated[-1], highest))
    else:
        ax.set_ylim(0, 1.08 * max([highest, *rated]) or 1.0)
    quantity = f"Output power ({unit.strip() or 'mean square'})"
    return _over_time(ax, shown, f"{quantity}\nover {_window_in_words(window_s)}")


def save_figure(figure: Figure, path_without_suffix: str | os.PathLike[str]) -> tuple[Path, Path]:
    """Write a figure as PNG and as SVG, the same bytes for the same figure, and close it.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        The figure.
    path_without_suffix : path
        Where to write, without ".png" or ".svg"; missing folders are made, existing files replaced.

    Returns
    -------
    (pathlib.Path, pathlib.Path)
        The PNG, with 160 pixels per inch, and the SVG.

    Raises
    ------
    ValueError
        If the path ends in ".png" or ".svg".

    Examples
    --------
    >>> import tempfile
    >>> from matplotlib.figure import Figure
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [path.name for path in save_figure(Figure(), folder + "/nse")]
    ['nse.png', 'nse.svg']
    """
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    path = Path(path_without_suffix)
    if path.suffix.lower() in (".png", ".svg"):
        raise ValueError(f"path_without_suffix must leave out the suffix: both files are written; got {str(path)!r}")
    made_folder(path.parent)
    png, svg = (path.with_name(path.name + suffix) for suffix in (".png", ".svg"))
    with mpl.rc_context({"svg.hashsalt": "kfopc_filterpy"}):
        with replacing(png) as file:
            figure.savefig(file, format="png", dpi=160)
        with replacing(svg) as file:
            figure.savefig(file, format="svg", metadata={"Date": None})
    plt.close(figure)
    return png, svg


def _window_in_words(window_s: float) -> str:
    return f"{window_s:g} s" if window_s >= 1 else f"{1e3 * window_s:g} ms"


def _over_time(ax: Axes, shown: list[Curve], label: str) -> Axes:
    """Label axes with a quantity over the time of whole runs, and return them."""
    ax.set_xlim(0, max(curve.run.n_samples / curve.run.fs for curve in shown))
    return labelled(ax, xlabel="Time since switch-on (s)", ylabel=label)


def plot_run(result: SimulationResult) -> Figure:
    """Return a figure of one run: its normalised squared error and its output power over time, and its spectra.

    Parameters
    ----------
    result : SimulationResult
        The run. With several microphones, errors and spectra are those of the first.

    Returns
    -------
    matplotlib.figure.Figure
        A figure with three axes.
    """
    from matplotlib.figure import Figure

    from .signals import plot_error_spectra

    figure = Figure(figsize=(8.0, 8.0), layout="constrained")
    level, power, spectra = figure.subplots(3)
    first = 0 if result.error.ndim > 1 else None
    plot_nse(result, channel=first, ax=level)
    plot_output_power(result, ax=power)
    plot_error_spectra(result, channel=first, ax=spectra)
    return figure
