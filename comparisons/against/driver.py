"""Run every controller in cases that are the same for each version of the package, or time some of them.

`command` starts this file as a script, once with the working tree and once with an earlier version as the package. So it
uses only public names that both have, and nothing else of this repository. `VerifiedController` is looked up when its
case is made: where a version has none, only that case fails.
"""

from __future__ import annotations

import argparse
import json
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter

import kfopc_filterpy
from kfopc_filterpy import (
    KFOPC,
    ClippingFxLMS,
    DiagonalKalman,
    FastArrayKalman,
    FxLMS,
    FxNLMS,
    HardClipAmplifier,
    KalmanController,
    LeakyFxLMS,
    LimitedController,
    MOVFxLMS,
    OptimalLeakyFxLMS,
    OutputLimiter,
    OutputPowerConstraint,
    RescalingFxLMS,
    SoftSaturationAmplifier,
    TwoGradientFxLMS,
    controllers,
    fx_rls,
    kf_anc,
    kf_opc,
    kf_opc_repaired,
    kf_pb,
    simulate,
    simulate_scenarios,
)
from kfopc_filterpy.controllers import FeedbackNeutralizer, VirtualMicrophones
from kfopc_filterpy.paths import PathTolerance
from kfopc_filterpy.signals import (
    DataUnavailableError,
    band_limited_noise,
    level_jump,
    load_measured_duct,
    load_measured_room,
    tone,
)

FS = 16000.0
TAPS, RECORDED_TAPS, CHANNEL_TAPS, ROOM_TAPS = 24, 96, 12, 16
SAMPLES, RECORDED_SAMPLES, STEPPED_SAMPLES = 6000, 32000, 2400
BLOCKS = (1, 37, 64, 13)  # samples, in turn
SENSOR_NOISE, P0, RATED_POWER = 0.05, 0.5, 0.3
R, Q = 1e-6, SENSOR_NOISE**2
KALMAN: dict[str, Any] = {"state_noise": R, "measurement_noise": Q, "initial_variance": P0}
LIST = "cases.json"  # what the cases of a version are
SIGNALS = ("error", "control_signal", "amplifier_output", "anti_noise", "constraint_factor", "weights")
POWERS = ("disturbance_power", "secondary_path_gain", "power_weight")
SOFT, HARD = SoftSaturationAmplifier(1.0, 1.5), HardClipAmplifier(1.0)
WIDE = [HardClipAmplifier(2.5), SoftSaturationAmplifier(2.5, 1.5)]  # of two loudspeakers

Result = dict[str, Any]
Make = Callable[["Scene"], Any]


# ---- Scenes


@dataclass(frozen=True)
class Scene:
    """A noise, its paths, and what `simulate` is told beyond them."""

    x: np.ndarray
    d: np.ndarray
    secondary: np.ndarray
    estimate: np.ndarray
    n_taps: int = TAPS
    pace: float = 1.0  # of what has a step size
    options: dict[str, Any] = field(default_factory=dict)

    def having(self, **options: Any) -> Scene:
        return replace(self, options=self.options | options)

    @property
    def n_references(self) -> int:
        return len(np.atleast_2d(self.x))


def decaying(outputs: int, inputs: int, taps: int, seed: int, delay: int) -> np.ndarray:
    """Return random paths of unit energy, (outputs, inputs, taps)."""
    paths = np.random.default_rng(seed).standard_normal((outputs, inputs, taps)) * np.exp(-np.arange(taps) / (taps / 5))
    paths[..., :delay] = 0.0
    return paths / np.linalg.norm(paths, axis=-1, keepdims=True)


