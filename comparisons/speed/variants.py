"""What the speed study times: the kernels of this package, and the filters of others, each on the same rows.

Each maker takes a number of taps and gives a function that runs some samples, and how many. Everything is warm when it
is returned: compiled, with its arrays touched. q = 1 and a small P(0|0) keep S near q, as in a run past its start.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.lib.stride_tricks import sliding_window_view

from kfopc_filterpy import KFOPC, MOVFxLMS, kf_opc, kf_pb, simulate, simulate_scenarios
from kfopc_filterpy.kernels.block import Block, CausalBlock, project_in_block, update_in_block
from kfopc_filterpy.kernels.compiling import compiled
from kfopc_filterpy.kernels.covariance import (
    FAST,
    Covariance,
    new_covariance,
    predict_covariance,
    project_covariance,
    update_weights,
)

Work = tuple[Callable[[], Any], int]
R, Q, P0 = 1e-8, 1.0, 1e-3
BLOCK_SIZE = 48
SCENARIOS = 64
PATH = np.random.default_rng(0).standard_normal(32) / 8  # secondary path of the closed loops
TARGET_FLOPS = 1e8  # a timing takes about this much work of ours, and a few samples of the slow ones


def samples_for(taps: int, most: int = 20000, least: int = 192) -> int:
    """Samples of one timing."""
    return int(np.clip(TARGET_FLOPS / (3 * taps**2), least, most))


def signal(taps: int, samples: int) -> np.ndarray:
    """Filtered reference whose every `taps` neighbours are a row."""
    return np.random.default_rng(1).standard_normal(samples + taps)


@compiled()
def _stream(cov, w, x, d, state_noise, measurement_noise):
    for k in range(d.size):
        h = x[k : k + w.size]
        predict_covariance(cov, 1.0, state_noise)
        S = project_covariance(cov, h) + measurement_noise
        update_weights(cov, w, h, d[k], S, measurement_noise)


@compiled()
def _stream_in_block(cov, block, w, rows, d, state_noise, measurement_noise):
    for k in range(d.size):
        h = rows[k, : w.size]
        S = project_in_block(cov, block, h, state_noise)[0] + measurement_noise
        update_in_block(cov, block, w, h, d[k], S)


def filter_state(taps: int) -> tuple[Covariance, np.ndarray]:
    """Covariance and weights of a filter before its first sample."""
    return new_covariance(P0 * np.eye(taps)), np.zeros(taps)


def streaming(taps: int) -> Work:
    """The definition: sample by sample, in one compiled loop."""
    samples = samples_for(taps)
    x, (cov, w) = signal(taps, samples), filter_state(taps)
    d = x[:samples].copy()
    _stream(cov, w, x, d[:2], R, Q)
    return lambda: _stream(cov, w, x, d, R, Q), samples


def _block_samples(taps: int) -> int:
    return samples_for(taps, most=20 * BLOCK_SIZE, least=8 * BLOCK_SIZE) // BLOCK_SIZE * BLOCK_SIZE


def block(taps: int) -> Work:
    """All rows of a block known, in matrix products."""
    return _rows_known(taps, "advance")


def pairs(taps: int) -> Work:
    """All rows of a block known, two at a time."""
    return _rows_known(taps, "advance_in_pairs")


def _rows_known(taps: int, how: str) -> Work:
    """The weights as `simulate_scenarios` has them: two products with the gains."""
    samples = _block_samples(taps)
    x, (cov, w) = signal(taps, samples), filter_state(taps)
    d, work = x[:samples].copy(), Block(taps, BLOCK_SIZE)

    def run() -> None:
        for first in range(0, samples, BLOCK_SIZE):
            work.rows[:, :taps] = sliding_window_view(x[first : first + BLOCK_SIZE + taps - 1], taps)
            S = getattr(work, how)(cov, R, Q)
            _correct_in_turn(w, work.rows, work.directions, S, d[first : first + BLOCK_SIZE])

    run()
    return run, samples


@compiled(fastmath=FAST)
def _correct_in_turn(w, rows, directions, S, d):
    for k in range(d.size):
        y = d[k]
        for i in range(w.size):
            y -= rows[k, i] * w[i]
        for i in range(w.size):
            w[i] += directions[k, i] * (y / S[k])


def block_causal(taps: int) -> Work:
    """Each row only when its sample comes."""
    samples = _block_samples(taps)
    x, (cov, w) = signal(taps, samples), filter_state(taps)
    rows = sliding_window_view(x[::-1], taps)[::-1].copy()  # newest first, as a delay line has them
    d, work = x[:samples].copy(), CausalBlock(taps, BLOCK_SIZE)

    def run() -> None:
        for first in range(1, samples + 1, BLOCK_SIZE):
            work.open(cov, rows[first - 1])
            _stream_in_block(
                cov, work.state, w, rows[first : first + BLOCK_SIZE], d[first - 1 : first - 1 + BLOCK_SIZE], R, Q
            )
            work.close(cov, R)

    run()
    return run, samples


def filterpy_api(taps: int) -> Work:
    """`KFOPC.random_walk` called as a filterpy filter: `predict()`, `update(z, H=row)`."""
    samples = samples_for(taps, most=1000)
    x = signal(taps, samples)
    kf = KFOPC.random_walk(taps, state_noise=R, measurement_noise=Q, initial_variance=P0)

    def run() -> None:
        for k in range(samples):
            kf.predict()
            kf.update(1.0, H=x[k : k + taps])

    run()
    return run, samples


def _loop(controller: Any, taps: int) -> Work:
    samples = samples_for(taps, least=2000)
    x = signal(0, samples)
    d = np.random.default_rng(2).standard_normal(samples)
    simulate(controller, x[:2], disturbance=d[:2], secondary_path=PATH)
    return lambda: simulate(controller, x, disturbance=d, secondary_path=PATH), samples


def closed_loop(taps: int) -> Work:
    """KF-OPC in `simulate`: amplifier, paths, power estimates, records."""
    return _loop(_kf_opc(taps, 0), taps)


def closed_loop_lms(taps: int) -> Work:
    """MOV-FxLMS in `simulate`: what the loop costs beside an O(L) update."""
    return _loop(MOVFxLMS(taps, PATH, step_size=1e-5, rated_power=0.1), taps)


def closed_loop_budget(taps: int) -> Work:
    """KF-PB in `simulate`, its rated power so low that lambda is always searched for."""
    return _loop(kf_pb(taps, PATH, rated_power=1e-6, state_noise=R, measurement_noise=Q, initial_variance=P0), taps)


def _kf_opc(taps: int, i: int) -> Any:
    return kf_opc(taps, PATH, rated_power=0.1 * (1 + i), state_noise=R, measurement_noise=Q, initial_variance=P0)


def scenarios(taps: int) -> Work:
    """One of 64 scenarios in `simulate_scenarios`: samples of all are counted."""
    samples = 16000 if taps <= 256 else 4000  # a second at 16 kHz
    x = signal(0, samples)
    d = np.random.default_rng(2).standard_normal(samples)
    controllers = [_kf_opc(taps, i) for i in range(SCENARIOS)]
    run = lambda: simulate_scenarios(controllers, x, disturbance=d, secondary_path=PATH)  # noqa: E731
    run()
    return run, SCENARIOS * samples


def numpy_rank_one(taps: int) -> Work:
    """The O(L^2) filter in plain numpy: a product, an outer product, a difference."""
    samples = max(samples_for(taps, most=400) // 8, 12)
    x = signal(taps, samples)
    w, P, diagonal = np.zeros(taps), P0 * np.eye(taps), np.arange(taps)

    def run() -> None:
        nonlocal w, P
        for k in range(samples):
            h = x[k : k + taps]
            P[diagonal, diagonal] += R
            g = P @ h
            S = h @ g + Q
            w = w + g * ((1.0 - h @ w) / S)
            P = P - np.outer(g, g) / S

    run()
    return run, samples


def filterpy(taps: int) -> Work:
    """filterpy's own `KalmanFilter`, `predict()` and `update(z, H=row)`."""
    samples = int(np.clip(2e8 / taps**3, 1, 100))
    x = signal(taps, samples)
    kf = KalmanFilter(taps, 1)
    kf.P, kf.Q, kf.R = P0 * np.eye(taps), R * np.eye(taps), np.array([[Q]])

    def run() -> None:
        for k in range(samples):
            kf.predict()
            kf.update(1.0, H=x[k : k + taps].reshape(1, -1))

    run()
    return run, samples


