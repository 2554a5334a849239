#!/usr/bin/env python3
# /// script
# dependencies = ["nox>=2026.8.10"]
# ///
"""Tasks: `nox -l` lists them, `nox -s docs` runs one. What follows `--` goes to pytest, Sphinx, the studies or cosmic-ray.

`.ci/run` runs those marked with a star, `.ci/slow` runs bare, wheels, slow, kernels and prove; both install nox.
Sessions that leave cores idle may run beside one another (`nox -j 2`).
"""

from __future__ import annotations

import contextlib
import itertools
import os
import random
import re
import shutil
import signal
import sqlite3
import zipfile
from pathlib import Path

import nox

nox.needs_version = ">=2026.8.10"
nox.options.default_venv_backend = "virtualenv"  # its environments have pip, which some sessions run
nox.options.error_on_missing_interpreters = True
signal.signal(signal.SIGTERM, signal.default_int_handler)  # like Ctrl-C, at which nox ends the other sessions

PINNED = ("-c", "constraints.txt")
PROJECT = nox.project.load_toml("pyproject.toml")
COMPUTED = ["tests/filters", "tests/loop", "tests/power", "tests/bounds", "tests/paths", "tests/test_metrics.py"]
COVERED = ["filters", "loop", "power", "core"]
# The tags of wheels, and the machines in zig's words, with the oldest C library or system.
SYSTEMS = {
    "manylinux_2_17_x86_64": "x86_64-linux-gnu.2.17",
    "manylinux_2_17_aarch64": "aarch64-linux-gnu.2.17",
    "musllinux_1_1_x86_64": "x86_64-linux-musl",
    "musllinux_1_1_aarch64": "aarch64-linux-musl",
    "macosx_11_0_x86_64": "x86_64-macos.11.0",
    "macosx_11_0_arm64": "aarch64-macos.11.0",
    "win_amd64": "x86_64-windows-gnu",
}
# Tolerances of rounding, as the tests write them: a number below 1e-5 behind a keyword, a comparison, 1 +, or a constant's
# name. Larger ones are those of a method or of statistics.
TOLERANCE = re.compile(
    r'((tol|rel|abs)=|"abs": |[<>]=? (-|1(\.0)? [+-] )?|\(1(\.0)? [+-] (?=\S+\))|^[A-Z]+ = )[1-9](\.\d+)?e-([6-9]|\d\d)\b',
    re.M,
)
EVERY_NAME = """
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
"""


def run_readme(session: nox.Session, module: str, *written: str, **env: str) -> None:
    """Run README's command line for a module, word for word, and check that it has written these files."""
    form = rf"python3 -m venv \.venv && .+ && \.venv/bin/python -m {module}\b.*"
    lines = [line for line in Path("README.md").read_text(encoding="utf-8").splitlines() if re.fullmatch(form, line)]
    if len(lines) != 1:
        session.error(f"README.md must state one line of this form, and has {len(lines)}: {form}")
    line = lines[0].replace("/bin/", "/Scripts/") if os.name == "nt" else lines[0]
    session.run("sh", "-c", f'{line} "$@"', "sh", *session.posargs, env=env)
    if missing := [name for name in written if not Path(name).is_file()]:
        session.error(f"README's command has not written {missing}")


def install_group(session: nox.Session, *groups: str) -> None:
    """Install dependency groups, as pinned; the pip that CPython 3.11 and 3.12 bring does not know them."""
    session.install(*PINNED, *nox.project.dependency_groups(PROJECT, *groups))


def copy_tree(session: nox.Session) -> Path:
    """Return a folder with a copy of the files in git's index, which has no built libraries."""
    tree = Path(session.create_tmp()).resolve() / "tree"
    shutil.rmtree(tree, ignore_errors=True)
    session.run("git", "checkout-index", "--all", f"--prefix={tree}/", external=True)
    return tree


def build_wheel(session: nox.Session, *options: str, folder: Path, **env: str | None) -> Path:
    """Build a wheel in a folder, and return its path."""
    session.run("python", "-m", "pip", "wheel", "-q", "--no-deps", *options, "-w", str(folder), ".", env=env)
    return max(folder.glob("*.whl"), key=lambda path: path.stat().st_mtime)


