"""The command `kfopc`, which is also `python -m kfopc_filterpy`: verdicts, paths and comparisons from files.

Exit codes: 0 done, and for a verdict "enough"; 1 the verdict "not enough"; 2 wrong input, said in one line.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from .cli_inputs import (
    Files,
    in_options,
    pascal_per_unit_of,
    ratings_of,
    scene_of,
    uncertainty_of,
    warn,
)

if TYPE_CHECKING:
    from .bench import Assessment

ENOUGH, NOT_ENOUGH, WRONG_INPUT = 0, 1, 2
EXTRA = 'install the extra `studies`: python -m pip install "kfopc-filterpy[studies]"'
WRITTEN = (".wav", ".npy", ".csv", ".txt")
UNRELATED, CHANCE = 0.02, 3.0  # share of a response that a path must explain, and times what chance explains
POOR_DB = -20.0  # of the response that is left unexplained: more is too much

EXAMPLES = {
    "": """examples:
  kfopc verdict noise.wav --primary P.wav --secondary S.wav --watt 20 --ohm 8 --volts-per-unit 10 --want-db 6 -o out
  kfopc paths identify sent.wav received.wav --taps 512 -o S.wav
  kfopc compare noise.wav --primary P.wav --secondary S.wav --rated-power 1.6 --algorithm KF-PB,FxLMS -o out
  kfopc run noise.wav --primary P.wav --secondary S.wav --rated-power 0.1 --seconds 20
  kfopc explore
  kfopc data list
each command has its own --help""",
    "verdict": """examples:
  kfopc verdict noise.wav --primary P.wav --secondary S.wav --watt 20 --ohm 8 --volts-per-unit 10 --want-db 6 -o out
  kfopc verdict noise.wav --disturbance error.wav --secondary S.wav --watt 20 --ohm 8 --rating noise --json
  kfopc verdict noise.wav --primary P.wav --secondary S.wav --fs 16000 --rated-power 1.6 --taps 256
  cat noise.wav | kfopc verdict - --primary P.wav --secondary S.wav --rated-power 1.6
  kfopc verdict noise.wav --disturbance errors.wav --secondary S1.wav --secondary S2.wav --watt 20 --watt 10 --ohm 8

several channels: those of the noise are the references, those of the disturbance the microphones. Each --secondary is one
loudspeaker and each --primary one reference; the channels of these files are the microphones. With files of one channel,
say how many microphones there are, and give the files source after source, for each source its microphones in order:
  kfopc verdict noise.wav --microphones 2 --primary P11.wav --primary P21.wav \\
    --secondary S11.wav --secondary S21.wav --secondary S12.wav --secondary S22.wav --rated-power 1.6
where S21 is loudspeaker 1 at microphone 2. An array (microphones, loudspeakers, taps) in a .npy, .mat or .sofa file holds
all. Options of the rating are given once for all loudspeakers, or once for each, in their order.

