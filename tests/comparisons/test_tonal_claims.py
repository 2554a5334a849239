"""Claims on the paper's Fig. 5 from figures made by hand: on both sides of every threshold."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.results import single_result

from comparisons.studies import tonal
from comparisons.studies.tonal import LIMIT, Growth, growth_of
from kfopc_filterpy.bench import Claim

HARMONICS, PEAK, POWER, GROWTH, REDUCTION = range(5)  # the claims
LINE = Growth(over_optimal=600.0, over_half=2.0, of_quarters=1.0)
STILL = Growth(over_optimal=0.7, over_half=1.0, of_quarters=0.0)


def claim(
    which: int,
    figure: str = "harmonics_db",
    values: tuple[float | None, float | None] = (-8.5, -88.0),
    peak: float = 1.0,
    growths: Any = None,
    crossings: Any = (),
) -> Claim:
    """Return a claim on the one figure of merit, of KF-ANC and of KF-OPC, that it is about."""
    others: dict[str, float | None] = {"harmonics_db": -9.0, "output_power": 1.0, "noise_reduction_db": 9.0}
    merits = {name: others | {figure: own} for name, own in zip(("KF-ANC", "KF-OPC"), values, strict=True)}
    return tonal.claims(merits, peak, growths or {1e-8: (LINE, STILL)}, crossings)[which]


def growth_claim(growths: Any) -> Claim:
    return claim(GROWTH, growths=growths)


@pytest.mark.parametrize(
    ("anc_db", "opc_db", "held"),
    [
        (-30.0, -60.0, True),
        (-30.1, -88.0, False),  # KF-ANC as good as clean
        (-8.5, -59.9, False),
        (-8.5, -48.5, False),  # 40 dB below those of KF-ANC are harmonics still
        (np.nan, -88.0, False),
        (None, -88.0, False),
        (-8.5, np.nan, False),
    ],
)
def test_harmonics(anc_db: float | None, opc_db: float, held: bool) -> None:
    assert claim(HARMONICS, "harmonics_db", (anc_db, opc_db)).holds is held


@pytest.mark.parametrize(("share", "held"), [(1.009, True), (1.011, False), (np.nan, False)])
def test_peak(share: float, held: bool) -> None:
    assert claim(PEAK, peak=share * LIMIT).holds is held


@pytest.mark.parametrize(
    ("power", "held"), [(0.991, True), (1.009, True), (0.989, False), (1.011, False), (np.nan, False)]
)
def test_power(power: float, held: bool) -> None:
    """Not a constraint but an equality: too little is as wrong as too much."""
    assert claim(POWER, "output_power", (2.0, power)).holds is held


@pytest.mark.parametrize(
    ("anc_db", "opc_db", "held"), [(8.1, 10.7, True), (10.6, 10.7, True), (10.8, 10.7, False), (10.7, np.nan, False)]
)
def test_reduction(anc_db: float, opc_db: float, held: bool) -> None:
    flipping, same = (
        claim(REDUCTION, "noise_reduction_db", (anc_db, opc_db), crossings=own) for own in ([1.2, 4.6], [])
    )
    assert flipping.holds is same.holds is held
    assert "the order flips at 1.2 dB and 4.6 dB of overdrive" in flipping.measured
    assert "the same at every overdrive" in same.measured


@pytest.mark.parametrize(
    ("anc", "opc", "held"),
    [
        (Growth(10.1, 1.8, 0.91), STILL, True),
        (Growth(10.1, 1.8, 1.09), STILL, True),
        (Growth(9.9, 2.0, 1.0), STILL, False),  # not many times the optimum
        (Growth(600.0, 1.2, 0.89), STILL, False),  # comes to rest
        (Growth(600.0, 9.0, 1.11), STILL, False),  # faster than a line
        (LINE, Growth(0.7, 1.009, 0.0), True),
        (LINE, Growth(0.7, 0.991, 0.0), True),
        (LINE, Growth(0.7, 1.011, 1.0), False),
        (LINE, Growth(0.7, 0.989, 1.0), False),
        (Growth(np.nan, np.nan, np.nan), STILL, False),
        (LINE, Growth(np.nan, np.nan, np.nan), False),
    ],
)
def test_growth(anc: Growth, opc: Growth, held: bool) -> None:
    assert growth_claim({1e-8: (anc, opc)}).holds is held
    assert growth_claim({1e-8: (LINE, STILL), 1e-4: (anc, opc)}).holds is held  # at every state noise
    assert growth_claim({1e-8: (anc, opc), 1e-4: (LINE, STILL)}).holds is held


def of_weights(largest: Any) -> Any:
    """A run of three weights, of which the second one is the largest."""
    return single_result(weights=np.outer(largest, [0.5, -1.0, 0.0]))


def test_growth_of_a_line_of_a_constant_and_of_an_exponential() -> None:
    t = np.linspace(0.0, 1.0, 401)
    line = growth_of(of_weights(0.2 + 3.0 * t), optimal_weight=0.1)
    assert (line.over_optimal, line.over_half, line.of_quarters) == pytest.approx((32.0, 3.2 / 1.7, 1.0), rel=1e-12)
    still = growth_of(of_weights(np.full(401, 0.3)), optimal_weight=0.1)
    assert (still.over_optimal, still.over_half) == pytest.approx((3.0, 1.0), rel=1e-12)
    assert still.none
    assert not still.linear_without_bound
    exponential = growth_of(of_weights(np.exp(8.0 * t)), optimal_weight=0.1)
    assert exponential.of_quarters == pytest.approx(np.exp(4.0), rel=1e-12)
    assert not exponential.linear_without_bound
