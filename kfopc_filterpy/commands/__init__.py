"""The command line of `kfopc`: a file for each subcommand."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import warnings
from collections.abc import Sequence

from .. import __version__
from . import demo, export, paths, run, verdict
from .options import DONE, WRONG_INPUT, Parser
from .printing import warn

PIPE_CLOSED = 141  # as of a program that SIGPIPE ends

EXAMPLES = """examples:
  kfopc verdict noise.wav --primary P.wav --secondary S.wav --watt 20 --ohm 8 --volts-per-unit 10 --want-db 6 -o out
  kfopc paths identify sent.wav received.wav --taps 512 -o S.wav
  kfopc run noise.wav --primary P.wav --secondary S.wav --rated-power 0.1 --seconds 20
  kfopc export controller.toml -o firmware --dtype float32
  kfopc demo FOLDER
each command has its own --help
exit codes: 0 done, or the verdict is "enough"; 1 the verdict is "not enough", or a fault stopped a run; 2 wrong input,
with a message of one line; 130 interrupted; 141 the reader of its output went away"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    Parameters
    ----------
    arguments : sequence of str, optional
        The arguments; by default those of the process.

    Returns
    -------
    int
        0 done or enough, 1 not enough or stopped by a fault, 2 wrong input, 141 nobody reads the output.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments:
        whole_parser().print_help()
        return DONE
    options, unknown = whole_parser().parse_known_args(
        arguments, argparse.Namespace(command=shlex.join(["kfopc", *arguments]))
    )
    try:
        if unknown:
            raise ValueError(f"unrecognized arguments: {' '.join(unknown)}; see {options.prog} --help")
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: warn(options, str(message))
            code = options.run(options)
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # `head` has read enough; Python would complain at its end of what it cannot write
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED
    except (ValueError, TypeError, OSError, ImportError, RuntimeError, MemoryError) as error:
        print(f"{options.prog}: {' '.join(str(error).split()) or type(error).__name__}", file=sys.stderr)
        return WRONG_INPUT


def whole_parser() -> Parser:
    """Return the parser of the command and its subcommands."""
    parser = Parser(
        prog="kfopc",
        description="Active noise control with a limited amplifier, from recordings.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"kfopc {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for module in (verdict, paths, run, export, demo):
        module.add_to(commands)
    return parser
