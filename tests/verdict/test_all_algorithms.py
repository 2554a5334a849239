"""A verdict with all algorithms: each is tried with its settings, and the best of them runs."""

from __future__ import annotations

import numpy as np
import pytest

from kfopc_filterpy import Plant, fx_lms, fx_nlms, noise_reduction_db, simulate
from kfopc_filterpy.controllers.table import CORE
from kfopc_filterpy.metrics import nse_db
from kfopc_filterpy.signals import band_limited_noise
from kfopc_filterpy.verdict import assess
from kfopc_filterpy.verdict.candidates import CANDIDATES, ONE_CHANNEL
from kfopc_filterpy.verdict.runs import Plan
from kfopc_filterpy.verdict.verdict_page import settings_table

FS, TAPS = 8000, 16
NOISE = band_limited_noise((100, 1500), 3.0, fs=FS, rng=1, power=1.0)
PRIMARY, SECONDARY = np.eye(24)[14] + 0.4 * np.eye(24)[17], np.eye(12)[6]


def on(x=NOISE, primary=PRIMARY, secondary=SECONDARY, **options):
    options = {"rating": 100.0, "n_taps": TAPS, "beside": "all"} | options
    return assess(x, Plant(secondary, primary, fs=FS), **options)


@pytest.fixture(scope="module")
def verdict():
    return on()


def test_each_algorithm_runs_and_with_plenty_of_power_reduces_the_noise(verdict):
    assert set(verdict.figures) == set(CANDIDATES) <= set(CORE)
    for name, own in verdict.figures.items():
        assert own["noise_reduction_db"] > 6.0, name  # what a verdict wants by default


def test_the_step_that_runs_is_the_best_on_the_start_of_the_record(verdict):
    """It does better than half of it and twice it, in runs of its own."""
    d = np.convolve(NOISE, PRIMARY)[: NOISE.size]
    plan = Plan(NOISE, d, SECONDARY, FS, FS // 4, verdict.limits, verdict.settings, None, None)
    step = plan.best("FxLMS", verdict.limits)["step_size"]

    def mean_nse(step: float) -> float:
        own = fx_lms(TAPS, SECONDARY, step_size=step)
        run = simulate(own, NOISE, Plant(SECONDARY, fs=FS), disturbance=d, switch_on_s=0.25)
        return np.inf if run.diverged_at_s else float(np.nanmean(nse_db(run.error, run.disturbance, FS, 0.1)))

    assert mean_nse(step) == min(mean_nse(factor * step) for factor in (0.5, 1.0, 2.0))


def test_the_settings_that_ran_are_told(verdict):
    """The run again, from what the figures say."""
    assert verdict.figures["KF-PB"]["settings"] == {}  # nothing to choose
    settings = verdict.figures["FxNLMS"]["settings"]
    d = np.convolve(NOISE, PRIMARY)[: NOISE.size]
    own = fx_nlms(TAPS, SECONDARY, **settings)
    again = simulate(own, NOISE - NOISE.mean(), Plant(SECONDARY, fs=FS), disturbance=d, switch_on_s=0.3)
    reached = noise_reduction_db(again.error, again.disturbance)
    assert verdict.figures["FxNLMS"]["noise_reduction_db"] == pytest.approx(reached, abs=0.01)  # offsets are subtracted
    assert f"step_size={settings['step_size']:.6g}, regularization=" in "\n".join(settings_table(verdict).lines)


def test_with_several_channels_those_of_one_channel_and_the_slow_ones_are_left_out():
    x = np.stack([NOISE, band_limited_noise((100, 1500), 3.0, fs=FS, rng=2, power=1.0)])
    primary, secondary = np.zeros((2, 2, 24)), np.zeros((2, 2, 12))
    primary[:, :, 14], secondary[:, :, 6] = [[1.0, 0.3], [0.2, 0.8]], [[0.8, 0.1], [0.2, 0.9]]
    found = on(x, primary, secondary, n_taps=128, want_db=0.0)
    assert set(found.figures) == set(CANDIDATES) - set(ONE_CHANNEL) - {"KF-OPC", "KF-ANC"}
    assert (
        "KF-OPC and KF-ANC left out, because 512 weights take long: choose KF-OPC or KF-ANC as the algorithm, or 64 taps or "
        "fewer."
    ) in found.notes
