"""`python -m comparisons sweep`: a scenario for every combination of some values and seeds, on all cores or a cluster.

Each run that ends is a line of a file, a JSON object: its values and seed, the code that it ran with, and its figures, or
why it failed. A sweep does the runs that the file does not have yet.
"""

from __future__ import annotations

import argparse
import hashlib
import inspect
import json
import math
import os
import pkgutil
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from scipy.stats import t as student
from tqdm import tqdm

import kfopc_filterpy
from kfopc_filterpy.verdict.items import aligned
from kfopc_filterpy.verdict.runs import one_blas_thread

from .scenario import DEFAULTS, checked_axes, in_the_loop

CONFIDENCE = 0.95
CONNECT_S = 15.0  # time to find a scheduler
INTERRUPTED = 130  # what shells give a command that Ctrl-C ended
OF_THE_RUN = ("seed", "code", "error", "diverged")  # of a row, beside its values and figures

Row = dict[str, Any]
Scenario = Callable[[Row], Mapping[str, Any]]


def run_sweep(
    scenario: Scenario,
    axes: Mapping[str, Any],
    file: str | os.PathLike[str],
    *,
    seeds: int | Sequence[int] = 8,
    jobs: int = -1,
    scheduler: str | None = None,
    quiet: bool = True,
) -> list[Row]:
    """Run a scenario for every combination of values with every seed, and add a row for each to a file.

    Parameters
    ----------
    scenario : callable
        Function of a dict, the value of each axis and `seed`, that returns a dict of figures: numbers, or None where there
        is none. It must be picklable and draw its randomness from the seed. An exception is its row's ``"error"``.
    axes : mapping
        Values of each axis, one or a sequence: numbers, strings, booleans.
    file : path
        Where to write. The runs of this scenario and this state of the code that it has are not run again.
    seeds : int or sequence of int, default 8
        Number of seeds, which are then 1, 2, ..., or the seeds.
    jobs : int, default -1
        Processes on this machine; -1: all cores. Results are the same to the last bit for any number.
    scheduler : str, optional
        Address of a Dask scheduler, such as ``"tcp://host:8786"``, whose workers do the runs instead.
    quiet : bool, default True
        No progress bar.

    Returns
    -------
    list of dict
        Rows, the seed changing fastest, then the last axis.

    Raises
    ------
    ValueError, OSError, ModuleNotFoundError
        Axes or seeds that are not as described, no scheduler that answers, Dask that is not installed.

    Examples
    --------
    >>> import tempfile
    >>> from comparisons.sweep.study import run_sweep
    >>> def square(values):
    ...     return {"square": values["side"] ** 2 + values["seed"]}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     rows = run_sweep(square, {"side": [1.0, 3.0]}, f"{folder}/rows.jsonl", seeds=2, jobs=1)
    >>> [(row["side"], row["seed"], row["square"]) for row in rows]
    [(1.0, 1, 2.0), (1.0, 2, 3.0), (3.0, 1, 10.0), (3.0, 2, 11.0)]
    """
    values = {name: [given] if np.ndim(given) == 0 else list(given) for name, given in axes.items()}
    values["seed"] = list(range(1, seeds + 1) if isinstance(seeds, int) else seeds)
    for name, own in values.items():
        if not own or len(set(own)) < len(own) or (name == "seed" and "seed" in axes):
            raise ValueError(f"{name} must have at least one value, none twice, and no axis be called seed, got {own}")
    code, file = code_of(scenario), Path(file)
    runs = [{**dict(zip(values, one, strict=True)), "code": code} for one in product(*values.values())]
    keys = [json.dumps(run, sort_keys=True) for run in runs]
    kept = {json.dumps({name: row.get(name) for name in runs[0]}, sort_keys=True): row for row in rows_of(file)}
    pending = [run for run, key in zip(runs, keys, strict=True) if key not in kept]
    file.parent.mkdir(parents=True, exist_ok=True)
    with (
        open(file, "ab+") as lines,
        tqdm(total=len(runs), initial=len(runs) - len(pending), unit="run", disable=quiet, dynamic_ncols=True) as bar,
        closing(ended(scenario, pending, jobs, scheduler)) as rows,
    ):
        for row in rows:
            append(lines, row)
            kept[json.dumps({name: row[name] for name in runs[0]}, sort_keys=True)] = row
            bar.update()
    return [kept[key] for key in keys]


