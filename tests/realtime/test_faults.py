"""Bad samples are found, whatever the blocks, and replaced."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from kfopc_filterpy.realtime import Fault, Health
from kfopc_filterpy.realtime.faults import CLIPPED, GOOD, NOT_FINITE, OFFSET, STUCK, Inspector, is_repeated

FS = 8000.0


def inspector(**changed: Any) -> Inspector:
    return Inspector(1, **{"most_equal": 20, "rate": 1.0 / 800, "full_scale": 1.0} | changed)


def noise(n: int = 8000) -> np.ndarray:
    return np.clip(0.2 * np.random.default_rng(0).standard_normal((1, n)), -0.9, 0.9)


def test_sound_is_good_and_stays() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(8000) / FS
    sounds = {
        "white": noise(),
        "faint": 1e-4 * rng.standard_normal((1, 8000)),
        "20 Hz": 0.8 * np.sin(2 * np.pi * 20 * t + 1.0)[np.newaxis],
        "16 bits": np.round(3.0 * rng.standard_normal((1, 8000))) / 32768,  # many equal neighbours
        "impulses": np.where(rng.random((1, 8000)) < 0.01, 0.8, 1e-3 * rng.standard_normal((1, 8000))),
    }
    for name, sound in sounds.items():
        heard = sound.copy()
        kinds = inspector()(heard)
        assert not np.any(kinds), (name, np.unique(kinds))
        np.testing.assert_array_equal(heard, sound)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200])
def test_values_that_are_no_sound_become_zero(value: float) -> None:
    heard = noise()
    heard[0, 100:130] = value
    kinds = inspector()(heard)
    assert np.flatnonzero(kinds[0]).tolist() == list(range(100, 130))
    assert set(kinds[0, 100:130]) == {NOT_FINITE}
    assert not np.any(heard[0, 100:130])


def test_a_stuck_channel_is_found_after_some_samples_and_is_silent() -> None:
    for stuck in (0.0, 0.37):
        heard = noise()
        heard[0, 1000:3000] = stuck
        kinds = inspector()(heard)
        assert set(kinds[0, 1000:1020]) == {GOOD}
        assert set(kinds[0, 1020:3000]) == {STUCK}
        assert not np.any(heard[0, 1020:3000])
        assert not np.any(kinds[0, 3000:])


def test_clipped_samples_are_kept_but_noted() -> None:
    heard = np.clip(6.0 * noise(), -1.0, 1.0)
    sound = heard.copy()
    kinds = inspector()(heard)
    np.testing.assert_array_equal(kinds == CLIPPED, np.abs(sound) == 1.0)
    np.testing.assert_array_equal(heard, sound)
    assert not np.any(inspector(full_scale=np.inf)(np.clip(6.0 * noise(), -1.0, 1.0)))  # not known


def test_an_offset_is_found_and_subtracted() -> None:
    heard = 0.1 * noise()
    heard[0, 2000:] += 0.5
    kinds = inspector()(heard)
    assert not np.any(kinds[0, :2000])
    assert set(kinds[0, 2800:]) == {OFFSET}  # within the averaging time
    assert abs(np.mean(heard[0, 7000:])) < 0.005
    for offset, expected in ((0.0095, False), (0.0105, True)):  # a converter may have a hundredth of full scale
        silent = 1e-4 * noise()
        silent[0] += offset
        assert np.any(inspector()(silent)) == expected


def test_a_repeated_block() -> None:
    block = noise(64)
    assert is_repeated(block.copy(), block)
    assert not is_repeated(block, None)
    assert not is_repeated(block[:, :32], block)
    assert not is_repeated(np.nextafter(block, 1.0), block)
    assert not is_repeated(np.zeros((1, 64)), np.zeros((1, 64)))  # silence tells nothing


def test_the_record_stays_small_and_counts_go_on_whatever_an_exception_says() -> None:
    health = Health()
    for n in range(5000):
        health.note("clipped", "error 0", time_s=float(n), n_samples=2, until_s=n + 0.01)
    assert len(health.events) == 1000
    assert (health.counts["clipped"], health.samples["clipped"]) == (5000, 10000)
    health.note("clipped", "error 1", time_s=4999.005, until_s=4999.1)
    assert repr(health) == "<Health: 5001 clipped>"  # another channel
    for n in range(500):
        health.note(f"diverged: {n} {'x' * 10_000}", f"loudspeaker {n}", time_s=5000.0 + n)
    assert len(pickle.dumps(health)) < 500_000  # 1000 events of up to 200 letters
    assert health.counts["other"] == 401  # a hundred kinds are told apart, "clipped" among them


def test_the_record_joins_events_that_are_close_and_keeps_others_apart() -> None:
    health = Health()
    health.note("clipped", "error 0", time_s=10.0, n_samples=3, until_s=10.2)
    health.note("clipped", "error 0", time_s=10.28, n_samples=4, until_s=10.4)  # 0.08 s after the end: the same event
    (event,) = health.events
    assert event == Fault(10.0, "clipped", "error 0", 7, 10.4)
    health.note("clipped", "error 0", time_s=10.47, n_samples=1, until_s=10.48)  # counted from its new end
    assert (health.counts["clipped"], event.n_samples) == (1, 8)
    health.note("clipped", "error 0", time_s=10.6, until_s=10.61)  # 0.12 s later: another one
    assert (health.counts["clipped"], health.samples["clipped"], len(health.events)) == (2, 9, 2)
    for _ in range(2):  # what has no duration is never joined
        health.note("muted", time_s=11.0)
    assert (health.counts["muted"], health.samples["muted"]) == (2, 2)
    assert health.events[-1] == Fault(11.0, "muted", "", 1, 11.0)
    assert Fault(1.0, "muted").n_samples == 1
