"""Figures: what the curves hold, labels with units, given and new axes, refusals."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from kfopc_filterpy.paths.analysis import frequency_response
from kfopc_filterpy.paths.models import bandpass_path
from kfopc_filterpy.plot.paths import plot_bode

FS = 16000.0
P, S = bandpass_path(128, fs=FS), bandpass_path(32, fs=FS)


def _labels(ax):
    return ax.get_legend_handles_labels()[1]


def test_bode_draws_magnitude_and_phase_in_hz():
    magnitude, phase = plot_bode({"P": P, "S": S})
    magnitude.figure.canvas.draw()
    assert (magnitude.get_ylabel(), phase.get_ylabel()) == ("Magnitude (dB)", "Phase less onset delay (degrees)")
    assert (phase.get_xlabel(), phase.get_xscale()) == ("Frequency (Hz)", "log")
    assert _labels(magnitude) == ["P", "S"]
    line = magnitude.get_lines()[1]
    expected = 20 * np.log10(np.abs(frequency_response(S, line.get_xdata())))
    np.testing.assert_allclose(line.get_ydata(), expected, atol=1e-9)
    # 15.5 samples of delay less an onset of 13: a straight line of 2.5 samples where sound passes.
    f, angle = phase.get_lines()[1].get_data()
    passed = f < 4500
    np.testing.assert_allclose(angle[passed], -360 * 2.5 * f[passed] / FS, atol=1e-6)
    assert np.isnan(angle[-1])  # no phase where the path is silent
    assert _labels(phase)[1] == "S, less 0.81 ms"
    slower = plot_bode({"S": S, "of another rate": bandpass_path(8, (0, 1e3), fs=8e3)})[0]
    assert slower.get_xlim()[1] == pytest.approx(4000, rel=2e-3)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: plot_bode(S, ax=plt.subplots()[1]), ValueError, "ax must be 2 axes"),
        (lambda: plot_bode({}), ValueError, "paths must name at least one"),
        (lambda: plot_bode([1.0]), ValueError, "fs must be given if path is a tap array"),
    ],
)
def test_plots_refuse(call, error, message):
    with pytest.raises(error, match=message):
        call()
