"""What the tutorial on the constraint factor says of its figures."""

from __future__ import annotations

import numpy as np
from helpers.pages import Page

from kfopc_filterpy import noise_reduction_db, output_power
from kfopc_filterpy.metrics import overshoot, power_spectrum_db
from kfopc_filterpy.paths import path_taps


def test_the_figures_say_what_the_page_says():
    page = Page("constraint_factor")

    v = page.run(until="What works instead")
    assert np.all(np.abs(v.flat - 1) < 0.01)
    assert v.ratios[0] > 3
    assert all(ratio > 1.2 for ratio in v.ratios)
    assert np.all(np.abs(np.log(np.array(v.ratios) / v.predicted)) < 0.25)
    S2, band_only = np.abs(np.fft.rfft(path_taps(v.duct.secondary), 8192)) ** 2, slice(51, 154)  # 100 to 300 Hz
    assert 1 / np.mean(1 / S2[band_only]) < np.mean(S2[band_only])

    v = page.run()
    level = {name: noise_reduction_db(run.error, run.disturbance) for name, run in v.runs.items()}
    power = {name: output_power(run.control_signal) / v.rated for name, run in v.runs.items()}
    assert power["KF-OPC"] > 1.25
    assert abs(power["KF-PB"] - 1) < 0.02
    assert v.reach["whole"] > level["KF-PB"] > v.reach["whole"] - 0.25
    assert overshoot(v.runs["KF-PB, limited"].control_signal, v.rated, v.fs, window_s=0.1) <= 1 + 1e-9
    spectra = {name: power_spectrum_db(v.runs[name].control_signal, v.fs)[1] for name in ("KF-OPC", "KF-PB")}
    for hz in (550, 1150):
        near = np.abs(v.f - hz) < 20
        assert spectra["KF-OPC"][near].mean() > spectra["KF-PB"][near].mean() + 4
