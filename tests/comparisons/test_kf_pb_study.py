"""The study of KF-PB on a small scale: a report that is complete, and rows that say what a run of one's own says."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from helpers.studies import run_study, smaller

from comparisons.bench import StudyReport
from comparisons.studies import kf_pb as study
from comparisons.studies import kf_pb_cases
from comparisons.studies.cases import FS
from kfopc_filterpy import Plant, kf_pb, noise_reduction_db, simulate

pytestmark = pytest.mark.slow  # the run of the small study takes longest of all, and no other test needs it

PLANT = Plant([0.0, 0.0, 1.0, -0.6, 0.2], [0.0] * 6 + [1.0, 0.5, 0.25], fs=FS)
SMALL = {"N_TAPS": 16, "SILENT_S": 1.0, "DURATION_S": 5.0, "SHARES": (0.25,)}


@pytest.fixture(scope="module")
def report() -> Iterator[StudyReport]:
    """Few taps, short runs, one pair of short paths, one setting of MOV-FxLMS, no measured data."""
    settings = {"STEPS": np.array([0.01]), "PENALTIES": np.array([1.0])}
    own = {"JUMPS": {"12 dB louder from 3 s on": (12.0, 3.0, 5.0)}, "all_plants": lambda: {"short": PLANT}}
    with smaller(kf_pb_cases, **SMALL, **own), smaller(study, **settings):
        yield run_study(study)


def test_a_row_is_what_a_run_of_ones_own_says(report: StudyReport) -> None:
    row = next(row for row in report.extra["rows"] if row["noise"] == "band noise")
    case = kf_pb_cases.make_rated(PLANT, kf_pb_cases.noises()["band noise"][1](), 0.25)
    controller, bare = kf_pb(16, PLANT, rated_power=case.rated_power), Plant(PLANT.secondary, fs=FS)
    result = simulate(controller, case.reference, bare, disturbance=case.disturbance, switch_on_s=1.0)
    late = slice(round(FS), round(5.0 * FS))
    expected = noise_reduction_db(result.error[late], result.disturbance[late], steady=1.0)
    assert row["noise_reduction_db"] == pytest.approx(expected)
    assert row["noise_reduction_db"] > 3.0
