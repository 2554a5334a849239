"""The built pages read without a network: MathJax comes with them, and a build fails if a page loads anything remote."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from typing import Any

REMOTE = re.compile(r"(https?:)?//")
REMOTE_IN_STYLE = re.compile(r"""(?:url\(|@import)\s*["']?((?:https?:)?//[^"')\s;]+)""")
LOADED_LINKS = {"stylesheet", "icon", "preload", "modulepreload", "manifest"}  # other links are followed, not loaded


class Resources(HTMLParser):
    """Collects what a browser loads from elsewhere to show a page: scripts, styles, images, sounds, frames."""

    def __init__(self) -> None:
        super().__init__()
        self.remote: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Called for each element."""
        given = dict(attrs)
        loads_link = tag == "link" and LOADED_LINKS & set((given.get("rel") or "").split())
        address = (given.get("href") if loads_link else given.get("src") or given.get("data")) or ""
        if REMOTE.match(address):
            self.remote.append(address)
        self.remote += REMOTE_IN_STYLE.findall(given.get("style") or "")


def remote_resources(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield each page or style sheet of a folder with the address of a resource that it loads from a network."""
    for path in sorted(folder.rglob("*")):
        if path.suffix == ".html":
            reader = Resources()
            reader.feed(path.read_text(encoding="utf-8"))
            found = reader.remote
        elif path.suffix == ".css":
            found = REMOTE_IN_STYLE.findall(path.read_text(encoding="utf-8"))
        else:
            continue
        yield from ((str(path.relative_to(folder)), address) for address in found)


def mathjax_file() -> str:
    """Return the path of MathJax in one file: all of TeX, and output as SVG, which needs no fonts."""
    package = find_spec("sphinx-mathjax-offline")
    if package is None or not package.submodule_search_locations:
        raise ModuleNotFoundError(
            "the pages need MathJax from the package sphinx-mathjax-offline; install the extra: pip install -e '.[docs]'"
        )
    return str(Path(package.submodule_search_locations[0]) / "static" / "mathjax" / "tex-svg-full.js")


def require_offline(app: Any, exception: Exception | None) -> None:
    """Fail if a built page loads something from a network."""
    if exception is None and app.builder.format == "html":
        remote = [f"{page} loads {address}" for page, address in remote_resources(Path(app.outdir))]
        if remote:
            raise ValueError("pages must read without a network, but\n" + "\n".join(remote))


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("build-finished", require_offline)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
