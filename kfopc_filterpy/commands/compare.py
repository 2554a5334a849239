"""`kfopc compare`: the algorithms on your own recordings."""

from __future__ import annotations

import argparse
import json

from .._validate import as_choice
from .inputs import Files, ratings_of, scene_of
from .options import DONE, Parser, add_command, add_count, add_number, add_output, add_recorded_scene, prepare_output
from .printing import progress_bar, say_written, tell

EXAMPLES = """example:
  kfopc compare noise.wav --primary P.wav --secondary S.wav --watt 20 --ohm 8 --algorithm KF-PB,KF-OPC,FxLMS -o out"""


def add_to(commands: argparse._SubParsersAction[Parser]) -> None:
    """Add the subcommand."""
    parser = add_command(commands, "compare", compare, "tune and compare the algorithms on your own data", EXAMPLES)
    add_recorded_scene(parser)
    about = "taps of the control filters (default: chosen for the recordings, at most 256, and 1024 in all)"
    add_count(parser, "--taps", help=about)
    about = "algorithms to compare (default: all; with several channels those that are fast enough)"
    parser.add_argument("--algorithm", metavar="NAME,...", help=about)
    about = "seconds of the recording that are used, from its start (default: 10)"
    add_number(parser, "--seconds", "s", default=10.0, help=about)
    about = "folder for the report, figures, sounds and results.json"
    add_output(parser, about, "print the figures of merit as JSON")


def compare(options: argparse.Namespace) -> int:
    """Print figures of merit, and write the report if a folder is given."""
    from ..bench import algorithms, compare_recordings, results_table, write_report

    prepare_output(options)
    files = Files(options)
    noise, primary, secondary, disturbance = scene_of(options, files)
    several = (len(noise), *secondary.shape[:2]) != (1, 1, 1)
    known = algorithms(several_channels=several)
    names = None if several else list(known)
    if options.algorithm is not None:
        names = [as_choice(name, "--algorithm", known) for name in options.algorithm.split(",")]
    with progress_bar(options, "run") as bar:
        report = compare_recordings(
            noise,
            primary,
            secondary,
            rating=ratings_of(options, secondary.shape[1]),
            fs=files.fs,
            disturbance=disturbance,
            names=names,
            n_taps=options.taps,
            seconds=options.seconds,
            bar=bar,
        )
    report.notes.extend(files.remarks)
    text = results_table([report]).rstrip()
    result = json.dumps(report.result, indent=2, allow_nan=False) if options.json else text
    tell(options, result, report.notes)
    if options.output is not None:
        say_written(options, write_report([report], options.output), "results.json")
    return DONE
