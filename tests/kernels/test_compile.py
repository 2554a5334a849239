"""How functions are compiled: again where a module they come from was edited, and with numba's own rules bent safely."""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.errors import TypingError

from kfopc_filterpy import KFOPC
from kfopc_filterpy.kernels.compiling import SWITCHED_OFF, Settings, compiled
from kfopc_filterpy.kernels.covariance import project_covariance, update_weights
from kfopc_filterpy.kernels.delay_lines import delay_line, newest

PACKAGE = Path(__file__).resolve().parents[2] / "kfopc_filterpy"


def test_cached_loop_notices_an_edited_kernel(tmp_path):
    copy = tmp_path / PACKAGE.name
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "loop" / "run.py").write_text(
        "from ..kernels.compiling import compiled\nfrom ..kernels.covariance import dot\n\n\n"
        "@compiled()\ndef twice(a):\n    return 2 * dot(a, a)\n"
    )
    code = (
        "import numpy as np; from kfopc_filterpy.loop.run import twice; from kfopc_filterpy.kernels.compiling import on_disk\n"
        "print(on_disk(twice), twice(np.ones(3)), sum(twice.stats.cache_hits.values()))"
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)

    def run() -> list[str]:
        command = [sys.executable, "-c", code]
        return subprocess.run(
            command, cwd=tmp_path, env=environment, check=True, capture_output=True, text=True
        ).stdout.split()

    assert run() == ["False", "6.0", "0"]
    assert run() == ["True", "6.0", "1"]
    kernels = copy / "kernels" / "covariance.py"
    kernels.write_text(kernels.read_text().replace("total += a[i] * b[i]", "total += 5.0 * a[i] * b[i]"))
    assert run() == ["False", "30.0", "0"]


def test_arrays_keep_their_references():
    """What Python holds before a call of compiled code it holds after, no more, no less."""
    x, state = np.ones(50), KFOPC.random_walk(4, state_noise=1e-6, measurement_noise=1.0).compiled_state()[0]
    counts = [sys.getrefcount(array) for array in (x, *state)]
    for _ in range(100):
        project_covariance(state, x[:4])
        update_weights(state, np.zeros(4), x[:4], 1.0, 2.0, 1.0)
        assert newest(delay_line(3), 2).size == 2  # a view, made in Python
    assert [sys.getrefcount(array) for array in (x, *state)] == counts


@pytest.mark.skipif(SWITCHED_OFF, reason="numba's compiler is switched off")
def test_flags_are_the_same_where_the_same_was_set():
    """As dictionary keys, in whatever order; and never where numba's own comparison, of all values, finds a difference."""
    one, same, other = Settings(), Settings(), Settings()
    one.nrt, one.noalias = False, True
    same.noalias, same.nrt = True, False
    other.nrt, other.noalias = True, True
    assert one == same
    assert hash(one) == hash(same)
    assert one.values() == same.values()
    assert one != other
    assert one.values() != other.values()
    assert one.copy() == one
    assert type(one.copy()) is Settings
    assert {one: 1, other: 2}[same] == 1


@pytest.mark.skipif(SWITCHED_OFF, reason="numba's compiler is switched off")
def test_collecting_garbage_goes_on_after_a_compilation():
    @compiled(cache=False)
    def fails(a):
        return a.no_such_attribute

    @compiled(cache=False)
    def works(a):
        return a + 1

    assert gc.isenabled()
    assert works(1) == 2
    with pytest.raises(TypingError):
        fails(1)
    assert gc.isenabled()
    gc.disable()
    try:
        works(1.0)
        assert not gc.isenabled()
    finally:
        gc.enable()
