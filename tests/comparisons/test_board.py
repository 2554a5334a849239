"""Exported controllers on an emulated Cortex-M4."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from helpers.pages import ROOT

from comparisons.board.study import controllers, missing_tools, run_on_board

PRINTED = (ROOT / "docs" / "board.txt").read_text(encoding="utf-8").splitlines()[2:]


@pytest.mark.slow
@pytest.mark.parametrize("name", controllers())
def test_the_board_plays_the_bits_of_this_machine(name):
    if missing := missing_tools():
        pytest.skip(f"needs {', '.join(missing)}")
    run = run_on_board(controllers()[name], samples=2000)
    assert run.self_test == 0
    assert run.bits == run.host_bits
    assert len(set(run.bits)) == 8  # it played something, and went on playing
    assert 1000 < run.mean <= run.worst
    assert 500 < run.stack < 4096


def test_the_page_shows_the_controllers_of_the_command():
    assert [line[:27].strip() for line in PRINTED] == list(controllers())
    assert all(line.endswith("yes") for line in PRINTED)


@pytest.mark.parametrize(("options", "says"), [((), "on Debian: apt-get install"), (("--fast",), "takes no options")])
def test_what_is_missing_is_named(options, says, tmp_path):
    command = [sys.executable, "-m", "comparisons", "board", *options]
    environment = os.environ | {"PATH": str(tmp_path), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 1
    assert says in done.stderr
