"""KF-PB of the core against its law in numpy.

Both do the same operations in other orders, so they differ by rounding, which the solutions enlarge: by 1e-9 of the signal's
rms at most where nothing is decided. A decision, such as Newton's stop, could fall otherwise by a rounding error; in these
cases none does, so 1e-6 leaves room for other machines.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from oracles.limiter import Limiter
from oracles.power_budget import PowerBudget
from oracles.signals import push

from kfopc_filterpy import OutputLimiter
from kfopc_filterpy.core.block import Algorithm, Block, Shape

FS, RATE = 2000.0, 1e-6


def paths(rng: np.random.Generator, K: int, J: int, taps: int) -> np.ndarray:
    """Return random paths with a delay of three samples, which fade over their length."""
    s = rng.standard_normal((K, J, taps)) * np.exp(-np.arange(taps) / (0.2 * taps))
    s[..., :3] = 0.0
    return s / np.sqrt(np.sum(s**2, axis=2, keepdims=True))


def coloured(rng: np.random.Generator, channels: int, n: int) -> np.ndarray:
    """Return noise that a short filter colours."""
    white = rng.standard_normal((channels, n + 3))
    return white[:, 3:] + 0.6 * white[:, 2:-1] - 0.3 * white[:, 1:-2] + 0.2 * white[:, :-3]


class Core:
    """The core's controller, called as the oracle is."""

    def __init__(self, s: np.ndarray, taps: int, references: int, settings: dict[str, Any], window: int = 0) -> None:
        K, J, M = s.shape
        shape = Shape(K, J, references, taps, M, limiter_windows=(window,) * J if window else ())
        self.block = Block(Algorithm("power_budget"), shape, path=s, settings=settings)

    def control_signal(self, x: np.ndarray) -> np.ndarray:
        self.block.reference[:] = x
        assert self.block.emit() == 0
        return self.block.control_signal.copy()

    def update(self, e: np.ndarray | None) -> None:
        if e is None:
            self.block._update(self.block.address, None)
        else:
            self.block.error[:] = e
            assert self.block.update() == 0

    def listen(self, x: np.ndarray, e: np.ndarray, heard: bool) -> None:
        assert self.block.listen(x[None], e[None], np.array([heard])) == (1, 0)

    def field(self, name: str) -> np.ndarray:
        return self.block.fields[name].ravel()


def pair(s: np.ndarray, taps: int, references: int, share: np.ndarray, spread: float, averaging: float, **more: Any):
    """Return oracle and core with the same settings."""
    oracle = PowerBudget(
        s_hat=s,
        n_taps=taps,
        n_references=references,
        rated_power=share,
        fs=FS,
        averaging_s=averaging,
        spread=spread,
        **more,
    )
    settings = {
        "rated_power": share,
        "block": oracle.B,
        "averaging": oracle.blocks,
        "window": oracle.g,
        "spread": spread,
    }
    limiters = more.get("limiters")
    return oracle, Core(s, taps, references, settings, limiters[0].N if limiters else 0)


