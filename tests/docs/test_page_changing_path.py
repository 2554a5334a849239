"""What the tutorial on paths that change says of its figures."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.pages import Page


@pytest.mark.slow
def test_the_figures_say_what_the_page_says() -> None:
    page = Page("changing_path")
    v = page.run(until="The drift")
    for name, errors in v.after_door.items():
        assert np.isnan(errors["alone"]).any()  # it diverges
        assert np.isfinite(errors["with PathTracker"]).all()
        anew = v.reduction_db(errors["made anew at 2 s"], 11, 12)
        assert v.reduction_db(errors["with PathTracker"], 11, 12) > anew - 1.0
        assert 2.0 < v.trackers[name].changes[0].time_s < 4.0  # a second or so
        assert np.mean(errors["with PathTracker"][:96000].reshape(-1, 800) ** 2, axis=1).max() < 10**0.65 * np.mean(
            v.d**2
        )
    v = page.run(until="KF-PB needs no tracker")
    assert np.isnan(v.alone).any()
    assert v.reduction_db(v.tracked, 21, 22) > v.reduction_db(v.anew, 21, 22) - 1.0
    v = page.run(until="If nothing changes")
    for path_at, seconds in ((v.door, 12), (v.drift, 22)):
        budgeted = v.kf_pb(v.n_taps, v.closed, rated_power=1e6, fs=v.fs)
        error = v.run(budgeted, path_at, seconds)
        assert budgeted.alarms == 1
        assert np.mean(error.reshape(-1, 800) ** 2, axis=1).max() < np.mean(v.d**2)  # never louder than without control
        assert v.reduction_db(error, seconds - 1, seconds) > 28.0
    assert 10.0 < v.reduction_db(error, 2, 12) < v.reduction_db(v.tracked, 2, 12) - 5.0  # during the drift
    v = page.run(until="Sound that returns to the reference microphone")
    assert 0.0 < v.loss < 0.06
    assert not v.tracker.changes  # of the last run, in which the primary path drifts
    assert v.moved > 25.0
    v = page.run()
    reduction = {name: v.reduction_db(run.error, 8, 10) for name, run in v.runs.items()}
    assert abs(reduction["without feedback"] - reduction["neutralised"]) < 0.5
    assert reduction["exposed"] < reduction["without feedback"] - 10.0
    assert not v.feedback_margin(v.neutral.control_filter, v.feedback, fs=v.fs).stable
    assert v.feedback_margin(v.neutral.control_filter, v.feedback, v.estimate, fs=v.fs).disk_margin > 1.9
    assert 0.0 < v.feedback_margin(v.exposed.control_filter, v.feedback, fs=v.fs).gain_margin_db < 0.1
