"""`kfopc verdict`: whether an amplifier is enough, and what limits."""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial

from .._validate import as_choice, as_nonnegative, as_number
from .._writing import prepare_folder
from .amplifiers import cheapest_enough
from .inputs import Files, calibration_of, ratings_of, scene_of, take_volts, uncertainty_of
from .options import DONE, Parser, add_command, add_count, add_number, add_recorded_scene
from .printing import warn

NOT_ENOUGH = 1

EXAMPLES = """examples:
  kfopc verdict noise.wav --primary P.wav --secondary S.wav --watt 20 --ohm 8 --volts-per-unit 10 --want-db 6 -o out
  kfopc verdict noise.wav --disturbance error.wav --secondary S.wav --rated-power 1.6 --json
  kfopc verdict noise.wav --primary P.wav --secondary S.wav --fs 16000 --rated-power 1.6 --taps 256 --all
  kfopc verdict stereo.wav:0 --disturbance stereo.wav:1 --secondary paths.mat:S --rated-power 1.6
  kfopc verdict ear.wav --feedback --secondary S.wav --watt 0.1 --ohm 32 --volts-per-unit 1.8 --rating noise
  kfopc verdict outside.wav --disturbance ear.wav --feedback --secondary S.wav --watt 0.1 --ohm 32 --volts-per-unit 1.8
  kfopc verdict noise.wav --primary P.wav --secondary S.wav --amplifiers list.csv --volts-per-unit 10
  cat noise.wav | kfopc verdict - --primary P.wav --secondary S.wav --rated-power 1.6
  kfopc verdict noise.wav --disturbance errors.wav --secondary S1.wav --secondary S2.wav --rated-power 2 --rated-power 1

several channels: those of the noise are the references, those of the disturbance the microphones. Each --secondary is one
loudspeaker and each --primary one reference; the channels of these files are the microphones. If each file has one
channel, state the number of --microphones, and give the files source by source, the microphones of each in order:
  kfopc verdict noise.wav --microphones 2 --primary P11.wav --primary P21.wav \\
    --secondary S11.wav --secondary S21.wav --secondary S12.wav --secondary S22.wav --rated-power 1.6
where S21 is loudspeaker 1 at microphone 2. An array (microphones, loudspeakers, taps) in a .npy or .mat file holds
all of them. Give each option of the rating once for all loudspeakers, or once for each, in their order.

exit code: 0 enough, 1 not enough, 2 wrong input"""


