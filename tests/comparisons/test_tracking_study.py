"""The study of tracking on a small scale, its scenes against plain convolutions, its claims from rows made by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from comparisons import __main__ as command
from comparisons.studies import cases, tracking
from comparisons.studies import tracking_events as events
from comparisons.studies.tracking import TrackingRow
from comparisons.studies.tracking_events import (
    CHIRP_HZ,
    SWEEP_S,
    Event,
    change_scene,
    jump_scene,
    sweep,
    sweep_scene,
)
from kfopc_filterpy import convergence_time_s, noise_reduction_db, simulate
from kfopc_filterpy.bench import Runs, StudyReport, make_controller
from kfopc_filterpy.metrics import overshoot

FS = 16000.0
TAPS = 16
STUDIED = ("KF-ANC", "KF-OPC", "KF-PB", "FxLMS", "MOV-FxLMS")


@pytest.fixture(scope="module")
def small() -> Any:
    """Few taps, one pair of paths cut short, a jump, a change and a sweep, two seeds, short runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("KFOPC_DATA", "/no/such/folder")
        cases.measured_data.cache_clear()
        short = {"duct": tuple(path[:200] for path in cases.ducts()["duct"])}
        patch.setattr(cases, "N_TAPS", TAPS)
        patch.setattr(tracking, "ducts", lambda: short)
        patch.setattr(tracking, "ALGORITHMS", STUDIED)
        patch.setattr(events, "SEEDS", (1, 2))
        patch.setattr(events, "JUMP_S", (0.4, 0.8))
        patch.setattr(events, "JUMP_RUN_S", 1.6)
        patch.setattr(events, "CHANGE_S", 0.5)
        patch.setattr(events, "CHANGE_RUN_S", 1.2)
        chosen = [event for event in events.all_events() if event.name in ("20 dB louder", "sign", "one sweep")]
        patch.setattr(events, "all_events", lambda: chosen)
        runs = Runs()
        report = tracking.main(runs)
        planned = tracking.planned_runs()
        scenes = events.scenes_of(chosen[1], short["duct"])
    cases.measured_data.cache_clear()
    return report, runs.done, planned, scenes


def test_planned_runs_are_those_taken(small: Any) -> None:
    _, done, planned, _ = small
    # three events, two filters of 5 settings, one of 1 and two of 14, and each at its best
    assert planned == done == 3 * (2 * 5 + 1 + 2 * 14 + 5)


def test_the_report_is_complete(small: Any) -> None:
    report: StudyReport = small[0]
    assert (report.name, report.claims_heading, len(report.claims)) == ("tracking", "Findings", 4)
    assert [item.stem for item in report.figures] == ["20-db-louder", "sign", "one-sweep"]
    assert [table.stem for table in report.tables] == ["reduction", "worst", "power", "settling"]
    for table in report.tables[:3]:
        assert list(table.headings) == ["event", "paths", *STUDIED]
        assert [tuple(row[:2]) for row in table.rows] == [(n, "duct") for n in ("20 dB louder", "sign", "one sweep")]
    settling = report.tables[3]
    assert [tuple(row[:3]) for row in settling.rows] == [
        ("20 dB louder", "louder", "duct"),
        ("20 dB louder", "back", "duct"),
        ("sign", "changed", "duct"),
    ]
    assert set(report.parameters["settings"].value) == {"20 dB louder, duct", "sign, duct", "one sweep, duct"}
    assert len(report.extra["rows"]) == 3 * len(STUDIED)


@pytest.mark.parametrize("algorithm", ["KF-PB", "FxLMS"])
def test_a_row_is_that_of_plain_runs(small: Any, algorithm: str) -> None:
    report, _, _, scenes = small
    (row,) = (r for r in report.extra["rows"] if (r["event"], r["algorithm"]) == ("sign", algorithm))
    results = [
        simulate(
            make_controller(scene, algorithm, row["setting"]),
            scene.references[0],
            disturbance=scene.disturbances[0],
            secondary_path=scene.secondary,
            fs=FS,
            sensor_noise_std=scene.sensor_noise_std,
            rng=1000 + seed,
            switch_on_s=0.5,
        )
        for scene, seed in zip(scenes, (1, 2), strict=True)
    ]
    e, d, y = (np.array([getattr(r, name) for r in results]) for name in ("error", "disturbance", "control_signal"))
    rated = scenes[0].rated_power
    after = slice(round(0.5 * FS), round(1.2 * FS))
    assert row["noise_reduction_db"] == pytest.approx(noise_reduction_db(e, d, steady=1.0, runs=True), abs=1e-9)
    assert row["worst_window"] == pytest.approx(overshoot(y, rated, FS, window_s=0.1, runs=True), rel=1e-9)
    time = convergence_time_s(e[:, after], d[:, after], FS, window_s=0.05, runs=True)
    assert row["settled_s"]["changed"] == (None if np.isnan(time) else pytest.approx(time))


# ---- Scenes


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray]:
    """A delay with an echo, and a shorter delay."""
    primary, secondary = np.zeros(30), np.zeros(10)
    primary[[20, 25]] = 1.0, 0.5
    secondary[5] = 1.0
    return primary, secondary


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


