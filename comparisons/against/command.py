"""`python -m comparisons against`: compare every controller with those of an earlier version, and time both.

`driver` runs once with the working tree and once with the earlier version, each in a process of its own.
"""

from __future__ import annotations

import argparse
import io
import json
import math
import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np

from .driver import LIST

ROOT = Path(__file__).resolve().parents[2]
DRIVER = Path(__file__).with_name("driver.py")
BEFORE_CORE = "567a38ce53fa4295221c7f51d34fb14b5a5db2a3"  # the last version whose controllers numba compiled
TOLERANCE = 1e-9  # of a case, relative to the largest value of an array
ROUNDS = 5
# Cases that have moved for a known reason: a pattern of their names, how far they may move, and the reason.
KNOWN: dict[str, tuple[float, str]] = {
    "*: KF-PB*": (math.inf, "KF-PB is another algorithm now"),
    "*: VerifiedController": (math.inf, "earlier versions have none"),
    "*, duct: FxRLS": (
        1e-5,
        "its P grows where the noise excites nothing: a reference changed by 1e-15 moves it by 2e-6 in either version",
    ),
    "*, duct: fast-array KF*": (
        1e-7,
        "its rotations cancel digits: a reference changed by 1e-15 moves it by 4e-9 in the earlier version",
    ),
    "room, 2 x 2: FeedbackNeutralizer": (
        1e-3,
        "its loop amplifies rounding: a reference changed by 1e-15 moves it by 5e-5 in the earlier version",
    ),
    "compressor, duct: KF-OPC repaired": (
        1e-4,
        "s^ * y was the difference of d^ and e, which lost its digits in the first samples, when y is 1e-11",
    ),
}

OK, MOVED, IS_KNOWN = "ok", "MOVED", "known"
Result = Mapping[str, Any]


class AgainstError(Exception):
    """What stops the comparison, as one line."""


@dataclass(frozen=True)
class Row:
    """How far a case has moved."""

    case: str
    samples: int
    difference: float
    where: str  # the array that moved most, or what failed

    @property
    def status(self) -> str:
        if self.difference <= TOLERANCE:
            return OK
        return IS_KNOWN if self.known_reason else MOVED

    @property
    def known_reason(self) -> str:
        return next((why for p, (most, why) in KNOWN.items() if fnmatch(self.case, p) and self.difference <= most), "")

    def __str__(self) -> str:
        line = f"{self.case:<58} {self.samples:>7} {self.difference:>9.1e}  {self.status:<6}"
        if self.status == OK:
            return line.rstrip()
        return f"{line} {self.where}{self.known_reason and f': {self.known_reason}'}"


# ---- Comparing


def relative_difference(old: Any, new: Any) -> float:
    """Return max|new - old| / max|old|; infinite for other shapes, or NaN or infinities in other places."""
    old, new = np.asarray(old, dtype=np.float64), np.asarray(new, dtype=np.float64)
    if old.shape != new.shape:
        return np.inf
    finite = np.isfinite(old)
    if not np.array_equal(old[~finite], new[~finite], equal_nan=True) or not np.isfinite(new[finite]).all():
        return np.inf
    moved = np.abs(new[finite] - old[finite]).max(initial=0.0)
    if moved == 0.0:
        return 0.0
    largest = np.abs(old[finite]).max()
    return float(moved / largest) if largest > 0.0 else np.inf


def compared(case: str, old: Result | None, new: Result | None) -> Row:
    """Return how far a case has moved, from its results; None stands for a version that has no such case."""
    if old is None or new is None:
        return Row(case, 0, np.inf, f"only in the {'new' if old is None else 'old'} version")
    failed = [f"{name}: {result['failed']}" for name, result in (("old", old), ("new", new)) if "failed" in result]
    if failed:
        return Row(case, 0, np.inf, "; ".join(failed))
    samples = max(size for value in old.values() for size in (0, *np.shape(value)))
    other = sorted(old.keys() ^ new.keys())
    if other:
        return Row(case, samples, np.inf, f"{', '.join(other)} only in one version")
    differences = {name: relative_difference(old[name], new[name]) for name in old}
    where = max(differences, key=lambda name: differences[name])
    return Row(case, samples, differences[where], where)


