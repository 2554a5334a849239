"""How the largest weight of a control filter grows over a run: without bound, or not at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kfopc_filterpy import SimulationResult


@dataclass(frozen=True)
class Growth:
    """How the largest weight of a control filter grew, as ratios."""

    over_optimal: float  # at the end, over the largest weight of the Wiener solution
    over_half: float  # at the end, over that at half of the run
    of_quarters: float  # growth in the last quarter, over that in the second: 1 on a straight line


def growth_of(result: SimulationResult, optimal_weight: float) -> Growth:
    """Return how the largest weight of a run grew."""
    assert result.weights is not None
    largest = np.abs(result.weights).max(axis=1)
    quarter, half, three, end = (float(largest[k * (largest.size - 1) // 4]) for k in (1, 2, 3, 4))
    gained = (end - three) / (half - quarter) if half != quarter else np.inf
    return Growth(end / optimal_weight, end / half, gained)
