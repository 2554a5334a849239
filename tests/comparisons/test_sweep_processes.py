"""A sweep whose processes are really killed: the sweep itself, a worker of a cluster, the cluster."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from threading import Thread

import pytest
from helpers.studies import smaller

from comparisons.__main__ import main
from comparisons.sweep import jobs
from comparisons.sweep.run import run_sweep
from comparisons.sweep.scenario import ScenarioError

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 60.0  # for what takes a second or two on a machine that does nothing else
OWN_MODULE = """
import os, time

def slow(scenario):
    time.sleep(float(os.environ.get("SLOW_S", 0)))  # in the processes started below alone
    return {"product": scenario["a"] * scenario["seed"] / 3, "pid": os.getpid()}

def fatal(scenario):
    if scenario["a"] == 3:
        os.kill(os.getpid(), 9)
    return {"product": 1.0}

def broken(scenario):
    if scenario["a"] == 3:
        raise ArithmeticError("three")
    return {"product": 1.0}
"""
posix = pytest.mark.skipif(os.name != "posix", reason="signals and process groups are POSIX's")
dask = pytest.mark.skipif(find_spec("distributed") is None, reason="dask.distributed, the extra cluster, is missing")


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A module of one's own, in a folder that the workers look in too."""
    (tmp_path / "own_slow_module.py").write_text(OWN_MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield __import__("own_slow_module")
    sys.modules.pop("own_slow_module", None)


def environment(folder):
    path = os.pathsep.join([str(folder), str(ROOT)])
    settings = {
        "SLOW_S": "0.1",
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",  # a job goes to another worker when its own dies, once
        "DASK_DISTRIBUTED__SCHEDULER__IDLE_TIMEOUT": "120s",  # should the tests be killed themselves
    }
    return os.environ | settings | {"PYTHONPATH": path, "PYTHONWARNINGS": "default"}


def wait_for(condition, what):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited {PATIENCE_S:g} s in vain for {what}"
        time.sleep(0.02)


def lines(file):
    return file.read_bytes().count(b"\n") if file.exists() else 0


def heed_interrupts():
    """Undo what a shell does for a command in its background, whose children then ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextlib.contextmanager
def started(*command, folder, log):
    """A process in a group of its own, which is killed in the end with all its children."""
    with open(log, "wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", *map(str, command)],
            cwd=folder,
            env=environment(folder),
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=heed_interrupts,  # noqa: PLW1509 - it sets a signal, and starts no thread
        )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(PATIENCE_S)


# The sweep itself is ended in the middle, and goes on.

GRID = {"a": list(range(1, 11))}
SWEEP = ["comparisons", "sweep", "--scenario", "own_slow_module:slow", "--axis", "a=1:10:10", "--seeds", "4"]


@pytest.mark.slow
@posix
@pytest.mark.parametrize(("ending", "jobs"), [("SIGKILL", 2), ("SIGINT", 1), ("SIGINT", 2)])
def test_sweep_goes_on_from_what_is_done(own, tmp_path, ending, jobs):
    out, log = tmp_path / "out", tmp_path / "log"
    with started(*SWEEP, "--jobs", jobs, "--output", out, folder=tmp_path, log=log) as process:
        wait_for(lambda: lines(out / "runs.jsonl") >= 5 or process.poll() is not None, "five runs")
        os.killpg(process.pid, getattr(signal, ending))  # as a terminal does: the workers too
        code = process.wait(PATIENCE_S)
    before = lines(out / "runs.jsonl")
    assert 5 <= before < 40, log.read_text()
    assert not (out / "cells.csv").exists()
    if ending == "SIGINT":
        assert code == 130
        assert "interrupted; the same command goes on" in log.read_text()
    done = (out / "runs.jsonl").read_bytes()

    sweep = run_sweep(GRID, out, seeds=4, scenario=own.slow, jobs=1, quiet=True)

    assert (out / "runs.jsonl").read_bytes().startswith(done)
    assert lines(out / "runs.jsonl") == 40
    assert sum(run["pid"] == os.getpid() for run in sweep.runs) == 40 - before  # the others were not done again
    fresh = run_sweep(GRID, tmp_path / "fresh", seeds=4, scenario=own.slow, jobs=1, quiet=True)
    assert [run["product"] for run in sweep.runs] == [run["product"] for run in fresh.runs]


@pytest.mark.slow
@posix
def test_worker_killed_on_this_machine_is_an_error_that_keeps_what_is_done(own, tmp_path):
    with pytest.raises(OSError, match="a worker process was killed"):
        run_sweep({"a": [1, 2, 3]}, tmp_path / "out", seeds=8, scenario=own.fatal, jobs=2, quiet=True)


# On a cluster.


@pytest.fixture
def cluster(own, tmp_path):
    """Address of a scheduler on a free port of 127.0.0.1, and its two workers."""
    file = tmp_path / "scheduler.json"
    here = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", file]
    worker = ["--no-nanny", "--nthreads", 1, "--local-directory", tmp_path / "scratch", "--death-timeout", PATIENCE_S]
    with contextlib.ExitStack() as stack:

        def start(name, *command):
            log = tmp_path / f"{name}.log"
            return stack.enter_context(started("dask", *command, *here, folder=tmp_path, log=log))

        scheduler = start("scheduler", "scheduler", "--port", 0)
        wait_for(lambda: file.exists() or scheduler.poll() is not None, "the scheduler")
        assert scheduler.poll() is None, (tmp_path / "scheduler.log").read_text()
        workers = [start(f"worker{i}", "worker", *worker) for i in (1, 2)]
        address = json.loads(file.read_text())["address"]
        _wait_for_workers(address, 2)
        yield address, workers


def _wait_for_workers(address, count):
    from distributed import Client

    with Client(address, set_as_default=False, timeout=PATIENCE_S) as client:
        client.wait_for_workers(count, timeout=PATIENCE_S)


@pytest.mark.slow
@posix
@dask
def test_cluster_loses_a_worker_and_no_cell(own, cluster, tmp_path):
    address, workers = cluster
    out, killed = tmp_path / "out", []

    def slow_then_killed(file=out / "runs.jsonl"):
        wait_for(lambda: lines(file) >= 10, "ten runs")
        workers[0].send_signal(signal.SIGKILL)
        killed.append(lines(file))

    thread = Thread(target=slow_then_killed, daemon=True)
    thread.start()
    sweep = run_sweep(GRID, out, seeds=4, scenario=own.slow, scheduler=address, quiet=True)
    thread.join()

    assert workers[0].wait(PATIENCE_S) == -signal.SIGKILL
    assert 10 <= killed[0] < 40  # in the middle
    assert [cell["runs"] for cell in sweep.cells] == [4] * 10
    assert lines(out / "runs.jsonl") == 40
    assert {run["pid"] for run in sweep.runs} == {worker.pid for worker in workers}  # both did some
    kept = (out / "runs.jsonl").read_text().splitlines()[killed[0] + 4 :]  # what was on its way when it died left out
    assert {run["pid"] for line in kept for run in json.loads(line).values()} == {workers[1].pid}
    local = run_sweep(GRID, tmp_path / "local", seeds=4, scenario=own.slow, jobs=1, quiet=True)
    assert [run["product"] for run in sweep.runs] == [run["product"] for run in local.runs]

    # The built-in scenario on the worker that is left, the numbers to the last bit those of this process.
    grid = {"algorithm": ["KF-OPC", "FxLMS"], "rated_power_db": [-20, -10, -5], "duration_s": 0.3, "n_taps": 16}
    for folder, where in (("there", {"scheduler": address}), ("here", {"jobs": 1})):
        run_sweep(grid, tmp_path / folder, seeds=2, quiet=True, **where)
    for table in ("cells.csv", "runs.csv"):
        assert (tmp_path / "there" / table).read_bytes() == (tmp_path / "here" / table).read_bytes()

    with pytest.raises(ScenarioError, match="scenario a=3, seed=1: ArithmeticError: three"):
        run_sweep({"a": [3]}, tmp_path / "broken", seeds=1, scenario=own.broken, scheduler=address, quiet=True)


@pytest.mark.slow
@posix
@dask
def test_command_sends_a_module_that_the_workers_lack(cluster, tmp_path, monkeypatch, capsys):
    address, _ = cluster
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "own_far_module.py").write_text("def far(scenario):\n    return {'sum': scenario['a'] + 1}\n")
    monkeypatch.syspath_prepend(str(elsewhere))
    arguments = ["--scenario", "own_far_module:far", "--axis", "a=1,2", "--seeds", "2", "--scheduler", address]
    assert main(["sweep", *arguments, "--output", str(tmp_path / "out"), "--quiet"]) == 0
    assert "4 runs, 0 of them diverged, 2 cells" in capsys.readouterr().out


@pytest.mark.slow
@posix
@dask
def test_job_that_no_worker_survives_ends_the_sweep(own, cluster, tmp_path):
    address, _ = cluster
    with pytest.raises(OSError, match=r"the cluster gave a job up: .*2 different workers"):
        run_sweep({"a": [1, 3]}, tmp_path / "out", seeds=1, scenario=own.fatal, scheduler=address, quiet=True)


@dask
def test_scheduler_that_is_not_there_is_refused(own, tmp_path):
    with (
        smaller(jobs, CONNECT_S=1.0),
        pytest.raises(OSError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9: "),
    ):
        run_sweep(GRID, tmp_path, scenario=own.slow, scheduler="tcp://127.0.0.1:9", quiet=True)


def test_cluster_without_its_extra_is_refused(uninstall, own, tmp_path):
    uninstall("distributed")
    with pytest.raises(ModuleNotFoundError, match=r'a scheduler needs the extra cluster: .*"\.\[cluster\]"'):
        run_sweep(GRID, tmp_path, scenario=own.slow, scheduler="tcp://127.0.0.1:9", quiet=True)
