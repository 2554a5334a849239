"""`kfopc explore`: a page with sliders."""

from __future__ import annotations

import argparse

from .options import DONE, Parser, add_command, add_count, add_number

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
    add_number(parser, "--fs", "Hz", help="resample everything to this rate")
    add_count(parser, "--channel", 0, help="channel to read from files with several, counted from 0")
    add_count(parser, "--port", 0, default=5006, help="port; 0 takes any free one (default: 5006)")


def explore(options: argparse.Namespace) -> int:
    """Serve the page until it is interrupted."""
    from ..bench import explore_setups, read_setup, serve_explore

    setups = list(explore_setups())
    if options.primary and options.secondary:
        files = (options.noise, options.primary, options.secondary)
        setups.insert(0, read_setup(*files, fs=options.fs, channel=options.channel))
    elif options.noise or options.primary or options.secondary:
        raise ValueError(
            "your own files need both --primary and --secondary; without files, the page has built-in paths"
        )
    serve_explore(setups, port=options.port)
    return DONE
