"""KF-OPC with the gain of its constraint repaired: three departures from eq. 11-13, each on its own or together.

Eq. 13 keeps the rated power where the secondary path is flat over the noise and the disturbance can be cancelled
wholly. On other paths the control signal's spectrum is not the reference's, so that

- the gain `G_s` it sees is E[(s^ * y)^2] / E[y^2] and not E[x'^2] / E[x^2]: `OF_CONTROL`;
- whatever is still wrong shows in the output power measured, which can trim the factor: `TRIM_RATE`;
- the filter's memory delays what a factor on the measurement does to y; on the output it acts at once: `AT_OUTPUT`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..kernels.compiling import part
from ..power.constraint import FACTOR, LAST, RATED_POWER, SETTINGS

OF_CONTROL, TRIM_RATE, AT_OUTPUT, TRIM, OUTPUT_GAIN = range(5)
LARGEST_TRIM = math.log(10.0)


class RepairState(NamedTuple):
    """Which repairs, and what they keep."""

    table: np.ndarray  # (5,) flag, trim per sample (0: none), flag; logarithm of the trim, factor at the output


def new_repair(of_control: bool, trim_rate: float, at_output: bool) -> RepairState:
    """State of a filter that has not run."""
    return RepairState(np.array([of_control, trim_rate, at_output, 0.0, 1.0]))


@part(forceinline=True)
def gain_samples(repair, filtered, x, error, d, y):
    """Samples whose powers give G_s: of x' and x (eq. 11), or of s^ * y = d^ - e and y."""
    if repair is None:
        return filtered, x
    if repair.table[OF_CONTROL] == 0.0:
        return filtered, x
    return d - error, y


@part(forceinline=True)
def measurement_factor(repair, factor):
    """What scales the measurement (eq. 9)."""
    if repair is None:
        return factor
    return 1.0 if repair.table[AT_OUTPUT] != 0.0 else trimmed(repair, factor)


@part(forceinline=True)
def trimmed(repair, factor):
    """The factor with the trim, at most 1."""
    return min(factor * math.exp(repair.table[TRIM]), 1.0)


@part(forceinline=True)
def output_gain(repair):
    """What scales the control signal."""
    if repair is None:
        return 1.0
    return repair.table[OUTPUT_GAIN]


@part(forceinline=True)
def advance_repair(repair, constraint, y):
    """Note the factor used, and trim the next one by the power of y: up while it is below the rated, down above.

    At a factor of 1 there is nothing to gain, and the trim does not wind up.
    """
    if repair is not None:
        table, last = repair.table, constraint.table[LAST]
        last[FACTOR] = trimmed(repair, last[FACTOR])
        change = table[TRIM_RATE] * (1.0 - y * y / constraint.table[SETTINGS, RATED_POWER])
        if change < 0.0 or last[FACTOR] < 1.0:
            table[TRIM] = min(max(table[TRIM] + change, -LARGEST_TRIM), LARGEST_TRIM)
        if table[AT_OUTPUT] != 0.0:
            table[OUTPUT_GAIN] = last[FACTOR]
