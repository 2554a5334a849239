"""A list of amplifiers: which of them are enough, the cheapest of these first."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .._validate import as_number, as_positive
from .inputs import ratings_of
from .options import refuse_unused

if TYPE_CHECKING:
    from ..verdict import Assessment
    from ..verdict.items import Table

COLUMNS = ("name", "watt", "ohm", "price")


def amplifiers_in(path: str) -> list[list[Any]]:
    """Return the amplifiers of a CSV file by price: name, rated power in W, the load in ohm it was measured with, price."""
    from ..signals.content import require_file

    require_file(path)
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not text: save the list as CSV in UTF-8") from error
    decimal, delimiter = (",", ";") if ";" in next(filter(str.strip, lines), "") else (".", ",")
    reader = csv.reader(lines, delimiter=delimiter)
    rows = (row for row in reader if any(map(str.strip, row)))  # spreadsheets end with rows of empty cells
    headings, places = [cell.strip().lower() for cell in next(rows, [])], []
    for column in COLUMNS:
        if not (there := [i for i, heading in enumerate(headings) if heading.startswith(column)]):
            raise ValueError(
                f"{path} has no column {column!r}: its first line must have the headings {', '.join(COLUMNS)}"
            )
        places.append(there[0])

    def amplifier(row: list[str]) -> list[Any]:
        where = f"{path}, line {reader.line_num}"
        is_split = decimal == "." and any(map(str.strip, row[len(headings) :]))  # 1,5 has become two cells
        if is_split or len(row) <= max(places):
            raise ValueError(f"{where} must have {len(headings)} cells, as the headings, got {len(row)}")
        name, *cells = (row[place].strip() for place in places)
        numbers = []
        for column, cell in zip(COLUMNS[1:], cells, strict=True):
            try:
                number = float(cell.replace(decimal, "."))
            except ValueError as error:
                raise ValueError(f"{where}: {column} is {cell!r}, not a number") from error
            numbers.append((as_number if column == "price" else as_positive)(number, f"{where}: {column}"))
        return [name, *numbers]

    found = [amplifier(row) for row in rows]
    if not found:
        raise ValueError(f"{path} lists no amplifier below its headings")
    return sorted(found, key=lambda one: one[3])


def cheapest_enough(
    options: argparse.Namespace, n_loudspeakers: int, assessed: Callable[[Any], Assessment]
) -> tuple[Assessment, Table]:
    """Return the verdict on the cheapest amplifier that is enough, and a table of all; if none is, on the largest.

    The least power that is enough comes from the verdict on the largest.
    """
    from ..verdict.items import Table
    from ..verdict.limits import limits_of, ratings_of_each

    refuse_unused(options, ("watt", "ohm", "peak_volts", "rated_power"), ": --amplifiers has a column for it")
    listed = amplifiers_in(options.amplifiers)
    ratings = [
        ratings_of(argparse.Namespace(**vars(options) | {"watt": [watt], "ohm": [ohm]}), n_loudspeakers)
        for _, watt, ohm, _ in listed
    ]
    limits = [limits_of(ratings_of_each(one, n_loudspeakers), n_loudspeakers > 1) for one in ratings]
    powers = [float(np.min(one.rated_power)) for one in limits]
    largest = int(np.argmax(powers))
    found = first = assessed(ratings[largest])
    least = powers[largest] * float(np.max(first.least_rated_power / first.limits.rated_power))
    order = sorted(range(len(listed)), key=lambda k: powers[k] < least)  # stable: by price within each
    for k in order[: sum(power >= least for power in powers)]:
        found = first if k == largest else assessed(ratings[k])
        if found.enough:
            break
    spare_db = [round(float(10 * np.log10(power / least)), 1) if least else np.inf for power in powers]
    rows = [[*listed[k], "yes" if powers[k] >= least else "no", spare_db[k]] for k in order]
    headings = ["Amplifier", "Watt", "Ohm", "Price", "Enough", "Power to spare (dB)"]
    return found, Table("amplifiers", "Amplifiers, the cheapest that is enough first", headings, rows)
