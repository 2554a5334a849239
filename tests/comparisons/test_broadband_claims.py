"""Claims on the paper's Fig. 6 from figures made by hand, on both sides of every threshold, and what they rest on."""

from __future__ import annotations

import dataclasses
from math import erf, exp, pi, sqrt
from typing import Any

import numpy as np
import pytest
from helpers.results import single_result

from comparisons.bench import make_scene, with_clipping
from comparisons.studies import broadband
from comparisons.studies.broadband import FS
from comparisons.studies.broadband_clipped import KNOWING, UNAWARE
from comparisons.studies.report_parts import first_second_db
from comparisons.studies.weight_errors import WEIGHTS_EVERY, first_below_s, settled_after_s, weight_error


@pytest.mark.parametrize(
    ("powers", "held"),
    [
        ([1.004, 1.004], True),
        ([1.006, 1.006], False),  # the mean
        ([0.994, 0.994], False),
        ([0.986, 1.014], True),
        ([0.984, 1.016], False),  # one of them
        ([1.0, np.nan], False),
    ],
)
def test_power(powers: list[float], held: bool) -> None:
    assert broadband.power_claim(np.array(powers)).holds is held


@pytest.mark.parametrize(
    ("anc_db", "others_db", "power", "held"),
    [(6.1, 6.0, 1.51, True), (5.9, 6.0, 4.0, False), (50.0, 6.0, 1.49, False), (50.0, np.nan, 4.0, False)],
)
def test_best_reduction(anc_db: float, others_db: float, power: float, held: bool) -> None:
    for best_other in ("KF-OPC", "FxLMS", "MOV-FxLMS"):
        reductions = {"KF-ANC": anc_db, "KF-OPC": 1.0, "FxLMS": 1.0, "MOV-FxLMS": 1.0} | {best_other: others_db}
        powers = dict.fromkeys(reductions, 1.0) | {"KF-ANC": power}
        assert broadband.best_reduction_claim(reductions, powers).holds is held


@pytest.mark.parametrize(
    ("opc", "anc", "held"),
    [(1.09, 1.0, True), (1.11, 1.0, False), (np.nan, 1.0, False), (1.0, None, True), (None, None, False)],
)
def test_not_slower(opc: float | None, anc: float | None, held: bool) -> None:
    """None: it does not settle."""
    reached = dict.fromkeys(("KF-ANC", "KF-OPC", "MOV-FxLMS"), 0.0615)
    claim = broadband.not_slower_claim({"KF-ANC": anc, "KF-OPC": opc, "MOV-FxLMS": None}, reached)
    assert claim.holds is held
    assert claim.measured.endswith("MOV-FxLMS does not settle (first there after 61.5 ms)")


@pytest.mark.parametrize(
    ("opc", "mov", "held"),
    [(1.0, 2.01, True), (1.0, 1.99, False), (1.0, None, True), (None, None, False), (np.nan, 2.0, False)],
)
def test_twice_as_fast(opc: float | None, mov: float | None, held: bool) -> None:
    claim = broadband.faster_claim({"KF-ANC": 1.0, "KF-OPC": opc, "FxLMS": 1.0, "MOV-FxLMS": mov})
    assert claim.holds is held


@pytest.mark.parametrize(("coherence", "held"), [(0.991, True), (0.99, False), (np.nan, False)])
def test_linear(coherence: float, held: bool) -> None:
    assert broadband.linear_claim(coherence, 0.5, 6.0).holds is held


def clipped(**own: list[float]) -> dict[str, dict[str, Any]]:
    figures: dict[str, Any] = {
        "first_second_noise_reduction_db": [4.8, 4.7],
        "steady_noise_reduction_db": [4.6, 4.6],
        "peak_control_signal_of_the_whole_run": [3.9, 4.7],
        "output_power_of_each_seed": [0.79, 0.8],
        "clipped_fraction": 0.157,
    }
    return dict.fromkeys((UNAWARE, KNOWING), figures) | {"KF-OPC": figures | own}


