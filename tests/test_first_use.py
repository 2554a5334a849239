"""What a first use compiles: the studies have it done ahead, and only once."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from comparisons import first_use
from kfopc_filterpy import _compile

ROOT = Path(__file__).resolve().parents[1]
NOTHING_LEFT = """
from comparisons import first_use
from kfopc_filterpy._compile import on_disk
from kfopc_filterpy.lockstep import run_block
from kfopc_filterpy.loop import run
from kfopc_filterpy.pairs import take_pairs
compiled = (run, run_block, take_pairs)
before = [on_disk(one) for one in compiled]
first_use.compile_ahead()
after = [on_disk(one) for one in compiled]
print(any(before), all(after))
"""


@pytest.mark.skipif(_compile.SWITCHED_OFF, reason="numba's compiler is switched off")
def test_compiles_ahead_in_two_processes(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", NOTHING_LEFT]
    printed = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.split()
    assert printed == ["False", "True"]


def test_starts_no_process_where_all_is_compiled(monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError("a process was started")

    first_use.alone()
    first_use.together()
    monkeypatch.setattr(first_use.subprocess, "Popen", refuse)
    first_use.compile_ahead()