def read_results(folder: Path) -> tuple[dict[str, Result], dict[str, str]]:
    """Return the results of a version by case, and what it skipped."""
    text = json.loads((folder / LIST).read_text(encoding="utf-8"))
    results: dict[str, Result] = {}
    for index, name in enumerate(text["cases"]):
        with np.load(folder / f"{index}.npz") as file:
            results[name] = {key: file[key] for key in file.files}
    return results, text["skipped"]


# ---- Running both versions


@contextmanager
def earlier_tree(revision: str, keep: Path | None) -> Iterator[Path]:
    """Give the folder of an earlier version: its files in a temporary folder, or in one to keep.

    A folder with the package in it, in place of a revision, is taken as it is.
    """
    if (Path(revision) / "kfopc_filterpy").is_dir():
        yield Path(revision).resolve()
        return
    commit = git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}").decode().strip()
    if not commit:
        raise AgainstError(f"there is no revision {revision} in {ROOT}: name a commit, a tag or a branch (git log)")
    with tempfile.TemporaryDirectory(prefix="against-") as temporary:
        tree = (keep or Path(temporary)).resolve() / commit
        if not tree.is_dir():
            unfinished = tree.with_name(f"{commit}.part")
            with tarfile.open(fileobj=io.BytesIO(git("archive", commit))) as archive:
                archive.extractall(unfinished, filter="data")
            unfinished.rename(tree)
        yield tree


def git(*arguments: str) -> bytes:
    """Return what a git command prints, nothing if it fails."""
    try:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, check=False).stdout
    except OSError as error:
        raise AgainstError(f"git does not run: {error}") from error


@dataclass(frozen=True)
class Version:
    """A tree with the package, the interpreter that runs it, and where its results go."""

    tree: Path
    python: str
    output: Path

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """Start the driver."""
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        environment = os.environ | {"PYTHONPATH": str(self.tree)} | threads
        command = [self.python, "-P", str(DRIVER), *arguments]
        try:
            return subprocess.Popen(
                command, env=environment, cwd=self.output, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
            )
        except OSError as error:
            raise AgainstError(f"{self.python} does not run: {error}") from error

    def last_line(self, process: subprocess.Popen[str]) -> str:
        """Return the last line of the errors of a driver, once it has ended; nothing if all went well."""
        _, errors = process.communicate()
        ended = f"ended with {process.returncode}"
        return "" if process.returncode == 0 else (errors.strip().splitlines() or [ended])[-1]

    def require_own_package(self, package: str) -> None:
        """Check that the driver ran with the package of this tree."""
        if not Path(package).resolve().is_relative_to(self.tree):
            raise AgainstError(f"{self.python} ran the package {package}, not that of {self.tree}")


def run_cases(versions: Sequence[Version], only: str) -> None:
    """Run the cases of both versions side by side; one that ends its process counts as failed, the others go on."""
    waiting = list(versions)
    while waiting:
        running = [(one, one.start("cases", str(one.output), "--only", only)) for one in waiting]
        waiting = []
        for version, process in running:
            error = version.last_line(process)
            listed = version.output / LIST
            if error and not listed.exists():
                raise AgainstError(f"the cases do not run with {version.tree}: {error}")
            text = json.loads(listed.read_text(encoding="utf-8"))
            version.require_own_package(text["package"])
            missing = [i for i in range(len(text["cases"])) if not (version.output / f"{i}.npz").exists()]
            if missing:
                reason = f"the process ended with {process.returncode}: {error}"
                np.savez(version.output / f"{missing[0]}.npz", failed=reason)
                waiting.append(version)


