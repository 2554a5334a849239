"""Scenes and processes of the command `kfopc`."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

FS = 8000
ROOT = Path(__file__).resolve().parents[2]
SCENE = ["noise.wav", "--primary", "P.wav", "--secondary", "S.wav"]


def process(folder: Path, *arguments: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "kfopc_filterpy", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True)
