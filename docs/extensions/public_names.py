"""Reference pages, written anew in every build: one for each public name, so that none is listed by hand."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path
from typing import Any

import kfopc_filterpy

FIGURES = ("plotting", "path_plots")  # modules of figures, public as a whole
NOT_OURS = "KalmanFilter,tuple,Protocol,Exception"  # bases whose members are described elsewhere


def module_of(name: str) -> str:
    """Module, within the package, in which a public name is defined."""
    return getattr(kfopc_filterpy, name).__module__.removeprefix("kfopc_filterpy.")


def summary(thing: Any) -> str:
    """First line of a docstring."""
    return (inspect.getdoc(thing) or "").split("\n")[0]


def name_page(name: str) -> str:
    """Page of one public name."""
    heading = f"{name}\n{'=' * len(name)}\n\n"
    if inspect.isclass(getattr(kfopc_filterpy, name)):
        options = f"   :members:\n   :inherited-members: {NOT_OURS}\n"
        return f"{heading}.. autoclass:: kfopc_filterpy.{name}\n{options}"
    return f"{heading}.. autofunction:: kfopc_filterpy.{name}\n"


def figure_page(module: str) -> str:
    """Page of a module of figures."""
    name = f"kfopc_filterpy.{module}"
    members = figure_names(module)
    described = "".join(f".. autofunction:: {name}.{member}\n\n" for member in members)
    return f"{name}\n{'=' * len(name)}\n\n.. automodule:: {name}\n   :no-members:\n\n{described}"


def figure_names(module: str) -> list[str]:
    """Functions of a module of figures."""
    content = importlib.import_module(f"kfopc_filterpy.{module}")
    names = getattr(content, "__all__", None)
    return list(names or sorted(name for name in vars(content) if name.startswith("plot_")))


def index_page() -> str:
    """Table of all public names, by the modules that define them."""
    modules: dict[str, list[str]] = {}
    for name in kfopc_filterpy.__all__:
        modules.setdefault(module_of(name), []).append(name)
    title = "Every public name"
    lines = [title, "=" * len(title), "", "All but the figures are imported from ``kfopc_filterpy`` itself.", ""]
    for module in sorted(modules):
        content = importlib.import_module(f"kfopc_filterpy.{module}")
        lines += [module, "-" * len(module), "", summary(content), "", ".. list-table::", "   :widths: 30 70", ""]
        for name in sorted(modules[module]):
            lines += [f"   * - :doc:`{name} <{name}>`", f"     - {summary(getattr(kfopc_filterpy, name))}"]
        lines.append("")
    lines += ["Figures", "-------", "", *(f"- :doc:`{module}`" for module in FIGURES), ""]
    entries = [*sorted(kfopc_filterpy.__all__, key=str.lower), *FIGURES]
    return "\n".join([*lines, ".. toctree::", "   :hidden:", "", *(f"   {entry}" for entry in entries), ""])


def write_pages(app: Any) -> None:
    """Write what has changed, and remove pages of names that are gone."""
    folder = Path(app.srcdir) / "reference"
    folder.mkdir(exist_ok=True)
    pages = {"index": index_page()}
    pages |= {name: name_page(name) for name in kfopc_filterpy.__all__}
    pages |= {module: figure_page(module) for module in FIGURES}
    for path in folder.glob("*.rst"):
        if path.stem not in pages:
            path.unlink()
    for stem, text in pages.items():
        path = folder / f"{stem}.rst"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def require_all(app: Any, env: Any) -> None:
    """Warn of a public name without an entry."""
    from sphinx.util import logging

    described = {name for name, *_ in env.get_domain("py").get_objects()}
    for name in kfopc_filterpy.__all__:
        if f"kfopc_filterpy.{name}" not in described:
            logging.getLogger(__name__).warning("the reference lacks kfopc_filterpy.%s", name)


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("builder-inited", write_pages)
    app.connect("env-check-consistency", require_all)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
