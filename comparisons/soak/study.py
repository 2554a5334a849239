"""`python -m comparisons soak`: controllers over 10^7 samples, watched all the way.

At equal intervals it checks that the covariance is finite, symmetric and positive semidefinite, that weights and
signals are finite, that the noise is not louder than without control, that a limiter holds its rated power, and that
the process does not grow. What fails is dated by the last sample of its interval.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import resource
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatch
from functools import partial
from itertools import cycle
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from scipy.signal import butter, lfilter, sosfilt, unit_impulse

import kfopc_filterpy as anc
from kfopc_filterpy import OutputLimiter, simulate
from kfopc_filterpy._writing import write_whole
from kfopc_filterpy.verdict.items import aligned

SAMPLES = 10_000_000
CHECKS = 20  # in a run
FS = 16000.0
TAPS = 32
SENSOR_NOISE = 1e-2  # standard deviation; the measurement noise q is its variance
Q = SENSOR_NOISE**2
RATED_POWER = 0.5  # a quarter of what full control of white noise needs
PRIMARY, SECONDARY = np.array([0.0, 0.0, 1.0, 0.5]), np.array([0.0, 0.8, -0.3])
TONE_HZ, BAND_HZ = 300.0, (250.0, 350.0)
TURN = 16000  # samples of each noise before the alternating one goes on to the next
SEED = 1
LEAST_EIGENVALUE = -1e-12  # of P, over its largest
LARGEST_GROWTH_MB = 16.0  # of the process, from the second check to the last: 1.8 bytes a sample in 10^7
LOUDER_DB = 1.0
INTERRUPTED = 130  # what shells give a command that Ctrl-C ended
POWER_TOLERANCE = 1e-9  # of a limiter's window, relative

Take = Callable[[int], np.ndarray]


# ---- Noises, which continue from one interval to the next


def tone_source(rng: np.random.Generator) -> Take:
    """Return a source of a sine of power 1."""
    done = 0

    def take(samples: int) -> np.ndarray:
        nonlocal done
        done += samples
        cycles = TONE_HZ / FS * np.arange(done - samples, done) % 1.0
        return np.sqrt(2.0) * np.sin(2.0 * np.pi * cycles)

    return take


def narrow_source(rng: np.random.Generator) -> Take:
    """Return a source of band-limited noise of power 1."""
    sos = butter(4, BAND_HZ, "bandpass", fs=FS, output="sos")
    scale = 1.0 / np.linalg.norm(sosfilt(sos, unit_impulse(int(FS))))
    memory = np.zeros((len(sos), 2))

    def take(samples: int) -> np.ndarray:
        nonlocal memory
        signal, memory = sosfilt(sos, scale * rng.standard_normal(samples), zi=memory)
        return signal

    return take


def alternating_source(rng: np.random.Generator) -> Take:
    """Return a source of the other noises in turn, with jumps between them."""
    turns: Iterator[Take] = cycle([rng.standard_normal, np.zeros, narrow_source(rng), tone_source(rng)])
    left = np.empty(0)

    def take(samples: int) -> np.ndarray:
        nonlocal left
        parts = [left]
        while sum(map(len, parts)) < samples:
            parts.append(next(turns)(TURN))
        signal = np.concatenate(parts)
        left = signal[samples:]
        return signal[:samples]

    return take


SOURCES: dict[str, Callable[[np.random.Generator], Take]] = {
    "tone": tone_source,
    "silence": lambda rng: np.zeros,
    "white": lambda rng: rng.standard_normal,  # of power 1
    "narrow band": narrow_source,
    "alternating": alternating_source,
}


# ---- Controllers


@dataclass(frozen=True)
class Case:
    """A controller to soak, on each of some noises."""

    name: str
    make: Callable[[], Any]
    ratio: float | None = None  # P(0|0) / q
    signals: tuple[str, ...] = tuple(SOURCES)
    secondary: np.ndarray = field(default_factory=lambda: SECONDARY)
    share: float = 1.0  # of the samples
    quiet: bool = True  # whether it must not make the noise louder


def kalman_case(name: str, make: Any, ratio: float, **settings: Any) -> Case:
    """Return a case of a Kalman filter without state noise."""
    noises = {"state_noise": 0.0, "measurement_noise": Q, "initial_variance": ratio * Q}
    return Case(name, partial(make, TAPS, SECONDARY, **noises, **settings), ratio)


def limited_kf_opc(*arguments: Any, **settings: Any) -> Any:
    """Return KF-OPC behind a limiter."""
    limiter = OutputLimiter(RATED_POWER, fs=FS)
    return anc.kf_opc(*arguments, rated_power=RATED_POWER, limiter=limiter, **settings)


def several_channels() -> np.ndarray:
    """Return the secondary paths of two loudspeakers to two microphones."""
    return np.array([[SECONDARY, 0.3 * SECONDARY[::-1]], [0.2 * SECONDARY[::-1], SECONDARY]])


def all_cases() -> list[Case]:
    """Return every case, in the order of the table."""
    rated: dict[str, Any] = {"rated_power": RATED_POWER}
    limit: dict[str, Any] = {"amplitude_limit": 1.0}
    zero: dict[str, Any] = {"state_noise": 0.0, "measurement_noise": Q, "initial_variance": 1e12 * Q}
    paths = several_channels()
    lms: dict[str, tuple[Any, dict[str, Any]]] = {
        "FxLMS": (anc.FxLMS, {}),
        "FxNLMS": (anc.FxNLMS, {}),
        "leaky FxLMS": (anc.LeakyFxLMS, {"leak": 0.1}),
        "optimal leaky FxLMS": (anc.OptimalLeakyFxLMS, rated),
        "MOV-FxLMS": (anc.MOVFxLMS, rated),
        "two-gradient FxLMS": (anc.TwoGradientFxLMS, limit),
        "re-scaling FxLMS": (anc.RescalingFxLMS, limit),
        "clipping FxLMS": (anc.ClippingFxLMS, limit),  # lets the weights grow, and is loud when the noise changes
    }
    return [
        *(kalman_case("KF-ANC", anc.kf_anc, ratio) for ratio in (1e4, 1e12)),
        *(kalman_case("KF-OPC", anc.kf_opc, ratio, **rated) for ratio in (1e4, 1e12)),
        kalman_case("KF-OPC, limiter", limited_kf_opc, 1e12),
        Case("KF-PB", partial(anc.kf_pb, TAPS, SECONDARY, **rated)),
        kalman_case("diagonal KF", anc.DiagonalKalman, 1e12),
        Case("KF-ANC, 2 x 2", partial(anc.kf_anc, TAPS // 2, paths, **zero), ratio=1e12, secondary=paths, share=0.1),
        *(
            Case(name, partial(make, TAPS, SECONDARY, step_size=1e-3, **settings), quiet=name != "clipping FxLMS")
            for name, (make, settings) in lms.items()
        ),
    ]


# ---- A run


@dataclass
class Outcome:
    """What a run showed."""

    name: str
    ratio: float | None
    signal: str
    samples: int = 0
    us_per_sample: float = np.nan
    noise_reduction_db: float = np.nan  # over the last interval
    least_eigenvalue: float = np.nan  # over the largest; the least of all checks
    largest_weight: float = 0.0
    growth_mb: float = 0.0
    violations: list[tuple[int, str]] = field(default_factory=list)  # sample, what


def process_mb() -> float:
    """Return the memory of the process that is resident now; where the system does not tell, the most so far.

    glibc keeps freed blocks, up to tens of MB of the intervals' signals, until it is asked to return them.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (1e6 if sys.platform == "darwin" else 1e3)
    return pages * resource.getpagesize() / 1e6


