"""Reading what the options name: files with signals and paths, ratings, tolerances, calibrations."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .options import refuse_unused
from .printing import warn

if TYPE_CHECKING:
    from ..paths.uncertainty import Uncertainty
    from ..plant import Plant
    from ..signals import Recording

LONG_PATH_S = 5.0  # hardly any impulse response is longer
LONGEST_PATH_S, MOST_TAPS = 10.0, 65536  # of an impulse response


class _Named(NamedTuple):
    """What an argument names: a file, and perhaps one of its channels or variables."""

    file: str
    channel: int | None = None
    variable: str | None = None


def _named(argument: str) -> _Named:
    """Return what is named by "x.wav", "x.wav:1", "x.mat:S" or "x.mat:S:1"."""
    parts: dict[str, Any] = {}
    file = argument
    while not Path(file).exists():
        file, colon, part = file.rpartition(":")
        kind = "channel" if part.isdecimal() else "variable"
        if not colon or kind in parts:
            return _Named(argument)  # there is no such file, as its reader will say
        parts[kind] = int(part) if kind == "channel" else part
    return _Named(file, **parts)


class Files:
    """Reader of the files of a command, which must agree on their sample rate."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.read: list[str] = []  # what was read, in words
        self.units: dict[str, str] = {}  # that the files state
        self.remarks: list[str] = []  # on flaws of the recordings that resampling hides
        self._fs = 0.0  # of the files that were read; 0 before the first
        self._first = ""
        self._without_rate = False  # whether a file stated none

    @property
    def fs(self) -> float:
        """Sample rate in Hz of all files, once they were read."""
        if self.options.file_fs is not None and not self._without_rate:
            raise ValueError("--file-fs is for files that state no rate, but all of them do: leave it out, or use --fs")
        return self._fs

    def recording(self, path: str) -> np.ndarray:
        """Return the samples of a recording, one channel."""
        return self._read(path, is_path=False).one_channel()

    def calibrator(self, path: str) -> Recording:
        """Return the recording of a calibrator, at any rate."""
        return self._chosen(path, False, None)

    def channels(self, path: str) -> np.ndarray:
        """Return all channels of a recording, (n_channels, n_samples), none of them silent."""
        from ..paths.file_checks import require_heard

        channels = np.atleast_2d(self._read(path, is_path=False).samples)
        require_heard(path, channels)
        return channels

    def noise_paths(self, paths: Sequence[str], option: str, noise: np.ndarray) -> np.ndarray:
        """Return a matrix of paths for a noise; they must be shorter than it, and not silent."""
        from ..paths.file_checks import require_sound

        matrix = self.matrix(paths, option, self.options.microphones)
        n_taps, n_samples = matrix.shape[-1], noise.shape[-1]
        if n_taps >= n_samples or n_taps > min(LONGEST_PATH_S * self._fs, MOST_TAPS):
            raise ValueError(
                f"{', '.join(paths)} has {n_taps} samples ({n_taps / self._fs:.3g} s), {self.options.noise} {n_samples} "
                f"({n_samples / self._fs:.3g} s): an impulse response must be shorter than the noise, and at most "
                f"{LONGEST_PATH_S:g} s and {MOST_TAPS} taps long; cut the impulse response, or are the files swapped?"
            )
        require_sound(paths[0] if len(paths) == 1 else option, matrix)
        return matrix

    def matrix(self, paths: Sequence[str], option: str, n_microphones: int | None = None) -> np.ndarray:
        """Return the taps of paths, (microphones, sources, taps); see the examples of `verdict` for their order."""
        from .._taps import stacked

        each = [self._read(path, is_path=True).samples for path in paths]
        if any(one.ndim == 3 for one in each):
            if len(each) > 1:
                raise ValueError(f"{option} holds a matrix of paths: leave out the other files")
            return each[0]
        rows = [row for one in each for row in np.atleast_2d(one)]
        count = len(np.atleast_2d(each[0])) if n_microphones is None else n_microphones
        if len(rows) % count:
            raise ValueError(
                f"{option} must give a path to each of the {count} microphone(s) from every source, got {len(rows)} in all: "
                "choose one channel of a file, as in file.wav:0, or see the order of several with kfopc verdict --help"
            )
        return stacked(rows).reshape(len(rows) // count, count, -1).swapaxes(0, 1)

    def _read(self, path: str, *, is_path: bool) -> Recording:
        """Read a file, whose rate must be that of the files before it."""
        from ..signals.quality import clipping_remarks

        read = self._chosen(path, is_path, self.options.fs)
        if not is_path and read.file_fs not in (None, read.fs):  # resampling would hide clipping
            self.remarks += clipping_remarks(self._chosen(path, is_path, None).samples, path)
        if is_path and read.samples.shape[-1] > LONG_PATH_S * read.fs:
            seconds = read.samples.shape[-1] / read.fs
            warn(self.options, f"{path} lasts {seconds:.3g} s, too long for an impulse response: is it a recording?")
        if self._fs and read.fs != self._fs:
            raise ValueError(
                f"{path} is sampled at {read.fs:g} Hz, {self._first} at {self._fs:g} Hz: resample both to one rate, for "
                "example with --fs 16000"
            )
        self._fs, self._first = read.fs, self._first or path
        self.units[path] = read.unit
        rate = "" if read.file_fs in (None, read.fs) else f" resampled from {read.file_fs:g} Hz"
        what = "taps" if is_path else "samples"
        self.read.append(f"{path}, {' x '.join(map(str, read.samples.shape))} {what} at {read.fs:g} Hz{rate}")
        return read

    def _chosen(self, path: str, is_path: bool, fs: float | None) -> Recording:
        """Return the channels of a file that its argument names, at a rate."""
        from ..paths.reading import path_of
        from ..signals.content import LEAST_SURE_RATE
        from ..signals.recordings import read_content, recording_of

        named = _named(path)
        content, file_fs = read_content(named.file, channel=named.channel, variable=named.variable), None
        if content.fs is None or content.fs < LEAST_SURE_RATE:
            file_fs, self._without_rate = self.options.file_fs, True
            if file_fs is None and content.fs is None:
                raise ValueError(
                    f"{path} states no sampling rate: give the rate in Hz at which it was sampled, for example with "
                    "--file-fs 48000 (--fs is the rate to which files are resampled)"
                )
        read = (path_of if is_path else recording_of)(named.file, content, fs, file_fs)
        return replace(read, name=path)


def scene_of(options: argparse.Namespace, files: Files) -> tuple[np.ndarray, Plant, np.ndarray | None]:
    """Return the noise, (I, n_samples), the plant and the disturbance, (K, n_samples), if there is one."""
    from .. import Plant
    from ..paths.file_checks import require_different, require_each_microphone

    if options.secondary is None:
        raise ValueError("--secondary is needed: the impulse response from control signal to error microphone")
    only_errors = options.primary is None and options.disturbance is None
    if only_errors and not getattr(options, "feedback", False):
        name = options.noise
        raise ValueError(
            "--primary or --disturbance is needed: what arrives at the error microphone? If it is a channel of "
            f"{name}, name both, as in {name}:0 --disturbance {name}:1"
        )
    noise, primary, disturbance = files.channels(options.noise), None, None
    if options.primary is not None:
        primary = files.noise_paths(options.primary, "--primary", noise)
    secondary = files.noise_paths(options.secondary, "--secondary", noise)
    if only_errors:
        require_each_microphone(options.noise, noise, len(secondary), "--secondary")
    if primary is not None and primary.shape[:2] != (len(secondary), len(noise)):
        raise ValueError(
            f"--primary must give a path from each of the {len(noise)} channel(s) of {options.noise} to each of the "
            f"{len(secondary)} microphone(s), got {primary.shape[1]} to {primary.shape[0]}: choose a channel, as in "
            f"{options.noise}:0, or see the order of several with kfopc verdict --help"
        )
    if options.disturbance is not None:
        disturbance = files.channels(options.disturbance)
        if disturbance.shape[-1] != noise.shape[-1]:
            raise ValueError(
                f"{options.disturbance} has {disturbance.shape[-1]} samples, {options.noise} {noise.shape[-1]}: they must be "
                "recorded together and be equally long; cut both to the same start and the same end"
            )
        require_different(f"--disturbance {options.disturbance}", disturbance, options.noise, noise)
        require_each_microphone(options.disturbance, disturbance, len(secondary), "--secondary")
    return noise, Plant(secondary, primary, fs=files.fs), disturbance


def take_volts(options: argparse.Namespace, files: Files) -> None:
    """Take the volts that secondary paths state, as in "Pa/V", for those of the control signal."""
    stated = next((path for path in options.secondary if files.units[path].endswith("/V")), None)
    given = options.volts_per_unit
    if stated is None or (given is None and options.rated_power is not None and options.loudspeaker_watt is None):
        return
    if given is not None and set(given) != {1.0}:
        raise ValueError(
            f"{stated} is in {files.units[stated]}, so a control signal of 1 is 1 V, but --volts-per-unit is "
            f"{', '.join(f'{one:g}' for one in given)}: leave it out"
        )
    options.volts_per_unit = [1.0]


def _each(given: list[Any] | None, option: str, count: int, what: str) -> list[Any]:
    """Return `count` values of an option that is given once for all, or once for each."""
    if given is not None and len(given) not in (1, count):
        raise ValueError(
            f"{option} must be given once, or once for each of the {count} {what}(s), got {len(given)}: leave out the others"
        )
    given = given or [None]
    return given * (count if len(given) == 1 else 1)


OF_A_LOUDSPEAKER = ("watt", "ohm", "peak_volts", "volts_per_unit", "rated_power", "loudspeaker_watt")


def ratings_of(options: argparse.Namespace, n_loudspeakers: int) -> list[Any]:
    """Return the ratings that the options state: of one loudspeaker, or a list for each of several."""
    stated = [
        _each(getattr(options, name), f"--{name.replace('_', '-')}", n_loudspeakers, "loudspeaker")
        for name in OF_A_LOUDSPEAKER
    ]
    each = [
        _rating(argparse.Namespace(rating=options.rating, **dict(zip(OF_A_LOUDSPEAKER, own, strict=True))))
        for own in zip(*stated, strict=True)
    ]
    return each[0] if n_loudspeakers == 1 else each


def _rating(own: argparse.Namespace) -> list[Any]:
    """Return the ratings of one loudspeaker."""
    from ..power import AmplifierRating, LoudspeakerRating

    ratings: list[Any] = []
    used = {"rated_power"}
    if own.watt is not None or own.peak_volts is not None:
        if own.ohm is None:
            raise ValueError("--watt and --peak-volts need --ohm, the resistance they were measured with")
        if own.rated_power is not None:
            raise ValueError("--rated-power stands in place of --watt and --peak-volts: leave out one of them")
        watts = {f"{own.rating or 'sine'}_watt": own.watt}
        ratings.append(AmplifierRating(own.ohm, peak_volts=own.peak_volts, volts_per_unit=own.volts_per_unit, **watts))
        used |= {"watt", "peak_volts", "ohm", "volts_per_unit"} | ({"rating"} if own.watt is not None else set())
    elif own.rated_power is not None:
        ratings.append(own.rated_power)
    if own.loudspeaker_watt is not None:
        if own.ohm is None:
            raise ValueError("a loudspeaker's rating needs --ohm, its nominal impedance")
        ratings.append(LoudspeakerRating(own.ohm, noise_watt=own.loudspeaker_watt, volts_per_unit=own.volts_per_unit))
        used |= {"loudspeaker_watt", "ohm", "volts_per_unit"}
    if "volts_per_unit" in used and own.volts_per_unit is None:
        raise ValueError(
            "watts and volts need --volts-per-unit, the volts at the loudspeaker for a control signal of 1: give what the "
            "secondary path was measured with, or --rated-power in place of watts"
        )
    if not ratings:
        volts = " --volts-per-unit 10" if own.volts_per_unit is None else ""
        raise ValueError(f"a rating is needed: --watt 20 --ohm 8{volts}, or --rated-power 1.6")
    refuse_unused(
        own,
        [name for name in vars(own) if name not in used],
        ": --ohm and --volts-per-unit belong to --watt or --loudspeaker-watt, and --rating to --watt; add these, or leave it "
        "out",
    )
    return ratings


def uncertainty_of(options: argparse.Namespace, files: Files, secondary: np.ndarray) -> Uncertainty:
    """Return how far the secondary path may be wrong: from other measurements, from tolerances, or by default."""
    from .._taps import lengthened
    from ..controllers.kf_pb import DEFAULT_UNCERTAINTY
    from ..paths import PathTolerance
    from ..paths.uncertainty import as_gain_error

    tolerances = (options.path_error_samples, options.path_error_deg, options.path_error_db)
    if not options.secondary_again:
        if tolerances == (None, None, None):
            return DEFAULT_UNCERTAINTY
        samples, deg, db = (one or 0.0 for one in tolerances)
        return PathTolerance(samples, deg, as_gain_error(db, "--path-error-db"))
    if tolerances != (None, None, None):
        raise ValueError("--secondary-again stands in place of --path-error-...: leave out one of them")
    K, J, _ = secondary.shape
    others = files.matrix(options.secondary_again, "--secondary-again", K)  # (K, M J, taps)
    if others.shape[0] != K or others.shape[1] % J:
        raise ValueError(
            f"--secondary-again must give paths from {J} loudspeakers to {K} microphones, once or several times"
        )
    longest = max(secondary.shape[2], others.shape[2])
    every = [lengthened(one, longest) for one in (secondary, others)]
    return np.concatenate(every, axis=1).reshape(K, -1, J, longest).swapaxes(0, 1)


def calibration_of(options: argparse.Namespace, files: Files, n_microphones: int) -> ArrayLike | None:
    """Return the pascals per unit of the error microphones, of all or of each; None if the options give none."""
    from ..signals.recordings import calibration_factor

    pascals, option = options.pascal_per_unit, "--pascal-per-unit"
    errors = options.disturbance or options.noise
    stated = {path: files.units[path] for path in (errors, *options.secondary) if path in files.units}
    if options.disturbance is None and options.primary is not None:
        del stated[errors]  # of the reference
    units = {one.partition("/")[0] for unit in stated.values() for one in unit.split(", ")} - {"1"}
    if options.calibrator is not None:
        if pascals is not None:
            raise ValueError("--calibrator stands in place of --pascal-per-unit: leave out one of them")
        option, pascals = "--calibrator", []
        for path in options.calibrator:
            tone = files.calibrator(path)
            if {tone.unit} == units != {"Pa"}:  # volts, like the recordings: the factor is in pascals per volt
                tone = replace(tone, unit="1")
            pascals.append(calibration_factor(tone, options.calibrator_db))
    if len(units) > 1 or (pascals is not None and units == {"Pa"} and set(pascals) != {1.0}):
        is_in = ", ".join(f"{path} is in {unit}" for path, unit in stated.items() if unit != "1")
        scale = "" if pascals is None else f", but {option} gives {', '.join(f'{one:.4g}' for one in pascals)} Pa for 1"
        raise ValueError(f"{is_in}{scale}: the error microphones need one unit")
    if units == {"Pa"}:
        return 1.0
    each = _each(pascals, option, n_microphones, "microphone")
    return each[0] if pascals is None or len(pascals) == 1 else each
