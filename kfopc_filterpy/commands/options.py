"""Functions that declare options: numbers whose errors name the option, and options that several subcommands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from typing import Any, NoReturn

from .._validate import as_count, as_positive

DONE, WRONG_INPUT = 0, 2


class Parser(argparse.ArgumentParser):
    """Parser whose errors are one line, and whose options are written out."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)

    def error(self, message: str) -> NoReturn:
        self.exit(WRONG_INPUT, f"{self.prog}: {message}; see {self.prog} --help\n")


def sentence(about: str) -> str:
    """Return a line of a list as a sentence."""
    return about[0].upper() + about[1:] + "."


def add_command(
    commands: argparse._SubParsersAction[Parser], name: str, run: Callable[[Any], int], about: str, examples: str
) -> Parser:
    """Add a subcommand that calls `run`, and return its parser."""
    parser = commands.add_parser(
        name,
        help=about,
        description=sentence(about),
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run, prog=parser.prog)
    return parser


def add_number(
    group: argparse._ActionsContainer, option: str, unit: str, check: Callable[..., float] = as_positive, **more: Any
) -> None:
    """Add an option that takes a number; errors of `check`, a function of `_validate`, name the option."""
    group.add_argument(option, type=_checked(float, option, check, unit=unit), **{"metavar": unit.upper()} | more)


def add_count(group: argparse._ActionsContainer, option: str, minimum: int = 1, **more: Any) -> None:
    """Add an option that takes a whole number of at least `minimum`."""
    group.add_argument(option, type=_checked(int, option, as_count, minimum=minimum), **{"metavar": "N"} | more)


def _checked(kind: Callable[[str], Any], option: str, check: Callable[..., Any], **more: Any) -> Callable[[str], Any]:
    def read(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError:
            value = text  # which the check refuses
        try:
            return check(value, option, **more)
        except (ValueError, TypeError) as error:  # argparse would replace their message with its own
            raise argparse.ArgumentError(None, str(error)) from error

    return read


def refuse_unused(options: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Raise ValueError, with the reason `why`, if one of these options is given: nothing would use it."""
    unused = [f"--{name.replace('_', '-')}" for name in names if getattr(options, name) is not None]
    if unused:
        raise ValueError(f"{' and '.join(unused)} would not be used{why}")


def add_reading(parser: argparse._ActionsContainer, about_fs: str = "resample everything to this rate") -> None:
    """Add the options for reading files."""
    add_number(parser, "--fs", "Hz", help=about_fs)
    add_number(parser, "--file-fs", "Hz", help="rate of the files that state none")


def add_scene(parser: argparse._ActionsContainer, *, required: bool) -> None:
    """Add the options for paths and disturbance."""
    path: dict[str, Any] = {"action": "append", "metavar": "FILE"}
    about = "impulse response, reference to error microphone; repeated for several references"
    parser.add_argument("--primary", help=about, **path)
    about = "recording of the error microphone, made together with that of the noise"
    parser.add_argument("--disturbance", metavar="FILE", help=about)
    about = "impulse response, control signal to error microphone; repeated for several loudspeakers"
    parser.add_argument("--secondary", help=about, required=required, **path)
    about = "number of error microphones (default: the channels of the first --secondary)"
    add_count(parser, "--microphones", metavar="K", help=about)
    add_reading(parser)


def add_recorded_scene(parser: argparse._ActionsContainer) -> None:
    """Add the options for a recorded noise, the paths and the rating."""
    about = (
        "recording of the reference microphone, made while the loudspeaker is silent; FILE:1 is channel 1 of a file, "
        "FILE:NAME its variable NAME"
    )
    parser.add_argument("noise", help=about)
    add_scene(parser, required=True)
    rating = parser.add_argument_group(
        "rating",
        "--watt and --ohm of the amplifier, or --rated-power; each option once for all loudspeakers, or once for each",
    )
    each: dict[str, Any] = {"action": "append"}
    add_number(rating, "--watt", "W", help="rated power of the amplifier", **each)
    add_number(rating, "--ohm", "ohm", help="load of these watts, or a loudspeaker's nominal impedance", **each)
    rating.add_argument(
        "--rating",
        choices=("sine", "noise"),
        help="signal with which the watts were measured (default: sine, which is on the safe side)",
    )
    add_number(rating, "--peak-volts", "V", help="voltage at which the amplifier clips", **each)
    about = (
        "volts for a control signal of 1, with which the secondary path was measured; ratings in W or V need it, unless the "
        "path's file is in Pa/V"
    )
    add_number(rating, "--volts-per-unit", "V", help=about, **each)
    add_number(rating, "--rated-power", "", metavar="P", help="rated power as mean square, in place of watts", **each)
    add_number(rating, "--loudspeaker-watt", "W", help="rated noise power of the loudspeaker", **each)
