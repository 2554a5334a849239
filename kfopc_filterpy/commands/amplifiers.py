"""A list of amplifiers: which of them are enough, the cheapest of these first."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .inputs import ratings_of
from .options import refuse_unused

if TYPE_CHECKING:
    from ..verdict import Assessment
    from ..verdict.items import Table

COLUMNS = ("name", "watt", "ohm", "price")


class Amplifier(NamedTuple):
    """A line of the list: the rated power in W, the load in ohm that it was measured with, and the price."""

    name: str
    watt: float
    ohm: float
    price: float


def amplifiers_in(path: str) -> list[Amplifier]:
    """Return the amplifiers of a CSV file, by price."""
    from ..signals.content import require_file

    require_file(path)
    lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    delimiter = ";" if ";" in lines[0] else ","
    rows = csv.DictReader(lines, delimiter=delimiter, skipinitialspace=True)
    headings = {
        column: next((one for one in rows.fieldnames or () if one.lower().startswith(column)), "") for column in COLUMNS
    }
    if not all(headings.values()):
        raise ValueError(f"{path} must begin with the headings {', '.join(COLUMNS)}, got {lines[0]!r}")
    found = []
    for row in rows:
        name, *texts = (row[headings[column]] or "" for column in COLUMNS)
        try:
            numbers = [float(text.replace(",", ".") if delimiter == ";" else text) for text in texts]
        except ValueError as error:
            raise ValueError(
                f"{path}, line {rows.line_num}: watt, ohm and price must be numbers, got {texts}"
            ) from error
        found.append(Amplifier(name, *numbers))
    if not found:
        raise ValueError(f"{path} lists no amplifier below its headings")
    return sorted(found, key=lambda one: one.price)


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
        ratings_of(argparse.Namespace(**vars(options) | {"watt": [one.watt], "ohm": [one.ohm]}), n_loudspeakers)
        for one in listed
    ]
    several = n_loudspeakers > 1
    powers = [float(np.min(limits_of(ratings_of_each(one, n_loudspeakers), several).rated_power)) for one in ratings]
    largest = int(np.argmax(powers))
    found = assessed(ratings[largest])
    least = powers[largest] * float(np.max(found.least_rated_power / found.limits.rated_power))
    order = sorted(range(len(listed)), key=lambda k: powers[k] < least)  # stable: by price within each
    for k in order:
        if powers[k] >= least and k != largest:
            found = assessed(ratings[k])
        if found.enough or powers[k] < least:
            break
    spare_db = [round(float(10 * np.log10(power / least)), 1) if least else np.inf for power in powers]
    rows = [[*listed[k], "yes" if powers[k] >= least else "no", spare_db[k]] for k in order]
    headings = ["Amplifier", "Watt", "Ohm", "Price", "Enough", "To spare (dB)"]
    return found, Table("amplifiers", "Amplifiers, the cheapest that is enough first", headings, rows)
