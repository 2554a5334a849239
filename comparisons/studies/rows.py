"""Rows of results, which all studies beyond the paper have: selected, put into words, put into tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from kfopc_filterpy import SimulationResult
from kfopc_filterpy.metrics import overshoot

from ..bench import Claim, Table
from .cases import FS, WINDOW_S, Case

AnyRow = TypeVar("AnyRow")


@dataclass(frozen=True, kw_only=True)
class Row:
    """The result of an algorithm in a case, common to all studies; figures are NaN if it diverged."""

    path: str
    noise: str
    algorithm: str
    setting: Any = None  # the tuned one, if any
    noise_reduction_db: float = np.nan  # over the steady half
    power: float = np.nan  # over the steady half, over the rated one
    diverged_at_s: float | None = None

    @property
    def case(self) -> Case:
        """Where it was run."""
        return Case(self.path, self.noise)

    @property
    def unstable(self) -> bool:
        """Whether it ran away, or left more noise than there was."""
        return self.diverged_at_s is not None or not self.noise_reduction_db > 0.0


@dataclass(frozen=True, kw_only=True)
class WindowRow(Row):
    """A row that knows the short-time output power too."""

    worst_window: float = np.nan  # largest power over WINDOW_S, over the rated one


def figures_of(result: SimulationResult | None, rated_power: float) -> dict[str, Any]:
    """Return the figures of a `WindowRow`; a filter that could not go on diverged at its start."""
    if result is None or result.diverged_at_s is not None:
        return {"diverged_at_s": 0.0 if result is None else result.diverged_at_s}
    return {
        "noise_reduction_db": result.noise_reduction_db,
        "power": result.output_power / rated_power,
        "worst_window": overshoot(result.control_signal, rated_power, FS, window_s=WINDOW_S),
    }


# ---- Selections


def select(rows: Iterable[AnyRow], **values: Any) -> list[AnyRow]:
    """Return the rows that have these values."""
    return [row for row in rows if all(getattr(row, name) == value for name, value in values.items())]


def grouped(rows: Iterable[AnyRow], *names: str) -> dict[tuple[Any, ...], list[AnyRow]]:
    """Return the rows by their values of these names, in the order in which they come."""
    groups: dict[tuple[Any, ...], list[AnyRow]] = {}
    for row in rows:
        groups.setdefault(tuple(getattr(row, name) for name in names), []).append(row)
    return groups


def column(rows: Iterable[Any], name: str) -> np.ndarray:
    """Return one value of all rows."""
    return np.array([getattr(row, name) for row in rows])


# ---- Claims and words


def worst_claim(text: str, values: Mapping[Any, float], *, at_most: float = np.inf, at_least: float = -np.inf) -> Claim:
    """Return the claim at the worst of some values, with where that is and their mean; NaN, of a run that diverged, is worst."""
    if not values:
        return Claim(text, np.nan, at_most, at_least, "nothing to compare with")
    own = np.array(list(values.values()))
    k = int(np.argmax(own) if np.isfinite(at_most) else np.argmin(own))
    return Claim(text, float(own[k]), at_most, at_least, f"{list(values)[k]}; mean {np.mean(own):.3g}")


def span(values: Iterable[float], form: str = ".3g") -> str:
    """Return the least and the largest of some values in words."""
    own = list(values)
    return f"{np.min(own):{form}} to {np.max(own):{form}}" if own else "(none)"


# ---- Tables


def cell(row: Row, figure: str) -> Any:
    """Return a figure of a row for a table."""
    return getattr(row, figure) if row.diverged_at_s is None else "diverged"


def figure_table(
    stem: str,
    caption: str,
    rows: Iterable[Row],
    figure: str,
    keys: Mapping[str, str],
    columns: Iterable[Any],
    column_of: str = "algorithm",
) -> Table:
    """Return a table of one figure: a line for the keys, given by heading and name, and a column for each algorithm."""
    beginning = grouped(rows, *keys.values(), column_of)
    cells = ((tuple(begins), name, cell(row, figure)) for (*begins, name), (*_, row) in beginning.items())
    return table_of_cells(stem, caption, list(keys), columns, cells)


def table_of_cells(
    stem: str,
    caption: str,
    headings: Sequence[str],
    columns: Iterable[Any],
    cells: Iterable[tuple[tuple[str | float, ...], Any, Any]],
) -> Table:
    """Return a table of cells, each given with the beginning of its line and with its column."""
    columns, lines = list(columns), dict[tuple[str | float, ...], dict[Any, Any]]()
    for key, name, value in cells:
        lines.setdefault(key, {})[name] = value
    rows = [[*key, *(own.get(name, "") for name in columns)] for key, own in lines.items()]
    return Table(stem, caption, [*headings, *map(str, columns)], rows)
