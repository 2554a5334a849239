"""The command `kfopc run`: levels, powers and health of a run in the terminal."""

from __future__ import annotations

import argparse
import sys
from typing import Any, TextIO

import numpy as np

from .._validate import as_positive
from ..controllers.power_budget import kf_pb
from ..paths.file_checks import require_same_length, require_shorter, require_sound
from ..paths.reading import read_path
from ..power.limiter import OutputLimiter
from ..signals.recordings import read_recording
from .interfaces import Interface, SimulatedInterface
from .running import FaultError, IdentifiedPlant, Levels, RunReport, run
from .sound_device import SoundDevice

SMALL_BOUND_DB = 10.0  # below it, a shorter delay may be worth having

EXAMPLES = """examples:
  kfopc run noise.wav --primary P.wav --secondary S.wav --rated-power 0.1 --seconds 20
  kfopc run noise.wav --primary P.wav --secondary S.wav --rated-power 0.1 --clock real --block 32
  kfopc run --device 3 --references 0 --errors 1 --outputs 0 --rated-power 0.01 --amplitude-limit 0.5

With a recording, the plant is simulated. With --device, it is real: begin with a small --amplitude-limit.
Ctrl-C fades the control out. exit code: 0 ended as asked, 1 stopped by a fault, 2 wrong input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `kfopc run` to a parser."""
    parser.add_argument("noise", nargs="?", help="recording of the reference microphone, for a simulated plant")
    parser.add_argument("--primary", metavar="FILE", help="impulse response, reference to error microphone")
    parser.add_argument("--disturbance", metavar="FILE", help="recording of the error microphone, made with the noise")
    parser.add_argument("--secondary", metavar="FILE", help="impulse response, control signal to error microphone")
    parser.add_argument(
        "--clock", choices=("free", "real"), default="free", help="simulate as fast as possible, or in real time"
    )
    parser.add_argument(
        "--latency", type=int, metavar="N", help="samples from writing to playing (default: two blocks)"
    )
    parser.add_argument("--device", help="sound card, as `python -m sounddevice` lists it; default is the system's")
    for name, what in (("references", "reference microphones"), ("errors", "error microphones")):
        parser.add_argument(f"--{name}", metavar="N", nargs="+", type=int, help=f"inputs of the {what}, from 0")
    parser.add_argument("--outputs", metavar="N", nargs="+", type=int, default=[0], help="outputs (default: 0)")
    parser.add_argument("--fs", type=float, metavar="HZ", help="sample rate (default: the recording's, or 16000)")
    parser.add_argument("--block", type=int, default=64, metavar="N", help="samples of a block (default: 64)")
    parser.add_argument("--rated-power", type=float, required=True, metavar="P", help="rated power, a mean square")
    parser.add_argument(
        "--amplitude-limit", type=float, metavar="A", help="largest control signal (default: 4 sqrt(P))"
    )
    parser.add_argument("--taps", type=int, default=256, metavar="N", help="taps of the control filter (default: 256)")
    parser.add_argument(
        "--seconds", type=float, metavar="S", help="seconds of control (default: until the recording ends, or Ctrl-C)"
    )
    parser.add_argument("--listen", type=float, default=2.0, metavar="S", help="silence before (default: 2)")
    parser.add_argument("--identify", type=float, default=5.0, metavar="S", help="noise that is played (default: 5)")
    parser.add_argument("--quiet", action="store_true", help="print only the result")


