"""Numbers that the documentation quotes from the studies: each is on the list, and each entry of the list on a page."""

from __future__ import annotations

import dataclasses
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from comparisons.bench import Claim, StudyReport

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path.insert(0, str(DOCS))

import quoted  # noqa: E402

# Numbers in dB that are not results: aims, settings, definitions, and what an example on the page prints.
DEFINITIONS = {"limits.md": ["settles to 3 dB of a steady value", "falls to -20 dB of the filter's"]}


def test_the_words_of_every_quote_stand_on_their_page():
    for quote in quoted.QUOTES:
        assert quote.found() is not None, f"{quote.page} does not say: {quote.words}"


@pytest.mark.parametrize("page", ["constraint.md", "limits.md", "theory.md", "symbols.md"])
def test_every_figure_in_decibels_is_on_the_list(page):
    text = (DOCS / page).read_text(encoding="utf-8")
    text = " ".join(re.sub(r"^```.*?^```", "", text, flags=re.M | re.S).split())
    for quote in quoted.QUOTES:
        if quote.page == page:
            said = " ".join(quote.words.split())
            for number in quote.found() or ():
                said = quoted.FIELD.sub(number, said, count=1)
            text = text.replace(said, "")
    for definition in DEFINITIONS.get(page, ()):
        assert definition in text, f"{page} no longer says {definition!r}"
        text = text.replace(definition, "")
    left = re.findall(r".{0,40}\d ?dB\b", text)
    assert not left, f"{page} quotes figures that docs/quoted.py does not list: {left}"


def fake_results(value: float) -> quoted.Results:
    results = quoted.Results(Path("nowhere"))
    extra = {"ordering_flips_at_overdrive_db": [1.2325, value]}
    vars(results)["studies"] = {"tonal": {"extra": extra, "rated_power": 1.0}}  # in place of the cached file
    return results


def test_a_quote_is_held_to_its_last_digit_and_a_missing_one_is_wrong():
    quote = next(quote for quote in quoted.QUOTES if "of overdrive" in quote.words)
    assert quote.found() == ["1.2", "4.6"]
    assert quote.wrong(fake_results(4.587)) == []
    assert len(quote.wrong(fake_results(4.75))) == 1
    assert len(quote.wrong(fake_results(float("nan")))) == 1
    absent = dataclasses.replace(quote, words="leads KF-ANC by {:.1f} dB everywhere, {:.1f}")
    assert absent.found() is None
    assert len(absent.wrong(fake_results(4.587))) == 1


def test_what_a_claim_measured_is_found_by_its_first_words():
    held, missed = Claim("It is faster", True, "1.5 s, -3 dB"), Claim("It is louder", np.bool_(False), "7")
    study = StudyReport("tonal", "", "", 16000.0, 1.0, {}, {}, claims=[held, missed])
    results = fake_results(1.0)
    vars(results)["studies"] = dict.fromkeys(quoted.PAPER, study.result)
    assert results.said("tonal", "It is f") == [1.5, -3.0]
    assert results.said("tonal", "It is l") == [7.0]
    assert results.reproduced() == (len(quoted.PAPER), 2 * len(quoted.PAPER))


@pytest.mark.skipif(not os.environ.get("KFOPC_RESULTS"), reason="KFOPC_RESULTS names no folder of fresh results")
def test_fresh_results_say_what_the_pages_quote():
    problems, held, _ = quoted.check(Path(os.environ["KFOPC_RESULTS"]))
    assert held
    assert not problems