exit code: 0 enough, 1 not enough, 2 wrong input""",
    "identify": """example:
  kfopc paths identify sent.wav received.wav --taps 512 -o S.wav""",
    "inspect": """example:
  kfopc paths inspect S.wav --primary P.wav""",
    "convert": """example:
  kfopc paths convert S.wav S.csv""",
    "resample": """example:
  kfopc paths resample S.wav S16.wav --fs 16000""",
    "plot": """example:
  kfopc paths plot P.wav S.wav -o paths.png""",
    "explore": """examples:
  kfopc explore
  kfopc explore noise.wav --primary P.wav --secondary S.wav""",
    "data": """examples:
  kfopc data list
  kfopc data fetch duct compressor
  kfopc data where""",
    "compare": """example:
  kfopc compare noise.wav --primary P.wav --secondary S.wav --watt 20 --ohm 8 --algorithm KF-PB,KF-OPC,FxLMS -o out""",
}


class _Parser(argparse.ArgumentParser):
    """Parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(WRONG_INPUT, f"{self.prog}: {message}; see {self.prog} --help\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    Parameters
    ----------
    arguments : sequence of str, optional
        The arguments; by default those of the process.

    Returns
    -------
    int
        0 done or enough, 1 not enough, 2 wrong input.
    """
    options, unknown = _parser().parse_known_args(arguments)
    try:
        if unknown:
            raise ValueError(f"unrecognized arguments: {' '.join(unknown)}; see {options.prog} --help")
        return options.run(options)
    except (ValueError, TypeError, OSError, ImportError, RuntimeError, MemoryError) as error:
        words = in_options(" ".join(str(error).split()), options) or type(error).__name__
        print(f"{options.prog}: {words}", file=sys.stderr)
        return WRONG_INPUT
    except KeyboardInterrupt:
        print(f"{options.prog}: interrupted; nothing of it was written", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="kfopc",
        description="Active noise control with a limited amplifier, from recordings.",
        epilog=EXAMPLES[""],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
    _verdict_options(_command(commands, "verdict", _verdict, "say whether an amplifier is enough, and what limits"))
    _compare_options(_command(commands, "compare", _compare, "tune and compare the algorithms on your own data"))
    about = "identify, inspect, convert, resample and plot impulse responses"
    paths = commands.add_parser("paths", help=about, description=_sentence(about))
    _path_commands(paths.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=_Parser))
    _run_options(_command(commands, "run", _run, "control noise in real time, with a sound card or a simulated plant"))
    explore = _command(commands, "explore", _explore, "open a page with sliders for rating, noise, paths and algorithm")
    explore.add_argument("noise", nargs="?", help="your own recording of the reference microphone; needs both paths")
    explore.add_argument("--primary", metavar="FILE", help="impulse response, reference to error microphone")
    explore.add_argument("--secondary", metavar="FILE", help="impulse response, control signal to error microphone")
    explore.add_argument("--fs", type=float, metavar="HZ", help="resample everything to this rate")
    explore.add_argument("--port", type=int, default=5006, metavar="N", help="port; 0 is any free one (default: 5006)")
    data = _command(commands, "data", _data, "list or fetch the public measured data, or say where they are")
    data.add_argument("action", choices=("list", "fetch", "where"), help="what to do")
    data.add_argument("name", nargs="*", help="data sets to list or fetch (default: all)")
    data.add_argument("--folder", metavar="FOLDER", help="in place of KFOPC_DATA or the cache")
    data.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _command(commands: Any, name: str, run: Callable[[Any], int], about: str) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        name,
        help=about,
        description=_sentence(about),
        epilog=EXAMPLES.get(name),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run, prog=parser.prog)
    return parser


def _sentence(about: str) -> str:
    return about[0].upper() + about[1:] + "."


def _reading_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--fs", type=float, metavar="HZ", help="resample everything to this rate")
    parser.add_argument("--channel", type=int, metavar="N", help="channel of files with several, from 0")
    parser.add_argument("--variable", metavar="NAME", help="variable of files with several")


def _scene_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the noise, the paths and the rating."""
    parser.add_argument("noise", help="recording of the reference microphone, loudspeaker silent; - is standard input")
    parser.add_argument(
        "--primary", action="append", metavar="FILE", help="impulse response, reference to error microphone"
    )
    parser.add_argument("--disturbance", metavar="FILE", help="recording of the error microphone, made with the noise")
    parser.add_argument(
        "--secondary",
        action="append",
        metavar="FILE",
        required=True,
        help="impulse response, control signal to error microphone; repeated for several loudspeakers",
    )
    parser.add_argument(
        "--microphones",
        type=int,
        metavar="K",
        help="number of error microphones (default: the channels of the first --secondary)",
    )
    _reading_options(parser)
    rating = parser.add_argument_group(
        "rating",
        "of the amplifier: --watt and --ohm, or --rated-power; numbers and curves once for all loudspeakers, or once for each",
    )

    def add(option: str, **more: Any) -> None:
        rating.add_argument(option, action="append", **more)

    add("--watt", type=float, metavar="W", help="rated power of the amplifier")
    add("--ohm", type=float, metavar="R", help="into this resistance")
    rating.add_argument(
        "--rating",
        choices=("sine", "noise"),
        default="sine",
        help="what the watts were measured with (default: sine, the safe side)",
    )
    add("--peak-volts", type=float, metavar="V", help="voltage at which the amplifier clips")
    add("--volts-per-unit", type=float, metavar="V", help="volts for a control signal of 1 (default: 1)")
    add("--rated-power", type=float, metavar="P", help="rated power as mean square, in place of watts")
    add(
        "--impedance",
        metavar="CSV",
        help="the loudspeaker's impedance, whose least value counts: Hz, ohm (default: --ohm)",
    )
    add("--loudspeaker-watt", type=float, metavar="W", help="rated noise power of the loudspeaker")
    add("--programme-watt", type=float, metavar="W", help="its programme power, in place of that")
    add("--x-max-mm", type=float, metavar="MM", help="its largest excursion, one way")
    add("--displacement", metavar="CSV", help="its excursion per volt: a column of Hz, a column of mm/V, and commas")


def _verdict_options(parser: argparse.ArgumentParser) -> None:
    _scene_options(parser)
    parser.add_argument("--want-db", type=float, default=6.0, metavar="DB", help="noise reduction wanted (default: 6)")
    parser.add_argument(
        "--algorithm", default="KF-PB", help="KF-PB (default), KF-OPC or FxLMS, behind a limiter; the others beside it"
    )
    parser.add_argument(
        "--taps", type=int, metavar="N", help="taps of the control filter (default: found, at most 256)"
    )
    parser.add_argument(
        "--memory", type=float, metavar="S", help="memory of the filter (default: 0.25 s, several channels 1 s)"
    )
    parser.add_argument(
        "--path-error-samples",
        type=float,
        metavar="N",
        help="delay by which the secondary path may be wrong (default: 1)",
    )
    parser.add_argument(
        "--path-error-deg", type=float, default=0.0, metavar="DEG", help="phase by which it may be wrong"
    )
    parser.add_argument("--path-error-db", type=float, default=0.0, metavar="DB", help="gain by which it may be wrong")
    parser.add_argument(
        "--secondary-again",
        action="append",
        metavar="FILE",
        help="another measurement of the secondary path, which tells how far it may be wrong; may be repeated",
    )
    parser.add_argument(
        "--pascal-per-unit",
        action="append",
        type=float,
        metavar="PA",
        help="calibration of the error microphone, for levels in dBA; once for all microphones, or once for each",
    )
    parser.add_argument(
        "--calibrator",
        action="append",
        metavar="FILE",
        help="recording of a sound calibrator by the error microphone, in place of that",
    )
    parser.add_argument(
        "--calibrator-db", type=float, default=94.0, metavar="DB", help="its sound pressure level (default: 94)"
    )
    parser.add_argument(
        "-o", "--output", metavar="FOLDER", help="folder for the page, figures, sounds and verdict.json"
    )
    parser.add_argument("--json", action="store_true", help="print verdict.json in place of text")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


@contextmanager
def _bar(quiet: bool, unit: str) -> Iterator[Any]:
    """Give a progress bar on a terminal."""
    try:
        from tqdm import tqdm
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"the progress bar needs tqdm: {EXTRA}") from error
    with tqdm(unit=unit, unit_scale=True, disable=True if quiet else None, dynamic_ncols=True, leave=False) as bar:
        yield bar


