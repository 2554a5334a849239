"""Figures: what the curves hold, labels with units, given and new axes, refusals."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from kfopc_filterpy import Plant, power_constrained_wiener
from kfopc_filterpy._taps import path_taps
from kfopc_filterpy.bounds.wiener import wiener_solution
from kfopc_filterpy.paths.analysis import frequency_response
from kfopc_filterpy.paths.identification import identify_secondary_path
from kfopc_filterpy.paths.models import bandpass_path, perturbed_path
from kfopc_filterpy.plot.paths import (
    plot_bode,
    plot_causality_margin,
    plot_group_delay,
    plot_impulse_responses,
    plot_modelling_error,
    plot_phase_error,
    plot_required_rated_power,
    plot_secondary_path_gain,
)

FS = 16000.0
P, S = bandpass_path(128, fs=FS), bandpass_path(32, fs=FS)
PLANT = Plant(S, P)


def _solution():
    x = np.random.default_rng(0).standard_normal(4000)
    d = PLANT.disturbance(x) + 0.2 * np.random.default_rng(1).standard_normal(4000)
    return wiener_solution(x, PLANT, n_taps=64, disturbance=d)


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


def test_impulse_response_and_group_delay_are_in_milliseconds():
    ax = plot_impulse_responses({"S": S, "Ŝ": path_taps(S)}, fs=FS)
    assert ax.get_xlabel() == "Time (ms)"
    np.testing.assert_allclose(ax.get_lines()[0].get_data(), [np.arange(32) / 16, path_taps(S)])
    ax = plot_group_delay(S)
    assert ax.get_ylabel() == "Group delay (ms)"
    delay = ax.get_lines()[0].get_ydata()
    np.testing.assert_allclose(delay[~np.isnan(delay)], 15.5 / 16, rtol=1e-6)
    assert np.isnan(delay[-1])  # where no sound passes


@pytest.mark.parametrize(("primary", "secondary", "text"), [(P, S, "2.81 ms (45"), (S, P, "-2.81 ms (-45")])
def test_causality_margin_is_written_out(primary, secondary, text):
    ax = plot_causality_margin(Plant(secondary, primary))
    ax.figure.canvas.draw()
    assert any(text in label.get_text() for label in ax.texts)
    assert _labels(ax) == ["Primary path P", "Secondary path S"]


def test_causality_margins_of_several_channels_are_a_table():
    delays = np.array([[10, 38], [20, 24], [-1, 12]])  # -1: silent
    secondary = np.vstack([np.eye(64), np.zeros(64)])[delays]
    primary = np.eye(64)[[[30], [36], [44]]]
    ax = plot_causality_margin(Plant(secondary, primary, fs=FS))
    ax.figure.canvas.draw()
    expected = [["1.25", "-0.50"], ["1.00", "0.75"], ["silent", "2.00"]]
    written = {text.get_position(): text.get_text() for text in ax.texts}
    assert written == {(j, k): expected[k][j] for k in range(3) for j in range(2)}
    assert _labels(ax) == ["margin of the whole: 1.00 ms (16 samples)"]
    assert ax.patches[0].get_xy() == (-0.5, 0.5)  # loudspeaker 0 at microphone 1
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("Loudspeaker (margins in ms)", "Microphone")


def test_phase_error_with_both_bounds():
    ax = plot_phase_error(S, {"late": perturbed_path(S, delay_samples=2)})
    ax.figure.canvas.draw()
    curve, *bounds = ax.get_lines()
    assert sorted(line.get_ydata()[0] for line in bounds) == [-90, 90]
    assert _labels(ax) == ["late", "Stability bound ±90°"]
    f, error = curve.get_xdata(), curve.get_ydata()
    below = f < 3500  # before the error wraps
    np.testing.assert_allclose(error[below], -720 * f[below] / FS, atol=1e-6)
    assert _labels(plot_phase_error(S, S))[0] == "Estimate"


def test_required_rated_power_of_several_loudspeakers_has_a_line_for_each():
    """The last one is unplugged: it needs none, and a logarithmic axis cannot show that."""
    x = np.random.default_rng(0).standard_normal((1, 3000))
    paths = np.zeros((2, 3, 4))
    paths[:, :2, 1] = [[1.0, 0.3], [0.2, 0.5]]
    d = np.array([np.roll(x[0], 2), 0.5 * np.roll(x[0], 3)]) + 0.1 * np.random.default_rng(1).standard_normal((2, 3000))
    plant = Plant(paths, fs=8000)
    free = power_constrained_wiener(x, plant, n_taps=8, rated_power=100.0, disturbance=d).unconstrained
    ax = plot_required_rated_power(free, rated_power=0.5)
    ax.figure.canvas.draw()
    assert _labels(ax)[:2] == [f"Wiener filter scaled by α, loudspeaker {j}" for j in range(2)]
    assert ax.get_yscale() == "log"
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("Noise reduction (dB)", "Rated power needed (mean square)")
    for line, power in zip(ax.get_lines()[:2], free.control_power, strict=False):
        assert np.all(np.diff(line.get_ydata()) > 0)
        assert 0.8 * power < line.get_ydata()[-1] < power
    with pytest.raises(TypeError, match="rated_power must be a single number"):
        plot_required_rated_power(free, rated_power=[0.5, 0.5])


def test_modelling_error_has_a_curve_for_each_path():
    taps = path_taps(S)
    paths = np.array([[taps, 0.5 * taps, taps[::-1]], [2 * taps, -taps, taps]])
    plant = Plant(paths, fs=FS, sensor_noise_std=0.1)
    result = identify_secondary_path(plant, n_taps=32, duration_s=0.2, rng=0)
    ax = plot_modelling_error({"in turn": result})
    assert ax.get_ylabel() == "Modelling error (dB)"
    assert len(ax.get_lines()) == 6
    np.testing.assert_array_equal(ax.get_lines()[4].get_ydata(), result.modelling_error_db[1, 1])
    low, high = result.misalignment_db.min(), result.misalignment_db.max()
    assert _labels(ax) == [f"in turn, 6 paths: {low:.1f} to {high:.1f} dB overall"]
    one = identify_secondary_path(PLANT, n_taps=32, duration_s=0.2, rng=0)
    assert len(plot_modelling_error(one).get_lines()) == 1


@pytest.mark.parametrize(
    "draw",
    [
        lambda ax: plot_impulse_responses(S, ax=ax),
        lambda ax: plot_group_delay(S, ax=ax),
        lambda ax: plot_causality_margin(PLANT, ax=ax),
        lambda ax: plot_secondary_path_gain(S, ax=ax),
        lambda ax: plot_phase_error(S, S, ax=ax),
        lambda ax: plot_required_rated_power(_solution(), ax=ax),
        lambda ax: plot_modelling_error(identify_secondary_path(PLANT, n_taps=8, duration_s=0.1, rng=0), ax=ax),
    ],
)
def test_given_axes_are_used_and_returned(draw):
    ax = plt.subplots()[1]
    assert draw(ax) is ax
    assert plt.get_fignums() == [ax.figure.number]
    assert not ax.get_title()


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: plot_bode(S, ax=plt.subplots()[1]), ValueError, "ax must be 2 axes"),
        (lambda: plot_bode({}), ValueError, "paths must name at least one"),
        (lambda: plot_bode([1.0]), ValueError, "fs must be given if path is a tap array"),
        (lambda: plot_bode({"a": S, "b": bandpass_path(8, (0, 1e3), fs=8e3)}), ValueError, "differing sampl"),
        (lambda: plot_bode(S, frequencies_hz=[1.0]), ValueError, "frequencies_hz must have at least 2"),
        (lambda: plot_modelling_error({"x": S}), TypeError, "results must hold IdentificationResult"),
    ],
)
def test_plots_refuse(call, error, message):
    with pytest.raises(error, match=message):
        call()
