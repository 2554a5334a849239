"""Figures of merit against direct sums and closed forms."""

import math

import numpy as np
import pytest

from kfopc_filterpy import metrics
from kfopc_filterpy.metrics import (
    clipped_fraction,
    coherence_and_gain,
    convergence_time_s,
    harmonics_db,
    noise_reduction_db,
    nse_db,
    output_power,
    overshoot,
    peak_control_signal,
    power_spectrum_db,
    short_time_power,
)

FS = 16000


def noise(n, seed=0):
    return np.random.default_rng(seed).standard_normal(n)


def sine(frequency, n, amplitude=1.0, phase=0.0):
    return amplitude * np.sin(2 * np.pi * frequency / FS * np.arange(n) + phase)


# ---- NSE


@pytest.mark.parametrize("window", [1, 7, 101, 500])
def test_powers_are_direct_means_over_the_window_that_ends_with_the_sample(window):
    e, d = noise(101, 1), noise(101, 2)
    powers = [np.array([np.mean(x[max(0, n - window + 1) : n + 1] ** 2) for n in range(101)]) for x in (e, d)]
    # Two orders of summation of up to 101 positive terms: rounding below 1e-13 relative, 1e-12 dB.
    np.testing.assert_allclose(nse_db(e, d, FS, window / FS), 10 * np.log10(powers[0] / powers[1]), rtol=0, atol=1e-11)
    np.testing.assert_allclose(short_time_power(e, FS, window / FS), powers[0], rtol=1e-12)


def test_nse_keeps_a_small_residual_after_a_huge_transient():
    # Differences of running sums would leave rounding of 1e16 * 1e-16 = 1 here, over a residual of 1e-12.
    e = np.concatenate([np.full(500, 1e8), np.full(500, 1e-6)])
    np.testing.assert_allclose(nse_db(e, np.ones(1000), FS)[580:], -120.0, rtol=0, atol=1e-9)


def test_nse_is_nan_exactly_where_its_window_sees_nan_or_silence():
    e, d = np.ones(40), np.ones(40)
    e[20] = np.nan
    curve = nse_db(e, d, 1000, 0.005)
    assert np.flatnonzero(np.isnan(curve)).tolist() == [20, 21, 22, 23, 24]
    d[:10] = 0.0
    assert np.flatnonzero(np.isnan(nse_db(np.ones(40), d, 1000, 0.005))).tolist() == list(range(10))


def test_perfect_cancellation_is_minus_infinity_without_a_warning():
    assert np.all(nse_db(np.zeros(10), np.ones(10), FS) == -np.inf)
    assert noise_reduction_db(np.zeros(10), np.ones(10)) == np.inf


# ---- noise reduction, power, peaks


def test_noise_reduction_is_of_the_second_half():
    e, d = noise(1001, 1), noise(1001, 2)
    assert noise_reduction_db(e, d) == pytest.approx(-10 * math.log10(sum(e[500:] ** 2) / sum(d[500:] ** 2)), abs=1e-10)
    assert noise_reduction_db(e, d, steady=1.0) == pytest.approx(-nse_db(e, d, FS, 1.0)[-1], abs=1e-10)


def test_output_power_is_the_mean_square_of_the_steady_portion():
    y = noise(1000)
    assert output_power(y) == pytest.approx(math.fsum(y[500:] ** 2) / 500, rel=1e-13)
    assert output_power(y, steady=0.25) == pytest.approx(math.fsum(y[750:] ** 2) / 250, rel=1e-13)
    runs = np.array([y, 2 * y])
    assert output_power(runs, runs=True) == pytest.approx(2.5 * output_power(y), rel=1e-13)