def pykalman(taps: int) -> Work:
    """pykalman's `filter_update` with an observation matrix each sample."""
    from pykalman import KalmanFilter as PyKalman

    samples = int(np.clip(1e8 / taps**3, 1, 100))
    x = signal(taps, samples)
    kf = PyKalman(np.eye(taps), np.ones((1, taps)), R * np.eye(taps), np.array([[Q]]))

    def run() -> None:
        mean, P = np.zeros(taps), P0 * np.eye(taps)
        for k in range(samples):
            row = x[k : k + taps].reshape(1, -1)
            mean, P = kf.filter_update(mean, P, observation=[1.0], observation_matrix=row)

    run()
    return run, samples


def statsmodels(taps: int) -> Work:
    """statsmodels' compiled state-space filter with a design that varies, keeping nothing."""
    from statsmodels.tsa.statespace.kalman_filter import MEMORY_CONSERVE
    from statsmodels.tsa.statespace.kalman_filter import KalmanFilter as StateSpace

    samples = int(np.clip(2e8 / taps**3, 2, 100))
    x = signal(taps, samples)
    model = StateSpace(k_endog=1, k_states=taps)
    model.bind(np.ones(samples))
    model["design"] = np.stack([x[k : k + taps] for k in range(samples)], axis=-1)[None]
    model["transition"], model["selection"] = np.eye(taps), np.eye(taps)
    model["state_cov"], model["obs_cov"] = R * np.eye(taps), np.array([[Q]])
    model.initialize_known(np.zeros(taps), P0 * np.eye(taps))
    model.set_conserve_memory(MEMORY_CONSERVE)
    run = lambda: model.filter()  # noqa: E731
    run()
    return run, samples


