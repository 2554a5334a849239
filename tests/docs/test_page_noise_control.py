"""What the tutorial that begins from scratch says of its figures."""

from __future__ import annotations

import numpy as np
from helpers.pages import Page

from kfopc_filterpy import convergence_time_s


def test_the_figures_say_what_the_page_says():
    page = Page("noise_control")

    v = page.run(until="Second attempt: a Kalman filter")
    assert np.abs(v.errors["LMS, reference not filtered"]).max() > 10
    assert np.abs(v.errors["filtered-x LMS"][-1000:]).max() < 0.02
    assert v.reduction(1, 5) < 20
    assert v.reduction(0, 60) < 1e-9
    assert 1e-5 < 5 / 360 / v.frequency < 1e-4

    v = page.run()
    time_s = {
        name: convergence_time_s(run.error, run.disturbance, v.fs, window_s=0.0025, tolerance_db=6)
        for name, run in v.results.items()
    }
    assert np.isnan(time_s["FxLMS, step 0.05"])
    assert v.results["FxLMS, step 0.05"].diverged_at_s is not None
    assert time_s["KF-ANC"] < 0.005
    assert 3 * time_s["KF-ANC"] < time_s["FxLMS, step 0.01"] < time_s["FxLMS, step 0.001"] / 10
