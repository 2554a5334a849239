"""The figures that scripts draw for the pages: the order of the curves that the pages describe."""

from __future__ import annotations

import sys

import numpy as np
from helpers.pages import ROOT

sys.path.insert(0, str(ROOT / "docs"))

import overview
import page_figures


def test_what_keeps_the_rated_power_stays_below_the_bound(shared_data, monkeypatch):
    """6 dB above what the rated power can cancel, five seconds: the mean over half of them is within 10 %, that over ten seconds within 2 %."""
    monkeypatch.setenv("KFOPC_DATA", str(shared_data))
    overload = overview.Overload(5.0)
    runs = {name: overload.run(name, 6.0) for name in overview.ALGORITHMS}
    reduction_db, power = ({name: run[k] for name, run in runs.items()} for k in (0, 1))
    assert reduction_db["KF-ANC"] < reduction_db["KF-OPC"] < reduction_db["KF-PB"] - 3.0
    assert power["KF-PB"] < 1.1 < 1.5 < power["KF-OPC"] < power["KF-ANC"]
    assert reduction_db["KF-PB"] < overload.bound(6.0)


def test_kf_opc_exceeds_the_rated_power_and_kf_pb_keeps_it_and_reaches_the_bound():
    example = page_figures.WeakLoudspeaker()
    runs = example.runs()
    power = {name: np.mean(run.control_signal[run.n_samples // 2 :] ** 2) for name, run in runs.items()}
    assert power["KF-PB"] < 1.02 * page_figures.RATED_POWER < power["KF-OPC"]
    steady = slice(runs["KF-PB"].n_samples // 2, None)
    left = np.mean(runs["KF-PB"].error[steady] ** 2) / np.mean(runs["KF-PB"].disturbance[steady] ** 2)
    bound_db = example.bound(page_figures.RATED_POWER).whole.noise_reduction_db
    assert abs(-10 * np.log10(left) - bound_db) < 0.1


def test_a_guard_protects_and_costs_and_kf_pb_learns_the_path():
    found = page_figures.delayed_estimates((-1.0, 0.0, 1.0))
    early, right, late = np.transpose(
        [found[f"KF-OPC, {name}"] for name in ("taken as exact", "half a sample", "one sample")]
    )
    assert np.all(np.diff(early) > 0)
    assert np.all(np.diff(late) > 0)
    assert np.all(np.diff(right) < 0)
    assert np.ptp(found["KF-PB"]) < 0.5


def test_feedback_control_stays_below_the_bound_and_kf_pb_reaches_it():
    """The noise is correlated over 20 samples, and 5 s of it are judged: 0.3 dB."""
    found = page_figures.predictions((0, 3))
    np.testing.assert_allclose(found["KF-PB"], found["bound"], atol=0.3)
    assert np.all(np.array(found["bound"]) < found["closed form"])
    assert np.all(np.array(found["KF-OPC"]) < found["bound"])