@pytest.mark.parametrize(
    ("own", "held"),
    [
        ({"first_second_noise_reduction_db": [4.0, 4.8], "steady_noise_reduction_db": [5.0, 4.6]}, True),  # 1 dB less
        ({"first_second_noise_reduction_db": [4.8, 3.59]}, False),  # one seed will do
        ({"first_second_noise_reduction_db": [np.nan, 4.8]}, False),
        ({"steady_noise_reduction_db": [5.81, 4.6]}, False),
        ({"output_power_of_each_seed": [0.79, 0.815]}, True),
        ({"output_power_of_each_seed": [0.817, 0.79]}, False),
    ],
)
def test_clipped(own: dict[str, list[float]], held: bool) -> None:
    assert broadband.clipped_claim(clipped(**own), 1.265).holds is held


def test_the_first_second_is_a_whole_second_and_no_more() -> None:
    """Silent from 0.5 s on: 3 dB over the first second, 0 over its first half, 6 over the two seconds of the run."""
    fs = 1000.0
    error = np.r_[np.ones(500), np.zeros(1500)]
    run = single_result(2000, fs, error=error)
    assert first_second_db(run) == pytest.approx(10 * np.log10(2.0), abs=1e-12)


# ---- Weight error


def test_weight_error_is_the_missing_part_of_the_anti_noise() -> None:
    """Against the anti-noise itself, sample by sample, with coloured noise."""
    rng = np.random.default_rng(2)
    x = np.convolve(rng.standard_normal(50_000), [1.0, 0.8, 0.3])
    own, now = rng.standard_normal((2, 4))
    curve = weight_error(np.vstack([now, *[own] * 3]), x)
    missing, whole = np.convolve(x, now - own), np.convolve(x, own)
    assert curve[0] == pytest.approx(np.sum(missing**2) / np.sum(whole**2), rel=1e-9)


def test_times_at_which_a_curve_settles() -> None:
    step = WEIGHTS_EVERY / FS
    curve = np.array([1.0, 0.011, 0.009, 0.011, 0.0099, 0.001])
    steady = np.full(8, 0.001)
    assert settled_after_s(np.r_[curve, steady], -20.0) == 4 * step
    assert settled_after_s(np.r_[np.ones(8), steady], -20.0) == 8 * step
    assert settled_after_s(np.r_[np.ones(9), steady], -20.0) is None  # not for the second half of the run
    assert settled_after_s(np.r_[curve, np.nan], -20.0) is None
    assert settled_after_s(curve[4:], -20.0) == 0.0
    assert first_below_s(curve, -20.0) == 2 * step
    assert first_below_s(curve[:2], -20.0) is None


# ---- q with the clipping


def test_q_with_clipping_is_that_of_a_clipped_gaussian() -> None:
    """Flat paths, white noise: y is Gaussian, so Price's theorem gives what is clipped off and proportional to y."""
    noise = np.random.default_rng(3).standard_normal(200_000)
    scene = make_scene({0: noise}, [0.0, 1.0], [1.0], fs=FS, rated_power=0.8, power_multiple=4.0, n_taps=4)
    scene = dataclasses.replace(scene, sensor_noise_std=0.0)
    limited = with_clipping(scene)
    a = sqrt(2.0)  # the limit over the standard deviation of y
    tail, density = (1.0 - erf(a / sqrt(2.0))) / 2.0, exp(-(a**2) / 2.0) / sqrt(2.0 * pi)
    power = 2.0 * ((1.0 + a**2) * tail - a * density)  # E[(y - clip(y))^2] for a variance of 1
    unexplained = 0.8 * (power - (2.0 * tail) ** 2)
    assert limited.measurement_noise - scene.measurement_noise == pytest.approx(unexplained, rel=0.02)
    assert limited.amplifier(9.0) == pytest.approx(sqrt(1.6))
    assert scene.amplifier is None
