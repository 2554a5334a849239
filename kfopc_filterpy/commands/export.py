"""`kfopc export`: a controller as C99, or as an FMU, from a settings file or from what Python saved."""

from __future__ import annotations

import argparse
import inspect
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .._validate import as_choice
from .._writing import made_folder
from .inputs import Files
from .options import DONE, Parser, add_command, add_reading

EXAMPLES = """examples:
  kfopc export controller.toml -o firmware --dtype float32
  kfopc export trained.npz -o firmware --name left
  kfopc export controller.toml -o simulation --fmu

controller.toml, where every other key is a keyword argument of the algorithm in Python:
  algorithm = "KF-OPC"         # a name of the table in docs/algorithms.md
  n_taps = 64
  secondary = "S.wav"          # or taps, or a list of files, one for each loudspeaker
  fs = 16000                   # resample the path to this rate (default: the rate of the file)
  rated_power = 0.5
  state_noise = 1e-9
  measurement_noise = 1e-3
  [limiter]                    # OutputLimiter; [[limiter]] once for each of several loudspeakers
  rated_power = 0.5
  # likewise [constraint], [secondary_path_uncertainty] (PathTolerance) and [amplifier] (limit, sharpness)
trained.npz is what controller.save wrote: the export goes on from its state"""


def add_to(commands: argparse._SubParsersAction[Parser]) -> None:
    """Add the subcommand."""
    parser = add_command(commands, "export", export, "write a controller as C99 for a microcontroller", EXAMPLES)
    parser.add_argument("controller", help="settings file, *.toml, or a controller that Python saved")
    parser.add_argument("-o", "--output", metavar="FOLDER", required=True, help="folder for the files")
    parser.add_argument("--name", default="anc", help="prefix of all names in C, and name of the files (default: anc)")
    about = "precision of the arithmetic (default: float64)"
    parser.add_argument("--dtype", choices=("float64", "float32"), default="float64", help=about)
    about = "write an FMU (FMI 3.0, co-simulation) in place of the C files, with binaries for Linux and Windows"
    parser.add_argument("--fmu", action="store_true", help=about)
    add_reading(parser, "sample rate, in place of the settings file's")


def export(options: argparse.Namespace) -> int:
    """Write the files and print where they are."""
    from ..checkpoint import Checkpointed
    from ..export import export_c, export_fmu
    from ..signals.recordings import AUDIO_FILES

    path, fs = Path(options.controller), options.fs
    if path.suffix == ".toml":
        controller, fs = described(path, options)
    elif path.suffix.lower() in AUDIO_FILES:
        raise ValueError(
            f"{path} is a sound file: give a settings file, *.toml, that names it as its secondary path, or a controller "
            "that Python saved"
        )
    else:
        controller = Checkpointed.load(path)
    folder = Path(options.output)
    if not options.fmu:
        made = export_c(controller, folder, name=options.name, dtype=options.dtype)
        print(
            f"{made.path} and {made.header_path.name}: {made.algorithm}, {made.n_taps} taps, {made.dtype}, state of "
            f"{made.n_bytes:,} bytes"
        )
        return DONE
    if not fs:
        raise ValueError("an FMU needs the sample rate: give --fs, or fs in the settings file")
    print(export_fmu(controller, made_folder(folder) / f"{options.name}.fmu", fs=fs, dtype=options.dtype))
    return DONE


def described(path: Path, options: argparse.Namespace) -> tuple[Any, float | None]:
    """Return the controller that a settings file describes, and its sample rate, None if nothing states it."""
    from .. import OutputLimiter, OutputPowerConstraint
    from ..controllers.table import CORE
    from ..paths import PathTolerance
    from ..signals.content import require_file

    require_file(path)
    try:
        settings = tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not TOML: {error}") from error
    make = CORE[as_choice(settings.pop("algorithm", None), f"algorithm in {path}", CORE)]
    given_fs = settings.pop("fs", None)
    files = Files(argparse.Namespace(**vars(options) | {"fs": options.fs or given_fs}))
    if "secondary" in settings:
        settings["secondary"] = _paths(settings["secondary"], path.parent, files)
    fs = files.options.fs or files.fs or None
    parts: dict[str, Any] = {
        "limiter": OutputLimiter,
        "constraint": OutputPowerConstraint,
        "secondary_path_uncertainty": PathTolerance,
        "amplifier": _amplifier,
    }
    for key in parts.keys() & settings.keys():
        own, where = settings[key], f"{path}, [{key}]"
        if isinstance(own, dict):
            settings[key] = _made(parts[key], own, fs, where)
        elif isinstance(own, list) and own and isinstance(own[0], dict):
            settings[key] = [_made(parts[key], one, fs, where) for one in own]
    known = inspect.signature(make).parameters
    uncertainty = None if "secondary_path_uncertainty" in known else settings.pop("secondary_path_uncertainty", None)
    controller = _made(make, settings, fs, str(path))
    if uncertainty is not None:
        controller.secondary_path_uncertainty = uncertainty
    return controller, fs


def _paths(given: Any, folder: Path, files: Files) -> Any:
    """Return secondary paths, (taps,) or (K, J, taps): as given, or from files beside the settings file."""
    names = [given] if isinstance(given, str) else given
    if names == []:
        raise ValueError("secondary must be taps or names of files, got an empty list")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return given
    matrix = files.matrix([str(folder / name) for name in names], "secondary")
    return matrix[0, 0] if matrix.shape[:2] == (1, 1) else matrix


def _amplifier(*, limit: float, sharpness: float | None = None) -> Any:
    from .. import HardClipAmplifier, SoftSaturationAmplifier

    return HardClipAmplifier(limit) if sharpness is None else SoftSaturationAmplifier(limit, sharpness)


def _made(make: Callable[..., Any], settings: dict[str, Any], fs: float | None, where: str) -> Any:
    """Return what a function or class makes of settings, and of the sample rate if it takes one."""
    known = inspect.signature(make).parameters
    if unknown := ", ".join(settings.keys() - known.keys()):
        raise ValueError(f"{where}: there is no setting {unknown}, but {', '.join(known)}")
    rate = {"fs": fs} if fs and "fs" in known and "constraint" not in settings else {}  # a constraint has its own
    try:
        return make(**rate | settings)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{where}: {error}") from error
