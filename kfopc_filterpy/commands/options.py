"""Options as subcommands declare them: numbers that are checked by the option's name, and what several share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any, NoReturn

from .._validate import as_count, as_positive

DONE, WRONG_INPUT = 0, 2


class Parser(argparse.ArgumentParser):
    """Parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(WRONG_INPUT, f"{self.prog}: {message}; see {self.prog} --help\n")


def sentence(about: str) -> str:
    """Return a line of a list as a sentence."""
    return about[0].upper() + about[1:] + "."


def add_command(commands: Any, name: str, run: Callable[[Any], int], about: str, examples: str) -> Parser:
    """Add a subcommand that `run` does, and return its parser."""
    parser = commands.add_parser(
        name,
        help=about,
        description=sentence(about),
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run, prog=parser.prog)
    return parser


def add_number(group: Any, option: str, unit: str, check: Callable[..., float] = as_positive, **more: Any) -> None:
    """Add an option that takes a number, which `check` of `_validate` refuses by the option's name."""
    group.add_argument(option, type=_checked(float, option, check, unit=unit), **{"metavar": unit.upper()} | more)


def add_count(group: Any, option: str, minimum: int = 1, **more: Any) -> None:
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
        except (ValueError, TypeError) as error:  # argparse would replace their message by one of its own
            raise argparse.ArgumentError(None, str(error)) from error

    return read


def add_reading(parser: Any, about_fs: str = "resample everything to this rate", **of_fs: Any) -> None:
    """Add the options of how files are read."""
    add_number(parser, "--fs", "Hz", help=about_fs, **of_fs)
    add_count(parser, "--channel", 0, help="channel of files with several, from 0")
    parser.add_argument("--variable", metavar="NAME", help="variable of files with several")


def add_scene(parser: Any, *, required: bool) -> None:
    """Add the options of paths and disturbance."""
    path: dict[str, Any] = {"action": "append", "metavar": "FILE"}
    about = "impulse response, reference to error microphone; repeated for several references"
    parser.add_argument("--primary", help=about, **path)
    parser.add_argument("--disturbance", metavar="FILE", help="recording of the error microphone, made with the noise")
    about = "impulse response, control signal to error microphone; repeated for several loudspeakers"
    parser.add_argument("--secondary", help=about, required=required, **path)
    about = "number of error microphones (default: the channels of the first --secondary)"
    add_count(parser, "--microphones", metavar="K", help=about)
    add_reading(parser)


def add_recorded_scene(parser: Any) -> None:
    """Add the options of a recorded noise, the paths and the rating."""
    parser.add_argument("noise", help="recording of the reference microphone, loudspeaker silent; - is standard input")
    add_scene(parser, required=True)
    rating = parser.add_argument_group(
        "rating",
        "of the amplifier: --watt and --ohm, or --rated-power; numbers and curves once for all loudspeakers, or once for each",
    )
    each: dict[str, Any] = {"action": "append"}
    add_number(rating, "--watt", "W", help="rated power of the amplifier", **each)
    add_number(rating, "--ohm", "ohm", help="into this resistance", **each)
    rating.add_argument(
        "--rating",
        choices=("sine", "noise"),
        default="sine",
        help="what the watts were measured with (default: sine, the safe side)",
    )
    add_number(rating, "--peak-volts", "V", help="voltage at which the amplifier clips", **each)
    add_number(rating, "--volts-per-unit", "V", help="volts for a control signal of 1 (default: 1)", **each)
    add_number(rating, "--rated-power", "", metavar="P", help="rated power as mean square, in place of watts", **each)
    about = "the loudspeaker's impedance, whose least value counts: Hz, ohm (default: --ohm)"
    rating.add_argument("--impedance", metavar="CSV", help=about, **each)
    add_number(rating, "--loudspeaker-watt", "W", help="rated noise power of the loudspeaker", **each)
    add_number(rating, "--programme-watt", "W", help="its programme power, in place of that", **each)
    add_number(rating, "--x-max-mm", "mm", help="its largest excursion, one way", **each)
    about = "its excursion per volt: a column of Hz, a column of mm/V, and commas"
    rating.add_argument("--displacement", metavar="CSV", help=about, **each)


def add_output(parser: Any, about: str, about_json: str) -> None:
    """Add the options of what is written and printed."""
    parser.add_argument("-o", "--output", metavar="FOLDER", help=about)
    parser.add_argument("--json", action="store_true", help=about_json)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
