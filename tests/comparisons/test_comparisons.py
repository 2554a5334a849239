"""The command that runs the studies; the figures they give are their own output."""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers import reports
from helpers.studies import run_study, smaller

from comparisons import __main__ as command
from comparisons.__main__ import main
from comparisons.studies import broadband, duct, tonal
from comparisons.studies.cases import PAPER


def test_overdrives_where_the_order_flips():
    levels = np.array([0.0, 1.0, 2.0, 3.0])
    assert tonal.crossings_db(levels, np.array([-1.0, 1.0, 3.0, -1.0])) == [0.5, 2.75]
    assert tonal.crossings_db(levels, np.ones(4)) == []


def test_studies_plan_the_runs_they_take():
    for study, duration_s in ((tonal, 0.7), (broadband, 1.7), (duct, 1.7)):
        with smaller(study, DURATION_S=duration_s, _figures_of=lambda *_: []):
            run_study(study)


def test_a_study_that_is_left_out_is_noted_on_the_page(tmp_path, capsys):
    studies = {
        "tonal": (lambda runs: reports.study(), lambda: 1),
        "duct-measured": (lambda runs: "duct-measured is left out: set KFOPC_DATA", lambda: 1),
    }
    with smaller(command, STUDIES=studies):
        assert main(["--quiet", "--output", str(tmp_path)]) == 0
    assert "duct-measured is left out: set KFOPC_DATA" in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "message"), [(["tonal", "--output", "file"], "'file'"), (["tonal", "tidal"], "no study called tidal")]
)
def test_bad_arguments_are_refused(arguments, message, inside, capsys):
    (inside / "file").write_text("")
    with pytest.raises(SystemExit):
        main(arguments)
    assert message in capsys.readouterr().err


def test_studies_beyond_the_paper_run_only_where_they_are_named(tmp_path):
    ran = []

    def fake(name):
        return lambda runs: ran.append(name) or f"{name} is left out", lambda: 1

    studies = {table: {name: fake(name) for name in getattr(command, table)} for table in ("STUDIES", "FURTHER")}
    with smaller(command, **studies):
        main(["--quiet", "--output", str(tmp_path)])
        main(["constraint", "--quiet", "--output", str(tmp_path)])
    assert ran == ["tonal", "broadband", "duct", "duct-measured", "constraint"]


def test_command_writes_report_and_results(tmp_path, capsys):
    with smaller(tonal, DURATION_S=1.5, OVERDRIVES_DB=np.array([0.0, 3.0, 10.0])):
        assert main(["tonal", "--quiet", "--output", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    note = "The ceiling: within the rated power"  # notes go to the report
    assert note not in " ".join(printed.split())
    assert note in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert len(printed.splitlines()) <= 40  # a screen
    study = json.loads((tmp_path / "results.json").read_text())["studies"]["tonal"]
    assert set(study["algorithms"]) == set(PAPER)
    assert study["extra"]["overdrive_db"] == [0.0, 3.0, 10.0]