def compare(oracle, core, x, d, true, *, on=0, heard=None):
    """Run both over references (I, n) and disturbances (K, n), with true paths of each sample, and compare them."""
    lines = [np.zeros(true(0).shape[1:]) for _ in range(2)]
    ys: list[list[np.ndarray]] = [[], []]
    heard = np.ones(x.shape[1], bool) if heard is None else heard
    prices = []
    for n in range(x.shape[1]):
        for one, line, kept in zip((oracle, core), lines, ys, strict=True):
            if n < on:
                if one is core:
                    one.listen(x[:, n], d[:, n], bool(heard[n]))
                else:
                    one.hear(x[:, n]), one.play(np.zeros(line.shape[0]))
                    one.d = d[:, n] if heard[n] else None
                    one.follow()
                push(line, np.zeros(line.shape[0]))
                continue
            y = one.control_signal(x[:, n])
            push(line, y)
            e = d[:, n] - np.einsum("kjm,jm->k", true(n), line)
            if heard[n]:
                one.update(e)
            elif one is core:
                one.update(None)
            else:
                one.adapt(None)
            kept.append(y)
        prices.append((oracle.price.copy(), core.field("price").copy()))
    theirs, ours = np.array(ys[0]), np.array(ys[1])
    assert np.sqrt(np.mean(theirs**2)) > 1e-3, "nothing was played"
    worst = np.max(np.abs(ours - theirs)) / np.sqrt(np.mean(theirs**2))
    assert worst < RATE, (worst, np.argmax(np.max(np.abs(ours - theirs), axis=1) > RATE * np.sqrt(np.mean(theirs**2))))
    expected, found = (np.array([price[one] for price in prices]) for one in range(2))
    np.testing.assert_allclose(found, expected, rtol=RATE, atol=1e-6 * np.max(expected))
    assert core.field("alarms")[0] == oracle.alarms
    assert core.field("fits")[0] == oracle.plant.fits
    np.testing.assert_allclose(core.block.fields["book"][0, 0], oracle.book, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(
        core.field("theta"), oracle.plant.theta.ravel(), rtol=1e-5, atol=1e-6 * np.max(np.abs(oracle.plant.theta))
    )
    np.testing.assert_allclose(core.field("noise"), oracle.plant.q, rtol=1e-5)
    return worst


def scene(seed: int, K: int, J: int, references: int, seconds: float, M: int = 16):
    """Return paths, references and disturbances."""
    rng = np.random.default_rng(seed)
    n = round(seconds * FS)
    x = coloured(rng, references, n)
    primary = paths(rng, K, references, 28)
    d = sum(np.array([np.convolve(primary[k, i], x[i])[:n] for k in range(K)]) for i in range(references))
    return paths(rng, K, J, M), x, d + 0.03 * rng.standard_normal((K, n)), rng


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_one_channel(spread: float) -> None:
    s, x, d, rng = scene(1, 1, 1, 1, 8.0)
    estimated = s if spread == 0 else s + 0.05 * rng.standard_normal(s.shape)
    oracle, core = pair(estimated, 24, 1, np.array([0.25 * np.mean(d**2)]), spread, 2.0)
    compare(oracle, core, x, d, lambda n: s)
    assert np.mean(oracle.book) > 0.5


def test_a_path_that_flips_its_polarity() -> None:
    s, x, d, _ = scene(2, 1, 1, 1, 12.0)
    oracle, core = pair(s, 24, 1, np.array([0.25 * np.mean(d**2)]), 0.3, 2.0)
    compare(oracle, core, x, d, lambda n: s if n < 6.0 * FS else -s)
    assert oracle.alarms


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_a_primary_path_that_flips_its_polarity(spread: float) -> None:
    s, x, d, _ = scene(2, 1, 1, 1, 12.0)
    d[:, round(6.0 * FS) :] *= -1.0
    oracle, core = pair(s, 24, 1, np.array([0.25 * np.mean(d**2)]), spread, 2.0)
    compare(oracle, core, x, d, lambda n: s)
    assert oracle.alarms == 1
    assert spread == 0.0 or oracle.plant.wrong >= 4  # the data were forgotten, in both


@pytest.mark.parametrize(("K", "J", "references"), [(2, 2, 2), (3, 2, 1), (9, 1, 1), (1, 3, 1), (2, 1, 3)])
def test_several_channels(K: int, J: int, references: int) -> None:
    """Nine microphones are more than a solution takes at once."""
    s, x, d, _ = scene(4, K, J, references, 3.0)
    oracle, core = pair(s, 9, references, np.linspace(0.25, 0.1, J) * np.mean(d**2), 0.3, 2.0)
    compare(oracle, core, x, d, lambda n: s)


def test_a_factorisation_that_takes_several_blocks() -> None:
    s, x, d, _ = scene(9, 1, 1, 1, 2.5, M=400)
    oracle, core = pair(s, 200, 1, np.array([0.25 * np.mean(d**2)]), 0.3, 2.0)
    assert oracle.plant.delay > 2
    compare(oracle, core, x, d, lambda n: s)


def test_missing_errors_after_silence() -> None:
    """The control comes on in the middle of a block, and some blocks are not heard."""
    s, x, d, rng = scene(5, 1, 1, 1, 6.0)
    heard = np.ones(x.shape[1], bool)
    heard[rng.integers(0, heard.size, 12)] = False
    heard[5000:5600] = False
    oracle, core = pair(s, 24, 1, np.array([0.25 * np.mean(d**2)]), 0.3, 2.0)
    compare(oracle, core, x, d, lambda n: s, on=1501, heard=heard)


def test_an_amplifier_model() -> None:
    """The posterior takes what was played."""
    s, x, d, _ = scene(6, 1, 1, 1, 6.0)
    oracle, core = pair(
        s, 24, 1, np.array([0.25 * np.mean(d**2)]), 0.3, 2.0, amplifiers=[lambda y: min(max(y, -0.5), 0.5)]
    )
    core.block.fields["amplifier"][0, 0, 0] = [1, 0.5, 1]
    compare(oracle, core, x, d, lambda n: s)


def test_a_limiter() -> None:
    """The account takes what was asked, which the limiter, of half the rating, lets pass in part."""
    s, x, d, _ = scene(6, 1, 1, 1, 6.0)
    rated = 0.25 * np.mean(d**2)
    own, theirs = (make(rated / 2, fs=FS, window_s=0.1) for make in (OutputLimiter, Limiter))
    oracle, core = pair(s, 24, 1, np.array([rated]), 0.3, 2.0, limiters=[theirs])
    laps = core.block.fields["laps"][0, 0]
    own.live_in(core.block.fields["limiter"][0, 0, 0], laps)
    compare(oracle, core, x, d, lambda n: s)
    played = np.mean(core.block.fields["history"][..., -1, :] ** 2)
    assert played < 0.9 * rated * np.mean(oracle.book[:10])


def test_a_silent_reference_or_loudspeaker_leaves_the_others_at_work() -> None:
    """The oracle takes neither: its matrices are singular."""
    s, x, d, _ = scene(8, 2, 2, 2, 3.0)
    s[:, 1] = 0.0
    x[1] = 0.0
    d = np.array([np.convolve(h, x[0])[: x.shape[1]] for h in ([0, 0, 0, 1, 0.5], [0, 0, 0, 0, 0.7])])
    rated = 0.5 * np.mean(d**2)
    settings = {"rated_power": rated, "block": 64, "averaging": 60, "window": np.exp(-1 / 3840), "spread": 0.0}
    core = Core(s, 12, 2, settings)
    line, e, y = np.zeros(s.shape[1:]), np.zeros_like(d), np.zeros((2, d.shape[1]))
    for n in range(x.shape[1]):
        y[:, n] = core.control_signal(x[:, n])
        push(line, y[:, n])
        e[:, n] = d[:, n] - np.einsum("kjm,jm->k", s, line)
        core.update(e[:, n])
    assert np.mean(e[:, -2000:] ** 2) < 0.9 * np.mean(d[:, -2000:] ** 2)
    assert 0.2 * rated < np.mean(y[0] ** 2) < 1.05 * rated
    assert np.all(y[1] == 0.0)
