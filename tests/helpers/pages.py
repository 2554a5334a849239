"""Runs a tutorial as its reader does, cell by cell, so that tests can look at what it computed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parents[2]
TUTORIALS = ROOT / "docs" / "tutorials"
_SHELL = re.compile(r"^!", re.M)  # marks a command of the shell
_PART = re.compile(
    r"^```\{code-cell\}[^\n]*\n(?P<options>(?:---\n.*?^---\n)?(?::[^\n]*\n)*)(?P<code>.*?)^```$|^## (?P<heading>[^\n]*)$",
    re.M | re.S,
)


class Page:
    """A tutorial, whose cells run in the order of the page.

    Parameters
    ----------
    stem : str
        Name of its file without suffix.
    without : str, optional
        Cells with this tag are left out.
    """

    def __init__(self, stem: str, without: str | None = None) -> None:
        self.stem, self.variables = stem, {"__name__": "__main__"}
        text = (TUTORIALS / f"{stem}.md").read_text(encoding="utf-8")
        parts = list(_PART.finditer(text))
        assert sum(part["code"] is not None for part in parts) == text.count("```{code-cell}")  # none was overlooked
        self.left = [part for part in parts if without is None or f"[{without}]" not in (part["options"] or "")]
        assert without is None or len(self.left) < len(parts), f"{stem}.md has no cell tagged {without}"

    def skip(self, to: str) -> None:
        """Leave out the cells before the heading `to`."""
        while self.left[0]["heading"] != to:
            self.left.pop(0)

    def run(self, until: str | None = None) -> Any:
        """Run the cells before the heading `until`, by default all that are left; return the variables."""
        while self.left and not (until and self.left[0]["heading"] == until):
            part = self.left.pop(0)
            if part["code"] is not None and _SHELL.match(part["code"]):
                _run_in_shell(_SHELL.sub("", part["code"]))
            elif part["code"] is not None:
                exec(compile(part["code"], f"{self.stem}.md", "exec"), self.variables)
                plt.close("all")  # as a notebook does
        assert self.left or until is None, f"{self.stem}.md has no heading {until!r} there"
        return SimpleNamespace(**{name: value for name, value in self.variables.items() if not name.startswith("__")})


def table_of(text: str, heading: str) -> list[list[str]]:
    """Return the cells of the first table below a heading of a page, without its head."""
    section = re.split(r"^## ", text.split(f"## {heading}\n", 1)[1], maxsplit=1, flags=re.M)[0]
    rows = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows[2:]]


def _run_in_shell(commands: str) -> None:
    """Run a cell of shell commands and print what they say; `kfopc` is this checkout's."""
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder) / "kfopc"
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m kfopc_filterpy "$@"\n', encoding="utf-8")
        script.chmod(0o755)
        environment = os.environ | {"PATH": folder + os.pathsep + os.environ["PATH"], "PYTHONPATH": str(ROOT)}
        ended = subprocess.run(["sh", "-c", commands], env=environment, capture_output=True, text=True)
    print(ended.stdout, end="")
    assert ended.returncode == 0, ended.stderr
