"""`kfopc paths`: identify and inspect impulse responses."""

from __future__ import annotations

import argparse
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from .._writing import jsonable, replacing, require_writable
from .inputs import Files
from .options import DONE, Parser, add_command, add_count, add_reading, sentence
from .printing import warn

WRITTEN = (".wav", ".npy", ".csv", ".txt")
UNRELATED, CHANCE = 0.02, 3.0  # a path must explain this share of a response, and this many times what chance explains
POOR_DB = -20.0  # a warning is printed if more of the response is left unexplained
EXCITED_DB = -40.0  # of the strongest part of an excitation's spectrum: below, a microphone mostly hears other noise
LOWEST_HZ, NARROW = 20.0, 8.0  # an excited band is narrow below three octaves, as from 125 to 1000 Hz
WHOLE = 0.4  # of the sampling rate: from LOWEST_HZ up to there is the whole band, however few octaves it has


def add_to(commands: argparse._SubParsersAction[Parser]) -> None:
    """Add the subcommand, which has actions of its own."""
    about = "identify and inspect impulse responses"
    parser = commands.add_parser("paths", help=about, description=sentence(about))
    actions = parser.add_subparsers(required=True, metavar="ACTION")

    def add(name: str, run: Any, about: str, example: str) -> Any:
        return add_command(actions, name, run, about, f"example:\n  kfopc paths {name} {example}")

    about = "fit an impulse response to a recorded excitation, noise or sweep"
    own = add("identify", identify, about, "sent.wav received.wav --taps 512 -o S.wav")
    own.add_argument(
        "excitation", help="what was sent to the amplifier; FILE:1 is channel 1 of a file, FILE:NAME its variable NAME"
    )
    own.add_argument("response", help="what the microphone heard, recorded at the same time")
    add_count(own, "--taps", required=True, help="length of the impulse response")
    own.add_argument("-o", "--output", metavar="FILE", required=True, help=f"file to write: {', '.join(WRITTEN)}")
    own.add_argument("--json", action="store_true", help="print JSON")
    add_reading(own)
    own = add("inspect", inspect, "describe an impulse response", "S.wav --primary P.wav")
    own.add_argument("path", help="the impulse response")
    about = "impulse response of the primary path, for the causality margin"
    own.add_argument("--primary", metavar="FILE", help=about)
    own.add_argument("--json", action="store_true", help="print JSON")
    add_reading(own)


def identify(options: argparse.Namespace) -> int:
    """Fit an impulse response, write it and print what it leaves unexplained, and in which band it is known."""
    from ..paths import estimate_path
    from ..paths.file_checks import require_different
    from ..paths.timing import plays_once

    _require_output(options.output)
    files = Files(options)
    sent, heard = files.recording(options.excitation), files.recording(options.response)
    require_different(options.response, heard[np.newaxis], options.excitation, sent[np.newaxis])
    shortest = min(sent.size, heard.size)  # a recorder is stopped later than the player
    if options.taps > (shortest + 1) // 2 > 0:
        raise ValueError(
            f"--taps must be at most {(shortest + 1) // 2} for recordings of {shortest} samples, got {options.taps}: "
            "identify a shorter impulse response, or record for longer"
        )
    low_hz, high_hz = _excited_band(sent, files.fs)
    found = estimate_path(sent[:shortest], heard[:shortest], options.taps, files.fs)
    _judge_residual(options, found.residual_db, files.fs, sent[:shortest], heard[:shortest])
    if high_hz < max(NARROW * low_hz, min(NARROW * LOWEST_HZ, WHOLE * files.fs)):
        warn(
            options,
            f"{options.excitation} excites the path from {low_hz:.0f} to {high_hz:.0f} Hz only: elsewhere the impulse response "
            "is a guess, which no residual shows; play noise or a sweep over the whole band of the noise to be controlled, "
            "and an octave beyond",
        )
    if plays_once(sent):
        warn(
            options,
            f"{options.excitation} plays each frequency once, so clocks that differ and lost samples would not show: play "
            "noise, or the sweep twice, unless one interface plays and records",
        )
    units = files.units[options.response], files.units[options.excitation]
    _write_path(options.output, found.taps, files.fs, "" if "1" in units or len(set(units)) == 1 else "/".join(units))
    residual_db = float(found.residual_db)
    facts = {"n_taps": options.taps, "fs": files.fs, "residual_db": residual_db, "output": options.output}
    facts |= {"excited_low_hz": low_hz, "excited_high_hz": high_hz}
    text = (
        f"{options.output}: {options.taps} taps, which explain all but {100 * 10 ** (residual_db / 10):.1g} % of the response "
        f"({residual_db:.1f} dB); excited from {low_hz:.0f} to {high_hz:.0f} Hz"
    )
    print(json.dumps(facts) if options.json else text)
    return DONE


def _excited_band(sent: np.ndarray, fs: float) -> tuple[float, float]:
    """Return the lowest and the highest frequency in Hz at which an excitation has power."""
    from scipy.signal import welch

    frequencies, powers = welch(sent - sent.mean(), fs, nperseg=min(4096, sent.size), detrend=False)
    excited = frequencies[powers >= 10 ** (EXCITED_DB / 10) * powers.max()]
    return float(excited[0]), float(excited[-1])


