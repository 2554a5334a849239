"""Change a file of the C core at random places, and print the changes that its tests miss: core.py lms.c [40].

Operators, constants, indices and statements change, one at a time, in a copy of the checkout with one library, the baseline
in double. The recorded bits are compared first; with `no-bits` after the number, the tests alone have to notice. Changes
that are known to make no difference are in `core_survivors.txt`, with their reasons.
"""

from __future__ import annotations

import importlib.util
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from helpers.core import program

ROOT = Path(__file__).resolve().parents[2]
EVERY = "tests/controllers/test_every_controller.py::test_"
CONTROLLERS = (  # the quickest first
    "tests/controllers/test_against_oracles.py",
    "tests/core/test_core_refusals.py::test_a_setting_without_an_upper_limit_may_be_large",
    f"{EVERY}a_run_is_the_steps_bit_for_bit",
    f"{EVERY}blocks_are_the_steps_bit_for_bit",
    f"{EVERY}runs_together_are_the_runs_one_by_one",
    f"{EVERY}a_refused_sample_leaves_the_state_as_it_was",
    "tests/controllers/test_little_excitation.py",
)
KALMAN = (
    "kalman or random_walk or (KF- or RLS) and not KF-PB",
    "tests/controllers/test_kalman_variants.py",
    "tests/filters/test_random_walk.py",
    *CONTROLLERS,
)
KF_PB = (
    "(KF-PB or power_budget or posterior) and not limiter and not amplifier",
    "tests/controllers/test_posterior_oracles.py",
    "tests/controllers/test_power_budget.py",
    "tests/controllers/test_power_budget_conditions.py",
    *CONTROLLERS[1:],
)
LOOP = tuple(
    f"tests/loop/test_{name}.py"
    for name in ("loop", "channels", "changes_in_a_run", "simulation", "several_controllers")
)
IN_C = "not frequency"  # whose filter is Python's
TESTS = {  # which, as pytest's -k says it, and of which files
    "amplifier.c": (IN_C, "tests/power/test_amplifiers.py"),
    "budget.c": KF_PB,
    "constraint.c": (IN_C, "tests/power/test_constraint.py", "tests/controllers/test_against_oracles.py"),
    "controller.c": (
        IN_C,
        "tests/core/test_core_refusals.py",
        "tests/controllers/test_refused_settings.py",
        *CONTROLLERS,
    ),
    "covariance.c": KALMAN,
    "diagonal.c": ("kalman or diagonal", "tests/controllers/test_kalman_variants.py", *CONTROLLERS),
    "fourier.c": KF_PB,
    "kalman.c": KALMAN,
    "limiter.c": (
        IN_C,
        "tests/power/test_limiter.py",
        "tests/realtime/test_limiter_promise.py",
        "tests/controllers/test_against_oracles.py",
        "tests/core/test_core_refusals.py",
    ),
    "lms.c": ("not KF and not RLS and not frequency", "tests/controllers/test_lms_family.py", *CONTROLLERS),
    "loop.c": (IN_C, *LOOP, *CONTROLLERS),
    "posterior.c": KF_PB,
    "processor.c": (IN_C, "tests/core/test_building.py::test_the_level_is_that_of_the_features"),
    "signals.c": (
        IN_C,
        "tests/controllers/test_lms_family.py",
        "tests/controllers/test_internal_model.py",
        "tests/controllers/test_new_secondary_path.py",
        "tests/controllers/test_uncertain_path.py",
        "tests/controllers/test_kalman_variants.py",
        *LOOP,
        *CONTROLLERS,
        "tests/core/test_core_refusals.py",
    ),
}
CONSTANT = r"(?<![\w.])(\d+)(?![\w.])"
CHANGES: tuple[tuple[str, Any], ...] = (  # what a line may have, and what it becomes
    *((rf" {re.escape(old)} ", f" {new} ") for old, new in ("+-", "-+", "*/", "/*", "<>", "><")),
    *((f" {old} ", f" {new} ") for old, new in ((r"\+=", "-="), ("<=", "<"), (">=", ">"), ("==", "!="), ("!=", "=="))),
    *((f" {old} ", f" {new} ") for old, new in ((r"&&", "||"), (r"\|\|", "&&"))),
    *((rf"\b{old}\(", f"{new}(") for old, new in (("larger", "smaller"), ("smaller", "larger"))),
    (CONSTANT, lambda found: str(int(found[1]) + 1)),
    (r"\[(\w+)\]", lambda found: f"[{found[1]} + 1]"),
    (
        r"^(\s+)(?!return|const|real|int|for|if|else|static|typedef)[^=(]+ [-+*/]?= [^{]*;$",
        lambda found: f"{found[1]};",
    ),
    (r"^(\s+)\w+\(.*\);$", lambda found: f"{found[1]};"),
    (r"if \((.*)\)", lambda found: f"if (!({found[1]}))"),
)
BITS_CPU_S, TESTS_CPU_S = 5, 150  # a mutant may loop for ever; without a change, they take 0.1 and 50