def run_command(options: argparse.Namespace) -> int:
    """Run with the options of `add_options`; return 0, or 1 if a fault ended the run."""
    as_positive(options.rated_power, "--rated-power")
    interface = _interface(options)
    if isinstance(interface, SimulatedInterface):
        _judge_length(options, interface)
    limit = 4.0 * options.rated_power**0.5 if options.amplitude_limit is None else options.amplitude_limit
    show = None if options.quiet else _Screen(sys.stderr)
    try:
        report = run(
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
        return 1
    if show is not None:
        show.end()
    print(_summary(report, interface.fs, interface.block))
    return 1 if report.stopped_by.startswith("fault") else 0


def _interface(options: argparse.Namespace) -> Interface:
    card = (options.device, options.references, options.errors)
    if options.noise is not None and any(option is not None for option in card):
        raise ValueError(
            "give either a recording or a sound card: --device, --references and --errors do not go with a recording"
        )
    if options.noise is None:
        if options.references is None or options.errors is None:
            raise ValueError(
                "a recording with --primary and --secondary is needed for a simulated plant, or --references and --errors, "
                "the inputs of a sound card"
            )
        device = int(options.device) if (options.device or "").isdigit() else options.device
        return SoundDevice(
            options.references,
            options.errors,
            options.outputs,
            fs=16000.0 if options.fs is None else options.fs,
            block=options.block,
            device=device,
        )
    if options.secondary is None:
        raise ValueError("--secondary is needed: the impulse response from control signal to error microphone")
    noise = read_recording(options.noise, fs=options.fs)
    n_samples = noise.samples.shape[-1]
    files = {"secondary": read_path(options.secondary, fs=options.fs)}
    for name, read in (("primary", read_path), ("disturbance", read_recording)):
        if getattr(options, name) is not None:
            files[name] = read(getattr(options, name), fs=options.fs)
    for name, one in files.items():
        if one.fs != noise.fs:
            raise ValueError(
                f"--{name} is sampled at {one.fs:g} Hz, the noise at {noise.fs:g} Hz: resample all, for example with "
                "--fs 16000"
            )
    for name in ("primary", "secondary"):
        if name in files:
            path = files[name]
            require_shorter(getattr(options, name), path.samples.shape[-1], options.noise, n_samples, noise.fs)
            require_sound(getattr(options, name), path.samples)
    if "disturbance" in files:
        require_same_length(options.disturbance, files["disturbance"].samples.shape[-1], options.noise, n_samples)
    primary = files.get("primary")
    disturbance = files.get("disturbance")
    return SimulatedInterface(
        noise.one_channel(),
        files["secondary"].one_channel(),
        primary_path=None if primary is None else primary.one_channel(),
        disturbance=None if disturbance is None else disturbance.one_channel(),
        fs=noise.fs,
        block=options.block,
        latency=options.latency,
        clock=options.clock,
    )


def _judge_length(options: argparse.Namespace, interface: SimulatedInterface) -> None:
    """Raise ValueError if a recording ends before the control begins, warn if it ends before the seconds asked."""
    lasts, before = interface.n_samples / interface.fs, options.listen + options.identify
    text = (
        f"{options.noise} lasts {lasts:.3g} s, of which listening takes {options.listen:g} s and identifying "
        f"{options.identify:g} s"
    )
    mend = "give a longer recording, or a shorter --listen and --identify"
    if lasts <= before:
        raise ValueError(f"{text}: nothing is left to control; {mend}")
    if options.seconds is not None and lasts - before < options.seconds:
        left = f"{lasts - before:.3g} s of control are left of the {options.seconds:g} s asked for"
        print(f"{options.prog}: warning: {text}: {left}; {mend}", file=sys.stderr)


def _controller(plant: IdentifiedPlant, options: argparse.Namespace, limit: float) -> Any:
    """Return KF-PB behind its limiter for what was identified."""
    several = np.ndim(plant.taps) == 3
    limiters = [
        OutputLimiter(options.rated_power, fs=plant.fs, amplitude_limit=limit)
        for _ in range(plant.taps.shape[1] if several else 1)
    ]
    settings: dict[str, Any] = {
        "rated_power": options.rated_power,
        "secondary_path_uncertainty": plant.uncertainty,
        "fs": plant.fs,
    }
    if several:
        settings["n_references"] = len(np.atleast_2d(plant.references))
    return kf_pb(options.taps, plant.taps, limiter=limiters if several else limiters[0], **settings)


class _Screen:
    """One line in the terminal that shows the present levels."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._is_terminal = stream, stream.isatty()
        self._calls = 0

    def __call__(self, levels: Levels) -> None:
        line = describe(levels)
        self._calls += 1
        if self._is_terminal:
            self._stream.write(f"\r\x1b[K{line}")
        elif self._calls % 20 == 0:  # in a file, a line every five seconds
            self._stream.write(f"{line}\n")
        self._stream.flush()

    def end(self) -> None:
        """Leave the line."""
        if self._is_terminal:
            self._stream.write("\n")


def describe(levels: Levels) -> str:
    """Return levels as a line of text."""
    reductions = " ".join(f"{r:5.1f}" for r in levels.reduction_db)
    rated = np.full(len(levels.powers), np.nan) if levels.rated_power is None else levels.rated_power
    powers = " ".join(
        f"{p:.3g} ({100 * p / r:.0f} %)" if np.isfinite(r) else f"{p:.3g}"
        for p, r in zip(levels.powers, np.broadcast_to(rated, len(levels.powers)), strict=True)
    )
    health = ", ".join(f"{n} {what}" for what, n in levels.health.counts.items()) or "healthy"
    return (
        f"{levels.time_s:7.1f} s  reduction {reductions} dB  power {powers}  load {100 * levels.load:.0f} %  "
        f"overruns {levels.overruns}  {health}"
    )


def _summary(report: RunReport, fs: float, block: int) -> str:
    """Return a report as text."""
    rated = report.rated_power
    powers = ", ".join(
        f"{p:.3g}" + ("" if rated is None else f", {100 * p / r:.0f} % of the rated power")
        for p, r in zip(
            report.powers, np.broadcast_to(1.0 if rated is None else rated, report.powers.shape), strict=True
        )
    )
    trip = report.round_trip_samples
    lines = [
        f"{report.seconds:.1f} s under control, stopped by {report.stopped_by}",
        f"noise reduction {', '.join(f'{r:.1f}' for r in report.reduction_db)} dB over the second half, against the silence before",
        f"output power {powers}",
        f"{report.overruns} of {report.blocks} blocks took longer than their duration, the longest {100 * report.load:.0f} % of it; "
        f"{report.lost} samples lost, {report.underflows} blocks too late for the output",
    ]
    if trip is not None:
        lines.insert(1, f"round trip {trip} samples, {1e3 * trip / fs:.1f} ms")
    if np.isfinite(report.possible_db):
        reach = f"the best filter without a rated power would reach {report.possible_db:.1f} dB"
        if report.possible_db < SMALL_BOUND_DB and block > 1:
            reach += (
                f"; if the anti-noise comes too late, use a smaller --block: two blocks of {block} samples are "
                f"{2e3 * block / fs:.2g} ms"
            )
        lines.insert(2, reach)
    faults = [f"{event.time_s:.2f} s: {event.what} {event.channel}".rstrip() for event in report.health.events]
    lines.append("health: " + ("; ".join(faults[-10:]) or "nothing noticed"))
    return "\n".join(lines)
