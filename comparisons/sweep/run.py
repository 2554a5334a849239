"""A grid of scenarios times seeds on all cores or a cluster: mean and 95 % interval of each cell.

`run_sweep` is the function, ``python -m comparisons sweep`` the command (docs/sweep.md).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kfopc_filterpy.plot import save_figure

from .figures import BUILT_IN_FIGURES, sweep_figures, swept_axis
from .grid import Grid, Run, built_in_grid, own_grid
from .jobs import Pool, Scenario, Sent, cluster, jobs_of, local
from .scenario import FIGURES, ScenarioError
from .store import SweepFolder
from .table import Record, cell_rows, figure_names, require_format, run_rows, write_table

__all__ = ["ScenarioError", "Sweep", "run_sweep"]


@dataclass(frozen=True)
class Sweep:
    """The results of a sweep.

    Attributes
    ----------
    grid : Grid
        Values of each axis, and the seeds.
    cells : list of dict
        One for each combination: the axes, `runs`, `diverged`, and ``<figure>_mean``, ``_low``, ``_high`` and ``_n``.
    runs : list of dict
        One for each run: the axes, `seed`, the figures, `diverged`.
    files : list of pathlib.Path
        The tables and figures written.
    """

    grid: Grid
    cells: list[Record]
    runs: list[Record]
    files: list[Path]

    @property
    def diverged(self) -> int:
        """Number of runs that diverged."""
        return sum(row["diverged"] for row in self.runs)


def run_sweep(
    grid: Mapping[str, Any],
    folder: str | os.PathLike[str],
    *,
    seeds: int | Sequence[int] = 8,
    scenario: Scenario | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    format: str = "csv",
    x: str | None = None,
    figures: Sequence[str] | None = None,
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
        package installed, and a clone (and the scenario function's module) on their path.
    format : {"csv", "parquet"}, default "csv"
        Of the tables. Parquet needs the extra `parquet`.
    x : str, optional
        Axis that the figures are drawn against; by default the one of numbers with most values.
    figures : sequence of str, optional
        Figures of merit that are drawn; by default noise reduction and output power, or all of an own scenario.
    quiet : bool, default False
        No progress bar.

    Returns
    -------
    Sweep
        The cells: means over the seeds that did not diverge, and their 95 % t-intervals (NaN for one seed).

    Raises
    ------
    ValueError, TypeError
        An axis, name, number or format that is not as described; a folder of another sweep; no such figure.
    ModuleNotFoundError
        An extra is missing.
    OSError
        The folder cannot be written, or no scheduler answers.
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
    made = built_in_grid(grid, seeds) if scenario is None else own_grid(grid, seeds)
    if scenario is not None and not callable(scenario):
        raise TypeError(f"scenario must be a function of a dict, got {scenario!r}")
    if scheduler is not None and jobs is not None:
        raise ValueError("give either jobs or scheduler: a cluster's workers are as many as it has")
    require_format(format)
    against = swept_axis(made, x)
    if scenario is None and figures is not None:
        _drawn(figures, FIGURES, True)  # better refused before the runs than after
    store = SweepFolder(folder, made, scenario)
    done = store.done()
    pending = [run for run in made.runs() if run.index not in done]
    if pending:
        pool = local(jobs) if scheduler is None else cluster(scheduler)
        _work_off(made, pending, store, done, Sent(scenario) if scenario and scheduler else scenario, pool, quiet)
    cells, runs = cell_rows(made, done), run_rows(made, done)
    files = [write_table(cells, store.path / "cells", format), write_table(runs, store.path / "runs", format)]
    names = _drawn(figures, figure_names(done), scenario is None)
    for name, figure in sweep_figures(made, cells, names, against).items():
        files += save_figure(figure, store.path / "figures" / name)
    return Sweep(made, cells, runs, files)


def _work_off(
    grid: Grid,
    pending: Sequence[Run],
    store: SweepFolder,
    done: dict[int, dict[str, Any]],
    scenario: Scenario | None,
    pool: Pool,
    quiet: bool,
) -> None:
    """Do the pending runs, and keep each job's as it ends."""
    from tqdm import tqdm

    diverged = sum(figures["diverged"] for figures in done.values())
    with (
        pool as (workers, run),
        tqdm(total=len(grid), initial=len(done), unit="run", disable=quiet, dynamic_ncols=True) as bar,
        closing(run(jobs_of(grid, pending, workers, scenario))) as outcomes,
    ):
        for own in outcomes:
            store.keep(own)
            done |= dict(own)
            bar.update(len(own))
            diverged += sum(figures["diverged"] for _, figures in own)
            bar.set_postfix(diverged=diverged, refresh=False)


def _drawn(chosen: Sequence[str] | None, present: Sequence[str], built_in: bool) -> list[str]:
    if chosen is None:
        return list(BUILT_IN_FIGURES) if built_in else list(present)
    unknown = [name for name in chosen if name not in present]
    if unknown:
        raise ValueError(f"no figure called {', '.join(unknown)}; there are {', '.join(present)}")
    return list(chosen)
