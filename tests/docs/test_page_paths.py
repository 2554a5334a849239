"""What the tutorial on paths says of its figures."""

from __future__ import annotations

import numpy as np
from helpers.pages import Page

from kfopc_filterpy import noise_reduction_db, nse_db


def test_the_figures_say_what_the_page_says():
    page = Page("paths")

    v = page.run(until="How much amplifier power?")
    late = np.array(v.margins_ms) < 0
    levels = {name: np.array(values) for name, values in v.reachable.items()}
    assert all(np.all(levels[name][~late] > 24) for name in levels)
    assert np.all(levels["noise, 100-1500 Hz"][-2:] < 4)
    assert np.all(levels["compressor"][late] < 9)
    assert np.all(levels["tone"][late] > 57)
    assert np.sum(late) == 3

    v = page.run(until="How well is the path known?")
    share = v.needed.rated_power / v.solution.control_power
    assert abs(share[0] - 0.25) < 0.01
    assert 0.45 < share[1] < 0.5

    v = page.run()
    level = {key: noise_reduction_db(run.error, run.disturbance) for key, run in v.runs.items()}
    highest = {key: np.nanmax(nse_db(run.error, run.disturbance, v.fs, 0.05)) for key, run in v.runs.items()}
    assert level[2, 1e-3] < -20
    assert v.runs[3, 1e-3].diverged_at_s
    assert level[3, 1e-1] < -20
    assert abs(level[2, 1e-1] - level[0, 1e-1]) < 1
    assert highest[1, 1e-3] > 30
    assert highest[1, 1e-1] < 1
    assert v.identified["640 taps"].misalignment_db < -50
    assert v.loud.misalignment_db > -12
