"""The tutorials: that each runs from its first cell to its last, and that its reader sees all of it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from helpers.pages import ROOT, run_page

FOLDER = ROOT / "docs" / "tutorials"
TUTORIALS = sorted(page for page in FOLDER.glob("*.md") if page.stem != "index")


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_a_tutorial_runs(page: Path, inside: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/usr/bin:/bin")  # a page changes it, and the folder
    run_page(page)


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_a_tutorial_is_a_notebook_to_download_with_nothing_hidden(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert "format_name: myst" in text
    assert f"{{nb-download}}`{page.stem}.ipynb`" in text
    assert not re.search(r":tags:.*(remove|hide)|^ *assert ", text, re.M), "a hidden cell, or an assertion"
    assert f"\n{page.stem}\n" in (FOLDER / "index.md").read_text(encoding="utf-8")
