"""The suggested settings: each value against an independent computation, and how good they are in runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.channels import delayed, dense_systems

from comparisons.bench.noises import bursty_noise
from comparisons.studies.cases import modelled_plants
from kfopc_filterpy import Plant, kf_anc, kf_opc, simulate, suggest_settings
from kfopc_filterpy.bounds import settings, wiener_solution
from kfopc_filterpy.signals import band_limited_noise, compressor_noise, scaled_to_power, tone

FS = 16000.0
S = np.array([0.0, 0.0, 0.8, 0.3])
PLANT = Plant(S, fs=FS)


def delayed_noise(delay=20, n=32000, q=0.01, seed=0):
    """Return a white reference, and a disturbance that a control filter of about `delay` taps explains but for q."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(n)
    return x, np.convolve(x, np.concatenate([np.zeros(delay), S[2:]]))[:n] + np.sqrt(q) * rng.standard_normal(n)


X, D = delayed_noise()
PATHS = np.random.default_rng(5).standard_normal((2, 2, 6))  # secondary paths


# ---- Each value


@pytest.mark.parametrize("delay", [5, 20, 60, 100])
def test_the_length_is_that_of_the_true_filter(delay):
    """w is one weight, `delay` - 2 samples late: only filters that reach it reduce the noise, longer ones gain nothing."""
    x, d = delayed_noise(delay)
    suggested = suggest_settings(x, PLANT, disturbance=d)
    needed = delay - 2 + 1
    assert needed <= suggested.n_taps < needed + settings.MULTIPLE
    assert suggested.n_taps % settings.MULTIPLE == 0
    assert suggested.measurement_noise == pytest.approx(0.01, rel=5 * np.sqrt(2 / 32000))


def test_of_several_channels_the_measurement_noise_is_the_residual_of_dense_least_squares():
    x, paths, plant = X[:6000].reshape(2, 3000), PATHS, Plant(PATHS, fs=FS)
    d = np.stack([np.convolve(x[0], 0.9 ** np.arange(30))[:3000], np.convolve(x[1], 0.5 ** np.arange(30))[:3000]])
    d = d + D[:6000].reshape(2, 3000)
    for n in (1, 4, 10):
        start = n + paths.shape[2] - 2  # where the delay lines are full
        R, _, r = dense_systems(x, d, paths, n, start)
        residual = np.sum(np.mean(d[:, start:] ** 2, axis=1)) - r @ np.linalg.solve(R, r)
        n_samples, weights = d.shape[1] - start, r.size / 2  # weights for each microphone
        expected = residual / 2 * n_samples / (n_samples - weights)
        found = suggest_settings(x, plant, disturbance=d, n_taps=n)
        assert found.measurement_noise == pytest.approx(expected, rel=1e-6)


def test_two_loudspeakers_that_do_not_meet_get_the_settings_of_one():
    x, d = delayed_noise(12)
    alone = suggest_settings(x, PLANT, disturbance=d)
    apart = np.zeros((2, 2, len(S)))
    apart[[0, 1], [0, 1]] = S
    both = suggest_settings(x, Plant(apart, fs=FS), disturbance=np.stack([d, d]))
    assert both.n_taps == alone.n_taps
    assert both.measurement_noise == pytest.approx(alone.measurement_noise, rel=1e-6)
    # Each of the two filters learns from one microphone: the mean E[x'^2] is that of one, and so are r and P0.
    assert both.state_noise == pytest.approx(alone.state_noise, rel=1e-3)
    assert both.initial_variance == pytest.approx(alone.initial_variance, rel=1e-3)


def long_tail():
    """Return a noise of which each tap more explains a little."""
    tail = np.convolve(X, np.concatenate([np.zeros(5), 0.97 ** np.arange(200)]))[: X.size]
    return X, tail + 3.0 * np.random.default_rng(2).standard_normal(X.size)


