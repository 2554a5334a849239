"""`kfopc completion`: the script that completes commands, options and files in a shell."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import partial

from .._validate import optional_module
from .options import DONE, Parser, add_command

EXAMPLES = """examples:
  kfopc completion bash > ~/.local/share/bash-completion/completions/kfopc
  kfopc completion zsh > "${fpath[1]}/_kfopc\""""
FILES = ("FILE", "CSV", "noise", "excitation", "response", "path", "controller", "output")
FOLDERS = ("FOLDER", "folder")


def add_to(commands: argparse._SubParsersAction[Parser], whole: Parser) -> None:
    """Add the subcommand, which completes `whole`."""
    run = partial(completion, whole)
    parser = add_command(commands, "completion", run, "print a script that completes the command in a shell", EXAMPLES)
    parser.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="the shell")


def completion(whole: Parser, options: argparse.Namespace) -> int:
    """Print the script."""
    shtab = optional_module("shtab", "studies", "completion")
    for action in _actions(whole):
        name = action.metavar or action.dest
        if name in FILES + FOLDERS:
            action.complete = shtab.FILE if name in FILES else shtab.DIRECTORY  # type: ignore[attr-defined]
    print(shtab.complete(whole, options.shell))
    return DONE


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield the arguments of a parser and of its subcommands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for below in set(action.choices.values()):
                yield from _actions(below)
