"""What the tutorial on saturation says of its figures."""

from __future__ import annotations

import numpy as np
from helpers.pages import Page

from kfopc_filterpy import kf_anc, noise_reduction_db, output_power, simulate
from kfopc_filterpy.metrics import harmonics_db


def test_the_figures_say_what_the_page_says():
    page = Page("saturation")

    v = page.run(until="Two remedies")
    anc, opc = v.anc, v.opc
    largest = np.abs(anc.weights).max(axis=1)
    assert v.difference[32:].max() < 0.01
    assert largest[-1] > 1.5 * largest[largest.size // 2]
    assert np.abs(opc.weights[-1]).max() < 1.01 * np.abs(opc.weights[50]).max()
    assert anc.disturbance_power[-1] > 50 * np.mean(anc.disturbance**2)
    assert output_power(anc.control_signal) > 50
    faster = simulate(kf_anc(128, v.secondary, **v.settings | {"state_noise": 1e-9}), v.x, **v.plant)
    assert output_power(faster.control_signal) > 5 * output_power(anc.control_signal)

    v = page.run(until="Is the constraint always better?")
    level = {name: noise_reduction_db(run.error, run.disturbance) for name, run in v.runs.items()}
    assert level["KF-ANC, amplifier known"] > level["KF-OPC"] + 2 > level["KF-ANC"] + 4
    assert abs(level["KF-ANC, amplifier known"] - level["KF-ANC, limit 20 % too high"]) < 0.5
    assert output_power(v.known.control_signal) < 2.1
    assert harmonics_db(opc.error, opc.disturbance, 400.0, v.fs) < -80

    v = page.run()
    assert v.overdrive_db[v.lead > 0].tolist() == [2.0, 3.0, 4.0]
