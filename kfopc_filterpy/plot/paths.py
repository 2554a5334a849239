"""Figure of paths: python-control systems, which know their sampling rate, or arrays of taps, which need `fs`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .._taps import finite_taps, sampling_rate
from .._types import PathModel
from ..paths import analysis
from . import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LEAST_SHARE = 1e-4  # of the peak, -40 dB, of the power of a response whose phase is drawn


def plot_bode(
    paths: PathModel | Mapping[str, PathModel], *, fs: float | None = None, ax: Sequence[Axes] | None = None
) -> NDArray[Any]:
    """Draw the magnitude and phase of paths from 20 Hz to half the lowest sampling rate.

    The phase is unwrapped. The delay of each path (its energy onset, stated in the legend of the phase) is removed,
    because its slope would hide everything else; an infinite response keeps its delay. No phase is drawn at frequencies
    where a path is more than 40 dB below its peak.

    Parameters
    ----------
    paths : path, or mapping of str to path
        Paths by legend entry: ``{"P": primary, "S": secondary, "Ŝ": estimate}``. A path is a python-control system or
        an impulse response.
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
    named: dict[str, Any] = dict(paths) if isinstance(paths, Mapping) else {"path": paths}
    if not named:
        raise ValueError("paths must name at least one path, got an empty mapping")
    nyquist = min(sampling_rate(path, fs, name=name) for name, path in named.items()) / 2
    frequencies = np.geomspace(min(20.0, nyquist / 400), 0.999 * nyquist, 2000)
    magnitude, phase = axes = np.asarray(style.new_axes(ax, rows=2))
    powers = []
    for i, (label, path) in enumerate(named.items()):
        response = analysis.frequency_response(path, frequencies, fs=fs)
        powers.append(np.abs(response) ** 2)
        magnitude.plot(frequencies, style.decibels(powers[-1]), label=label, **style.line_style(i))
        taps = finite_taps(path)
        delay = 0.0 if taps is None else analysis.energy_onset(taps) / sampling_rate(path, fs)
        angle = np.rad2deg(np.unwrap(np.angle(response * np.exp(2j * np.pi * frequencies * delay))))
        angle[powers[-1] <= _LEAST_SHARE * powers[-1].max()] = np.nan  # where the phase means nothing
        phase.plot(frequencies, angle, label=f"{label}, less {1e3 * delay:.2f} ms", **style.line_style(i))
    peak_db = style.decibels(max(power.max() for power in powers))
    magnitude.set_ylim(peak_db - 60, peak_db + 5)  # the zeros beneath would take all the room
    magnitude.set_ylabel("Magnitude (dB)")
    style.phase_axis(phase, "Phase less onset delay (degrees)")
    style.frequency_axis(magnitude, frequencies).set_xlabel("")
    style.frequency_axis(phase, frequencies)
    return axes
