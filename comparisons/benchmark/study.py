"""`python -m comparisons benchmark`: every entry on every task, at its best setting, on a noise it was not tuned on."""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult, __version__, noise_reduction_db, output_power
from kfopc_filterpy._writing import prepare_folder, write_whole
from kfopc_filterpy.metrics import nse_db
from kfopc_filterpy.verdict.runs import one_blas_thread

from ..bench import Algorithm, AllDivergedError, Runs, make_controller, run_setting, tune
from ..bench.registry import registered
from ..bench.tuning import BUDGET
from .blocks import CommandController, EntryFailed
from .entries import entries_for, peers, rivals
from .event_figure import event_figure
from .tasks import FOLDER, JUDGED, LeftOut, Task, read_task

SHARE = 0.9  # of the steady noise reduction, that is reached after a time
TIMED_S, TIMES = 0.5, 5  # short runs are timed several times
REFERENCE = ("FxLMS", 2.0**-6)  # whose cost a sample is 1
Entry = Algorithm | str  # an object by its maker, or a command


@dataclass(frozen=True)
class Score:
    """What an entry reached in a task.

    Attributes
    ----------
    entry : str
        Its name.
    noise_reduction_db : float
        Noise reduction over the second half of the run in dB.
    below_bound_db : float
        By how many dB that is below the bound; NaN if the rated power is not kept.
    power : float
        Output power over that half, divided by the rated power, of the loudspeaker for which this is largest.
    loudest_second_db : float
        Power of the error relative to that of the disturbance in dB, in the second in which this is largest; those
        before the change do not count.
    time_s : float
        Time from the end of the change until 90 % of the steady noise reduction in dB is reached; NaN if the noise is
        not reduced.
    cost : float
        Processor time of a run, divided by that of FxLMS; for a command, the elapsed time divided by the same.
    setting : float or tuple of float, optional
        Its best setting.
    failed : str
        Why it has no score; empty if it has.
    """

    entry: str
    noise_reduction_db: float = np.nan
    below_bound_db: float = np.nan
    power: float = np.nan
    loudest_second_db: float = np.nan
    time_s: float = np.nan
    cost: float = np.nan
    setting: Any = None
    failed: str = ""

    @property
    def within_rating(self) -> bool:
        """Whether the rated power is kept, as the tuning rule means it."""
        return self.power <= BUDGET


