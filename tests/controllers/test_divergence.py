"""The guard that a path tracker has against an adaptation that makes the noise louder."""

from __future__ import annotations

import numpy as np
import pytest
from kfopc_filterpy.controllers.divergence import LOWEST_GAIN, DivergenceGuard

FRAME, SHARE = 10, 4.0


def guard_after(n_frames: int = 5, disturbance: float = 1.0, reference: float = 2.0) -> DivergenceGuard:
    """Return a guard that has heard a disturbance and a reference of these powers, and no error."""
    guard = DivergenceGuard(1, FRAME, 10.0 * FRAME, SHARE)
    play(guard, n_frames, error=0.0, disturbance=disturbance, reference=reference)
    return guard


def play(
    guard: DivergenceGuard,
    n_frames: int,
    *,
    error: float,
    alone: float | None = None,
    disturbance: float = 1.0,
    reference: float = 2.0,
) -> list[bool]:
    """Let the guard hear signals of constant power, and return for each sample whether the controller could adapt."""
    heard, by_itself, disturbances, references = (
        np.sqrt([power]) for power in (error, error if alone is None else alone, disturbance, reference)
    )
    allowed = []
    for n in range(1, n_frames * FRAME + 1):
        allowed.append(guard.allows(by_itself, references))
        guard.add(heard, by_itself, disturbances, references)
        if n % FRAME == 0:
            guard.end_frame()
    return allowed


def test_nothing_is_expected_before_anything_was_heard() -> None:
    guard = DivergenceGuard(1, FRAME, 10.0 * FRAME, SHARE)
    assert all(play(guard, 1, error=1e6, disturbance=0.0))
    assert guard.gain == 1.0


@pytest.mark.parametrize(("error", "held"), [(3.9, False), (4.1, True)])
def test_an_error_above_the_share_is_too_loud(error: float, held: bool) -> None:
    guard = guard_after()
    play(guard, 1, error=error)
    assert guard.held == held
    assert (guard.gain < 1.0) == held


def test_it_acts_within_a_frame_as_soon_as_the_energy_of_a_frame_is_exceeded() -> None:
    """At ten times the bound, a tenth of the frame has its energy."""
    guard = guard_after()
    allowed = play(guard, 1, error=39.9 * FRAME / 10)
    assert allowed == [True] + [False] * 9
    guard = guard_after()
    loud = np.sqrt([80.0])
    gains = []
    for _ in range(4):
        guard.add(loud, loud, np.ones(1), np.sqrt([2.0]))
        gains.append(guard.gain)
    assert gains == pytest.approx([0.5, 0.25, 40 / 240, 0.125])  # most over energy, 40 / (80 n)
    guard.add(np.array([1e9]), loud, np.ones(1), np.sqrt([2.0]))
    assert guard.gain == LOWEST_GAIN


def test_a_louder_reference_raises_what_is_expected_at_once_and_for_one_frame_more() -> None:
    """The noise of the reference may still be on its way to the microphones."""
    guard = guard_after(n_frames=20)
    loud = {"error": 390.0, "disturbance": 400.0}
    assert all(play(guard, 1, **loud, reference=200.0))
    assert all(play(guard, 1, **loud, reference=2.0))
    assert guard.gain == 1.0
    assert not all(play(guard, 1, **loud, reference=2.0))


def test_what_was_refused_is_not_counted() -> None:
    guard = guard_after()
    for _ in range(100):
        assert guard.allows(np.array([6.0]), np.array([1.0]))  # 36 of 40; nothing is added
    assert guard.gain == 1.0


def test_once_held_the_gain_settles_where_the_error_is_3_dB_below_the_limit() -> None:
    """Of the error, the expected power of 1 is the disturbance; the rest, 40 at full volume, comes from the control."""
    guard = guard_after(n_frames=20)
    play(guard, 1, error=41.0)
    for _ in range(200):
        play(guard, 1, error=1.0 + 40.0 * guard.gain**2, alone=0.1, disturbance=1.0 + 30.0 * guard.gain**2)
        assert guard.held  # although a path that may be wrong says that the error alone is soft
    assert 1.0 < 1.0 + 40.0 * guard.gain**2 < SHARE
    assert guard._expected(np.array([2.0])) == pytest.approx(1.0, abs=0.02)  # nothing is learned from a wrong path


