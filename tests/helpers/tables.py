"""Tables that slow tests make and pages show: `KFOPC_TABLES=docs pytest -m slow tests/...` writes them anew."""

from __future__ import annotations

import os
from pathlib import Path

from .pages import ROOT


def write_table(name: str, text: str) -> None:
    """Write a table into the folder that KFOPC_TABLES names, if any."""
    if folder := os.environ.get("KFOPC_TABLES"):
        (Path(folder) / name).write_text(text + "\n", encoding="utf-8")


def stored_table(name: str) -> list[str]:
    """Return the lines of a table in docs/."""
    return (ROOT / "docs" / name).read_text(encoding="utf-8").splitlines()
