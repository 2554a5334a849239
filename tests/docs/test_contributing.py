"""CONTRIBUTING: that its list of folders is true, and that the algorithm it adds runs."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "kfopc_filterpy"
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")

# Folders.


def layers() -> list[str]:
    """Folders and modules of the package in the order of the list, without suffixes."""
    section = TEXT.split("## Architecture")[1].split("Beside the package")[0]
    return re.findall(r"^    ([\w.]+?)(?:/|\.py) ", section, flags=re.M)


def layer_of_public_names() -> dict[str, str]:
    """Where the names that the package itself has come from."""
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    nodes = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: (node.module or alias.name).split(".")[0] for node in nodes for alias in node.names}


def imported(path: Path) -> Iterator[str]:
    """Folders and modules of the package that a module imports from, within functions and for types too."""
    public = layer_of_public_names()
    package = path.relative_to(PACKAGE).parts[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.ImportFrom):
            continue
        parts = tuple((node.module or "").split(".")) if node.module else ()
        if node.level:
            parts = package[: len(package) - node.level + 1] + parts
        elif parts[:1] == ("kfopc_filterpy",):
            parts = parts[1:]
        else:
            continue
        names = [alias.name for alias in node.names if alias.name != "__version__"]  # which is the package's own
        yield from [parts[0]] if parts else (public.get(name, name) for name in names)


def test_the_list_has_every_folder_and_module_of_the_package_once():
    there = {path.stem for path in PACKAGE.glob("*.py")} | {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert sorted(layers()) == sorted(there - {"__init__"})


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
    wrong = sorted(f"{path} imports {other}" for path, other in found if other not in before)
    assert not wrong


def test_the_reader_of_imports_finds_relative_and_public_ones():
    assert set(imported(PACKAGE / "controllers" / "fxlms.py")) == {"_types", "controllers", "power"}
    assert set(imported(PACKAGE / "verdict" / "limits.py")) == {"_types", "loop", "power", "verdict"}


# The algorithm.

CHECK = """
import numpy as np
from helpers.comparing import assert_same_run
from kfopc_filterpy import OutputLimiter, noise_reduction_db, simulate
from comparisons.bench import Runs, make_controller, make_scene, registry, tune
from kfopc_filterpy.controllers import CoreController
from kfopc_filterpy.plot import curve_style, style
from kfopc_filterpy.controllers.sign import SignFxLMS

x, s = np.random.default_rng(1).standard_normal(3000), np.array([0.0, 0.8, -0.3])
plant = {"primary_path": [0.0, 0.0, 1.0, 0.5], "secondary_path": s, "sensor_noise_std": 0.01, "rng": 2}
controllers = [SignFxLMS(8, s, step_size=0.002) for _ in range(2)]
assert isinstance(controllers[0], CoreController)
fast, slow = (
    simulate(controller, x, compiled=compiled, record_weights_every=100, **plant)
    for controller, compiled in zip(controllers, (True, False))
)
assert_same_run(fast, slow)

# The equation again, with numpy.
d = np.convolve(x, plant["primary_path"])[: x.size] + 0.01 * np.random.default_rng(2).standard_normal(x.size)
filtered, w, y, e = np.convolve(x, s)[: x.size], np.zeros(8), np.zeros(x.size), np.zeros(x.size)
for n in range(x.size):
    latest = slice(n, n - 8 if n >= 8 else None, -1)
    y[n] = w[: n + 1] @ x[latest]
    e[n] = d[n] - sum(s[k] * y[n - k] for k in range(min(n + 1, 3)))
    w[: n + 1] += 0.002 * np.sign(e[n]) * filtered[latest]
np.testing.assert_allclose(fast.error, e, rtol=1e-9, atol=1e-9)
assert noise_reduction_db(fast.error, fast.disturbance) > 10

# Two microphones that hear the same, and two loudspeakers of which one is not heard.
many = SignFxLMS(8, np.array([[s, 0 * s], [s, 0 * s]]), step_size=0.001)
both = simulate(many, x, secondary_path=np.array([[s, 0 * s], [s, 0 * s]]), disturbance=np.array([d, d]))
np.testing.assert_allclose(both.error, [e, e], rtol=1e-9, atol=1e-9)
np.testing.assert_array_equal(many.weights[1], 0.0)
"""

STUDIES = """
registry.REGISTRY |= eval("{" + REGISTERED + "}", vars(registry) | {"SignFxLMS": SignFxLMS})
known = dict(style.STYLES)
style.STYLES |= eval("{" + STYLED + "}", vars(style))
own = tuple(curve_style("sign FxLMS").values())
assert own not in [tuple(curve_style(name).values()) for name in known]
scene = make_scene({1: x}, plant["primary_path"], s, fs=16000.0, rated_power=1.0, power_multiple=2.0, n_taps=8,
                   switch_on_s=0.02)
best = tune(Runs(), scene, ["sign FxLMS"])["sign FxLMS"]
controller = make_controller(scene, "sign FxLMS", best.setting)
assert controller.name == "sign FxLMS"
assert noise_reduction_db((run := scene.run(controller)).error, run.disturbance) > 6
controller.limiter = OutputLimiter(1.0)
scene.run(controller)
assert "sign FxLMS" in registry.algorithms(several_channels=True)
"""

SECTION = TEXT.split("<!-- add-a-controller")[1].split("## Build the core")[0]
SIGN, MEAN = re.findall(r"^```c\n(.*?)^```", SECTION, flags=re.M | re.S)
CLASS, REGISTERED, STYLED = re.findall(r"^```python\n(.*?)^```", SECTION, flags=re.M | re.S)


@pytest.mark.parametrize("state", ["", MEAN], ids=["", "with a state of its own"])
def test_the_algorithm_that_it_adds_to_the_package_runs_and_is_tuned(tmp_path, state):
    """In a copy of the package, whose core is compiled with the new file."""
    package = tmp_path / "copy" / "kfopc_filterpy"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__", "libanc-*"))
    with_state = SIGN.replace("static int update(", f"{state}\nstatic int update(").replace("layout_plain", "layout")
    (package / "core" / "sign.c").write_text(with_state if state else SIGN, encoding="utf-8")
    (package / "controllers" / "sign.py").write_text(CLASS, encoding="utf-8")
    build = "from building import *; build(core_sources(), FOLDER / library_name('double', LEVELS[0]))"
    subprocess.run([sys.executable, "-c", build], cwd=package / "core", check=True)
    names = f"REGISTERED, STYLED = {REGISTERED.strip()!r}, {STYLED.strip()!r}\n"
    more = "assert many._block.fields['mean_error'].shape == (1, 1, 1, 2)" if state else ""
    (tmp_path / "check.py").write_text(CHECK + names + STUDIES + more + '\nprint("fine")\n', encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(package.parent), str(ROOT / "tests")])}
    command = [sys.executable, "-W", "error", "check.py"]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.stdout.split() == ["fine"], done.stderr
