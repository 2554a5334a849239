"""The figures of the pages on constraints and on uncertain paths: that what the pages say of them is so."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from kfopc_filterpy import OutputPowerConstraint, kf_opc, noise_reduction_db, output_power, simulate
from kfopc_filterpy.paths import PathTolerance, guard_filter

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs"))

import page_figures


def test_kf_opc_overshoots_and_kf_pb_reaches_the_bound():
    example = page_figures.WeakLoudspeaker()
    power, reduction = {}, {}
    for name, run in example.runs().items():
        power[name] = output_power(run.control_signal) / page_figures.RATED_POWER
        reduction[name] = noise_reduction_db(run.error, run.disturbance)
    bound = example.bound(page_figures.RATED_POWER)
    assert power == pytest.approx({"KF-OPC": 1.7, "KF-PB": 1.0}, abs=0.05)
    assert reduction["KF-PB"] == pytest.approx(bound.whole.noise_reduction_db, abs=0.1)


def test_a_guard_protects_and_costs_and_kf_pb_learns_the_path():
    found = page_figures.delayed_estimates((-1.0, 0.0, 1.0))
    exact, half, one = (
        np.array(found[f"KF-OPC, {name}"]) for name in ("taken as exact", "half a sample", "one sample")
    )
    early, right, late = np.transpose([exact, half, one])
    assert np.all(np.diff(early) > 1)
    assert np.all(np.diff(late) > 1)
    assert np.all(np.diff(right) < 0)
    assert max(early[0], late[0]) < 1
    assert np.ptp(found["KF-PB"]) < 0.5


def test_feedback_control_reaches_the_bound_within_the_rated_power():
    """The noise is correlated over 20 samples, and 5 s of it are judged: 0.3 dB."""
    found = page_figures.predictions((0, 3))
    assert found["KF-PB"] == pytest.approx(found["bound"], abs=0.3)
    assert np.all(np.array(found["bound"]) < found["closed form"])
    assert np.all(np.array(found["KF-OPC"]) < found["bound"])


def test_kf_opc_takes_three_times_its_rated_power_in_the_figure():
    secondary, limit = [0.0, 0.0, 0.0, 1.0, -0.6], OutputPowerConstraint(0.3, fs=8000.0)
    controller = kf_opc(24, secondary, constraint=limit, state_noise=1e-9, measurement_noise=1e-3)
    x = np.random.default_rng(1).standard_normal(40000)
    result = simulate(controller, x, primary_path=[0.0] * 8 + [0.8, 0.4], secondary_path=secondary, fs=8000.0)
    assert output_power(result.control_signal) / 0.3 == pytest.approx(3.0, abs=0.3)


def test_a_tone_gets_this_much_louder_under_a_guard_of_one_sample():
    omega = np.linspace(0.0, np.pi, 257)
    penalty = np.abs(np.fft.rfft(guard_filter(PathTolerance(delay_samples=1), [0.0, 0.0, 1.0, -0.6]), 512)) ** 2
    g = 1 / (1 + penalty)
    louder = 20 * np.log10((1 - g) / np.abs(1 + g * np.expm1(1j * omega)))
    assert louder.max() == pytest.approx(2.1, abs=0.05)
    assert 0.25 < np.argmax(louder) / 512 < 0.375  # of the sample rate
