"""Reads the pages, and runs a tutorial as its reader does, cell by cell."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parents[2]
CELL = re.compile(r"^```\{code-cell\}[^\n]*\n(?:---\n.*?^---\n)?(?::[^\n]*\n)*(?P<code>.*?)^```$", re.M | re.S)


def run_page(path: Path) -> None:
    """Run the cells of a page in their order; those that begin with "!" are commands of the shell."""
    text = path.read_text(encoding="utf-8")
    cells = [found["code"] for found in CELL.finditer(text)]
    assert len(cells) == text.count("```{code-cell}")  # none was overlooked
    variables: dict[str, object] = {"__name__": "__main__"}
    for code in cells:
        if code.startswith("!"):
            run_in_shell(re.sub(r"^!", "", code, flags=re.M))
        else:
            exec(compile(code, path.name, "exec"), variables)
            plt.close("all")  # as a notebook does


def run_in_shell(commands: str) -> None:
    """Run commands of the shell; `kfopc` is this checkout's."""
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder) / "kfopc"
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m kfopc_filterpy "$@"\n', encoding="utf-8")
        script.chmod(0o755)
        environment = os.environ | {"PATH": folder + os.pathsep + os.environ["PATH"], "PYTHONPATH": str(ROOT)}
        subprocess.run(["sh", "-c", commands], env=environment, check=True)


def table_of(text: str, heading: str) -> list[list[str]]:
    """Return the cells of the first table below a heading of a page, without its head."""
    section = re.split(r"^## ", text.split(f"## {heading}\n", 1)[1], maxsplit=1, flags=re.M)[0]
    rows = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows[2:]]
