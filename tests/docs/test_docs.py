"""The documentation: that its links into the code hold, that every public name and argument is described."""

from __future__ import annotations

import inspect
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import kfopc_filterpy

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path[:0] = [str(DOCS), str(DOCS / "extensions")]

import offline  # noqa: E402
import public_names  # noqa: E402
import source_lines  # noqa: E402

PAGES = sorted(page for page in DOCS.rglob("*.md") if "_build" not in page.parts)
LINE_ROLE = re.compile(r"\{line\}`([^`]+)`")
PUBLIC = [(name, public_names.thing_of(name)) for name in public_names.public_names()]
BUILT_OTHERWISE = (tuple, Exception)  # named tuples and errors: made by the package, not by its users


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


# Links into the code.


def test_a_line_that_is_not_there_or_not_alone_is_refused():
    with pytest.raises(ValueError, match="0 lines"):
        source_lines.find_line("core.triangle", "no such line of code")
    with pytest.raises(ValueError, match=r"lines of random_walk\.py hold"):
        source_lines.find_line("filters.random_walk", "return")


@pytest.mark.parametrize("number", ["1a", "1b", *map(str, range(2, 14))])
def test_the_theory_page_has_each_equation_of_the_paper_with_a_line_of_code(number):
    theory = text_of(DOCS / "theory.md")
    assert theory.count(rf"\tag{{{number}}}") == 1
    after = theory.split(rf"\tag{{{number}}}")[1]
    # The code comes before the next experiment or section; (12) is no line of its own, it becomes (13).
    assert LINE_ROLE.search(re.split(r"\n#|```", after)[0]), f"no line of code follows equation {number}"


# The network.

PAGE = """<link rel="canonical" href="https://x.org/page.html"><a href="https://x.org">link</a>
<script src="_static/tex-svg-full.js"></script><link rel="stylesheet" href="_static/wide.css">
<img src="data:image/png;base64,AAAA"><img src="../_images/a.png"><audio src="data:audio/wav;base64,AAAA"></audio>"""


@pytest.mark.parametrize(
    "loads",
    [
        '<script async src="https://cdn.org/a.js"></script>',
        '<script src="//cdn.org/a.js"></script>',
        '<link rel="preload stylesheet" href="http://cdn.org/a.js">',
        '<img alt="" src="https://cdn.org/a.js">',
        '<p style="background: url(https://cdn.org/a.js)">',
        "a.css",
    ],
)
def test_a_page_that_loads_something_from_a_network_fails_the_build(tmp_path, loads):
    (tmp_path / "deep").mkdir()
    page, sheet = tmp_path / "deep" / "page.html", tmp_path / "a.css"
    page.write_text(PAGE, encoding="utf-8")
    sheet.write_text('@import "own.css"; a { background: url("data:image/svg+xml,<svg/>") }', encoding="utf-8")
    app = SimpleNamespace(builder=SimpleNamespace(format="html"), outdir=tmp_path)
    offline.require_offline(app, None)
    if loads == "a.css":
        sheet.write_text("@import url('https://cdn.org/a.js');", encoding="utf-8")
    else:
        page.write_text(PAGE + loads, encoding="utf-8")
    ((name, address),) = offline.remote_resources(tmp_path)
    assert name == (loads if loads == "a.css" else str(Path("deep", "page.html")))
    assert address.endswith("//cdn.org/a.js")
    with pytest.raises(ValueError, match=r"pages must read without a network, but\n.* loads .*//cdn\.org/a\.js"):
        offline.require_offline(app, None)


# The reference.


def test_every_public_name_has_a_summary_and_an_example_or_is_made_by_one():
    for name, thing in PUBLIC:
        doc = inspect.getdoc(thing) or ""
        assert re.match(r"\S.*[.:]", doc), f"{name} has no summary"
        made_by_the_package = inspect.isclass(thing) and (
            hasattr(thing, "__dataclass_fields__")
            or issubclass(thing, BUILT_OTHERWISE)
            or thing is kfopc_filterpy.controllers.Controller
        )
        assert ">>>" in doc or made_by_the_package, f"{name} has no example"


def described(doc: str | None) -> set[str]:
    """Names in the sections Parameters and Attributes of a numpydoc docstring."""
    names: set[str] = set()
    for title in ("Parameters", "Attributes"):
        section = re.search(rf"^{title}\n-+\n(.*?)(?=^\S[^\n]*\n-{{3,}}$|\Z)", inspect.cleandoc(doc or ""), re.M | re.S)
        for line in section[1].splitlines() if section else ():
            if line and not line[0].isspace():
                names |= {name.strip().lstrip("*") for name in line.split(" : ")[0].split(",")}
    return names


def arguments(function: Any) -> list[str]:
    return [name for name in inspect.signature(function).parameters if name not in ("self", "cls")]


def test_every_argument_of_a_public_name_is_described_in_its_docstring():
    for name, thing in PUBLIC:
        if inspect.isclass(thing) and (issubclass(thing, BUILT_OTHERWISE) or getattr(thing, "_is_protocol", False)):
            continue  # not called by users
        missing = set(arguments(thing)) - described(thing.__doc__)
        assert not missing, f"{name} leaves undescribed: {sorted(missing)}"


def methods(kind: type) -> list[tuple[str, Any]]:
    """Public methods that are this package's own."""
    found = inspect.getmembers(kind, lambda member: inspect.isfunction(member) or inspect.ismethod(member))
    mine = [(name, method) for name, method in found if method.__module__.startswith("kfopc_filterpy")]
    return [(name, method) for name, method in mine if not name.startswith("_") or name == "__call__"]


def full_text(kind: type, name: str, depth: int = 2) -> str:
    """Docstrings of a method along its bases, filterpy's included, and of the methods that they refer to."""
    own = [vars(base)[name] for base in kind.__mro__ if name in vars(base)]
    text = "\n".join(getattr(method, "__doc__", None) or "" for method in own)
    if depth:
        for other in set(re.findall(r"`(?:\w+\.)?(\w+)`", text)) - {name}:
            text += full_text(kind, other, depth - 1)
    return text


def test_every_argument_of_a_public_method_is_named_where_it_is_described():
    own = [(name, kind) for name, kind in PUBLIC if inspect.isclass(kind) and not issubclass(kind, BUILT_OTHERWISE)]
    for name, kind in own:
        for method_name, method in methods(kind):
            assert method.__doc__, f"{name}.{method_name} has no docstring"
            text = full_text(kind, method_name)
            missing = [argument for argument in arguments(method) if not re.search(rf"\b{argument}\b", text)]
            assert not missing, f"{name}.{method_name} leaves undescribed: {missing}"


# Figures of the pages.

CELL = re.compile(r"^```\{code-cell\}.*?^```$", flags=re.M | re.S)
DRAWS = re.compile(r"\bplt\.subplots\(|\bplot_\w+\(|^diagrams\.\w+\(", flags=re.M)


def drawing_cells(text: str) -> list[str]:
    """Cells of a page that leave a figure on it."""
    return [cell for cell in CELL.findall(text) if DRAWS.search(cell) and "remove-cell" not in cell]


def test_every_figure_that_a_page_draws_has_a_caption_and_words_in_its_place():
    for cell in (cell for page in PAGES for cell in drawing_cells(text_of(page))):
        settings = cell.split("---")[1] if cell.count("---") >= 2 else ""
        assert re.search(r"^  figure:\n    caption: \|\n      \S", settings, flags=re.M), f"no caption:\n{cell}"
        assert re.search(r"^  image:\n    alt: \S", settings, flags=re.M), f"no alternative text:\n{cell}"
