"""Change a file of the C core at random places, and print the changes that its tests miss: core.py lms.c [40].

Operators, constants, indices and statements change, one at a time, in a copy of the checkout with one library, the baseline
in double. Changes that are known to make no difference are in `core_survivors.txt`, with their reasons.
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

ROOT = Path(__file__).resolve().parents[2]
BITS = "tests/core/test_same_bits.py::test_libraries_of_all_levels[baseline-double]"
CONTROLLERS = ("tests/controllers/test_against_oracles.py", "tests/controllers/test_little_excitation.py")
TESTS = {
    "lms.c": (BITS, *CONTROLLERS, "tests/controllers/test_lms_family.py"),
    "covariance.c": (
        BITS,
        *CONTROLLERS,
        "tests/controllers/test_kalman_variants.py",
        "tests/filters/test_random_walk.py",
    ),
    "limiter.c": (
        "tests/core/test_core_refusals.py",
        "tests/power/test_limiter.py",
        "tests/realtime/test_limiter_promise.py",
        BITS,
    ),
}
CHANGES: tuple[tuple[str, Any], ...] = (  # what a line may have, and what it becomes
    *((rf" {re.escape(old)} ", f" {new} ") for old, new in ("+-", "-+", "*/", "/*", "<>", "><")),
    *((f" {old} ", f" {new} ") for old, new in ((r"\+=", "-="), ("<=", "<"), (">=", ">"), ("==", "!="), ("!=", "=="))),
    *((f" {old} ", f" {new} ") for old, new in ((r"&&", "||"), (r"\|\|", "&&"))),
    *((rf"\b{old}\(", f"{new}(") for old, new in (("larger", "smaller"), ("smaller", "larger"))),
    (r"(?<![\w.])(\d+)(?![\w.])", lambda found: str(int(found[1]) + 1)),
    (r"\[(\w+)\]", lambda found: f"[{found[1]} + 1]"),
    (
        r"^(\s+)(?!return|const|real|int|for|if|else|static|typedef)[^=(]+ [-+*/]?= [^{]*;$",
        lambda found: f"{found[1]};",
    ),
    (r"^(\s+)\w+\(.*\);$", lambda found: f"{found[1]};"),
    (r"if \((.*)\)", lambda found: f"if (!({found[1]}))"),
)
MOST_CPU_S = 300  # of the tests of a mutant, which may loop for ever


def mutants(text: str) -> Iterator[tuple[int, str]]:
    """Yield each line that may be changed, and what it becomes."""
    in_comment = False
    for number, line in enumerate(text.splitlines()):
        code = re.sub(r"/\*.*?\*/", lambda found: " " * len(found[0]), line)
        if in_comment or code.lstrip().startswith(("/*", "#", "*", "static const anc_setting")):
            in_comment = (in_comment or "/*" in code) and "*/" not in code
            continue
        for old, new in CHANGES:
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
    flags = [flag for flag in building.flags(["gcc"]) if flag != "-shared"]
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


def survives(tree: Path, tests: tuple[str, ...]) -> bool:
    """Return whether all tests pass."""
    command = f"ulimit -t {MOST_CPU_S}; exec {sys.executable} -m pytest -x -q -n0 -p no:cacheprovider "
    environment = os.environ | {"KFOPC_CORE_LEVEL": "baseline", "PYTHONPATH": str(tree)}
    for test in tests:  # the quickest first
        done = subprocess.run(["sh", "-c", command + f"'{test}'"], cwd=tree, env=environment, capture_output=True)
        if done.returncode:
            return False
    return True


def main(name: str, count: str = "40") -> int:
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
        assert survives(tree, TESTS[name]), "the tests fail without a change"
        for number, line in sorted(chosen):
            changed = [*lines[:number], line, *lines[number + 1 :]]
            (tree / "kfopc_filterpy" / "core" / name).write_text("\n".join(changed) + "\n")
            if build(tree, objects, name) and survives(tree, TESTS[name]):
                expected = f"{name}: {lines[number].strip()} -> {line.strip()}" in known
                left += not expected
                print(
                    f"{name}:{number + 1}: {lines[number].strip()} -> {line.strip()}{' (known)' * expected}", flush=True
                )
    print(f"{len(chosen)} of {len(every)} mutants of {name}, {left} survive", flush=True)
    return int(left > 0)


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
