"""What the tutorial on several loudspeakers says of its figures."""

from __future__ import annotations

import numpy as np
from helpers.pages import Page

from kfopc_filterpy import noise_reduction_db, output_power


def test_the_figures_say_what_the_page_says():
    v = Page("many_loudspeakers").run()
    free, budgeted, scaled = (noise_reduction_db(run.error, run.disturbance) for run in (v.free, v.budgeted, v.scaled))
    assert free > 12
    assert free > budgeted + 4 > scaled + 5  # between the two, well above the scaled filters
    np.testing.assert_allclose(v.spent, 1.0, atol=0.03)
    assert np.all(v.controller.power_weight > 0.1)  # every budget binds
    np.testing.assert_allclose(output_power(v.scaled.control_signal) / v.rated, 1.0, atol=0.1)
    steps = v.enough.rated_power[1:] / v.enough.rated_power[:-1]
    assert np.all((steps > 2) & (steps < 4))  # three decibels more
    tried, later = (np.mean(v.two.control_signal[1, part] ** 2) for part in (slice(v.fs), slice(v.fs, None)))
    assert tried > 0.1 * v.rated[1] > 10 * later
    assert 1 < noise_reduction_db(v.two.error, v.two.disturbance) < budgeted
