"""What was played belongs to the output: no fault, and nothing that a user does, makes a window louder than the rating."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kfopc_filterpy import LimitedController, OutputLimiter, fx_lms
from kfopc_filterpy.realtime import Supervisor

FS, BLOCK, WINDOW, RATED = 8000.0, 32, 80, 0.5
PATH = np.r_[np.zeros(BLOCK), 0.8, -0.3]


def limiter(rated_power: float = RATED) -> OutputLimiter:
    return OutputLimiter(rated_power, fs=FS, window_s=WINDOW / FS)


class Loud:
    """A user's controller that plays far more than the rating, and fails on rare references."""

    def control_signal(self, reference: float) -> float:
        if reference > 2.6:
            raise RuntimeError("out of order")
        return np.nan if reference < -2.6 else 5.0 * reference

    def update(self, error: float) -> None:
        pass

    def state(self) -> None:
        """It keeps nothing."""

    def restore(self, state: None) -> None:
        pass


MAKERS: dict[str, Any] = {
    "a user's": lambda: LimitedController(Loud(), limiter()),
    "FxLMS": lambda: fx_lms(
        16, PATH, step_size=0.05, limiter=limiter()
    ),  # it diverges, and is often beyond largest_gain
}


def again(supervisor: Supervisor) -> Supervisor:
    with TemporaryDirectory() as folder:
        supervisor.save(Path(folder, "run.npz"))
        return Supervisor.load(Path(folder, "run.npz"), classes=[Loud])


@settings(max_examples=30, deadline=None)
@given(
    events=st.lists(
        st.sampled_from(["", "", "", "mute", "go on", "load", "controller", "limiter", "softer limiter", "lost"]),
        min_size=20,
        max_size=40,
    ),
    seed=st.integers(0, 1000),
)
@pytest.mark.parametrize("name", MAKERS)
def test_no_sample_ends_a_window_above_the_rating(name: str, events: list[str], seed: int) -> None:
    """Of the limiter in force. One of a lower rating may find more than that in its window: until then it plays zeros."""
    supervisor = Supervisor(
        MAKERS[name](),
        fs=FS,
        amplitude_limit=100.0,
        largest_gain=20.0,
        louder_s=None,  # it begins at once
        **{f"{what}_s": 40 / FS for what in ("fade", "pause", "window")},
    )
    rng, played = np.random.default_rng(seed), np.zeros(2 * WINDOW)
    for event in events:
        if event == "mute":
            supervisor.fade_out()
        elif event == "go on":
            supervisor.fade_in()
        elif event == "load":
            supervisor = again(supervisor)
        elif event == "controller":
            supervisor.controller = MAKERS[name]()
        elif event == "limiter":
            supervisor.controller.limiter = limiter()
        elif event == "softer limiter":
            supervisor.controller.limiter = limiter(0.3 * RATED)
        y = supervisor.process(*rng.standard_normal((2, BLOCK)), lost=7 * (event == "lost"))
        played = np.r_[played, y]
        rated = supervisor.controller.limiter.rated_power
        powers = np.convolve(played**2, np.ones(WINDOW))[played.size - BLOCK : played.size] / WINDOW
        # 1e-12: the powers are computed here with some hundred roundings; the limiter keeps a margin for its own.
        assert np.all(powers[y != 0.0] <= rated * (1 + 1e-12)), (event, dict(supervisor.health.counts))
    assert np.any(played) or "mute" in events