def _verdict(options: argparse.Namespace) -> int:
    if options.output is not None:  # better before the run than after it
        import matplotlib

        from .bench.assessment_page import require_page
        from .bench.report import prepare_folder

        matplotlib.use("Agg")
        require_page()
        prepare_folder(options.output)
    from .bench import assess

    files = Files(options)
    noise, primary, secondary, disturbance = scene_of(options, files)
    rating = ratings_of(options, secondary.shape[1])
    uncertainty = uncertainty_of(options, files, secondary)
    assert files.fs is not None
    with _bar(options.quiet, "sample") as bar:
        verdict = assess(
            noise,
            primary,
            secondary,
            rating=rating,
            fs=files.fs,
            disturbance=disturbance,
            want_db=options.want_db,
            algorithm=options.algorithm,
            n_taps=options.taps,
            memory_s=options.memory,
            secondary_path_uncertainty=uncertainty,
            pascal_per_unit=pascal_per_unit_of(options),
            bar=bar,
        )
        verdict = _in_options(verdict, files.remarks, options)
        if options.output is not None:
            bar.set_description("page")
            page = verdict.write(options.output)
    print(verdict.json if options.json else verdict)
    for note in verdict.notes:
        warn(options, note, "note")
    if options.output is not None and not options.json:
        print(f"{page} and verdict.json written")
    return ENOUGH if verdict.enough else NOT_ENOUGH


