"""What subcommands print besides their results: warnings, notes, a progress bar."""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def program() -> str:
    """Return how this program is called here, for the commands that it prints."""
    called = sys.argv[0]
    if Path(called).name == "__main__.py":
        return f"{shlex.quote(sys.executable)} -m kfopc_filterpy"
    return shlex.quote(called) if Path(called).stem == "kfopc" and not shutil.which("kfopc") else "kfopc"


def warn(options: argparse.Namespace, message: str, kind: str = "warning") -> None:
    """Print a warning or a note to standard error, in one line."""
    print(f"{options.prog}: {kind}: {message}", file=sys.stderr)


def tell(options: argparse.Namespace, result: str, notes: Sequence[str]) -> None:
    """Print a result, before its files are written, and notes on it."""
    print(result, flush=True)
    for note in notes:
        warn(options, note, "note")


def say_written(options: argparse.Namespace, page: Path, beside: str) -> None:
    """Print which files were written."""
    if not options.json:
        print(f"{page} and {beside} written")


@contextmanager
def progress_bar(options: argparse.Namespace, unit: str) -> Iterator[Any]:
    """Yield a progress bar, which is shown on a terminal only."""
    import tqdm

    quiet = True if options.quiet else None
    with tqdm.tqdm(unit=unit, unit_scale=True, disable=quiet, dynamic_ncols=True, leave=False) as bar:
        yield bar
