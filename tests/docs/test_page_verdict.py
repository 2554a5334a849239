"""The tutorial of the command line: what its commands say and write."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import soundfile
from helpers.pages import Page


@pytest.mark.slow
def test_the_commands_say_what_the_page_says(inside, monkeypatch, capsys):
    monkeypatch.setenv("PATH", "/usr/bin:/bin")  # the page changes it, and the folder
    page = Page("verdict")
    page.run(until="The verdict")
    said = capsys.readouterr().out
    unexplained = float(said.split("which leave ")[1].split(" dB")[0])
    assert unexplained < -20

    page.run(until="Listen")
    said = capsys.readouterr().out
    small, large = said.split("exit code 1")
    assert small.startswith("Not enough: KF-PB reaches")
    assert "The amplifier limits" in small
    assert large.strip().startswith("Enough: KF-PB reaches")
    assert "exit code 0" in large

    page.run()
    several = capsys.readouterr().out
    assert "KF-PB reaches" in several
    assert "20, 10 W into 8 ohm" in several
    assert re.search(r"exit code [01]\n", several)
    verdicts = {name: json.loads(Path(name, "verdict.json").read_text("utf-8")) for name in ("small", "large")}
    assert verdicts["small"]["limited_by"] == "amplifier"
    assert verdicts["large"]["limited_by"] is None
    assert verdicts["large"]["ceilings"]["coherence_db"] > 6
    before, after = (soundfile.read(f"large/audio/verdict-{name}.wav")[0] for name in ("before", "after"))
    steady = slice(before.size // 2, None)
    reduction = 10 * np.log10(np.sum(before[steady] ** 2) / np.sum(after[steady] ** 2))
    assert abs(reduction - verdicts["large"]["noise_reduction_db"]) < 0.05
