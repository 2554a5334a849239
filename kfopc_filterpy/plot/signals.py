"""Figures of the signals of runs: spectra and waveforms.

The conventions on results, axes, units and errors are those of `kfopc_filterpy.plot.runs`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_band, as_positive, per_channel
from ..metrics import SOUND_PRESSURE, power_spectrum_db
from .results import DISTURBANCE, RATED, Results, curves, one_channel, require_common_disturbance, span_of, span_times
from .style import labelled, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_DEPTH_DB = 120.0  # largest range of a spectrum's axis: numerical floors beneath would take all the room
_VISIBLE = 0.005  # difference of waveforms, over their peak, that a line's width does not hide


def plot_error_spectra(
    results: Results,
    *,
    band: tuple[float, float] | None = None,
    segment_s: float = 0.128,
    channel: int | None = None,
    pascal_per_unit: ArrayLike | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the power spectra of the disturbance and of each error (the paper's Fig. 5 a, 6 b, 7 b).

    Parameters
    ----------
    results : SimulationResult, sequence or mapping
        Runs with one disturbance; powers are averaged over several under a name.
    band : (float, float), optional
        Band to show in Hz, by default 0 to fs/2.
    segment_s : float, default 0.128
        As for `power_spectrum_db`, which looks at the second half.
    channel : int, optional
        Microphone to show, from 0; by default the mean power over all.
    pascal_per_unit : float or array_like, shape (K,), optional
        Sound pressure in Pa for a value of 1, of all K microphones or of each, above 0. With it, 0 dB is (20 µPa)²,
        without it the square of a value of 1.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into, by default new ones.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    ValueError
        If the disturbances differ.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> from kfopc_filterpy import Plant, fx_lms, simulate
    >>> from kfopc_filterpy.signals import tone
    >>> x = tone(400.0, 0.2, fs=16000)
    >>> result = simulate(fx_lms(8, [1.0], step_size=0.01), x, Plant([1.0], [0.5], fs=16000))
    >>> ax = plot_error_spectra(result, band=(0.0, 4000.0))
    >>> ax.get_xlabel(), ax.get_legend_handles_labels()[1]
    ('Frequency (Hz)', ['Disturbance', 'FxLMS'])
    >>> plt.close(ax.figure)
    """
    shown = curves(results)
    require_common_disturbance(shown)
    fs = shown[0].run.fs
    scale, unit = np.ones(1), "1 unit²"
    if pascal_per_unit is not None:
        pascals = per_channel(pascal_per_unit, len(np.atleast_2d(shown[0].run.error)), "microphones", "pascal_per_unit")
        scale, unit = pascals[:, np.newaxis] / SOUND_PRESSURE, "(20 µPa)²"
        scale = scale if channel is None else one_channel(scale, channel)
    low, high = as_band((0.0, fs / 2) if band is None else band, fs)
    spectra = []
    for curve, name in [(shown[0], "disturbance"), *((curve, "error") for curve in shown)]:
        signals = scale * curve.stack(name, channel)
        signals = signals.reshape(-1, signals.shape[-1])  # microphones are averaged like runs
        frequencies, level = power_spectrum_db(signals, fs, segment_s=segment_s, runs=True)
        inside = (frequencies >= low) & (frequencies <= high)
        style = {"label": "Disturbance", **DISTURBANCE} if name == "disturbance" else curve.line()
        spectra.append((frequencies[inside], level[inside], style))
    ax = new_axes(ax)
    for frequencies, level, style in spectra:
        ax.plot(frequencies, level, **style)
    levels = [level[np.isfinite(level)] for _, level, _ in spectra]
    top = np.max(np.concatenate(levels), initial=-np.inf)
    if np.isfinite(top):
        # The errors set the depth of the axis: the floor of the disturbance outside its band is of no interest.
        ax.set_ylim(max(np.min(np.concatenate(levels[1:]), initial=top) - 5, top - _DEPTH_DB), top + 5)
    ax.set_xlim(low, high)
    return labelled(ax, xlabel="Frequency (Hz)", ylabel=f"Power per Hz (dB re {unit}/Hz)")