def test_overshoot_is_the_highest_full_window():
    y = np.concatenate([sine(400, 1600, 2.0), sine(400, 14400, 1.0)])
    # Whole periods fill the window, so its power is 2.0 at the start, 0.5 after.
    assert overshoot(y, 0.5, FS) == pytest.approx(4.0, rel=1e-12)
    assert overshoot(np.array([y, 3 * y]), 0.5, FS, runs=True) == pytest.approx(36.0, rel=1e-12)
    # One sample of a burst at the very start must not count as a window of its own.
    burst = np.concatenate([[10.0], np.zeros(1599)])
    assert overshoot(burst, 1.0, FS, window_s=0.05) == pytest.approx(100 / 800, rel=1e-12)


def test_clipped_fraction_of_a_sine_is_the_arc_cosine():
    y = sine(37.0, 160000, 2.0)
    # abs(2 sin) > 1 for 2/3 of a period; 185 periods of steady portion, an edge of 4 samples in each.
    assert clipped_fraction(y, 1.0) == pytest.approx(2 / 3, abs=1e-3)
    assert clipped_fraction(np.clip(y, -1.0, 1.0), 1.0) == 0.0


def test_peak_is_of_the_steady_portion_unless_told_otherwise():
    y = [5.0, 0.0, -3.0, 1.0]
    assert peak_control_signal(y) == 3.0
    assert peak_control_signal(y, steady=1.0) == 5.0


# ---- harmonics


@pytest.mark.parametrize("fundamental", [400.0, 397.3, 123.45])
def test_harmonics_of_known_lines_also_between_bins(fundamental):
    n = 32000
    d = sine(fundamental, n, 2.0)
    e = sine(fundamental, n, 1.0, 0.4)
    for order, amplitude in ((2, 0.02), (3, 0.1), (10, 0.05)):
        e = e + sine(order * fundamental, n, amplitude, order)
    e = e + sine(11 * fundamental, n, 0.5)
    expected = 10 * math.log10((0.02**2 + 0.1**2 + 0.05**2) / 2.0**2)
    # The power beyond the four bins of the main lobe, and leakage, are below 1e-6.
    assert harmonics_db(e, d, fundamental, FS) == pytest.approx(expected, abs=1e-4)


def test_harmonics_of_a_hard_clip_are_the_fourier_series():
    # 40 samples a period; the sampled clip's series is the discrete Fourier series of one period.
    d = sine(400, 16000, 1.5)
    clipped = np.clip(d, -1.0, 1.0)
    series = 2 * np.abs(np.fft.fft(clipped[:40]) / 40) ** 2
    expected = 10 * math.log10(np.sum(series[2:11]) / (1.5**2 / 2))
    assert harmonics_db(d - clipped, d, 400.0, FS) == pytest.approx(expected, abs=1e-9)


def test_harmonics_above_half_the_sampling_rate_are_left_out():
    d = sine(3000, 16000)
    assert harmonics_db(d + sine(6000, 16000, 0.1), d, 3000.0, FS) == pytest.approx(-20.0, abs=1e-6)


# ---- convergence time


def test_convergence_time_of_an_exponential_decay_is_the_closed_form():
    fs, n = 1000, 4000
    t = np.arange(n) / fs
    # NSE falls by 20 dB a second down to a floor of -40 dB.
    e = np.maximum(10 ** (-t), 10**-2.0)
    # Within 3 dB of -40 dB from (40 - 3) / 20 = 1.85 s on; one sample of rounding.
    assert convergence_time_s(e, np.ones(n), fs, window_s=0.001) == pytest.approx(1.85, abs=0.0011)


def test_convergence_counts_from_the_last_excursion():
    e = np.where(np.arange(2000) < 100, 1.0, 0.1)
    e[500:510] = 1.0
    assert convergence_time_s(e, np.ones(2000), 1000, window_s=0.001) == 0.51
    # Going below the steady value by more than the tolerance is an excursion as well.
    e[700:710] = 0.01
    assert convergence_time_s(e, np.ones(2000), 1000, window_s=0.001) == 0.71


