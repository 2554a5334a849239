"""CONTRIBUTING: that its list of folders is true, and that the algorithm it adds runs."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import kfopc_filterpy

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
        yield from [parts[0]] if parts else (public.get(alias.name, alias.name) for alias in node.names)


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
    assert set(imported(PACKAGE / "controllers" / "fxlms.py")) == {"_validate", "power", "controllers"}
    assert set(imported(PACKAGE / "bench" / "registry.py")) == {"bench", "controllers", "power"}


# The algorithm.

CHECK = """
import importlib.util, sys
import numpy as np
from kfopc_filterpy import OutputLimiter, noise_reduction_db, simulate
from kfopc_filterpy.bench import Runs, make_controller, make_scene, registry, tune
from kfopc_filterpy.plot import curve_style, style

file, registered, styled = sys.argv[1:]
spec = importlib.util.spec_from_file_location("kfopc_filterpy.controllers.sign", file)
sign = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sign)

x, s = np.random.default_rng(1).standard_normal(3000), np.array([0.0, 0.8, -0.3])
plant = {"primary_path": [0.0, 0.0, 1.0, 0.5], "secondary_path": s, "sensor_noise_std": 0.01, "rng": 2}
runs = [
    simulate(sign.SignFxLMS(8, s, step_size=0.002), x, compiled=compiled, record_weights_every=100, **plant)
    for compiled in (True, False)
]
assert sign.SignFxLMS(8, s, step_size=0.002).compiled_state() is not None  # so the first run was compiled
for name in ("error", "control_signal", "constraint_factor", "weights"):
    np.testing.assert_allclose(getattr(runs[0], name), getattr(runs[1], name), rtol=1e-12, atol=1e-12, err_msg=name)

# The equation again, with numpy.
d = np.convolve(x, plant["primary_path"])[: x.size] + 0.01 * np.random.default_rng(2).standard_normal(x.size)
filtered, w, y, e = np.convolve(x, s)[: x.size], np.zeros(8), np.zeros(x.size), np.zeros(x.size)
for n in range(x.size):
    latest = slice(n, n - 8 if n >= 8 else None, -1)
    y[n] = w[: n + 1] @ x[latest]
    e[n] = d[n] - sum(s[k] * y[n - k] for k in range(min(n + 1, 3)))
    w[: n + 1] += 0.002 * np.sign(e[n]) * filtered[latest]
np.testing.assert_allclose(runs[0].error, e, rtol=1e-9, atol=1e-9)
assert noise_reduction_db(runs[0].error, runs[0].disturbance) > 10

registry.REGISTRY |= eval("{" + registered + "}", vars(registry) | {"SignFxLMS": sign.SignFxLMS})
known = dict(style.STYLES)
style.STYLES |= eval("{" + styled + "}", vars(style))
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
print("fine")
"""


def test_the_algorithm_that_it_adds_runs_compiled_and_from_python_with_equal_results(tmp_path):
    """In a process of its own with a cache of its own: compiled code of this module's types would stay in the package's."""
    section = TEXT.split("<!-- add-a-controller")[1].split("### Compiled functions")[0]
    module, registered, styled = re.findall(r"^```python\n(.*?)^```", section, flags=re.M | re.S)
    file = tmp_path / "sign.py"
    file.write_text(module, encoding="utf-8")
    (tmp_path / "check.py").write_text(CHECK, encoding="utf-8")
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": str(Path(kfopc_filterpy.__file__).parents[1]),
    }
    command = [sys.executable, "-W", "error", str(tmp_path / "check.py"), str(file), registered.strip(), styled.strip()]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.stdout.split() == ["fine"], done.stderr