def use_wheel(session: nox.Session, wheel: Path, python: str = "python", limits: tuple[str, ...] = PINNED) -> None:
    """Install a wheel in an empty environment, and use every public name and README's examples; warnings are errors."""
    session.run(python, "-m", "pip", "install", "-q", *limits, str(wheel), external=True)
    session.run(python, "-m", "pip", "check", external=True)
    for what in (("-c", EVERY_NAME), ("tests/helpers/readme.py",)):
        session.run(python, "-I", "-W", "error", *what, external=True)


@nox.session(venv_backend="none")
def tests(session: nox.Session) -> None:
    """Run README's command for the tests, which leaves out those marked slow."""
    run_readme(session, "pytest")


@nox.session(venv_backend="none", allow_parallel=True)
def studies(session: nox.Session) -> None:
    """Run README's command for the paper's studies."""
    run_readme(session, "comparisons", "studies/report.html", TQDM_MININTERVAL="20")  # seconds, for a short log


@nox.session(venv_backend="none")
def docs(session: nox.Session) -> None:
    """Run README's command for the documentation; with DOCS_WITHOUT_TUTORIALS=1 the tutorials are not executed."""
    shutil.rmtree("docs/_build", ignore_errors=True)
    run_readme(session, "sphinx", "docs/_build/html/index.html", "docs/_build/html/searchindex.js")


@nox.session(allow_parallel=True)
def lint(session: nox.Session) -> None:
    """Run ruff, mypy and the other hooks of .pre-commit-config.yaml."""
    session.install(*PINNED, "-e", ".[test]")
    install_group(session, "lint")
    session.run("pre-commit", "run", "--all-files", "--show-diff-on-failure", *session.posargs)


@nox.session(allow_parallel=True)
def wheel(session: nox.Session) -> None:
    """Build the wheel, compare its files with the tree's, and use it in an environment of its own."""
    built = build_wheel(session, folder=Path(session.create_tmp()).resolve())
    packed = {name for name in zipfile.ZipFile(built).namelist() if ".dist-info/" not in name}
    libraries = {name for name in packed if name.startswith("kfopc_filterpy/core/libanc-")}  # built, not in the tree
    listing = ("git", "ls-files", "--cached", "--others", "--exclude-standard", "kfopc_filterpy")
    expected = {name for name in session.run(*listing, external=True, silent=True).splitlines() if Path(name).exists()}
    if different := expected ^ (packed - libraries):
        session.error(f"these files are in the tree alone, or in the wheel alone: {sorted(different)}")
    for real in ("double", "float"):
        if not any(f"{real}-baseline" in name for name in libraries):
            session.error(f"the wheel has no {real} library for every processor, but {sorted(libraries)}")
    use_wheel(session, built)


@nox.session(name="filterpy-1.4.5", allow_parallel=True)
def older_filterpy(session: nox.Session) -> None:
    """Run the estimator's tests on filterpy 1.4.5."""
    session.install(*PINNED, "-e", ".[test]")
    session.install("--no-deps", "filterpy==1.4.5")
    kinds = ("against", "filterpy", "random_walk", "rated_power", "refusals")
    session.run(
        "python", "-m", "pytest", *(str(f) for kind in kinds for f in Path("tests/filters").glob(f"test_{kind}*"))
    )


@nox.session(default=False)
def bare(session: nox.Session) -> None:
    """Install without a C compiler: pip fetches zig's, or, without a network too, the message says what to install."""
    tree, without_compiler = str(copy_tree(session)), {"PATH": "", "CC": None}
    session.install("hatchling>=1.25")
    said = session.run(
        *("python", "-m", "pip", "install", "--no-deps", "--no-build-isolation", tree),
        env={**without_compiler, "PIP_NO_INDEX": "1"},
        success_codes=[1],
        silent=True,
    )
    if not re.search(r"needs a C compiler: install gcc or clang .* -m pip install ziglang", said):
        session.error(f"no line says what to install: {said}")
    session.install("--no-deps", tree, env=without_compiler)
    session.install(*PINNED, "--no-deps", "numpy", "lazy-loader", "packaging")
    load = "from kfopc_filterpy.core.library import load; print(load('double').path.name, load('float').path.name)"
    session.run("python", "-I", "-c", load)