def test_convergence_is_zero_where_nothing_happens_and_nan_where_it_never_settles():
    d = noise(1000)
    assert convergence_time_s(0.5 * d, d, FS) == 0.0
    e = np.ones(1000)
    e[-1] = 10.0
    assert math.isnan(convergence_time_s(e, np.ones(1000), 1000, window_s=0.001))
    assert convergence_time_s(np.r_[np.ones(10), np.zeros(90)], np.ones(100), 1000, window_s=0.001) == 0.01


# ---- coherence and spectra


def test_coherence_of_signal_and_noise_is_the_power_ratio():
    n = 40 * FS
    d, other = noise(n, 1), noise(n, 2)
    coherence, gain = coherence_and_gain(d, 0.5 * d + 0.25 * other, FS, (200.0, 2000.0), steady=1.0)
    # Signal power 0.25 over 0.25 + 0.0625; 1200 half-overlapping segments bias it by less than 1e-3.
    assert coherence == pytest.approx(0.8, abs=3e-3)
    # Relative error 0.5 / sqrt(72000 independent values in the band), five of them.
    assert gain == pytest.approx(0.5, abs=0.005)


def test_density_integrates_to_the_power():
    x = noise(20 * FS)
    f, level = power_spectrum_db(x, FS, steady=1.0)
    assert f[0] == 0
    assert f[-1] == FS / 2
    # 2e5 independent values: the windowed estimate of the power is within 1 %.
    assert np.sum(10 ** (level / 10)) * (f[1] - f[0]) == pytest.approx(np.mean(x**2), rel=0.02)
    assert power_spectrum_db(noise(60), FS)[1].shape == (16,)  # the steady half is shorter than a segment


# ---- channels and runs

K, R, N = 3, 4, 4000
OF_A_SIGNAL = {
    "output_power": output_power,
    "short_time_power": lambda y, **runs: short_time_power(y, FS, 0.01, **runs),
    "overshoot": lambda y, **runs: overshoot(y, 0.5, FS, **runs),
    "clipped_fraction": lambda y, **runs: clipped_fraction(y, 1.0, **runs),
    "peak_control_signal": peak_control_signal,
    "power_spectrum_db": lambda y, **runs: power_spectrum_db(y, FS, segment_s=0.01, **runs)[1],
}
OF_A_PAIR = {
    "nse_db": lambda e, d, **runs: nse_db(e, d, FS, **runs),
    "noise_reduction_db": noise_reduction_db,
    "convergence_time_s": lambda e, d, **runs: convergence_time_s(e, d, FS, window_s=0.01, **runs),
    "harmonics_db": lambda e, d, **runs: harmonics_db(e, d, 400.0, FS, **runs),
}


def coherence_of(d, a, band=(200.0, 2000.0), **runs):
    return coherence_and_gain(d, a, FS, band, segment_s=0.01, **runs)


@pytest.mark.parametrize("name", OF_A_SIGNAL)
def test_a_figure_of_several_channels_is_that_of_each(name):
    figure, y = OF_A_SIGNAL[name], noise((K, N))
    found = figure(y)
    np.testing.assert_allclose(found, [figure(channel) for channel in y], rtol=1e-12)
    np.testing.assert_allclose(figure(y[:1]), found[:1], rtol=1e-12)  # one channel may keep its axis


@pytest.mark.parametrize("name", OF_A_SIGNAL)
def test_pooling_several_channels_over_runs_is_pooling_each(name):
    figure, y = OF_A_SIGNAL[name], noise((R, K, N)) * np.arange(1, R + 1)[:, None, None]
    pooled = figure(y, runs=True)
    np.testing.assert_allclose(pooled, [figure(y[:, k], runs=True) for k in range(K)], rtol=1e-12)
    largest = name in ("overshoot", "peak_control_signal")
    each = np.array([figure(run) for run in y])
    if name == "power_spectrum_db":
        each, pooled = 10 ** (each / 10), 10 ** (pooled / 10)
    np.testing.assert_allclose(pooled, each.max(axis=0) if largest else each.mean(axis=0), rtol=1e-12)


