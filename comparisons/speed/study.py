"""`python -m comparisons speed`: what a sample costs, beside filterpy and others."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from kfopc_filterpy.verdict.runs import one_blas_thread

from . import controllers, estimator
from .timing import Work, dgemm_gflops, microseconds, seconds, table

REAL_TIME_HZ = (16000, 48000)
BLOCK_SAMPLES = 640_000  # 40 s at 16 kHz; 40,000 of the shortest blocks


def estimator_tables() -> str:
    """Return what `predict` and `update` take, beside filterpy's."""
    walks, trackers = [], []
    for taps in estimator.TAPS:
        us = microseconds(works_of(estimator.random_walks(taps)))
        slowest = max(time for name, time in us.items() if name not in ("filterpy", "rated power"))
        walks.append([str(taps), *us.values(), us["filterpy"] / slowest, us["filterpy"] / us["rated power"]])
    title = ["random walk, µs", *us, "times as fast, slowest", "times as fast, rated"]
    every = {f"{n} states, {m} measured": estimator.trackers(n, m) for n, m in estimator.TRACKERS}
    for name, filters in (every | {"IMM of two, 4 states": estimator.banks()}).items():
        us = microseconds(works_of(filters))
        trackers.append([name, *us.values(), us["KFOPC"] / us["filterpy"]])
    general = ["any F and H, µs", "filterpy", "KFOPC", "times its time"]
    return f"{table(title, walks)}\n\n{table(general, trackers)}"


def works_of(filters: dict[str, tuple[Any, estimator.Steps]]) -> dict[str, Work]:
    """Return the work of each filter with its steps."""
    return {name: estimator.stepping(*own) for name, own in filters.items()}


def sample_table() -> str:
    """Return the time of a sample against the taps, and how long 3 L^2 flops take at the rate of a matrix product."""
    makers = controllers.SAMPLES.items()
    us = {taps: microseconds({name: make(taps) for name, make in makers}) for taps in controllers.TAPS}
    rate = dgemm_gflops()
    limit = ["3 L² flops at dgemm's rate", *(3e-3 * taps**2 / rate for taps in controllers.TAPS)]
    rows = [[name, *(us[taps][name] for taps in us)] for name, _ in makers]
    return table(["a sample, µs, by taps", *map(str, us)], [*rows, limit])


def block_table() -> str:
    """Return the times of `process`, and the share of a block's duration that the longest takes."""
    rows = []
    for name in controllers.BLOCK_CONTROLLERS:
        for block in controllers.BLOCKS:
            run = controllers.processing(name, block)
            times = np.array([seconds(run) for _ in range(BLOCK_SAMPLES // block)])
            shares = [f"{times.max() * rate / block:.2f}" for rate in REAL_TIME_HZ]
            rows.append([name, str(block), *(1e6 * np.percentile(times, (50, 99.99, 100))), *shares])
    rates = (f"worst share, {rate // 1000} kHz" for rate in REAL_TIME_HZ)
    return table(["process, a block at a time", "block", "median, µs", "99.99 %", "worst", *rates], rows)


def long_table() -> str:
    """Return the time of a sample of controllers with many taps."""
    us = {
        taps: microseconds({name: controllers.long_block(name, taps) for name in controllers.LONG})
        for taps in controllers.LONG_TAPS
    }
    rows = [[name, *(us[taps][name] for taps in us)] for name in controllers.LONG]
    return table([f"µs a sample, in blocks of {controllers.LONG_BLOCK}", *map(str, us)], rows)


TABLES: dict[str, Callable[[], str]] = {
    "estimator": estimator_tables,
    "samples": sample_table,
    "blocks": block_table,
    "long": long_table,
}


def main(arguments: Sequence[str]) -> int:
    """Print the tables that are named, all by default."""
    parser = argparse.ArgumentParser(prog="python -m comparisons speed", description=__doc__)
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=f"{', '.join(TABLES)}; by default all")
    named = parser.parse_args(arguments).tables or list(TABLES)
    if unknown := [name for name in named if name not in TABLES]:
        parser.error(f"no table called {', '.join(unknown)}; there are {', '.join(TABLES)}")
    with one_blas_thread():
        print(*(TABLES[name]() for name in named), sep="\n\n")
    return 0
