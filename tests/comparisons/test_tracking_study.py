"""The study of tracking on a small scale, its scenes against plain convolutions, its claims."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.studies import plain_run, row_of, run_study, short_duct, smaller

from comparisons.studies import cases, tracking
from comparisons.studies import tracking_events as events
from comparisons.studies.tracking import TrackingRow
from comparisons.studies.tracking_events import CHIRP_HZ, SWEEP_S, change_scene, sweep
from kfopc_filterpy import Plant, noise_reduction_db
from kfopc_filterpy.metrics import convergence_time_s, overshoot

FS = 16000.0
TAPS = 16
STUDIED = ("KF-ANC", "KF-OPC", "KF-PB", "FxLMS", "MOV-FxLMS")


@pytest.fixture(scope="module")
def small() -> Any:
    """Few taps, one pair of paths cut short, a jump, a change and a sweep, two seeds, short runs."""
    short, names = short_duct(), ("20 dB louder", "sign", "one sweep")
    times = {"SEEDS": (1, 2), "JUMP_S": (0.4, 0.8), "JUMP_RUN_S": 1.6, "CHANGE_S": 0.5, "CHANGE_RUN_S": 1.2}
    own = {"ducts": lambda: short, "ALGORITHMS": STUDIED}
    with smaller(cases, N_TAPS=TAPS), smaller(events, **times), smaller(tracking, **own):
        chosen = [event for event in events.all_events() if event.name in names]
        with smaller(events, all_events=lambda: chosen):
            return run_study(tracking), events.scenes_of(chosen[0], short["duct"])


@pytest.mark.parametrize("algorithm", ["KF-ANC", "KF-PB"])
def test_a_row_is_that_of_plain_runs(small: Any, algorithm: str) -> None:
    report, scenes = small
    row = row_of(report, event="20 dB louder", algorithm=algorithm)
    results = [plain_run(scene, algorithm, row["setting"]) for scene in scenes]
    e, d, y = (np.array([getattr(r, name) for r in results]) for name in ("error", "disturbance", "control_signal"))
    rated = scenes[0].rated_power
    after = slice(round(0.8 * FS), round(1.6 * FS))
    assert row["noise_reduction_db"] == pytest.approx(noise_reduction_db(e, d, steady=1.0, runs=True), abs=1e-9)
    assert row["worst_window"] == pytest.approx(overshoot(y, rated, FS, window_s=0.1, runs=True), rel=1e-9)
    time = convergence_time_s(e[:, after], d[:, after], FS, window_s=0.05, runs=True)
    assert row["settled_s"]["back"] == (None if np.isnan(time) else pytest.approx(time))


# ---- Scenes


@pytest.fixture(scope="module")
def plant() -> Plant:
    """A delay with an echo, and a shorter delay."""
    primary, secondary = np.zeros(30), np.zeros(10)
    primary[[20, 25]] = 1.0, 0.5
    secondary[5] = 1.0
    return Plant(secondary, primary, fs=FS)


def test_a_sweep_has_the_frequencies_it_says() -> None:
    """Half a period lies between two zeros; the mean frequency there is that at its middle, the rise being linear."""
    x = sweep(CHIRP_HZ, SWEEP_S, FS)
    assert x.size == 4000
    assert x[0] == 0.0
    before = np.flatnonzero(x[1:-1] * x[2:] < 0) + 1
    zeros = (before + x[before] / (x[before] - x[before + 1])) / FS  # by linear interpolation
    frequency, middle = 0.5 / np.diff(zeros), 0.5 * (zeros[1:] + zeros[:-1])
    expected = CHIRP_HZ[0] + (CHIRP_HZ[1] - CHIRP_HZ[0]) * middle / SWEEP_S
    assert frequency.size > 400
    # Interpolation between samples a tenth of a period apart, at the worst: 1 % of half a period.
    assert np.max(np.abs(frequency / expected - 1.0)) < 0.02


def test_a_path_changes_at_its_sample(plant: Any) -> None:
    scene = change_scene(plant, 1, -plant.primary)
    d, one = scene.disturbances[0], plant.disturbance(scene.references[0])
    at = round(2.5 * FS)
    assert np.allclose(d[:at], one[:at], atol=1e-12)
    assert np.allclose(d[at:], -one[at:], atol=1e-12)


def test_claims_from_rows_made_by_hand() -> None:
    def row(event: str, algorithm: str, **more: Any) -> TrackingRow:
        figures: dict[str, Any] = {"mean_nse_db": -5.0, "worst_window": 30.0, "settled_s": {"changed": 0.1}}
        return TrackingRow(path="duct", noise="band noise", event=event, algorithm=algorithm, **figures | more)

    back = {"KF-ANC": 0.1, "KF-OPC": 1.2, "KF-PB": None, "FxLMS": 0.1, "MOV-FxLMS": 0.1}
    rows = [row("20 dB louder", name, settled_s={"back": time}) for name, time in back.items()]
    rows += [row("sign", "KF-ANC", mean_nse_db=-5.2, settled_s={"changed": 0.05}), row("sign", "FxLMS")]
    claims = tracking.claims(rows)
    assert [claim.value for claim in claims] == pytest.approx([0.0, -0.05, 30.0, 1.2, 0.1, np.inf])
    assert [claim.holds for claim in claims] == [True] * 5 + [False]
