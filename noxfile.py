#!/usr/bin/env python3
# /// script
# dependencies = ["nox>=2024.10.9"]
# ///
"""Tasks: `nox -l` lists them, `nox -s docs` runs one. What follows `--` goes to pytest, Sphinx or cosmic-ray.

`.ci/run` is no session: it runs the README's own commands from a fresh clone, and what it can beside one another.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import random
import re
import shutil
import sqlite3
from pathlib import Path

import nox

nox.needs_version = ">=2024.10.9"
nox.options.default_venv_backend = "virtualenv"  # `range` asks the pip of its environment
nox.options.error_on_missing_interpreters = True

PINNED = ("-c", "constraints.txt")
PROJECT = nox.project.load_toml("pyproject.toml")
COMPUTED = ["tests/filters", "tests/loop", "tests/power", "tests/bounds", "tests/paths", "tests/test_metrics.py"]
COVERED = ["filters", "loop", "power", "core"]
EVERY_NAME_AND_README = """
import doctest
import inspect

import kfopc_filterpy

spaces, count = [kfopc_filterpy], 0
for space in spaces:
    for name in space.__all__:
        value = getattr(space, name)
        if inspect.ismodule(value):
            spaces.append(value)
        count += 1
print(count, "public names in", len(spaces), "namespaces of", kfopc_filterpy.__version__)
failed, examples = doctest.testfile("README.md", module_relative=False)
print(examples, "lines of README's examples,", failed, "wrong")
raise SystemExit(failed > 0)
"""


def install_group(session: nox.Session, *groups: str) -> None:
    """Install dependency groups, as pinned; the pip that CPython 3.11 and 3.12 bring does not know them."""
    session.install(*PINNED, *nox.project.dependency_groups(PROJECT, *groups))


@nox.session
def lint(session: nox.Session) -> None:
    """Run ruff, mypy, codespell, reuse, zizmor and Scientific Python's review."""
    session.install(*PINNED, "-e", ".[test]")
    install_group(session, "lint")
    session.run("pre-commit", "run", "--all-files", "--show-diff-on-failure", *session.posargs)


@nox.session
def tests(session: nox.Session) -> None:
    """Run the tests, without those marked slow."""
    session.install(*PINNED, "-e", ".[test]")
    session.run("python", "-m", "pytest", *session.posargs)


@nox.session
def docs(session: nox.Session) -> None:
    """Build the documentation, with every page executed."""
    session.install(*PINNED, "-e", ".[docs]")
    session.run(*["python", "-m", "sphinx", "-W", "-j", "auto", "docs", "docs/_build/html"], *session.posargs)


@nox.session(default=False)
def coverage(session: nox.Session) -> None:
    """Measure which branches the tests of the computing folders take, and ask for 95 %."""
    session.install(*PINNED, "-e", ".[test]")
    install_group(session, "coverage")
    session.run(
        *("python", "-m", "pytest", "--cov", "--cov-report=term-missing:skip-covered"),
        *(session.posargs or [f"tests/{name}" for name in COVERED]),
    )


