"""Figures of paths and of what follows from them.

Each function draws into `ax`, or into a new figure, and returns the axes.

Examples
--------
>>> import matplotlib.pyplot as plt
>>> from kfopc_filterpy.paths.models import bandpass_path
>>> magnitude, phase = plot_bode({"P": bandpass_path(128), "S": bandpass_path(32)})
>>> magnitude.get_ylabel(), phase.get_xlabel()
('Magnitude (dB)', 'Frequency (Hz)')
>>> plt.close(magnitude.figure)
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .._validate import as_signal
from ..bounds.rated_power import required_rated_power
from ..bounds.wiener import WienerSolution
from ..paths.analysis import (
    STABILITY_BOUND_DEG,
    frequency_response,
    group_delay,
    phase_error,
    secondary_path_gain,
)
from ..paths.causality import causality_margin, energy_onset
from ..paths.identification import IdentificationResult
from ..paths.models import finite_taps, is_system, path_taps, sampling_rate
from .style import MARK, audible, decibels, frequency_axis, legend_above, level_axis, line_style, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def _named(paths: Any) -> dict[str, Any]:
    """Return paths by name, a single one under its own or a general name."""
    if isinstance(paths, Mapping):
        if not paths:
            raise ValueError("paths must name at least one path, got an empty mapping")
        return dict(paths)
    return {"path": paths}


def _grid(frequencies_hz: Any, paths: Mapping[str, Any], fs: float | None) -> np.ndarray:
    """Return the frequencies to draw: those given, or 2000 on a logarithmic scale from 20 Hz."""
    rates = {sampling_rate(path, fs, name=name) for name, path in paths.items()}
    if frequencies_hz is not None:
        return as_signal(frequencies_hz, "frequencies_hz", min_length=2)
    if len(rates) > 1:
        raise ValueError(f"frequencies_hz must be given for paths of differing sampling rates {sorted(rates)} Hz")
    nyquist = rates.pop() / 2
    return np.geomspace(min(20.0, nyquist / 400), 0.999 * nyquist, 2000)


def plot_bode(paths: Any, *, frequencies_hz: Any = None, fs: float | None = None, ax: Any = None) -> Any:
    """Magnitude and phase of paths over frequency in Hz.

    The phase is unwrapped, and each path's own delay (its energy onset, named in the phase's legend) is
    taken out, for otherwise its slope hides all else; an infinite response keeps its delay. Where a path
    lies more than 40 dB below its peak no phase is drawn.

    Parameters
    ----------
    paths : path, or mapping of str to path
        What to draw, by legend entry: ``{"P": primary, "S": secondary, "Ŝ": estimate}``. A path is a
        python-control system or an impulse response.
    frequencies_hz : array_like, optional
        Frequencies in Hz; by default 2000 from 20 Hz to fs/2.
    fs : float, optional
        Sampling rate in Hz, needed for tap arrays.
    ax : sequence of two matplotlib.axes.Axes, optional
        Axes for magnitude and phase.

    Returns
    -------
    numpy.ndarray of two matplotlib.axes.Axes
        Magnitude and phase.

    Raises
    ------
    TypeError, ValueError
        As `path_analysis.frequency_response`, or `ax` is not two axes.
    """
    named = _named(paths)
    frequencies = _grid(frequencies_hz, named, fs)
    magnitude, phase = axes = np.asarray(new_axes(ax, rows=2))
    powers = []
    for i, (label, path) in enumerate(named.items()):
        response = frequency_response(path, frequencies, fs=fs)
        powers.append(np.abs(response) ** 2)
        magnitude.plot(frequencies, decibels(powers[-1]), label=label, **line_style(i))
        delay = _onset_s(path, fs)
        angle = np.rad2deg(np.unwrap(np.angle(response * np.exp(2j * np.pi * frequencies * delay))))
        angle[~audible(response)] = np.nan
        phase.plot(frequencies, angle, label=f"{label}, less {1e3 * delay:.2f} ms", **line_style(i))
    level_axis(magnitude, powers, "Magnitude (dB)")
    phase.set_ylabel("Phase less onset delay (degrees)")
    frequency_axis(magnitude, frequencies, label=False)
    frequency_axis(phase, frequencies)
    legend_above(magnitude)
    legend_above(phase)
    return axes


def _onset_s(path: Any, fs: float | None) -> float:
    """Energy onset of a path in s; 0 for an infinite response."""
    taps = finite_taps(path) if is_system(path) else as_signal(path, "path")
    return 0.0 if taps is None else energy_onset(taps) / sampling_rate(path, fs)


def plot_impulse_responses(paths: Any, *, fs: float | None = None, ax: Axes | None = None) -> Axes:
    """Impulse responses of paths over time in ms.

    Parameters
    ----------
    paths : path, or mapping of str to path
        As `plot_bode`; finite impulse responses.
    fs : float, optional
        Sampling rate in Hz, needed for tap arrays.
    ax : matplotlib.axes.Axes, optional
        Where to draw.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    TypeError, ValueError
        As `paths.path_taps`.
    """
    ax = new_axes(ax)
    for i, (label, path) in enumerate(_named(paths).items()):
        taps, rate = path_taps(path, name=label), sampling_rate(path, fs, name=label)
        ax.plot(1e3 * np.arange(taps.size) / rate, taps, label=label, **line_style(i))
    ax.set(xlabel="Time (ms)", ylabel="Impulse response")
    ax.margins(x=0)
    ax.grid(True, alpha=0.3)
    legend_above(ax)
    return ax


def plot_group_delay(
    paths: Any, *, frequencies_hz: Any = None, fs: float | None = None, ax: Axes | None = None
) -> Axes:
    """Group delay of paths in ms over frequency in Hz, where they lie within 40 dB of their peak.

    Parameters
    ----------
    paths, frequencies_hz, fs
        As `plot_bode`.
    ax : matplotlib.axes.Axes, optional
        Where to draw.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    TypeError, ValueError
        As `path_analysis.group_delay`.
    """
    named = _named(paths)
    frequencies = _grid(frequencies_hz, named, fs)
    ax = new_axes(ax)
    for i, (label, path) in enumerate(named.items()):
        heard = audible(frequency_response(path, frequencies, fs=fs))
        delay = np.where(heard, group_delay(path, frequencies, fs=fs), np.nan)
        ax.plot(frequencies, 1e3 * delay, label=label, **line_style(i))
    ax.set_ylabel("Group delay (ms)")
    frequency_axis(ax, frequencies)
    legend_above(ax)
    return ax


def plot_causality_margin(primary: Any, secondary: Any, *, fs: float | None = None, ax: Axes | None = None) -> Axes:
    """Impulse responses of both paths with their energy onsets and the margin between them.

    Parameters
    ----------
    primary, secondary : control.TransferFunction or array_like, shape (n_taps,)
        Paths with finite impulse responses.
    fs : float, optional
        Sampling rate in Hz, needed for tap arrays.
    ax : matplotlib.axes.Axes, optional
        Where to draw.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    TypeError, ValueError
        As `path_analysis.causality_margin`.
    """
    margin = causality_margin(primary, secondary, fs=fs)
    onsets = (1e3 * margin.primary_onset_s, 1e3 * margin.secondary_onset_s)
    ax = new_axes(ax)
    for i, (label, path) in enumerate((("Primary path P", primary), ("Secondary path S", secondary))):
        taps = path_taps(path)
        ax.plot(1e3 * np.arange(taps.size) / margin.fs, taps / np.abs(taps).max(), label=label, **line_style(i))
        ax.axvline(onsets[i], color=line_style(i)["color"], linewidth=0.8)
    ax.annotate("", (onsets[0], -1.2), (onsets[1], -1.2), arrowprops={"arrowstyle": "<->", "color": MARK})
    ax.text(
        max(onsets),
        -1.2,
        f"  margin {1e3 * margin.margin_s:.2f} ms ({margin.margin_samples:.0f} samples)",
        va="center",
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
    )
    # The onsets and what follows shortly; the late reverberation does not bear on the margin.
    ax.set_xlim(0, 2 * max(*onsets, 1e3 * margin.primary_delay_s, 1e3 * margin.secondary_delay_s))
    ax.set_ylim(-1.4, 1.15)
    ax.set(xlabel="Time (ms)", ylabel="Impulse response / peak")
    ax.grid(True, alpha=0.3)
    legend_above(ax)
    return ax


def plot_secondary_path_gain(
    path: Any,
    *,
    band: tuple[float, float] | None = None,
    reference: Any = None,
    frequencies_hz: Any = None,
    fs: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Power gain of a secondary path over frequency, with G_s (eq. 11) for a band and for a reference.

    Parameters
    ----------
    path : control.TransferFunction or array_like, shape (n_taps,)
        Secondary path with a finite impulse response.
    band : (float, float), optional
        Band of white noise in Hz; from 0 to fs/2 by default.
    reference : array_like, shape (n_samples,), optional
        Reference signal to show G_s for as well.
    frequencies_hz, fs
        As `plot_bode`.
    ax : matplotlib.axes.Axes, optional
        Where to draw.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    TypeError, ValueError
        As `path_analysis.secondary_path_gain`.
    """
    frequencies = _grid(frequencies_hz, {"path": path}, fs)
    low, high = (0.0, sampling_rate(path, fs) / 2) if band is None else band
    in_band = float(decibels(secondary_path_gain(path, band=(low, high), fs=fs)))
    ax = new_axes(ax)
    power = np.abs(frequency_response(path, frequencies, fs=fs)) ** 2
    ax.plot(frequencies, decibels(power), label="$|S(f)|^2$", **line_style(0))
    ends = np.clip([low, high], frequencies[0], frequencies[-1])
    ax.plot(ends, [in_band] * 2, label=f"$G_s$, {low:g} to {high:g} Hz: {in_band:.1f} dB", **line_style(1))
    ax.axvspan(*ends, color=line_style(1)["color"], alpha=0.08, linewidth=0)
    if reference is not None:
        given = float(decibels(secondary_path_gain(path, reference=reference, fs=fs)))
        ax.axhline(given, label=f"$G_s$, reference: {given:.1f} dB", **line_style(2))
    level_axis(ax, [power], "Power gain (dB)")
    frequency_axis(ax, frequencies)
    legend_above(ax)
    return ax