def _in_options(verdict: Assessment, remarks: Sequence[str], options: argparse.Namespace) -> Assessment:
    """Return a verdict that names options in place of arguments, with further remarks."""

    def named(texts: Sequence[str]) -> tuple[str, ...]:
        return tuple(in_options(text, options) for text in texts)

    settings = verdict.settings
    reasons = dict(zip(settings.reasons, named(tuple(settings.reasons.values())), strict=True))
    return replace(
        verdict,
        advice=named(verdict.advice),
        notes=named((*verdict.notes, *remarks)),
        settings=replace(settings, reasons=reasons),
    )


def _compare_options(parser: argparse.ArgumentParser) -> None:
    _scene_options(parser)
    parser.add_argument(
        "--taps",
        type=int,
        metavar="N",
        help="taps of the control filters (default: found, at most 256, and 1024 in all)",
    )
    parser.add_argument(
        "--algorithm",
        metavar="NAME,...",
        help="algorithms to compare (default: all; with several channels those that are fast enough)",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=10.0,
        metavar="S",
        help="of the record that is used, from its start (default: 10)",
    )
    parser.add_argument(
        "-o", "--output", metavar="FOLDER", help="folder for the report, figures, sounds and results.json"
    )
    parser.add_argument("--json", action="store_true", help="print the figures of merit as JSON")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def _compare(options: argparse.Namespace) -> int:
    import matplotlib

    matplotlib.use("Agg")
    from .bench import algorithms, compare_recordings, results_table, write_report

    files = Files(options)
    noise, primary, secondary, disturbance = scene_of(options, files)
    several = (len(noise), *secondary.shape[:2]) != (1, 1, 1)
    names = None if several else list(algorithms())
    if options.algorithm is not None:
        names = options.algorithm.split(",")
    rating = ratings_of(options, secondary.shape[1])
    with _bar(options.quiet, "run") as bar:
        report = compare_recordings(
            noise,
            primary,
            secondary,
            rating=rating,
            fs=files.fs or 0.0,
            disturbance=disturbance,
            names=names,
            n_taps=options.taps,
            seconds=options.seconds,
            bar=bar,
        )
    report.notes[:] = [in_options(note, options) for note in (*report.notes, *files.remarks)]
    if options.output is not None:
        page = write_report([report], options.output)
    print(json.dumps(report.result, indent=2, allow_nan=False) if options.json else results_table([report]).rstrip())
    for note in report.notes:
        warn(options, note, "note")
    if options.output is not None and not options.json:
        print(f"{page} and results.json written")
    return ENOUGH


def _path_commands(actions: Any) -> None:
    identify = _command(
        actions, "identify", _identify, "fit an impulse response to a recorded excitation, noise or sweep"
    )
    identify.add_argument("excitation", help="what was sent to the amplifier; - is standard input")
    identify.add_argument("response", help="what the microphone heard, recorded at the same time")
    identify.add_argument("--taps", type=int, required=True, metavar="N", help="length of the impulse response")
    identify.add_argument("-o", "--output", metavar="FILE", required=True, help=f"file to write: {', '.join(WRITTEN)}")
    inspect = _command(actions, "inspect", _inspect, "say what an impulse response does")
    inspect.add_argument("path", help="the impulse response; - is standard input")
    inspect.add_argument(
        "--primary", metavar="FILE", help="impulse response of the primary path, for the causality margin"
    )
    convert = _command(actions, "convert", _convert, "write an impulse response in another format")
    resample = _command(actions, "resample", _convert, "write an impulse response at another sample rate")
    for parser in (convert, resample):
        parser.add_argument("path", help="the impulse response; - is standard input")
        parser.add_argument("to", nargs="?", metavar="output", help=f"file to write: {', '.join(WRITTEN)}")
        parser.add_argument("-o", "--output", metavar="FILE", help="the same")
    plot = _command(actions, "plot", _plot, "draw impulse responses and frequency responses")
    plot.add_argument("path", nargs="+", help="impulse responses of one sample rate")
    plot.add_argument("-o", "--output", metavar="FILE", required=True, help="figure to write: .png, .svg or .pdf")
    for parser in (identify, inspect, convert, plot):
        _reading_options(parser)
    resample.add_argument("--fs", type=float, metavar="HZ", required=True, help="the new rate")
    resample.set_defaults(channel=None, variable=None)
    for parser in (identify, inspect):
        parser.add_argument("--json", action="store_true", help="print JSON")