def compare(old: Version, new: Version, only: str) -> int:
    """Run the cases, print how far each has moved, and return 1 if one has moved that is not known to."""
    run_cases((old, new), only)
    (before, _), (after, skipped) = read_results(old.output), read_results(new.output)
    names = list(dict.fromkeys([*after, *before]))
    if not names:
        raise AgainstError(f"no case is called {only}")
    rows = [compared(name, before.get(name), after.get(name)) for name in names]
    print(f"{'case':<58} {'samples':>7} {'largest':>9}  (relative difference)", *rows, sep="\n")
    for name, reason in skipped.items():
        print(f"skipped: {name}: {reason}")
    moved = [row for row in rows if row.status == MOVED]
    largest = max(row.difference for row in rows)
    print(f"\n{len(rows)} cases, largest relative difference {largest:.1e}, {len(moved)} MOVED beyond {TOLERANCE:g}")
    print(*moved, sep="\n", end="\n" if moved else "")
    return 1 if moved else 0


# ---- Times


def run_times(version: Version, only: str) -> dict[str, float]:
    """Return the times of a sample in µs, from a process of its own."""
    path = version.output / "times.json"
    error = version.last_line(version.start("times", str(path), "--only", only))
    if error:
        raise AgainstError(f"the times do not run with {version.tree}: {error}")
    text = json.loads(path.read_text(encoding="utf-8"))
    version.require_own_package(text["package"])
    return text["times"]


def compare_times(old: Version, new: Version, only: str, rounds: int) -> int:
    """Time both versions in turns, and print the times with their ratio."""
    for version in (old, new):  # compile
        names = list(run_times(version, only))
    if not names:
        raise AgainstError(f"nothing that is timed is called {only}")
    times = np.empty((rounds, 2, len(names)))
    for turn in range(rounds):
        for index in (0, 1) if turn % 2 == 0 else (1, 0):
            measured = run_times((old, new)[index], only)
            times[turn, index] = [measured[name] for name in names]
    print(f"µs a sample, {rounds} rounds in turns; ratio: median of new over old in the same round")
    print(f"{'':<40} {'old: least':>11} {'median':>8} {'new: least':>11} {'median':>8} {'ratio':>7}")
    least, median = times.min(axis=0), np.median(times, axis=0)
    ratio = np.median(times[:, 1] / times[:, 0], axis=0)
    for k, name in enumerate(names):
        old_new = f"{least[0, k]:>11.3f} {median[0, k]:>8.3f} {least[1, k]:>11.3f} {median[1, k]:>8.3f}"
        print(f"{name:<40} {old_new} {ratio[k]:>7.2f}")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare the working tree with an earlier version, or time both."""
    parser = argparse.ArgumentParser(
        prog="python -m comparisons against",
        description="Compare every controller of the working tree with those of an earlier version. The exit code is 1 "
        f"if a result has moved by more than {TOLERANCE:g} of its largest value.",
    )
    parser.add_argument(
        "revision",
        nargs="?",
        default=BEFORE_CORE,
        help="earlier version: a commit, a tag, a branch, or a folder that has the package (default: %(default).7s)",
    )
    parser.add_argument(
        "--only", default="", metavar="PATTERN", help="run the cases whose name contains this, e.g. KF-OPC"
    )
    parser.add_argument("--python", default=sys.executable, help="interpreter for the earlier version")
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="keep the earlier version, and what it compiles, for the next run"
    )
    parser.add_argument(
        "--speed", action="store_true", help="time both versions, in turns, instead of comparing results"
    )
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="rounds of --speed (default: %(default)s)")
    options = parser.parse_args(arguments)
    if options.rounds < 1:
        parser.error(f"--rounds must be 1 or more, got {options.rounds}")
    try:
        with earlier_tree(options.revision, options.keep) as tree, tempfile.TemporaryDirectory() as folder:
            outputs = Path(folder) / "old", Path(folder) / "new"
            for output in outputs:
                output.mkdir()
            old, new = Version(tree, options.python, outputs[0]), Version(ROOT, sys.executable, outputs[1])
            print(f"new: {ROOT}\nold: {options.revision}\nWhat is not compiled yet is compiled first.", flush=True)
            if options.speed:
                return compare_times(old, new, options.only, options.rounds)
            return compare(old, new, options.only)
    except AgainstError as error:
        print(error, file=sys.stderr)
        return 2
