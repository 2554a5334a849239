"""Sphinx's settings: `python -m sphinx -W docs docs/_build/html`. The build does not need the network."""

from __future__ import annotations

import os
import socket
import sys
from importlib import metadata
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "extensions"))
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # in the kernels too: tutorials run in parallel
os.environ.pop("MPLBACKEND", None)  # notebooks draw inline; with another backend the pages would lack their figures
os.environ["MATPLOTLIBRC"] = str(Path(__file__).parent / "matplotlibrc")

project = "kfopc_filterpy"
version = metadata.version(project)
author = "The kfopc_filterpy developers"
copyright = author
exclude_patterns = ["_build", "figures", "**.ipynb_checkpoints"]

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.linkcode",
    "sphinx.ext.mathjax",
    "sphinx.ext.intersphinx",
    "numpydoc",
    "myst_nb",
    "sphinx_copybutton",
    "search_words",  # docs/extensions: words that the search ranks first
    "source_lines",  # docs/extensions: the package's source with line numbers, and links into it
    "public_names",  # docs/extensions: a reference page for each public name
    "listening",  # docs/extensions: the C core as WebAssembly, for the page that plays
    "offline",  # docs/extensions: nothing that a page loads comes from a network
]
from offline import mathjax_file  # noqa: E402
from source_lines import linkcode_resolve  # noqa: E402, F401

# MathJax is copied into the pages. It writes SVG, because browsers refuse the fonts of a page that is opened as a file.
mathjax_path = "tex-svg-full.js"
mathjax3_config = {"options": {"enableMenu": False}}  # the menu's settings load parts that are not in the file

# Tutorials are MyST text notebooks, executed anew in every build; a cell that raises ends it.
# .ci/run sets this variable: the tests run the tutorials, too.
nb_execution_excludepatterns = ["tutorials/*"] if os.environ.get("DOCS_WITHOUT_TUTORIALS") else []
nb_execution_mode = "force"
nb_execution_timeout = -1  # none: how long a tutorial takes is up to the machine
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_output_stderr = "warn"  # a warning in a cell is an error of the page
nb_render_markdown_format = "gfm"
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3
myst_links_external_new_tab = True

# numpydoc writes the docstrings; members come from autodoc, not from its own tables.
default_role = "py:obj"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "none"  # the docstrings say the types
python_use_unqualified_type_names = True

# `python -m sphinx -b linkcheck ...`: a missing network is not an error of the pages.
linkcheck_ignore = [r"(\.\./)*source/.*"]  # the role line has checked these
linkcheck_timeout = 10
linkcheck_anchors = False
linkcheck_allow_unauthorized = True

html_theme = "furo"
html_static_path = ["_static", mathjax_file()]
html_css_files = ["wide.css"]
html_title = f"{project} {version}"
html_baseurl = os.environ.get("READTHEDOCS_CANONICAL_URL", "")  # where search engines find the newest version
html_search_scorer = str(Path(__file__).parent / "extensions" / "scorer.js")
copybutton_exclude = ".linenos, .gp, .go"  # what is copied has no prompts and no output
html_copy_source = False
html_show_copyright = False
html_theme_options = {"sidebar_hide_name": False, "navigation_with_keys": True}


def spread_notebooks(app, env, docnames):
    """Spread the executed pages over the list, because Sphinx gives each process a stretch of it."""
    executed = [name for name in docnames if name.startswith("tutorials/") or name == "theory"]
    others = [name for name in docnames if name not in executed]
    step = -(-len(others) // max(len(executed), 1))
    docnames[:] = [name for k, page in enumerate(executed) for name in (page, *others[k * step : (k + 1) * step])]
    docnames += [name for name in others if name not in docnames]


def reachable(host):
    """Return whether a host answers."""
    try:
        socket.create_connection((host, 443), timeout=2).close()
    except OSError:
        return False
    return True


# Names of these packages in docstrings are links, if their pages can be reached during the build.
pages = {
    "python": "docs.python.org/3",
    "numpy": "numpy.org/doc/stable",
    "scipy": "docs.scipy.org/doc/scipy",
    "control": "python-control.readthedocs.io/en/latest",
    "matplotlib": "matplotlib.org/stable",
}
intersphinx_mapping = {
    name: (f"https://{page}/", None) for name, page in pages.items() if reachable(page.partition("/")[0])
}


def leave_links_offline(app):
    """If there is no network, check no external links and say so."""
    if app.builder.name == "linkcheck" and not reachable("github.com"):
        print("offline: external links are not checked")
        app.config.linkcheck_ignore.append("https?://.*")


def setup(app):
    app.connect("builder-inited", leave_links_offline)
    app.connect("env-before-read-docs", spread_notebooks)


suppress_warnings = ["misc.highlighting_failure"]  # IPython's lexer does not know a shell line that continues
