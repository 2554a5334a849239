"""What the tutorial on paths that change says of its figures."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.pages import Page


@pytest.mark.slow
def test_the_figures_say_what_the_page_says(capsys: pytest.CaptureFixture[str]) -> None:
    page = Page("changing_path")
    v = page.run(until="The drift")
    said = capsys.readouterr().out
    for name in v.makers:
        errors = v.after_door[name]
        assert np.isnan(errors["alone"]).any()  # it diverges
        anew = v.reduction_db(errors["made anew at 2 s"], 11, 12)
        assert v.reduction_db(errors["verified"], 11, 12) > anew - 1.0
        assert v.tenths_db(errors["verified"]).max() < 1.5  # hardly louder than without control
        assert f"{name}: [PathEvent(time_s=2.0" in said  # at once
    assert v.tenths_db(v.after_door["KF-PB"]["alone"]).max() < 0.0
    v = page.run(until="If the secondary path does not change")
    during = {label: v.reduction_db(error, 2, 12) for label, error in v.drift_errors.items()}
    for name, make in v.makers.items():
        assert np.isnan(v.drift_errors[name]).any()
        anew = v.reduction_db(v.made_anew(make, 12, 22), 21, 22)
        verified = v.drift_errors[f"{name} verified"]
        assert v.reduction_db(verified, 21, 22) > anew - 1.5  # nearly as good
        assert v.tenths_db(verified).max() < 1.0
        assert 5.0 < during[f"{name} verified"] < during["KF-PB"] - 1.0  # KF-PB reduces the noise most
    v = page.run(until="Sound that returns to the reference microphone")
    assert not v.checked.events
    assert abs(v.loss) < 0.05
    during = {label: v.reduction_db(error, 2, 12) for label, error in v.moved_errors.items()}
    for name in v.makers:
        assert abs(during[f"{name} verified"] - during[name]) < 0.5
    assert during["KF-PB"] < during["KF-ANC"] - 5.0
    assert " at " not in capsys.readouterr().out.split("nothing changes")[1]  # no event
    for error in v.moved_errors.values():
        assert v.reduction_db(error, 21, 22) > 28.0
    assert np.flatnonzero(np.isnan(v.walking["KF-ANC"]))[0] * 0.5 <= 4.0  # two seconds after the first step
    assert v.walking["KF-PB"].max() < 0.0
    lost = {name: v.walking[name][4:24].mean() - v.standing[name][4:].mean() for name in ("KF-PB", "FxLMS")}
    assert lost["FxLMS"] < lost["KF-PB"] - 5.0
    assert v.walking["KF-PB"][-1] < v.standing["KF-PB"][4:].mean() + 4.0
    assert min(-v.standing[name][4:].mean() for name in v.makers if name != "FxLMS") > 20.0
    assert -v.standing["FxLMS"][4:].mean() < 20.0
    v = page.run()
    reduction = {name: v.reduction_db(run.error, 8, 10) for name, run in v.runs.items()}
    assert abs(reduction["without feedback"] - reduction["neutralised"]) < 0.5
    assert reduction["exposed"] < reduction["without feedback"] - 10.0
    assert not v.feedback_margin(v.neutral.control_filter, v.feedback, fs=v.fs).stable
    assert v.feedback_margin(v.neutral.control_filter, v.feedback, v.estimate, fs=v.fs).disk_margin > 1.9
    assert 0.0 < v.feedback_margin(v.exposed.control_filter, v.feedback, fs=v.fs).gain_margin_db < 0.1
