"""`KFOPC` beside filterpy's own filter: `predict` and `update`, on the inputs that users have.

A measurement comes from a loop over an array (an np.float64), from a reading of one element, or as a Python float; a row
of H is a view of the reference, (L,), or what filterpy asks for, (1, L). filterpy gets np.float64 and (1, L), its fastest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from filterpy.kalman import IMMEstimator, KalmanFilter
from numpy.lib.stride_tricks import sliding_window_view

from kfopc_filterpy import KFOPC

from .timing import Work

Steps = Sequence[tuple[Any, Mapping[str, Any]]]  # of each step: z, and the options of `update`

TAPS = (2, 16, 64, 128, 256, 512)
TRACKERS = ((2, 1), (4, 2), (6, 3), (16, 2), (32, 4))  # states, measurements
Z: dict[str, Callable[[float], Any]] = {
    "float": float,
    "np.float64": np.float64,
    "0-d": np.array,
    "(1,)": np.atleast_1d,
}
STATE_NOISE, MEASUREMENT_NOISE, INITIAL_VARIANCE = 1e-8, 1.0, 1e-3  # S stays near q, as in a run past its start
RATED_POWER = 0.1  # below the power of the output, so that the constraint acts
STEPS = 50  # of a turn; fewer if filterpy's take milliseconds, which goes with L^3
FLOPS_OF_A_TURN = 2e8


def stepping(kf: Any, steps: Steps) -> Work:
    """Return the work of predicting and updating with each of some measurements."""

    def run() -> None:
        for z, options in steps:
            kf.predict()
            kf.update(z, **options)

    return run, len(steps)


def random_walks(taps: int) -> dict[str, tuple[Any, Steps]]:
    """Return filterpy's filter and ours for each kind of input, with steps of equal numbers."""
    rng = np.random.default_rng(0)
    rows = sliding_window_view(rng.standard_normal(STEPS + taps - 1), taps)
    z = rng.standard_normal(STEPS)
    general = KalmanFilter(taps, 1)
    general.P, general.Q = INITIAL_VARIANCE * np.eye(taps), STATE_NOISE * np.eye(taps)
    general.R = np.array([[MEASUREMENT_NOISE]])

    def walk(**options: Any) -> KFOPC:
        noises: dict[str, Any] = {"state_noise": STATE_NOISE, "measurement_noise": MEASUREMENT_NOISE}
        return KFOPC.random_walk(taps, **noises, initial_variance=INITIAL_VARIANCE, **options)

    flat, matrix = [{"H": row} for row in rows], [{"H": row[None]} for row in rows]
    few = int(np.clip(FLOPS_OF_A_TURN / taps**3, 3, STEPS))
    filters: dict[str, tuple[Any, Steps]] = {"filterpy": (general, list(zip(z, matrix, strict=True))[:few])}
    for kind, of_kind in Z.items():
        filters[kind] = walk(), [(of_kind(value), row) for value, row in zip(z, flat, strict=True)]
    filters["row (1, L)"] = walk(), list(zip(z, matrix, strict=True))
    rated = [(value, {"H": row, "reference": row[0]}) for value, row in zip(z, rows, strict=True)]
    filters["rated power"] = walk(rated_power=RATED_POWER, fs=16000), rated
    return filters


def trackers(states: int, measurements: int) -> dict[str, tuple[Any, Steps]]:
    """Return filterpy's filter and ours of positions, velocities and so on, with the positions measured."""
    z = np.random.default_rng(0).standard_normal((STEPS, measurements))
    return {
        name: (tracker(kind, states, measurements), [(row, {}) for row in z])
        for name, kind in (("filterpy", KalmanFilter), ("KFOPC", KFOPC))
    }


def tracker(kind: type, states: int, measurements: int) -> Any:
    """Return a filter of a class."""
    kf = kind(states, measurements)
    kf.F = np.eye(states) + 0.1 * np.eye(states, k=measurements)
    kf.H = np.eye(measurements, states)
    kf.Q, kf.R = 0.01 * np.eye(states), 0.1 * np.eye(measurements)
    return kf


def banks() -> dict[str, tuple[Any, Steps]]:
    """Return an IMM of two of filterpy's filters, and one of ours: it assigns x and P in each step."""
    likely, change = np.array([0.5, 0.5]), np.array([[0.9, 0.1], [0.1, 0.9]])
    return {
        name: (IMMEstimator([tracker(kind, 4, 2) for _ in range(2)], likely, change), trackers(4, 2)[name][1])
        for name, kind in (("filterpy", KalmanFilter), ("KFOPC", KFOPC))
    }
