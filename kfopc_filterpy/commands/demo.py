"""`kfopc demo`: files on which the other commands can be tried."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

import numpy as np

from .._writing import made_folder, write_whole
from .options import DONE, Parser, add_command
from .printing import program

FS, SECONDS = 16000, 20.0
MICROPHONE_NOISE = 0.005  # rms, beside a noise of 2 Pa rms
PASCAL_PER_VOLT = 0.14  # of the loudspeaker in the duct
VOLTS_PER_UNIT, WATT, OHM = 10.0, 50.0, 8.0
RATED_POWER = WATT * OHM / VOLTS_PER_UNIT**2
SETTINGS = f"""algorithm = "KF-OPC"
n_taps = 128
secondary = "S.wav"
rated_power = {RATED_POWER:g}
state_noise = 3.5e-9
measurement_noise = 0.6
[limiter]
rated_power = {RATED_POWER:g}
"""
EXAMPLES = """example:
  kfopc demo demo"""


def add_to(commands: argparse._SubParsersAction[Parser]) -> None:
    """Add the subcommand."""
    parser = add_command(commands, "demo", demo, "write files on which the other commands can be tried", EXAMPLES)
    about = "folder for noise.wav, d.wav, P.wav, S.wav, controller.toml and trained.npz"
    parser.add_argument("folder", type=Path, help=about)


def demo(options: argparse.Namespace) -> int:
    """Write a reference, a disturbance, both paths and a controller: a compressor at 100 dB SPL in a duct."""
    from .. import Plant, simulate
    from ..paths import duct_plant
    from ..signals import compressor_noise, write_wav
    from .export import described

    duct, rng = duct_plant(fs=FS), np.random.default_rng(7)
    # In Pa; the noise of the flow falls by 6 dB per octave up to fs/2.
    sound = compressor_noise(SECONDS, fs=FS, rng=7, power=2.0**2, bandwidth_hz=FS / 2)
    primary, secondary = duct.primary[0, 0], duct.secondary[0, 0]  # type: ignore[index]
    signals = {
        "noise": sound + MICROPHONE_NOISE * rng.standard_normal(sound.size),
        "d": np.convolve(sound, primary)[: sound.size] + MICROPHONE_NOISE * rng.standard_normal(sound.size),
        "P": primary,
        "S": VOLTS_PER_UNIT * PASCAL_PER_VOLT * secondary,
    }
    files = {options.folder / f"{name}.wav": signal for name, signal in signals.items()}
    settings, trained = options.folder / "controller.toml", options.folder / "trained.npz"
    if there := [str(path) for path in (*files, settings, trained) if path.exists()]:
        raise FileExistsError(f"{', '.join(there)} would be overwritten: choose another folder")
    made_folder(options.folder)
    for path, signal in files.items():
        write_wav(path, signal, FS)
    write_whole(settings, SETTINGS)
    as_stated = argparse.Namespace(fs=None, file_fs=None)
    controller, _ = described(settings, as_stated)
    learned = slice(0, int(5 * FS))
    simulate(controller, signals["noise"][learned], Plant(signals["S"], fs=FS), disturbance=signals["d"][learned])
    controller.save(trained)
    noise, d, primary_path, secondary_path = (shlex.quote(str(path)) for path in files)
    recorded = f"{noise} --disturbance {d} --secondary {secondary_path}"
    folder, kfopc = options.folder, program()
    print(f"noise.wav, d.wav, P.wav, S.wav, controller.toml and trained.npz written into {folder}. For example:")
    for command in (
        f"verdict {recorded} --watt {WATT:g} --ohm {OHM:g} --volts-per-unit {VOLTS_PER_UNIT:g} -o "
        + shlex.quote(str(folder / "out")),
        f"run {noise} --primary {primary_path} --secondary {secondary_path} --rated-power {RATED_POWER:g} --block 16",
        f"export {shlex.quote(str(trained))} -o {shlex.quote(str(folder / 'firmware'))} --dtype float32",
    ):
        print(f"{kfopc} {command}")
    return DONE
