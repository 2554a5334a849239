"""`StudyReport`, everything that the report says of one study: claims, parameters, tables, figures, sounds."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
HEADROOM = 4.0  # peak of a sound, over that of the study's first sound, beyond which it is clipped
SINCE_SWITCH_ON = "Time since switch-on (s)"
SWITCHED_ON = "The control is switched on {:g} s into the recording."
EXCERPT_S = 4.0  # what the page plays of a sound; the file has all of it


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


def _shown(cell: str | float) -> str:
    if isinstance(cell, str):
        return cell
    return "–" if np.isnan(cell) else f"{cell:.4g}"


@dataclass(frozen=True)
class Table:
    """A table of text and numbers: page and terminal show four digits, the file all of them.

    Parameters
    ----------
    stem : str
        End of the file's name.
    caption : str
        Caption.
    headings : sequence of str
        Headings of the columns.
    rows : sequence of sequence
        Rows of cells, each a text or a number.

    Raises
    ------
    ValueError
        A row has another number of cells than there are headings, or the stem cannot name a file.
    """

    stem: str
    caption: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str | float]]

    def __post_init__(self) -> None:
        _require_stem(self.stem, "stem")
        for row in self.rows:
            if len(row) != len(self.headings):
                raise ValueError(f"rows must have {len(self.headings)} cells, as there are headings, got {row}")

    @property
    def cells(self) -> list[list[str]]:
        """Cells as they are shown."""
        return [[_shown(cell) for cell in row] for row in self.rows]

    @property
    def numbers(self) -> set[int]:
        """Columns with a number in them."""
        return {i for row in self.rows for i, cell in enumerate(row) if not isinstance(cell, str)}


@dataclass(frozen=True)
class FigureItem:
    """A figure with its caption. pyplot is made to forget it, since a report holds many.

    Parameters
    ----------
    stem : str
        End of the names of its files.
    caption : str
        Caption.
    figure : matplotlib.figure.Figure
        The figure.
    """

    stem: str
    caption: str
    figure: Figure

    def __post_init__(self) -> None:
        import matplotlib.pyplot as plt

        _require_stem(self.stem, "stem")
        plt.close(self.figure)

    @property
    def alt(self) -> str:
        """What is drawn, in words: the axes and the names of the curves."""
        names = dict.fromkeys(
            text for ax in self.figure.axes for text in ax.get_legend_handles_labels()[1] if not text.startswith("_")
        )
        drawn = dict.fromkeys(filter(None, (_axes_in_words(ax, self.figure.axes) for ax in self.figure.axes)))
        curves = f". Curves: {'; '.join(names)}." if names else "."
        text = f"Plot of {'; '.join(drawn)}{curves}" if drawn else ""
        return re.sub(r"[${}\\]|\\mathrm", "", text)  # the marks of matplotlib's formulas


def _axes_in_words(ax: Axes, others: Sequence[Axes]) -> str:
    """Return an axes' labels; one that shares its time or frequency axis has the label of the lowest."""
    below = next((own.get_xlabel() for own in [ax, *others] if own.get_xlabel()), "")
    words = [ax.get_ylabel(), below] if ax.get_ylabel() else []
    return " over ".join(" ".join(word.split()) for word in words if word)


@dataclass(frozen=True)
class Sound:
    """A sound with its label.

    Parameters
    ----------
    stem : str
        End of its file's name.
    label : str
        Label.
    signal : ndarray, shape (n_samples,)
        The sound; NaN at its end if the run diverged.
    group : str, default ""
        Sounds of one group are of one moment, so that the page switches between them while they play. The first one is
        the noise without control.
    from_s : float, default 0.0
        Where the excerpt begins that the page plays, in s.

    Raises
    ------
    ValueError
        The stem cannot name a file, or the excerpt begins before the sound.
    """

    stem: str
    label: str
    signal: np.ndarray
    group: str = ""
    from_s: float = 0.0

    def __post_init__(self) -> None:
        _require_stem(self.stem, "stem")
        if not self.from_s >= 0:
            raise ValueError(f"from_s must be a time in s from 0 on, got {self.from_s}")

    def excerpt(self, signal: np.ndarray, fs: float) -> np.ndarray:
        """Return the part of a signal, of `fs` samples per second, that the page plays: 4 s, or what there is of them."""
        first = round(self.from_s * fs)
        return signal[first : first + round(EXCERPT_S * fs)]


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
        _require_stem(self.name, "name")
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


def jsonable(value: object, where: str = "value") -> Any:
    """Return `value` in strict JSON's types: arrays as lists, numpy's scalars as numbers, NaN and Inf as None.

    Examples
    --------
    >>> import numpy as np
    >>> jsonable({"power": np.float64(0.8), "taps": np.array([1.0, np.nan])})
    {'power': 0.8, 'taps': [1.0, None]}
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): jsonable(item, f"{where}, {key!r}") for key, item in value.items()}
    if isinstance(value, list | tuple | range):
        return [jsonable(item, where) for item in value]
    raise TypeError(f"{where} must hold numbers, text, arrays, lists or mappings, got {type(value).__name__}")


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


def file_of(folder: Path, study: StudyReport, item: FigureItem | Sound | Table) -> Path:
    """Return the path of a sound, of a table, or of a figure, that one without its suffix."""
    kind, suffix = {FigureItem: ("figures", ""), Sound: ("audio", ".wav"), Table: ("tables", ".csv")}[type(item)]
    return folder / kind / f"{study.name}-{item.stem}{suffix}"


def loudness(signals: Iterable[np.ndarray]) -> tuple[list[np.ndarray], float]:
    """Return the signals, clipped at full scale, and full scale, which is one peak for all of them.

    It is the peak of the loudest, but at most 4 times that of the first: a run that diverges would silence the rest.
    """
    signals = [np.asarray(signal, dtype=np.float64) for signal in signals]
    peaks = [float(np.max(np.abs(signal), initial=0.0, where=~np.isnan(signal))) for signal in signals]
    if not any(peaks):
        return signals, 1.0
    full_scale = min(max(peaks), HEADROOM * peaks[0]) if peaks[0] > 0 else max(peaks)
    return [np.clip(signal, -full_scale, full_scale) for signal in signals], full_scale


def _require_stem(name: str, argument: str) -> None:
    if not isinstance(name, str) or not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", name):
        raise ValueError(f"{argument} must be lower-case letters, digits and '-', for it names files, got {name!r}")


def require_different(names: Iterable[str], what: str) -> None:
    """Raise ValueError if two names are the same."""
    names = list(names)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{what} must have different names, got {', '.join(twice)} twice")
