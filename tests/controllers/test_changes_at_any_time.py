"""KF-PB after a change of a path: of random plants, at any time, in any part of a block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from kfopc_filterpy import Plant, kf_pb, noise_reduction_db, simulate
from kfopc_filterpy.signals import band_limited_noise

AFTER_S = 3  # whole seconds that are judged


@dataclass(frozen=True)
class Change:
    """A plant, what becomes of it, and how it is controlled."""

    fs: float
    n_taps: int
    rated_power: float
    secondary: np.ndarray
    primary: np.ndarray
    later_secondary: np.ndarray
    later_primary: np.ndarray
    at_s: float
    seed: int


def impulse_response(rng: np.random.Generator, fs: float, n_taps: int, delay: int) -> np.ndarray:
    """Return a decaying random response of energy 1."""
    response = rng.standard_normal(n_taps) * np.exp(-np.arange(n_taps) / (0.004 * fs * rng.uniform(0.5, 1.5)))
    response[:delay] = 0.0
    return response / np.linalg.norm(response)


def random_change(seed: int) -> Change:
    """Return a change of a random plant, with little or much rated power."""
    rng = np.random.default_rng(seed)
    fs = float(rng.choice([8000, 16000]))
    n_taps, m = int(rng.choice([64, 128, 256])), int(rng.choice([16, 32, 64]))
    near, far = int(rng.integers(1, m // 4)), int(rng.integers(2, n_taps // 3))
    s, p = impulse_response(rng, fs, m, near), impulse_response(rng, fs, n_taps, near + far)
    later_s, later_p = [
        (-s, p),
        (np.r_[np.zeros(rng.integers(1, 3)), s][:m], p),
        (impulse_response(rng, fs, m, near), p),
        (2.0 * s, p),
        (s, -p),
        (s, np.r_[np.zeros(rng.integers(1, 7)), p][:n_taps]),
        (s, impulse_response(rng, fs, n_taps, near + far)),
    ][rng.integers(7)]
    rated_power = float(rng.choice([0.3, 3.0]))  # of a disturbance of 1
    return Change(
        fs, n_taps, rated_power, s, p, later_s, later_p, rng.choice([0.4, 1, 2, 4]) + rng.uniform(0, 0.1), seed
    )


def lost_db(change: Change) -> tuple[np.ndarray, float]:
    """Return what each second after a change lacks, against KF-PB on the later plant, and the level of the loudest second."""
    fs, seconds = round(change.fs), change.at_s + AFTER_S + 0.1
    x = band_limited_noise((0.01 * fs, 0.3 * fs), seconds, fs=fs, rng=change.seed)
    noise = 0.01 * np.random.default_rng(change.seed).standard_normal(x.size)
    at = round(change.at_s * fs)
    before, later = (np.convolve(x, p)[: x.size] + noise for p in (change.primary, change.later_primary))
    d = np.r_[before[:at], later[at:]]
    changes = Plant(change.secondary, fs=fs).changed_at(change.at_s, secondary=change.later_secondary)
    runs = [
        simulate(kf_pb(change.n_taps, s, rated_power=change.rated_power, fs=fs), x, plant, disturbance=heard)
        for s, plant, heard in (
            (change.secondary, changes, d),
            (change.later_secondary, Plant(change.later_secondary, fs=fs), later),
        )
    ]
    parts = [slice(at + k * fs, at + (k + 1) * fs) for k in range(AFTER_S)]
    own, best = (np.array([noise_reduction_db(run.error[k], later[k], steady=1.0) for k in parts]) for run in runs)
    return best - own, -float(np.min(own))


@pytest.mark.parametrize("seed", [*range(20), *(pytest.param(s, marks=pytest.mark.slow) for s in range(100, 400))])
def test_a_path_that_changes_at_any_time_is_learnt(seed: int) -> None:
    """A wrong secondary path can be held for good, and make the noise louder. The third second lacks less than 1 dB."""
    lost, loudest = lost_db(random_change(seed))
    assert lost[2] < 1.0
    assert loudest < 1.0
