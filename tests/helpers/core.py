"""The algorithms that the core exports, with settings for tests, and the C programs of tests/core that run them."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from kfopc_filterpy.core import building, library

KALMAN = {"state_noise": 2.0**-20, "measurement_noise": 2.0**-7, "initial_variance": 2.0**-7, "fading": 1.0}
FOLDER = Path(__file__).resolve().parents[1] / "core"
# The settings of every algorithm, in the order of its C file, such that it adapts to noise of power 1/3. A float holds each.
ALGORITHMS: dict[str, Mapping[str, float]] = {
    "fxlms": {"step_size": 2.0**-7},
    "fxnlms": {"step_size": 2.0**-4, "regularization": 2.0**-5},
    "leaky": {"step_size": 2.0**-7, "leak": 2.0**-4},
    "optimal_leaky": {"step_size": 2.0**-7},
    "mov": {"step_size": 2.0**-7, "modified": 1.0},
    "mov_fixed": {"step_size": 2.0**-7, "modified": 0.0, "penalty_factor": 2.0**-3},
    "two_gradient": {"step_size": 2.0**-7, "amplitude_limit": 2.0**-4, "output_step_size": 2.0**-8},
    "clipping": {"step_size": 2.0**-7, "amplitude_limit": 2.0**-4},
    "rescaling": {"step_size": 2.0**-7, "amplitude_limit": 2.0**-4},
    "kalman": KALMAN,
    "diagonal": {"state_noise": 2.0**-20, "measurement_noise": 2.0**-7, "initial_variance": 2.0**-7},
    "power_budget": {
        "rated_power": 2.0**-6,
        "block": 16.0,
        "averaging": 20.0,
        "window": 1 - 2.0**-5,
        "memory": 1 - 2.0**-5,
        "spread": 2.0**-2,
    },
    "signals_alone": {},
}
# What differs with everything that a block may have, and on hard input, so that the bits of each branch are recorded.
EQUIPPED: dict[str, Mapping[str, float]] = {
    "fxnlms": {"regularization": 0.0},
    "mov": {"modified": 0.0},
    "mov_fixed": {"modified": 1.0},
    "kalman": {"fading": 1 + 2.0**-7},
    "power_budget": {"block": 83.0, "averaging": 41.0, "memory": 1 - 2.0**-8, "spread": 0.0},
}
HARD: dict[str, Mapping[str, float]] = {
    "fxnlms": {"regularization": 0.0},
    "kalman": {"state_noise": 0.0, "measurement_noise": 0.0, "initial_variance": 2.0**10, "fading": 1 + 2.0**-3},
    "diagonal": {"state_noise": 0.0, "measurement_noise": 0.0, "initial_variance": 2.0**10},
    "power_budget": {"block": 13.0},
}
PAUSED: dict[str, Mapping[str, float]] = {"power_budget": {"block": 5.0, "memory": 1 - 2.0**-7}}


def exported(kind: str = "algorithm") -> list[str]:
    """Return the names of the constants of a type, by default the algorithms, that anc.h declares, without ``anc_``."""
    text = (building.FOLDER / "anc.h").read_text(encoding="utf-8")
    lists = re.findall(rf"^extern ANC_PUBLIC const anc_{kind} ([^;]+);", text, re.M)
    return [name.strip().removeprefix("anc_") for names in lists for name in names.split(",")]


def known() -> list[str]:
    """Return the algorithms of the table; a test fails if the core has another."""
    assert set(exported()) == set(ALGORITHMS), (
        f"ALGORITHMS of tests/helpers/core.py and anc.h differ in {sorted(set(exported()) ^ set(ALGORITHMS))}: "
        "enter a new algorithm with its settings"
    )
    return list(ALGORITHMS)


def tool(*names: str) -> str:
    """Return the path of the first of these programs that the machine has, or skip the test."""
    found = next((path for name in names if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"needs {' or '.join(names)}")
    return found


def c_compiler() -> list[str]:
    """Return the machine's C compiler, or skip the test."""
    return [tool("cc", "gcc", "clang")]


def zig() -> list[str]:
    """Return the command of zig's C compiler, or skip the test."""
    if importlib.util.find_spec("ziglang") is None:
        pytest.skip("needs zig: python -m pip install ziglang")
    return [sys.executable, "-P", "-m", "ziglang", "cc"]


def highest_level() -> str:
    """Return the highest level of this processor, whether a library was built for it or not."""
    return {3: "x86-64-v3", 4: "x86-64-v4"}.get(library.load().free.anc_processor_level(), "baseline")


def ran(*command: object, cwd: Path | None = None, **variables: str) -> str:
    """Run a command and return what it printed; if it fails, so does the test."""
    line = [str(part) for part in command]
    done = subprocess.run(line, capture_output=True, text=True, cwd=cwd, env={**os.environ, **variables})
    assert done.returncode == 0, f"{' '.join(line)}\n{done.stdout[-3000:]}{done.stderr[-3000:]}"
    return done.stdout


def program_flags(command: list[str], real: str = "double", level: str = "baseline", target: str = "") -> list[str]:
    """Return the flags that the library is built with, for a program."""
    return [flag for flag in building.flags(command, real, level, target) if flag not in ("-shared", "-fPIC")]


def program(
    name: str, folder: Path, command: list[str], *options: str, sources: list[Path] | None = None, **of_flags: str
) -> Path:
    """Compile a program of tests/core with the sources of the core, or against a library, and return its path."""

    def row(name: str, plain: Mapping[str, float]) -> str:
        each = [{**plain, **own.get(name, {})} for own in ({}, EQUIPPED, HARD, PAUSED)]
        settings = [", ".join(f"(anc_real){value!r}" for value in one.values()) for one in each]
        return f"{{ALGORITHM({name}), {{{', '.join(f'{{{one}}}' for one in settings)}}}}}"

    rows = ", ".join(row(name, plain) for name, plain in ALGORITHMS.items())
    table = "static struct { const char *name; const anc_algorithm *algorithm; anc_real settings[4][8]; } algorithms[]"
    (folder / "algorithms.h").write_text(f"{table} = {{{rows}, {{0}}}};\n")
    made = folder / name
    files = building.core_sources() if sources is None else sources
    flags = (*program_flags(command, **of_flags), *options, f"-I{folder}", f"-I{FOLDER}")
    ran(*command, *flags, FOLDER / f"{name}.c", *files, "-o", made, "-lm")
    return made
