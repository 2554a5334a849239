"""The study of a secondary path that is known within a tolerance: small, and its claims from rows made by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.studies import run_study, smaller

from comparisons.bench import StudyReport
from comparisons.studies import uncertain_path
from comparisons.studies.uncertain_path import (
    DEFAULT,
    IDENTIFIED,
    NOTHING,
    STATED,
    AllowanceRow,
    claims,
    seconds_db,
)
from kfopc_filterpy import SimulationResult, simulate

PRIMARY, SECONDARY = np.array([0.0] * 8 + [0.8, 0.4]), np.array([0.0, 0.0, 0.0, 1.0, -0.6])


@pytest.fixture(scope="module")
def report() -> StudyReport:
    """Few taps, two seconds, one pair of short paths, two noises, no measured data."""
    with smaller(uncertain_path, paths=lambda: {"duct": (PRIMARY, SECONDARY)}, N_TAPS=16, DURATION_S=2.0):
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
    taps, uncertainty = uncertain_path.known_paths((PRIMARY, SECONDARY))[IDENTIFIED]
    true, found = np.fft.rfft([SECONDARY, taps], 512)
    assert 0.0 < np.max(np.abs(true / found - 1)) < 0.02
    assert np.all(np.abs(true / found - 1) < uncertainty)


def test_each_second_counts_by_itself() -> None:
    x = np.ones(35)
    result: SimulationResult = simulate(_Half(), x, disturbance=x, secondary_path=[1.0], fs=10.0)
    assert seconds_db(result) == pytest.approx([20 * np.log10(2.0)] * 2 + [0.0])


class _Half:
    """Plays half of the reference until it has heard two seconds."""

    def __init__(self) -> None:
        self.n = 0

    def control_signal(self, reference: float) -> float:
        self.n += 1
        return 0.5 * reference if self.n <= 20 else 0.0

    def update(self, error: float) -> None:
        pass


# ---- Claims on rows made by hand


def row(noise: str = "white", error: str = "a sample late", allowance: str = DEFAULT, **figures: Any) -> AllowanceRow:
    place = {"path": "duct", "noise": noise, "algorithm": "KF-PB", "error": error, "allowance": allowance}
    return AllowanceRow(**place, **{"noise_reduction_db": 5.0, "worst_second_db": 1.0, "power": 1.0} | figures)


GOOD = [
    *(
        row(noise, error, allowance, noise_reduction_db=5.0 if allowance == NOTHING else 4.6)
        for noise in ("motor", "white")
        for error, allowance in (
            ("exact", NOTHING),
            ("exact", DEFAULT),
            ("a sample late", DEFAULT),
            ("a sample late", STATED),
            (IDENTIFIED, STATED),
        )
    ),
    row(allowance=NOTHING, worst_second_db=-7.0),
]


@pytest.mark.parametrize(
    ("at", "figures", "finding"),
    [
        (2, {"worst_second_db": -0.1}, 0),
        (2, {"diverged_at_s": 1.0}, 0),
        (3, {"worst_second_db": np.nan}, 1),
        (1, {"noise_reduction_db": 4.4}, 2),
        (6, {"noise_reduction_db": 4.4}, 3),
        (6, {"noise_reduction_db": np.nan, "diverged_at_s": 1.0}, 3),
        (4, {"noise_reduction_db": 4.4}, 4),
        (9, {"noise_reduction_db": 4.4}, 4),
    ],
)
def test_each_finding_fails_alone(at: int, figures: dict[str, Any], finding: int) -> None:
    assert all(claim.holds for claim in claims(GOOD))
    changed = [replace(one, **figures) if n == at else one for n, one in enumerate(GOOD)]
    assert [n for n, claim in enumerate(claims(changed)) if not claim.holds] == [finding]
