"""Figures of runs: what the curves hold, labels with units, one style per algorithm, files, refusals."""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from helpers.results import multichannel_result

from kfopc_filterpy import Plant, fx_lms, kf_anc, kf_opc, mov_fx_lms, simulate
from kfopc_filterpy import plot as plotting
from kfopc_filterpy.metrics import nse_db, power_spectrum_db, short_time_power
from kfopc_filterpy.paths.models import bandpass_path
from kfopc_filterpy.plot.runs import readable_window_s
from kfopc_filterpy.power.amplifiers import HardClipAmplifier
from kfopc_filterpy.signals import band_limited_noise, scaled_to_power, tone

FS = 16000.0
S, P = bandpass_path(32, fs=FS), bandpass_path(128, fs=FS)
PLANT = Plant(S, P)
LIMIT = np.sqrt(2)
SPAN = (0.38, 0.39)


def _controllers():
    noise = {"state_noise": 1e-8, "measurement_noise": 1e-2}
    return (
        kf_anc(16, PLANT, **noise),
        kf_opc(16, PLANT, rated_power=1.0, **noise),
        fx_lms(16, PLANT, step_size=1e-3),
        mov_fx_lms(16, PLANT, step_size=1e-3, rated_power=1.0),
    )


@pytest.fixture(scope="module")
def tonal():
    """Runs of a tone of twice the rated power into a clipping amplifier, by algorithm."""
    x = scaled_to_power(tone(400.0, 0.4, fs=FS), 2.0)
    clipping = Plant(S, P, amplifier=HardClipAmplifier(LIMIT))
    return {run.algorithm: run for run in simulate(_controllers(), x, clipping, record_weights_every=16)}


@pytest.fixture(scope="module")
def noise():
    """Two seeds of a run of KF-OPC in noise."""
    signals = [band_limited_noise((200.0, 2000.0), 1.2, fs=FS, power=4.0, rng=seed) for seed in (1, 2)]
    return [simulate(_controllers()[1], x, PLANT) for x in signals]


def _diverged(run):
    blank = np.full_like(run.error, np.nan)
    return replace(run, error=blank, control_signal=blank, amplifier_output=blank, diverged_at_s=0.25)


def _labels(ax):
    ax.figure.canvas.draw()
    return ax.get_legend_handles_labels()[1]


def _line(ax, label):
    return next(line for line in ax.get_lines() if line.get_label() == label)


def require_nse(ax, label, e, d, *window_s, **options):
    """The line has the NSE at some of the samples; return which."""
    line = _line(ax, label)
    rows = np.round(line.get_xdata() * FS).astype(int) - 1
    np.testing.assert_array_equal(line.get_ydata(), nse_db(e, d, FS, *window_s, **options)[rows])
    return rows


def test_error_spectra_hold_the_disturbance_and_each_error(tonal):
    ax = plotting.plot_error_spectra(list(tonal.values()), band=(100.0, 5000.0), segment_s=0.05)
    assert _labels(ax) == ["Disturbance", *tonal]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("Frequency (Hz)", "Power per Hz (dB re 1 unit²/Hz)")
    assert ax.get_xlim() == (100.0, 5000.0)
    for name, run in tonal.items():
        f, level = power_spectrum_db(run.error, FS, segment_s=0.05)
        np.testing.assert_array_equal(_line(ax, name).get_ydata(), level[(f >= 100) & (f <= 5000)])


def test_error_spectra_of_seeds_as_sound_pressure_levels(noise):
    ax = plotting.plot_error_spectra({"KF-OPC": noise}, pascal_per_unit=0.2)
    assert ax.get_ylabel() == "Power per Hz (dB re (20 µPa)²/Hz)"
    errors = 0.2 * np.stack([run.error for run in noise]) / 20e-6
    _, level = power_spectrum_db(errors, FS, runs=True)
    np.testing.assert_allclose(_line(ax, "KF-OPC").get_ydata(), level, atol=1e-9)


