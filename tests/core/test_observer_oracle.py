"""The observer of the core against the posterior in numpy; tolerances as those of KF-PB, see test_power_budget_oracle.py."""

from __future__ import annotations

import math

import numpy as np
import pytest
from oracles.power_budget import KNOWN, Plant
from test_power_budget_oracle import FS, RATE, coloured, paths, scene

from kfopc_filterpy.controllers.posterior import PathObserver

MEMORY_S, SPREAD = 5.0, 0.3


class Observer:
    """The numpy posterior, which takes blocks, fed sample by sample."""

    def __init__(self, s: np.ndarray, taps: int, references: int, block: int) -> None:
        self.J, M = s.shape[1:]
        self.B, self.N, self.heard, self.alarms = block, taps + M - 1, 0, 0
        self.plant = Plant(s, references, self.N, block, SPREAD, math.exp(-block / (MEMORY_S * FS)))
        self.signals = np.zeros((references + self.J, taps + self.N + block))
        self.new: list[tuple[np.ndarray, np.ndarray | None]] = []

    def take(self, signals: np.ndarray, e: np.ndarray | None) -> None:
        self.new.append((signals, e))
        if len(self.new) < self.B:
            return
        heard = [e for _, e in self.new if e is not None]
        self.signals = np.concatenate((self.signals[:, self.B :], np.transpose([z for z, _ in self.new])), axis=1)
        if len(heard) == self.B and self.heard >= self.N:
            known = self.heard / self.B * (1 - self.plant.forget) >= KNOWN
            x, y = self.signals[: -self.J], self.signals[-self.J :]
            self.alarms += self.plant.learn(x, y, np.transpose(heard), known)
        self.heard += self.B
        self.new = []


@pytest.mark.parametrize(("channels", "taps"), [((1, 1, 1), 24), ((2, 2, 2), 12)])
def test_it_learns_what_the_oracle_learns(channels: tuple[int, int, int], taps: int) -> None:
    """Silence at first, errors that never come, and a path whose polarity changes, which is an alarm."""
    K, J, references = channels
    s, x, d, rng = scene(11, K, J, references, 6.0)
    y, n = coloured(rng, J, x.shape[1]), x.shape[1]
    y[:, :1000] = 0.0
    played = np.array([sum(np.convolve(s[k, j], y[j])[:n] for j in range(J)) for k in range(K)])
    e = d - np.where(np.arange(n) < 7001, 1.0, -1.0) * played
    heard = rng.random(n) > 1e-3
    heard[9000:9300] = False
    estimate = s + 0.1 * paths(rng, K, J, s.shape[2])
    observer = PathObserver(taps, estimate, n_references=references, spread=SPREAD, fs=FS, memory_s=MEMORY_S)
    oracle, fits = Observer(estimate, taps, references, observer.block), 0
    for t in range(n):
        signals = np.concatenate((x[:, t], y[:, t]))
        assert not observer.control_signal(signals).any()  # it plays nothing
        if heard[t]:
            observer.update(e[:, t])
        oracle.take(signals, e[:, t] if heard[t] else None)
        if heard[t] and oracle.plant.fits > fits:
            fits = oracle.plant.fits
            expected = oracle.plant.theta.reshape(K, -1)
            theta = np.concatenate(
                (observer.primary_path.reshape(K, -1), observer.identified_path.reshape(K, -1)), axis=1
            )
            np.testing.assert_allclose(theta, expected, rtol=0, atol=RATE * np.max(np.abs(expected)), err_msg=f"{t}")
            np.testing.assert_allclose(observer.measurement_noise, oracle.plant.q, rtol=RATE, err_msg=f"{t}")
            assert observer.fits == fits
            assert observer.alarms == oracle.alarms
    assert fits > 20
    assert oracle.alarms == 1
    # The noise is 30 dB below the disturbance: -20 dB of the path is left if it was learned again from seconds of data.
    assert np.sum((observer.identified_path + s) ** 2) < 0.01 * np.sum(s**2)
