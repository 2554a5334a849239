"""The studies' own parts: the scene, the rule that tunes, the command; the figures they give are their own output."""

from __future__ import annotations

import json
from importlib import import_module

import numpy as np
import pytest
from helpers import reports
from helpers.studies import run_study, smaller

from comparisons import __main__ as comparisons_command
from comparisons.__main__ import FURTHER, STUDIES, main
from comparisons.studies import broadband, duct, tonal
from comparisons.studies.cases import PAPER
from kfopc_filterpy import bandpass_path, output_power
from kfopc_filterpy.bench import (
    Runs,
    Trial,
    algorithms,
    best_setting,
    figures_of_merit,
    make_controller,
    make_scene,
    tune,
)
from kfopc_filterpy.bounds import wiener_solution
from kfopc_filterpy.paths import path_taps
from kfopc_filterpy.signals import tone


@pytest.fixture(scope="module")
def scene():
    noise = np.random.default_rng(0).standard_normal(12000)
    return make_scene(
        {3: noise, 4: noise[::-1].copy()},
        bandpass_path(64),
        bandpass_path(16),
        fs=16000.0,
        rated_power=0.5,
        power_multiple=4.0,
        n_taps=64,
        switch_on_s=0.1,
    )


def test_scene_needs_the_stated_multiple_of_the_rated_power(scene):
    x, d = scene.references[0][1600:], scene.disturbances[0][1600:]
    solution = wiener_solution(x, d, scene.secondary, scene.n_taps)
    assert solution.control_power == pytest.approx(4.0 * 0.5, rel=1e-9)  # the same least squares, scaled
    np.testing.assert_allclose(d, np.convolve(scene.references[0], path_taps(bandpass_path(64)))[1600 : 1600 + d.size])


def test_tuning_takes_the_lowest_error_that_keeps_the_budget(scene):
    trials = [
        Trial(1.0, -9.0, 9.0, 0.1),  # diverged
        Trial(2.0, -8.0, 0.52),  # over the budget
        Trial(3.0, -7.0, 0.505),
        Trial(4.0, -6.0, 0.5),
    ]
    assert best_setting(scene, "KF-OPC", trials).setting == 3.0
    assert best_setting(scene, "KF-ANC", trials).setting == 2.0
    over = best_setting(scene, "KF-OPC", trials[:2])
    assert (over.setting, over.within_budget) == (2.0, False)
    assert best_setting(scene, "KF-OPC", trials[:1]) is None
    with pytest.raises(RuntimeError, match="KF-OPC diverged at every setting"):
        tune(Runs(), scene, ["KF-OPC"], trials={"KF-OPC": trials[:1]})


def test_tuned_setting_is_the_best_of_its_trials(scene):
    tuned = tune(Runs(), scene, ["KF-OPC", "MOV-FxLMS"], seeds=2)
    for name, best in tuned.items():
        assert [t.setting for t in best.trials] == algorithms()[name].grid
        kept = [t for t in best.trials if not t.diverged and t.output_power <= 1.02 * scene.rated_power]
        assert best.within_budget == bool(kept)
        if kept:
            assert best.setting == min(kept, key=lambda t: (round(t.mean_nse_db, 2), t.setting)).setting
        result = scene.run(make_controller(scene, name, best.setting))
        figures = figures_of_merit([result], scene)
        assert figures["output_power"] == output_power(result.control_signal)


def test_overdrives_where_the_order_flips():
    levels = np.array([0.0, 1.0, 2.0, 3.0])
    assert tonal.crossings_db(levels, np.array([-1.0, 1.0, 3.0, -1.0])) == [0.5, 2.75]
    assert tonal.crossings_db(levels, np.ones(4)) == []


def test_wiener_multiple_of_a_tone_is_its_overdrive():
    noise, fs = {0: tone(400, 10.5, fs=16000.0)}, 16000.0
    paths = bandpass_path(128), bandpass_path(32)
    scene = make_scene(noise, *paths, fs=fs, rated_power=0.5, power_multiple=4.0, n_taps=32)
    gain = abs(np.exp(-2j * np.pi * 400 / 16000 * np.arange(32)) @ path_taps(bandpass_path(32))) ** 2
    d = scene.disturbances[0][8000:]
    # A tone is cancelled by a control signal of power E[d^2] over the path's power gain at its frequency.
    assert np.mean(d**2) / gain == pytest.approx(2.0, rel=1e-3)


def test_measured_study_says_in_a_line_why_it_is_left_out(data_folder, tmp_path):
    data_folder(tmp_path / "nowhere")
    line = duct.main_measured(Runs())
    assert isinstance(line, str)
    assert line.startswith("duct-measured is left out: set KFOPC_DATA to a folder with the measured data")
    assert "\n" not in line


def test_studies_plan_the_runs_they_take():
    for study, duration_s in ((tonal, 0.7), (broadband, 1.7), (duct, 1.7)):
        with smaller(study, DURATION_S=duration_s, _figures_of=lambda *_: []):
            run_study(study)


def test_command_refuses_a_folder_it_cannot_write(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit):
        main(["tonal", "--output", str(tmp_path / "file")])
    assert str(tmp_path / "file") in capsys.readouterr().err


def test_command_refuses_an_unknown_study(capsys):
    with pytest.raises(SystemExit):
        main(["tonal", "tidal"])
    assert "no study called tidal" in capsys.readouterr().err


def test_a_study_that_is_left_out_is_noted_on_the_page(tmp_path, capsys):
    studies = {
        "tonal": (lambda runs: reports.study(), lambda: 1),
        "duct-measured": (lambda runs: "duct-measured is left out: set KFOPC_DATA", lambda: 1),
    }
    with smaller(comparisons_command, STUDIES=studies):
        assert main(["--quiet", "--output", str(tmp_path)]) == 0
    assert "duct-measured is left out: set KFOPC_DATA" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_the_command_finds_every_study_by_its_name():
    assert list(STUDIES) == ["tonal", "broadband", "duct", "duct-measured"]
    assert not set(STUDIES) & set(FURTHER)
    for name, functions in (STUDIES | FURTHER).items():
        module = import_module(f"comparisons.studies.{name.partition('-')[0]}")
        main_of_part = {"duct-measured": "main_measured", "duct-motor": "main_motor"}.get(name, "main")
        assert functions == (getattr(module, main_of_part), module.planned_runs)


def test_command_writes_report_and_results(tmp_path, capsys):
    with smaller(tonal, DURATION_S=1.5, OVERDRIVES_DB=np.array([0.0, 3.0, 10.0])):
        assert main(["tonal", "--quiet", "--output", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    note = "The ceiling: within the rated power"  # notes go to the report
    assert note not in " ".join(printed.split())
    assert note in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert len(printed.splitlines()) <= 40  # a screen
    study = json.loads((tmp_path / "out" / "results.json").read_text())["studies"]["tonal"]
    assert set(study["algorithms"]) == set(PAPER)
    assert study["extra"]["overdrive_db"] == [0.0, 3.0, 10.0]
    assert (tmp_path / "out" / "report.html").stat().st_size > 100_000
    assert min(p.name for p in (tmp_path / "out" / "audio").iterdir()) == "tonal-disturbance.wav"