def covariance_of(controller: Any) -> np.ndarray | None:
    """Return P of a controller that has one."""
    if hasattr(controller, "variances"):
        return np.diag(controller.variances)
    return getattr(controller, "covariance", None)


def covariance_faults(P: np.ndarray) -> tuple[float, list[str]]:
    """Return the smallest eigenvalue of P over its largest, and what is wrong with P."""
    if not np.isfinite(P).all():
        return -np.inf, ["P is not finite"]
    faults = [] if np.array_equal(P, P.T) else ["P is not symmetric"]
    values = np.linalg.eigvalsh(P)
    least = float(values[0] / max(abs(values[0]), abs(values[-1]), np.finfo(np.float64).tiny))
    if least < LEAST_EIGENVALUE:
        faults.append(f"the smallest eigenvalue of P is {least:.2g} of the largest")
    return least, faults


def largest_window_power(y: np.ndarray, window: int) -> float:
    """Return the largest mean square of a window of a control signal, (n,)."""
    sums = np.cumsum(np.concatenate(([0.0], y**2)))
    return float(np.max(sums[window:] - sums[:-window], initial=0.0) / window)


def signal_faults(case: Case, controller: Any, result: Any, signal: str, starting: bool) -> list[str]:
    """Return what is wrong with the signals of an interval; a start from a large P(0|0) may be loud."""
    if result.diverged_at_s is not None:
        return ["the control signal exceeds a million times the rated amplitude"]
    if not (np.isfinite(result.error).all() and np.isfinite(result.control_signal).all()):
        return ["the control signal or the error is not finite"]
    faults = [] if np.isfinite(controller.weights).all() else ["the weights are not finite"]
    if signal != "silence" and not starting and case.quiet and reduction_db(result) < -LOUDER_DB:
        faults.append(f"the noise is louder than without control, by {-reduction_db(result):.1f} dB")
    limiter = getattr(controller, "limiter", None)
    if isinstance(limiter, OutputLimiter):
        most = largest_window_power(result.control_signal, round(limiter.window_s * limiter.fs))
        if most > limiter.rated_power * (1.0 + POWER_TOLERANCE):
            faults.append(f"a window has {most / limiter.rated_power:.12g} of the limiter's rated power")
    return faults


