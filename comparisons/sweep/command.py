"""`python -m comparisons sweep`: the command line of `run_sweep`."""

from __future__ import annotations

import argparse
import importlib
import math
import re
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .grid import AXES
from .jobs import Scenario
from .run import ScenarioError, Sweep, run_sweep
from .table import FORMATS, Record, figure_names

MOST_LINES = 40  # of the table on the terminal
SHOWN_FIGURES = 4
INTERRUPTED = 130  # what shells give a command that Ctrl-C ended


def main(arguments: Sequence[str]) -> int:
    """Run the sweep that the command line describes."""
    parser = _parser()
    options = parser.parse_args(values_joined(arguments))
    import matplotlib

    matplotlib.use("Agg")
    began = time.perf_counter()
    try:
        scenario = (
            None if options.scenario is None else loaded_scenario(options.scenario, options.scheduler is not None)
        )
        grid, seeds = _grid(options), _seeds(options.seeds)
        sweep = run_sweep(
            grid,
            options.output,
            seeds=seeds,
            scenario=scenario,
            jobs=options.jobs,
            scheduler=options.scheduler,
            format=options.format,
            x=options.x,
            figures=options.figures.split(",") if options.figures else None,
            quiet=options.quiet,
        )
    except ScenarioError as error:
        print(f"{parser.prog}: {error}\nFinished runs are kept in {options.output}", file=sys.stderr)
        return 1
    except (ValueError, TypeError, OSError, ImportError) as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        print(f"\ninterrupted; the same command goes on from what is kept in {options.output}", file=sys.stderr)
        return INTERRUPTED
    print(cells_table(sweep))
    diverged = f", {sweep.diverged} of them diverged" if sweep.diverged else ""
    print(
        f"\n{len(sweep.runs)} runs{diverged}, {len(sweep.cells)} cells: {sweep.files[0]} and {len(sweep.files) - 1} further "
        f"files written in {time.perf_counter() - began:.0f} s"
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
    for axis in AXES.values():
        axes.add_argument(
            axis.option,
            dest=axis.name,
            metavar="VALUES",
            help=f"{axis.help} (default: {axis.default})".replace("%", "%%"),
        )
    parser.add_argument("--seeds", default="8", metavar="N", help="number of seeds, or a list of them (default: 8)")
    parser.add_argument(
        "--scenario",
        metavar="MODULE:FUNCTION",
        help="your own function of a dict of values and seed that returns figures",
    )
    parser.add_argument(
        "--axis", action="append", default=[], metavar="NAME=VALUES", help="an axis of your own function; once for each"
    )
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--jobs", type=int, metavar="N", help="processes on this machine (default: all cores)")
    place.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler whose workers do it, tcp://host:8786")
    parser.add_argument("--format", choices=FORMATS, default="csv", help="of the tables (default: csv)")
    parser.add_argument(
        "--x", metavar="AXIS", help="axis the figures are drawn against (default: that of most numbers)"
    )
    parser.add_argument("--figures", metavar="NAMES", help="figures of merit that are drawn")
    parser.add_argument(
        "--output", type=Path, default=Path("studies/sweep"), help="folder to write into (default: studies/sweep)"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser


def values_joined(arguments: Sequence[str]) -> list[str]:
    """Return arguments with ``--option -20,-10`` as ``--option=-20,-10``: argparse would take the list for an option."""
    joined: list[str] = []
    for argument in arguments:
        negative = re.match(r"-[.\d]", argument) is not None
        if negative and joined and joined[-1].startswith("--") and "=" not in joined[-1]:
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def _grid(options: argparse.Namespace) -> dict[str, Any]:
    given = {name: text for name in AXES if (text := getattr(options, name)) is not None}
    if options.scenario is None:
        if options.axis:
            raise ValueError(
                "--axis needs --scenario; the built-in scenario's axes are options of their own, see --help"
            )
        return {name: parsed_values(text, name) for name, text in given.items()}
    if given:
        raise ValueError(f"{AXES[next(iter(given))].option} is of the built-in scenario: name the axis with --axis")
    own: dict[str, Any] = {}
    for text in options.axis:
        name, equals, values = text.partition("=")
        if not equals:
            raise ValueError(f"--axis must be NAME=VALUES, got {text!r}")
        if name in own:
            raise ValueError(f"--axis names {name} twice")
        own[name] = parsed_values(values, name)
    return own


def parsed_values(text: str, name: str) -> list[Any]:
    """Return the values of a list as the command line has it.

    Examples
    --------
    >>> parsed_values("-20:0:3", "rated_power_db"), parsed_values("1e-8:1e-6:3:log", "setting")
    ([-20, -10, 0], [1e-08, 1e-07, 1e-06])
    >>> parsed_values("KF-OPC,KF-PB", "algorithm"), parsed_values("64,128", "n_taps")
    (['KF-OPC', 'KF-PB'], [64, 128])
    """
    values: list[Any] = []
    for part in text.split(","):
        if not part.strip():
            raise ValueError(f"{name} must be values separated by commas, got {text!r}")
        values += _range(part, name) if ":" in part else [_value(part.strip())]
    return values


def _value(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _range(text: str, name: str) -> list[Any]:
    first, last, count, *rest = [*text.split(":"), "", ""]
    try:
        ends, number = (float(first), float(last)), int(count)
    except ValueError:
        number = 0
    spacing = [word for word in rest if word]
    if number < 2 or not all(map(math.isfinite, ends)) or spacing not in ([], ["log"]):
        raise ValueError(
            f"{name} must be first:last:count with a count of 2 at least, or first:last:count:log, got {text!r}"
        )
    if spacing and min(ends) <= 0:
        raise ValueError(f"{name} must have ends above 0 to be spaced logarithmically, got {text!r}")
    spaced = np.geomspace(*ends, number) if spacing else np.linspace(*ends, number)
    values = [float(f"{value:.12g}") for value in spaced]
    whole = not re.search("[.e]", text.casefold().removesuffix("log")) and all(value == int(value) for value in values)
    return [int(value) for value in values] if whole else values


def _seeds(text: str) -> Any:
    values = parsed_values(text, "seeds")
    return values if "," in text or ":" in text else values[0]


def loaded_scenario(text: str, send_source: bool) -> Scenario:
    """Return a function of a module, which may lie in the current folder; with its source for workers that lack it."""
    name, colon, function = text.partition(":")
    if not (name and colon and function):
        raise ValueError(f"--scenario must be MODULE:FUNCTION, got {text!r}")
    if "" not in sys.path and str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    module = importlib.import_module(name)
    found: Callable[..., Any] | None = getattr(module, function, None)
    if found is None:
        raise ValueError(f"module {name} has no function {function}")
    if send_source:
        import cloudpickle

        cloudpickle.register_pickle_by_value(module)
    return found


def cells_table(sweep: Sweep) -> str:
    """Return the cells for a terminal: swept axes, and the mean and half interval of the first figures."""
    names = figure_names(dict(enumerate(sweep.runs)))
    names = [name for name in names if name not in (*sweep.grid.axes, "seed")][:SHOWN_FIGURES]
    axes = sweep.grid.swept or list(sweep.grid.axes)[:1]
    lines = [[*axes, "runs", "diverged", *names]]
    for row in sweep.cells[:MOST_LINES]:
        lines.append(
            [*(_words(row[name]) for name in axes), str(row["runs"]), str(row["diverged"])]
            + [_with_interval(row, name) for name in names]
        )
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    left = len(sweep.cells) - MOST_LINES
    return "\n".join(
        ["  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines]
        + ([f"... and {left} further cells"] if left > 0 else [])
    )


def _words(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _with_interval(row: Record, name: str) -> str:
    mean, high = row[f"{name}_mean"], row[f"{name}_high"]
    if math.isnan(mean):
        return "-"
    return f"{mean:.4g}" if math.isnan(high) else f"{mean:.4g} ± {high - mean:.2g}"
