"""`python -m comparisons sweep`: the command line of `run_sweep`."""

from __future__ import annotations

import argparse
import math
import pkgutil
import re
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from .grid import AXES
from .results import FORMATS
from .run import run_sweep
from .scenario import ScenarioError

INTERRUPTED = 130  # what shells give a command that Ctrl-C ended


def main(arguments: Sequence[str]) -> int:
    """Run the sweep that the command line describes."""
    parser = _parser()
    # argparse takes "-20,-10" for an option, but nothing that begins with a space
    options = parser.parse_args([f" {text}" if re.match(r"-[.\d]", text) else text for text in arguments])
    began = time.perf_counter()
    try:
        sweep = run_sweep(
            _grid(options),
            options.output,
            seeds=_seeds(options.seeds),
            scenario=None if options.scenario is None else pkgutil.resolve_name(options.scenario),
            jobs=options.jobs,
            scheduler=options.scheduler,
            format=options.format,
            quiet=options.quiet,
        )
    except ScenarioError as error:
        print(f"{parser.prog}: {error}\nFinished runs are kept in {options.output}", file=sys.stderr)
        return 1
    except (ValueError, TypeError, OSError, ImportError, AttributeError) as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        print(f"\ninterrupted; the same command goes on from what is kept in {options.output}", file=sys.stderr)
        return INTERRUPTED
    diverged = sum(run["diverged"] for run in sweep.runs)
    print(
        f"{len(sweep.runs)} runs, {diverged} of them diverged, {len(sweep.cells)} cells: {sweep.files[0]} and "
        f"{len(sweep.files) - 1} further files written in {time.perf_counter() - began:.0f} s"
    )
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m comparisons sweep",
        description="Run every combination of a grid with every seed: mean and 95 % interval of each cell.",
        epilog="Values are separated by commas; first:last:count are numbers at equal distances, and first:last:count:log "
        "at equal ratios. An interrupted sweep goes on if the same command is given again.",
    )
    axes = parser.add_argument_group("axes, each with one value or several")
    for name, axis in AXES.items():
        choices = f": {', '.join(axis.choices)}" if axis.choices else ""
        text = f"{axis.label}{choices} (default: {axis.default})"
        axes.add_argument("--" + name.replace("_", "-"), dest=name, metavar="VALUES", help=text)
    parser.add_argument("--seeds", default="8", metavar="N", help="number of seeds, or a list of them (default: 8)")
    own = "your own function of a dict of values and seed that returns figures"
    parser.add_argument("--scenario", metavar="MODULE:FUNCTION", help=own)
    each = "an axis of your own function; once for each"
    parser.add_argument("--axis", action="append", default=[], metavar="NAME=VALUES", help=each)
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--jobs", type=int, metavar="N", help="processes on this machine (default: all cores)")
    place.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler whose workers do it, tcp://host:8786")
    parser.add_argument("--format", choices=FORMATS, default="csv", help="of the tables (default: csv)")
    parser.add_argument(
        "--output", type=Path, default="studies/sweep", help="folder to write into (default: %(default)s)"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser


def _grid(options: argparse.Namespace) -> dict[str, Any]:
    given = {name: text for name in AXES if (text := getattr(options, name)) is not None}
    for text in options.axis:
        name, equals, values = text.partition("=")
        if not equals:
            raise ValueError(f"--axis must be NAME=VALUES, got {text!r}")
        given[name] = values
    return {name: parsed_values(text, name) for name, text in given.items()}


def _seeds(text: str) -> Any:
    values = parsed_values(text, "seeds")
    return values if len(values) > 1 else values[0]


def parsed_values(text: str, name: str) -> list[Any]:
    """Return the values of a list as the command line has it.

    Examples
    --------
    >>> parsed_values("-20:0:3", "rated_power_db"), parsed_values("1e-8:1e-6:3:log", "setting")
    ([-20, -10, 0], [1e-08, 1e-07, 1e-06])
    >>> parsed_values("KF-OPC,KF-PB", "algorithm"), parsed_values("64,128", "n_taps")
    (['KF-OPC', 'KF-PB'], [64, 128])
    """
    return [_value(word) for part in text.split(",") for word in _spaced(part.strip(), name)]


def _value(text: str) -> Any:
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


def _spaced(text: str, name: str) -> list[str]:
    """Return a value as it is, and first:last:count as so many numbers."""
    parts = text.split(":")
    if text and len(parts) == 1:
        return parts
    with suppress(ValueError):
        first, last, count = map(float, parts[:3])
        log = parts[3:] == ["log"] and min(first, last) > 0
        if count >= 2 and math.isfinite(last - first) and (log or not parts[3:]):
            return [f"{number:.12g}" for number in (np.geomspace if log else np.linspace)(first, last, int(count))]
    raise ValueError(
        f"{name} must be values separated by commas, or first:last:count with a count of 2 at least, or "
        f"first:last:count:log with ends above 0, got {text!r}"
    )