@pytest.mark.parametrize("name", OF_A_PAIR)
def test_a_figure_of_the_sound_field_takes_all_microphones_and_runs_together(name):
    figure = OF_A_PAIR[name]
    d = np.tile(sine(400, N), (R, K, 1)) + 0.1 * noise((R, K, N), 1)
    e = d * np.linspace(0.1, 0.3, R * K).reshape(R, K, 1)
    # All of these see the same energies: microphones of several runs, or as many runs or microphones in a row.
    in_a_row = figure(e.reshape(-1, N), d.reshape(-1, N))
    np.testing.assert_allclose(figure(e, d, runs=True), in_a_row, rtol=1e-10)
    np.testing.assert_allclose(figure(e.reshape(-1, N), d.reshape(-1, N), runs=True), in_a_row, rtol=1e-10)
    if name == "noise_reduction_db":
        steady = np.s_[..., N // 2 :]
        assert in_a_row == pytest.approx(-10 * math.log10(np.sum(e[steady] ** 2) / np.sum(d[steady] ** 2)), rel=1e-12)
    one = figure(e[0, 0], d[0, 0])
    np.testing.assert_allclose(figure(e[0, :1], d[0, :1]), one, rtol=1e-12)
    assert np.shape(in_a_row) == np.shape(one)


def test_coherence_and_gain_are_of_each_microphone():
    d, other = noise((R, K, N), 1), noise((R, K, N), 2)
    a = 0.5 * d + np.array([0.0, 0.1, 1.0])[:, None] * other
    found, pooled = coherence_of(d[0], a[0]), coherence_of(d, a, runs=True)
    for k in range(K):
        assert (found.coherence[k], found.gain[k]) == pytest.approx(coherence_of(d[0, k], a[0, k]), rel=1e-12)
        assert (pooled.coherence[k], pooled.gain[k]) == pytest.approx(
            coherence_of(d[:, k], a[:, k], runs=True), rel=1e-12
        )


def test_loudspeakers_may_have_limits_of_their_own():
    y = noise((K, N))
    rated, limits = [0.5, 1.0, 2.0], [1.0, 2.0, 3.0]
    np.testing.assert_array_equal(overshoot(y, rated, FS), [overshoot(y[k], rated[k], FS) for k in range(K)])
    np.testing.assert_array_equal(clipped_fraction(y, limits), [clipped_fraction(y[k], limits[k]) for k in range(K)])


@pytest.mark.parametrize(
    "figure",
    [*OF_A_SIGNAL.values(), *(lambda x, f=f, **runs: f(x, x, **runs) for f in (*OF_A_PAIR.values(), coherence_of))],
)
def test_runs_are_never_guessed_from_an_axis(figure):
    with pytest.raises(ValueError, match=r"got shape \(2, 3, 8\); pass runs=True if the leading axis counts runs"):
        figure(np.ones((2, 3, 8)))
    with pytest.raises(ValueError, match=r"with runs=True \(n_runs, n_samples\) or .*, got shape \(8,\)"):
        figure(np.ones(8), runs=True)
    with pytest.raises(ValueError, match=r"got shape \(2, 2, 3, 8\)$"):
        figure(np.ones((2, 2, 3, 8)), runs=True)
    for shape, runs in (((8, 3), False), ((2, 8, 3), True)):
        with pytest.raises(ValueError, match=r"must have its channels first.*got 8 channels of 3 sample.*transpose it"):
            figure(np.ones(shape), runs=runs)
    with pytest.raises(TypeError, match="got list, whose rows differ in length"):
        figure([[1.0], [1.0, 2.0]])


# ---- divergence, silence, refusals


def figures_of_pairs(e, d):
    return [figure(e, d) for name, figure in OF_A_PAIR.items() if name != "nse_db"]


def test_a_diverged_run_gives_nan_everywhere_without_a_warning():
    d = sine(400, 16000)
    e = np.where(np.arange(16000) < 9000, d, np.nan)
    assert np.isnan(nse_db(e, d, FS)[9000:]).all()
    curves = ("short_time_power", "power_spectrum_db")
    figures = [figure(e) for name, figure in OF_A_SIGNAL.items() if name not in curves]
    figures += [*figures_of_pairs(e, d), *coherence_of(d, e)]
    assert np.isnan(figures).all()
    assert all(type(figure) is float for figure in figures)
    assert np.isnan(power_spectrum_db(e, FS)[1][5])


def test_silent_disturbance_gives_nan_without_a_warning():
    e, silence = sine(400, 2 * FS), np.zeros(2 * FS)
    assert np.isnan([*figures_of_pairs(e, silence), *coherence_of(silence, e)]).all()


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: nse_db([], [], FS), ValueError, "error must have at least one sample"),
        (lambda: nse_db([1.0], [1.0, 2.0], FS), ValueError, "error and disturbance must have one shape"),
        (lambda: nse_db([1.0], [1.0], FS, 1e-6), ValueError, "window_s must be at least one sample"),
        (lambda: nse_db([np.inf], [1.0], FS), ValueError, "error must hold finite numbers"),
        (lambda: nse_db(["a"], [1.0], FS), TypeError, "error must be a sequence of real numbers, got list"),
        (lambda: noise_reduction_db([1.0], [1.0], steady=0.0), ValueError, "steady must be a portion above 0"),
        (lambda: noise_reduction_db([1.0], [1.0], steady=1.5), ValueError, "steady must be a portion above 0"),
        (lambda: overshoot([1.0], 0.0, FS), ValueError, "rated_power must be greater than 0"),
        (lambda: overshoot(np.ones((3, 9)), [1.0, 2.0], FS), ValueError, "rated_power must have 3 values, got 2"),
        (lambda: clipped_fraction([1.0], [1.0, 2.0]), ValueError, "limit must be a single number"),
        (lambda: clipped_fraction(np.ones((2, 9)), [1.0, -1.0]), ValueError, "limit must be greater than 0"),
        (lambda: harmonics_db(np.ones(80), np.ones(80), 400.0, FS), ValueError, "at least 16 periods"),
        (lambda: harmonics_db(np.ones(999), np.ones(999), 5e3, FS), ValueError, "second harmonic below fs/2"),
        (lambda: coherence_of(np.ones(999), np.ones(999)), ValueError, "at least 8 segments"),
        (lambda: coherence_of(np.ones(FS), np.ones(FS), (201, 202)), ValueError, "holds no frequency bin"),
        (lambda: metrics.a_weighting_db([-1.0]), ValueError, "frequencies_hz must not be negative"),
        (lambda: metrics.third_octave_levels_db(np.ones(4), FS), ValueError, "must be longer for a third-octave band"),
    ],
)
def test_refusals_say_what_was_wrong(call, error, message):
    with pytest.raises(error, match=message):
        call()


