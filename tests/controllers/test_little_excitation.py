"""No controller plays louder for what it has heard before: long passages that excite little, and soft beginnings."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
import numpy.lib.recfunctions as rfn
import pytest
from helpers.checkpoints import Room
from helpers.controllers import ALL, IN_BLOCKS, MAKERS
from helpers.loop import FS, S_HAT

from kfopc_filterpy import Plant, fx_nlms, simulate
from kfopc_filterpy.checkpoint import content_of

S = np.r_[0.0, S_HAT]  # for a sample, x' is still what it was before
P = np.array([0.0, 0.0, 0.5, 1.0, -0.4, 0.3, 0.1])
LEVEL, SENSOR_STD, N = 0.3, 1e-3, 4000
IN_PARTS = {name: make for name, make in IN_BLOCKS.items() if name in ("frequency domain", "block LMS")}
EVERY = {name: partial(make, S) for name, make in (MAKERS | IN_PARTS).items()}
EVERY["FxNLMS, slow"] = lambda: fx_nlms(10, S, step_size=0.01)
FORGET = ("KF-ANC", "KF-OPC", "fxRLS", "diagonal KF", "FxNLMS", "leaky", "optimal leaky")
LONG: dict[str, Any] = {
    "silence": np.zeros,
    "tone": lambda n: 0.4 * np.sin(0.3 * np.arange(n)),
    "constant": lambda n: np.full(n, 0.3),
    "soft tone": lambda n: 1e-3 * np.sin(0.3 * np.arange(n)),
    "soft noise": lambda n: 1e-5 * np.random.default_rng(4).standard_normal(n),
}


def white(n: int, seed: int = 0) -> np.ndarray:
    return LEVEL * np.random.default_rng(seed).standard_normal(n)


def played(name: str, x: np.ndarray, sensor_noise_std: float = SENSOR_STD) -> np.ndarray:
    """Return the sizes of the control signal of a run, which must not end early."""
    result = simulate(EVERY[name](), x, Plant(S, P, fs=FS, sensor_noise_std=sensor_noise_std), rng=3)
    assert result.diverged_at_s is None
    return np.abs(result.control_signal)


@cache
def usual(name: str) -> float:
    """Return the loudest control signal of a run of noise alone, in which slow algorithms converge, too."""
    return float(np.max(played(name, white(5 * N), 0.0)))


def require_no_trace(name: str, passage: str, n: int) -> None:
    assert np.max(played(name, np.r_[white(N), LONG[passage](n), white(N, 1)])) < 1.3 * usual(name)


@pytest.mark.parametrize("passage", LONG)
@pytest.mark.parametrize("name", EVERY)
def test_a_passage_that_excites_little_makes_nothing_loud(name: str, passage: str) -> None:
    require_no_trace(name, passage, 10_000)


@pytest.mark.parametrize("passage", ["silence", "tone", "constant"])
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in FORGET else pytest.mark.slow) for name in EVERY]
)
def test_what_forgets_forgets_only_what_is_replaced(name: str, passage: str) -> None:
    """A minute: FxRLS played 25 times as loud after one of digital silence, when it went on forgetting."""
    require_no_trace(name, passage, 500_000)


IN_PYTHON = ("KFOPC", "LimitedController", "FeedbackNeutralizer", "VirtualMicrophones, KalmanObserver")
SILENT = dict.fromkeys(MAKERS, 800_000) | {"frequency domain": 60_000} | dict.fromkeys(IN_PYTHON, 20_000)  # samples


@pytest.mark.parametrize("name", SILENT)
def test_what_decays_in_silence_ends_at_zero(name: str) -> None:
    """Denormal numbers made leaky FxLMS four times slower there."""
    controller = (ALL | MAKERS)[name]()
    x, d = (np.atleast_2d(signal) for signal in Room(controller).heard(slice(None)))
    for gain, n in ((1.0, x.shape[1]), (0.0, SILENT[name])):
        heard = (np.squeeze(gain * np.resize(signal, (len(signal), n))) for signal in (x, d))
        controller.process(*heard)
    with np.load(io.BytesIO(content_of(controller))) as file:
        states = [rfn.structured_to_unstructured(one) if one.dtype.names else one for one in dict(file).values()]
    numbers = np.concatenate([np.abs(np.ravel(one)) for one in states if one.dtype.kind == "f"])
    assert numbers.any()
    assert not np.any((numbers > 0.0) & (numbers < np.finfo(float).tiny))


SOFT: dict[str, Callable[[float], np.ndarray]] = {
    "start": lambda soft: np.r_[np.full(N, soft), np.ones(2 * N)],
    "one sample": lambda soft: np.r_[soft, np.zeros(N), np.ones(2 * N)],
    "fade": lambda soft: np.r_[np.geomspace(soft, 1.0, N), np.ones(2 * N)],
    "middle": lambda soft: np.r_[np.ones(N), np.full(N, soft), np.ones(2 * N)],
}


@pytest.mark.parametrize("kind", SOFT)
@pytest.mark.parametrize("name", EVERY)
def test_a_soft_past_makes_nothing_loud(name: str, kind: str) -> None:
    """The reference is soft, the noise of the microphone is not: FxNLMS learned weights of it that played 2.5e4."""
    for soft in (1e-19, 1e-12, 1e-8, 1e-6, 1e-5, 1e-4, 1e-3):
        gain = SOFT[kind](soft)
        assert np.max(played(name, gain * white(gain.size))) < 1.3 * usual(name), soft
