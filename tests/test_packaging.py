"""What a user meets before any filter runs: metadata, import cost, pinned versions, the README's commands."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.resources
import inspect
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import kfopc_filterpy

ROOT = Path(__file__).resolve().parents[1]
DISTRIBUTION = "kfopc-filterpy"
SET_UP = "python3 -m venv .venv && .venv/bin/python -m pip install -q -c constraints.txt -e"
README_COMMANDS = [
    f'{SET_UP} ".[test]" && .venv/bin/python -m pytest',
    f'{SET_UP} ".[studies]" && .venv/bin/python -m comparisons',
    f'{SET_UP} ".[docs]" && .venv/bin/python -m sphinx -W -j auto docs docs/_build/html',
]
# Extras and groups that the tests run without.
NOT_FOR_TESTS = ("benchmark", "docs", "fmu", "realtime", "coverage", "dev", "lint", "mutants")
LOADED_WHEN_FIRST_USED = ("jinja2", "control", "h5py", "matplotlib", "pooch", "soundfile", "tqdm")


def read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def pins() -> dict[str, str]:
    """Return the version of each package that constraints.txt pins, by normalised name."""
    lines = [line for line in read("constraints.txt").splitlines() if line and not line.startswith("#")]
    pairs = [line.split("==") for line in lines]
    assert all(len(pair) == 2 for pair in pairs), "every line of constraints.txt is name==version"
    versions = {str(canonicalize_name(name)): version for name, version in pairs}
    assert len(versions) == len(lines), "constraints.txt names a package twice"
    return versions


def requirements(without: tuple[str, ...] = ()) -> list[Requirement]:
    """Return what pyproject.toml asks for, extras and groups but those named included, the package itself left out."""
    tables = tomllib.loads(read("pyproject.toml"))
    project = tables["project"]
    named = project["optional-dependencies"] | tables["dependency-groups"]
    groups = [project["dependencies"], *(lines for name, lines in named.items() if name not in without)]
    parsed = [Requirement(line) for group in groups for line in group if isinstance(line, str)]
    return [requirement for requirement in parsed if requirement.name != DISTRIBUTION]


@pytest.mark.parametrize("statement", ["import kfopc_filterpy", "from kfopc_filterpy import KFOPC"])
def test_import_leaves_heavy_modules_for_later_and_warns_of_nothing(statement):
    code = f"import sys; {statement}; print(*sorted(set(sys.modules) & set({LOADED_WHEN_FIRST_USED})))"
    command = [sys.executable, "-W", "error", "-c", code]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == [], f"{statement} loads {run.stdout.strip()}"


def test_the_studies_name_what_they_miss():
    """Each package of their extra is looked for before any study is imported."""
    extra = tomllib.loads(read("pyproject.toml"))["project"]["optional-dependencies"]["studies"]
    names = [Requirement(line).name for line in extra]
    code = f"import sys; sys.modules.update(dict.fromkeys({names})); import comparisons"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert f"ImportError: the studies need {', '.join(names)}" in run.stderr
    assert '-m pip install -e ".[studies]"' in run.stderr


def test_every_python_that_is_started_ignores_the_current_folder():
    """A json.py beside a user's recordings is not ours to run."""
    started = [
        (path.name, option)
        for folder in ("kfopc_filterpy", "comparisons", "docs/extensions")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for option in re.findall(r"sys\.executable,\s*([^,]*)", path.read_text(encoding="utf-8"))
    ]
    assert started
    assert [one for one in started if one[1] != '"-P"'] == []


def test_no_test_looks_at_a_wall_clock():
    """On a busy machine it would fail. CPU time may be measured, and a sound card's time is real."""
    clock = re.compile(r"\b(sleep|perf_counter|monotonic|time\.time|datetime\.now)\(")
    found = {path.name for path in (ROOT / "tests").rglob("*.py") if clock.search(path.read_text(encoding="utf-8"))}
    assert found == {"test_jack.py"}


PARTS = [
    *("filters", "power", "controllers", "paths", "signals", "bounds"),
    *("metrics", "export", "realtime", "plot", "verdict"),
]


