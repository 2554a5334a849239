"""Claims of the constraint study with runs that diverged or did not settle: never counted as held."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.reports import study

from comparisons.studies import constraint
from comparisons.studies.constraint import ConstraintRow
from kfopc_filterpy.bench import Table, write_report
from kfopc_filterpy.signals import swelling


def row(**changed: Any) -> ConstraintRow:
    values: dict[str, Any] = {
        "path": "duct",
        "noise": "tone",
        "share": 0.25,
        "duration_s": 8.0,
        "seed": 1,
        "algorithm": "KF-PB",
        "noise_reduction_db": 10.0,
        "power": 1.0,
        "worst_window": 1.0,
        "bound_db": 10.0,
        "scaled_db": 9.0,
    }
    return ConstraintRow(**values | changed)


@pytest.mark.parametrize("claim", [constraint._steady_claim, constraint._varying_claim])
@pytest.mark.parametrize("first", [True, False])
def test_a_run_without_a_figure_is_not_held(claim: Any, first: bool) -> None:
    bad = row(power=np.nan, noise_reduction_db=np.nan)
    assert not claim([bad, row()] if first else [row(), bad]).holds
    assert claim([row(), row()]).holds


def test_a_limited_run_without_a_figure_is_not_held() -> None:
    rows = [
        row(algorithm="KF-PB limited"),
        row(algorithm="KF-OPC limited"),
        row(algorithm="KF-PB limited", seed=2, noise_reduction_db=np.nan, worst_window=np.nan),
        row(algorithm="KF-OPC limited", seed=2),
    ]
    assert not constraint._guarantee_claim(rows, [], []).holds
    assert not any(claim.holds for claim in constraint._transparency_claims(rows))


@pytest.mark.parametrize(
    ("ours", "theirs", "held"),
    [
        (1.0, 1.0, True),
        (1.6, 1.0, False),
        (np.nan, 1.0, False),
        (None, 1.0, False),
        (1.0, np.nan, True),
        (0.0, 1.0, True),
    ],
)
def test_what_does_not_settle_is_slower(ours: float | None, theirs: float, held: bool) -> None:
    settled = {"other": {"KF-PB": 0.5, "KF-ANC": 1.0}, "this": {"KF-PB": ours, "KF-ANC": theirs}}
    assert constraint._convergence_claim(settled).holds == held


def test_claims_and_cells_are_text_on_the_page(tmp_path: Any) -> None:
    table = Table("a", "A", ["x"], [[np.nan]])
    text = write_report([study(claims_heading="Aims <of> it", tables=[table])], tmp_path).read_text(encoding="utf-8")
    assert "<of>" not in text
    assert ">nan<" not in text


def test_ragged_tables_and_silent_noise_are_refused() -> None:
    with pytest.raises(ValueError, match="2 cells"):
        Table("a", "A", ["x", "y"], [[1.0]])
    with pytest.raises(ValueError, match="signal must not be all zeros"):
        swelling([0.0, 0.0], fs=8.0)