def reduction_db(result: Any) -> float:
    """Return the noise reduction over an interval."""
    return float(10.0 * np.log10(np.mean(result.disturbance**2) / np.mean(result.error**2)))


def intervals(signal: str, samples: int, secondary: np.ndarray) -> Iterator[Callable[[Any], Any]]:
    """Return a function for each interval that runs a controller over it.

    `simulate` begins with silent paths. The anti-noise of the last control signals that is still under way is taken off
    the disturbance instead, so that the intervals are one run.
    """
    rng = np.random.default_rng(SEED)
    take, channels = SOURCES[signal](rng), secondary.shape[:-2]
    microphones = secondary.shape[0] if channels else 1
    memory = np.zeros(PRIMARY.size - 1)
    under_way = np.zeros((*channels, secondary.shape[-1] - 1))
    done = 0
    for check in range(1, CHECKS + 1):
        size, done = samples * check // CHECKS - done, samples * check // CHECKS
        x = take(size)
        d, memory = lfilter(PRIMARY, 1.0, x, zi=memory)
        d = d + SENSOR_NOISE * rng.standard_normal((microphones, size) if channels else size)
        d[..., : under_way.shape[-1]] -= under_way

        def run(controller: Any, x: np.ndarray = x, d: np.ndarray = d) -> Any:
            nonlocal under_way
            result = simulate(controller, x, disturbance=d, secondary_path=secondary, fs=FS)
            under_way = ringing(secondary, result.control_signal)
            return result

        yield run


