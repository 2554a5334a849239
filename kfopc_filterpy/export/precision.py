"""A limiter's numbers in another precision: its margins for rounding are those of the precision."""

from __future__ import annotations

import numpy as np

from ..power.limiter import spans_of

LARGEST_MARGIN = 0.01  # of the rated power, which the limiter keeps free for rounding
SINGLE_FLOOR = 1e-30  # of the budget, as in limiter.c


def in_precision(numbers: np.ndarray, precision: np.dtype) -> None:
    """Change a limiter's record of numbers to those of a precision.

    Raises
    ------
    ValueError
        If the margin for rounding would take too much of the rated power.
    """
    if precision == np.float64:
        return
    epsilon, window = float(np.finfo(precision).eps), int(numbers["size"][0])
    margin = (1.0 - float(numbers["budget"][0])) * epsilon / float(np.finfo(np.float64).eps)
    if margin > LARGEST_MARGIN:
        longest = int(window * LARGEST_MARGIN / margin)
        raise ValueError(
            f"the limiter's window of {window} samples is too long for {precision}, whose rounding errors would take "
            f"{100 * margin:.1f} % of the rated power: at most {longest} samples, or dtype='float64'"
        )
    spans = int(numbers["spans"][0])
    numbers["peak"] = (1.0 - 4.0 * epsilon) / numbers["scale"]
    numbers["budget"] = 1.0 - margin
    for values in (numbers["average"], numbers["loud"], spans_of(numbers)[1:, :spans]):  # held and room
        np.maximum(values, SINGLE_FLOOR, out=values)
