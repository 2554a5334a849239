"""The study of a secondary path that is known within a tolerance: small, and its claims."""

from __future__ import annotations

from itertools import count
from typing import Any

import numpy as np
import pytest
from helpers.simulation import Playing
from helpers.studies import run_study, smaller

from comparisons.bench import StudyReport
from comparisons.studies import uncertain_path
from comparisons.studies.uncertain_path import DEFAULT, IDENTIFIED, NOTHING, STATED, AllowanceRow, seconds_db
from kfopc_filterpy import Plant, simulate

PLANT = Plant([0.0, 0.0, 0.0, 1.0, -0.6], [0.0] * 8 + [0.8, 0.4], fs=16000)


@pytest.fixture(scope="module")
def report() -> StudyReport:
    """Few taps, two seconds, one pair of short paths, two noises, no measured data."""
    with smaller(uncertain_path, plants=lambda: {"duct": PLANT}, N_TAPS=16, DURATION_S=2.0):
        noises = uncertain_path.study_noises()
        assert list(noises) == ["compressor", "band noise", "wide band", "white", "high tone"]
        with smaller(uncertain_path, study_noises=lambda: {name: noises[name] for name in ("band noise", "white")}):
            return run_study(uncertain_path)


def test_the_default_costs_little_and_the_rated_power_is_kept(report: StudyReport) -> None:
    rows = [AllowanceRow(**row) for row in report.extra["rows"] if row["error"] == "exact" and row["noise"] == "white"]
    bare, allowing = rows
    assert (bare.allowance, allowing.allowance) == (NOTHING, DEFAULT)
    assert allowing.noise_reduction_db == pytest.approx(bare.noise_reduction_db, abs=0.5)
    assert bare.noise_reduction_db > 3.0
    assert bare.power == pytest.approx(1.0, abs=0.1)


def test_the_identified_path_is_near_the_true_one_and_within_its_uncertainty() -> None:
    taps, uncertainty = uncertain_path.known_paths(PLANT)[IDENTIFIED]
    true, found = np.fft.rfft([PLANT.secondary[0, 0], taps], 512)
    assert 0.0 < np.max(np.abs(true / found - 1)) < 0.02
    assert np.all(np.abs(true / found - 1) < uncertainty)


def test_each_second_counts_by_itself() -> None:
    x = np.ones(35)
    numbers = count()  # half of the reference is played until two seconds are over
    half = Playing(lambda reference: 0.5 * reference if next(numbers) < 20 else 0.0)
    result = simulate(half, x, Plant([1.0], fs=10), disturbance=x)
    assert seconds_db(result) == pytest.approx([20 * np.log10(2.0)] * 2 + [0.0])


def test_claims_from_rows_made_by_hand() -> None:
    def row(noise: str, error: str, allowance: str, reduction_db: float, **figures: Any) -> AllowanceRow:
        place = {"path": "duct", "noise": noise, "algorithm": "KF-PB", "error": error, "allowance": allowance}
        return AllowanceRow(**place, noise_reduction_db=reduction_db, **{"worst_second_db": 1.0} | figures)  # type: ignore[arg-type]

    rows = []
    for noise, cost in (("motor", 0.25), ("white", 0.75)):
        rows += [row(noise, "exact", NOTHING, 5.0), row(noise, "exact", DEFAULT, 5.0 - cost)]
        rows += [row(noise, IDENTIFIED, STATED, 4.5), row(noise, "a sample late", DEFAULT, 4.0)]
        rows.append(row(noise, "a sample late", STATED, np.nan, diverged_at_s=1.0))
    claims = uncertain_path.claims(rows)
    assert [claim.value for claim in claims] == pytest.approx([-1.0, np.inf, 0.25, 0.75, 0.5])
    assert [claim.holds for claim in claims] == [True, False, True, False, True]
    louder = {line[0]: line[1:] for line in uncertain_path.louder_table(rows).rows}
    assert louder == {STATED: [4, 2, np.inf], DEFAULT: [2, 0, -1.0]}