def plot_phase_error(
    path: Any,
    estimates: Any,
    *,
    frequencies_hz: Any = None,
    fs: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Phase error of one or several estimates against the path, with the stability bound at ±90 degrees.

    Frequencies at which the path lies more than 40 dB below its peak are left out.

    Parameters
    ----------
    path : control.TransferFunction, control.StateSpace or array_like, shape (n_taps,)
        True secondary path.
    estimates : path, or mapping of str to path
        Its estimates, by legend entry.
    frequencies_hz, fs
        As `plot_bode`.
    ax : matplotlib.axes.Axes, optional
        Where to draw.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    TypeError, ValueError
        As `path_analysis.phase_error`.
    """
    frequencies = _grid(frequencies_hz, {"path": path}, fs)
    named = estimates if isinstance(estimates, Mapping) else {"Estimate": estimates}
    silent = ~audible(frequency_response(path, frequencies, fs=fs))
    ax = new_axes(ax)
    for i, (label, estimate) in enumerate(_named(named).items()):
        error = phase_error(path, estimate, frequencies, fs=fs).error_deg
        # Break the curve where it wraps from 180 to -180 degrees, and where the path passes nothing.
        wrapped = np.append(np.abs(np.diff(error)) > 180, False)
        ax.plot(frequencies, np.where(wrapped | silent, np.nan, error), label=label, **line_style(i))
    for sign in (-1, 1):
        bound = ax.axhline(sign * STABILITY_BOUND_DEG, color=MARK, linewidth=1, linestyle=(0, (1, 1)))
        ax.axhspan(sign * STABILITY_BOUND_DEG, sign * 180, color=MARK, alpha=0.1, linewidth=0)
    bound.set_label("Stability bound ±90°")
    ax.set_ylim(-180, 180)
    ax.set_yticks(np.arange(-180, 181, 45))
    ax.set_ylabel("Phase error (degrees)")
    frequency_axis(ax, frequencies)
    legend_above(ax)
    return ax


def plot_required_rated_power(
    solution: WienerSolution, *, rated_power: float | None = None, ax: Axes | None = None
) -> Axes:
    """Rated power that KF-OPC needs over the noise reduction wanted, up to what the Wiener filter attains.

    Parameters
    ----------
    solution : WienerSolution
        Wiener filter of the reference and disturbance at hand, made without a penalty.
    rated_power : float, optional
        A rated power to mark.
    ax : matplotlib.axes.Axes, optional
        Where to draw.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    TypeError, ValueError
        As `rated_power.required_rated_power`.
    """
    powers = {
        "disturbance_power": solution.disturbance_power,
        "antinoise_power": min(solution.antinoise_power, solution.disturbance_power),
        "control_power": solution.control_power,
    }
    limit = solution.noise_reduction_db
    shown = min(limit, 60.0)  # a noiseless tone can be cancelled to rounding
    wanted = np.linspace(0.02, 0.999, 400) * shown
    needed = required_rated_power(wanted, **powers, beyond="inf")
    ax = new_axes(ax)
    ax.semilogy(wanted, needed.rated_power, label="Wiener filter scaled by α", **line_style(0))
    ax.axvline(limit, label=f"Wiener filter unconstrained: {limit:.1f} dB", **line_style(1))
    if rated_power is not None:
        ax.axhline(rated_power, label=f"Rated power {rated_power:g}", **line_style(2))
    ax.set(xlabel="Noise reduction (dB)", ylabel="Rated power needed (mean square)")
    ax.set_xlim(0, 1.05 * shown)
    ax.grid(True, which="major", alpha=0.3)
    legend_above(ax)
    return ax


def plot_modelling_error(results: Any, *, ax: Axes | None = None) -> Axes:
    """Modelling error of one or several identifications over frequency.

    Parameters
    ----------
    results : IdentificationResult, or mapping of str to IdentificationResult
        What to draw, by legend entry.
    ax : matplotlib.axes.Axes, optional
        Where to draw.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    TypeError
        A value is not an IdentificationResult.
    """
    named = results if isinstance(results, Mapping) else {"Estimate": results}
    ax = new_axes(ax)
    for i, (label, result) in enumerate(_named(named).items()):
        if not isinstance(result, IdentificationResult):
            raise TypeError(f"results must hold IdentificationResult, got {type(result).__name__} for {label!r}")
        text = f"{label}: {result.misalignment_db:.1f} dB overall"
        ax.plot(result.frequencies_hz, result.modelling_error_db, label=text, **line_style(i))
    ax.set_ylabel("Modelling error (dB)")
    frequency_axis(ax, np.concatenate([result.frequencies_hz for result in named.values()]))
    legend_above(ax)
    return ax
