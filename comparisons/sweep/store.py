"""The folder of a sweep: its description, and the runs that are done.

`sweep.json` holds the grid, seeds, scenario and code; it is written once and whole. `runs.jsonl` gets a line for each
job that ends, on disk before the next one counts: a JSON object of the figures of each run by its number. If a kill or a
power cut leaves a line torn, a brace is missing and it is not JSON: its runs are done again. A torn line stays, and the
next one goes below it.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import kfopc_filterpy
from kfopc_filterpy._writing import prepare_folder, write_whole

from .grid import Grid
from .scenario import Figures

DESCRIPTION, RUNS = "sweep.json", "runs.jsonl"
PART_OF_SWEEP = ("studies/cases.py", "sweep/grid.py", "sweep/scenario.py")
OTHER_FOLDER = "choose another output folder, or remove this one to start afresh"


def sweep_folder(folder: str | os.PathLike[str], grid: Grid, scenario: Callable[..., Any] | None) -> Path:
    """Return the folder of a sweep, which is made unless it is there; refuse that of another sweep."""
    path = prepare_folder(folder)
    file, own = path / DESCRIPTION, describe(grid, scenario)
    if not (file.exists() or (path / RUNS).exists()):
        write_whole(file, json.dumps(own, ensure_ascii=False, indent=1) + "\n")
        return path
    try:
        there = dict(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"folder {str(path)!r} has no readable {DESCRIPTION}: {OTHER_FOLDER}") from error
    for name in own | there:
        if there.get(name) != own.get(name):
            differs = f"{name} is {_short(there.get(name))} there, but {_short(own.get(name))} here"
            raise ValueError(f"folder {str(path)!r} holds another sweep ({differs}): {OTHER_FOLDER}")
    if list(there) != list(own):
        raise ValueError(f"folder {str(path)!r} holds another sweep (its axes have another order): {OTHER_FOLDER}")
    return path


def describe(grid: Grid, scenario: Callable[..., Any] | None) -> dict[str, Any]:
    """Return the description of a sweep, as JSON gives it back."""
    name = "built in"
    if scenario is not None:
        name = f"{scenario.__module__}.{getattr(scenario, '__qualname__', type(scenario).__qualname__)}"
    axes = {f"axis {axis}": list(values) for axis, values in grid.axes.items()}
    return {"scenario": name, **axes, "seeds": list(grid.seeds), "SHA-256 of the code": code_hash(scenario)}


def code_hash(scenario: Callable[..., Any] | None) -> str:
    """Return the hash of the code that results rest on: the package, the scenes, and the source of an own scenario."""
    package, comparisons = Path(kfopc_filterpy.__file__).parent, Path(__file__).parents[1]
    digest = hashlib.sha256()
    sources = sorted(file for file in package.rglob("*") if file.suffix in (".py", ".c", ".h"))
    for file in (*sources, *(comparisons / name for name in PART_OF_SWEEP)):
        digest.update(file.name.encode() + file.read_bytes())
    if scenario is not None:
        with suppress(OSError, TypeError):  # typed at a prompt, or an object: it goes by its name
            digest.update(inspect.getsource(scenario).encode())
    return digest.hexdigest()


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 80 else f"{text[:60]} ... {text[-15:]}"


def kept(folder: Path) -> dict[int, Figures]:
    """Return the figures of the runs that are done, by number."""
    done: dict[int, Figures] = {}
    file = folder / RUNS
    for line in file.read_bytes().splitlines() if file.exists() else ():
        with suppress(ValueError):  # a torn line
            for number, figures in json.loads(line).items():
                done[int(number)] = {name: math.nan if value is None else value for name, value in figures.items()}
    return done


def keep(folder: Path, outcomes: dict[int, Figures]) -> None:
    """Add the runs of a job, on disk when this returns."""
    finite = {  # JSON has no number for the others
        number: {name: value if math.isfinite(value) else None for name, value in figures.items()}
        for number, figures in outcomes.items()
    }
    line = json.dumps(finite, ensure_ascii=False, allow_nan=False).encode() + b"\n"
    with open(folder / RUNS, "ab+") as file:
        if file.tell():
            file.seek(-1, os.SEEK_END)
            line = line if file.read(1) == b"\n" else b"\n" + line
        file.write(line)
        file.flush()
        os.fsync(file.fileno())
