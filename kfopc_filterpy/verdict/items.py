"""What a page shows, and writes as files beside it: tables, figures, sounds."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .._writing import made_folder, write_whole
from ..plot import save_figure
from ..signals import write_wav

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEADROOM = 4.0  # peak of a sound, over that of the first sound, beyond which it is clipped
EXCERPT_S = 4.0  # what a page plays of a sound; the file has all of it


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
    """

    stem: str
    caption: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str | float]]

    @property
    def cells(self) -> list[list[str]]:
        """Cells as they are shown."""
        return [[_shown(cell) for cell in row] for row in self.rows]

    @property
    def numbers(self) -> set[int]:
        """Columns with a number in them."""
        return {i for row in self.rows for i, cell in enumerate(row) if not isinstance(cell, str)}

    @property
    def lines(self) -> list[str]:
        """The table for a terminal, without its caption."""
        return aligned([self.headings, *self.cells], set(range(len(self.headings))) - self.numbers)


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

        plt.close(self.figure)


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
    """

    stem: str
    label: str
    signal: np.ndarray
    group: str = ""
    from_s: float = 0.0

    def excerpt(self, signal: np.ndarray, fs: float) -> np.ndarray:
        """Return the part of a signal at a rate `fs` that the page plays: 4 s, or what there is of them."""
        first = round(self.from_s * fs)
        return signal[first : first + round(EXCERPT_S * fs)]


def aligned(rows: Sequence[Sequence[str]], left: set[int]) -> list[str]:
    """Return lines of cells in columns; the columns `left` are aligned to the left."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    sides = ["<" if i in left else ">" for i in range(len(widths))]
    line = "  ".join(f"{{:{side}{width}}}" for side, width in zip(sides, widths, strict=True))
    return [line.format(*row).rstrip() for row in rows]


def file_of(folder: Path, name: str, item: FigureItem | Sound | Table) -> Path:
    """Return the path of a sound, of a table, or of a figure, that one without its suffix; it begins with a `name`."""
    kind, suffix = {FigureItem: ("figures", ""), Sound: ("audio", ".wav"), Table: ("tables", ".csv")}[type(item)]
    return folder / kind / f"{name}-{item.stem}{suffix}"


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


def write_files(
    folder: Path,
    name: str,
    *,
    fs: float,
    figures: Sequence[FigureItem] = (),
    sounds: Sequence[Sound] = (),
    tables: Sequence[Table] = (),
) -> None:
    """Write figures/, audio/ and, if there are any, tables/ into a folder; all files begin with a `name`."""
    for kind in ("figures", "audio"):
        made_folder(folder / kind)
    for item in figures:
        save_figure(item.figure, file_of(folder, name, item))
    signals, full_scale = loudness(sound.signal for sound in sounds)
    for sound, signal in zip(sounds, signals, strict=True):
        write_wav(file_of(folder, name, sound), signal, fs, peak=full_scale)
    for table in tables:
        made_folder(folder / "tables")
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([table.headings, *table.rows])
        write_whole(file_of(folder, name, table), text.getvalue())
