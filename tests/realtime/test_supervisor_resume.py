"""Checkpoints of a supervisor: saved between any two blocks, it continues to the bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.checkpoints import assert_same_contents
from helpers.controllers import OwnController

from kfopc_filterpy import fx_lms
from kfopc_filterpy.realtime import Supervisor

FS, BLOCK, BLOCKS = 8000.0, 32, 60
PATH = np.concatenate((np.zeros(BLOCK), [0.8, -0.3]))
PATHS = np.concatenate((np.zeros((2, 2, BLOCK)), np.random.default_rng(2).standard_normal((2, 2, 3))), axis=2)


def supervised(controller: Any, **settings: float) -> Supervisor:
    times = {"window_s": 0.008, "fade_s": 0.01, "pause_s": 0.04, "stuck_s": 0.002, "mute_after_s": 0.03}
    return Supervisor(controller, fs=FS, amplitude_limit=2.0, full_scale=20.0, louder_s=0.016, **times, **settings)


SUPERVISORS: dict[str, Any] = {
    "one channel": lambda: supervised(fx_lms(8, PATH, step_size=1e-3)),
    "diverging, two of each": lambda: supervised(fx_lms(8, PATHS, step_size=3e-4, n_references=2), largest_gain=0.02),
    "a user's": lambda: supervised(OwnController()),
}


def block(supervisor: Supervisor, b: int) -> tuple[Any, Any, int]:
    """Return what is heard in a block: noise with all kinds of faults."""
    shape = (2, BLOCK) if supervisor.multichannel else (BLOCK,)
    x, e = np.random.default_rng(b).standard_normal((2, *shape))
    if b % 9 == 3:
        x[..., 3:5], e[..., 7] = np.nan, 30.0
    if b in (17, 18):
        e[...] = 0.25
    if b >= 45:  # it becomes louder by itself
        e *= 4.0
    return (None if 30 <= b < 42 else x), e, 64 * (b % 13 == 12)


def run(supervisor: Supervisor, begin: int, end: int) -> np.ndarray:
    """Process some blocks, and let the user fade out and in again meanwhile."""
    kept = []
    for b in range(begin, end):
        if b == 50:
            supervisor.fade_out()
        if b == 55:
            supervisor.fade_in()
        x, e, lost = block(supervisor, b)
        kept.append(supervisor.process(x, e, lost=lost))
    return np.array(kept)


@pytest.mark.parametrize("name", SUPERVISORS)
def test_a_supervisor_that_is_saved_between_any_blocks_continues_to_the_bit(name: str, tmp_path: Path) -> None:
    """At every fifth block, what was loaded goes on with five more and with the rest, and the original with all."""
    original, path, ys = SUPERVISORS[name](), tmp_path / "run.npz", []
    states: list[tuple[Supervisor, int]] = []
    for begin in range(0, BLOCKS, 5):
        original.save(path)
        loaded = Supervisor.load(path, classes=[OwnController])
        assert_same_contents(loaded, original)
        states.append((loaded, begin))
        ys.append(run(original, begin, begin + 5))
        np.testing.assert_array_equal(run(loaded, begin, begin + 5), ys[-1])
        assert_same_contents(loaded, original)
    # Something has happened to be remembered.
    happened = {"not finite", "clipped", "stuck", "lost"}
    happened |= {"diverged: weights", "running again"} if "diverging" in name else {"silent: no usable input"}
    assert happened <= set(original.health.counts)
    first, _ = states[0]
    np.testing.assert_array_equal(run(first, 5, BLOCKS), np.concatenate(ys[1:]))
    assert_same_contents(first, original)
