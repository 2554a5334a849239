"""The study of rated powers on a small scale, and its tables and claims from rows made by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.studies import few_settings, run_study, short_duct, smaller

from comparisons.bench import registry as algorithms
from comparisons.bench import run_setting
from comparisons.studies import rated_powers
from comparisons.studies.cases import Case, make_case, noises
from comparisons.studies.rated_powers import BOUND, RECORD, SCALED, BudgetRow, _claims, mean_rows
from kfopc_filterpy import power_constrained_wiener

TAPS, DURATION_S = 16, 1.0
CASE = Case("duct", "band noise")
SHARES = (-10.0, 0.0)


@pytest.fixture(scope="module")
def small() -> Any:
    """One case, two rated powers, two seeds of a second, 16 taps, three of each setting; the measured data away."""
    constants = {
        "N_TAPS": TAPS,
        "DURATION_S": DURATION_S,
        "SHARES_DB": SHARES,
        "SHOWN_DB": SHARES[0],
        "SEEDS": (1, 2),
        "plants": short_duct,
    }
    studied = (CASE, Case("measured duct", "motor"))
    with few_settings(), smaller(rated_powers, CASES=studied, **constants):
        plant, noise = short_duct()["duct"], noises()["band noise"]
        first, scene = (make_case(plant, noise(DURATION_S + 0.5, seed), n_taps=TAPS) for seed in (1, 2))
        rated = replace(
            first,
            rated_power=0.1,
            references=[first.references[0], scene.references[0]],
            disturbances=[first.disturbances[0], scene.disturbances[0]],
            seeds=[1, 2],
        )
        report = run_study(rated_powers)
        settings = {row["algorithm"]: row["setting"] for row in report.extra["rows"] if row["share_db"] == -10.0}
        again = {name: run_setting(rated, name, settings[name], 1) for name in ("KF-OPC", "leaky FxLMS", "FxLMS")}
        bound = power_constrained_wiener(
            scene.references[0],
            plant,
            n_taps=TAPS,
            rated_power=0.1,
            switch_on_s=0.5,
            ridge=scene.measurement_noise / (scene.settled[0].size * scene.initial_variance),
        ).noise_reduction_over(0.5 * DURATION_S)
    return report, again, bound


def test_rows_are_what_plain_runs_give(small: Any) -> None:
    """The second seed, in the units of the first: both were tuned on."""
    rows = {(r["algorithm"], r["share_db"]): r for r in small[0].extra["rows"] if r["seed"] == 2}
    for name, result in small[1].items():
        row = rows[name, -10.0]
        assert row["noise_reduction_db"] == pytest.approx(result.noise_reduction_db, rel=1e-9)
        assert row["power"] == pytest.approx(result.output_power / 0.1, rel=1e-9)
    # Outside its band the noise has no energy: there rounding decides about the weights.
    assert rows[BOUND, -10.0]["noise_reduction_db"] == pytest.approx(small[2]["whole"], rel=1e-6)
    assert rows[SCALED, -10.0]["noise_reduction_db"] == pytest.approx(small[2]["scaled"], rel=1e-6)
    assert set(rows) == {
        (name, share) for name in (*algorithms.algorithms(), BOUND, RECORD, SCALED) for share in SHARES
    }
    # without a constraint one run serves for all rated powers
    assert rows["FxLMS", -10.0]["power"] == pytest.approx(10 * rows["FxLMS", 0.0]["power"], rel=1e-12)


def rows_of(name: str, reductions: Any, powers: Any = (1.0, 1.0), seed: int = 1) -> list[BudgetRow]:
    place: Any = {"path": CASE.path, "noise": CASE.noise, "seed": seed, "algorithm": name, "worst_window": 2.0}
    return [
        BudgetRow(share_db=share, noise_reduction_db=reduction, power=power, **place)
        for share, reduction, power in zip(SHARES, reductions, powers, strict=True)
    ]


def test_means_are_over_seeds_and_the_worst_window_is_the_worst() -> None:
    two = [
        *rows_of("KF-PB", (2.0, 12.0)),
        *(replace(r, worst_window=5.0) for r in rows_of("KF-PB", (4.0, np.nan), seed=2)),
    ]
    low, high = mean_rows(two)[CASE, "KF-PB"]
    assert (low.noise_reduction_db, low.worst_window) == (3.0, 5.0)
    assert np.isnan(high.noise_reduction_db)  # a seed that diverged is not left out


def test_claims_are_against_the_bound_and_the_best_that_keeps_the_budget() -> None:
    rows = rows_of(BOUND, (3.0, 12.0)) + rows_of("KF-PB", (2.5, 11.5), (0.9, 1.01))
    for name, algorithm in algorithms.algorithms().items():
        if name != "KF-PB" and algorithm.keeps_budget:
            rows += rows_of(name, (2.0, 11.0))
    rows += rows_of("MOV-FxLMS", (9.0, 11.6), (1.03, 1.0), seed=2)  # the mean of two seeds: 1.015 and 1
    claims = _claims(mean_rows(rows))
    assert [claim.value for claim in claims] == pytest.approx([1.01, 0.5, 3.0])
    assert [claim.holds for claim in claims] == [True, True, False]
    lost = [replace(row, power=1.1) if row.seed == 2 else row for row in rows]  # 1.05: kept no budget
    assert [claim.value for claim in _claims(mean_rows(lost))] == pytest.approx([1.01, 0.5, -0.5])