def plot_anti_noise(
    results: Results, *, span_s: tuple[float, float], channel: int | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the waveforms of the disturbance and of each anti-noise (the paper's Fig. 5 b).

    Parameters
    ----------
    results : SimulationResult, sequence or mapping
        Runs with one disturbance, one per name.
    span_s : (float, float)
        Start and end in seconds.
    channel : int, optional
        Microphone to show, from 0; needed if there are several.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into, by default new ones.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    ValueError
        If the disturbances differ.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> from kfopc_filterpy import Plant, fx_lms, simulate
    >>> from kfopc_filterpy.signals import tone
    >>> x = tone(400.0, 0.1, fs=16000)
    >>> result = simulate(fx_lms(8, [1.0], step_size=0.01), x, Plant([1.0], [0.5], fs=16000))
    >>> ax = plot_anti_noise(result, span_s=(0.09, 0.1))
    >>> ax.get_xlabel()
    'Time (ms)'
    >>> plt.close(ax.figure)
    """
    shown = curves(results, single=True)
    require_common_disturbance(shown)
    run, part = shown[0].run, span_of(shown[0].run, span_s)
    disturbance = one_channel(run.disturbance, channel)
    waves = [one_channel(curve.run.anti_noise, channel) for curve in shown]
    ax = new_axes(ax)
    time = span_times(ax, run, part, span_s)
    ax.plot(time, disturbance[part], label="Disturbance", **DISTURBANCE)
    for curve, wave in zip(shown, waves, strict=True):
        ax.plot(time, wave[part], **curve.line())
    return labelled(ax, ylabel="Sound at the error microphone")


def plot_amplifier_output(
    results: Results,
    *,
    span_s: tuple[float, float],
    limit: float | None = None,
    channel: int | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the waveforms of the amplifier's output, and of the control signal if the amplifier changed it (Fig. 5 c).

    Parameters
    ----------
    results : SimulationResult, sequence or mapping
        Runs, one per name. The control signal is drawn where it differs by more than 0.5 % of the output's peak; beyond
        2.5 times the highest output it leaves the axes.
    span_s : (float, float)
        Start and end in seconds.
    limit : float, optional
        Amplitude limit of the amplifier, above 0, to mark.
    channel : int, optional
        Loudspeaker to show, from 0; needed if there are several.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into, by default new ones.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> from kfopc_filterpy import HardClipAmplifier, Plant, fx_lms, simulate
    >>> from kfopc_filterpy.signals import tone
    >>> x, clip = tone(400.0, 0.1, fs=16000), HardClipAmplifier(0.3)
    >>> controller = fx_lms(8, [1.0], step_size=0.01)
    >>> result = simulate(controller, x, Plant([1.0], [0.5], amplifier=clip, fs=16000))
    >>> ax = plot_amplifier_output(result, span_s=(0.09, 0.1), limit=0.3)
    >>> ax.get_legend_handles_labels()[1]
    ['FxLMS', 'FxLMS before the amplifier', 'Limit ±0.3']
    >>> plt.close(ax.figure)
    """
    shown = curves(results, single=True)
    peaks = [] if limit is None else [as_positive(limit, "limit")]
    parts = [span_of(curve.run, span_s) for curve in shown]
    signals = [
        (one_channel(curve.run.control_signal, channel)[part], one_channel(curve.run.amplifier_output, channel)[part])
        for curve, part in zip(shown, parts, strict=True)
    ]
    ax = new_axes(ax)
    before = []
    for curve, part, (y, out) in zip(shown, parts, signals, strict=True):
        time = span_times(ax, curve.run, part, span_s)
        ax.plot(time, out, **curve.line())
        if np.any(changed := np.abs(y - out) > _VISIBLE * _peak(out)):
            dashed = {"color": curve.style["color"], "linestyle": (0, (2, 1.5)), "linewidth": 0.9}
            # One more sample to each side joins the dashes to the curve.
            beside = np.convolve(changed, np.ones(3), mode="same") > 0
            ax.plot(time, np.where(beside, y, np.nan), label=f"{curve.label} before the amplifier", **dashed)
            before.append(np.nanmax(np.abs(y)))
        peaks.append(_peak(out))
    if limit is not None:
        ax.axhline(limit, label=f"Limit ±{limit:.4g}", **RATED)
        ax.axhline(-limit, **RATED)
    top = 1.1 * max([*peaks, min(max(before, default=0.0), 2.5 * max(peaks))])
    if top > 0:
        ax.set_ylim(-top, top)
    return labelled(ax, ylabel="Amplifier output")


def _peak(signal: np.ndarray) -> float:
    """Return the largest magnitude, 0 if all is NaN."""
    return float(np.max(np.abs(signal), initial=0.0, where=~np.isnan(signal)))
