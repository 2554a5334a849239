"""The study of rated powers on a small scale, and its tables and claims from rows made by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.studies import few_settings, run_study, short_duct, smaller

from comparisons.bench import StudyReport, run_setting, write_report
from comparisons.bench import registry as algorithms
from comparisons.studies import rated_powers
from comparisons.studies.cases import Case, make_case, noises
from comparisons.studies.rated_powers import BOUND, RECORD, SCALED, BudgetRow, _claims, mean_rows
from kfopc_filterpy import noise_reduction_db, output_power, power_constrained_wiener

TAPS, DURATION_S = 16, 1.0
CASE = Case("duct", "band noise")
SHARES = (-10.0, 0.0)


@pytest.fixture(scope="module")
def small() -> Any:
    """One case, two rated powers, two seeds of a second, 16 taps, three of each setting; the measured data away."""
    constants = {"N_TAPS": TAPS, "DURATION_S": DURATION_S, "SHARES_DB": SHARES, "SEEDS": (1, 2), "paths": short_duct}
    studied = (CASE, Case("measured duct", "motor"))
    with few_settings(), smaller(rated_powers, CASES=studied, **constants):
        pair, noise = short_duct()["duct"], noises()["band noise"]
        first, scene = (make_case(pair, noise(DURATION_S + 0.5, seed), n_taps=TAPS) for seed in (1, 2))
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
            scene.disturbances[0],
            scene.secondary,
            TAPS,
            0.1,
            fs=16000.0,
            switch_on_s=0.5,
            ridge=scene.measurement_noise / (scene.settled[0].size * scene.initial_variance),
        ).noise_reduction_over(0.5 * DURATION_S)
    return report, again, bound


def test_rows_are_what_plain_runs_give(small: Any) -> None:
    """The second seed, in the units of the first: both were tuned on."""
    rows = {(r["algorithm"], r["share_db"]): r for r in small[0].extra["rows"] if r["seed"] == 2}
    for name, result in small[1].items():
        row = rows[name, -10.0]
        assert row["noise_reduction_db"] == pytest.approx(
            noise_reduction_db(result.error, result.disturbance), rel=1e-9
        )
        assert row["power"] == pytest.approx(output_power(result.control_signal) / 0.1, rel=1e-9)
    # Outside its band the noise has no energy: there rounding decides about the weights.
    assert rows[BOUND, -10.0]["noise_reduction_db"] == pytest.approx(small[2]["whole"], rel=1e-6)
    assert rows[SCALED, -10.0]["noise_reduction_db"] == pytest.approx(small[2]["scaled"], rel=1e-6)
    assert set(rows) == {
        (name, share) for name in (*algorithms.algorithms(), BOUND, RECORD, SCALED) for share in SHARES
    }
    # without a constraint one run serves for all rated powers
    assert rows["FxLMS", -10.0]["power"] == pytest.approx(10 * rows["FxLMS", 0.0]["power"], rel=1e-12)


def test_the_report_is_complete(small: Any, tmp_path: Any) -> None:
    report: StudyReport = small[0]
    assert [table.stem for table in report.tables] == ["reduction"]
    assert len(report.tables[0].rows) == len(algorithms.algorithms()) + 3
    assert [figure.stem for figure in report.figures] == ["duct-band-noise"]
    assert len(report.claims) == 3
    assert report.notes[0].startswith("The measured duct was not at hand")
    write_report([report], tmp_path)
    assert (tmp_path / "tables" / "rated-powers-reduction.csv").stat().st_size > 0
    assert (tmp_path / "figures" / "rated-powers-duct-band-noise.png").stat().st_size > 10_000


def rows_of(name: str, reductions: Any, powers: Any = (1.0, 1.0), seed: int = 1) -> list[BudgetRow]:
    return [
        BudgetRow(
            path=CASE.path,
            noise=CASE.noise,
            share_db=share,
            seed=seed,
            algorithm=name,
            noise_reduction_db=reduction,
            power=power,
            worst_window=2.0,
        )
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


@pytest.mark.parametrize(
    ("own", "powers", "other", "other_powers", "expected"),
    [
        ((2.5, 11.5), (1.0, 1.0), (2.0, 11.0), (1.0, 1.0), [True, True, True]),
        ((2.5, 11.5), (0.5, 1.02), (2.0, 11.0), (1.0, 1.0), [True, True, True]),
        ((2.5, 11.5), (1.0, 1.021), (2.0, 11.0), (1.0, 1.0), [False, True, True]),
        ((2.01, 11.01), (1.0, 1.0), (2.0, 11.0), (1.0, 1.0), [True, True, True]),
        ((1.99, 11.5), (1.0, 1.0), (1.0, 11.0), (1.0, 1.0), [True, False, True]),
        ((2.5, 11.5), (1.0, 1.0), (2.79, 11.0), (1.02, 1.0), [True, True, True]),
        ((2.5, 11.5), (1.0, 1.0), (2.81, 11.0), (1.02, 1.0), [True, True, False]),
        ((2.5, 11.5), (1.0, 1.0), (2.81, 11.0), (1.021, 1.0), [True, True, True]),  # kept no budget
        ((2.5, np.nan), (1.0, np.nan), (2.0, 11.0), (1.0, 1.0), [False, False, False]),
    ],
)
def test_claims(own: Any, powers: Any, other: Any, other_powers: Any, expected: list[bool]) -> None:
    rows = (
        rows_of(BOUND, (3.0, 12.0))
        + rows_of(RECORD, (3.0, 12.0))
        + rows_of(SCALED, (2.0, 12.0))
        + rows_of("KF-PB", own, powers)
    )
    for name, algorithm in algorithms.algorithms().items():
        if name != "KF-PB" and algorithm.keeps_budget:
            rows += rows_of(name, other, other_powers)
    assert [claim.holds for claim in _claims(mean_rows(rows))] == expected
