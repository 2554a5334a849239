"""The built pages as they are read: found by the search, and on a phone."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "docs" / "extensions"))

import search_words  # noqa: E402

pytestmark = pytest.mark.slow

PHONE = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
TOO_WIDE = """
const room = document.querySelector("article").getBoundingClientRect().width;
return [...document.querySelectorAll("mjx-container > svg")].map(svg => svg.getBoundingClientRect().width)
  .filter(width => width > room + 1);
"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """The pages as HTML; the tutorials are not run."""
    pytest.importorskip("myst_nb", reason="needs the extra `docs`")
    folder = tmp_path_factory.mktemp("html")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", ROOT / "docs", folder]
    subprocess.run(command, check=True, env=os.environ | {"DOCS_WITHOUT_TUTORIALS": "1"})
    return folder


def results(browser, pages, words):
    """The first three pages that the search finds."""
    browser.get(f"{(pages / 'search.html').as_uri()}?q={words.replace(' ', '+')}")
    summary = browser.until(lambda _: browser.find_elements("css selector", ".search-summary"))[0]
    browser.until(lambda _: "..." not in summary.text)
    found = browser.find_elements("css selector", "ul.search > li > a")[:3]
    return [link.get_attribute("href").split("/html0/")[-1].split(".html")[0] for link in found]


def test_the_search_finds_the_page_that_answers(browser, pages):
    for page, words in search_words.WORDS.items():
        for word in words:
            assert page in results(browser, pages, word), word


def test_no_page_and_no_equation_is_wider_than_a_phone(browser, pages):
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", PHONE)
    for page in sorted(pages.rglob("*.html")):
        if page.relative_to(pages).parts[0] in ("_static", "source", "genindex.html"):
            continue
        browser.get(page.as_uri())
        browser.execute_async_script("(window.MathJax?.startup?.promise ?? Promise.resolve()).then(arguments[0])")
        assert browser.execute_script("return document.scrollingElement.scrollWidth") <= PHONE["width"], page
        assert not browser.execute_script(TOO_WIDE), page
