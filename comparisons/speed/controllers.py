"""Controllers as users run them, beside other filters on the same rows.

Each maker takes a number of taps and returns a work. q = 1 and a small P(0|0) keep S near q, as in a run past its start.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from kfopc_filterpy import Plant, frequency_domain_fx_lms, fx_lms, kf_anc, kf_opc, kf_pb, mov_fx_lms, simulate
from kfopc_filterpy.realtime import Supervisor

from .estimator import random_walks, stepping
from .timing import Work

R, Q, P0 = 1e-8, 1.0, 1e-3
SHARING = 64
WHOLE_RUN_S = 20.0  # of KF-PB, whose steps after a block become fewer as it learns
PLANT = Plant(np.random.default_rng(0).standard_normal(32) / 8, fs=16000)  # of the closed loops
TARGET_FLOPS = 1e8  # of a turn
TAPS = (16, 64, 128, 256, 512, 1024)


def samples_for(taps: int, most: int, least: int, name: str = "") -> int:
    """Return the number of samples of a turn, those of a whole run for KF-PB."""
    if name == "KF-PB":
        return round(WHOLE_RUN_S * PLANT.fs)
    return int(np.clip(TARGET_FLOPS / (3 * taps**2), least, most))


def noises(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a reference and a disturbance."""
    return tuple(np.random.default_rng(1).standard_normal((2, samples)))


# ---- A sample, against the taps


def _kalman(make: Any, taps: int, **settings: Any) -> Any:
    return make(taps, PLANT, state_noise=R, measurement_noise=Q, initial_variance=P0, **settings)


# KF-PB has so low a rated power that power always has a price.
CONTROLLERS: dict[str, Callable[[int], Any]] = {
    "KF-ANC": lambda taps: _kalman(kf_anc, taps),
    "KF-OPC": lambda taps: _kalman(kf_opc, taps, rated_power=0.1),
    "KF-PB": lambda taps: kf_pb(taps, PLANT, rated_power=1e-6),
    "MOV-FxLMS": lambda taps: mov_fx_lms(taps, PLANT, step_size=1e-5, rated_power=0.1),
}


def simulated(name: str, taps: int) -> Work:
    """Return the work of a controller in `simulate`: amplifier, paths, power estimates, records."""
    samples = samples_for(taps, most=20000, least=2000, name=name)
    x, d = noises(samples)
    return partial(simulate, CONTROLLERS[name](taps), x, PLANT, disturbance=d), samples


def stepped(name: str, taps: int) -> Work:
    """Return the work of a controller stepped from Python, two calls a sample, without a loop around it."""
    controller, samples = CONTROLLERS[name](taps), samples_for(taps, most=1000, least=200, name=name)
    x, d = noises(samples)

    def run() -> None:
        for k in range(samples):
            controller.control_signal(x[k])
            controller.update(d[k])

    return run, samples


def together(taps: int) -> Work:
    """Return the work of runs that share gains: the samples of all are counted."""
    samples = 16000 if taps <= 256 else 4000  # a second at 16 kHz
    x, d = noises(samples)
    controllers = [_kalman(kf_opc, taps, rated_power=0.1 * (1 + i)) for i in range(SHARING)]
    return partial(simulate, controllers, x, PLANT, disturbance=d), SHARING * samples


def numpy_rank_one(taps: int) -> Work:
    """Return the work of the O(L^2) filter in plain numpy: a product, an outer product, a difference."""
    samples = samples_for(taps, most=50, least=12)
    x, z = noises(samples + taps)
    w, P, diagonal = np.zeros(taps), P0 * np.eye(taps), np.arange(taps)

    def run() -> None:
        nonlocal w, P
        for k in range(samples):
            h = x[k : k + taps]
            P[diagonal, diagonal] += R
            g = P @ h
            S = h @ g + Q
            w = w + g * ((z[k] - h @ w) / S)
            P = P - np.outer(g, g) / S

    return run, samples


