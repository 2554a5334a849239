"""The studies of the paper: claims on figures made by hand, and what the figures rest on."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from math import erf, exp, pi, sqrt
from typing import Any

import numpy as np
import pytest
from helpers.results import single_result
from helpers.studies import smaller

from comparisons.__main__ import FURTHER, STUDIES
from comparisons.bench import Claim, Runs, Tuned, make_scene, with_clipping
from comparisons.studies import broadband, duct, duct_start, tonal
from comparisons.studies.duct import Figures
from comparisons.studies.duct_start import Start
from comparisons.studies.weight_errors import WEIGHTS_EVERY, first_below_s, settled_after_s, weight_error
from comparisons.studies.weight_growth import Growth, growth_of
from kfopc_filterpy import Plant
from kfopc_filterpy.signals import band_limited_noise

FS = duct.FS

# ---- Claims: all hold on these figures, and then one that fails


def values(claims: list[Claim]) -> list[float]:
    return [claim.value for claim in claims]


def failed(claims: list[Claim]) -> list[int]:
    return [k for k, claim in enumerate(claims) if not claim.holds]


def test_claims_of_a_tone() -> None:
    merits = {
        "KF-ANC": {"harmonics_db": -8.5, "output_power": 2.0, "noise_reduction_db": 8.0},
        "KF-OPC": {"harmonics_db": -88.0, "output_power": 1.0, "noise_reduction_db": 10.5},
    }
    line, still = Growth(600.0, 2.0, 1.0), Growth(0.7, 1.0, 0.0)
    claims = tonal.claims(merits, 0.5 * tonal.LIMIT, {1e-8: (line, still)}, [1.2, 4.6])
    assert values(claims) == pytest.approx([-8.5, -88.0, 0.5, 1.0, 2.5, 600.0, 1.0, 1.0])
    assert failed(claims) == []
    assert claims[4].note == "the order flips at 1.2 dB and 4.6 dB of overdrive"
    lost: Any = merits | {"KF-ANC": dict.fromkeys(merits["KF-ANC"])}  # KF-ANC diverged
    assert failed(tonal.claims(lost, 0.5 * tonal.LIMIT, {1e-8: (still, line)}, [])) == [0, 4, 5, 6, 7]


def test_claims_of_broadband_noise() -> None:
    powers = {"KF-OPC": np.array([1.004, 0.996]), "KF-ANC": np.array([4.0, 4.0])}
    reductions = {"KF-ANC": 50.0, "KF-OPC": 6.0, "FxLMS": 40.0, "MOV-FxLMS": 6.0}
    settling = {"KF-ANC": 0.01, "KF-OPC": 0.01, "FxLMS": 0.05, "MOV-FxLMS": None}
    times = settling | {"MOV-FxLMS": 0.04}
    claims = broadband.claims(powers, reductions, settling, times, 0.999)
    assert values(claims) == pytest.approx([1.0, 0.004, 10.0, 4.0, -0.001, 0.02, 0.999])
    assert failed(claims) == []
    never = dict.fromkeys(settling)
    assert failed(broadband.claims(powers, reductions, never, never, np.nan)) == [4, 5, 6]


def test_claims_of_a_duct() -> None:
    usual = {"noise_reduction_db": 6.0, "mean_nse_db": -6.0, "power": 0.8, "worst_second": 1.0, "worst_50_ms": 1.5}
    figures = {name: Figures(**usual) for name in duct.ALGORITHMS}
    figures["KF-ANC"] = Figures(**usual | {"noise_reduction_db": 10.0, "power": 4.0})
    figures["KF-OPC"] = Figures(**usual | {"mean_nse_db": -6.5, "power": 0.9})
    reduction = {"KF-OPC": 6.5, "MOV-FxLMS": 5.0}
    start = Start(3.0, reduction, {"KF-OPC": 1.25, "MOV-FxLMS": 0.9}, 0.91, 4.5, 0.01, 0.02, 0.005, 0.02)
    claims = duct.claims(figures, start)
    assert values(claims) == pytest.approx([4.0, 4.0, 0.9, 1.0, -0.01, -0.015, -0.1, -0.5])
    assert failed(claims) == []
    figures["KF-OPC"] = replace(figures["KF-OPC"], power=1.3, mean_nse_db=np.nan)
    assert failed(duct.claims(figures, None)) == [
        2,
        4,
        5,
        6,
    ]  # without a second under the constraint there is one claim less


# ---- Weights


def of_weights(largest: Any) -> Any:
    """A run of three weights, of which the second one is the largest."""
    return single_result(weights=np.outer(largest, [0.5, -1.0, 0.0]))


def test_growth_of_a_line_of_a_constant_and_of_an_exponential() -> None:
    t = np.linspace(0.0, 1.0, 401)
    line = growth_of(of_weights(0.2 + 3.0 * t), optimal_weight=0.1)
    assert (line.over_optimal, line.over_half, line.of_quarters) == pytest.approx((32.0, 3.2 / 1.7, 1.0), rel=1e-12)
    still = growth_of(of_weights(np.full(401, 0.3)), optimal_weight=0.1)
    assert (still.over_optimal, still.over_half) == pytest.approx((3.0, 1.0), rel=1e-12)
    exponential = growth_of(of_weights(np.exp(8.0 * t)), optimal_weight=0.1)
    assert exponential.of_quarters == pytest.approx(np.exp(4.0), rel=1e-12)


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
    flat = Plant([1.0], [0.0, 1.0], fs=FS)
    scene = make_scene({0: noise}, flat, rated_power=0.8, power_multiple=4.0, n_taps=4)
    scene = dataclasses.replace(scene, sensor_noise_std=0.0)
    limited = with_clipping(scene)
    a = sqrt(2.0)  # the limit over the standard deviation of y
    tail, density = (1.0 - erf(a / sqrt(2.0))) / 2.0, exp(-(a**2) / 2.0) / sqrt(2.0 * pi)
    power = 2.0 * ((1.0 + a**2) * tail - a * density)  # E[(y - clip(y))^2] for a variance of 1
    unexplained = 0.8 * (power - (2.0 * tail) ** 2)
    assert limited.measurement_noise - scene.measurement_noise == pytest.approx(unexplained, rel=0.02)
    assert limited.amplifier(9.0) == pytest.approx(sqrt(1.6))
    assert scene.amplifier is None


# ---- The start


def test_the_first_second_below_one_is_found() -> None:
    factor = np.ones(45)
    assert duct_start.first_second_below_one(factor, 10.0) is None
    factor[12:35] = 0.9
    assert duct_start.first_second_below_one(factor, 10.0) == 2  # the second from 10 on begins with a factor of 1
    factor[10:12] = 0.999
    assert duct_start.first_second_below_one(factor, 10.0) == 1
    factor[0:45] = 0.5
    assert duct_start.first_second_below_one(factor, 10.0) == 0
    assert duct_start.first_second_below_one(np.full(9, 0.5), 10.0) is None  # not a whole second


@pytest.fixture(scope="module")
def scene() -> Any:
    noise = band_limited_noise((200.0, 1000.0), 3.0, fs=FS, rng=1)
    return make_scene(
        {1: noise}, Plant([0, 1.0], [0, 0, 0, 1.0], fs=FS), rated_power=0.5, power_multiple=4.0, n_taps=16
    )


def test_both_start_where_the_constraint_acts_and_with_equal_power(scene: Any) -> None:
    tuned = {name: Tuned(1e-6 if name.startswith("KF") else 0.003, True, False, []) for name in duct.RATED}
    factor = np.full(int(2.5 * FS), 0.6)
    factor[: int(0.2 * FS)] = 1.0
    found = duct_start.start_under_constraint(scene, tuned, factor)
    assert found is not None
    assert found.at_s == 1.0
    # Flat paths: the constraint factor is 1/2, so the power is the rated one, and the noise is reduced by 6 dB.
    assert found.power["KF-OPC"] == pytest.approx(1.0, abs=0.15)
    assert found.noise_reduction_db["KF-OPC"] == pytest.approx(6.0, abs=0.6)
    assert found.equal_power == pytest.approx(found.power["MOV-FxLMS"], rel=0.02)
    assert found.equal_power < 0.98 * found.power["KF-OPC"]
    assert found.equal_power_db < found.noise_reduction_db["KF-OPC"]
    assert duct_start.start_under_constraint(scene, tuned, np.ones(int(2.5 * FS))) is None


def test_the_common_level_is_that_of_the_lesser(scene: Any) -> None:
    d = scene.disturbances[0][: int(FS)]

    def course(at_s: float, reduction_db: float) -> Any:
        """A run that reduces the noise from a time on."""
        late = np.arange(d.size) >= at_s * FS
        return single_result(d.size, FS, error=np.where(late, d * 10 ** (-reduction_db / 20), d), disturbance=d)

    lesser, better = course(0.2, 5.0), course(0.1, 20.0)
    one, other = duct_start.times_to_a_common_level(lesser, better)
    assert duct_start.times_to_a_common_level(better, lesser) == (other, one)
    # At -4 dB most of the window has to be late for the lesser, and less of it for the better.
    assert 0.2 < one < 0.2 + duct_start.TIME_WINDOW_S + 1 / FS
    assert 0.1 < other < 0.1 + duct_start.TIME_WINDOW_S
    assert other - 0.1 < one - 0.2


# ---- Which noise


@pytest.mark.parametrize(
    ("name", "noise", "owner"),
    [
        ("duct-measured", "compressor", "author"),
        ("duct-second", "compressor", "gfanc"),
        ("duct-motor", "motor", "gfanc"),
    ],
)
def test_each_study_asks_for_its_duct_and_recording(name: str, noise: str, owner: str) -> None:
    main, _ = (STUDIES | FURTHER)[name]
    asked = []

    def unavailable(*what: str) -> None:
        asked.append(what)
        raise duct.DataUnavailableError("no file")

    with smaller(duct, load_measured_duct=unavailable):
        line = main(Runs())
    assert line.startswith(f"{name} is left out: set KFOPC_DATA to a folder with the measured data")
    assert line.endswith("(no file)")
    assert asked == [(noise, owner)]
