"""What a first use compiles: the studies have it done ahead, and only once."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from comparisons.speed import first_use
from comparisons.speed import study as speed
from kfopc_filterpy.kernels import compiling as _compile

ROOT = Path(__file__).resolve().parents[2]
NOTHING_LEFT = """
import subprocess
from comparisons.speed import first_use
from kfopc_filterpy.kernels.compiling import on_disk
from kfopc_filterpy.loop.lockstep import run_block
from kfopc_filterpy.loop.run import run
from kfopc_filterpy.kernels.pairs import take_pairs

class Recorded(subprocess.Popen):
    def __init__(self, *arguments, **options):
        others.append(self)
        super().__init__(*arguments, **options)

others, subprocess.Popen = [], Recorded
compiled = (run, run_block, take_pairs)
before = [on_disk(one) for one in compiled]
first_use.compile_ahead()
after = [on_disk(one) for one in compiled]
print(any(before), all(after), *(other.returncode for other in others), sum(run_block.stats.cache_misses.values()))
"""


@pytest.mark.skipif(_compile.SWITCHED_OFF, reason="numba's compiler is switched off")
def test_compiles_ahead_in_two_processes(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", NOTHING_LEFT]
    printed = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.split()
    assert printed == ["False", "True", "0", "0"]  # the other process did not fail; this one compiled none of its part


def test_starts_no_process_where_all_is_compiled(monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError("a process was started")

    first_use.alone()
    first_use.together()
    monkeypatch.setattr(first_use.subprocess, "Popen", refuse)
    first_use.compile_ahead()


@pytest.mark.skipif(_compile.SWITCHED_OFF, reason="numba's compiler is switched off")
def test_a_first_use_takes_longer_than_the_second():
    """A tenth of a second at the very least for some dozen functions, on any machine; hardly ten minutes."""
    assert 0.1 < speed.first_use_s("shared_gains") < 600.0


def test_a_first_use_that_fails_says_why():
    with pytest.raises(RuntimeError, match=r"(?s)the first run failed: .*cannot import name 'no_such'"):
        speed.first_use_s("no_such")