def test_anti_noise_over_a_span_in_ms_or_s(tonal):
    ax = plotting.plot_anti_noise(tonal["KF-OPC"], span_s=SPAN)
    line = _line(ax, "KF-OPC")
    np.testing.assert_allclose(line.get_xdata(), 380 + np.arange(160) / 16)
    np.testing.assert_array_equal(line.get_ydata(), tonal["KF-OPC"].anti_noise[6080:6240])
    np.testing.assert_array_equal(_line(ax, "Disturbance").get_ydata(), tonal["KF-OPC"].disturbance[6080:6240])
    assert ax.get_xlabel() == "Time (ms)"
    assert ax.get_ylabel() == "Sound at the error microphone"


def test_amplifier_output_with_limit_and_the_signal_before_it(tonal):
    y = np.clip(tonal["KF-OPC"].control_signal, -1.001 * LIMIT, 1.001 * LIMIT)  # what a line's width would hide
    within = replace(tonal["KF-OPC"], control_signal=y)
    ax = plotting.plot_amplifier_output([tonal["KF-ANC"], within], span_s=SPAN, limit=LIMIT)
    assert _labels(ax) == ["KF-ANC", "KF-ANC before the amplifier", "KF-OPC", "Limit ±1.414"]
    assert sorted(line.get_ydata()[0] for line in ax.get_lines() if len(line.get_ydata()) == 2) == [-LIMIT, LIMIT]
    before, run = _line(ax, "KF-ANC before the amplifier").get_ydata(), tonal["KF-ANC"]
    shown = ~np.isnan(before)
    np.testing.assert_array_equal(before[shown], run.control_signal[6080:6240][shown])
    assert np.all(shown[np.abs(run.control_signal[6080:6240]) > LIMIT])
    assert not np.all(shown)
    assert ax.get_ylim()[1] <= 2.75 * LIMIT + 1e-9
    assert _labels(plotting.plot_amplifier_output(within, span_s=SPAN)) == ["KF-OPC"]


def test_nse_pools_seeds_and_shows_the_start(noise):
    ax = plotting.plot_nse({"KF-OPC": noise}, window_s=0.005)
    e, d = (np.stack([getattr(run, name) for run in noise]) for name in ("error", "disturbance"))
    rows = require_nse(ax, "KF-OPC", e, d, 0.005, runs=True)
    assert np.max(np.diff(rows)) <= 20  # a quarter of the window
    assert ax.get_ylabel() == "Normalised squared error (dB)\nover 5 ms"
    log = plotting.plot_nse({"KF-OPC": noise}, time_axis="log")
    log.figure.canvas.draw()
    assert log.get_xscale() == "log"
    assert _line(log, "KF-OPC").get_xdata()[0] == 1 / FS
    assert _line(log, "KF-OPC").get_xdata()[-1] == noise[0].error.size / FS
    assert log.get_ylabel().endswith("over 5 ms")


@pytest.mark.parametrize(
    ("duration_s", "window_s"), [(0.25, 0.005), (2.0, 0.02), (10.0, 0.2), (60.0, 1.0), (600.0, 10.0)]
)
def test_the_window_of_the_nse_grows_with_the_longest_run(duration_s, window_s):
    assert readable_window_s(duration_s) == pytest.approx(window_s, rel=1e-12)


def test_the_window_of_the_nse_is_said_and_its_values_are_those_of_the_run(noise):
    run, short = noise[0], multichannel_result()  # of 1.2 s and of 0.25 s
    ax = plotting.plot_nse({"short": short, "long": run})
    assert ax.get_ylabel() == "Normalised squared error (dB)\nover 20 ms"
    require_nse(ax, "long", run.error, run.disturbance, 0.02)
    assert plotting.plot_nse(run, time_axis="log").get_ylabel().endswith("over 5 ms")


def test_the_noise_reduction_is_the_nse_with_the_other_sign(noise):
    error, reduction = (plotting.plot_nse(noise[0], noise_reduction=other) for other in (False, True))
    np.testing.assert_array_equal(_line(reduction, "KF-OPC").get_ydata(), -_line(error, "KF-OPC").get_ydata())
    assert reduction.get_ylabel() == "Noise reduction (dB)\nover 20 ms"
    assert reduction.get_xlabel() == error.get_xlabel() == "Time since switch-on (s)"


