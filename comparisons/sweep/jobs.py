"""The jobs of a sweep, which run on this machine's cores or on a Dask cluster."""

from __future__ import annotations

import inspect
import pickle
from collections.abc import Callable, Generator, Mapping
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from typing import Any

import joblib

from kfopc_filterpy._validate import as_count
from kfopc_filterpy.verdict.runs import one_blas_thread

from .grid import Values
from .scenario import Figures, group_of, most_together, naming, run_group

CONNECT_S = 15.0  # time to find a scheduler

Scenario = Callable[[Values], Mapping[str, Any]]
Pending = Mapping[int, Values]  # runs by number
Outcomes = dict[int, Figures]
Job = Callable[[], Outcomes]


def plan(pending: Pending, workers: int) -> list[Pending]:
    """Return the runs of the built-in scenario in jobs: what can share is together, no job beyond its share of the cores."""
    share = -(-len(pending) // workers)
    groups: dict[Any, list[int]] = {}
    for number, values in pending.items():
        groups.setdefault(group_of(values), []).append(number)
    jobs: list[Pending] = []
    for numbers in groups.values():
        size = min(most_together(pending[numbers[0]]), share)
        parts = (numbers[i : i + size] for i in range(0, len(numbers), size))
        jobs += [{number: pending[number] for number in part} for part in parts]
    return jobs


def jobs_of(pending: Pending, scenario: Scenario | None, tuning_seed: int, workers: int) -> list[Job]:
    """Return the jobs of the runs; an own scenario has one for each."""
    alone = [{number: values} for number, values in pending.items()]
    return [partial(do_job, runs, scenario, tuning_seed) for runs in (alone if scenario else plan(pending, workers))]


@one_blas_thread()  # each core has a job, and the sums of several threads differ
def do_job(runs: Pending, scenario: Scenario | None, tuning_seed: int) -> Outcomes:
    """Return the figures of runs of one group, or of the user's scenario function."""
    if scenario is None:
        return dict(zip(runs, run_group(list(runs.values()), tuning_seed), strict=True))
    outcomes = {}
    for number, values in runs.items():
        with naming(values):
            outcomes[number] = as_figures(scenario(dict(values)))
            if clash := set(outcomes[number]) & set(values):
                raise ValueError(f"the figure {min(clash)!r} has the name of an axis or the seed: rename it")
    return outcomes


def as_figures(returned: Any) -> Figures:
    """Return the figures of an own scenario as floats, NaN for None, and `diverged` as a boolean, False by default."""
    if not (isinstance(returned, Mapping) and all(isinstance(name, str) for name in returned)):
        raise TypeError(f"a scenario must return a dict of figures by name, got {returned!r}")
    figures: Figures = {}
    for name, value in returned.items():
        try:
            figures[name] = float("nan") if value is None else float(value)
        except (TypeError, ValueError) as error:
            raise TypeError(f"figure {name!r} of a scenario must be a number, got {value!r}") from error
    return figures | {"diverged": bool(returned.get("diverged", False))}


def job_outcomes(
    pending: Pending, scenario: Scenario | None, tuning_seed: int, jobs: int | None, scheduler: str | None
) -> Generator[Outcomes, None, None]:
    """Yield the outcomes of each job as it ends; closing the iterator stops what still runs."""
    jobs_for = partial(jobs_of, pending, scenario, tuning_seed)
    if scheduler is not None:
        yield from _on_cluster(scheduler, jobs_for, scenario)
        return
    workers = joblib.cpu_count() if jobs is None else as_count(jobs, "jobs")
    parallel = joblib.Parallel(n_jobs=workers, return_as="generator_unordered")
    try:
        yield from parallel(joblib.delayed(job)() for job in jobs_for(workers))
    except BrokenProcessPool as error:
        raise OSError(f"a worker process was killed, perhaps for want of memory (take fewer jobs): {error}") from error


def _on_cluster(
    scheduler: str, jobs_for: Callable[[int], list[Job]], scenario: Scenario | None
) -> Generator[Outcomes, None, None]:
    try:
        import cloudpickle
        from distributed import Client, KilledWorker, as_completed
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'a scheduler needs the extra cluster: python -m pip install -c constraints.txt -e ".[cluster]"'
        ) from error
    if inspect.isfunction(scenario):  # its module goes with it: the workers may lack it
        cloudpickle.register_pickle_by_value(inspect.getmodule(scenario))
    try:
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OSError(f"no Dask scheduler answers at {scheduler}: {error}") from error
    with client:
        client.wait_for_workers(1)
        jobs = [cloudpickle.dumps(job) for job in jobs_for(sum(client.nthreads().values()))]
        futures = client.map(unpickled, jobs, pure=False)
        try:
            for _, outcome in as_completed(futures, loop=client.loop, with_results=True):
                yield outcome
        except KilledWorker as error:
            raise OSError(f"the cluster gave a job up: {error}") from error


def unpickled(job: bytes) -> Outcomes:
    """Do a job that cloudpickle has packed."""
    return pickle.loads(job)()