def _identify(options: argparse.Namespace) -> int:
    from .paths import estimate_path

    files = Files(options)
    sent, heard = files.recording(options.excitation), files.recording(options.response)
    shortest = min(sent.size, heard.size)  # a recorder is stopped later than the player
    if options.taps > (shortest + 1) // 2 > 0:
        raise ValueError(
            f"--taps must be at most {(shortest + 1) // 2} for recordings of {shortest} samples, got {options.taps}: "
            "identify a shorter impulse response, or record for longer"
        )
    found = estimate_path(sent[:shortest], heard[:shortest], options.taps, files.fs or 0.0)
    _judge_residual(options, found.residual_db, files.fs or 0.0, shortest)
    _write_path(options.output, found.taps, files.fs or 0.0)
    facts = {"n_taps": options.taps, "fs": files.fs, "residual_db": float(found.residual_db), "output": options.output}
    text = f"{options.output}: {options.taps} taps, which leave {found.residual_db:.1f} dB of the response unexplained"
    print(json.dumps(facts) if options.json else text)
    return ENOUGH


def _judge_residual(options: argparse.Namespace, residual_db: float, fs: float, n_samples: int) -> None:
    """Raise ValueError if a fit explains hardly more of a response than chance would, warn if it explains little."""
    share = 1.0 - 10 ** (residual_db / 10)
    explained = f"explains {100 * max(share, 0.0):.1f} % of {options.response}"
    if share < max(UNRELATED, CHANCE * options.taps / n_samples):
        raise ValueError(
            f"{options.excitation} {explained}, hardly more than chance would: are the files swapped, or of different "
            "recordings? Give what was sent to the amplifier first, then what the microphone heard at the same time; "
            "nothing was written"
        )
    if residual_db > POOR_DB:
        warn(
            options,
            f"{options.excitation} {explained} only: play it louder or wait for silence, check that nothing is "
            f"clipped, and give more --taps if the impulse response is longer than {1e3 * options.taps / fs:.3g} ms",
        )


def _inspect(options: argparse.Namespace) -> int:
    from .paths import causality_margin

    files = Files(options)
    paths = files.matrix([options.path], "path")
    primary = None if options.primary is None else files.matrix([options.primary], "--primary")
    fs = files.fs or 0.0
    several = paths.shape[:2] != (1, 1)
    each = [
        ({"microphone": k + 1, "loudspeaker": j + 1} if several else {}) | _facts(paths[k, j], fs)
        for k, j in np.ndindex(*paths.shape[:2])
    ]
    facts: dict[str, Any] = {"paths": each} if several else each[0]
    if primary is not None:
        facts["causality_margin_s"] = causality_margin(primary, paths, fs=fs).margin_s
    if options.json:
        from .bench.items import jsonable

        print(json.dumps(jsonable(facts), allow_nan=False))
        return ENOUGH
    for one in each:
        if several:
            print(f"microphone {one['microphone']}, loudspeaker {one['loudspeaker']}:")
        print(_described(one))
    if primary is not None:
        margin = facts["causality_margin_s"]
        late = "early enough" if margin > 0 else "too late for anything but tones"
        print(f"causality margin {1e3 * margin:+.2f} ms: the anti-noise is {late}")
    return ENOUGH


def _facts(taps: np.ndarray, fs: float) -> dict[str, Any]:
    """Return what a path does; no band and no onset if it is silent."""
    from .paths import achieved_band, causality_margin, secondary_path_gain

    facts: dict[str, Any] = {"n_taps": taps.size, "fs": fs, "duration_s": taps.size / fs}
    if not np.any(taps):
        return facts | {"power_gain_db": None, "low_hz": None, "high_hz": None, "onset_s": None}
    band = achieved_band(taps, fs=fs)
    return facts | {
        "power_gain_db": _db(secondary_path_gain(taps, band=(0.0, fs / 2), fs=fs)),
        "low_hz": band.low_hz,
        "high_hz": band.high_hz,
        "onset_s": causality_margin(taps, taps, fs=fs).secondary_onset_s,
    }


def _described(facts: dict[str, Any]) -> str:
    """Return what a path does in two lines."""
    seconds = facts["duration_s"]
    duration = f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"
    length = f"{facts['n_taps']} taps at {facts['fs']:g} Hz, {duration}"
    if facts["onset_s"] is None:
        return f"{length}; silent"
    return (
        f"{length}; its energy begins at {1e3 * facts['onset_s']:.3g} ms\n"
        f"power gain {facts['power_gain_db']:.1f} dB; within 3 dB of its peak from {facts['low_hz']:.0f} to "
        f"{facts['high_hz']:.0f} Hz"
    )