def test_output_power_against_the_rated_power(noise, tonal):
    ax = plotting.plot_output_power({"KF-OPC": noise}, window_s=0.25)
    assert _labels(ax) == ["KF-OPC", "Rated power 1"]
    line = _line(ax, "KF-OPC")
    expected = np.mean([np.mean(run.control_signal[-4000:] ** 2) for run in noise])
    assert line.get_xdata()[-1] == pytest.approx(noise[0].error.size / FS, abs=1e-2)
    assert line.get_ydata()[-1] == pytest.approx(expected, rel=0.05)
    assert ax.get_yscale() == "linear"
    ax = plotting.plot_output_power(list(tonal.values()), rated_power=1e4)
    assert ax.get_yscale() == "log"
    assert ax.get_ylim()[1] == 2e4
    assert ax.get_ylabel() == "Output power (mean square)\nover 250 ms"


def test_a_divergence_is_written_in_the_legend(tonal):
    run = _diverged(tonal["FxLMS"])
    for ax in (
        plotting.plot_error_spectra([run, tonal["KF-OPC"]]),
        plotting.plot_error_spectra(run),
        plotting.plot_nse(run),
        plotting.plot_output_power(run),
        plotting.plot_amplifier_output(run, span_s=SPAN),
    ):
        assert "FxLMS (diverged at 0.25 s)" in _labels(ax)
    ax = plotting.plot_nse({"FxLMS": [run, tonal["FxLMS"]]})
    assert _labels(ax) == ["FxLMS (1 of 2 runs diverged at 0.25 s)"]


def test_files_are_the_same_for_the_same_figure_and_the_figure_is_closed(tonal, tmp_path):
    files = []
    for name in ("one", "two"):
        ax = plotting.plot_nse(tonal["KF-OPC"])
        png, svg = plotting.save_figure(ax.figure, tmp_path / "new" / f"{name}-0.5")
        assert (png.name, svg.name) == (f"{name}-0.5.png", f"{name}-0.5.svg")
        files.append((png.read_bytes(), svg.read_bytes()))
    assert files[0] == files[1]
    assert b"<dc:date>" not in files[0][1]
    assert not plt.get_fignums()
    with pytest.raises(ValueError, match="must leave out the suffix"):
        plotting.save_figure(ax.figure, tmp_path / "nse.svg")


@pytest.mark.parametrize("kind", ["one channel", "several", "several ratings", "diverged"])
def test_a_run_draws_its_error_its_power_and_its_spectra(tonal, kind):
    run = {
        "one channel": tonal["KF-OPC"],
        "several": multichannel_result(),
        "several ratings": multichannel_result(rated_power=np.array([1.0, 0.5])),
        "diverged": _diverged(tonal["FxLMS"]),
    }[kind]
    figure = run.plot()
    figure.canvas.draw()
    level, power, spectra = figure.axes
    first = (run.error[0], run.disturbance[0]) if "several" in kind else (run.error, run.disturbance)
    require_nse(level, next(label for label in _labels(level) if label.startswith(run.algorithm)), *first)
    assert [ax.get_xlabel() for ax in figure.axes] == [*2 * ["Time since switch-on (s)"], "Frequency (Hz)"]
    ratings = [label for label in _labels(power) if label.startswith("Rated")]
    assert ratings == {"several ratings": ["Rated power 0.5", "Rated power 1"], "diverged": []}.get(
        kind, ["Rated power 1"]
    )
    assert "Disturbance" in _labels(spectra)
    assert not plt.get_fignums()  # nothing is left open in pyplot


# ---- several channels


def test_nse_of_several_microphones_is_of_all_or_of_one():
    run = multichannel_result()
    together, one = plotting.plot_nse(run), plotting.plot_nse(run, channel=1)
    require_nse(together, "KF-OPC", run.error, run.disturbance)
    require_nse(one, "KF-OPC", run.error[1], run.disturbance[1])
    pooled = plotting.plot_nse({"KF-OPC": [run, multichannel_result(seed=1)]}, channel=2)
    assert _labels(pooled) == ["KF-OPC"]


