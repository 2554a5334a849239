"""The loss map on a small scale, against batch least squares and the runs themselves."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from helpers.studies import run_study, smaller

from comparisons.bench import StudyReport
from comparisons.studies import kf_pb_cases, loss_map
from comparisons.studies.cases import FS, SENSOR_NOISE_DB
from comparisons.studies.kf_pb_cases import Rated, make_rated, noises
from kfopc_filterpy import Plant

TAPS, LONG = 12, 40
PLANT = Plant([0.0, 0.0, 1.0, -0.6, 0.2], [0.0] * 6 + [1.0, 0.5, 0.25], fs=FS)


@pytest.fixture(scope="module")
def report() -> Iterator[StudyReport]:
    """Few taps, one pair of short paths, no measured data."""
    with smaller(kf_pb_cases, N_TAPS=TAPS, all_plants=lambda: {"short": PLANT}), smaller(loss_map, LONG=LONG):
        yield run_study(loss_map)


def test_the_losses_lead_from_the_sensor_noise_to_what_is_left(report: StudyReport) -> None:
    for line in report.tables[1].rows:
        losses, left = np.array(line[2:8]), line[8]
        assert -SENSOR_NOISE_DB - losses.sum() == pytest.approx(left)
        assert losses[1] >= -0.05  # a longer filter is not worse: the record and the ridge are the same
        assert losses[2] > 1.0  # a quarter of the power
        assert abs(losses[4]) < 0.5  # the path is learned within the first second
        assert losses[5] > 0.0


def test_a_filter_with_any_power_is_that_of_batch_least_squares() -> None:
    """To 0.1 dB: the ridge, which least squares lacks, is 40 dB below the filtered reference."""
    case: Rated = make_rated(PLANT, noises()["band noise"][1](), 0.25)
    filtered = np.convolve(case.reference, PLANT.secondary[0, 0])[: case.reference.size]
    begin = case.disturbance.size - case.after.size
    rows = np.lib.stride_tricks.sliding_window_view(filtered, TAPS)[begin - TAPS + 1 :, ::-1]
    weights = np.linalg.lstsq(rows, case.after, rcond=None)[0]
    expected = case.reduction_db(case.after - rows @ weights)
    found = kf_pb_cases.with_any_power(case.reference, case.disturbance, PLANT, TAPS)
    assert case.reduction_db(found.error) == pytest.approx(expected, abs=0.1)
