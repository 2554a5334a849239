"""Figures of paths, their identification, and the rated power they ask for.

Each function draws into `ax`, or into new axes, and returns the axes. Paths are python-control systems, which know their
sampling rate, or arrays of taps, which need `fs`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._taps import finite_taps, path_taps, sampling_rate
from .._types import PathModel
from .._validate import as_positive, as_signal
from ..bounds.rated_power import required_rated_power
from ..bounds.wiener import WienerSolution
from ..paths import analysis
from ..paths.identification import IdentificationResult
from . import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..plant import Plant


def _named(paths: Any, single: str = "path") -> dict[str, Any]:
    """Return paths, or what belongs to paths, by name; a `single` one is called so."""
    if isinstance(paths, Mapping):
        if not paths:
            raise ValueError("paths must name at least one path, got an empty mapping")
        return dict(paths)
    return {single: paths}


def _grid(frequencies_hz: Any, paths: Mapping[str, Any], fs: float | None) -> np.ndarray:
    """Return the frequencies to draw: those given, or 2000 on a logarithmic scale from 20 Hz to fs/2."""
    rates = {sampling_rate(path, fs, name=name) for name, path in paths.items()}
    if frequencies_hz is not None:
        return as_signal(frequencies_hz, "frequencies_hz", min_length=2)
    if len(rates) > 1:
        raise ValueError(f"frequencies_hz must be given for paths of differing sampling rates, {sorted(rates)} Hz")
    nyquist = rates.pop() / 2
    return np.geomspace(min(20.0, nyquist / 400), 0.999 * nyquist, 2000)


def plot_bode(
    paths: PathModel | Mapping[str, PathModel],
    *,
    frequencies_hz: ArrayLike | None = None,
    fs: float | None = None,
    ax: Sequence[Axes] | None = None,
) -> NDArray[Any]:
    """Draw the magnitude and phase of paths over frequency in Hz.

    The phase is unwrapped. The delay of each path (its energy onset, stated in the legend of the phase) is removed,
    because its slope would hide everything else; an infinite response keeps its delay. No phase is drawn at frequencies
    where a path is more than 40 dB below its peak.

    Parameters
    ----------
    paths : path, or mapping of str to path
        Paths by legend entry: ``{"P": primary, "S": secondary, "Ŝ": estimate}``. A path is a python-control system or an
        impulse response.
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
        As for `frequency_response`, or if `ax` is not two axes.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> from kfopc_filterpy import bandpass_path
    >>> primary, secondary = bandpass_path(128, fs=16000), bandpass_path(32, fs=16000)
    >>> magnitude, phase = plot_bode({"P": primary, "S": secondary})
    >>> magnitude.get_ylabel(), phase.get_xlabel()
    ('Magnitude (dB)', 'Frequency (Hz)')
    >>> plt.close(magnitude.figure)
    """
    named = _named(paths)
    frequencies = _grid(frequencies_hz, named, fs)
    magnitude, phase = axes = np.asarray(style.new_axes(ax, rows=2))
    powers = []
    for i, (label, path) in enumerate(named.items()):
        response = analysis.frequency_response(path, frequencies, fs=fs)
        powers.append(np.abs(response) ** 2)
        magnitude.plot(frequencies, style.decibels(powers[-1]), label=label, **style.line_style(i))
        taps = finite_taps(path)
        delay = 0.0 if taps is None else analysis.energy_onset(taps) / sampling_rate(path, fs)
        angle = np.rad2deg(np.unwrap(np.angle(response * np.exp(2j * np.pi * frequencies * delay))))
        angle[~style.audible(response)] = np.nan
        phase.plot(frequencies, angle, label=f"{label}, less {1e3 * delay:.2f} ms", **style.line_style(i))
    style.level_axis(magnitude, powers, "Magnitude (dB)")
    style.phase_axis(phase, "Phase less onset delay (degrees)")
    style.frequency_axis(magnitude, frequencies).set_xlabel("")
    style.frequency_axis(phase, frequencies)
    return axes


def plot_impulse_responses(
    paths: PathModel | Mapping[str, PathModel], *, fs: float | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the impulse responses of paths over time in ms.

    Parameters
    ----------
    paths : path, or mapping of str to path
        As for `plot_bode`, with finite impulse responses.
    fs : float, optional
        Sampling rate in Hz, needed for tap arrays.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into, by default new ones.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    TypeError, ValueError
        As for `path_taps`.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> from kfopc_filterpy import bandpass_path
    >>> primary, secondary = bandpass_path(128, fs=16000), bandpass_path(32, fs=16000)
    >>> ax = plot_impulse_responses({"P": primary, "S": secondary})
    >>> ax.get_xlabel(), ax.get_legend_handles_labels()[1]
    ('Time (ms)', ['P', 'S'])
    >>> plt.close(ax.figure)
    """
    ax = style.new_axes(ax)
    for i, (label, path) in enumerate(_named(paths).items()):
        taps, rate = path_taps(path, name=label), sampling_rate(path, fs, name=label)
        ax.plot(1e3 * np.arange(taps.size) / rate, taps, label=label, **style.line_style(i))
    ax.margins(x=0)
    return style.labelled(ax, xlabel="Time (ms)", ylabel="Impulse response")