def row_of(scenario: Scenario, run: Row) -> Row:
    """Return the row of a run: its figures as numbers, None for those that are not finite; or why it failed."""
    try:
        with one_blas_thread():  # each core has a run, and the sums of several threads differ
            returned = scenario({name: value for name, value in run.items() if name != "code"})
        figures = {name: value if isinstance(value, bool) else _number(value) for name, value in returned.items()}
        if clash := figures.keys() & run.keys():
            raise ValueError(f"the figure {min(clash)!r} has the name of an axis, the seed or the code: rename it")
    except Exception as error:  # noqa: BLE001 - the others go on
        return run | {"error": f"{type(error).__name__}: {error}"}
    return run | figures


def _number(value: Any) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def code_of(scenario: Scenario) -> str:
    """Return a hash of what figures rest on: the package, the studies' scenes, and the file of the scenario."""
    package, here = Path(kfopc_filterpy.__file__).parent, Path(__file__).parent
    sources = [file for file in package.rglob("*") if file.suffix in (".py", ".c", ".h")]
    sources += [*(here.parent / "bench").glob("*.py"), here.parent / "studies" / "cases.py", here / "scenario.py"]
    digest = hashlib.sha256(getattr(scenario, "__qualname__", type(scenario).__qualname__).encode())
    with suppress(OSError, TypeError):  # typed at a prompt, or an object: it goes by its name
        sources.append(Path(inspect.getsourcefile(scenario) or ""))
    for file in sorted(set(sources)):
        with suppress(OSError):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def ended(
    scenario: Scenario, pending: Sequence[Row], jobs: int = -1, scheduler: str | None = None
) -> Generator[Row, None, None]:
    """Yield the row of each run as it ends; closing the iterator stops the others."""
    if scheduler is None:
        parallel = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")
        try:
            yield from parallel(joblib.delayed(row_of)(scenario, run) for run in pending)
        except BrokenProcessPool as error:
            raise OSError(f"a process was killed, perhaps for want of memory (take fewer jobs): {error}") from error
        return
    try:
        from distributed import Client, as_completed
    except ModuleNotFoundError as error:
        said = "a scheduler needs Dask: python -m pip install -c constraints.txt distributed"
        raise ModuleNotFoundError(said) from error
    try:
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OSError(f"no Dask scheduler answers at {scheduler}: {error}") from error
    with client:  # joblib's Dask backend would wait for ever for a run of which its workers died
        futures = client.map(partial(row_of, scenario), pending, pure=False)
        of_future = dict(zip(futures, pending, strict=True))
        for future in as_completed(futures, loop=client.loop):
            died = future.exception()
            yield of_future[future] | {"error": f"{type(died).__name__}: {died}"} if died else future.result()


# ---- The file


def rows_of(file: Path) -> list[Row]:
    """Return the rows of a file; a line that was cut off lacks a brace, and is none."""
    rows = []
    for line in file.read_bytes().splitlines() if file.exists() else ():
        with suppress(ValueError):
            rows.append(dict(json.loads(line)))
    return rows


def append(lines: Any, row: Row) -> None:
    """Add a row to an open file, on disk when this returns; below a line that was cut off."""
    line = json.dumps(row, ensure_ascii=False, allow_nan=False).encode() + b"\n"
    if lines.seek(0, os.SEEK_END):
        lines.seek(-1, os.SEEK_END)
        line = line if lines.read(1) == b"\n" else b"\n" + line
    lines.write(line)
    lines.flush()
    os.fsync(lines.fileno())


# ---- Means