def padasip(taps: int) -> Work:
    """Return the work of padasip's RLS, a filter with forgetting: another recursion of the same order."""
    from padasip.filters import FilterRLS

    samples = samples_for(taps, most=25, least=4)
    (x, z), rls = noises(samples + taps), FilterRLS(taps, mu=0.9999)

    def run() -> None:
        for k in range(samples):
            rls.adapt(z[k], x[k : k + taps])

    return run, samples


def pyroomacoustics(taps: int) -> Work:
    """Return the work of pyroomacoustics' RLS, which has a delay line: another recursion of the same order."""
    from pyroomacoustics.adaptive import RLS

    samples = samples_for(taps, most=50, least=12)
    (x, z), rls = noises(samples), RLS(taps)

    def run() -> None:
        for k in range(samples):
            rls.update(x[k], z[k])

    return run, samples


SAMPLES: dict[str, Callable[[int], Work]] = {
    "KFOPC.random_walk": lambda taps: stepping(*random_walks(taps)["np.float64"]),
    **{f"{name}, simulate": partial(simulated, name) for name in CONTROLLERS},
    **{f"{name}, stepped from Python": partial(stepped, name) for name in CONTROLLERS},
    f"KF-OPC, each of {SHARING} that share gains": together,
    "filterpy": lambda taps: stepping(*random_walks(taps)["filterpy"]),
    "the O(L²) filter in numpy": numpy_rank_one,
    "padasip RLS": padasip,
    "pyroomacoustics RLS": pyroomacoustics,
}

# ---- Blocks, as a real-time process hands them over


def _several(references: int, loudspeakers: int, microphones: int) -> Any:
    paths = np.random.default_rng(3).standard_normal((microphones, loudspeakers, 64)) * np.exp(-np.arange(64) / 10)
    return kf_pb(128, Plant(paths, fs=16000), rated_power=1e-3, n_references=references)


BLOCK_CONTROLLERS: dict[str, Callable[[], Any]] = {
    "FxLMS, 256 taps": lambda: fx_lms(256, PLANT, step_size=1e-5),
    "FxLMS, 256 taps, supervised": lambda: Supervisor(
        fx_lms(256, PLANT, step_size=1e-5), fs=16000, amplitude_limit=10.0
    ),
    "KF-OPC, 256 taps": lambda: CONTROLLERS["KF-OPC"](256),
    "KF-PB, 256 taps": lambda: CONTROLLERS["KF-PB"](256),
    "KF-PB, 1 x 2 x 2, 128 taps": lambda: _several(1, 2, 2),
    "KF-PB, 1 x 4 x 4, 128 taps": lambda: _several(1, 4, 4),
    "KF-PB, 2 x 2 x 2, 128 taps": lambda: _several(2, 2, 2),
}
BLOCKS = (16, 64, 256)
SIGNAL = 4096  # samples, which come again and again


def processing(name: str, block: int) -> Callable[[], Any]:
    """Return a function that has a controller process its next block, past its start."""
    controller = BLOCK_CONTROLLERS[name]()
    several, rng = controller.multichannel, np.random.default_rng(5)
    x = rng.standard_normal((controller.n_references, SIGNAL) if several else SIGNAL)
    e = rng.standard_normal((controller.n_microphones, SIGNAL) if several else SIGNAL)
    position = 0

    def run() -> None:
        nonlocal position
        controller.process(x[..., position : position + block], e[..., position : position + block])
        position = (position + block) % SIGNAL

    for _ in range(2 * SIGNAL // block):
        run()
    return run


# ---- Many taps: controllers that adapt once per block, beside FxLMS in compiled code

LONG_TAPS = (512, 1024, 2048, 4096, 8192, 16384)
LONG_BLOCK = 512
_blocks = partial(frequency_domain_fx_lms, secondary=PLANT, step_size=1e-6, block_size=LONG_BLOCK)
LONG: dict[str, Callable[[int], Any]] = {
    "FxLMS": partial(fx_lms, secondary=PLANT, step_size=1e-9),
    "frequency-domain FxLMS": _blocks,
    "... with one partition": lambda taps: _blocks(taps, partition_size=taps),
}


def long_block(name: str, taps: int) -> Work:
    """Return the work of `process` for a block."""
    return partial(LONG[name](taps).process, *noises(LONG_BLOCK)), LONG_BLOCK