def padasip(taps: int) -> Work:
    """padasip's RLS, a filter with forgetting: another recursion of the same order."""
    from padasip.filters import FilterRLS

    samples = max(samples_for(taps, most=400) // 16, 4)
    x, rls = signal(taps, samples), FilterRLS(taps, mu=0.9999)

    def run() -> None:
        for k in range(samples):
            rls.adapt(1.0, x[k : k + taps])

    run()
    return run, samples


def pyroomacoustics(taps: int) -> Work:
    """pyroomacoustics' RLS, which keeps its own delay line: another recursion of the same order."""
    from pyroomacoustics.adaptive import RLS

    samples = max(samples_for(taps, most=400) // 8, 12)
    x, rls = signal(taps, samples), RLS(taps)

    def run() -> None:
        for k in range(samples):
            rls.update(x[k], 1.0)

    run()
    return run, samples


OURS: dict[str, Callable[[int], Work]] = {
    "streaming kernel": streaming,
    "block kernel, rows known": block,
    "block kernel, causal": block_causal,
    "two at a time, rows known": pairs,
    "filterpy API of KFOPC": filterpy_api,
    "closed loop, KF-OPC": closed_loop,
    "closed loop, KF-PB": closed_loop_budget,
    "closed loop, MOV-FxLMS": closed_loop_lms,
    f"closed loop, each of {SCENARIOS} KF-OPC": scenarios,
}
PEERS: dict[str, Callable[[int], Work]] = {
    "numpy rank-1": numpy_rank_one,
    "filterpy": filterpy,
    "statsmodels": statsmodels,
    "pykalman": pykalman,
    "padasip RLS": padasip,
    "pyroomacoustics RLS": pyroomacoustics,
}
