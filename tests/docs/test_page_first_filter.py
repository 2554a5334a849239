"""What the tutorial from KalmanFilter to KFOPC says of its figures."""

from __future__ import annotations

import numpy as np
from helpers.pages import Page


def test_the_figures_say_what_the_page_says():
    v = Page("first_filter").run()
    power = {name: np.mean(drive[v.half] ** 2) for name, (drive, error) in v.runs.items()}
    assert np.array_equal(v.ours.x, v.theirs.x)
    assert np.array_equal(v.ours.P, v.theirs.P)
    assert np.abs(v.fast.x - v.theirs.x).max() < 1e-9
    assert v.slow > 3 * v.quick
    assert 7 < power["no rated power"] / 0.5 < 9
    assert 1.03 < power["KFOPC, rated power 0.5"] / 0.5 < 1.15