def test_sweeps_start_from_silence(pair: Any) -> None:
    scene = sweep_scene(pair, 3)
    x = scene.references[0]
    assert x.size == 8000 + 3 * 4000
    assert not np.any(x[:8000])
    assert np.array_equal(x[8000:12000], x[16000:])


def test_a_path_changes_at_its_sample(pair: Any) -> None:
    scene = change_scene(pair, 1, -pair[0])
    x, d = scene.references[0], scene.disturbances[0]
    at = round(2.5 * FS)
    one = np.convolve(x, pair[0])[: x.size]
    assert np.allclose(d[:at], one[:at], atol=1e-12)
    assert np.allclose(d[at:], -one[at:], atol=1e-12)


def test_a_jump_is_of_the_reference(pair: Any) -> None:
    scene = jump_scene(pair, 1, 20.0)
    x = scene.references[0]
    louder = slice(round(2.0 * FS), round(3.5 * FS))
    usual = np.concatenate([x[: louder.start], x[louder.stop :]])
    # 1.5 s of 800 Hz of band: power known to 1 / sqrt(2400), 2 %
    assert np.mean(x[louder] ** 2) / np.mean(usual**2) == pytest.approx(100.0, rel=0.15)
    assert scene.rated_power == pytest.approx(10**-0.3)


def test_events_say_where_they_happen() -> None:
    found = {event.name: event for event in events.all_events()}
    assert list(found) == ["20 dB louder", "20 dB softer", "sign", "delay", "longer duct", "one sweep", "sweeps"]
    assert found["longer duct"].paths == ("duct",)
    names = [(event.name, path) for event, path in events.jobs({"duct": None, "measured duct": None})]
    assert len(names) == 13
    assert ("longer duct", "measured duct") not in names


def test_an_algorithm_without_a_setting_is_lost() -> None:
    event = Event("sign", lambda pair, seed: None, {"changed": (0.0, 1.0)})  # type: ignore[arg-type,return-value]
    row, course = tracking.run_event(event, "duct", [], {"FxLMS": None}, "FxLMS")
    assert (row.diverged_at_s, course) == (0.0, None)
    assert np.isnan(row.noise_reduction_db)
    assert row.settled_s == {"changed": None}


# ---- Claims from rows made by hand


def _row(event: str, algorithm: str, **more: Any) -> TrackingRow:
    values: dict[str, Any] = {
        "path": "duct",
        "noise": "band noise",
        "setting": 0.1,
        "mean_nse_db": -5.0,
        "noise_reduction_db": 5.0,
        "power": 1.0,
        "worst_window": 1.0,
        "settled_s": {"changed": 0.1},
        "diverged_at_s": None,
    }
    return TrackingRow(event=event, algorithm=algorithm, **{**values, **more})


@pytest.mark.parametrize(("nse", "met"), [(-5.01, True), (-5.0, False), (-4.99, False), (np.nan, False)])
def test_mean_nse_is_compared_event_by_event(nse: float, met: bool) -> None:
    rows = [_row("sign", "KF-ANC", mean_nse_db=-9.0), _row("sign", "FxLMS")]
    rows += [_row("delay", "KF-ANC", mean_nse_db=nse), _row("delay", "FxLMS")]
    claim = tracking._mean_nse(rows)
    assert claim.holds == met
    if np.isfinite(nse):
        assert (
            claim.measured
            == f"by {(4.0 - 5.0 - nse) / 2:.1f} dB on average, by {-5.0 - nse:.2f} dB at least (delay, duct)"
        )


@pytest.mark.parametrize(("time", "met"), [(0.099, True), (0.1, False), (None, False)])
def test_sooner_needs_every_change(time: float | None, met: bool) -> None:
    rows = [_row("sign", "KF-ANC", settled_s={"changed": time}), _row("sign", "FxLMS")]
    rows += [_row("sweeps", "KF-ANC", settled_s={}), _row("sweeps", "FxLMS", settled_s={})]
    assert tracking._sooner(rows).holds == met


@pytest.mark.parametrize(("worst", "met"), [(10.01, True), (10.0, False), (9.99, False)])
def test_a_jump_breaks_every_constraint(worst: float, met: bool) -> None:
    rows = [_row("20 dB louder", name, worst_window=30.0) for name in tracking.CONSTRAINED[1:]]
    rows.append(_row("20 dB louder", tracking.CONSTRAINED[0], worst_window=worst))
    assert tracking._jump(rows).holds == met


@pytest.mark.parametrize(
    ("opc", "pb", "anc", "met"),
    [
        (1.01, 0.19, 0.19, True),
        (0.99, 0.1, 0.1, False),
        (1.3, 0.21, 0.1, False),
        (1.2, 0.1, 0.21, False),
        (None, 0.1, 0.1, True),
        (1.2, 0.1, None, False),
        (1.2, None, 0.1, False),
    ],
)
def test_back_after_a_loud_noise(opc: float | None, pb: float | None, anc: float | None, met: bool) -> None:
    times = {"KF-OPC": opc, "KF-PB": pb, "KF-ANC": anc}
    rows = [_row("20 dB louder", name, settled_s={"louder": 0.0, "back": time}) for name, time in times.items()]
    assert tracking._back(rows).holds == met


def test_the_command_knows_the_study() -> None:
    assert command.FURTHER["tracking"] == (tracking.main, tracking.planned_runs)
    assert "tracking" not in command.STUDIES
