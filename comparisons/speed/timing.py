"""CPU time, the best of some turns: what is compared takes turns in one process.

So what the machine does besides is not counted, and what it slows, it slows alike.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from kfopc_filterpy.verdict.items import aligned

Work = tuple[Callable[[], Any], int]  # runs some samples, and how many

ROUNDS = 20
BUDGET_S = 20.0  # of all rounds; slow works, of which a round takes seconds, have fewer, and two at least
PROBE_SIZE, PROBE_TIMES = 384, 20


def seconds(run: Callable[[], Any]) -> float:
    """Return the CPU time of one call."""
    began = time.process_time()
    run()
    return time.process_time() - began


def microseconds(works: Mapping[str, Work]) -> dict[str, float]:
    """Return the time of a sample of each work: the best of some turns, after one that warms up."""
    best = dict.fromkeys(works, np.inf)
    spent, turn = 0.0, -1
    while turn < 2 or (turn < ROUNDS and spent < BUDGET_S):
        for name, (run, samples) in works.items():
            took = seconds(run)
            spent += took
            best[name] = min(best[name], 1e6 * took / samples) if turn >= 0 else np.inf
        turn += 1
    return best


def dgemm_gflops() -> float:
    """Return the rate of a matrix product, the best of some."""
    a = np.random.default_rng(0).standard_normal((PROBE_SIZE, PROBE_SIZE))
    return max(2e-9 * PROBE_SIZE**3 / seconds(lambda: a @ a) for _ in range(PROBE_TIMES))


def table(title: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """Return rows under a title, numbers with three digits; nothing stands where there is None."""
    cells = [[_shown(cell) for cell in row] for row in rows]
    return "\n".join(aligned([list(title), *cells], left={0}))


def _shown(value: Any) -> str:
    if value is None or isinstance(value, str):
        return value or "-"
    return f"{value:.0f}" if isinstance(value, int) or value >= 100 else f"{value:#.3g}".rstrip(".")
