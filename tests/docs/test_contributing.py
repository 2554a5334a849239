"""CONTRIBUTING: that its list of folders is true, and that the algorithm it adds runs."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import resolve_name
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "kfopc_filterpy"
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")

# Folders.


def layers() -> list[str]:
    """Folders and modules of the package in the order of the list, without suffixes."""
    section = TEXT.split("## Where things are")[1].split("Beside the package")[0]
    return re.findall(r"^    ([\w.]+?)(?:/|\.py) ", section, flags=re.M)


def layer_of_public_names() -> dict[str, str]:
    """Where the names that the package itself has come from."""
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    nodes = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: (node.module or alias.name).split(".")[0] for node in nodes for alias in node.names}


def imported(path: Path) -> Iterator[str]:
    """Folders and modules of the package that a module imports from, within functions and for types too."""
    public = layer_of_public_names()
    package = ".".join(path.relative_to(ROOT).parts[:-1])
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            top, *parts = resolve_name("." * node.level + (node.module or ""), package).split(".")
            names = [alias.name for alias in node.names if alias.name != "__version__"]  # which is the package's own
            if top == "kfopc_filterpy":
                yield from parts[:1] or (public.get(name, name) for name in names)


def test_the_list_has_every_folder_and_module_of_the_package_once():
    there = {path.stem for path in PACKAGE.glob("*.py")} | {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert sorted(layers()) == sorted(there - {"__init__"})


BACK = {("loop", "plot")}  # named below the list


@pytest.mark.parametrize("layer", layers())
def test_a_folder_imports_only_from_folders_before_it_in_the_list(layer):
    before = layers()[: layers().index(layer)]
    folder = PACKAGE / layer
    found = {
        (str(path.relative_to(PACKAGE)), other)
        for path in (sorted(folder.rglob("*.py")) if folder.is_dir() else [PACKAGE / f"{layer}.py"])
        for other in imported(path)
        if other != layer
    }
    assert all(other in layers() for _, other in found)  # the reader of imports knows all of them
    wrong = sorted(
        f"{path} imports {other}" for path, other in found if other not in before and (layer, other) not in BACK
    )
    assert not wrong


# The algorithm.

CHECK = """
import numpy as np
from helpers.comparing import assert_same_run
from helpers.simulation import Stepwise
from kfopc_filterpy import Plant, simulate
from kfopc_filterpy.controllers.sign import sign_fx_lms

x, s = np.random.default_rng(1).standard_normal(3000), np.array([0.0, 0.8, -0.3])
plant = Plant(s, [0.0, 0.0, 1.0, 0.5], sensor_noise_std=0.01, fs=16000)
controllers = sign_fx_lms(8, plant, step_size=0.002), Stepwise(sign_fx_lms(8, plant, step_size=0.002))
fast, slow = (simulate(controller, x, plant, rng=2) for controller in controllers)
assert_same_run(fast, slow)

# The equation again, with numpy.
d = plant.disturbance(x) + 0.01 * np.random.default_rng(2).standard_normal(x.size)
filtered, w, y, e = np.convolve(x, s)[: x.size], np.zeros(8), np.zeros(x.size), np.zeros(x.size)
for n in range(x.size):
    latest = slice(n, n - 8 if n >= 8 else None, -1)
    y[n] = w[: n + 1] @ x[latest]
    e[n] = d[n] - sum(s[k] * y[n - k] for k in range(min(n + 1, 3)))
    w[: n + 1] += 0.002 * np.sign(e[n]) * filtered[latest]
np.testing.assert_allclose(fast.error, e, rtol=1e-9, atol=1e-9)  # the same sums in another order
assert fast.noise_reduction_db > 10
print("fine")
"""


def test_the_algorithm_that_it_adds_runs(tmp_path):
    """In a copy of the package, whose core is compiled with the new file."""
    (c,), (python,) = (
        re.findall(rf"^```{language}\n(.*?)^```", TEXT, flags=re.M | re.S) for language in ("c", "python")
    )
    package = tmp_path / "copy" / "kfopc_filterpy"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__", "libanc-*"))
    (package / "core" / "sign.c").write_text(c, encoding="utf-8")
    (package / "controllers" / "sign.py").write_text(python, encoding="utf-8")
    build = "from building import *; build(core_sources(), FOLDER / library_name('double', LEVELS[0]))"
    subprocess.run([sys.executable, "-c", build], cwd=package / "core", check=True)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(package.parent), str(ROOT / "tests")])}
    command = [sys.executable, "-W", "error", "-c", CHECK]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout == "fine\n", done.stderr