def _db(power: float) -> float:
    import math

    return 10 * math.log10(max(power, 1e-30))


def _convert(options: argparse.Namespace) -> int:
    if (options.to is None) == (options.output is None):
        raise ValueError(f"one file to write is needed, for example {options.path} S.csv or {options.path} -o S.csv")
    output = options.to if options.to is not None else options.output
    files = Files(options)
    taps = files.path(options.path)
    _write_path(output, taps, files.fs or 0.0)
    print(f"{output}: {taps.size} taps at {files.fs:g} Hz")
    return ENOUGH


def _write_path(output: str, taps: np.ndarray, fs: float) -> None:
    """Write taps in the format of the file's suffix: text has a column of times in s."""
    from .signals import write_wav

    suffix = Path(output).suffix.lower()
    if suffix == ".wav":
        write_wav(output, taps, fs)
    elif suffix == ".npy":
        np.save(output, taps)
    elif suffix in (".csv", ".txt"):
        times = np.arange(taps.size) / fs
        np.savetxt(output, np.column_stack([times, taps]), delimiter="," if suffix == ".csv" else "\t", fmt="%.17g")
    else:
        raise ValueError(f"{output} must end in {', '.join(WRITTEN)}")


def _plot(options: argparse.Namespace) -> int:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from .plot import plot_bode, plot_impulse_responses

    files = Files(options)
    taps = {Path(name).stem: files.path(name) for name in options.path}
    figure, axes = plt.subplots(3, 1, figsize=(7, 8), layout="constrained")
    plot_impulse_responses(taps, fs=files.fs, ax=axes[0])
    plot_bode(taps, fs=files.fs, ax=axes[1:])
    output = Path(options.output)
    output = output if output.suffix else output.with_suffix(".png")
    figure.savefig(output, dpi=160)
    print(f"{output} written")
    return ENOUGH


def _explore(options: argparse.Namespace) -> int:
    from .bench import explore_setups, read_setup, serve_explore

    setups = list(explore_setups())
    if options.primary and options.secondary:
        setups.insert(0, read_setup(options.noise, options.primary, options.secondary, fs=options.fs))
    elif options.noise or options.primary or options.secondary:
        raise ValueError(
            "your own files need both --primary and --secondary; without files, the page has built-in paths"
        )
    serve_explore(setups, port=options.port)
    return ENOUGH


def _run_options(parser: argparse.ArgumentParser) -> None:
    from .realtime.command import EXAMPLES as run_examples
    from .realtime.command import add_options

    parser.epilog = run_examples
    add_options(parser)


def _run(options: argparse.Namespace) -> int:
    from .realtime.command import run_command

    return run_command(options)


def _data(options: argparse.Namespace) -> int:
    from .signals import dataset_folder, fetch_dataset, has_dataset, list_datasets

    known = {one.name: one for one in list_datasets()}
    for name in options.name:
        if name not in known:
            raise ValueError(f"there is no data set {name!r}; there are {', '.join(known)}")
    folder = str(options.folder or dataset_folder())
    is_named = options.folder or os.environ.get("KFOPC_DATA")
    if is_named and options.action != "fetch" and not Path(folder).is_dir():
        warn(options, f"the folder {folder} does not exist: correct --folder or KFOPC_DATA, or run kfopc data fetch")
    if options.action == "where":
        print(json.dumps({"folder": folder}) if options.json else folder)
        return ENOUGH
    facts = {}
    for name, one in known.items():
        if options.name and name not in options.name:
            continue
        if options.action == "fetch":
            fetch_dataset(name, folder)
        facts[name] = {
            "title": one.title,
            "source": f"https://github.com/{one.repository}/tree/{one.commit}",
            "licence": one.licence,
            "fs": one.fs,
            "units": one.units,
            "here": has_dataset(name, folder),
        }
    if options.json:
        print(json.dumps(facts, indent=2))
    else:
        for name, fact in facts.items():
            here = f"in {folder}" if fact["here"] else "not here: kfopc data fetch"
            print(f"{name}: {fact['title']}, {fact['fs']:g} Hz; licence: {fact['licence']}; {here}")
    return ENOUGH


if __name__ == "__main__":
    sys.exit(main())