@nox.session(name="range", python=nox.project.python_versions(PROJECT), default=False)
@nox.parametrize("end", ["oldest", "newest"])
def ends_of_the_range(session: nox.Session, end: str) -> None:
    """Run tests and the README on an end of the supported range.

    The oldest versions are the lower bounds of pyproject.toml, the newest those that pip finds, without constraints.txt.
    Without arguments, the tests of what is computed are run, not those of pages and figures. Warnings are errors.
    """
    work = Path(session.create_tmp()).resolve()
    limits = []
    if end == "oldest":
        (work / "oldest.txt").write_text("\n".join(lower_bounds()), encoding="utf-8")
        limits = ["-c", str(work / "oldest.txt")]
    session.install(*limits, "-e", ".[test]")
    session.run("python", "-m", "pip", "check")
    session.run("python", "-m", "pip", "freeze", "--exclude-editable")
    session.run("python", "-m", "pytest", *(session.posargs or COMPUTED))

    # README's Install section, from the wheel in an empty environment: every public name, and README's examples.
    session.run("python", "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(work / "dist"), ".")
    session.run("python", "-m", "venv", "--clear", str(work / "empty"))
    python = str(work / "empty" / ("Scripts" if os.name == "nt" else "bin") / "python")
    (wheel,) = (work / "dist").glob("*.whl")
    session.run(python, "-m", "pip", "install", "-q", *limits, str(wheel), external=True)
    session.run(python, "-m", "pip", "check", external=True)
    (work / "README.md").write_bytes(Path("README.md").read_bytes())
    with session.chdir(work):
        session.run(python, "-I", "-W", "error", "-c", EVERY_NAME_AND_README, external=True)


def lower_bounds() -> list[str]:
    """Return each requirement's lower bound as a pin."""
    project, bounds = PROJECT["project"], {}
    for requirement in itertools.chain(project["dependencies"], *project["optional-dependencies"].values()):
        if found := re.match(r"([A-Za-z0-9._-]+)>=([0-9.]+)", requirement):
            name, version = found.groups()
            if bounds.setdefault(name, version) != version:
                raise ValueError(f"two lower bounds of {name}: {bounds[name]} and {version}")
    # matplotlib 3.8 calls names that pyparsing 3.3 warns about, and does not bound it.
    return [*(f"{name}=={version}" for name, version in sorted(bounds.items())), "pyparsing<3.3"]


@nox.session(default=False)
def mutants(session: nox.Session) -> None:
    """Change a package at some random places, and print the changes that its tests miss: `-- power 40`.

    The packages are the files in tests/mutants/, and so are the tests that must fail. Without a number, every mutant is run.
    """
    name, *number = session.posargs or ["power", "40"]
    tree = Path(session.create_tmp()).resolve() / "tree"
    shutil.rmtree(tree, ignore_errors=True)
    session.run("git", "checkout-index", "--all", f"--prefix={tree}/", external=True)  # what is changed is a copy
    session.install(*PINNED, "-e", f"{tree}[test]")
    install_group(session, "mutants")
    with session.chdir(tree):
        config, found = f"tests/mutants/{name}.toml", f"{name}.sqlite"
        session.run("cosmic-ray", "init", config, found)
        session.run("cr-filter-operators", found, config)
        if number:
            keep_some(found, int(number[0]))
        # Python compares the times and sizes of files, which a mutant may share with the file before it.
        session.run("cosmic-ray", "exec", config, found, env={"PYTHONDONTWRITEBYTECODE": "1"})
        session.run("cr-report", "--surviving-only", "--show-diff", found)


def keep_some(found: str, count: int) -> None:
    """Leave a number of mutants that wait in a session of cosmic-ray, the same ones each time, and remove the others."""
    with contextlib.closing(sqlite3.connect(found)) as database, database:
        waiting = database.execute(
            "SELECT job_id FROM mutation_specs WHERE job_id NOT IN (SELECT job_id FROM work_results) "
            "ORDER BY module_path, start_pos_row, start_pos_col, operator_name, operator_args, occurrence"
        ).fetchall()
        kept = [job for (job,) in random.Random(0).sample(waiting, count)]
        for table in ("work_results", "mutation_specs", "work_items"):
            database.execute(f"DELETE FROM {table} WHERE job_id NOT IN ({', '.join('?' * count)})", kept)


@nox.session(venv_backend="none", default=False)
def slow(session: nox.Session) -> None:
    """Run the slow set: other compilers and systems, long runs, all wheels, a minute of fuzzing."""
    session.run("bash", ".ci/slow", *session.posargs, external=True)


@nox.session(venv_backend="none", default=False)
def wheels(session: nox.Session) -> None:
    """Make the wheels of all systems, in dist/ or the folder that is given."""
    session.run("bash", ".ci/wheels", *session.posargs, external=True)


if __name__ == "__main__":
    nox.main()