def means(rows: Sequence[Row], axes: Sequence[str]) -> list[Row]:
    """Return a row for each combination of values: runs, how many diverged or failed, and each figure's mean.

    A mean is over the runs that have the figure, with half of its 95 % interval (a t-interval; None for a single run).

    Examples
    --------
    >>> (cell,) = means([{"a": 1, "power": value} for value in (1.0, 2.0, 3.0)], ["a"])
    >>> mean, half = cell["power"]
    >>> print(cell["runs"], mean, round(half, 3))  # 4.303 / sqrt(3)
    3 2.0 2.484
    """
    figures = dict.fromkeys(name for row in rows for name in row if name not in (*axes, *OF_THE_RUN))
    cells: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        cells.setdefault(tuple(row[name] for name in axes), []).append(row)
    return [
        {
            **dict(zip(axes, key, strict=True)),
            "runs": len(own),
            "diverged": sum(bool(row.get("diverged")) for row in own),
            "failed": sum("error" in row for row in own),
            **{name: _mean([row[name] for row in own if row.get(name) is not None]) for name in figures},
        }
        for key, own in cells.items()
    ]


def _mean(values: Sequence[float]) -> tuple[float, float | None] | None:
    if len(values) < 2:
        return (values[0], None) if values else None
    half = student.ppf(0.5 + CONFIDENCE / 2, len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values))
    return float(np.mean(values)), float(half)


def table(cells: Sequence[Row]) -> str:
    """Return means for the terminal; columns in which all cells agree on one value are left out if there are several."""
    names = [name for name in cells[0] if len(cells) == 1 or len({json.dumps(cell[name]) for cell in cells}) > 1]
    return "\n".join(aligned([names, *([_shown(cell[name]) for name in names] for cell in cells)], left=set()))


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return f"{value[0]:.4g}" if value[1] is None else f"{value[0]:.4g} ± {value[1]:.2g}"
    return "-" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


# ---- The command


def main(arguments: Sequence[str]) -> int:
    """Run the sweep that the command line describes, and print the means."""
    parser = argparse.ArgumentParser(
        prog="python -m comparisons sweep",
        description="Run a scenario for every combination of values with every seed, and print means and 95 %% intervals.",
        epilog=f"Values are separated by commas. Axes of the built-in scenario, and their defaults: {DEFAULTS}. "
        "After an interruption, the same command goes on.",
    )
    parser.add_argument("axes", nargs="*", metavar="AXIS=VALUES")
    parser.add_argument("--seeds", default="8", metavar="N", help="number of seeds, or a list of them (default: 8)")
    own = "your own function of a dict of values and seed that returns a dict of figures"
    parser.add_argument("--scenario", metavar="MODULE:FUNCTION", help=own)
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--jobs", type=int, default=-1, metavar="N", help="processes (default: -1, all cores)")
    place.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler whose workers do it, tcp://host:8786")
    parser.add_argument(
        "--output", type=Path, default="studies/sweep.jsonl", help="file of rows (default: %(default)s)"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    options = parser.parse_intermixed_args(arguments)
    try:
        axes = {name: parsed(text) for name, _, text in (given.partition("=") for given in options.axes)}
        seeds = parsed(options.seeds)
        scenario = in_the_loop if options.scenario is None else pkgutil.resolve_name(options.scenario)
        rows = run_sweep(
            scenario,
            axes if options.scenario else checked_axes(axes),
            options.output,
            seeds=seeds[0] if len(seeds) == 1 else seeds,
            jobs=options.jobs,
            scheduler=options.scheduler,
            quiet=options.quiet,
        )
    except (ValueError, TypeError, OSError, ImportError, AttributeError) as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        print(f"\ninterrupted; the same command goes on from {options.output}", file=sys.stderr)
        return INTERRUPTED
    print(table(means(rows, list(axes))))
    print(f"\n{len(rows)} rows in {options.output}")
    failed = [row for row in rows if "error" in row]
    for row in failed[:3]:
        print(f"failed: {', '.join(f'{n}={row[n]}' for n in (*axes, 'seed'))}: {row['error']}", file=sys.stderr)
    return 1 if failed else 0


def parsed(text: str) -> list[Any]:
    """Return the values of a list as the command line has it.

    Examples
    --------
    >>> parsed("-20,0.5,KF-OPC")
    [-20, 0.5, 'KF-OPC']
    """
    return [_value(part) for part in text.split(",") if part]


def _value(text: str) -> Any:
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text
