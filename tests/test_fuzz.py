"""Arguments of any type, shape, size and value: refused with nothing changed, or a finite result; no other outcome.

For a longer search: `FUZZ_SECONDS=180 pytest tests/test_fuzz.py -n0`, which gives each test so many seconds.
"""

from __future__ import annotations

import itertools
import os
import time
import warnings
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from kfopc_filterpy import OutputPowerConstraint, Plant, fx_lms, kf_opc
from kfopc_filterpy.realtime import Supervisor

SECONDS = float(os.environ.get("FUZZ_SECONDS") or "0")
FS = 8000.0
PATH = np.array([0.0, 0.0, 0.8, -0.3])
PATHS = np.random.default_rng(3).standard_normal((2, 2, 4))
LIMIT = 2.0
KALMAN: dict[str, Any] = {"state_noise": 1e-7, "measurement_noise": 1e-2, "initial_variance": 1e-2}
CONTROLLERS: dict[str, Callable[[], Any]] = {
    "FxLMS": lambda: fx_lms(8, PATH, step_size=1e-3),
    "KF-OPC": lambda: kf_opc(8, PATH, constraint=OutputPowerConstraint(0.5, fs=FS), **KALMAN),
    "FxLMS of several channels": lambda: fx_lms(8, PATHS, step_size=1e-3),
}
SCALARS: list[Any] = [
    *(0.0, -0.0, 1.0, -3.5, 5e-324, 1e-160, 1e-30, 1e30, 1e80, 1e154, -1e155, 1e300, np.finfo(float).max),
    *(np.nan, np.inf, -np.inf, 0, 1, True, False, -7, 10**25, 10**400, 1j, 1 + 0j, np.complex128(2.0)),
    *(None, "", "1.0", b"1", "nan", object, {}, {1.0}, (), [], [[]], [1.0], [None]),
    *([[1.0, 2.0], [3.0]], ["x"], range(3)),
    *(Fraction(1, 3), np.float32(2.5), np.float16(6e4), np.longdouble(1.5), np.int8(-3), np.uint64(2**63), slice(3)),
    *(np.bool_(True), np.datetime64("2020-01-01"), np.timedelta64(3, "s"), np.str_("a"), np.void(b"abc"), Ellipsis),
]
DTYPES = ["f8", "f8", "f8", "f4", "f2", "i8", "u1", "bool", "c16", "O", ">f8", "U3", "M8[s]", "longdouble"]


def rounds(few: int) -> Iterator[np.random.Generator]:
    """Give a generator of random numbers for each round: `few` rounds, or `FUZZ_SECONDS` of them from a new seed."""
    if not SECONDS:
        yield from (np.random.default_rng(seed) for seed in range(few))
        return
    end, first = time.monotonic() + SECONDS, time.time_ns() % 2**40
    for seed in itertools.count(first):
        if time.monotonic() > end:
            print(f"{seed - first} rounds in {SECONDS:g} s")
            return
        yield np.random.default_rng(seed)


def anything(rng: np.random.Generator, good: tuple[int, ...]) -> Any:
    """Return an argument: what is wanted, of shape `good`, or nearly that, or something quite different."""
    kind = rng.integers(10)
    if kind < 2:
        return SCALARS[rng.integers(len(SCALARS))]
    shape = good
    if kind < 5:  # another shape
        shape = tuple(int(n) for n in rng.choice([0, 1, 2, 3, 8, 9], size=rng.integers(0, 4)))
    values = rng.standard_normal(shape) * 10.0 ** rng.choice([0.0, 0.0, 0.0, -200.0, -30.0, 30.0, 100.0, 154.0, 300.0])
    if kind in (4, 5, 6) and values.size:
        number = rng.choice([np.nan, np.inf, 1e200, 1e308, -1e154, 0.0, 5e-324])
        values = np.where(rng.random(shape) < 0.2, number, values)
    if kind != 7:
        return values if values.ndim else float(values)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        values = np.asarray(values).astype(DTYPES[rng.integers(len(DTYPES))])
    if rng.random() < 0.3:
        return values.tolist()
    return values[..., ::-1] if values.ndim else values


def refused(call: Callable[[], Any]) -> tuple[Any, Exception | None]:
    """Return what a call gives, and the TypeError or ValueError with a message that it raised instead."""
    try:
        return call(), None
    except (TypeError, ValueError) as error:
        caught = error
    assert str(caught).strip(), repr(caught)
    return None, caught


def magnitude(value: Any) -> float:
    """Return the largest magnitude of an argument; 0 if it is no number, which is refused."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # complex numbers, which are refused
            numbers = np.abs(np.asarray(value, dtype=np.float64))
    except (TypeError, ValueError, OverflowError):
        return 0.0
    return float(np.max(numbers, where=np.isfinite(numbers), initial=0.0))


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_supervisor_is_finite_and_within_its_limit(name: str) -> None:
    for rng in rounds(12):
        times = {"window_s": 0.002, "fade_s": 0.001, "pause_s": 0.002, "louder_s": None}  # it begins at once
        supervisor = Supervisor(CONTROLLERS[name](), fs=FS, amplitude_limit=LIMIT, **times)
        several = supervisor.multichannel
        for _ in range(40):
            n = int(rng.integers(1, 17))
            given = [anything(rng, (channels, n) if several else (n,)) for channels in (1, 2)]
            lost = SCALARS[rng.integers(len(SCALARS))] if rng.random() < 0.1 else 0
            weights, health = supervisor.controller.weights, dict(supervisor.health.samples)
            y, error = refused(lambda: supervisor.process(*given, lost=lost))  # noqa: B023 - called at once
            if error is None:
                assert np.all(np.isfinite(y)), given
                assert np.max(np.abs(y)) <= LIMIT
            else:
                np.testing.assert_array_equal(supervisor.controller.weights, weights)
                assert dict(supervisor.health.samples) == health, (given, lost, error)


def test_a_plant_and_its_changes_are_refused_or_have_finite_paths_and_a_finite_disturbance() -> None:
    for rng in rounds(200):
        n = int(rng.integers(1, 4))
        shapes = {"secondary": (n, 2, 4), "primary": (n, 1, 4), "feedback": (1, 2, 4)}
        given = {name: anything(rng, shape) for name, shape in shapes.items() if rng.random() < 0.7}
        numbers = {"fs": FS, "sensor_noise_std": 0.0, "n_path": None}
        given |= {name: SCALARS[rng.integers(len(SCALARS))] if rng.random() < 0.1 else v for name, v in numbers.items()}
        given |= {"amplifier": SCALARS[rng.integers(len(SCALARS))]} if rng.random() < 0.2 else {}
        plant, error = refused(lambda: Plant(**{"secondary": np.ones((n, 2, 4))} | given))  # noqa: B023 - called at once
        if error is not None:
            continue
        before = repr(plant)
        changes = {name: anything(rng, shape) for name, shape in shapes.items() if rng.random() < 0.5}
        changed, error = refused(lambda: plant.changed_at(1.0, **changes))  # noqa: B023 - called at once
        for one in (plant, *([] if error else [changed.at(2.0)])):
            for paths in (one.secondary, one.primary, one.feedback):
                assert paths is None or (paths.ndim == 3 and np.isfinite(paths).all()), (given, changes)
        assert repr(plant) == before
        x = anything(rng, (1, 20))
        if (
            max(magnitude(x), magnitude(plant.primary), magnitude(x) * magnitude(plant.primary)) < 1e290
        ):  # or sums overflow
            d, error = refused(lambda: plant.disturbance(x))  # noqa: B023 - called at once
            assert error is not None or np.isfinite(d).all(), (given, x)
