"""`kfopc run`: control in real time, with levels, powers and health in the terminal."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from itertools import count
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from .._validate import as_nonnegative
from .._writing import jsonable
from .inputs import Files, scene_of
from .options import DONE, Parser, add_command, add_count, add_number, add_scene, refuse_unused
from .printing import warn

if TYPE_CHECKING:
    from ..realtime import Interface, RunReport, RunStatus, SimulatedInterface

FAULT = 1
LATEST = 10  # events that the summary shows
SMALL_BOUND_DB = 10.0  # below it, a shorter delay may be worth having

EXAMPLES = """examples:
  kfopc run noise.wav --primary P.wav --secondary S.wav --rated-power 0.1 --seconds 20
  kfopc run noise.wav --primary P.wav --secondary S.wav --rated-power 0.1 --block 32
  kfopc run --device 3 --references 0 --errors 1 --outputs 0 --fs 16000 --rated-power 0.01 --amplitude-limit 0.5
  kfopc run --device 3 --errors 1 --feedback --fs 16000 --rated-power 0.01 --amplitude-limit 0.5

With a recording, the plant is simulated; give several channels as for kfopc verdict. With --references and --errors, it
is real, behind a sound card at the rate --fs: begin with a small --amplitude-limit.
Ctrl-C fades the control out. exit code: 0 ended as requested, 1 stopped by a fault, 2 wrong input"""


def add_to(commands: argparse._SubParsersAction[Parser]) -> None:
    """Add the subcommand."""
    about = "control noise in real time, with a sound card or a simulated plant"
    parser = add_command(commands, "run", run, about, EXAMPLES)
    parser.add_argument("noise", nargs="?", help="recording of the reference microphone, for a simulated plant")
    add_scene(parser, required=False)
    about = (
        "also predict the disturbance from its past (hybrid control). Without --references, or for a recording without "
        "--primary and --disturbance, there is no reference microphone: the recording is that of the error microphone"
    )
    parser.add_argument("--feedback", action="store_true", help=about)
    add_count(parser, "--latency", help="samples from writing to playing (default: two blocks)")
    parser.add_argument("--device", help="sound card, as `python -m sounddevice` lists it (default: the system's)")
    several: dict[str, Any] = {"minimum": 0, "nargs": "+"}
    add_count(parser, "--references", help="inputs of the reference microphones, counted from 0", **several)
    add_count(parser, "--errors", help="inputs of the error microphones, counted from 0", **several)
    add_count(parser, "--outputs", default=[0], help="outputs to the loudspeakers (default: 0)", **several)
    add_count(parser, "--block", default=64, help="samples in a block (default: 64)")
    about = "rated power, a mean square"
    add_number(parser, "--rated-power", "", metavar="P", required=True, help=about)
    about = "largest control signal (default: 4 sqrt(P))"
    add_number(parser, "--amplitude-limit", "", metavar="A", help=about)
    add_count(parser, "--taps", default=256, help="taps of the control filter (default: 256)")
    about = "seconds of control (default: until the recording ends, or Ctrl-C)"
    add_number(parser, "--seconds", "s", help=about)
    about = "seconds of silence before the identification (default: 2)"
    add_number(parser, "--listen", "s", as_nonnegative, default=2.0, help=about)
    about = "seconds of noise played to identify the paths (default: 5)"
    add_number(parser, "--identify", "s", default=5.0, help=about)
    parser.add_argument("--quiet", action="store_true", help="print only the result")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(options: argparse.Namespace) -> int:
    """Run the control and print the result; return 1 if a fault stopped it."""
    from ..realtime import FaultError
    from ..realtime import run as run_supervised

    interface = _simulated(options) if options.noise is not None else _sound_card(options)
    limit = 4.0 * options.rated_power**0.5 if options.amplitude_limit is None else options.amplitude_limit
    show = None if options.quiet else _screen(sys.stderr)
    try:
        report = run_supervised(
            lambda plant: _controller(plant, options, limit),
            interface,
            amplitude_limit=limit,
            seconds=options.seconds,
            listen_s=options.listen,
            identify_s=options.identify,
            on_report=show,
        )
    except FaultError as fault:
        print(f"{options.prog}: {fault}", file=sys.stderr)
        return FAULT
    if show is not None and sys.stderr.isatty():
        print(file=sys.stderr)  # the line of the status ends
    print(_facts(report) if options.json else summarize(report, interface.fs, interface.block, options.seconds))
    return FAULT if report.stopped_by.startswith("fault") else DONE


def _sound_card(options: argparse.Namespace) -> Interface:
    from ..realtime import SoundDevice

    references = [] if options.references is None and options.feedback else options.references
    if references is None or options.errors is None:
        raise ValueError(
            "a recording with --primary and --secondary is needed for a simulated plant, or --references and --errors, "
            "the inputs of a sound card; without a reference microphone, --feedback in place of --references"
        )
    of_files = ("primary", "disturbance", "secondary", "microphones", "file_fs")
    refuse_unused(options, of_files, " with a sound card: leave it out, or give a recording")
    if options.fs is None:
        raise ValueError("the sample rate of the sound card is missing: give one that it has, for example --fs 48000")
    return SoundDevice(
        references,
        options.errors,
        options.outputs,
        fs=options.fs,
        block=options.block,
        device=int(options.device) if (options.device or "").isdigit() else options.device,
    )


def _simulated(options: argparse.Namespace) -> SimulatedInterface:
    from ..realtime import SimulatedInterface

    if any(option is not None for option in (options.device, options.references, options.errors)):
        raise ValueError(
            "give either a recording or a sound card: --device, --references and --errors do not go with a recording"
        )
    if options.primary is not None and options.disturbance is not None:
        raise ValueError("--disturbance stands in place of --primary: leave out one of them")
    files = Files(options)
    noise, plant, disturbance = scene_of(options, files)
    _judge_length(options, noise.shape[-1] / files.fs)
    only_errors = plant.primary is None and disturbance is None
    return SimulatedInterface(
        None if only_errors else noise,
        plant,
        disturbance=noise if only_errors else disturbance,
        block=options.block,
        latency=options.latency,
    )


def _judge_length(options: argparse.Namespace, lasts: float) -> None:
    """Raise ValueError if a recording ends before the control begins, and warn if it lasts less than `--seconds`."""
    left = lasts - options.listen - options.identify
    text = (
        f"{options.noise} lasts {lasts:.3g} s, of which listening takes {options.listen:g} s and identifying "
        f"{options.identify:g} s"
    )
    mend = "give a longer recording, or a shorter --listen and --identify"
    if left <= 0:
        raise ValueError(f"{text}: nothing is left to control; {mend}")
    if options.seconds is not None and left < options.seconds:
        warn(options, f"{text}: {left:.3g} s of control are left of the {options.seconds:g} s asked for; {mend}")


def _controller(plant: Any, options: argparse.Namespace, limit: float) -> Any:
    """Return KF-PB behind a limiter for the identified plant; with `--feedback` it has an internal model."""
    from .. import OutputLimiter, kf_pb
    from ..controllers import with_internal_model

    n_references = len(np.atleast_2d(plant.references)) + options.feedback * len(np.atleast_2d(plant.errors))
    several = np.ndim(plant.taps) == 3 or n_references > 1
    limiters = [
        OutputLimiter(options.rated_power, fs=plant.fs, amplitude_limit=limit)
        for _ in range(plant.plant.n_loudspeakers)
    ]
    controller = kf_pb(
        options.taps,
        plant.taps,
        rated_power=options.rated_power,
        n_references=n_references,
        limiter=limiters if several else limiters[0],
        secondary_path_uncertainty=plant.uncertainty,
        fs=plant.fs,
    )
    return with_internal_model(controller) if options.feedback else controller


def _screen(stream: TextIO) -> Callable[[RunStatus], None]:
    """Return a function that shows the status of a run: in one line on a terminal, or in a file every five seconds."""
    calls = count(1)

    def show(status: RunStatus) -> None:
        if stream.isatty():
            stream.write(f"\r\x1b[K{describe(status)}")
        elif next(calls) % 20 == 0:
            stream.write(f"{describe(status)}\n")
        stream.flush()

    return show


def describe(status: RunStatus) -> str:
    """Return the status of a run as a line of text."""
    reductions = " ".join(f"{r:5.1f}" for r in status.reduction_db)
    return (
        f"{status.seconds:7.1f} s  reduction {reductions} dB  power {_powers(status)}  load {100 * status.load:.0f} %  "
        f"{_noticed(status) or 'healthy'}"
    )


def _noticed(status: RunStatus) -> str:
    """Return how many blocks took too long, and how often each kind of event was noticed; empty if nothing was."""
    late = {"block(s) too slow": status.overruns} if status.overruns else {}
    return ", ".join(f"{n} {what}" for what, n in (late | status.health.counts).items())


def _powers(report: RunStatus | RunReport, of: str = "") -> str:
    """Return the output powers, and the share of the rated power that they take."""
    rated: Any = report.rated_power  # KF-PB always has one
    return ", ".join(
        f"{p:.3g} ({100 * p / r:.0f} %{of})"
        for p, r in zip(report.powers, np.broadcast_to(rated, report.powers.shape), strict=True)
    )


def _facts(report: RunReport) -> str:
    """Return a report as JSON, without the arrays of the path and the controller."""
    facts = {name: value for name, value in vars(report).items() if name not in ("secondary", "controller")}
    return json.dumps(jsonable(facts | {"health": [vars(event) for event in report.health.events]}), indent=2)


def summarize(report: RunReport, fs: float, block: int, asked_s: float | None = None) -> str:
    """Return a report as text; `asked_s` are the seconds of control that were asked for."""
    end = f"stopped by {report.stopped_by}"
    if report.stopped_by == "end":
        end = "as asked for" if asked_s is not None and report.seconds >= asked_s else "ended with the recording"
    lines = [f"{report.seconds:.1f} s under control, {end}"]
    if report.round_trip_samples is not None:
        lines.append(f"round trip {report.round_trip_samples} samples, {1e3 * report.round_trip_samples / fs:.1f} ms")
    if np.isfinite(report.possible_db):
        reach = (
            f"in the silence before, the best fixed filter without a rated power would reach {report.possible_db:.1f} dB, and "
            "one that adapts perhaps more"
        )
        if report.possible_db < SMALL_BOUND_DB and block > 1:
            reach += (
                f"; if the anti-noise comes too late, use a smaller --block: two blocks of {block} samples are "
                f"{2e3 * block / fs:.2g} ms"
            )
        lines.append(reach)
    reductions = ", ".join(f"{r:.1f}" for r in report.reduction_db)
    faults = [f"{event.time_s:.2f} s: {event.what} {event.channel}".rstrip() for event in report.health.events]
    lines += [
        f"noise reduction {reductions} dB over the second half, relative to the silence before",
        f"output power {_powers(report, ' of the rated power')}",
        f"the longest of {report.blocks} blocks took {100 * report.load:.0f} % of its duration; {report.lost} samples lost, "
        f"{report.underflows} blocks too late for the output",
        f"health: {_noticed(report) or 'nothing noticed'}",
        *(f"  {fault}" for fault in faults[-LATEST:]),
    ]
    return "\n".join(lines)
