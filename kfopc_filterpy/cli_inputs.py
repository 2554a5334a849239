"""What the options of the command `kfopc` name: files with signals and paths, ratings, tolerances, calibrations."""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ._validate import as_count, as_positive
from .paths.file_checks import LONG_PATH_S, require_same_length, require_shorter, require_sound
from .signals.quality import clipping_remarks
from .signals.recordings import as_channel

if TYPE_CHECKING:
    from .signals import Recording

STANDARD_INPUT = "-"

# What sets an argument that the package's messages name.
OPTIONS = {
    "algorithm": "--algorithm",
    "amplitude_limit": "--amplitude-limit",
    "block": "--block",
    "channel": "--channel",
    "clock": "--clock",
    "delay_samples": "--path-error-samples",
    "displacement_mm_per_volt": "--displacement",
    "disturbance": "--disturbance",
    "errors": "--errors",
    "fs": "--fs",
    "gain_db": "--path-error-db",
    "identify_s": "--identify",
    "latency": "--latency",
    "level_db": "--calibrator-db",
    "listen_s": "--listen",
    "memory_s": "--memory",
    "n_taps": "--taps",
    "names": "--algorithm",
    "noise_watt": "--loudspeaker-watt",
    "new_fs": "--fs",
    "pascal_per_unit": "--pascal-per-unit",
    "phase_deg": "--path-error-deg",
    "peak_volts": "--peak-volts",
    "primary": "--primary",
    "primary_path": "--primary",
    "programme_watt": "--programme-watt",
    "rated_power": "--rated-power",
    "secondary": "--secondary",
    "secondary_path": "--secondary",
    "seconds": "--seconds",
    "variable": "--variable",
    "volts_per_unit": "--volts-per-unit",
    "want_db": "--want-db",
    "x_max_mm": "--x-max-mm",
}
_NAMES = "|".join(OPTIONS)
_ALONE = re.compile(rf"^({_NAMES})(?=\[| must | is )|(?<![\w./\\-])(\w+_\w+)(?![\w=/\\]|\.\w)")
_WITH_A_VALUE = re.compile(rf"(?<![\w./\\-])({_NAMES})=")


def in_options(message: str, options: argparse.Namespace) -> str:
    """Return a message of the package with options of the command in place of the arguments that it names.

    An argument stands at the start of a message, has a value, or is no word: "fs must be ...", "fs=16000", "n_taps".
    """

    def option(name: str, end: str) -> str:
        known = OPTIONS.get(name, "")
        return f"{known}{end}" if hasattr(options, known.lstrip("-").replace("-", "_")) else ""

    message = _ALONE.sub(lambda found: option(found[0], "") or found[0], message)
    return _WITH_A_VALUE.sub(lambda found: option(found[1], " ") or found[0], message)


def warn(options: argparse.Namespace, message: str, kind: str = "warning") -> None:
    """Print a warning or a note of one line to the standard error."""
    print(f"{options.prog}: {kind}: {message}", file=sys.stderr)


def _read(path: Any, *, fs: float | None, variable: str | None, is_path: bool) -> Recording:
    """Read a recording or an impulse response: the one place that knows how."""
    from .paths import read_path
    from .signals import read_recording

    return (read_path if is_path else read_recording)(path, fs=fs, variable=variable)