@nox.session(default=False)
def wheels(session: nox.Session) -> None:
    """Make the wheels of all systems in dist/, with zig's compiler."""
    session.install("hatchling>=1.25", "ziglang>=0.13")
    zig = f"'{shutil.which('python', path=session.bin)}' -P -m ziglang cc"
    own = {"CC": zig, "CFLAGS": None, "CPPFLAGS": None, "LDFLAGS": None}
    dist = Path("dist")
    shutil.rmtree(dist, ignore_errors=True)
    for tag, target in SYSTEMS.items():
        own |= {"KFOPC_PLATFORM": tag, "KFOPC_TARGET": target}
        session.log(build_wheel(session, "--no-build-isolation", folder=dist, **own).name)


@nox.session(default=False, requires=["wheels"])
def slow(session: nox.Session) -> None:
    """Run the tests marked slow: other compilers and systems, all wheels, long runs, filterpy 1.4.5's own tests."""
    session.install(*PINNED, "-e", ".[docs,test,fmu]")
    session.install("sounddevice", "JACK-Client")
    session.run("python", "-m", "pytest", "-m", "slow", *(session.posargs or ["tests"]), env={"KFOPC_WHEELS": "dist"})
    session.install("--no-deps", "filterpy==1.4.5")
    session.run("python", "-m", "pytest", "-m", "slow", "-n0", "tests/filters/test_filterpy_own_tests.py")


@nox.session(venv_backend="none", default=False)
def kernels(session: nox.Session) -> None:
    """Run README's tests with the kernels of an old processor, which sum in another order, and a third of each tolerance.

    In a copy, each tolerance of rounding is divided by three, so that none rests on what one machine rounds to.
    """
    tree, data = copy_tree(session), Path(os.environ.get("KFOPC_DATA", "../shared/data")).resolve()
    for path in tree.glob("tests/**/test_*.py"):
        path.write_text(TOLERANCE.sub(r"\g<0> / 3", path.read_text(encoding="utf-8")), encoding="utf-8")
    with session.chdir(tree):
        old = {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4"}
        run_readme(session, "pytest", KFOPC_DATA=str(data), **old)


@nox.session(venv_backend="none", default=False)
def prove(session: nox.Session) -> None:
    """Prove what the C core promises with Frama-C, Why3 and Gappa; skipped if this machine lacks one of them."""
    tools = ("frama-c", "why3", "z3", "cvc4", "gappa")
    if missing := [tool for tool in tools if shutil.which(tool) is None]:
        session.skip(f"not installed: {', '.join(missing)}")
    session.run("python3", "tests/proofs/prove.py", external=True)


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
    limits: tuple[str, ...] = ()
    if end == "oldest":
        (work / "oldest.txt").write_text("\n".join(lower_bounds()), encoding="utf-8")
        limits = ("-c", str(work / "oldest.txt"))
    session.install(*limits, "-e", ".[test]")
    session.run("python", "-m", "pip", "check")
    session.run("python", "-m", "pip", "freeze", "--exclude-editable")
    session.run("python", "-m", "pytest", *(session.posargs or COMPUTED))
    session.run("python", "-m", "venv", "--clear", str(work / "empty"))
    python = work / "empty" / ("Scripts" if os.name == "nt" else "bin") / "python"
    use_wheel(session, build_wheel(session, folder=work), str(python), limits)


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
    """Change a package, or a C file of the core, at random places, and print what its tests miss: `-- power 40`, `-- lms.c`.

    The packages are the files in tests/mutants/, and so are the tests that must fail. Without a number, every mutant is run.
    """
    name, *number = session.posargs or ["power", "40"]
    if name.endswith(".c"):
        session.install(*PINNED, "-e", ".[test]")
        session.run("python", "tests/mutants/core.py", name, *number)
        return
    tree = copy_tree(session)
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


if __name__ == "__main__":
    nox.main()
