"""`kfopc demo`: files on which the other commands can be tried."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from .._writing import made_folder
from .options import DONE, Parser, add_command

FS, SECONDS = 16000, 10.0
MICROPHONE_NOISE = 0.005  # rms, beside a noise of 2 Pa rms
PASCAL_PER_VOLT = 0.14  # of the loudspeaker in the duct
VOLTS_PER_UNIT = 10.0
EXAMPLES = """example:
  kfopc demo demo"""


def add_to(commands: argparse._SubParsersAction[Parser]) -> None:
    """Add the subcommand."""
    parser = add_command(commands, "demo", demo, "write files on which the other commands can be tried", EXAMPLES)
    parser.add_argument("folder", type=Path, help="folder for noise.wav, d.wav, P.wav and S.wav")


def demo(options: argparse.Namespace) -> int:
    """Write a reference, a disturbance and both paths: a compressor at 100 dB SPL in a duct."""
    from ..paths import duct_plant
    from ..signals import compressor_noise, write_wav

    duct, rng = duct_plant(fs=FS), np.random.default_rng(7)
    sound = compressor_noise(SECONDS, fs=FS, rng=7, power=2.0**2)  # in Pa
    primary, secondary = duct.primary[0, 0], duct.secondary[0, 0]  # type: ignore[index]
    signals = {
        "noise": sound + MICROPHONE_NOISE * rng.standard_normal(sound.size),
        "d": np.convolve(sound, primary)[: sound.size] + MICROPHONE_NOISE * rng.standard_normal(sound.size),
        "P": primary,
        "S": VOLTS_PER_UNIT * PASCAL_PER_VOLT * secondary,
    }
    files = {options.folder / f"{name}.wav": signal for name, signal in signals.items()}
    if there := [str(path) for path in files if path.exists()]:
        raise FileExistsError(f"{', '.join(there)} would be overwritten: choose another folder")
    made_folder(options.folder)
    for path, signal in files.items():
        write_wav(path, signal, FS)
    noise, d, primary_file, secondary_file = files
    print(f"{noise}, {d}, {primary_file} and {secondary_file} written. For example:")
    print(
        f"kfopc verdict {noise} --primary {primary_file} --secondary {secondary_file} --watt 50 --ohm 8 "
        f"--volts-per-unit {VOLTS_PER_UNIT:g} -o {options.folder / 'out'}"
    )
    return DONE