# Levels.

# Table of IEC 61672-1: weighting A in dB, rounded to a tenth, at 31.5, 63, 125, ... 16000 Hz.
A_WEIGHTING = [-39.4, -26.2, -16.1, -8.6, -3.2, 0.0, 1.2, 1.0, -1.1, -6.6]


def test_the_weighting_a_is_that_of_the_standards_table():
    exact = 1000 * 10.0 ** (0.3 * np.arange(-5, 5))  # what the nominal frequencies stand for
    np.testing.assert_allclose(metrics.a_weighting_db(exact), A_WEIGHTING, atol=0.1)
    assert metrics.a_weighting_db(0.0) == -np.inf


@pytest.mark.parametrize("hz", [100.0, 1000.0, 4000.0])
def test_a_tone_of_one_pascal_has_94_decibels_in_its_band_and_less_by_the_weighting(hz):
    fs = 16000
    t = np.arange(2 * fs) / fs
    signal = np.sqrt(2) * np.sin(2 * np.pi * hz * t)
    centres, levels = metrics.third_octave_levels_db(signal, fs)
    level = 20 * np.log10(1 / 2e-5)
    assert levels.max() == pytest.approx(level, abs=0.01)
    assert abs(np.log10(centres[levels.argmax()] / hz)) < 0.05
    assert metrics.a_weighted_level_db(signal, fs) == pytest.approx(level + metrics.a_weighting_db(hz), abs=0.02)


