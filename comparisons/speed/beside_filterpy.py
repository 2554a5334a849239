"""`KFOPC` beside filterpy's own filter: predict and update in one process, in turns.

A turn is some steps, so that what a filter needs is in the processor's caches, as in a run of it alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from filterpy.kalman import IMMEstimator, KalmanFilter

from kfopc_filterpy import KFOPC

GENERAL = ((2, 1), (4, 2), (6, 3), (16, 2), (32, 4))  # states, measurements
TAPS = (2, 4, 8, 16, 64, 256)
STEPS_OF_A_TURN = 20
TURNS = 100
TURNS_OF_MANY_TAPS = 10  # filterpy takes milliseconds
LEAST_MANY_TAPS = 128


def tracker(kind: type, states: int, measurements: int) -> Any:
    """Return a filter of positions, velocities and so on, with the positions measured."""
    kf = kind(states, measurements)
    kf.F = np.eye(states) + 0.1 * np.eye(states, k=measurements)
    kf.H = np.eye(measurements, states)
    kf.Q, kf.R = 0.01 * np.eye(states), 0.1 * np.eye(measurements)
    return kf


def steps_of(kf: Any, z: Any, **row: Any) -> Callable[[], None]:
    """Return a function that predicts and updates."""

    def step() -> None:
        kf.predict()
        kf.update(z, **row)

    return step


def after_assignment(kf: Any, z: Any) -> Callable[[], None]:
    """Return a function that assigns another x and P, as a bank of filters does, then predicts and updates."""
    states = [np.full((kf.dim_x, 1), value) for value in (0.0, 1.0)]
    covariances = [value * np.eye(kf.dim_x) for value in (1.0, 2.0)]

    def step() -> None:
        states.reverse()
        covariances.reverse()
        kf.x, kf.P = states[0], covariances[0]
        kf.predict()
        kf.update(z)

    return step


def bank_of(kind: type, z: np.ndarray) -> Callable[[], None]:
    """Return a step of an IMM of two filters."""
    bank = IMMEstimator(
        [tracker(kind, 4, 2) for _ in range(2)], np.array([0.5, 0.5]), np.array([[0.9, 0.1], [0.1, 0.9]])
    )
    return steps_of(bank, z)


def pairs() -> dict[str, tuple[Callable[[], None], Callable[[], None], int]]:
    """Return what is timed: a step of filterpy's, one of ours, and how many turns."""
    rng = np.random.default_rng(0)
    found = {}
    for states, measurements in GENERAL:
        z = rng.standard_normal(measurements)
        theirs, ours = (steps_of(tracker(kind, states, measurements), z) for kind in (KalmanFilter, KFOPC))
        found[f"KFOPC, {states} states, {measurements} measurement(s)"] = theirs, ours, TURNS
    z = rng.standard_normal(2)
    theirs, ours = (after_assignment(tracker(kind, 4, 2), z) for kind in (KalmanFilter, KFOPC))
    found["KFOPC, 4 states, x and P assigned before"] = theirs, ours, TURNS
    found["IMM of two, 4 states"] = bank_of(KalmanFilter, z), bank_of(KFOPC, z), TURNS
    for taps in TAPS:
        row = rng.standard_normal((1, taps))
        general, walk = KalmanFilter(taps, 1), KFOPC.random_walk(taps, state_noise=1e-6, measurement_noise=1.0)
        general.Q *= 1e-6
        turns = TURNS if taps < LEAST_MANY_TAPS else TURNS_OF_MANY_TAPS
        found[f"KFOPC.random_walk, {taps} taps"] = steps_of(general, 1.0, H=row), steps_of(walk, 1.0, H=row), turns
    return found


def times_beside_filterpy() -> list[dict[str, Any]]:
    """Return the median times of a step in µs, filterpy's and ours."""
    rows = []
    for name, (theirs, ours, turns) in pairs().items():
        took = np.zeros((2, turns, STEPS_OF_A_TURN))
        for turn in range(turns):
            for kind, step in enumerate((theirs, ours)):
                for k in range(STEPS_OF_A_TURN):
                    began = time.perf_counter()
                    step()
                    took[kind, turn, k] = time.perf_counter() - began
        their_us, our_us = (1e6 * np.median(took, axis=(1, 2))).tolist()
        rows.append({"what": name, "filterpy_us": their_us, "ours_us": our_us})
    return rows


def table_beside_filterpy(rows: list[dict[str, Any]]) -> str:
    """Return the times for the terminal."""
    title = f"{'predict and update, in turns':42}{'filterpy µs':>12}{'ours µs':>10}{'times its time':>16}{'times as fast':>15}"
    lines = (
        f"{row['what']:42}{row['filterpy_us']:12.1f}{row['ours_us']:10.1f}"
        f"{row['ours_us'] / row['filterpy_us']:16.2f}{row['filterpy_us'] / row['ours_us']:15.2f}"
        for row in rows
    )
    return "\n".join([title, *lines])