def through(paths: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return signals (inputs, n) after paths (outputs, inputs, taps)."""
    return np.array([sum(np.convolve(p, one)[: x.shape[1]] for p, one in zip(row, x, strict=True)) for row in paths])


def nearly(secondary: np.ndarray) -> np.ndarray:
    """Return an estimate that differs from a secondary path a little, and is two taps shorter."""
    kept = secondary[..., :-2]
    return kept * (1.0 + 0.05 * np.random.default_rng(9).standard_normal(kept.shape))


def one_channel(x: np.ndarray) -> Scene:
    """Return a scene of one channel with random paths."""
    s = decaying(1, 1, 20, 2, 2)[0, 0]
    return Scene(x, np.convolve(x, decaying(1, 1, 40, 1, 8)[0, 0])[: x.size], s, nearly(s))


def recorded_scene(x: np.ndarray, primary: np.ndarray, secondary: np.ndarray, n_taps: int, pace: float) -> Scene:
    """Return a scene of measured paths, (K, I or J, taps); filtered reference and disturbance have a power near 1."""
    d, filtered = through(primary, x), through(secondary[:1, :1], x)
    d, s = d / np.sqrt(np.mean(d**2)), secondary / np.sqrt(np.mean(filtered**2))
    if s.shape[:2] == (1, 1):
        x, d, s = x[0], d[0], s[0, 0]
    return Scene(x, d, s, nearly(s), n_taps, pace)


def channels(n_references: int, delay: int = 2) -> Scene:
    """Return a scene of two loudspeakers and two microphones."""
    x = np.array([band_limited_noise((100, 3000), SAMPLES / FS, fs=FS, rng=20 + i) for i in range(n_references)])
    secondary = decaying(2, 2, delay + 12, 4, delay)
    return Scene(x, through(decaying(2, n_references, 30, 3, 6), x), secondary, nearly(secondary), CHANNEL_TAPS)


def noises() -> dict[str, np.ndarray]:
    """Return the seeded noises of one channel."""
    duration = SAMPLES / FS
    band = band_limited_noise((100, 3000), duration, fs=FS, rng=10)
    softer = 0.5 * band_limited_noise((50, 6000), duration, fs=FS, rng=11)
    return {
        "band noise": band,
        "tone": tone(400.0, duration, fs=FS, amplitude=np.sqrt(2.0)),
        "level jump": level_jump(softer, duration / 2, 10.0, fs=FS),
    }


def unit_power(recording: np.ndarray) -> np.ndarray:
    """Return the first seconds of a recording with a power of 1, (1, n_samples)."""
    first = recording[None, :RECORDED_SAMPLES]
    return first / np.sqrt(np.mean(first**2))


def recorded_scenes() -> tuple[dict[str, Scene], dict[str, str]]:
    """Return scenes of recordings, and the reasons why some of them are missing."""
    scenes: dict[str, Scene] = {}
    skipped: dict[str, str] = {}
    for noise in ("compressor", "motor"):
        try:
            duct = load_measured_duct(noise=noise)
        except DataUnavailableError as error:
            skipped[f"{noise}, duct"] = str(error)
            continue
        paths = duct.primary[None, None], duct.secondary[None, None]
        scenes[f"{noise}, duct"] = recorded_scene(unit_power(duct.noise), *paths, RECORDED_TAPS, pace=0.05)
    try:
        room, recording = load_measured_room(), load_measured_duct(noise="compressor").noise
    except DataUnavailableError as error:
        return scenes, skipped | {"room": str(error)}
    x = unit_power(recording)[:, : RECORDED_SAMPLES // 2]
    for count in (2, 4):
        paths = room.primary[:count], room.secondary[:count, :count]
        scenes[f"room, {count} x {count}"] = recorded_scene(x, *paths, ROOM_TAPS, pace=0.02)
    return scenes, skipped


# ---- Controllers


def rated(power: float = RATED_POWER, **settings: Any) -> OutputPowerConstraint:
    return OutputPowerConstraint(power, **{"fs": FS, "memory_s": 0.02} | settings)


def limiter(power: float = 0.05) -> OutputLimiter:
    return OutputLimiter(power, fs=FS, window_s=0.005)


def made(make: Any, scene: Scene, **settings: Any) -> Any:
    """Return a controller for a scene; a `step` is a step size times the number of taps."""
    if "step" in settings:
        settings["step_size"] = settings.pop("step") / scene.n_taps
    for name in settings.keys() & {"step_size", "output_step_size"}:
        settings[name] *= scene.pace
    if scene.estimate.ndim == 3:
        settings["n_references"] = scene.n_references
    return make(scene.n_taps, scene.estimate, **settings)


def limited_by_window(make: Any) -> Make:
    """Return a function that makes a controller with a limiter of its own."""
    return lambda scene: make(scene, limiter=limiter())


def with_tolerance(controller: Any) -> Any:
    controller.secondary_path_uncertainty = PathTolerance(delay_samples=0.5, gain_db=1.0)
    return controller


def set_up(kf: Any) -> Any:
    """Return a filter of filterpy's kind with the noises of the others."""
    n = kf.dim_x
    kf.P, kf.Q, kf.R = P0 * np.eye(n), R * np.eye(n), Q * np.eye(1)
    return kf


class OwnController:
    """A user's controller: FxLMS in numpy."""

    def __init__(self, scene: Scene) -> None:
        self.estimate, self.n_taps = scene.estimate, scene.n_taps
        self.weights, self.x = np.zeros(scene.n_taps), np.zeros(scene.n_taps + scene.estimate.size - 1)

    def control_signal(self, reference: float) -> float:
        self.x = np.concatenate(([reference], self.x[:-1]))
        return float(self.weights @ self.x[: self.n_taps])

    def update(self, error: float) -> None:
        filtered = np.correlate(self.x, self.estimate, mode="valid")
        self.weights = self.weights + 0.05 / self.n_taps * error * filtered


LMS: dict[str, Any] = {"step": 0.05}
PEAK: dict[str, Any] = LMS | {"amplitude_limit": 0.8}
EARLIER = KALMAN if "form" in signature(kf_pb).parameters else {}  # KF-PB of earlier versions needs noises
# One channel: each is called with a scene and further options. Constraints keep a state, so each run has its own.
SINGLE: dict[str, Any] = {
    "KF-ANC": lambda s, **o: made(kf_anc, s, **KALMAN, **o),
    "KF-OPC": lambda s, **o: made(kf_opc, s, constraint=rated(), **KALMAN, **o),
    "KF-OPC, sliding": lambda s, **o: made(kf_opc, s, constraint=rated(window="sliding"), **KALMAN, **o),
    "KF-OPC repaired": lambda s, **o: made(kf_opc_repaired, s, constraint=rated(), **KALMAN, **o),
    "KF-PB": lambda s, **o: made(kf_pb, s, rated_power=RATED_POWER, fs=FS, **EARLIER, **o),
    "FxRLS": lambda s, **o: made(fx_rls, s, forgetting=0.9995, **o),
    "diagonal KF": lambda s, **o: made(DiagonalKalman, s, **KALMAN, **o),
    "diagonal KF-OPC": lambda s, **o: made(DiagonalKalman, s, constraint=rated(), **KALMAN, **o),
    "fast-array KF": lambda s, **o: made(FastArrayKalman, s, measurement_noise=Q, **o),
    "fast-array KF-OPC": lambda s, **o: made(FastArrayKalman, s, measurement_noise=Q, constraint=rated(), **o),
    "fast-array KF, memory": lambda s, **o: made(FastArrayKalman, s, measurement_noise=Q, memory=8 * s.n_taps, **o),
    "FxLMS": lambda s, **o: made(FxLMS, s, **LMS, **o),
    "FxNLMS": lambda s, **o: made(FxNLMS, s, step_size=0.1, regularization=0.01, **o),
    "leaky FxLMS": lambda s, **o: made(LeakyFxLMS, s, leak=0.1, **LMS, **o),
    "optimal leaky FxLMS": lambda s, **o: made(OptimalLeakyFxLMS, s, constraint=rated(), **LMS, **o),
    "MOV": lambda s, **o: made(MOVFxLMS, s, constraint=rated(), **LMS, **o),
    "MOV, sliding": lambda s, **o: made(MOVFxLMS, s, constraint=rated(window="sliding"), **LMS, **o),
    "MOV, modified": lambda s, **o: made(MOVFxLMS, s, constraint=rated(), modified=True, **LMS, **o),
    "MOV, fixed penalty": lambda s, **o: made(MOVFxLMS, s, constraint=rated(), penalty_factor=0.5, **LMS, **o),
    "two-gradient FxLMS": lambda s, **o: made(TwoGradientFxLMS, s, output_step_size=0.002, **PEAK, **o),
    "re-scaling FxLMS": lambda s, **o: made(RescalingFxLMS, s, **PEAK, **o),
    "clipping FxLMS": lambda s, **o: made(ClippingFxLMS, s, **PEAK, **o),
}
# Those that estimate the disturbance can be told the amplifier.
ESTIMATING = [name for name in SINGLE if name.startswith(("KF", "fast", "diagonal", "FxRLS", "MOV", "optimal"))]
LIMITED = (
    "KF-ANC",
    "KF-OPC",
    "KF-OPC repaired",
    "KF-PB",
    "FxLMS",
    "MOV",
    "two-gradient FxLMS",
    "re-scaling FxLMS",
    "clipping FxLMS",
)
AROUND: dict[str, Make] = {
    "KF-PB, exact path": lambda s: SINGLE["KF-PB"](s, secondary_path_uncertainty=None),
    "KF-OPC, uncertain path": lambda s: with_tolerance(SINGLE["KF-OPC"](s)),
    "FxLMS, uncertain path": lambda s: with_tolerance(SINGLE["FxLMS"](s)),
    "filterpy's filter": lambda s: KalmanController(set_up(KalmanFilter(s.n_taps, 1)), s.estimate),
    "KFOPC": lambda s: KalmanController(set_up(KFOPC(s.n_taps, constraint=rated())), s.estimate),
    "LimitedController": lambda s: LimitedController(OwnController(s), limiter()),
    "VerifiedController": lambda s: controllers.VerifiedController(
        FxLMS(s.n_taps, -s.estimate, step_size=0.02 / s.n_taps), fs=FS
    ),
    "FeedbackNeutralizer": lambda s: FeedbackNeutralizer(SINGLE["FxLMS"](s), [0.0, 0.1, 0.05]),
}


def both(make: Callable[[float], Any]) -> list[Any]:
    """Return a constraint or a limiter for each of as many loudspeakers as a scene has: a rated power each."""
    return [make(0.1), make(0.2)]


SEVERAL: dict[str, Make] = {
    "KF-ANC": lambda s: made(kf_anc, s, **KALMAN),
    "KF-ANC, known amplifiers": lambda s: made(kf_anc, s, amplifier=WIDE, **KALMAN),
    "KF-ANC, uncertain path": lambda s: with_tolerance(made(kf_anc, s, **KALMAN)),
    "KF-OPC": lambda s: made(kf_opc, s, constraint=both(rated), **KALMAN),
    "KF-OPC, limiter": lambda s: made(kf_opc, s, constraint=both(rated), limiter=both(limiter), **KALMAN),
    "KF-PB": lambda s: made(kf_pb, s, rated_power=[0.1, 0.2], fs=FS),
    "KF-PB, exact path": lambda s: made(kf_pb, s, rated_power=[0.1, 0.2], fs=FS, secondary_path_uncertainty=None),
    "KF-PB, limiter": lambda s: made(kf_pb, s, rated_power=0.1, fs=FS, limiter=both(limiter)),
    "FxLMS": lambda s: made(FxLMS, s, **LMS),
    "FxLMS, limiter": lambda s: made(FxLMS, s, limiter=both(limiter), **LMS),
    "FxLMS, uncertain path": lambda s: with_tolerance(made(FxLMS, s, **LMS)),
    "FxNLMS": lambda s: made(FxNLMS, s, step_size=0.1, regularization=0.01),
    "leaky FxLMS": lambda s: made(LeakyFxLMS, s, leak=[0.3, 0.1], **LMS),
    "optimal leaky FxLMS": lambda s: made(OptimalLeakyFxLMS, s, constraint=both(rated), **LMS),
    "MOV": lambda s: made(MOVFxLMS, s, constraint=both(rated), **LMS),
    "MOV, modified": lambda s: made(MOVFxLMS, s, constraint=both(rated), modified=True, amplifier=WIDE, **LMS),
    "MOV, fixed penalty": lambda s: made(MOVFxLMS, s, constraint=both(rated), penalty_factor=[0.5, 0.2], **LMS),
    "two-gradient FxLMS": lambda s: made(TwoGradientFxLMS, s, **PEAK),
    "re-scaling FxLMS": lambda s: made(RescalingFxLMS, s, **LMS, amplitude_limit=[0.3, 0.8]),
    "clipping FxLMS": lambda s: made(ClippingFxLMS, s, **PEAK),
}
AROUND_SEVERAL: dict[str, Make] = {
    "VerifiedController": lambda s: controllers.VerifiedController(SEVERAL["KF-OPC"](s), fs=FS),
    "FeedbackNeutralizer": lambda s: FeedbackNeutralizer(
        SEVERAL["KF-ANC"](s), 0.1 * decaying(s.n_references, 2, 6, 6, 1), amplifier=HARD
    ),
    "VirtualMicrophones": lambda s: VirtualMicrophones(
        made(FxLMS, replace(s, estimate=s.estimate[1:]), **LMS), s.estimate, decaying(1, 1, 6, 5, 0), physical=[0]
    ),
}
ROOM_2 = [*SEVERAL, *AROUND_SEVERAL]
ROOM_4: dict[str, Make] = {
    "KF-ANC": SEVERAL["KF-ANC"],
    "KF-OPC": lambda s: made(kf_opc, s, rated_power=0.1, **KALMAN),
    "KF-PB": lambda s: made(kf_pb, s, rated_power=0.1, fs=FS),
    "FxLMS": SEVERAL["FxLMS"],
    "FxNLMS": SEVERAL["FxNLMS"],
    "MOV": lambda s: made(MOVFxLMS, s, rated_power=0.1, **LMS),
}


# ---- Runs


def state_of(controller: Any) -> Result:
    """Return what a controller holds at the end."""
    names = ("weights", "control_filter", "constraint_factor")
    held = {f"final {name}": getattr(controller, name, None) for name in names}
    return {name: np.array(value, dtype=np.float64) for name, value in held.items() if value is not None}


def signals_of(run: Any) -> Result:
    """Return the signals of a `SimulationResult`."""
    values = {name: getattr(run, name, None) for name in (*SIGNALS, *POWERS)}
    recorded = {name: value for name, value in values.items() if value is not None}
    return recorded | {"diverged_at_s": np.nan if run.diverged_at_s is None else run.diverged_at_s}


def simulated(make: Make, scene: Scene) -> Result:
    """Return the results of a closed loop by `simulate`."""
    controller, every = make(scene), scene.x.shape[-1] // 4
    own: dict[str, Any] = {"record_powers": True} if scene.secondary.ndim == 1 else {}
    own |= {"record_weights_every": every} if hasattr(controller, "weights") else {}
    noise: dict[str, Any] = {"sensor_noise_std": SENSOR_NOISE, "rng": 11}
    run = simulate(
        controller, scene.x, secondary_path=scene.secondary, disturbance=scene.d, fs=FS, **own, **noise, **scene.options
    )
    return signals_of(run) | state_of(controller)


def called(make: Make, scene: Scene, blocks: bool) -> Result:
    """Return the results of a closed loop that Python runs: sample by sample, or by `process` with pauses.

    In the middle it gets another secondary path, and later half its rated power.
    """
    controller, n = make(scene), STEPPED_SAMPLES
    single = scene.secondary.ndim == 1
    s = scene.secondary[None, None] if single else scene.secondary
    x, d = np.atleast_2d(scene.x)[:, :n], np.atleast_2d(scene.d)[:, :n]
    d = d + SENSOR_NOISE * np.random.default_rng(11).standard_normal(d.shape)
    past = s.shape[2]
    y, e = np.zeros((s.shape[1], past + n)), np.zeros_like(d)  # y after as much silence as the path is long
    adapting = np.random.default_rng(12).random(n) > 0.1
    changes, first, turn = [n // 2, 3 * n // 4], 0, 0
    while first < n:
        if changes and first >= changes[0]:
            del changes[0]
            if changes:
                controller.secondary_path = 0.9 * scene.estimate + 0.1 * np.roll(scene.estimate, 1, axis=-1)
            elif getattr(controller, "rated_power", None) is not None:
                controller.rated_power = 0.5 * np.asarray(controller.rated_power)[()]
        end = min(first + (BLOCKS[turn % len(BLOCKS)] if blocks else 1), n)
        now, then = slice(first, end), slice(past + first, past + end)
        if blocks:  # the path delays by a block, so its errors are known before
            e[:, now] = heard(s, y, d, first, end)
            xs, es = (x[0, now], e[0, now]) if single else (x[:, now], e[:, now])
            y[:, then] = controller.process(xs, es, adapt=adapting[now])
        else:
            y[:, then] = np.reshape(controller.control_signal(x[0, first] if single else x[:, first]), (-1, 1))
            e[:, now] = heard(s, y, d, first, end)
            controller.update(e[0, first] if single else e[:, first])
        first, turn = end, turn + 1
    return {"control_signal": y[:, past:], "error": e} | state_of(controller)


def heard(s: np.ndarray, y: np.ndarray, d: np.ndarray, first: int, end: int) -> np.ndarray:
    """Return the errors of some samples, from control signals that begin with as much silence as the path is long."""
    taps = s.shape[2]
    rows = [y[:, n + taps : n : -1] for n in range(first, end)]
    return d[:, first:end] - np.einsum("kjt,njt->kn", s, np.array(rows))


def shared_gains(scene: Scene) -> Result:
    """Return the results of three KF-OPC that share their gains."""
    controllers = [SINGLE["KF-ANC"](scene), *(made(kf_opc, scene, rated_power=p, **KALMAN) for p in (0.1, 0.4))]
    plant: dict[str, Any] = {"secondary_path": scene.secondary, "disturbance": scene.d, "fs": FS, "amplifier": HARD}
    runs = simulate_scenarios(controllers, scene.x, sensor_noise_std=SENSOR_NOISE, rng=11, **plant)
    return {
        f"{name}, {i}": value
        for i, (run, controller) in enumerate(zip(runs, controllers, strict=True))
        for name, value in (signals_of(run) | state_of(controller)).items()
    }


def filtered(make: Callable[[], Any]) -> Result:
    """Return what a filter estimates of a path, from its own `predict` and `update`."""
    kf, rng = make(), np.random.default_rng(13)
    x = rng.standard_normal(2000)
    rows = np.lib.stride_tricks.sliding_window_view(np.concatenate((np.zeros(kf.dim_x - 1), x)), kf.dim_x)[:, ::-1]
    z = rows @ decaying(1, 1, kf.dim_x, 1, 0)[0, 0] + SENSOR_NOISE * rng.standard_normal(x.size)
    states = np.zeros((x.size, kf.dim_x))
    for n, row in enumerate(rows):
        if hasattr(kf, "control_signal"):
            kf.control_signal(x[n])
        kf.predict()
        kf.update(z[n], H=row[None, :].copy(), reference=x[n])
        states[n] = np.ravel(kf.x)
    return {"x": states, "P": np.array(kf.P, dtype=np.float64)}


FILTERS: dict[str, Callable[[], Any]] = {
    "KFOPC": lambda: set_up(KFOPC(TAPS, constraint=rated())),
    "random walk": lambda: KFOPC.random_walk(TAPS, **KALMAN),
    "random walk, KF-OPC": lambda: KFOPC.random_walk(TAPS, constraint=rated(), **KALMAN),
}


def all_cases() -> tuple[dict[str, Callable[[], Result]], dict[str, str]]:
    """Return the cases by name, and what is skipped, with the reason."""
    scenes = {name: one_channel(x) for name, x in noises().items()}
    band, jump = scenes["band noise"], scenes["level jump"]
    limited: dict[str, Make] = {name: limited_by_window(SINGLE[name]) for name in LIMITED}
    knowing: dict[str, Make] = {name: partial(SINGLE[name], amplifier=SOFT) for name in ESTIMATING}
    fed_back = band.having(feedback_path=[0.0, 0.15, -0.1, 0.05, 0.0, 0.02], switch_on_s=0.05)
    groups: dict[str, tuple[Scene, dict[str, Make]]] = {
        **{name: (scene, SINGLE) for name, scene in scenes.items()},
        "around others": (band, AROUND),
        "limiter": (jump, limited),
        "unknown hard clip": (band.having(amplifier=HARD), SINGLE),
        "known soft saturation": (band.having(amplifier=SOFT), knowing),
        "feedback, switched on later": (fed_back, SINGLE),
    }
    for count in (1, 2):
        many = channels(count)
        feedback = 0.1 * decaying(count, 2, 6, 6, 1)
        around = {"VirtualMicrophones": AROUND_SEVERAL["VirtualMicrophones"]} if count == 1 else AROUND_SEVERAL
        groups[f"2 x 2 x {count}"] = (many, SEVERAL | around)
        groups[f"2 x 2 x {count}, feedback, switched on later"] = (
            many.having(feedback_path=feedback, switch_on_s=0.05, amplifier=WIDE),
            SEVERAL,
        )
    recorded, skipped = recorded_scenes()
    for name, scene in recorded.items():
        several = ROOM_4 if "4" in name else {one: (SEVERAL | AROUND_SEVERAL)[one] for one in ROOM_2}
        groups[name] = (scene, SINGLE if scene.secondary.ndim == 1 else several)
    cases: dict[str, Callable[[], Result]] = {
        f"{group}: {name}": partial(simulated, make, scene)
        for group, (scene, makers) in groups.items()
        for name, make in makers.items()
    }
    late = np.concatenate((np.zeros(max(BLOCKS)), band.secondary))
    delayed = replace(band, secondary=late, estimate=nearly(late), pace=0.3)
    for group, (scene, makers) in {
        "sample by sample": (band, SINGLE),
        "sample by sample, 2 x 2 x 2": (channels(2), SEVERAL),
        "blocks": (delayed, SINGLE),
        "blocks, 2 x 2 x 1": (replace(channels(1, delay=max(BLOCKS)), pace=0.3), SEVERAL),
    }.items():
        blocks = group.startswith("blocks")
        cases |= {f"{group}: {name}": partial(called, make, scene, blocks) for name, make in makers.items()}
    cases["shared gains: KF-OPC"] = partial(shared_gains, band)
    return cases | {f"filter: {name}": partial(filtered, make) for name, make in FILTERS.items()}, skipped


def is_chosen(name: str, pattern: str) -> bool:
    """Return whether a name contains a pattern."""
    return fnmatch(name.lower(), f"*{pattern.lower()}*")


def write_cases(folder: Path, pattern: str) -> None:
    """Write the results of each case into a file; one that is there is kept, so that a run can be continued."""
    cases, skipped = all_cases()
    chosen = [name for name in cases if is_chosen(name, pattern)]
    text = {"package": kfopc_filterpy.__file__, "cases": chosen, "skipped": skipped}
    (folder / LIST).write_text(json.dumps(text), encoding="utf-8")
    for index, name in enumerate(chosen):
        path = folder / f"{index}.npz"
        if path.exists():
            continue
        try:
            result = cases[name]()
        except Exception as error:  # the other cases must run
            traceback.print_exc()
            result = {"failed": f"{type(error).__name__}: {error}"}
        unfinished = path.with_suffix(".part")
        with unfinished.open("wb") as file:
            np.savez(file, **result)
        unfinished.replace(path)


# ---- Times


def fastest(work: Callable[[], Any], samples: int) -> float:
    """Return the least time of a sample in µs, of three calls after one that compiles."""
    work()
    spent = []
    for _ in range(3):
        began = time.perf_counter()
        work()
        spent.append(time.perf_counter() - began)
    return min(spent) / samples * 1e6


def timed(make: Make, scene: Scene, n_taps: int, samples: int) -> float:
    """Return the time of a sample of `simulate` in µs."""
    scene = replace(scene, n_taps=n_taps)
    controller, (x, d) = (
        make(scene),
        (np.resize(signal, (*signal.shape[:-1], samples)) for signal in (scene.x, scene.d)),
    )
    run = partial(simulate, controller, x, disturbance=d, secondary_path=scene.secondary, fs=FS)
    return fastest(run, samples)


def stepped(make: Make, scene: Scene) -> float:
    """Return the time of a sample that Python steps through, in µs."""
    controller, x, d = make(scene), scene.x.tolist(), (0.001 * scene.d).tolist()

    def work() -> None:
        for n in range(2000):
            controller.control_signal(x[n])
            controller.update(d[n])

    return fastest(work, 2000)


def all_times() -> dict[str, Callable[[], float]]:
    """Return what is timed, by name."""
    single, many = one_channel(noises()["band noise"]), channels(2)
    times: dict[str, Callable[[], float]] = {}
    for n_taps in (32, 128, 256, 512):
        for name in ("FxLMS", "FxNLMS", "MOV", "KF-ANC", "KF-OPC", "KF-PB"):
            samples = max(1000, 20_000_000 // n_taps**2) if name.startswith("KF") else 100_000
            times[f"{name}, {n_taps} taps"] = partial(timed, SINGLE[name], single, n_taps, samples)
    for n_taps in (32, 256):
        times[f"FxLMS, {n_taps} taps, 2 x 2 x 2"] = partial(timed, SEVERAL["FxLMS"], many, n_taps, 20_000)
    for name in ("FxLMS", "KF-OPC"):
        times[f"{name}, {TAPS} taps, stepped from Python"] = partial(stepped, SINGLE[name], single)
    return times


def write_times(path: Path, pattern: str) -> None:
    """Write the times of a sample in µs, by what was timed."""
    times = {name: measure() for name, measure in all_times().items() if is_chosen(name, pattern)}
    text = {"package": kfopc_filterpy.__file__, "times": times}
    path.write_text(json.dumps(text), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("cases", "times"))
    parser.add_argument("output", type=Path)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    if options.what == "cases":
        write_cases(options.output, options.only)
    else:
        write_times(options.output, options.only)


if __name__ == "__main__":
    main()