def test_the_bands_of_noise_add_up_and_channels_stay_apart():
    fs = 16000
    noise = np.random.default_rng(0).standard_normal(10 * fs) * [[1.0], [10.0]]
    centres, levels = metrics.third_octave_levels_db(noise, fs, reference=1.0, steady=1.0)
    assert levels.shape == (2, centres.size)
    np.testing.assert_allclose(levels[1] - levels[0], 20.0, atol=1e-9)
    # White noise: a band's power is its width over fs/2; ten seconds leave a third of a decibel in the lowest ones.
    width = centres * (10**0.05 - 10**-0.05)
    np.testing.assert_allclose(levels[0][centres > 100], 10 * np.log10(width / (fs / 2))[centres > 100], atol=1.0)


# IEC 61260-1, table 1, class 1: frequencies of octave bands over their centre, as exponents of 10**0.3, with the least
# attenuation from there on, and the largest up to there, in dB.
CLASS_1_LEAST = ([0.5, 1, 2, 3, 4], [1.2, 16.6, 40.5, 60.0, 70.0])
CLASS_1_MOST = ([0, 1 / 8, 1 / 4, 3 / 8, 0.5], [0.4, 0.5, 0.7, 1.4, 5.3])


@pytest.mark.parametrize("fs", [5000, 16000])
def test_every_third_octave_keeps_to_class_1(fs):
    tones = np.geomspace(20.0, 0.499 * fs, 120)
    signals = np.sqrt(2) * np.sin(2 * np.pi * tones[:, np.newaxis] * np.arange(3 * fs) / fs)
    centres, levels = metrics.third_octave_levels_db(signals, fs, reference=1.0)
    assert centres[-1] * 10**0.05 > 0.38 * fs  # up to fs/2 but for a band
    ratio = np.exp(np.abs(np.log(tones[:, np.newaxis] / centres)))  # the limits are the same on both sides

    def limits(exponents, decibels):  # of a third octave, by equation 11 of the standard
        edges = 1 + (10**0.05 - 1) / (10**0.15 - 1) * (10 ** (0.3 * np.array(exponents)) - 1)
        return np.interp(np.log(ratio), np.log(edges), decibels)

    inside = ratio < 10**0.05
    assert np.all(-levels[inside] <= limits(*CLASS_1_MOST)[inside])
    assert np.all(-levels >= np.where(inside, -0.4, limits(*CLASS_1_LEAST)))


def test_a_level_is_a_mean_over_time_wherever_the_sound_is():
    """Noise in a sixteenth of the steady half has a sixteenth of the power of noise that lasts, at its end as well."""
    fs, n = 16000, 32000
    noise = np.random.default_rng(0).standard_normal(n // 16)
    bursts = np.zeros((3, 2 * n))
    for row, place in zip(bursts, (n, n + n // 2, 2 * n - noise.size), strict=True):
        row[place : place + noise.size] = noise
    frequencies = np.fft.rfftfreq(noise.size, 1 / fs)
    powers = 2 * np.abs(np.fft.rfft(noise) / noise.size) ** 2
    expected = 10 * np.log10(np.sum(powers * 10 ** (metrics.a_weighting_db(frequencies) / 10)) / 16)
    # The burst's own spectrum, as if it repeated; where it is cut, its ends differ by hundredths of a decibel.
    np.testing.assert_allclose(metrics.a_weighted_level_db(bursts, fs, reference=1.0), expected, atol=0.05)
    _, levels = metrics.third_octave_levels_db(bursts, fs, reference=1.0)
    np.testing.assert_allclose(levels[0], levels[1], atol=0.01)  # the end would cut what its filters still play
