"""The variants of the speed study: this package through its public names, and other filters, on the same rows.

Each maker takes a number of taps and returns a function that runs some samples, and how many. Everything is warm by then:
compiled, with its arrays touched. q = 1 and a small P(0|0) keep S near q, as in a run past its start.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter

from kfopc_filterpy import (
    KFOPC,
    FrequencyDomainFxLMS,
    FrequencyDomainKalman,
    FxLMS,
    MOVFxLMS,
    SubbandFxLMS,
    kf_anc,
    kf_opc,
    kf_pb,
    simulate,
    simulate_scenarios,
)
from kfopc_filterpy.realtime import Supervisor

Work = tuple[Callable[[], Any], int]
R, Q, P0 = 1e-8, 1.0, 1e-3
SCENARIOS = 64
PATH = np.random.default_rng(0).standard_normal(32) / 8  # secondary path of the closed loops
TARGET_FLOPS = 1e8  # a timing takes about this much work of ours, and a few samples of the slow ones


def samples_for(taps: int, most: int = 20000, least: int = 192) -> int:
    """Return the number of samples of one timing."""
    return int(np.clip(TARGET_FLOPS / (3 * taps**2), least, most))


def signal(taps: int, samples: int) -> np.ndarray:
    """Return a filtered reference in which every `taps` neighbours are a row."""
    return np.random.default_rng(1).standard_normal(samples + taps)


def random_walk(taps: int) -> KFOPC:
    """Return the filter that the study times."""
    return KFOPC.random_walk(taps, state_noise=R, measurement_noise=Q, initial_variance=P0)


def filterpy_api(taps: int) -> Work:
    """Time `KFOPC.random_walk` called as a filterpy filter: `predict()`, `update(z, H=row)`."""
    samples = samples_for(taps, most=1000)
    x, kf = signal(taps, samples), random_walk(taps)

    def run() -> None:
        for k in range(samples):
            kf.predict()
            kf.update(1.0, H=x[k : k + taps])

    run()
    return run, samples


# ---- Controllers, in the compiled loop and stepped from Python


def _kalman(make: Any, taps: int, **settings: Any) -> Any:
    return make(taps, PATH, state_noise=R, measurement_noise=Q, initial_variance=P0, **settings)


# KF-PB has so low a rated power that the price is always searched for.
CONTROLLERS: dict[str, Callable[[int], Any]] = {
    "KF-ANC": lambda taps: _kalman(kf_anc, taps),
    "KF-OPC": lambda taps: _kalman(kf_opc, taps, rated_power=0.1),
    "KF-PB": lambda taps: kf_pb(taps, PATH, rated_power=1e-6),
    "MOV-FxLMS": lambda taps: MOVFxLMS(taps, PATH, step_size=1e-5, rated_power=0.1),
}


# ---- Several channels: references, loudspeakers, microphones, taps of a control filter.

CHANNELS = [(1, 1, 1, 256), (1, 2, 2, 128), (1, 4, 4, 128), (2, 2, 2, 128)]
CHANNEL_SECONDARY_TAPS, CHANNEL_PLANT_TAPS = 128, 32
CHANNEL_BLOCK = 512  # of KF-PB at 16 kHz


def channel_blocks(references: int, loudspeakers: int, microphones: int, n_taps: int) -> tuple[Callable[[], Any], int]:
    """Return a function that runs KF-PB over the next block, and the samples of a block.

    The paths of the plant are cut short, so that little of the time is the simulation's. The controller
    does not notice: its rated power is far below the noise.
    """
    rng = np.random.default_rng(3)
    decay = np.exp(-np.arange(CHANNEL_SECONDARY_TAPS) / 40)
    secondary = rng.standard_normal((microphones, loudspeakers, CHANNEL_SECONDARY_TAPS)) * decay
    controller = kf_pb(n_taps, secondary, rated_power=1e-3, n_references=references)
    x, d = (rng.standard_normal((channels, CHANNEL_BLOCK)) for channels in (references, microphones))

    def run() -> None:
        simulate(controller, x, disturbance=d, secondary_path=secondary[..., :CHANNEL_PLANT_TAPS])

    for _ in range(20):  # past the start, when the posterior is solved for in every block
        run()
    return run, CHANNEL_BLOCK


# ---- Blocks as a real-time process hands them over: controllers, and samples of a block.

BLOCK_CONTROLLERS: dict[str, Callable[[], Any]] = {
    "FxLMS, 256 taps": lambda: FxLMS(256, PATH, step_size=1e-5),
    "FxLMS, supervised": lambda: Supervisor(FxLMS(256, PATH, step_size=1e-5), amplitude_limit=10.0),
    "KF-OPC, 256 taps": lambda: CONTROLLERS["KF-OPC"](256),
    "KF-PB, 256 taps": lambda: CONTROLLERS["KF-PB"](256),
    "KF-PB, 4 x 4, 128 taps": lambda: kf_pb(
        128, np.random.default_rng(3).standard_normal((4, 4, 64)) * np.exp(-np.arange(64) / 10), rated_power=1e-3
    ),
}
BLOCKS = (16, 64, 256)


def process_block(name: str, block: int) -> Callable[[], Any]:
    """Return a function that processes the next block of a controller, past its start."""
    controller = BLOCK_CONTROLLERS[name]()
    shape = (controller.n_microphones, 4096) if controller.multichannel else 4096
    rng = np.random.default_rng(5)
    x, e = rng.standard_normal((1, 4096) if controller.multichannel else 4096), rng.standard_normal(shape)
    y = np.empty((controller.n_loudspeakers, block)) if controller.multichannel else np.empty(block)
    room = {} if isinstance(controller, Supervisor) else {"out": y}
    position = 0

    def run() -> None:
        nonlocal position
        part = slice(position, position + block)
        controller.process(x[..., part], e[..., part], **room)
        position = (position + block) % 4096

    for _ in range(max(8192 // block, 1)):
        run()
    return run


# ---- Controllers that adapt once per block, beside FxLMS in compiled code, with many taps.

LONG_TAPS = (512, 1024, 2048, 4096, 8192, 16384)
LONG_BLOCK = 512
LONG: dict[str, Callable[[int], Any]] = {
    "FxLMS, compiled": lambda taps: FxLMS(taps, PATH, step_size=1e-9),
    "frequency domain": partial(FrequencyDomainFxLMS, secondary_path=PATH, step_size=1e-6, block_size=LONG_BLOCK),
    "one partition": lambda taps: FrequencyDomainFxLMS(
        taps, PATH, step_size=1e-6, block_size=LONG_BLOCK, partition_size=taps
    ),
    "unconstrained": partial(
        FrequencyDomainFxLMS, secondary_path=PATH, step_size=1e-6, block_size=LONG_BLOCK, constrained=False
    ),
    "subband, 64 bands": partial(SubbandFxLMS, secondary_path=PATH, step_size=1e-6, n_bands=64, block_size=LONG_BLOCK),
    "frequency-domain Kalman": partial(FrequencyDomainKalman, secondary_path=PATH, block_size=LONG_BLOCK),
}


def long_filter(name: str, taps: int) -> Work:
    """Time `process` of a controller with many taps, over a block of its own."""
    controller, (x, e) = LONG[name](taps), _noise(LONG_BLOCK)
    y = np.empty(LONG_BLOCK)
    controller.process(x, e, out=y)
    return lambda: controller.process(x, e, out=y), LONG_BLOCK


def _noise(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a reference and a disturbance."""
    return signal(0, samples), np.random.default_rng(2).standard_normal(samples)


