"""What the tutorial that reproduces the paper says of its figures."""

from __future__ import annotations

import numpy as np
from helpers.pages import Page

from comparisons.bench import figures_of_merit
from kfopc_filterpy import noise_reduction_db, output_power
from kfopc_filterpy.metrics import harmonics_db


def test_the_figures_say_what_the_page_says():
    page = Page("paper")

    v = page.run(until="Fig. 6: broadband noise")
    level = {name: noise_reduction_db(run.error, run.disturbance) for name, run in v.tonal.items()}
    harm = {name: harmonics_db(run.error, run.disturbance, 400.0, v.fs) for name, run in v.tonal.items()}
    anc, opc = v.tonal["KF-ANC"], v.tonal["KF-OPC"]
    assert level["FxLMS"] > level["KF-OPC"] > level["KF-ANC"] + 2
    assert harm["KF-OPC"] < harm["KF-ANC"] - 60
    assert np.abs(opc.control_signal).max() < 1.01 * v.scene.amplitude_limit
    assert abs(output_power(opc.control_signal) - 1) < 0.01
    assert anc.diverged_at_s is None
    weights = np.abs(anc.weights).max(axis=1)
    assert weights[-1] > 1.5 * weights[weights.size // 2]
    largest = {name: np.abs(run.weights).max(axis=1) for name, run in v.forgetful.items()}
    assert largest["KF-ANC"][-1] > 100 * v.needed
    assert largest["KF-OPC"][-1] < v.needed
    quarter = weights.size // 4
    gained = [largest["KF-ANC"][k * quarter] - largest["KF-ANC"][(k - 1) * quarter] for k in (2, 3)]
    assert abs(gained[1] / gained[0] - 1) < 0.1  # a straight line

    v = page.run(until="Fig. 7: machine noise in a duct")
    each = np.array([output_power(run.control_signal) for run in v.broadband["KF-OPC"]])
    times = {name: merit["convergence_time_s"] for name, merit in v.pooled.items()}
    assert np.all(np.abs(each / 0.8 - 1) < 0.01)
    assert v.both.coherence > 0.999
    assert abs(v.both.gain - 0.5) < 0.005
    assert times["KF-OPC"] <= times["KF-ANC"]
    assert 1.5 * times["KF-OPC"] < times["MOV-FxLMS"]
    assert abs(v.pooled["KF-ANC"]["output_power"] / 3.2 - 1) < 0.01
    assert max(v.pooled, key=lambda name: v.pooled[name]["noise_reduction_db"]) == "KF-ANC"

    v = page.run()
    merit = {name: figures_of_merit([run], v.scene) for name, run in v.machine.items()}
    power = {name: own["output_power"] / 0.5 for name, own in merit.items()}
    assert 1.2 < power["KF-OPC"] < 1.3
    assert 0.8 < power["MOV-FxLMS"] < 0.95
    assert power["KF-ANC"] > 3.5
    assert merit["KF-OPC"]["convergence_time_s"] < merit["MOV-FxLMS"]["convergence_time_s"]
    assert merit["KF-OPC"]["noise_reduction_db"] > merit["MOV-FxLMS"]["noise_reduction_db"]
    assert not v.tuned["KF-OPC"].within_budget
    assert v.tuned["MOV-FxLMS"].within_budget
