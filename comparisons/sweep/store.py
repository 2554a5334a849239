"""The folder of a sweep: its description, and the runs that are done.

`sweep.json` holds the grid, seeds, scenario and code; it is written once and whole. `runs.jsonl` gets a line for each
job that ends, on disk before the next one counts. A line is one JSON object. If a kill or a power cut leaves it torn, a
brace is missing and it is not JSON: its runs are done again. A torn line stays, and the next one goes below it.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import kfopc_filterpy
from kfopc_filterpy.bench import prepare_folder, write_whole

from .grid import Grid

FORMAT = 1
DESCRIPTION, RUNS = "sweep.json", "runs.jsonl"
PART_OF_SWEEP = ("studies/cases.py", "sweep/grid.py", "sweep/scenario.py")

Outcome = tuple[int, dict[str, Any]]  # number of a run, and its figures


class SweepFolder:
    """The folder that keeps a sweep's runs.

    Raises
    ------
    ValueError
        The folder is of another grid, other seeds, another scenario or other code.
    OSError
        It cannot be written.
    """

    def __init__(self, folder: str | os.PathLike[str], grid: Grid, scenario: Callable[..., Any] | None) -> None:
        self.path = prepare_folder(folder)
        self._runs = self.path / RUNS
        self._count = len(grid)
        own = describe(grid, scenario)
        there = self._description()
        if there is None:
            write_whole(self.path / DESCRIPTION, json.dumps(own, ensure_ascii=False, indent=1) + "\n")
        elif there != own:
            raise ValueError(
                f"folder {str(self.path)!r} holds another sweep: {_difference(there, own)}. Choose another output folder, or "
                "remove this one to start afresh"
            )

    def _description(self) -> dict[str, Any] | None:
        file = self.path / DESCRIPTION
        if not file.exists():
            if self._runs.exists():
                raise ValueError(
                    f"folder {str(self.path)!r} holds {RUNS} but no {DESCRIPTION}: choose another output folder"
                )
            return None
        try:
            there = json.loads(file.read_text(encoding="utf-8"))
        except ValueError:
            there = None
        if not isinstance(there, dict):
            raise ValueError(f"{str(file)!r} is not the description of a sweep: choose another output folder")
        return there

    def done(self) -> dict[int, dict[str, Any]]:
        """Return the figures of the runs that are done, by number."""
        outcomes: dict[int, dict[str, Any]] = {}
        if self._runs.exists():
            for line in self._runs.read_bytes().splitlines():
                for index, figures in _outcomes(line):
                    if 0 <= index < self._count:
                        outcomes.setdefault(index, figures)
        return outcomes

    def keep(self, outcomes: Sequence[Outcome]) -> None:
        """Add the runs of a job, on disk when this returns."""
        line = json.dumps(
            {"runs": [{"run": index, "figures": _to_json(figures)} for index, figures in outcomes]},
            ensure_ascii=False,
            allow_nan=False,
        )
        with open(self._runs, "ab+") as file:
            file.seek(0, os.SEEK_END)
            if file.tell():
                file.seek(-1, os.SEEK_END)
                line = line if file.read(1) == b"\n" else "\n" + line
            file.write((line + "\n").encode())
            file.flush()
            os.fsync(file.fileno())


def describe(grid: Grid, scenario: Callable[..., Any] | None) -> dict[str, Any]:
    """Return the description of a sweep, as JSON gives it back."""
    return {
        "format": FORMAT,
        "axes": {name: list(values) for name, values in grid.axes.items()},
        "seeds": list(grid.seeds),
        "scenario": "built in" if scenario is None else _name(scenario),
        "code": {"kfopc_filterpy": kfopc_filterpy.__version__, "sha256": code_hash(scenario)},
    }


def code_hash(scenario: Callable[..., Any] | None) -> str:
    """Return the hash of the code that results rest on: the package, the scenes, and the source of an own scenario."""
    package, studies = Path(kfopc_filterpy.__file__).parent, Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in (*sorted(package.rglob("*.py")), *(studies / name for name in PART_OF_SWEEP)):
        digest.update(file.name.encode() + file.read_bytes())
    if scenario is not None:
        with suppress(OSError, TypeError):  # typed at a prompt, or an object: it goes by its name
            digest.update(inspect.getsource(scenario).encode())
    return digest.hexdigest()


def _name(scenario: Callable[..., Any]) -> str:
    named = scenario if hasattr(scenario, "__qualname__") else type(scenario)
    return f"{named.__module__}.{named.__qualname__}"


def _difference(there: Mapping[str, Any], own: Mapping[str, Any]) -> str:
    """Return in words how two descriptions differ."""
    if there.get("format") != own["format"]:
        return f"its format is {there.get('format')!r}, not {own['format']}"
    for name in ("scenario", "seeds"):
        if there.get(name) != own[name]:
            return f"its {name} is {_short(there.get(name))}, not {_short(own[name])}"
    axes = there.get("axes")
    axes = axes if isinstance(axes, dict) else {}
    for name, values in own["axes"].items():
        if axes.get(name) != values:
            return f"its {name} is {_short(axes.get(name))}, not {_short(values)}"
    if list(axes) != list(own["axes"]):
        return f"its axes are {', '.join(axes)}, not {', '.join(own['axes'])}"
    return "it was made with other code (another version of the package, of the scenes or of the scenario function)"


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 80 else f"{text[:60]} ... {text[-15:]}"


def _outcomes(line: bytes) -> list[Outcome]:
    """Return the runs of a line; none if it is torn."""
    try:
        return [(int(run["run"]), _from_json(run["figures"])) for run in json.loads(line)["runs"]]
    except (ValueError, KeyError, TypeError, AttributeError):
        return []


def _to_json(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Return figures with null for values that are not finite: JSON has no number for them."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in figures.items()
    }


def _from_json(figures: Mapping[str, Any]) -> dict[str, Any]:
    return {name: math.nan if value is None else value for name, value in figures.items()}
