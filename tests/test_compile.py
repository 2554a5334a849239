"""The compiled code of one module is not used with another version of the modules it was compiled from."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "kfopc_filterpy"


def test_cached_loop_notices_an_edited_kernel(tmp_path):
    copy = tmp_path / PACKAGE.name
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "loop.py").write_text(
        "from ._compile import compiled\nfrom .kernels import dot\n\n\n"
        "@compiled()\ndef twice(a):\n    return 2 * dot(a, a)\n"
    )
    code = (
        "import numpy as np; from kfopc_filterpy.loop import twice\n"
        "print(twice(np.ones(3)), sum(twice.stats.cache_hits.values()))"
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)

    def run() -> list[str]:
        command = [sys.executable, "-c", code]
        return subprocess.run(
            command, cwd=tmp_path, env=environment, check=True, capture_output=True, text=True
        ).stdout.split()

    assert run() == ["6.0", "0"]
    assert run() == ["6.0", "1"]
    kernels = copy / "kernels.py"
    kernels.write_text(kernels.read_text().replace("total += a[i] * b[i]", "total += 5.0 * a[i] * b[i]"))
    assert run() == ["30.0", "0"]
