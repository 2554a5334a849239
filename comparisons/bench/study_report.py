"""`StudyReport`, everything that the report says of one study: claims, parameters, tables, figures, sounds."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from kfopc_filterpy._writing import jsonable
from kfopc_filterpy.verdict.items import FigureItem, Sound, Table, require_stem

MERIT_COLUMNS = (  # heading, unit, figure of merit and format
    ("noise reduction", "dB", "noise_reduction_db", ".1f"),
    ("output power", "", "output_power", ".5g"),
    ("of rated power", "times", "output_power", ".4g"),
    ("peak control signal", "", "peak_control_signal", ".4g"),
    ("clipped", "%", "clipped_fraction", ".2f"),
    ("harmonics", "dB", "harmonics_db", ".1f"),
    ("converged", "s", "convergence_time_s", ".4g"),
    ("diverged", "s", "diverged_at_s", ".4g"),
)
FIGURES_OF_MERIT = tuple(dict.fromkeys(figure for _, _, figure, _ in MERIT_COLUMNS))
OF_THE_PAPER = "Claims of the paper"


@dataclass(frozen=True)
class Claim:
    """One claim of a study, and what was measured.

    Parameters
    ----------
    text : str
        The claim as a sentence.
    holds : bool
        Whether it holds.
    measured : str
        What was measured, in words.
    """

    text: str
    holds: bool
    measured: str


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
        Figures of merit by algorithm: keys out of `FIGURES_OF_MERIT`; None, NaN or left out if undefined.
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
    claims_heading : str
        What the claims are: "Claims of the paper", which are reproduced or not; all others, such as "Aims", are met or
        not.
    watt_per_power : float, optional
        Power in W of a mean square of 1, if it is known: page and terminal then show output powers in W.

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
    claims_heading: str = OF_THE_PAPER
    watt_per_power: float | None = None

    def __post_init__(self) -> None:
        require_stem(self.name, "name")
        for algorithm, figures in self.algorithms.items():
            if unknown := set(figures) - set(FIGURES_OF_MERIT):
                raise ValueError(
                    f"algorithms[{algorithm!r}] holds unknown figures of merit {sorted(unknown)}; "
                    f"known are {', '.join(FIGURES_OF_MERIT)}; further ones belong into extra"
                )
        for items, kind in ((self.figures, "figures"), (self.sounds, "sounds"), (self.tables, "tables")):
            require_different((item.stem for item in items), f"{kind} of study {self.name!r}")

    @property
    def marks(self) -> tuple[str, str]:
        """Words for a claim that holds, and for one that does not."""
        return ("reproduced", "not reproduced") if self.claims_heading == OF_THE_PAPER else ("met", "not met")

    @property
    def rating(self) -> str:
        """The rated power in words, in W if that is known."""
        if self.watt_per_power is None:
            return f"{self.rated_power:.4g}"
        return f"{self.rated_power * self.watt_per_power:.4g} W"

    @property
    def result(self) -> dict[str, Any]:
        """Part of results.json: strict JSON values only, None if undefined."""
        values = {
            "rated_power": self.rated_power,
            "parameters": {name: parameter.value for name, parameter in self.parameters.items()},
            "algorithms": {
                name: {key: figures.get(key) for key in FIGURES_OF_MERIT} for name, figures in self.algorithms.items()
            },
            "claims": [vars(claim) for claim in self.claims],
            "extra": self.extra,
        }
        return jsonable(values, f"study {self.name!r}")


def merit_table(study: StudyReport) -> tuple[list[tuple[str, str]], list[list[str]]]:
    """Return the headings and units of the figures of merit, and the cells of each algorithm, "-" if there is no figure."""
    watt = study.watt_per_power
    factors = {"output power": watt or 1.0, "of rated power": 1 / study.rated_power, "clipped": 100.0}
    units = {"output power": "" if watt is None else "W"}
    headings = [(heading, units.get(heading, unit)) for heading, unit, *_ in MERIT_COLUMNS]

    def cell(value: float | None, heading: str, form: str) -> str:
        return "-" if value is None else f"{value * factors.get(heading, 1.0):{form}}"

    rows = [
        [cell(jsonable(figures.get(key)), heading, form) for heading, _, key, form in MERIT_COLUMNS]
        for figures in study.algorithms.values()
    ]
    return headings, rows


def require_different(names: Iterable[str], what: str) -> None:
    """Raise ValueError if two names are the same."""
    names = list(names)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{what} must have different names, got {', '.join(twice)} twice")
