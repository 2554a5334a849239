"""KF-PB against its law in numpy.

Both do the same operations in other orders, so they differ by rounding, which the solutions enlarge: by 1e-9 of the signal's
rms at most where nothing is decided. A decision, such as Newton's stop, could fall otherwise by a rounding error; in these
cases none does, so 1e-6 leaves room for other machines.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from oracles.limiter import Limiter
from oracles.power_budget import PowerBudget
from oracles.signals import hard_clip, push

from kfopc_filterpy import HardClipAmplifier, OutputLimiter, Plant, kf_pb, simulate

FS, RATE = 2000.0, 1e-6
# Of the control signal: once filters have converged, rounding is all that steps go on with, and equations as badly
# conditioned as those of band noise (REGULAR) make it up to 1e7 times as large.
PLAYED = 3e-5


def paths(rng: np.random.Generator, K: int, J: int, taps: int) -> np.ndarray:
    """Return random paths with a delay of three samples, which fade over their length."""
    s = rng.standard_normal((K, J, taps)) * np.exp(-np.arange(taps) / (0.2 * taps))
    s[..., :3] = 0.0
    return s / np.sqrt(np.sum(s**2, axis=2, keepdims=True))


def coloured(rng: np.random.Generator, channels: int, n: int) -> np.ndarray:
    """Return noise that a short filter colours."""
    white = rng.standard_normal((channels, n + 3))
    return white[:, 3:] + 0.6 * white[:, 2:-1] - 0.3 * white[:, 1:-2] + 0.2 * white[:, :-3]


def scene(seed: int, K: int, J: int, references: int, seconds: float, M: int = 16):
    """Return paths, references and disturbances."""
    rng = np.random.default_rng(seed)
    n = round(seconds * FS)
    x = coloured(rng, references, n)
    primary = paths(rng, K, references, 28)
    d = sum(np.array([np.convolve(primary[k, i], x[i])[:n] for k in range(K)]) for i in range(references))
    return paths(rng, K, J, M), x, d + 0.03 * rng.standard_normal((K, n)), rng


def pair(
    s: np.ndarray,
    taps: int,
    references: int,
    rated_power: np.ndarray,
    spread: float,
    *,
    theirs: dict[str, Any] | None = None,
    **ours: Any,
) -> tuple[PowerBudget, Any]:
    """Return oracle and controller with the same settings."""
    common: dict[str, Any] = {"rated_power": rated_power, "fs": FS, "averaging_s": 2.0, "n_references": references}
    oracle = PowerBudget(s_hat=s, n_taps=taps, spread=spread, **common, **theirs or {})
    if rated_power.size == references == 1:
        common["rated_power"] = float(rated_power[0])
    return oracle, kf_pb(taps, s, secondary_path_uncertainty=spread or None, **common, **ours)


def played(
    one: Any, x: np.ndarray, d: np.ndarray, true: Callable[[int], np.ndarray], on: int, heard: np.ndarray
) -> np.ndarray:
    """Return the control signals, (n, J), over references (I, n) and disturbances (K, n), with a true path of each sample."""
    line, ys = np.zeros(true(0).shape[1:]), []
    for n in range(on, x.shape[1]):
        ys.append(np.atleast_1d(one.control_signal(x[:, n])))
        push(line, ys[-1])
        if heard[n]:
            one.update(d[:, n] - np.einsum("kjm,jm->k", true(n), line))
        elif isinstance(one, PowerBudget):
            one.adapt(np.full(d.shape[0], np.nan))
    return np.array(ys)


def compare(
    oracle: PowerBudget,
    controller: Any,
    x: np.ndarray,
    d: np.ndarray,
    true: Callable[[int], np.ndarray],
    *,
    on: int = 0,
    heard: np.ndarray | None = None,
) -> None:
    """Run both and compare what they play, and what they have learned."""
    for n in range(on):
        oracle.listen(x[:, n], d[:, n])
    if on:
        controller.listen(x[:, :on], d[:, :on])
    heard = np.ones(x.shape[1], bool) if heard is None else heard
    theirs, ours = (played(one, x, d, true, on, heard) for one in (oracle, controller))
    scale = np.sqrt(np.mean(theirs**2))
    assert scale > 1e-3, "nothing was played"
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=PLAYED * scale)
    np.testing.assert_allclose(controller.power_weight, oracle.price, rtol=RATE, atol=RATE * np.max(oracle.price))
    np.testing.assert_allclose(controller.measurement_noise, oracle.plant.q, rtol=1e-5)
    p, s = (paths[: oracle.plant.K] for paths in oracle.plant.paths())
    for got, expected in ((controller.primary_path, p), (controller.identified_path, s)):
        np.testing.assert_allclose(
            np.reshape(got, expected.shape), expected, rtol=1e-5, atol=RATE * np.max(np.abs(expected))
        )
    assert controller.alarms == oracle.plant.surprises


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_one_channel(spread: float) -> None:
    s, x, d, rng = scene(1, 1, 1, 1, 8.0)
    estimated = s if spread == 0 else s + 0.05 * rng.standard_normal(s.shape)
    oracle, controller = pair(estimated, 24, 1, np.array([0.25 * np.mean(d**2)]), spread)
    compare(oracle, controller, x, d, lambda n: s)
    assert np.mean(oracle.book) > 0.5


def test_a_path_that_flips_its_polarity() -> None:
    s, x, d, _ = scene(2, 1, 1, 1, 12.0)
    oracle, controller = pair(s, 24, 1, np.array([0.25 * np.mean(d**2)]), 0.3)
    compare(oracle, controller, x, d, lambda n: s if n < 6.0 * FS else -s)
    assert oracle.plant.surprises


def test_a_block_that_is_shorter_than_the_paths_after_a_surprise() -> None:
    s, x, d, _ = scene(1, 1, 1, 1, 5.0, M=60)
    oracle, controller = pair(s, 90, 1, np.array([0.25 * np.mean(d**2)]), 0.3)
    compare(oracle, controller, x, d, lambda n: s if n < 4.0 * FS else np.roll(s, 1))
    assert oracle.plant.surprises > 1


@pytest.mark.parametrize("at", [340, 1137, 2037])
@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_a_change_within_a_block_while_little_is_known(spread: float, at: int) -> None:
    """With an exact path, of the primary one."""
    s, x, d, _ = scene(11, 1, 1, 1, 2.5, M=40)
    later = s if spread == 0 else -s
    if spread == 0:
        d[:, at:] *= -1.0
    oracle, controller = pair(s, 60, 1, np.array([0.25 * np.mean(d**2)]), spread)
    compare(oracle, controller, x, d, lambda n: s if n < at else later)
    assert oracle.plant.surprises or at == 340


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_a_primary_path_that_flips_its_polarity(spread: float) -> None:
    s, x, d, _ = scene(2, 1, 1, 1, 12.0)
    d[:, round(6.0 * FS) :] *= -1.0
    oracle, controller = pair(s, 24, 1, np.array([0.25 * np.mean(d**2)]), spread)
    compare(oracle, controller, x, d, lambda n: s)
    assert oracle.plant.surprises >= 1


@pytest.mark.parametrize(("K", "J", "references"), [(2, 2, 2), (3, 2, 1), (9, 1, 1), (1, 3, 1), (2, 1, 3)])
def test_several_channels(K: int, J: int, references: int) -> None:
    """Nine microphones are more than a solution takes at once."""
    s, x, d, _ = scene(4, K, J, references, 3.0)
    oracle, controller = pair(s, 9, references, np.linspace(0.25, 0.1, J) * np.mean(d**2), 0.3)
    compare(oracle, controller, x, d, lambda n: s)


def test_a_path_of_hundreds_of_taps() -> None:
    s, x, d, _ = scene(9, 1, 1, 1, 2.5, M=400)
    oracle, controller = pair(s, 200, 1, np.array([0.25 * np.mean(d**2)]), 0.3)
    compare(oracle, controller, x, d, lambda n: s)


def test_missing_errors_after_silence() -> None:
    """The control comes on in the middle of a block, and some blocks are not heard."""
    s, x, d, rng = scene(5, 1, 1, 1, 6.0)
    heard = np.ones(x.shape[1], bool)
    heard[rng.integers(0, heard.size, 12)] = False
    heard[5000:5600] = False
    oracle, controller = pair(s, 24, 1, np.array([0.25 * np.mean(d**2)]), 0.3)
    compare(oracle, controller, x, d, lambda n: s, on=1501, heard=heard)


def test_a_reference_that_sets_in_after_silence() -> None:
    """It is cut like a click until its peak has grown, and finds an account that is full."""
    s, x, d, rng = scene(7, 1, 1, 1, 8.0)
    silent = np.arange(x.shape[1]) < 4.0 * FS
    x[0, silent] *= 1e-9
    d[0, silent] = 0.03 * rng.standard_normal(np.sum(silent))
    oracle, controller = pair(s, 24, 1, np.array([0.25 * np.mean(d**2)]), 0.3)
    compare(oracle, controller, x, d, lambda n: s)
    assert np.mean(oracle.book) > 0.5


@pytest.mark.parametrize("levels", [(1.0, 0.1, 1.0, 0.1), (1.0, 3.0, 6.0, 0.3)])
def test_a_noise_whose_level_changes(levels: tuple[float, ...]) -> None:
    """With pauses, some of which last longer than the account."""
    s, x, d, rng = scene(7, 1, 1, 1, 12.0)
    level = np.repeat(levels, x.shape[1] // len(levels))
    x, d = level * x, level * d + 0.001 * rng.standard_normal(d.shape)
    compare(*pair(s, 24, 1, np.array([0.25 * np.mean(d**2)]), 0.3), x, d, lambda n: s)


def test_an_amplifier_model() -> None:
    """The posterior takes what was played."""
    s, x, d, _ = scene(6, 1, 1, 1, 6.0)
    rated = np.array([0.25 * np.mean(d**2)])
    both = pair(s, 24, 1, rated, 0.3, theirs={"amplifiers": [hard_clip(0.5)]}, amplifier=HardClipAmplifier(0.5))
    compare(*both, x, d, lambda n: s)


def test_a_limiter() -> None:
    """The account takes what was asked, which the limiter, of half the rating, lets pass in part."""
    s, x, d, _ = scene(6, 1, 1, 1, 6.0)
    rated = 0.25 * np.mean(d**2)
    own, theirs = (make(rated / 2, fs=FS, window_s=0.1) for make in (OutputLimiter, Limiter))
    oracle, controller = pair(s, 24, 1, np.array([rated]), 0.3, theirs={"limiters": [theirs]}, limiter=own)
    compare(oracle, controller, x, d, lambda n: s)
    assert theirs.gain < 1.0
    assert np.mean(oracle.book[:10]) > 0.6


def test_a_silent_reference_or_loudspeaker_leaves_the_others_at_work() -> None:
    """The oracle takes neither: its matrices are singular."""
    s, x, d, _ = scene(8, 2, 2, 2, 3.0)
    s[:, 1] = 0.0
    x[1] = 0.0
    d = np.array([np.convolve(h, x[0])[: x.shape[1]] for h in ([0, 0, 0, 1, 0.5], [0, 0, 0, 0, 0.7])])
    rated = 0.5 * np.mean(d**2)
    controller = kf_pb(
        12, s, rated_power=rated, fs=FS, averaging_s=2.0, secondary_path_uncertainty=None, n_references=2
    )
    result = simulate(controller, x, Plant(s, fs=FS), disturbance=d)
    assert np.mean(result.error[:, -2000:] ** 2) < 0.9 * np.mean(d[:, -2000:] ** 2)
    assert 0.2 * rated < np.mean(result.control_signal[0] ** 2) < 1.05 * rated
    assert np.all(result.control_signal[1] == 0.0)
