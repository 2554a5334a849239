"""The guard that a path tracker has against an adaptation that makes the noise louder."""

from __future__ import annotations

import numpy as np
import pytest

from kfopc_filterpy.controllers.divergence import DivergenceGuard

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


def test_it_is_held_until_the_error_at_full_volume_would_be_3_dB_below_the_limit() -> None:
    """Of the error, the expected power of 1 is the disturbance; the rest grows with the square of the gain."""
    guard = guard_after(n_frames=20)
    play(guard, 1, error=50.0)
    gain = guard.gain
    assert not any(play(guard, 3, error=1.0 + 1.1 * gain**2))
    assert guard.gain == gain
    play(guard, 1, error=1.0 + 0.9 * gain**2)
    assert not guard.held


def test_a_path_that_may_be_wrong_does_not_end_the_hold() -> None:
    """With the wrong sign, the error at full volume seems to fall as the gain does."""
    guard = guard_after(n_frames=20)
    play(guard, 1, error=50.0)
    assert not any(play(guard, 3, error=3.9, alone=0.1))


def test_noise_that_becomes_louder_than_the_reference_tells_is_controlled_again_after_the_memory() -> None:
    guard = guard_after(n_frames=20)
    play(guard, 1, error=100.0, disturbance=100.0)
    assert guard.held
    # 5 memories: by a factor of 1.3 a frame at most, then exponentially
    for power in np.random.default_rng(0).chisquare(20, 50) * 5.0:
        play(guard, 1, error=power, disturbance=power)
    assert not guard.held
    play(guard, 10, error=1.0, disturbance=100.0)
    assert guard.gain == 1.0


def test_the_gain_comes_back_by_6_dB_in_a_frame_once_the_error_alone_is_soft() -> None:
    guard = guard_after(n_frames=20)
    play(guard, 1, error=50.0)
    lowest = guard.gain
    gains = []
    for _ in range(8):
        play(guard, 1, error=0.1)
        gains.append(guard.gain)
    assert gains == pytest.approx([min(lowest * 2.0**n, 1.0) for n in range(1, 9)])


def test_with_a_new_path_it_may_be_as_loud_as_before_until_it_has_become_softer() -> None:
    guard = guard_after()
    play(guard, 1, error=50.0)
    guard.begin_anew(50.0)
    assert all(play(guard, 2, error=1.0, alone=90.0))
    assert all(play(guard, 1, error=1.0, alone=1.0))
    assert not all(play(guard, 1, error=1.0, alone=90.0))


def test_a_wrong_path_does_not_raise_what_is_expected_faster_than_the_memory() -> None:
    """The disturbance estimate of a wrong path is loud, but a frame does not count more than the share."""
    guard = guard_after(n_frames=20)
    play(guard, 1, error=0.0, disturbance=1e6)
    assert guard._expected(np.array([2.0])) == pytest.approx(1.0 + (SHARE - 1.0) / 10.0)
