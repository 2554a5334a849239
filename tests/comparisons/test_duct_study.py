"""The duct study: each claim from figures made by hand, both outcomes close to the threshold, and where it starts."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.studies import smaller

from comparisons.__main__ import FURTHER, STUDIES
from comparisons.bench import Claim, Runs, Tuned, make_controller, make_scene
from comparisons.studies import duct, duct_start
from comparisons.studies.duct import Figures
from comparisons.studies.duct_start import Start
from kfopc_filterpy.signals import band_limited_noise

FS = duct.FS
BEST, CONFINED, FASTER, NEARER, BETTER = range(5)  # the claims


def claim_of(which: int, start: Start | None = None, **changed: dict[str, float]) -> Claim:
    """Return a claim on figures of all algorithms; the arguments KF_ANC and so on change some of them."""
    usual = {"noise_reduction_db": 6.0, "mean_nse_db": -6.0, "power": 1.0, "worst_second": 1.0, "worst_50_ms": 1.5}
    figures = {name: Figures(**usual) for name in duct.ALGORITHMS}
    figures["KF-ANC"] = Figures(**usual | {"noise_reduction_db": 10.0, "power": 4.0})
    for name, own in ((name.replace("_", "-"), own) for name, own in changed.items()):
        figures[name] = replace(figures[name], **own)
    return duct.claims(figures, start)[which]


@pytest.mark.parametrize(
    ("which", "changed", "met"),
    [
        (BEST, {"KF_ANC": {"noise_reduction_db": 6.01, "power": 1.51}}, True),
        (BEST, {"KF_ANC": {"noise_reduction_db": 5.99, "power": 1.51}}, False),
        (BEST, {"KF_ANC": {"noise_reduction_db": 6.01, "power": 1.5}}, False),
        (BEST, {"KF_ANC": {"noise_reduction_db": np.nan, "power": np.nan}}, False),
        (BEST, {"KF_PB": {"noise_reduction_db": 20.0}}, True),  # not of the paper
        *((BEST, {rival: {"noise_reduction_db": 10.1}}, False) for rival in ("KF_OPC", "FxLMS", "MOV_FxLMS")),
        (CONFINED, {"KF_OPC": {"power": 1.02, "worst_second": 1.1, "worst_50_ms": 9.0}}, True),  # the last is only told
        (CONFINED, {"KF_OPC": {"power": 1.021}}, False),
        (CONFINED, {"KF_OPC": {"worst_second": 1.101}}, False),
        (CONFINED, {"KF_OPC": {"power": np.nan}}, False),
        (NEARER, {"KF_OPC": {"power": 1.25}, "MOV_FxLMS": {"power": 0.74}}, True),
        (NEARER, {"KF_OPC": {"power": 0.74}, "MOV_FxLMS": {"power": 1.25}}, False),
        (NEARER, {"KF_OPC": {"power": 1.25}, "MOV_FxLMS": {"power": 0.75}}, False),
        (NEARER, {"KF_OPC": {"power": np.nan}}, False),
        (BETTER, {"KF_OPC": {"mean_nse_db": -6.1, "noise_reduction_db": 5.9}}, True),
        (BETTER, {"KF_OPC": {"mean_nse_db": -6.0, "noise_reduction_db": 6.1}}, False),
        (BETTER, {"KF_OPC": {"mean_nse_db": np.nan}}, False),
    ],
)
def test_claims_on_both_sides_of_each_threshold(which: int, changed: Any, met: bool) -> None:
    assert claim_of(which, **changed).holds is met


@pytest.mark.parametrize(
    ("time_s", "equal_time_s", "met"),
    [(0.0199, 0.0099, True), (0.0199, 0.0100, False), (0.0200, 0.0099, False), (np.inf, 0.0099, False)],
)
def test_faster_is_sooner_at_equal_power_too(time_s: float, equal_time_s: float, met: bool) -> None:
    start = Start(
        at_s=3.0,
        noise_reduction_db={"KF-OPC": 6.5, "MOV-FxLMS": 5.0},
        power={"KF-OPC": 1.25, "MOV-FxLMS": 0.9},
        equal_power=0.91,
        equal_power_db=4.5,
        time_s=time_s,
        mov_time_s=0.020,
        equal_time_s=equal_time_s,
        mov_equal_time_s=0.010,
    )
    assert claim_of(FASTER, start).holds is met


def test_without_a_second_under_the_constraint_nothing_is_claimed() -> None:
    claim = claim_of(FASTER)
    assert not claim.holds
    assert claim.measured.startswith("not tested")


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
    return make_scene({1: noise}, [0, 0, 0, 1.0], [0, 1.0], fs=FS, rated_power=0.5, power_multiple=4.0, n_taps=16)


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
        return SimpleNamespace(error=np.where(late, d * 10 ** (-reduction_db / 20), d), disturbance=d)

    lesser, better = course(0.2, 5.0), course(0.1, 20.0)
    one, other = duct_start.times_to_a_common_level(lesser, better)
    assert duct_start.times_to_a_common_level(better, lesser) == (other, one)
    # At -4 dB most of the window has to be late for the lesser, and less of it for the better.
    assert 0.2 < one < 0.2 + duct_start.TIME_WINDOW_S + 1 / FS
    assert 0.1 < other < 0.1 + duct_start.TIME_WINDOW_S
    assert other - 0.1 < one - 0.2


# ---- Which noise


@pytest.mark.parametrize(("name", "noise"), [("duct-measured", "compressor"), ("duct-motor", "motor")])
def test_each_study_asks_for_its_recording(name: str, noise: str) -> None:
    main, _ = (STUDIES | FURTHER)[name]
    asked = []

    def unavailable(noise: str) -> None:
        asked.append(noise)
        raise duct.DataUnavailableError("no file")

    with smaller(duct, load_measured_duct=unavailable):
        line = main(Runs())
    assert line.startswith(f"{name} is left out: set KFOPC_DATA to a folder with the measured data")
    assert line.endswith("(no file)")
    assert asked == [noise]


def test_figures_are_over_the_rated_power(scene: Any) -> None:
    result = scene.run(make_controller(scene, "KF-OPC", 1e-6))
    once, twice = (duct.figures_of(result, power) for power in (0.5, 0.25))
    half = result.control_signal.size // 2
    assert once.power == pytest.approx(np.mean(result.control_signal[half:] ** 2) / 0.5, rel=1e-3)
    assert (
        replace(once, power=2 * once.power, worst_second=2 * once.worst_second, worst_50_ms=2 * once.worst_50_ms)
        == twice
    )
    assert once.worst_50_ms > once.worst_second
