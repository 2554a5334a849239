"""What subcommands print besides their results: warnings and notes."""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
from pathlib import Path


def program() -> str:
    """Return how this program is called here, for the commands that it prints."""
    called = sys.argv[0]
    if Path(called).name == "__main__.py":
        return f"{shlex.quote(sys.executable)} -m kfopc_filterpy"
    return shlex.quote(called) if Path(called).stem == "kfopc" and not shutil.which("kfopc") else "kfopc"


def warn(options: argparse.Namespace, message: str, kind: str = "warning") -> None:
    """Print a warning or a note to standard error, in one line."""
    print(f"{options.prog}: {kind}: {message}", file=sys.stderr)
