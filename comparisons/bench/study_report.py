"""`StudyReport`, everything that the report says of one study: claims, tables, figures, sounds, parameters."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from kfopc_filterpy._writing import jsonable
from kfopc_filterpy.verdict.items import FigureItem, Sound, Table

from .merit import MERITS, merit_table


@dataclass(frozen=True)
class Claim:
    """A claim of a study: a number that was measured, and the limits within which the claim holds.

    Parameters
    ----------
    text : str
        The claim, with the unit of the number.
    value : float
        What was measured.
    at_most, at_least : float, optional
        The largest and the smallest value with which it holds. NaN never holds.
    note : str, default ""
        Where it was measured, or what belongs to it, in a few words.

    Examples
    --------
    >>> Claim("KF-PB's output power over the rated one", 0.99, at_most=1.02).holds
    True
    """

    text: str
    value: float
    at_most: float = np.inf
    at_least: float = -np.inf
    note: str = ""

    @property
    def holds(self) -> bool:
        """Whether the value is within the limits."""
        return bool(self.at_least <= self.value <= self.at_most)

    @property
    def limits(self) -> str:
        """The limits in words."""
        if np.isfinite(self.at_most) and np.isfinite(self.at_least):
            return f"{self.at_least:g} to {self.at_most:g}"
        return f"at most {self.at_most:g}" if np.isfinite(self.at_most) else f"at least {self.at_least:g}"


@dataclass(frozen=True)
class Parameter:
    """A parameter's value, and how it was chosen.

    Parameters
    ----------
    value : Any
        Number, text, array, list or mapping.
    chosen : str
        How it was chosen.
    """

    value: Any
    chosen: str


@dataclass(frozen=True)
class StudyReport:
    """Everything that the report says of one study.

    Parameters
    ----------
    name : str
        Lower-case letters, digits and "-", for it names files.
    title, summary : str
        Heading, and a few sentences.
    fs : float
        Sampling frequency in Hz.
    rated_power : float
        Rated output power, a mean square.
    parameters : dict of str to Parameter
        Every parameter by name.
    algorithms : dict of str to dict, optional
        Figures of merit by algorithm: keys out of `MERITS`; None, NaN or left out if undefined.
    extra : dict of str to Any
        Further figures for results.json: numbers, text, arrays, lists and mappings of them.
    claims : list of Claim
        The paper's claims, or the study's own.
    figures : list of FigureItem
        Figures in their order.
    sounds : list of Sound
        Sounds; the first one, the disturbance, sets the level.
    notes : list of str
        Further remarks.
    tables : list of Table
        Further tables in their order.

    Raises
    ------
    ValueError, TypeError
        An unknown figure of merit, two figures or sounds of one stem, or an argument not as described.
    """

    name: str
    title: str
    summary: str
    fs: float
    rated_power: float
    parameters: dict[str, Parameter]
    algorithms: dict[str, dict[str, float | None]] = field(default_factory=dict)
    extra: dict[str, Any] = field(default_factory=dict)
    claims: list[Claim] = field(default_factory=list)
    figures: list[FigureItem] = field(default_factory=list)
    sounds: list[Sound] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)

    def __post_init__(self) -> None:
        for algorithm, figures in self.algorithms.items():
            if unknown := set(figures) - set(MERITS):
                raise ValueError(
                    f"algorithms[{algorithm!r}] holds unknown figures of merit {sorted(unknown)}; "
                    f"known are {', '.join(MERITS)}; further ones belong into extra"
                )
        for items, kind in ((self.figures, "figures"), (self.sounds, "sounds"), (self.all_tables, "tables")):
            require_different((item.stem for item in items), f"{kind} of study {self.name!r}")

    @property
    def all_tables(self) -> list[Table]:
        """The claims, the figures of merit and the further tables, those that have rows."""
        claims = [["holds" if one.holds else "fails", one.value, one.limits, one.text, one.note] for one in self.claims]
        tables = [
            Table("claims", "Claims", ["", "measured", "holds if", "claim", "note"], claims),
            merit_table(self.algorithms, self.rated_power),
            *self.tables,
        ]
        return [table for table in tables if table.rows]

    @property
    def result(self) -> dict[str, Any]:
        """Part of results.json: strict JSON values only, None if undefined."""
        values = {
            "rated_power": self.rated_power,
            "parameters": {name: parameter.value for name, parameter in self.parameters.items()},
            "algorithms": {name: {key: own.get(key) for key in MERITS} for name, own in self.algorithms.items()},
            "claims": [asdict(claim) | {"holds": claim.holds} for claim in self.claims],
            "extra": self.extra,
        }
        return jsonable(values, f"study {self.name!r}")


def claims_sentence(studies: Sequence[StudyReport]) -> str:
    """Return how many claims hold, and in which studies some do not; empty if there are no claims.

    Examples
    --------
    >>> kept, over = Claim("Output power", 1.0, at_most=1.02), Claim("Output power", 1.7, at_most=1.02)
    >>> claims_sentence([StudyReport(name, name, "", 16000, 1.0, {}, claims=[kept, own])
    ...                  for name, own in (("a", kept), ("b", over))])
    '3 of 4 claims hold; failing: 1 of b'
    """
    failed = {study.name: sum(not claim.holds for claim in study.claims) for study in studies}
    total = sum(len(study.claims) for study in studies)
    others = ", ".join(f"{count} of {name}" for name, count in failed.items() if count)
    holding = f"{total - sum(failed.values())} of {total} claims hold" if total else ""
    return f"{holding}; failing: {others}" if others else holding


def require_different(names: Iterable[str], what: str) -> None:
    """Raise ValueError if two names are the same."""
    names = list(names)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{what} must have different names, got {', '.join(twice)} twice")