def mutants(text: str) -> Iterator[tuple[int, str]]:
    """Yield each line that may be changed, and what it becomes."""
    in_comment = False
    for number, line in enumerate(text.splitlines()):
        code = re.sub(r"/\*.*?\*/", lambda found: " " * len(found[0]), line)
        if in_comment or code.lstrip().startswith(("/*", "#", "*", "static const anc_setting")):
            in_comment = (in_comment or "/*" in code) and "*/" not in code
            continue
        room = '(at, "' in code  # a larger constant makes more of it, and nothing else
        for old, new in CHANGES:
            if room and old == CONSTANT:
                continue
            for found in re.finditer(old, code):
                become = new(found) if callable(new) else new
                yield number, line[: found.start()] + become + line[found.end() :]


def build(tree: Path, objects: Path, name: str) -> bool:
    """Compile a changed file and the stamp, and link; return whether that was possible."""
    core = tree / "kfopc_filterpy" / "core"
    spec = importlib.util.spec_from_file_location("building", core / "building.py")
    assert spec is not None
    assert spec.loader is not None
    building = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(building)
    given = (flag for flag in building.flags(["gcc"]) if flag != "-shared")
    flags = [*given, "-O1"]  # compiled sooner, to the same bits
    for path in building.core_sources(core):
        made = objects / f"{path.stem}.o"
        current = made.exists() and path.name not in (name, "stamp.c")
        if (
            not current
            and subprocess.run(["gcc", *flags, "-w", "-c", path, "-o", made], capture_output=True).returncode
        ):
            return False
    library = core / building.library_name("double", "baseline")
    library.unlink(missing_ok=True)  # the one in use stays what it is
    return not subprocess.run(["gcc", "-shared", *sorted(objects.glob("*.o")), "-lm", "-o", library]).returncode


def run(tree: Path, command: str, most_cpu_s: int) -> subprocess.CompletedProcess[str]:
    """Run a command with the copy's package."""
    environment = os.environ | {"KFOPC_CORE_LEVEL": "baseline", "PYTHONPATH": str(tree)}
    limited = f"ulimit -t {most_cpu_s}; exec {command}"
    return subprocess.run(["sh", "-c", limited], cwd=tree, env=environment, capture_output=True, text=True)


def survives(tree: Path, tests: tuple[str, ...], bits: Path | None) -> bool:
    """Return whether a program prints the recorded bits, if there is one, and all tests pass."""
    recorded = (tree / "tests" / "core" / "same_bits.txt").read_text().splitlines()
    expected = [line.removeprefix("double ") for line in recorded if line.startswith("double ")]
    if bits and run(tree, str(bits), BITS_CPU_S).stdout.splitlines() != expected:
        return False
    which, *files = tests
    command = f"{sys.executable} -m pytest -x -q -n0 -p no:cacheprovider -k '{which}' {' '.join(files)}"
    return not run(tree, command, TESTS_CPU_S).returncode


def main(name: str, count: str = "40", *no_bits: str) -> int:
    """Print the mutants of a file that survive and are not known to; return 1 if there are any."""
    source = (ROOT / "kfopc_filterpy" / "core" / name).read_text()
    lines = source.splitlines()
    known = (Path(__file__).parent / "core_survivors.txt").read_text().splitlines()
    every = sorted(set(mutants(source)))
    chosen, left = random.Random(0).sample(every, min(int(count), len(every))), 0
    with tempfile.TemporaryDirectory() as folder:
        tree, objects = Path(folder, "tree"), Path(folder, "objects")
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".git", ".nox", ".venv", "docs", "libanc-*"))
        objects.mkdir()
        assert build(tree, objects, name)
        core = tree / "kfopc_filterpy" / "core"
        library = core / "libanc-double-baseline.so"
        bits = None if no_bits else program("same_bits", Path(folder), ["gcc"], f"-Wl,-rpath,{core}", sources=[library])
        assert survives(tree, TESTS[name], bits), "the tests fail without a change"
        for number, line in sorted(chosen):
            changed = [*lines[:number], line, *lines[number + 1 :]]
            (core / name).write_text("\n".join(changed) + "\n")
            if build(tree, objects, name) and survives(tree, TESTS[name], bits):
                expected = f"{name}: {lines[number].strip()} -> {line.strip()}" in known
                left += not expected
                print(
                    f"{name}:{number + 1}: {lines[number].strip()} -> {line.strip()}{' (known)' * expected}", flush=True
                )
    print(f"{len(chosen)} of {len(every)} mutants of {name}, {left} survive", flush=True)
    return int(left > 0)


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