def plot_group_delay(
    paths: PathModel | Mapping[str, PathModel],
    *,
    frequencies_hz: ArrayLike | None = None,
    fs: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the group delay of paths in ms over frequency in Hz, where they are within 40 dB of their peak.

    Parameters
    ----------
    paths, frequencies_hz, fs
        As for `plot_bode`.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into, by default new ones.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    TypeError, ValueError
        As for `group_delay`.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> from kfopc_filterpy import bandpass_path
    >>> primary, secondary = bandpass_path(128, fs=16000), bandpass_path(32, fs=16000)
    >>> ax = plot_group_delay({"P": primary, "S": secondary})
    >>> ax.get_ylabel()
    'Group delay (ms)'
    >>> plt.close(ax.figure)
    """
    named = _named(paths)
    frequencies = _grid(frequencies_hz, named, fs)
    ax = style.new_axes(ax)
    for i, (label, path) in enumerate(named.items()):
        heard = style.audible(analysis.frequency_response(path, frequencies, fs=fs))
        delay = np.where(heard, analysis.group_delay(path, frequencies, fs=fs), np.nan)
        ax.plot(frequencies, 1e3 * delay, label=label, **style.line_style(i))
    ax.set_ylabel("Group delay (ms)")
    return style.frequency_axis(ax, frequencies)


def plot_causality_margin(plant: Plant, *, ax: Axes | None = None) -> Axes:
    """Draw the impulse responses of both paths, with their energy onsets and the margin between them.

    With several channels, draw the margin of each microphone and loudspeaker as a table. A frame marks the pair that
    decides: the best loudspeaker of the worst microphone.

    Parameters
    ----------
    plant : Plant
        Plant with a primary path.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into, by default new ones.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    TypeError, ValueError
        As for `causality_margin`.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> from kfopc_filterpy import Plant, bandpass_path
    >>> ax = plot_causality_margin(Plant(bandpass_path(32, fs=16000), bandpass_path(128, fs=16000)))
    >>> ax.texts[-1].get_text().strip()
    'margin 2.81 ms (45 samples)'
    >>> plt.close(ax.figure)
    """
    margin = analysis.causality_margin(plant)
    ax = style.new_axes(ax)
    if np.ndim(margin.secondary_onset_s) == 2:
        _draw_margins(margin, ax)
    else:
        _draw_onsets(margin, {"Primary path P": plant.primary[0, 0], "Secondary path S": plant.secondary[0, 0]}, ax)  # type: ignore[index]
    return ax


def _draw_onsets(margin: analysis.CausalityMargin, paths: Mapping[str, Any], ax: Axes) -> None:
    """Draw a primary and a secondary path with their onsets."""
    onsets = (1e3 * margin.primary_onset_s, 1e3 * margin.secondary_onset_s)
    for i, (label, path) in enumerate(paths.items()):
        taps = path
        ax.plot(1e3 * np.arange(taps.size) / margin.fs, taps / np.abs(taps).max(), label=label, **style.line_style(i))
        ax.axvline(onsets[i], color=style.line_style(i)["color"], linewidth=0.8)
    ax.annotate("", (onsets[0], -1.2), (onsets[1], -1.2), arrowprops={"arrowstyle": "<->", "color": style.MARK})
    text = f"  margin {1e3 * margin.margin_s:.2f} ms ({margin.margin_samples:.0f} samples)"
    ax.text(max(onsets), -1.2, text, va="center", bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0})
    # The late reverberation does not affect the margin.
    ax.set_xlim(0, 2 * max(*onsets, 1e3 * margin.primary_delay_s, 1e3 * margin.secondary_delay_s))
    ax.set_ylim(-1.4, 1.15)
    style.labelled(ax, xlabel="Time (ms)", ylabel="Impulse response / peak")


def _draw_margins(margin: analysis.CausalityMargin, ax: Axes) -> None:
    """Draw the margins of all pairs as a table: blue is causal, red is not, grey is a silent path."""
    from matplotlib.patches import Rectangle

    margins = 1e3 * margin.margins_s
    heard = np.isfinite(margins)
    largest = max(float(np.abs(margins[heard]).max()), 1e-9)
    # Twice the range keeps the colours pale under the numbers.
    shown = np.ma.masked_where(~heard, margins)
    ax.imshow(shown, cmap="RdBu", vmin=-2 * largest, vmax=2 * largest, aspect="auto")
    ax.set_facecolor("0.85")  # where no sound arrives
    for (k, j), value in np.ndenumerate(margins):
        ax.text(j, k, f"{value:.2f}" if heard[k, j] else "silent", ha="center", va="center", fontsize="small")
    k, j = margin.deciding_pair
    label = f"margin of the whole: {1e3 * margin.margin_s:.2f} ms ({margin.margin_samples:.0f} samples)"
    frame: dict[str, Any] = {"fill": False, "edgecolor": "black", "linewidth": 2, "clip_on": False}
    ax.add_patch(Rectangle((j - 0.5, k - 0.5), 1, 1, **frame, label=label))
    ax.set(xlabel="Loudspeaker (margins in ms)", ylabel="Microphone")
    ax.set_xticks(range(margins.shape[1]))
    ax.set_yticks(range(margins.shape[0]))
    style.legend_above(ax)


def plot_secondary_path_gain(
    path: PathModel,
    *,
    band: tuple[float, float] | None = None,
    reference: ArrayLike | None = None,
    frequencies_hz: ArrayLike | None = None,
    fs: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the power gain of a secondary path over frequency, with G_s (eq. 11) for a band and for a reference.

    Parameters
    ----------
    path : control.TransferFunction or array_like, shape (n_taps,)
        Secondary path with a finite impulse response.
    band : (float, float), optional
        Band of white noise in Hz, by default 0 to fs/2.
    reference : array_like, shape (n_samples,), optional
        Reference signal, to show G_s for it as well.
    frequencies_hz, fs
        As for `plot_bode`.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into, by default new ones.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    TypeError, ValueError
        As for `secondary_path_gain`.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> from kfopc_filterpy import bandpass_path
    >>> ax = plot_secondary_path_gain(bandpass_path(32, fs=16000), band=(200.0, 2000.0))
    >>> ax.get_legend_handles_labels()[1][1]
    '$G_s$, 200 to 2000 Hz: -0.1 dB'
    >>> plt.close(ax.figure)
    """
    frequencies = _grid(frequencies_hz, {"path": path}, fs)
    low, high = (0.0, sampling_rate(path, fs) / 2) if band is None else band
    in_band = float(style.decibels(analysis.secondary_path_gain(path, band=(low, high), fs=fs)))
    ax = style.new_axes(ax)
    power = np.abs(analysis.frequency_response(path, frequencies, fs=fs)) ** 2
    ax.plot(frequencies, style.decibels(power), label="$|S(f)|^2$", **style.line_style(0))
    ends = np.clip([low, high], frequencies[0], frequencies[-1])
    ax.plot(ends, [in_band] * 2, label=f"$G_s$, {low:g} to {high:g} Hz: {in_band:.1f} dB", **style.line_style(1))
    if reference is not None:
        given = float(style.decibels(analysis.secondary_path_gain(path, reference=reference, fs=fs)))
        ax.axhline(given, label=f"$G_s$, reference: {given:.1f} dB", **style.line_style(2))
    if band is not None:
        ax.axvspan(*ends, color=style.line_style(1)["color"], alpha=0.08, linewidth=0, label="Band of the white noise")
    style.level_axis(ax, [power], "Power gain (dB)")
    return style.frequency_axis(ax, frequencies)


def plot_phase_error(
    path: PathModel,
    estimates: PathModel | Mapping[str, PathModel],
    *,
    frequencies_hz: ArrayLike | None = None,
    fs: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the phase error of estimates of a path, with the stability bound at ±90 degrees.

    Frequencies at which the path is more than 40 dB below its peak are left out.

    Parameters
    ----------
    path : control.TransferFunction, control.StateSpace or array_like, shape (n_taps,)
        True secondary path.
    estimates : path, or mapping of str to path
        Estimates of it, by legend entry.
    frequencies_hz, fs
        As for `plot_bode`.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into, by default new ones.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    TypeError, ValueError
        As for `phase_error`.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> from kfopc_filterpy import bandpass_path
    >>> from kfopc_filterpy.paths import perturbed_path
    >>> path = bandpass_path(32, fs=16000)
    >>> ax = plot_phase_error(path, {"one sample late": perturbed_path(path, delay_samples=1)})
    >>> ax.get_legend_handles_labels()[1]
    ['one sample late', 'Stability bound ±90°']
    >>> plt.close(ax.figure)
    """
    frequencies = _grid(frequencies_hz, {"path": path}, fs)
    silent = ~style.audible(analysis.frequency_response(path, frequencies, fs=fs))
    ax = style.new_axes(ax)
    for i, (label, estimate) in enumerate(_named(estimates, "Estimate").items()):
        error = analysis.phase_error(path, estimate, frequencies, fs=fs).error_deg
        # Break the curve where it wraps from 180 to -180 degrees, and where the path is silent.
        wrapped = np.append(np.abs(np.diff(error)) > 180, False)
        ax.plot(frequencies, np.where(wrapped | silent, np.nan, error), label=label, **style.line_style(i))
    for sign in (-1, 1):
        bound = ax.axhline(sign * analysis.STABILITY_BOUND_DEG, color=style.MARK, linewidth=1, linestyle=(0, (1, 1)))
        ax.axhspan(sign * analysis.STABILITY_BOUND_DEG, sign * 180, color=style.MARK, alpha=0.1, linewidth=0)
    bound.set_label("Stability bound ±90°")
    ax.set_ylim(-180, 180)
    style.phase_axis(ax, "Phase error (degrees)")
    return style.frequency_axis(ax, frequencies)


def plot_required_rated_power(
    solution: WienerSolution, *, rated_power: float | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the rated power that KF-OPC needs over the noise reduction, up to what the Wiener filter attains.

    Parameters
    ----------
    solution : WienerSolution
        Wiener filter of the reference and disturbance at hand, computed without a penalty. With several loudspeakers,
        the `unconstrained` one of `power_constrained_wiener`; each has a line.
    rated_power : float, optional
        A rated power to mark.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into, by default new ones.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    TypeError, ValueError
        As for `required_rated_power`.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> import numpy as np
    >>> from kfopc_filterpy import Plant
    >>> from kfopc_filterpy.bounds import wiener_solution
    >>> rng = np.random.default_rng(0)
    >>> x = rng.standard_normal(4000)
    >>> d = 0.5 * x + 0.05 * rng.standard_normal(4000)
    >>> solution = wiener_solution(x, Plant([1.0], fs=16000), n_taps=4, disturbance=d)
    >>> ax = plot_required_rated_power(solution, rated_power=0.1)
    >>> ax.get_legend_handles_labels()[1][1:]
    ['Wiener filter unconstrained: 20.0 dB', 'Rated power 0.1']
    >>> plt.close(ax.figure)
    """
    marked = None if rated_power is None else as_positive(rated_power, "rated_power")
    limit = solution.noise_reduction_db
    shown = min(limit, 60.0)  # a noiseless tone can be cancelled to rounding
    wanted = np.linspace(0.02, 0.999, 400) * shown
    known = {name: getattr(solution, name) for name in ("disturbance_power", "control_power")}
    known["antinoise_power"] = min(solution.antinoise_power, solution.disturbance_power)
    needed = required_rated_power(wanted, **known, beyond="inf")
    ax = style.new_axes(ax)
    each = needed.rated_power.reshape(wanted.size, -1).T
    for j, powers in enumerate(each):
        label = "Wiener filter scaled by α" + (f", loudspeaker {j}" if len(each) > 1 else "")
        ax.semilogy(wanted, np.where(powers > 0, powers, np.nan), label=label, **style.line_style(j))
    ax.axvline(limit, label=f"Wiener filter unconstrained: {limit:.1f} dB", **style.line_style(len(each)))
    if marked is not None:
        ax.axhline(marked, label=f"Rated power {marked:g}", **style.line_style(len(each) + 1))
    ax.set_xlim(0, 1.05 * shown)
    return style.labelled(ax, xlabel="Noise reduction (dB)", ylabel="Rated power needed (mean square)")


def plot_modelling_error(
    results: IdentificationResult | Mapping[str, IdentificationResult], *, ax: Axes | None = None
) -> Axes:
    """Draw the modelling error of one or several identifications over frequency.

    Parameters
    ----------
    results : IdentificationResult, or mapping of str to IdentificationResult
        Identifications by legend entry. One of several paths has a curve for each path.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into, by default new ones.

    Returns
    -------
    matplotlib.axes.Axes
        The axes drawn into.

    Raises
    ------
    TypeError
        If a value is not an IdentificationResult.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> from kfopc_filterpy import Plant, bandpass_path
    >>> from kfopc_filterpy.paths import identify_secondary_path
    >>> result = identify_secondary_path(
    ...     Plant(bandpass_path(32, fs=16000), sensor_noise_std=0.01), n_taps=32, duration_s=1.0, rng=1
    ... )
    >>> ax = plot_modelling_error({"32 taps": result})
    >>> ax.get_ylabel()
    'Modelling error (dB)'
    >>> plt.close(ax.figure)
    """
    named = _named(results, "Estimate")
    ax = style.new_axes(ax)
    for i, (label, result) in enumerate(named.items()):
        if not isinstance(result, IdentificationResult):
            raise TypeError(f"results must hold IdentificationResult, got {type(result).__name__} for {label!r}")
        overall = np.ravel(result.misalignment_db)
        text = f"{label}: {overall[0]:.1f} dB overall"
        if overall.size > 1:
            text = f"{label}, {overall.size} paths: {overall.min():.1f} to {overall.max():.1f} dB overall"
        errors = np.reshape(result.modelling_error_db, (overall.size, -1))
        for n, error in enumerate(errors):
            ax.plot(result.frequencies_hz, error, label=None if n else text, **style.line_style(i))
    ax.set_ylabel("Modelling error (dB)")
    return style.frequency_axis(ax, np.concatenate([result.frequencies_hz for result in named.values()]))
