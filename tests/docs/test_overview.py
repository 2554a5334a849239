"""The first figure of the README and the front page: that what their caption says is what the runs give."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "docs"))

import overview  # noqa: E402


@pytest.fixture(scope="module")
def overload():
    return overview.Overload()


@pytest.fixture(scope="module")
def runs(overload):
    """Noise reduction and power over the rated power by algorithm, 12 dB above what the rated power can cancel."""
    return {name: overload.run(name, 12.0) for name in overview.ALGORITHMS}


@pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
def test_the_caption_says_what_the_runs_give(runs, page):
    text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
    assert "figures/overview.png" in text
    (least,) = re.findall(r"asks for more and more, at 12 dB for over ([\d,]+) times", text)
    assert runs["KF-ANC"][1] > float(least.replace(",", ""))
    assert "in the end it makes the noise louder" in text
    assert runs["KF-ANC"][0] < 0
    (said,) = re.findall(r"KF-OPC goes on reducing the noise, but takes ([\d.]+) times the rated power", text)
    assert runs["KF-OPC"][1] == pytest.approx(float(said), abs=0.05)
    assert runs["KF-OPC"][0] > 2
    (most,) = re.findall(r"KF-PB reduces it as much and takes at most ([\d.]+) times", text)  # at all of its points
    assert runs["KF-PB"][1] < float(most)
    assert runs["KF-PB"][0] >= runs["KF-OPC"][0]


def test_the_bound_is_above_what_keeps_the_rated_power(overload, runs):
    assert runs["KF-PB"][0] < overload.bound(12.0) < runs["KF-PB"][0] + 0.5