def test_spectra_of_several_microphones_are_averaged_or_of_one():
    run, scale = multichannel_result(), [0.1, 0.2, 0.4]
    powers = np.array([10 ** (power_spectrum_db(e, FS)[1] / 10) for e in run.error])
    levels = (np.array(scale)[:, np.newaxis] / 20e-6) ** 2 * powers
    for options, expected in (
        ({}, powers.mean(axis=0)),
        ({"channel": 2}, powers[2]),
        ({"pascal_per_unit": scale}, levels.mean(axis=0)),
        ({"pascal_per_unit": scale, "channel": 2}, levels[2]),
    ):
        line = _line(plotting.plot_error_spectra(run, **options), "KF-OPC")
        np.testing.assert_allclose(line.get_ydata(), 10 * np.log10(expected), rtol=0, atol=1e-9)


def test_output_power_has_a_curve_for_each_loudspeaker():
    run = multichannel_result()
    ax = plotting.plot_output_power(run, window_s=0.01)
    assert _labels(ax) == ["KF-OPC, 2 loudspeakers", "Rated power 1"]
    for line, y in zip(ax.get_lines()[:2], run.control_signal, strict=True):
        np.testing.assert_allclose(line.get_ydata(), short_time_power(y, FS, 0.01)[: line.get_ydata().size])
        assert line.get_color() == ax.get_lines()[0].get_color()
    one = plotting.plot_output_power(run, window_s=0.01, channel=1)
    assert _labels(one) == ["KF-OPC", "Rated power 1"]
    np.testing.assert_array_equal(_line(one, "KF-OPC").get_ydata(), ax.get_lines()[1].get_ydata())


def test_refusals_name_the_argument(tonal, noise):
    run, many = tonal["KF-OPC"], multichannel_result()
    span = {"span_s": SPAN}
    others = {"a": [many, multichannel_result(control_signal=np.zeros(4000))]}
    for plot, results, options, message in (
        (plotting.plot_nse, run.error, {}, "results must be a SimulationResult or a sequence of them, got ndarray"),
        (plotting.plot_nse, {"a": run.error}, {}, "results must hold SimulationResult, got ndarray under 'a'"),
        (plotting.plot_nse, [], {}, "results must hold at least one SimulationResult"),
        (plotting.plot_nse, noise, {}, "results hold two runs of 'KF-OPC'; pass a mapping"),
        (plotting.plot_nse, {"a": [run, noise[0]]}, {}, "results 'a' must be runs of one length"),
        (plotting.plot_anti_noise, {"KF-OPC": noise}, span, "must hold one run per name here, got 2 runs of 'KF-OPC'"),
        (plotting.plot_error_spectra, {"a": noise[0], "b": noise[1]}, {}, "results must have one disturbance"),
        (plotting.plot_anti_noise, run, {"span_s": (0.3, 0.5)}, r"0 <= start < end <= 0.4 s, got \(0.3, 0.5\) s"),
        (plotting.plot_anti_noise, run, {"span_s": 0.1}, r"span_s must be a pair \(start, end\) in seconds"),
        (plotting.plot_nse, run, {"time_axis": "decades"}, "time_axis must be one of 'linear', 'log'"),
        (plotting.plot_output_power, run, {"rated_power": 0.0}, "rated_power must be greater than 0"),
        (
            plotting.plot_anti_noise,
            many,
            {"span_s": (0.1, 0.12)},
            "results hold 3 channels; choose one with channel=0 to channel=2",
        ),
        (plotting.plot_amplifier_output, many, {"span_s": (0.1, 0.12)}, "results hold 2 channels; choose one"),
        (plotting.plot_nse, many, {"channel": 3}, r"channel must be below the 3 channel\(s\) of the results, got 3"),
        (plotting.plot_output_power, many, {"channel": 2}, r"channel must be below the 2 channel\(s\) of the results"),
        (plotting.plot_nse, others, {}, "with the same channels"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            plot(results, **options)
    assert not plt.get_fignums()  # arguments are looked at before a figure is made