def test_the_noises_and_the_variance_are_those_of_the_formulas():
    suggested = suggest_settings(X, PLANT, disturbance=D, n_taps=24, memory_s=0.5)
    filtered = np.convolve(X, S)[: X.size]
    start = 24 + S.size - 2  # delay lines full
    rows = delayed(filtered[None], 24)[:, start:].T
    _, (squares,), _, _ = np.linalg.lstsq(rows, D[start:], rcond=None)
    q = squares / (len(rows) - 24)
    assert suggested.n_taps == 24
    assert suggested.measurement_noise == pytest.approx(q, rel=1e-6)  # but for the ridge of 1e-11
    # mean squares over the samples with full delay lines, or over all: 0.2 % of the record
    assert suggested.initial_variance == pytest.approx(np.mean(D**2) / (24 * np.mean(filtered**2)), rel=0.01)
    memory = np.sqrt(q / (suggested.state_noise * np.mean(filtered**2))) / FS
    assert memory == pytest.approx(0.5, rel=0.02)  # white noise: its power over 10 ms varies by 160 samples' chance
    assert memory > 0.5


def test_the_sensor_noise_of_the_plant_is_part_of_q_and_a_recording_has_it():
    noisy = Plant(S, np.pad(S[2:], (20, 0)), fs=FS, sensor_noise_std=0.1)
    computed, recorded = suggest_settings(X, noisy), suggest_settings(X, PLANT, disturbance=D)  # with q = 0.01
    assert computed.measurement_noise == pytest.approx(0.01, rel=1e-6)
    assert "the plant's sensor noise of 0.01 included, 18.7 dB below" in computed.reasons["measurement_noise"]
    assert computed.n_taps == recorded.n_taps
    for name, value in recorded.noises.items():
        assert getattr(computed, name) == pytest.approx(value, rel=5 * np.sqrt(2 / X.size))
    assert suggest_settings(X, noisy, disturbance=D).noises == recorded.noises  # not twice
    quiet = suggest_settings(X, noisy, disturbance=Plant(S, noisy.primary, fs=FS).disturbance(X))
    assert quiet.measurement_noise == pytest.approx(0.01, rel=1e-12)
    assert quiet.reasons["measurement_noise"].startswith("the power of the plant's sensor noise")


def test_q_has_no_bias_from_the_weights_fitted():
    """27 weights on 300 samples take a tenth of the residual: 160 estimates average to q within 4 sigma."""
    estimates = []
    for seed in range(160):
        rng = np.random.default_rng(seed)
        x, w = rng.standard_normal(300), rng.standard_normal(27)
        d = np.convolve(np.convolve(x, S), w)[:300] + np.sqrt(0.5) * rng.standard_normal(300)
        estimates.append(suggest_settings(x, PLANT, disturbance=d, n_taps=27).measurement_noise)
    sigma = np.sqrt(2 / (300 - 29 - 27) / len(estimates))
    assert np.mean(estimates) == pytest.approx(0.5, rel=4 * sigma)
    assert 4 * sigma < 27 / 300 / 2  # an uncorrected mean square would be far outside


def test_a_short_memory_makes_a_long_filter_not_worth_while():
    """Weights that gain little each pay at a long memory, and cost more than they gain at a short one."""
    x, d = long_tail()
    lengths = [suggest_settings(x, PLANT, disturbance=d, memory_s=memory).n_taps for memory in (0.02, 0.1, 10.0)]
    assert lengths[0] < lengths[1] < lengths[2]


def test_a_length_at_which_tones_need_huge_weights_is_passed_over():
    """32 taps cancel four tones with weights that no filter learns within its memory."""
    x = sum(tone(f, 2.0, fs=FS, phase_rad=f) for f in (120.0, 240.0, 480.0, 730.0))
    d = np.concatenate([np.zeros(50), x])[: x.size] + 0.1 * np.random.default_rng(0).standard_normal(x.size)
    x, d = x[2000:], d[2000:]
    suggested, shorter = (
        suggest_settings(x, PLANT, disturbance=d),
        suggest_settings(x, PLANT, disturbance=d, n_taps=32),
    )
    assert shorter.measurement_noise < 1.02 * suggested.measurement_noise  # 0.1 dB: long enough for a fixed filter
    found, other = (
        simulate(kf_anc(given.n_taps, PLANT, **given.noises), x, PLANT, disturbance=d) for given in (suggested, shorter)
    )
    assert found.noise_reduction_db > 22.5  # of 23 dB that the microphone's noise allows
    assert other.noise_reduction_db < 10.0