def closed_loop(name: str, taps: int) -> Work:
    """Time a controller in `simulate`: amplifier, paths, power estimates, records."""
    controller, samples = CONTROLLERS[name](taps), samples_for(taps, least=2000)
    x, d = _noise(samples)
    simulate(controller, x[:2], disturbance=d[:2], secondary_path=PATH)
    return lambda: simulate(controller, x, disturbance=d, secondary_path=PATH), samples


def stepped(name: str, taps: int) -> Work:
    """Time a controller stepped from Python, two calls a sample, without a loop around it."""
    controller, samples = CONTROLLERS[name](taps), samples_for(taps, most=1000)
    x, d = _noise(samples)

    def run() -> None:
        for k in range(samples):
            controller.control_signal(x[k])
            controller.update(d[k])

    run()
    return run, samples


def scenarios(taps: int) -> Work:
    """Time one of 64 scenarios in `simulate_scenarios`: the samples of all are counted."""
    samples = 16000 if taps <= 256 else 4000  # a second at 16 kHz
    x, d = _noise(samples)
    controllers = [_kalman(kf_opc, taps, rated_power=0.1 * (1 + i)) for i in range(SCENARIOS)]
    run = partial(simulate_scenarios, controllers, x, disturbance=d, secondary_path=PATH)
    run()
    return run, SCENARIOS * samples


# ---- Others


def numpy_rank_one(taps: int) -> Work:
    """Time the O(L^2) filter in plain numpy: a product, an outer product, a difference."""
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
    """Time filterpy's own `KalmanFilter`, `predict()` and `update(z, H=row)`."""
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
    """Time pykalman's `filter_update` with an observation matrix each sample."""
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
    """Time statsmodels' compiled state-space filter with a design that varies, keeping nothing."""
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
    model.filter()
    return model.filter, samples


def padasip(taps: int) -> Work:
    """Time padasip's RLS, a filter with forgetting: another recursion of the same order."""
    from padasip.filters import FilterRLS

    samples = max(samples_for(taps, most=400) // 16, 4)
    x, rls = signal(taps, samples), FilterRLS(taps, mu=0.9999)

    def run() -> None:
        for k in range(samples):
            rls.adapt(1.0, x[k : k + taps])

    run()
    return run, samples


def pyroomacoustics(taps: int) -> Work:
    """Time pyroomacoustics' RLS, which has a delay line: another recursion of the same order."""
    from pyroomacoustics.adaptive import RLS

    samples = max(samples_for(taps, most=400) // 8, 12)
    x, rls = signal(taps, samples), RLS(taps)

    def run() -> None:
        for k in range(samples):
            rls.update(x[k], 1.0)

    run()
    return run, samples


OURS: dict[str, Callable[[int], Work]] = {
    "filterpy API of KFOPC": filterpy_api,
    **{f"closed loop, {name}": partial(closed_loop, name) for name in CONTROLLERS},
    **{f"stepped from Python, {name}": partial(stepped, name) for name in CONTROLLERS},
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
