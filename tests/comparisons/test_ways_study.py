"""Ten ways to keep a rated power, on a short plant in place of the measured duct."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.studies import few_settings, run_study, smaller

from comparisons.bench.measured import MeasuredDuct
from comparisons.studies import duct, ways


def test_every_way_has_a_line_below_the_bound() -> None:
    noise = np.random.default_rng(0).standard_normal(16000)
    data = MeasuredDuct(np.eye(24)[16], np.array([0.0, 1.0, -0.6]), noise)
    with few_settings(), smaller(ways, at_hand=lambda *_: data, N_PRIMARY=32), smaller(duct, N_TAPS=24):
        table = run_study(ways).tables[0]
    assert [row[0] for row in table.rows] == ["bound", *ways.WAYS]
    bound, *lines = ([float(cell) for cell in row[4:]] for row in table.rows)
    for reduction_db, power, less_db, _ in lines:
        assert less_db < reduction_db
        # A power above the rated one may buy more than the bound; it is not above by much in any.
        assert reduction_db < bound[0] + 0.2 or power > 1.0
    found = dict(zip(ways.WAYS, lines, strict=True))
    assert found["KF-PB"][1] == pytest.approx(1.0, abs=0.05)
