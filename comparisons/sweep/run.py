"""A grid of scenarios times seeds on all cores or a cluster: mean and 95 % interval of each cell.

`run_sweep` is the function, ``python -m comparisons sweep`` the command (docs/sweep.md).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tqdm import tqdm

from kfopc_filterpy.plot import save_figure

from .grid import built_in_grid, own_grid
from .jobs import Scenario, job_outcomes
from .results import FORMATS, LABELS, Record, cell_rows, figure_names, sweep_figure, swept_axis, write_table
from .store import keep, kept, sweep_folder


@dataclass(frozen=True)
class Sweep:
    """The results of a sweep.

    Attributes
    ----------
    cells : list of dict
        One for each combination: the axes, `runs`, `diverged`, and ``<figure>_mean``, ``_low``, ``_high`` and ``_n``.
    runs : list of dict
        One for each run: the axes, `seed`, the figures, `diverged`.
    files : list of pathlib.Path
        The tables and figures written.
    """

    cells: list[Record]
    runs: list[Record]
    files: list[Path]


def run_sweep(
    grid: Mapping[str, Any],
    folder: str | os.PathLike[str],
    *,
    seeds: int | Sequence[int] = 8,
    scenario: Scenario | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    format: str = "csv",
    quiet: bool = False,
) -> Sweep:
    """Run every combination of a grid with every seed; write tables and figures of means and intervals.

    Finished jobs are kept in the folder: after an interruption the same call goes on from there. Results are the same to
    the last bit for any number of jobs, and on a cluster of machines that compute alike.

    Parameters
    ----------
    grid : mapping
        Values of each axis, one or a sequence. Without `scenario` those of `comparisons.sweep.grid.AXES`
        (``python -m comparisons sweep --help`` lists them), the others having their default; with one, any.
    folder : path
        Where to write: sweep.json and runs.jsonl, which keep the runs; cells and runs as tables; figures/.
    seeds : int or sequence of int, default 8
        Number of seeds, which are then 1, 2, ..., or the seeds.
    scenario : callable, optional
        Function of a dict, the value of each axis and `seed`, that returns a dict of figures, each a number (None or
        NaN if undefined); ``"diverged": True`` counts the run as diverged. It must be picklable and draw its
        randomness from the seed. By default a controller in the loop on a noise.
    jobs : int, optional
        Processes on this machine, all cores by default.
    scheduler : str, optional
        Address of a Dask scheduler, such as ``"tcp://host:8786"``, whose workers do the runs instead. They need the
        package installed, and a clone on their path. The scenario function's module is sent to them.
    format : {"csv", "parquet"}, default "csv"
        Of the tables. Parquet needs the extra `parquet`.
    quiet : bool, default False
        No progress bar.

    Returns
    -------
    Sweep
        The cells: means over the seeds that did not diverge, and their 95 % t-intervals (NaN for one seed).

    Raises
    ------
    ValueError, TypeError, ModuleNotFoundError, OSError
        An argument that is not as described, a folder of another sweep or that cannot be written, an extra that is
        missing, or no scheduler that answers. The message says what to change.
    ScenarioError
        A scenario raised an exception; the message says which. Finished runs are kept.

    Examples
    --------
    >>> import tempfile
    >>> from comparisons.sweep.run import run_sweep
    >>> def square(scenario):
    ...     return {"square": scenario["side"] ** 2 + scenario["seed"]}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sweep = run_sweep({"side": [1.0, 3.0]}, folder, seeds=3, scenario=square, jobs=1, quiet=True)
    >>> [cell["square_mean"] for cell in sweep.cells]
    [3.0, 11.0]
    """
    if format not in FORMATS:
        raise ValueError(f"format must be one of {', '.join(FORMATS)}, got {format!r}")
    if format == "parquet" and find_spec("pyarrow") is None:
        raise ModuleNotFoundError(
            'Parquet needs the extra parquet: python -m pip install -c constraints.txt -e ".[parquet]"; or take csv'
        )
    if not (scenario is None or callable(scenario)):
        raise TypeError(f"scenario must be a function of a dict, got {scenario!r}")
    if scheduler is not None and jobs is not None:
        raise ValueError("give either jobs or scheduler: a cluster's workers are as many as it has")
    made = built_in_grid(grid, seeds) if scenario is None else own_grid(grid, seeds)
    path = sweep_folder(folder, made, scenario)
    done = kept(path)
    pending = {number: values for number, values in enumerate(made.runs()) if number not in done}
    with (
        tqdm(total=len(done) + len(pending), initial=len(done), unit="run", disable=quiet, dynamic_ncols=True) as bar,
        closing(job_outcomes(pending, scenario, made.seeds[0], jobs, scheduler)) as ended,
    ):
        for own in ended if pending else ():
            keep(path, own)
            done |= own
            bar.update(len(own))
    figures = [done[number] for number in sorted(done)]
    cells, runs = cell_rows(made, figures), [run | own for run, own in zip(made.runs(), figures, strict=True)]
    files = [write_table(cells, path / "cells", format), write_table(runs, path / "runs", format)]
    drawn = list(LABELS) if scenario is None else figure_names(figures)
    files += save_figure(sweep_figure(made, cells, drawn), path / "figures" / swept_axis(made))
    return Sweep(cells, runs, files)