def add_to(commands: argparse._SubParsersAction[Parser]) -> None:
    """Add the subcommand."""
    parser = add_command(commands, "verdict", verdict, "say whether an amplifier is enough, and what limits", EXAMPLES)
    add_recorded_scene(parser)
    about = (
        "also predict the disturbance from its past (hybrid control). Without --primary and --disturbance there is no "
        "reference microphone, as in headphones: the noise is what the error microphone records without control"
    )
    parser.add_argument("--feedback", action="store_true", help=about)
    add_number(parser, "--want-db", "dB", as_nonnegative, default=6.0, help="noise reduction wanted (default: 6)")
    about = (
        "list with the columns name, watt, ohm and price, in place of --watt and --ohm: print a table, the cheapest that is "
        "enough first; the verdict is on that one"
    )
    parser.add_argument("--amplifiers", metavar="CSV", help=about)
    about = "algorithm of the verdict, behind a limiter (default: KF-PB); KF-PB, KF-OPC and FxLMS run beside it"
    parser.add_argument("--algorithm", default="KF-PB", help=about)
    about = (
        "compare: run every algorithm beside it, each with the best of the settings that are tried, and print a table"
    )
    parser.add_argument("--all", action="store_true", help=about)
    add_count(parser, "--taps", help="taps of the control filter (default: chosen for the recordings, at most 256)")
    about = "memory of KF-OPC; a filter length that is chosen suits it too (default: 0.25 s, with several channels 1 s)"
    add_number(parser, "--memory", "s", help=about)
    path = parser.add_argument_group(
        "secondary path",
        "how wrong it may be, for KF-PB, which learns it while it controls (default: a relative rms error of 0.3); "
        "stated errors add up",
    )
    add_number(path, "--path-error-samples", "", as_nonnegative, metavar="N", help="error of its delay")
    add_number(path, "--path-error-deg", "deg", as_nonnegative, help="error of its phase")
    add_number(path, "--path-error-db", "dB", as_nonnegative, help="error of its gain")
    about = "another measurement of it, which shows how wrong it may be; can be repeated"
    path.add_argument("--secondary-again", action="append", metavar="FILE", help=about)
    about = "calibration of the error microphone, for levels in dBA; once for all microphones, or once for each"
    add_number(parser, "--pascal-per-unit", "Pa", action="append", help=about)
    about = "recording of a sound calibrator by the error microphone, in place of --pascal-per-unit"
    parser.add_argument("--calibrator", action="append", metavar="FILE", help=about)
    add_number(parser, "--calibrator-db", "dB", as_number, default=94.0, help="its sound pressure level (default: 94)")
    about = "folder for the page, figures, sounds and verdict.json"
    parser.add_argument("-o", "--output", metavar="FOLDER", help=about)
    parser.add_argument("--json", action="store_true", help="print verdict.json in place of text")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def verdict(options: argparse.Namespace) -> int:
    """Print a verdict, and write its page if a folder is given."""
    import tqdm

    from ..verdict import assess
    from ..verdict.assessing import ALL
    from ..verdict.assessment import advice_on
    from ..verdict.candidates import CANDIDATES
    from ..verdict.verdict_page import algorithms_table, settings_table

    if options.output is not None:
        import matplotlib

        matplotlib.use("Agg")
        prepare_folder(options.output)  # better before the run than after it
    as_choice(options.algorithm, "--algorithm", CANDIDATES)
    files = Files(options)
    noise, plant, disturbance = scene_of(options, files)
    take_volts(options, files)
    quiet = True if options.quiet else None  # None: quiet unless on a terminal
    with tqdm.tqdm(unit="sample", unit_scale=True, disable=quiet, dynamic_ncols=True, leave=False) as bar:
        assessed = partial(
            assess,
            noise,
            plant,
            disturbance=disturbance,
            want_db=options.want_db,
            algorithm=options.algorithm,
            beside=ALL if options.all else None,
            n_taps=options.taps,
            memory_s=options.memory,
            secondary_path_uncertainty=uncertainty_of(options, files, plant.secondary),
            pascal_per_unit=calibration_of(options, files, plant.n_microphones),
            feedback=options.feedback,
            bar=bar,
        )
        table = None
        if options.amplifiers is None:
            found = assessed(rating=ratings_of(options, plant.n_loudspeakers))
        else:
            found, table = cheapest_enough(options, plant.n_loudspeakers, lambda rating: assessed(rating=rating))
        advice = advice_on(
            found, fs="--fs ", n_taps="--taps ", noise_rating="--rating noise", peak_volts="--peak-volts"
        )
        origin = {"Command": options.command, "Files": "; ".join(files.read)}
        if table:
            origin["Amplifiers"] = "; ".join(f"{row[0]}: enough {row[-2]}, {row[-1]} dB to spare" for row in table.rows)
        found = replace(found, advice=tuple(advice), notes=(*found.notes, *files.remarks), origin=origin)
    tables = ([table] if table else []) + ([algorithms_table(found), settings_table(found)] if options.all else [])
    text = "\n".join([str(found), *(line for one in tables for line in ("", *one.lines))])
    print(found.json if options.json else text, flush=True)  # before the files are written
    for note in found.notes:
        warn(options, note, "note")
    if options.output is not None:
        page = found.write(options.output)
        if not options.json:
            print(f"{page} and verdict.json written")
    return DONE if found.enough else NOT_ENOUGH