def _judge_residual(
    options: argparse.Namespace, residual_db: float, fs: float, sent: np.ndarray, heard: np.ndarray
) -> None:
    """Raise ValueError if a fit explains hardly more than chance would, or two clocks show.

    Warn if it explains little.
    """
    from ..paths.timing import delay_of, timing_fault
    from ..signals.quality import clipping_remarks

    if residual_db <= POOR_DB:
        return
    share = 1.0 - 10 ** (residual_db / 10)
    explained = f"explains {100 * max(share, 0.0):.1f} % of {options.response}"
    is_related = share >= max(UNRELATED, CHANCE * options.taps / sent.size)
    if not is_related and (delay := delay_of(sent, heard)) >= options.taps:
        raise ValueError(
            f"{options.response} comes {1e3 * delay / fs:.3g} ms after {options.excitation}, but --taps {options.taps} last "
            f"{1e3 * options.taps / fs:.3g} ms: give --taps {delay + options.taps}, or a shorter latency; nothing was written"
        )
    if fault := timing_fault(sent, heard, fs, (options.excitation, options.response)):
        raise ValueError(f"{options.excitation} {explained}: {fault} Nothing was written")
    if not is_related:
        raise ValueError(
            f"{options.excitation} {explained}, hardly more than chance would: are the files swapped, or of different "
            "recordings? Give what was sent to the amplifier first, then what the microphone heard at the same time; "
            "nothing was written"
        )
    clipped = clipping_remarks(sent, options.excitation) + clipping_remarks(heard, options.response)
    warn(
        options,
        f"{options.excitation} {explained} only: "
        + (
            " ".join(clipped)
            or f"{residual_db:.1f} dB are noise, or come later than {1e3 * options.taps / fs:.3g} ms; play it louder or wait "
            "for silence, or give more --taps"
        ),
    )


def inspect(options: argparse.Namespace) -> int:
    """Print a description of an impulse response."""
    from .. import Plant
    from ..paths import causality_margin
    from ..paths.file_checks import require_sound

    files = Files(options)
    paths, primary = files.matrix([options.path], options.path), None
    if options.primary is not None:
        primary = files.matrix([options.primary], options.primary)
        for name, matrix in ((options.path, paths), (options.primary, primary)):
            require_sound(name, matrix)
        if len(primary) != len(paths):
            raise ValueError(
                f"--primary must lead to the {len(paths)} microphone(s) of {options.path}, got {len(primary)}: give the paths "
                "to each of them"
            )
    fs = files.fs
    several = paths.shape[:2] != (1, 1)
    each = [
        ({"microphone": k + 1, "loudspeaker": j + 1} if several else {}) | _facts(paths[k, j], fs)
        for k, j in np.ndindex(*paths.shape[:2])
    ]
    facts: dict[str, Any] = {"paths": each} if several else each[0]
    if primary is not None:
        facts["causality_margin_s"] = causality_margin(Plant(paths, primary, fs=fs)).margin_s
    if options.json:
        print(json.dumps(jsonable(facts), allow_nan=False))
        return DONE
    for one in each:
        if several:
            print(f"microphone {one['microphone']}, loudspeaker {one['loudspeaker']}:")
        print(_described(one))
    if primary is not None:
        margin = facts["causality_margin_s"]
        late = "early enough" if margin > 0 else "too late for anything but tones"
        print(f"causality margin {1e3 * margin:+.2f} ms: the anti-noise is {late}")
    return DONE


def _facts(taps: np.ndarray, fs: float) -> dict[str, Any]:
    """Return the properties of a path; a silent one has no band and no onset."""
    from ..paths import achieved_band, secondary_path_gain
    from ..paths.analysis import energy_onset

    facts: dict[str, Any] = {"n_taps": taps.size, "fs": fs, "duration_s": taps.size / fs}
    if not np.any(taps):
        return facts | {"power_gain_db": None, "low_hz": None, "high_hz": None, "onset_s": None}
    band = achieved_band(taps, fs=fs)
    return facts | {
        "power_gain_db": 10 * math.log10(max(secondary_path_gain(taps), 1e-30)),
        "low_hz": band.low_hz,
        "high_hz": band.high_hz,
        "onset_s": energy_onset(taps) / fs,
    }


def _described(facts: dict[str, Any]) -> str:
    """Return the properties of a path as two lines of text."""
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


def _require_output(output: str) -> None:
    """Raise ValueError or OSError if a path cannot be written: better before it is made than after."""
    if Path(output).suffix.lower() not in WRITTEN:
        raise ValueError(f"{output} must end in {', '.join(WRITTEN)}")
    if not Path(output).parent.is_dir():
        raise FileNotFoundError(f"the folder {Path(output).parent} does not exist: make it first")
    require_writable(Path(output).parent)


def _write_path(output: str, taps: np.ndarray, fs: float, unit: str) -> None:
    """Write taps in the format that the file's suffix names; text also gets a column of times in s."""
    from ..signals import write_wav

    suffix = Path(output).suffix.lower()
    if suffix == ".wav":
        if fs != round(fs):
            raise ValueError(
                f"{output} must have a rate of whole Hz, as WAV files have, got {fs:g} Hz: take another --fs, or write .csv"
            )
        write_wav(output, taps, fs)
        return
    with replacing(output) as file:
        if suffix == ".npy":
            content = io.BytesIO()  # in a file, numpy would not notice that the disk is full
            np.save(content, taps)
            file.write(content.getbuffer())
        else:
            timed, delimiter = np.column_stack([np.arange(taps.size) / fs, taps]), "," if suffix == ".csv" else "\t"
            heading = f"t (s){delimiter}S ({unit})" if unit else ""
            np.savetxt(file, timed, delimiter=delimiter, fmt="%.17g", header=heading, comments="")