def test_a_hold_ends_at_full_volume_3_dB_below_the_limit() -> None:
    guard = guard_after(n_frames=20)
    play(guard, 1, error=50.0)
    held = []
    while guard.gain < 1.0:
        play(guard, 1, error=1.9)
        held.append(guard.held)
    assert all(held)
    assert len(held) < 50
    play(guard, 1, error=1.9)
    assert not guard.held


@pytest.mark.parametrize("scatter", [0.0, 0.2])
@pytest.mark.parametrize("power", [3.0, 10.0, 100.0, 1e6])
def test_noise_that_becomes_louder_than_the_reference_tells_is_soon_controlled_again(
    power: float, scatter: float
) -> None:
    """Turned down, the control cannot be to blame: what is heard then is the noise. It takes no memory to learn that."""
    guard = guard_after(n_frames=20)
    play(guard, 1, error=50.0)
    assert guard.held
    rng = np.random.default_rng(0)
    n_frames = 0
    while guard.held or guard.gain < 1.0:
        level = power * (1.0 + scatter * rng.standard_normal())
        play(guard, 1, error=level, disturbance=level)
        n_frames += 1
        assert n_frames < 200
    play(guard, 20, error=power, disturbance=power)
    assert not guard.held
    assert guard.gain == 1.0


def test_noise_that_rises_slowly_does_not_keep_it_held() -> None:
    """By a tenth of the memory's rate, so that what is expected is always a little behind."""
    guard = guard_after(n_frames=20)
    play(guard, 1, error=50.0)
    powers = 1.01 ** np.arange(300)
    for power in powers:
        play(guard, 1, error=power, disturbance=power)
    assert not guard.held
    assert guard.gain == 1.0


def test_what_is_heard_while_nothing_is_played_is_nobodys_fault() -> None:
    guard = guard_after(n_frames=20)
    for _ in range(3):
        for _ in range(FRAME):
            guard.follow(np.sqrt([100.0]), np.sqrt([2.0]))
        guard.end_frame()
    assert not guard.held
    assert guard.gain == 1.0
    assert guard._expected(np.array([2.0])) == pytest.approx(100.0)


def test_with_a_new_path_it_may_be_as_loud_as_before_until_it_has_become_softer() -> None:
    guard = guard_after()
    play(guard, 1, error=50.0)
    guard.begin_anew(50.0)
    assert guard.allows(np.array([1.0]), np.sqrt([2.0]))
    assert all(play(guard, 2, error=1.0, alone=90.0))
    assert all(play(guard, 1, error=1.0, alone=1.0))
    assert not all(play(guard, 1, error=1.0, alone=90.0))


@pytest.mark.parametrize(("error", "share"), [(0.0, SHARE), (2.1, 1.0)])
def test_a_wrong_path_raises_what_is_expected_slowly_and_not_at_all_if_in_doubt(error: float, share: float) -> None:
    """The disturbance estimate of a wrong path is loud."""
    guard = guard_after(n_frames=20)
    play(guard, 1, error=error, alone=0.0, disturbance=1e6)
    assert guard._expected(np.array([2.0])) == pytest.approx(1.0 + (share - 1.0) / 10.0)


def test_an_assigned_path_does_not_inherit_what_was_heard_by_the_old_one() -> None:
    guard = guard_after(n_frames=20)
    for _ in range(5):
        guard.add(np.array([1.0]), np.array([100.0]), np.array([1.0]), np.sqrt([2.0]))
    assert not guard.allows(np.array([0.1]), np.sqrt([2.0]))
    guard.begin_anew()
    assert guard.allows(np.array([0.1]), np.sqrt([2.0]))
