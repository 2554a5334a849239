"""What subcommands print besides their results: warnings, notes, a progress bar."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

EXTRA = 'install the extra `studies`: python -m pip install "kfopc-filterpy[studies]"'


def warn(options: argparse.Namespace, message: str, kind: str = "warning") -> None:
    """Print a warning or a note to standard error, in one line."""
    print(f"{options.prog}: {kind}: {message}", file=sys.stderr)


def tell(options: argparse.Namespace, result: str, notes: Sequence[str], written: str | None) -> None:
    """Print a result, notes on it, and which files were written."""
    print(result)
    for note in notes:
        warn(options, note, "note")
    if written and not options.json:
        print(f"{written} written")


@contextmanager
def progress_bar(options: argparse.Namespace, unit: str) -> Iterator[Any]:
    """Yield a progress bar, which is shown on a terminal only."""
    try:
        from tqdm import tqdm
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"the progress bar needs tqdm: {EXTRA}") from error
    quiet = True if options.quiet else None
    with tqdm(unit=unit, unit_scale=True, disable=quiet, dynamic_ncols=True, leave=False) as bar:
        yield bar
