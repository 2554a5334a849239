"""Reference pages, written in every build: one for each public name, so that none is listed by hand."""

from __future__ import annotations

import importlib
import inspect
import os
from argparse import ArgumentParser, _SubParsersAction
from pathlib import Path
from typing import Any

import kfopc_filterpy
from kfopc_filterpy.commands import whole_parser

NOT_OURS = "KalmanFilter,tuple,Protocol,Exception"  # bases whose members are described elsewhere
NAMESPACES = (
    "",
    "filters",
    "power",
    "controllers",
    "paths",
    "signals",
    "bounds",
    "metrics",
    "export",
    "realtime",
    "plot",
    "verdict",
)

TASKS = {  # what the names of a folder are for
    "plant": "Describe a plant",
    "loop": "Simulate a run",
    "controllers": "Choose a controller, or write one",
    "filters": "Extend filterpy",
    "power": "Keep a rated power",
    "bounds": "Ask what is possible, and with which settings",
    "metrics": "Measure a run",
    "plot": "Draw figures",
    "signals": "Read recordings, make noises",
    "paths": "Model, measure and judge paths",
    "verdict": "Rate an amplifier",
    "realtime": "Run in real time",
    "export": "Take a controller to a board",
}


def names_of(namespace: str) -> list[str]:
    """Return the public names of a namespace ("" is the package itself) that no namespace before it has."""
    module = importlib.import_module(f"kfopc_filterpy.{namespace}") if namespace else kfopc_filterpy
    names = [name for name in module.__all__ if not inspect.ismodule(getattr(module, name))]
    return sorted((name for name in names if not namespace or name not in kfopc_filterpy.__all__), key=str.lower)


def public_names() -> list[str]:
    """Return every public name, dotted from the package on."""
    return [f"{space}.{name}" if space else name for space in NAMESPACES for name in names_of(space)]


def thing_of(name: str) -> Any:
    """Return what a dotted public name stands for."""
    space, _, last = name.rpartition(".")
    return getattr(importlib.import_module(f"kfopc_filterpy.{space}") if space else kfopc_filterpy, last)


def summary(thing: Any) -> str:
    """Return the first line of a docstring."""
    return (inspect.getdoc(thing) or "").split("\n")[0]


def name_page(name: str) -> str:
    """Return the page of one public name."""
    heading = f"{name}\n{'=' * len(name)}\n\n"
    if inspect.isclass(thing_of(name)):
        options = f"   :members:\n   :inherited-members: {NOT_OURS}\n"
        return f"{heading}.. autoclass:: kfopc_filterpy.{name}\n{options}"
    return f"{heading}.. autofunction:: kfopc_filterpy.{name}\n"


def index_page() -> str:
    """Return the tables of all public names, by task: each folder of the package serves one."""
    title = "API reference"
    lines = [title, "=" * len(title), ""]
    folders = {
        name: name.split(".")[0] if "." in name else thing_of(name).__module__.split(".")[1] for name in public_names()
    }
    for folder, task in TASKS.items():
        lines += [task, "-" * len(task), "", ".. list-table::", "   :widths: 35 65", ""]
        for name in [name for name in folders if folders[name] == folder]:
            lines += [f"   * - :doc:`{name} <{name}>`", f"     - {summary(thing_of(name))}"]
        lines.append("")
    lines += [
        "The command",
        "-----------",
        "",
        ":doc:`kfopc <kfopc>`: every subcommand, its options and the exit codes",
        "",
    ]
    pages = ["kfopc", *public_names()]
    return "\n".join([*lines, ".. toctree::", "   :hidden:", "", *(f"   {name}" for name in pages), ""])


def command_page() -> str:
    """Return the help of the command and of each subcommand."""
    os.environ["COLUMNS"] = "120"  # argparse wraps to the width of a terminal
    lines: list[str] = []

    def add(parser: ArgumentParser, underline: str) -> None:
        help_lines = [f"   {line}".rstrip() for line in parser.format_help().splitlines()]
        lines.extend([parser.prog, underline * len(parser.prog), "", ".. code-block:: text", "", *help_lines, ""])
        for action in parser._actions:
            for below in (action.choices or {}).values() if isinstance(action, _SubParsersAction) else ():
                add(below, "-")

    add(whole_parser(), "=")
    return "\n".join(lines)


def write_pages(app: Any) -> None:
    """Write what has changed, and remove pages of names that are gone."""
    folder = Path(app.srcdir) / "reference"
    folder.mkdir(exist_ok=True)
    pages = {"index": index_page(), "kfopc": command_page()}
    pages |= {name: name_page(name) for name in public_names()}
    for path in folder.glob("*.rst"):
        if path.name.removesuffix(".rst") not in pages:
            path.unlink()
    for stem, text in pages.items():
        path = folder / f"{stem}.rst"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def require_all(app: Any, env: Any) -> None:
    """Warn of a public name without an entry."""
    from sphinx.util import logging

    described = {name for name, *_ in env.get_domain("py").get_objects()}
    for name in public_names():
        if f"kfopc_filterpy.{name}" not in described:
            logging.getLogger(__name__).warning("the reference lacks kfopc_filterpy.%s", name)


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("builder-inited", write_pages)
    app.connect("env-check-consistency", require_all)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