class Files:
    """Reader of the files of a command, which must agree on their sample rate."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.fs: float | None = options.fs
        self.remarks: list[str] = []  # what resampling hides of the recordings that were read
        self._first = ""

    def recording(self, path: str) -> np.ndarray:
        """Return the samples of a recording, one channel."""
        return self._one(path, is_path=False)

    def path(self, path: str) -> np.ndarray:
        """Return the taps of a path."""
        return self._one(path, is_path=True)

    def channels(self, path: str) -> np.ndarray:
        """Return all channels of a recording, (n_channels, n_samples)."""
        return np.atleast_2d(self._read(path, is_path=False).samples)

    def noise_paths(
        self, paths: Sequence[str], option: str, noise: np.ndarray, n_microphones: int | None
    ) -> np.ndarray:
        """Return a matrix of paths that are to go with a noise: shorter than it, and not silent."""
        matrix = self.matrix(paths, option, n_microphones)
        names, heard = ", ".join(paths), self.options.noise
        require_shorter(names, matrix.shape[-1], heard, noise.shape[-1], self.fs or 0.0)
        require_sound(names, matrix)
        return matrix

    def matrix(self, paths: Sequence[str], option: str, n_microphones: int | None = None) -> np.ndarray:
        """Return the taps of paths, (microphones, sources, taps); see the examples of `verdict` for their order."""
        each = [self._read(path, is_path=True).samples for path in paths]
        if any(one.ndim == 3 for one in each):
            if len(each) > 1:
                raise ValueError(f"{option} holds a matrix of paths: leave out the other files")
            return each[0]
        rows = [row for one in each for row in np.atleast_2d(one)]
        count = len(np.atleast_2d(each[0])) if n_microphones is None else as_count(n_microphones, "--microphones")
        if len(rows) % count:
            raise ValueError(
                f"{option} must give a path to each of the {count} microphone(s) from every source, got {len(rows)} in all: "
                "choose one channel with --channel, or see the order of several with --help"
            )
        longest = max(row.size for row in rows)
        padded = np.array([np.pad(row, (0, longest - row.size)) for row in rows])
        return padded.reshape(-1, count, longest).swapaxes(0, 1)

    def _one(self, path: str, *, is_path: bool) -> np.ndarray:
        read = self._read(path, is_path=is_path)
        if read.samples.size != read.samples.shape[-1]:
            raise ValueError(
                f"{path} has {len(read.samples)} channels where one is needed: choose with --channel 0 to --channel "
                f"{len(read.samples) - 1}"
            )
        return read.one_channel()

    def _read(self, path: str, *, is_path: bool) -> Recording:
        """Read a file, whose rate must be that of the files before it."""
        with _file(path) as source:
            read = self._chosen(path, self._as_stored(source, self.options.fs, is_path))
            if not is_path and read.file_fs not in (None, read.fs):  # resampling hides that samples are equal
                stored = self._chosen(path, self._as_stored(source, None, is_path))
                self.remarks += clipping_remarks(stored.samples, path)
        if is_path and read.samples.shape[-1] > LONG_PATH_S * read.fs:
            seconds = read.samples.shape[-1] / read.fs
            warn(self.options, f"{path} lasts {seconds:.3g} s, too long for an impulse response: is it a recording?")
        if self.fs is not None and read.fs != self.fs:
            raise ValueError(
                f"{path} is sampled at {read.fs:g} Hz, {self._first} at {self.fs:g} Hz: resample both to one rate, for "
                "example with --fs 16000"
            )
        self.fs, self._first = read.fs, self._first or path
        return read

    def _as_stored(self, source: str, fs: float | None, is_path: bool) -> Recording:
        return _read(source, fs=fs, variable=self.options.variable, is_path=is_path)

    def _chosen(self, path: str, read: Recording) -> Recording:
        """Return the channel that the options choose; a file with one channel stays as it is."""
        if self.options.channel is None or read.samples.ndim == 1:
            return read
        return replace(read, samples=read.samples[as_channel(self.options.channel, read.samples, path)])


@contextmanager
def _file(path: str) -> Iterator[str]:
    """Give the name of a file, for "-" of a copy of the standard input."""
    if path != STANDARD_INPUT:
        yield path
        return
    content = sys.stdin.buffer.read()
    if not content:
        raise ValueError("standard input is empty: pipe a file into the command")
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "standard-input"
        copy.write_bytes(content)
        yield str(copy)


OF_THE_RATING = (
    "watt",
    "ohm",
    "peak_volts",
    "volts_per_unit",
    "rated_power",
    "impedance",
    "loudspeaker_watt",
    "programme_watt",
    "x_max_mm",
    "displacement",
)


def ratings_of(options: argparse.Namespace, n_loudspeakers: int) -> list[Any]:
    """Return the ratings that the options state: of one loudspeaker, or a list for each of several."""
    for name in OF_THE_RATING:
        given = getattr(options, name)
        if given is not None and len(given) not in (1, n_loudspeakers):
            raise ValueError(
                f"{_option(name)} must be given once, or once for each of the {n_loudspeakers} loudspeaker(s), "
                f"got {len(given)}"
            )
    each = []
    for j in range(n_loudspeakers):
        own = argparse.Namespace(rating=options.rating)
        for name in OF_THE_RATING:
            given = getattr(options, name)
            setattr(own, name, None if given is None else given[j if len(given) > 1 else 0])
        each.append(_rating(own))
    return each[0] if n_loudspeakers == 1 else each


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _rating(options: argparse.Namespace) -> list[Any]:
    """Return the ratings of one loudspeaker."""
    from .power import AmplifierRating, LoudspeakerRating

    for name in OF_THE_RATING:
        value = getattr(options, name)
        if isinstance(value, float):  # also where no rating uses it
            as_positive(value, _option(name))
    if options.loudspeaker_watt is not None and options.programme_watt is not None:
        raise ValueError("--programme-watt stands in place of --loudspeaker-watt: leave out one of them")
    ratings: list[Any] = []
    volts = 1.0 if options.volts_per_unit is None else options.volts_per_unit
    if options.watt is not None or options.peak_volts is not None:
        if options.ohm is None:
            raise ValueError("--watt and --peak-volts need --ohm, the resistance they were measured with")
        if options.rated_power is not None:
            raise ValueError("--rated-power stands in place of --watt and --peak-volts: leave out one of them")
        watts = {f"{options.rating}_watt": options.watt}
        ratings.append(AmplifierRating(options.ohm, peak_volts=options.peak_volts, volts_per_unit=volts, **watts))
    elif options.rated_power is not None:
        ratings.append(options.rated_power)
    if (options.loudspeaker_watt, options.programme_watt, options.x_max_mm) != (None, None, None):
        if options.ohm is None and options.impedance is None:
            raise ValueError("a loudspeaker's rating needs --ohm, its nominal impedance, or --impedance, its curve")
        ratings.append(
            LoudspeakerRating(
                options.ohm if options.impedance is None else _curve(options.impedance),
                noise_watt=options.loudspeaker_watt,
                programme_watt=options.programme_watt,
                x_max_mm=options.x_max_mm,
                displacement_mm_per_volt=None if options.displacement is None else _curve(options.displacement),
                volts_per_unit=volts,
            )
        )
    if not ratings:
        raise ValueError("a rating is needed: --watt 20 --ohm 8, or --rated-power 1.6")
    return ratings


def _curve(path: str) -> Any:
    """Return two columns of a CSV file."""
    try:
        columns = np.loadtxt(path, delimiter=",", ndmin=2)
    except ValueError as error:
        raise ValueError(f"{path} must hold two numbers in a line with a comma between them: {error}") from error
    if columns.shape[1] != 2:
        raise ValueError(f"{path} must hold two columns, Hz and a value, got {columns.shape[1]}")
    return columns[:, 0], columns[:, 1]


def uncertainty_of(options: argparse.Namespace, files: Files, secondary: np.ndarray) -> Any:
    """Return how far the secondary path may be wrong: by the other measurements, or by the tolerances."""
    from .paths import PathTolerance

    tolerances = (options.path_error_samples, options.path_error_deg, options.path_error_db)
    if options.secondary_again:
        if tolerances != (None, 0.0, 0.0):
            raise ValueError("--secondary-again stands in place of --path-error-...: leave out one of them")
        K, J, _ = secondary.shape
        others = files.matrix(options.secondary_again, "--secondary-again", K)  # (K, M J, taps)
        if others.shape[0] != K or others.shape[1] % J:
            raise ValueError(
                f"--secondary-again must give paths from {J} loudspeakers to {K} microphones, once or several times"
            )
        longest = max(secondary.shape[2], others.shape[2])
        every = [np.pad(one, ((0, 0), (0, 0), (0, longest - one.shape[2]))) for one in (secondary, others)]
        return np.concatenate(every, axis=1).reshape(K, -1, J, longest).swapaxes(0, 1)
    samples = 1.0 if options.path_error_samples is None else options.path_error_samples
    return PathTolerance(samples, options.path_error_deg, options.path_error_db)


def scene_of(options: argparse.Namespace, files: Files) -> tuple[Any, Any, Any, Any]:
    """Return noise, primary path, secondary path and disturbance."""
    if options.primary is None and options.disturbance is None:
        raise ValueError("--primary or --disturbance is needed: what arrives at the error microphone?")
    noise = files.channels(options.noise)
    primary = None
    if options.primary is not None:
        primary = files.noise_paths(options.primary, "--primary", noise, options.microphones)
    secondary = files.noise_paths(options.secondary, "--secondary", noise, options.microphones)
    if primary is not None and primary.shape[:2] != (len(secondary), len(noise)):
        raise ValueError(
            f"--primary must give a path from each of the {len(noise)} channel(s) of {options.noise} to each of the "
            f"{len(secondary)} microphone(s), got {primary.shape[1]} to {primary.shape[0]}: choose with --channel 0 to "
            f"--channel {max(len(noise), 2) - 1}, or see the order of several with --help"
        )
    disturbance = None if options.disturbance is None else files.channels(options.disturbance)
    if disturbance is not None:
        require_same_length(options.disturbance, disturbance.shape[-1], options.noise, noise.shape[-1])
    return noise, primary, secondary, disturbance


def pascal_per_unit_of(options: argparse.Namespace) -> Any:
    """Return the calibration of the error microphones, if the options give one."""
    if options.calibrator is None:
        return _one_or_all(options.pascal_per_unit)
    if options.pascal_per_unit is not None:
        raise ValueError("--calibrator stands in place of --pascal-per-unit: leave out one of them")
    from .signals import calibration_factor

    level = options.calibrator_db
    return _one_or_all([calibration_factor(one, level, channel=options.channel) for one in options.calibrator])


def _one_or_all(values: list[float] | None) -> Any:
    return values[0] if values is not None and len(values) == 1 else values
