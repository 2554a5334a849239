"""Pages that show the package's source with numbered lines, and links to lines, found by their text.

The role ``{line}`core.kalman: S = x + q` `` links to the one line of ``kfopc_filterpy/core/kalman.c`` that
contains the text. If no line contains it, or several do, that is a warning: a page cannot keep pointing at code that has
moved or changed.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).resolve().parents[2] / "kfopc_filterpy"


def find_line(module: str, text: str) -> int:
    """Number, from 1, of the only line of a module that contains `text`; ValueError if there is none or more than one."""
    path = source_of(module)
    lines = path.read_text(encoding="utf-8").splitlines()
    found = [number for number, line in enumerate(lines, 1) if text in line]
    if len(found) != 1:
        raise ValueError(f"{len(found)} lines of {path.name} hold {text!r}, expected one")
    return found[0]


def source_of(module: str) -> Path:
    """File of a module, or the C file of the core."""
    python = PACKAGE / f"{module.replace('.', '/')}.py"
    return python if python.exists() else python.with_suffix(".c")


def page_of(module: str) -> str:
    """Name of the page that shows a module's source."""
    return f"source/{module.replace('.', '-')}"


def line_role(name: str, rawtext: str, text: str, lineno: int, inliner: Any, options: Any = None, content: Any = ()):
    """Link to a line of the source."""
    from docutils import nodes

    module, _, code = text.partition(": ")
    try:
        number = find_line(module, code)
    except (OSError, ValueError) as error:
        message = inliner.reporter.warning(f"role line: {error}", line=lineno)
        return [inliner.problematic(rawtext, rawtext, message)], [message]
    environment = inliner.document.settings.env
    up = "../" * environment.docname.count("/")
    link = nodes.reference(rawtext, "", refuri=f"{up}{page_of(module)}.html#L-{number}", internal=True)
    link += nodes.literal(code, code)
    return [link, nodes.inline("", f" ({source_of(module).relative_to(PACKAGE).as_posix()}, line {number})")], []


def linkcode_resolve(domain: str, info: dict[str, str]) -> str | None:
    """Link of a reference page, all of which lie in one folder, to the source of what it describes."""
    import kfopc_filterpy

    thing: Any = kfopc_filterpy if info["module"] == "kfopc_filterpy" else __import__(info["module"], fromlist=["_"])
    for part in info["fullname"].split("."):
        thing = getattr(thing, part, None)
    thing = inspect.unwrap(thing.fget if isinstance(thing, property) and thing.fget else thing) if thing else None
    try:
        path, number = Path(inspect.getsourcefile(thing) or ""), inspect.getsourcelines(thing)[1]
    except (OSError, TypeError):
        return None
    if PACKAGE not in path.parents:
        return None
    return f"../{page_of('.'.join(path.relative_to(PACKAGE).with_suffix('').parts))}.html#L-{number}"


def source_pages(app: Any) -> Iterator[tuple[str, dict[str, Any], str]]:
    """A page for each module and each C file of the core."""
    from pygments import highlight
    from pygments.formatters import HtmlFormatter
    from pygments.lexers import CLexer, PythonLexer

    for path in sorted([*PACKAGE.rglob("*.py"), *(PACKAGE / "core").glob("*.c")]):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        formatter = HtmlFormatter(linenos="inline", lineanchors="L", anchorlinenos=True, wrapcode=True)
        title = f"kfopc_filterpy/{'/'.join(parts)}{path.suffix}"
        body = f"<h1>{title}</h1>{highlight(path.read_text(encoding='utf-8'), (PythonLexer if path.suffix == '.py' else CLexer)(), formatter)}"
        yield page_of(".".join(parts)), {"title": title, "body": body, "parents": []}, "page.html"


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.add_role("line", line_role)
    app.connect("html-collect-pages", source_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
