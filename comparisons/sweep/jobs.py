"""The jobs of a sweep, which run on this machine's cores or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from functools import lru_cache, partial
from importlib.util import find_spec
from typing import Any

from .grid import Grid, Run, Values, as_whole
from .scenario import group_of, most_together, naming, run_group
from .store import Outcome

CONNECT_S = 15.0  # time to find a scheduler, and then its workers

Scenario = Callable[[Values], Mapping[str, Any]]
Job = Callable[[], list[Outcome]]
Outcomes = Callable[[list[Job]], Generator[list[Outcome], None, None]]  # what runs jobs
Pool = AbstractContextManager[tuple[int, Outcomes]]  # number of workers, and what runs jobs on them


def plan(pending: Sequence[Run], workers: int) -> list[list[Run]]:
    """Return the runs of the built-in scenario in jobs: what can share is together, no job beyond its share of the cores."""
    share = -(-len(pending) // workers)
    groups: dict[Any, list[Run]] = {}
    for run in pending:
        groups.setdefault(group_of(run.scenario), []).append(run)
    return [part for runs in groups.values() for part in _parts(runs, min(most_together(runs[0].scenario), share))]


def _parts(runs: list[Run], size: int) -> list[list[Run]]:
    return [runs[i : i + size] for i in range(0, len(runs), size)]


def jobs_of(grid: Grid, pending: Sequence[Run], workers: int, scenario: Scenario | None) -> list[Job]:
    """Return the jobs of the runs; an own scenario has one for each."""
    if scenario is not None:
        return [partial(own_job, scenario, run.index, run.scenario) for run in pending]
    return [
        partial(built_in_job, [run.index for run in part], [run.scenario for run in part], grid.seeds[0])
        for part in plan(pending, workers)
    ]


def built_in_job(indices: Sequence[int], scenarios: Sequence[Values], tuning_seed: int) -> list[Outcome]:
    """Run scenarios of one scene."""
    with one_thread():
        return list(zip(indices, run_group(scenarios, tuning_seed), strict=True))


def own_job(scenario: Scenario, index: int, values: Values) -> list[Outcome]:
    """Call the user's scenario function."""
    with naming(values), one_thread():
        figures = as_figures(scenario(dict(values)))
        clash = [name for name in figures if name in values]
        if clash:
            raise ValueError(f"the figure {clash[0]!r} has the name of an axis or the seed: call it something else")
        return [(index, figures)]


def as_figures(returned: Any) -> dict[str, Any]:
    """Return the figures of an own scenario as floats, `diverged` as a boolean, False by default."""
    if not isinstance(returned, Mapping):
        raise TypeError(f"a scenario must return a dict of figures, got {type(returned).__name__}")
    figures: dict[str, Any] = {}
    for name, value in returned.items():
        if not isinstance(name, str):
            raise TypeError(f"the figures of a scenario must have strings for names, got {name!r}")
        if name != "diverged":
            try:
                figures[name] = float("nan") if value is None else float(value)
            except (TypeError, ValueError) as error:
                raise TypeError(f"figure {name!r} of a scenario must be a number, got {value!r}") from error
    return figures | {"diverged": bool(returned.get("diverged", False))}


class Sent:
    """A scenario function as cloudpickle sends it: with its source, if its module is registered for that.

    distributed itself looks at the outermost object only, and would send a function within it by name.
    """

    def __init__(self, scenario: Scenario) -> None:
        import cloudpickle

        self._pickled: bytes = cloudpickle.dumps(scenario)

    def __call__(self, values: Values) -> Mapping[str, Any]:
        return _unpickled(self._pickled)(values)


@lru_cache(maxsize=4)
def _unpickled(pickled: bytes) -> Scenario:
    import cloudpickle

    return cloudpickle.loads(pickled)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run with one BLAS thread: each core has a job, and the sums of several threads differ."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1):
        yield


@contextmanager
def local(jobs: int | None) -> Iterator[tuple[int, Outcomes]]:
    """Yield the number of workers and what runs jobs on as many processes of this machine, by default all cores."""
    import joblib

    workers = joblib.cpu_count() if jobs is None else as_whole(jobs, "jobs")
    threads: dict[str, Any] = {} if workers == 1 else {"inner_max_num_threads": 1}
    with joblib.parallel_config(backend="loky", n_jobs=workers, **threads):
        yield workers, _outcomes


@contextmanager
def cluster(scheduler: str) -> Iterator[tuple[int, Outcomes]]:
    """Yield the number of threads of a Dask cluster's workers and what runs jobs on them."""
    if find_spec("distributed") is None:
        raise ModuleNotFoundError(
            'a scheduler needs the extra cluster: python -m pip install -c constraints.txt -e ".[cluster]"'
        )
    import joblib
    from distributed import Client

    try:
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OSError(f"no Dask scheduler answers at {scheduler}: {error}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError as error:
            raise OSError(f"the Dask scheduler at {scheduler} has no workers: start one with dask worker") from error
        with joblib.parallel_config(backend=_dask_backend(client)):
            yield sum(client.nthreads().values()), _outcomes


def _dask_backend(client: Any) -> Any:
    """Return joblib's Dask backend, which would wait for ever for a job that Dask has given up.

    It takes results only from its callback, which is never called for a job whose workers died one after another.
    """
    from joblib._dask import DaskDistributedBackend

    class Backend(DaskDistributedBackend):
        def submit(self, func: Any, callback: Any = None) -> Any:
            future = super().submit(func, callback)
            future.add_done_callback(lambda ended: ended.exception() and callback(ended.exception()))
            return future

        def retrieve_result_callback(self, out: Any) -> Any:
            if isinstance(out, BaseException):
                raise OSError(f"the cluster gave a job up: {out}") from out
            return super().retrieve_result_callback(out)

    return Backend(client=client)


def _outcomes(jobs: list[Job]) -> Generator[list[Outcome], None, None]:
    """Yield the outcomes of jobs in the order in which they end; closing it stops what still runs."""
    import joblib

    try:
        yield from joblib.Parallel(return_as="generator_unordered")(joblib.delayed(_call)(job) for job in jobs)
    except BrokenProcessPool as error:
        raise OSError(f"a worker process was killed, perhaps for want of memory (take fewer jobs): {error}") from error


def _call(job: Job) -> list[Outcome]:
    return job()