def score(task: Task, name: str, result: SimulationResult, bound_db: float) -> Score:
    """Return the score of a run on the noise that is judged, without its cost and setting."""
    if result.diverged_at_s is not None:
        return Score(name, failed=f"diverges after {result.diverged_at_s:.2g} s")
    e, d = np.atleast_2d(result.error), np.atleast_2d(result.disturbance)
    reduction = noise_reduction_db(e, d)
    power = float(np.max(output_power(result.control_signal) / task.rated_power))
    seconds = np.array_split(np.arange(e.shape[1]), max(round(e.shape[1] / task.fs), 1))
    later = [part for part in seconds if part[-1] >= task.changed_at_s * task.fs]
    loudest = max(-noise_reduction_db(e[:, part], d[:, part], steady=1.0) for part in later)
    change = round((task.changed_at_s + task.change.lasting_s) * task.fs)
    window = round(task.nse_window_s * task.fs)
    curve = -nse_db(e[:, change:], d[:, change:], task.fs, task.nse_window_s)
    curve[: window - 1] = np.nan  # shorter windows
    reached = np.flatnonzero(curve >= SHARE * reduction) if reduction > 0.0 else np.array([])
    return Score(
        name,
        noise_reduction_db=reduction,
        below_bound_db=bound_db - reduction if power <= BUDGET else np.nan,
        power=power,
        loudest_second_db=loudest,
        time_s=float(reached[0] / task.fs) if reached.size else np.nan,
    )


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of a run and its processor time in s, the shortest of several if it is short."""
    best, spent, done = np.inf, 0.0, 0
    while done == 0 or (spent < TIMED_S and done < TIMES):
        began = time.thread_time()
        result = run()
        took = time.thread_time() - began
        best, spent, done = min(best, took), spent + took, done + 1
    return result, best


def run_entry(runs: Runs, task: Task, name: str, entry: Entry, bound_db: float, reference_s: float) -> Score:
    """Return the score of an entry, or why it failed."""
    setting = None
    try:
        if isinstance(entry, str):
            with CommandController(task, entry) as command:
                result, seconds = timed_once(task, command)
        else:
            with registered({name: entry}):
                setting = tune(runs, task, [name])[name].setting
                result, seconds = timed(lambda: run_setting(task, name, setting, JUDGED))
            if result is None:
                raise EntryFailed("refuses to continue")
    except AllDivergedError:
        return Score(name, failed="diverges at every setting")
    except EntryFailed as error:
        return Score(name, failed=str(error))
    except Exception as error:  # noqa: BLE001 - of code that is not ours; the others go on
        return Score(name, failed=f"{type(error).__name__}: {error}")
    return replace(score(task, name, result, bound_db), cost=seconds / reference_s, setting=setting)


def timed_once(task: Task, command: CommandController) -> tuple[SimulationResult, float]:
    """Return the run of a command, and its time in s without its start."""
    began = time.perf_counter()
    result = task.run(command, JUDGED)
    return result, time.perf_counter() - began - command.first_answer_s


def run_task(runs: Runs, task: Task, entries: Mapping[str, Entry], only: str = "*") -> dict[str, Any]:
    """Return the scores of all entries of a task, the best within the rating first, and its bound."""
    chosen = {name: own for name, own in entries_for(task, entries).items() if fnmatch(name, only)}
    if not chosen:
        raise LeftOut(f"no entry fits {only}")
    bound_db = task.bound_db()
    _, reference_s = timed(lambda: task.run(make_controller(task, *REFERENCE), JUDGED))
    scores = [run_entry(runs, task, name, own, bound_db, reference_s) for name, own in chosen.items()]
    scores.sort(key=lambda one: (bool(one.failed), not one.within_rating, -one.noise_reduction_db))
    return {"task": task, "bound_db": bound_db, "scores": scores}


def table(outcome: Mapping[str, Any]) -> str:
    """Return the scores of a task for the terminal."""
    task, scores = outcome["task"], outcome["scores"]
    lines = [
        f"{task.name} [{task.digest}]: {task.title}",
        f"bound {outcome['bound_db']:.2f} dB with {task.n_taps} taps; {task.fs / 1e3:g} kHz, blocks of {task.block}",
        f"{'entry':31}{'dB':>8}{'to bound':>10}{'power':>8}{'loudest s':>11}{'90 % after s':>14}{'cost':>8}  setting",
    ]
    for one in scores:
        if one.failed:
            lines.append(f"{one.entry:31}  failed: {one.failed}")
            continue
        settings = "" if one.setting is None else ", ".join(f"{value:.3g}" for value in np.ravel(one.setting))
        lost = f"{one.below_bound_db:.2f}" if one.within_rating else "over"
        lines.append(
            f"{one.entry:31}{one.noise_reduction_db:8.2f}{lost:>10} {one.power:7.2f}{one.loudest_second_db:11.2f}"
            f"{one.time_s:14.3f}{one.cost:8.1f}  {settings}"
        )
    return "\n".join([*lines, place(scores)]).rstrip()


def place(scores: Sequence[Score], name: str = "KF-PB") -> str:
    """Return the place of an entry in a sentence; nothing if it has none."""
    kept = [one.entry for one in scores if one.within_rating]
    if name not in kept:
        return ""
    k = kept.index(name)
    behind = scores[0].noise_reduction_db - scores[k].noise_reduction_db
    return f"{name} has place {k + 1} of {len(scores)}" + (f", {behind:.2f} dB behind {kept[0]}." if k else ".")


def main(arguments: Sequence[str], objects: Mapping[str, Algorithm] | None = None) -> int:
    """Run the benchmark, with entries of one's own beside the others: `objects`, and those that `--entry` names."""
    parser = argparse.ArgumentParser(
        prog="python -m comparisons benchmark", description="Run every entry on every task, and print the scores."
    )
    parser.add_argument(
        "--entry",
        action="append",
        default=[],
        metavar="NAME=COMMAND",
        help="a command that exchanges blocks (docs/benchmark.md)",
    )
    parser.add_argument("--tasks", default="*", metavar="NAME", help="tasks whose name fits, such as 'duct-*'")
    parser.add_argument("--only", default="*", metavar="NAME", help="entries whose name fits, such as 'KF-*'")
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("benchmark"),
        help="folder for benchmark.json and events.png (default: benchmark)",
    )
    options = parser.parse_args(arguments)
    commands = dict(one.partition("=")[::2] for one in options.entry)
    for name, command in commands.items():
        if not (name and command):
            parser.error(f"--entry must be NAME=COMMAND, got {name}={command}")
    files = [path for path in sorted(FOLDER.glob("*.toml")) if fnmatch(path.stem, options.tasks)]
    if not files:
        parser.error(
            f"no task fits {options.tasks}; there are {', '.join(p.stem for p in sorted(FOLDER.glob('*.toml')))}"
        )
    try:
        prepare_folder(options.output)
    except OSError as error:
        parser.error(str(error))
    entries: dict[str, Entry] = {**(objects or {}), **commands}
    known: dict[str, Entry] = {}
    runs, outcomes = Runs(), []
    with one_blas_thread(), warnings.catch_warnings():  # as in the runs that are timed
        warnings.simplefilter("ignore", RuntimeWarning)  # of filters that diverge while they are tuned
        for path in files:
            try:
                task = read_task(path)
                others = {**rivals(), **(peers() if task.other_packages else {}), **entries}
                known |= entries_for(task, others)
                outcomes.append(run_task(runs, task, others, options.only))
            except LeftOut as error:
                print(f"{path.stem}: left out, {error}\n", flush=True)
                continue
            print(f"{table(outcomes[-1])}\n", flush=True)
    if not outcomes:
        parser.error(f"no task was run; the entries that --only can name are {', '.join(known)}")
    found = {
        outcome["task"].name: {
            "digest": outcome["task"].digest,
            "bound_db": outcome["bound_db"],
            "scores": [asdict(one) for one in outcome["scores"]],
        }
        for outcome in outcomes
    }
    written = options.output / "benchmark.json"
    write_whole(written, json.dumps({"version": __version__, "tasks": found}, indent=1) + "\n")
    print(f"{written} written")
    if figure := event_figure(outcomes):
        figure.savefig(options.output / "events.png", dpi=150)
    return 0