def test_bursts_lengthen_the_memory():
    """Bursts of a tenth of the time, with all of the power: the mean square of the power is ten times its square."""
    x = np.where((np.arange(X.size) // 320) % 10 == 0, X, 0.0)  # 20 ms each 200 ms
    d = np.convolve(x, np.eye(20)[19])[: x.size] + 0.1 * np.random.default_rng(2).standard_normal(x.size)
    for wanted, lengthened in ((0.25, np.sqrt(10)), (0.02, 1.0)):  # a memory as short as a burst follows it
        suggested = suggest_settings(x, PLANT, disturbance=d, n_taps=24, memory_s=wanted)
        power = np.mean(np.convolve(x, S) ** 2)
        memory = np.sqrt(suggested.measurement_noise / (suggested.state_noise * power)) / FS
        assert memory == pytest.approx(wanted * lengthened, rel=0.1)


def test_all_follows_the_units():
    """Volts or pascals: weights scale with d over x', so r and P0 with its square, q with d's."""
    one, two = (
        suggest_settings(X, PLANT, disturbance=D),
        suggest_settings(4.0 * X, Plant(8.0 * S, fs=FS), disturbance=2.0 * D),
    )
    assert two.n_taps == one.n_taps
    assert two.measurement_noise == pytest.approx(4 * one.measurement_noise, rel=1e-9)
    for name in ("state_noise", "initial_variance"):
        assert getattr(two, name) == pytest.approx(getattr(one, name) * (2 / 32) ** 2, rel=1e-9)


def test_without_any_noise_of_a_microphone_q_is_60_db_down():
    x, d = delayed_noise(q=0.0)
    suggested = suggest_settings(x, PLANT, disturbance=d)
    assert suggested.measurement_noise == pytest.approx(1e-6 * np.mean(d**2), rel=0.01)
    assert "60 dB below" in suggested.reasons["measurement_noise"]
    assert "60 dB" not in suggest_settings(X, PLANT, disturbance=D).reasons["measurement_noise"]


# ---- What it says


def test_it_says_why():
    """What limits the length; and of noise that cannot be controlled, and of bursts, that they are that."""
    (x, d), other = long_tail(), np.random.default_rng(9).standard_normal(X.size)
    bursts = bursty_noise(2.0, fs=FS, rng=0)
    late = np.convolve(bursts, np.eye(30)[25])[: bursts.size] + 0.01 * other
    plain = {"gains less than 0.1 dB": "n_taps"}
    cases = [
        ((x, d), {"max_taps": 32}, {"the longest that is tried; the best fixed filter": "n_taps"}),
        ((x[:400], d[:400]), {}, {"as long as this record supports": "n_taps"}),
        ((x, d), {"n_taps": 64}, {"as given": "n_taps"}),
        ((X, other), {}, {"causality margin and the coherence tell the cause": "n_taps", "by 0.0 dB": "n_taps"}),
        ((bursts, late), {}, {"because the noise comes in bursts": "state_noise"}),
        ((X, D), {}, plain),
    ]
    for (reference, disturbance), options, words in cases:
        found = suggest_settings(reference, PLANT, disturbance=disturbance, **options)
        assert all(said in found.reasons[name] for said, name in words.items()), found.reasons
        if words is plain:
            assert not any(said in reason for said in ("bursts", "causality") for reason in found.reasons.values())
    assert suggest_settings(x[:400], PLANT, disturbance=d[:400]).n_taps == (400 - S.size + 2) // 11
    assert suggest_settings(X, PLANT, disturbance=other).n_taps == settings.MULTIPLE


# ---- What it refuses


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reference": np.zeros(X.size)}, "must not be silent"),
        ({"disturbance": np.zeros(X.size)}, "disturbance must not be silent"),
        ({"reference": 1e-160 * X}, r"the filtered reference must have a mean square from 1e-60 to 1e\+60"),
        ({"disturbance": 1e100 * D}, r"disturbance must have a mean square from 1e-60 to 1e\+60, got .*: scale"),
        ({"plant": Plant(np.zeros((2, 2, 4)), fs=FS)}, r"\(K microphones, n_samples\) = \(2, 32000\)"),
        ({"disturbance": None}, "the disturbance is unknown: make the plant with a primary path, or give disturbance="),
        ({"plant": PLANT.changed_at(1.0, secondary=-S)}, "suggest_settings needs a plant that does not change"),
        (
            {"n_taps": 2909},
            "at least 32001 samples for 2909 control and 4 path taps, got 32000; choose at most 2908 control",
        ),
        ({"plant": Plant(np.ones(31995), fs=FS)}, "record a longer silent run, or cut the impulse response"),
        ({"reference": X[:12], "disturbance": D[:12]}, "at least 13 samples for 1 control"),
        ({"memory_s": -1.0}, "memory_s must be greater than 0"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_it_refuses(change, message):
    with pytest.raises(ValueError, match=message):
        suggest_settings(**{"reference": X, "plant": PLANT, "disturbance": D} | change)


def test_the_shortest_record_and_the_longest_filter_that_it_supports():
    assert suggest_settings(X[:13], PLANT, disturbance=D[:13]).n_taps == 1
    assert suggest_settings(X[:332], PLANT, disturbance=D[:332], n_taps=30).n_taps == 30


# ---- How good they are: within 0.5 dB of the best of a grid over length and state noise

ON, DURATION_S = 8000, 2.0  # samples until the control is switched on: the start-up of the primary path is over
SENSOR_NOISE = 0.01  # standard deviation of the microphone's noise over that of the disturbance
RATED_SHARE = 0.25  # rated power of KF-OPC over what the best fixed filter takes
NOISES = {
    "white": lambda seconds, seed: np.random.default_rng(seed).standard_normal(round(seconds * FS)),
    "band noise": lambda seconds, seed: band_limited_noise((100, 1000), seconds, fs=FS, rng=seed),
    "tone": lambda seconds, seed: tone(300.0, seconds, fs=FS, phase_rad=float(seed)),
    "compressor": lambda seconds, seed: compressor_noise(seconds, fs=FS, rng=seed),
    "bursts": lambda seconds, seed: bursty_noise(seconds, fs=FS, rng=seed),
}


def noisy_scene(plant, noise, seed):
    """Return a reference of power 1, and the plant with the noise of its microphone."""
    x = scaled_to_power(noise(DURATION_S + ON / FS, seed), 1.0)
    std = SENSOR_NOISE * float(np.sqrt(np.mean(plant.disturbance(x) ** 2)))
    return x, Plant(plant.secondary, plant.primary, fs=FS, sensor_noise_std=std)


@pytest.mark.parametrize(
    ("path", "noise"),
    [
        *(("band-pass", noise) for noise in ("white", "tone", "bursts")),
        *(("duct", noise) for noise in ("band noise", "compressor")),
    ],
)
@pytest.mark.filterwarnings("ignore::numpy.exceptions.RankWarning")
def test_no_setting_of_a_grid_is_better_by_half_a_decibel(path, noise):
    """Suggested from one run of the noise, compared on another: noise reduction and mean NSE of KF-ANC and KF-OPC.

    The grid has two lengths, each with its suggested q and P0, and multiples of its suggested r. A setting with which
    KF-OPC exceeds the rated power, and the power with the suggested ones, by 2 % is not counted: while the level changes,
    weights that lag behind the factor reduce more noise, with power that they should not take.
    """
    plant, lengths = modelled_plants()[path], (64, 128)
    silent, with_noise = noisy_scene(plant, NOISES[noise], 1)
    d = with_noise.disturbance(silent)[ON:]
    d = d + with_noise.sensor_noise_std * np.random.default_rng(5).standard_normal(d.size)
    heard = silent[ON:]
    suggested = suggest_settings(heard, plant, disturbance=d, max_taps=max(lengths))
    fixed = wiener_solution(heard, plant, n_taps=suggested.n_taps, disturbance=d, regularization=1e-6)
    rated = RATED_SHARE * fixed.control_power
    x, noisy = noisy_scene(plant, NOISES[noise], 2)

    def run(n_taps, noises):
        both = kf_anc(n_taps, plant, **noises), kf_opc(n_taps, plant, rated_power=rated, **noises)
        results = simulate(both, x, noisy, rng=6, switch_on_s=ON / FS)
        merits = [(one.noise_reduction_db, -np.mean(one.nse_db(0.05))) for one in results]
        return np.array(merits), results[1].output_power

    own, power = run(suggested.n_taps, suggested.noises)
    best = np.full((2, 2), -np.inf)
    for n_taps in lengths:
        at = suggest_settings(heard, plant, disturbance=d, n_taps=n_taps)
        for factor in (0.01, 1.0, 100.0):
            merits, used = run(n_taps, replace(at, state_noise=factor * at.state_noise).noises)
            best[0] = np.maximum(best[0], merits[0])
            if used <= 1.02 * max(power, rated):
                best[1] = np.maximum(best[1], merits[1])
    assert np.all(own > best - 0.5), f"{own} against {best}"
    assert np.all(own[0] > 5.0)  # there is something to lose
