"""One bad sample is not the end: what is refused leaves no trace, and what is taken is overcome."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
from helpers.checkpoints import Room
from helpers.controllers import ALL
from hypothesis import given, settings
from hypothesis import strategies as st

from kfopc_filterpy import Plant, fx_nlms, fx_rls, simulate
from kfopc_filterpy.checkpoint import content_of
from kfopc_filterpy.signals import band_limited_noise, tone

LOUD = [-1e160, 1e308]
UNUSABLE = [np.nan, np.inf, *LOUD, "1.0", np.ma.masked, np.datetime64("2020-01-01")]
HUGE = [1e12, -1e24, 1e49]
FS = 8000
S = np.array([0.0, 0.0, 0.0, 0.8, 0.0, -0.2])
P = np.zeros(40)
P[[8, 12, 20]] = 1.0, 0.5, -0.3


def bad_sample(controller: Any, room: Room, half: str, value: Any, samples: int) -> tuple[Any, Exception | None]:
    """Return a copy from before a bad sample, and the error that it raised, if any."""
    room.run(controller, samples)
    sample = room.x[room.n]
    if half == "update":
        room.play(controller)
        sample = room.d[room.n]
    given: Any = np.array(sample, dtype=object)
    if given.ndim:
        given[0] = value
    before = deepcopy(controller)
    try:
        getattr(controller, half)(given if given.ndim else value)
    except (TypeError, ValueError) as error:
        return before, error
    return before, None


@pytest.mark.parametrize("half", ["control_signal", "update"])
@pytest.mark.parametrize("name", ALL)
@settings(max_examples=4, deadline=None)
@given(value=st.sampled_from([*UNUSABLE, *HUGE]), samples=st.integers(0, 60))
def test_a_refused_sample_leaves_the_saved_state_as_it_was(name: str, half: str, value: Any, samples: int) -> None:
    controller = ALL[name]()
    room = Room(controller)
    before, refused = bad_sample(controller, room, half, value, samples)
    if refused is None:
        taken_by_users_own = name == "LimitedController" and value in LOUD
        assert taken_by_users_own or not any(value is one for one in UNUSABLE), "it was taken"
        return
    assert content_of(controller) == content_of(before)
    if half == "update":
        room.n += 1  # the run goes on without it
    room.run(controller, 20)
    assert np.isfinite(controller.weights).all()


@pytest.mark.parametrize("half", ["control_signal", "update"])
@pytest.mark.parametrize("name", [name for name in ALL if name != "FeedbackNeutralizer"])
def test_a_huge_sample_is_overcome(name: str, half: str) -> None:
    """In a closed loop; 1000 samples later nothing is refused, and nothing is infinite.

    This room has no feedback: with the huge weights that FxLMS has learned, what is subtracted for it is an unstable loop.
    """
    for value in HUGE:
        controller = ALL[name]()
        room, refusals = Room(controller), 0
        bad_sample(controller, room, half, value, 60)
        for n in range(1000):
            room.n = n % 300
            try:
                room.run(controller, 1)
            except ValueError:
                refusals = n
        assert refusals < 900, value
        assert np.isfinite(controller.weights).all(), value


# Forgetting, and a normalised step, where little is excited.

NOISES: dict[str, Any] = {
    "white": lambda n: 0.3 * np.random.default_rng(0).standard_normal(n),
    "band": lambda n: band_limited_noise((200.0, 600.0), n / FS, fs=FS, power=0.09, rng=1),
    "tone": lambda n: tone(300.0, n / FS, fs=FS, amplitude=0.4),
}
MAKERS: dict[str, Any] = {
    "FxRLS": lambda: fx_rls(32, S, forgetting=0.999),
    "FxNLMS": lambda: fx_nlms(32, S, step_size=0.1),
}


@pytest.mark.parametrize("quiet", [0.0, 1e-5, 1e-3])
@pytest.mark.parametrize(("name", "noise"), [*(("FxRLS", noise) for noise in NOISES), ("FxNLMS", "white")])
def test_a_quiet_passage_makes_nothing_loud(name: str, noise: str, quiet: float) -> None:
    """10 s of it; before, FxRLS played up to 4e5 afterwards, FxNLMS 49. The paths change then, and it must follow."""
    n = 2 * FS
    x = NOISES[noise](14 * FS)
    x[n:-n] *= quiet
    controller = MAKERS[name]()
    result = simulate(controller, x, Plant(S, P, fs=FS, sensor_noise_std=1e-3), rng=3)
    assert np.max(np.abs(result.control_signal[-n:])) < 1.3 * np.max(np.abs(result.control_signal[:n]))
    after = simulate(controller, NOISES[noise](n), Plant(S, -P, fs=FS))
    assert np.mean(after.error[FS:] ** 2) < 1e-3 * np.mean(after.disturbance[FS:] ** 2)


@pytest.mark.parametrize("noise", NOISES)
def test_a_silent_start_makes_nothing_loud(noise: str) -> None:
    """60 memories of digital silence, in which forgetting alone would raise P by 1e26; then sensor noise comes in, too.

    With P at 1e12 of its start, y peaked at 80 times what it is without the silence; at 1e20, the weights were NaN.
    """
    n, silent = 2 * FS, np.zeros(60_000)
    peaks = []
    for start in (silent, silent[:0]):
        x = np.r_[start, NOISES[noise](n)]
        result = simulate(MAKERS["FxRLS"](), x, Plant(S, P, fs=FS, sensor_noise_std=1e-3), rng=3)
        peaks.append(np.max(np.abs(result.control_signal[-n:])))
        assert np.mean(result.error[-FS:] ** 2) < 1e-3 * np.mean(result.disturbance[-FS:] ** 2)
    assert peaks[0] < 1.3 * peaks[1]


@pytest.mark.parametrize(
    ("name", "scale"), [*((name, scale) for name in MAKERS for scale in (1e-3, 1e3)), ("FxRLS", 1e-5), ("FxNLMS", 1e-8)]
)
def test_defaults_scale_with_the_signal(name: str, scale: float) -> None:
    """FxRLS begins with the variance of a unit signal: for 1e-5, P has to grow by up to 1e6."""
    x = scale * NOISES["white"](6 * FS)
    result = simulate(MAKERS[name](), x, Plant(S, P, fs=FS))
    assert np.mean(result.error[-FS // 2 :] ** 2) < 1e-3 * np.mean(result.disturbance[-FS // 2 :] ** 2)
