"""`kfopc explore`: a page with sliders."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from .inputs import Files
from .options import DONE, Parser, add_command, add_count, add_reading

if TYPE_CHECKING:
    from ..bench import AcousticSetup

EXAMPLES = """examples:
  kfopc explore
  kfopc explore noise.wav --primary P.wav --secondary S.wav"""


def add_to(commands: argparse._SubParsersAction[Parser]) -> None:
    """Add the subcommand."""
    about = "open a page with sliders for rating, noise, paths and algorithm"
    parser = add_command(commands, "explore", explore, about, EXAMPLES)
    parser.add_argument("noise", nargs="?", help="your own recording of the reference microphone; needs both paths")
    parser.add_argument("--primary", metavar="FILE", help="impulse response, reference to error microphone")
    parser.add_argument("--secondary", metavar="FILE", help="impulse response, control signal to error microphone")
    add_reading(parser)
    add_count(parser, "--port", 0, default=5006, help="port; 0 takes any free one (default: 5006)")


def explore(options: argparse.Namespace) -> int:
    """Serve the page until it is interrupted."""
    from ..bench import explore_setups, serve_explore

    setups = list(explore_setups())
    if options.primary and options.secondary:
        setups.insert(0, _own_setup(options))
    elif options.noise or options.primary or options.secondary:
        raise ValueError(
            "your own files need both --primary and --secondary; without files, the page has built-in paths"
        )
    serve_explore(setups, port=options.port)
    return DONE


def _own_setup(options: argparse.Namespace) -> AcousticSetup:
    """Return the user's files as a setup; without a rate, those above 16 kHz are resampled to it."""
    from ..bench import AcousticSetup
    from ..bench.exploring import MOST_FS

    files = Files(options)
    noise = None if options.noise is None else files.recording(options.noise)
    setup = AcousticSetup(
        "Your recording", files.path(options.primary), files.path(options.secondary), noise=noise, fs=files.fs
    )
    if options.fs is None and setup.fs > MOST_FS:
        options.fs = MOST_FS
        return _own_setup(options)
    return setup