def ringing(secondary: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the anti-noise after the end of a control signal, (K, taps - 1) or (taps - 1,)."""
    taps = secondary.shape[-1]
    last = np.atleast_2d(y)[:, -(taps - 1) :]
    paths = secondary.reshape(-1, len(last), taps)
    heard = np.array([sum(np.convolve(s, own)[taps - 1 :] for s, own in zip(row, last, strict=True)) for row in paths])
    return heard if secondary.ndim > 1 else heard[0]


def soak(case: Case, signal: str, samples: int, tick: Callable[[int], Any] = lambda samples: None) -> Outcome:
    """Run a case on a noise; `tick` is called with the samples of each interval."""
    controller = case.make()
    outcome = Outcome(case.name, case.ratio, signal)
    memory: list[float] = []
    clock = 0.0
    for run in intervals(signal, samples, case.secondary):
        began = time.process_time()
        try:
            result = run(controller)
        except ValueError as error:
            where = "".join(getattr(error, "__notes__", []))
            outcome.violations.append((outcome.samples, f"refused {where}: {str(error).split(':')[0]}"))
            break
        clock += time.process_time() - began
        size = result.error.shape[-1]
        outcome.samples += size
        faults = signal_faults(case, controller, result, signal, starting=not memory)
        P = covariance_of(controller)
        if P is not None:
            least, of_P = covariance_faults(P)
            outcome.least_eigenvalue = float(np.fmin(outcome.least_eigenvalue, least))
            faults += of_P
        outcome.largest_weight = max(outcome.largest_weight, float(np.max(np.abs(controller.weights))))
        if signal != "silence":
            outcome.noise_reduction_db = reduction_db(result)
        del result
        memory.append(process_mb())
        outcome.growth_mb = memory[-1] - memory[1] if len(memory) > 1 else 0.0
        if outcome.growth_mb > LARGEST_GROWTH_MB:
            faults.append(f"the process has grown by {outcome.growth_mb:.0f} MB")
        outcome.violations += [(outcome.samples, fault) for fault in faults]
        tick(size)
        if faults:
            break
    outcome.us_per_sample = 1e6 * clock / max(outcome.samples, 1)
    return outcome


# ---- The command


def table(outcomes: Sequence[Outcome]) -> str:
    """Return a line for each case, with the noise reduction on each noise and the worst of the rest."""
    noises = [name for name in SOURCES if name != "silence"]
    head = ["controller", "P0/q", *(f"{name}, dB" for name in noises), "least/largest", "MB", "us", "violations"]
    rows = [head]
    for key in dict.fromkeys((one.name, one.ratio) for one in outcomes):
        own = [one for one in outcomes if (one.name, one.ratio) == key]
        reached = {one.signal: f"{one.noise_reduction_db:.1f}" for one in own}
        with_P = [one.least_eigenvalue for one in own if not np.isnan(one.least_eigenvalue)]
        line = [key[0], "-" if key[1] is None else f"{key[1]:.0e}", *(reached.get(name, "-") for name in noises)]
        line += [f"{min(with_P):.1e}" if with_P else "-", f"{max(one.growth_mb for one in own):.1f}"]
        line += [f"{min(one.us_per_sample for one in own):.2f}", str(sum(len(one.violations) for one in own))]
        rows.append(line)
    return "\n".join(aligned(rows, left={0}))


def remarks(outcomes: Sequence[Outcome]) -> list[str]:
    """Return what the table does not say."""
    longest = max(one.samples for one in outcomes)
    lines = [
        f"{len(outcomes)} runs of {longest:,} samples (several channels: a tenth), {CHECKS} checks in each, "
        f"{TAPS} taps, no state noise, q = {Q:g}. dB: noise reduction in the last interval; least/largest: eigenvalues of "
        "P, the worst of all checks; MB: growth of the process; us: time of a sample, the least of the noises."
    ]
    violations = ((one, sample, what) for one in outcomes for sample, what in one.violations)
    return lines + [f"VIOLATION: {one.name}, {one.signal}, by sample {n:,}: {what}." for one, n, what in violations]


def main(arguments: Sequence[str]) -> int:
    """Soak the controllers that the command line names; return 1 if anything was violated."""
    about = "Run the controllers for very long, and watch them."
    parser = argparse.ArgumentParser(prog="python -m comparisons soak", description=about)
    parser.add_argument("--samples", type=float, default=SAMPLES, help="of a run (default: 1e7)")
    parser.add_argument("--only", metavar="NAME", help="controllers whose name fits, such as 'KF-*' (default: all)")
    parser.add_argument("--output", type=Path, default=Path("soak"), help="folder to write into (default: soak)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    options = parser.parse_args(arguments)
    samples = round(options.samples) if np.isfinite(options.samples) else 0
    if samples < 100 * CHECKS:
        parser.error(f"--samples must be {100 * CHECKS} at least, got {options.samples:g}")
    cases = [case for case in all_cases() if options.only is None or fnmatch(case.name, options.only)]
    if not cases:
        known = ", ".join(dict.fromkeys(case.name for case in all_cases()))
        parser.error(f"no controller fits {options.only}; there are {known}")

    from tqdm import tqdm

    options.output.mkdir(parents=True, exist_ok=True)
    written = options.output / "soak.json"
    began, outcomes = time.process_time(), []
    runs = [(case, signal) for case in cases for signal in case.signals]
    planned = sum(round(samples * case.share) for case, _ in runs)
    with tqdm(total=planned, unit="sample", unit_scale=True, disable=options.quiet, dynamic_ncols=True) as bar:
        try:
            for case, signal in runs:
                bar.set_description(f"{case.name}, {signal}")
                outcomes.append(soak(case, signal, round(samples * case.share), bar.update))
                write_whole(written, json.dumps([asdict(one) for one in outcomes], indent=1) + "\n")
        except KeyboardInterrupt:
            print(f"interrupted after {len(outcomes)} of {len(runs)} runs")
    if not outcomes:
        return INTERRUPTED
    lines = (fill(f"- {line}", 110, subsequent_indent="  ") for line in remarks(outcomes))
    print(table(outcomes), "", *lines, sep="\n")
    violated, took = sum(bool(one.violations) for one in outcomes), time.process_time() - began
    print(f"\n{violated} of {len(outcomes)} runs violated a promise; {took:.0f} s of CPU; {written}")
    return 1 if violated else 0 if len(outcomes) == len(runs) else INTERRUPTED
