"""Claims on the paper's Fig. 5 from figures made by hand: on both sides of every threshold."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.results import single_result

from comparisons.bench import Claim
from comparisons.studies import tonal
from comparisons.studies.tonal import LIMIT, Growth, growth_of

HARMONICS, PEAK, POWER, GROWTH, REDUCTION = range(5)  # the claims
LINE = Growth(over_optimal=600.0, over_half=2.0, of_quarters=1.0)
STILL = Growth(over_optimal=0.7, over_half=1.0, of_quarters=0.0)


def claim(which: int, *, peak: float = 1.0, growths: Any = None, crossings: Any = (), **of_anc_and_opc: Any) -> Claim:
    """Return a claim; a figure of merit is given for KF-ANC and for KF-OPC."""
    figures = {"harmonics_db": (-8.5, -88.0), "output_power": (2.0, 1.0), "noise_reduction_db": (8.1, 10.7)}
    figures |= of_anc_and_opc
    merits = {name: {key: own[k] for key, own in figures.items()} for k, name in enumerate(("KF-ANC", "KF-OPC"))}
    return tonal.claims(merits, peak, growths or {1e-8: (LINE, STILL)}, crossings)[which]


@pytest.mark.parametrize(
    ("which", "changed", "held"),
    [
        (HARMONICS, {"harmonics_db": (-30.0, -60.0)}, True),
        (HARMONICS, {"harmonics_db": (-30.1, -88.0)}, False),  # KF-ANC as good as clean
        (HARMONICS, {"harmonics_db": (-8.5, -59.9)}, False),
        (HARMONICS, {"harmonics_db": (None, -88.0)}, False),
        (HARMONICS, {"harmonics_db": (-8.5, np.nan)}, False),
        (PEAK, {"peak": 1.009 * LIMIT}, True),
        (PEAK, {"peak": 1.011 * LIMIT}, False),
        (POWER, {"output_power": (2.0, 0.991)}, True),
        (POWER, {"output_power": (2.0, 1.009)}, True),
        (POWER, {"output_power": (2.0, 0.989)}, False),  # too little is as wrong as too much
        (POWER, {"output_power": (2.0, 1.011)}, False),
        (POWER, {"output_power": (2.0, np.nan)}, False),
        (REDUCTION, {"noise_reduction_db": (10.6, 10.7)}, True),
        (REDUCTION, {"noise_reduction_db": (10.8, 10.7)}, False),
        (REDUCTION, {"noise_reduction_db": (10.7, np.nan)}, False),
    ],
)
def test_claims_on_both_sides_of_each_threshold(which: int, changed: Any, held: bool) -> None:
    assert claim(which, **changed).holds is held


def test_where_the_order_flips_is_told() -> None:
    assert "the order flips at 1.2 dB and 4.6 dB" in claim(REDUCTION, crossings=[1.2, 4.6]).measured
    assert "the same at every overdrive" in claim(REDUCTION).measured


@pytest.mark.parametrize(
    ("anc", "opc", "held"),
    [
        (Growth(10.1, 1.8, 0.91), STILL, True),
        (Growth(10.1, 1.8, 1.09), STILL, True),
        (Growth(9.9, 2.0, 1.0), STILL, False),  # not many times the optimum
        (Growth(600.0, 1.2, 0.89), STILL, False),  # comes to rest
        (Growth(600.0, 9.0, 1.11), STILL, False),  # faster than a line
        (LINE, Growth(0.7, 1.009, 0.0), True),
        (LINE, Growth(0.7, 1.011, 1.0), False),
        (LINE, Growth(0.7, 0.989, 1.0), False),
        (Growth(np.nan, np.nan, np.nan), STILL, False),
    ],
)
def test_growth(anc: Growth, opc: Growth, held: bool) -> None:
    for growths in ({1e-8: (LINE, STILL), 1e-4: (anc, opc)}, {1e-8: (anc, opc), 1e-4: (LINE, STILL)}):
        assert claim(GROWTH, growths=growths).holds is held  # at every state noise


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