@pytest.mark.parametrize("namespace", ["kfopc_filterpy", *(f"kfopc_filterpy.{part}" for part in PARTS)])
def test_public_names_resolve_and_are_listed_once(namespace):
    module = importlib.import_module(namespace)
    assert module.__all__
    assert len(set(module.__all__)) == len(module.__all__)
    for name in module.__all__:
        thing = getattr(module, name)
        assert thing is not None
        assert name in dir(module)
        hides = Path(module.__file__).with_name(f"{name}.py").exists() and not inspect.ismodule(thing)
        assert not hides, f"importing {name}.py would put the module in place of the name"


def test_every_public_folder_is_an_attribute_and_a_misspelt_name_says_what_was_meant():
    package = importlib.import_module("kfopc_filterpy")
    folders = {stub.parent.name for stub in (ROOT / "kfopc_filterpy").glob("*/__init__.pyi")}
    assert folders == {part for part in PARTS if (ROOT / "kfopc_filterpy" / part).is_dir()}
    assert all(inspect.ismodule(getattr(package, name)) and name in package.__all__ for name in folders)
    for wrong, meant in {
        "KFOCP": "KFOPC",
        "kf_obc": "kf_opc",
        "constraned": r"kfopc_filterpy\.filters\.constrained",
    }.items():
        with pytest.raises(AttributeError, match=rf"has no attribute '{wrong}'; did you mean {meant}\?"):
            getattr(package, wrong)
        with pytest.raises(
            ImportError, match=rf"cannot import name '{wrong}' from 'kfopc_filterpy'; did you mean {meant}\?"
        ):
            exec(f"from kfopc_filterpy import {wrong}")
    exec("from kfopc_filterpy import checkpoint, filters, core")  # folders and files that are no public names
    with pytest.raises(AttributeError, match=r"has no attribute 'nothing_like_it'$"):
        _ = package.nothing_like_it
    assert not hasattr(package, "_repr_html_")


def test_the_package_never_imports_the_comparisons_and_its_wheel_has_none_of_them():
    wheel = tomllib.loads(read("pyproject.toml"))["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["packages"] == ["kfopc_filterpy"]
    for path in (ROOT / "kfopc_filterpy").rglob("*.py"):
        assert not re.search(r"\bcomparisons\b", path.read_text(encoding="utf-8")), path


def test_package_is_typed():
    assert (importlib.resources.files("kfopc_filterpy") / "py.typed").is_file()


def test_version_is_the_same_everywhere():
    version = kfopc_filterpy.__version__
    cited = re.search(r"^version: *[\"']?([^\"'\s]+)", read("CITATION.cff"), flags=re.MULTILINE)
    assert importlib.metadata.version(DISTRIBUTION) == version, "install the clone again"
    assert cited is not None
    assert cited[1] == version
    released = re.search(r"^date-released: *(\S+)$", read("CITATION.cff"), flags=re.MULTILINE)
    assert released is not None
    headings = [line for line in read("CHANGELOG.md").splitlines() if line.startswith("## ")]
    assert headings == [f"## [{version}] - {released[1]}"]


def test_every_requirement_is_pinned_within_its_range():
    versions = pins()
    for requirement in requirements():
        name = str(canonicalize_name(requirement.name))
        assert name in versions, f"constraints.txt does not pin {name}"
        assert versions[name] in requirement.specifier, f"{name}=={versions[name]} is not {requirement}"


def test_everything_an_install_brings_is_pinned():
    """Follow the requirements of what is installed, from this package's own down to the last.

    What NOT_FOR_TESTS names need not be installed; what of it is, is followed too.
    """
    versions = pins()
    always = {str(canonicalize_name(requirement.name)) for requirement in requirements(without=NOT_FOR_TESTS)}
    waiting, seen = [str(canonicalize_name(requirement.name)) for requirement in requirements()], set()
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        if name not in always and not list(importlib.metadata.distributions(name=name)):
            continue
        for line in importlib.metadata.requires(name) or []:
            requirement = Requirement(line)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                waiting.append(str(canonicalize_name(requirement.name)))
    assert seen <= set(versions), f"constraints.txt does not pin {sorted(seen - set(versions))}"


@pytest.mark.parametrize("command", README_COMMANDS)
def test_readme_states_the_command_on_a_line_of_its_own(command):
    assert command in [line.strip() for line in read("README.md").splitlines()]


def test_the_installation_page_says_what_each_extra_is_for():
    rows = re.findall(r"^\| (`.*?) \|", read("docs/install.md"), flags=re.M)
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert sorted(named) == sorted(tomllib.loads(read("pyproject.toml"))["project"]["optional-dependencies"])
