"""The algorithms that studies compare: how each is made for a scene, and the settings that are tried to tune it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from kfopc_filterpy import (
    ClippingFxLMS,
    DiagonalKalman,
    FxLMS,
    FxNLMS,
    LeakyFxLMS,
    MOVFxLMS,
    OptimalLeakyFxLMS,
    RescalingFxLMS,
    TwoGradientFxLMS,
    fx_rls,
    kf_anc,
    kf_opc,
    kf_opc_repaired,
    kf_pb,
)
from kfopc_filterpy.controllers.base import FilteredReferenceController
from kfopc_filterpy.power.amplifiers import Amplifier

from .scene import Scene

ALGORITHMS = ("KF-ANC", "KF-OPC", "FxLMS", "MOV-FxLMS")  # the paper's
KALMAN = ("KF-ANC", "KF-OPC")  # whose runs share gains
BUDGETED = ("KF-OPC repaired", "KF-PB")
POWER_MEMORY_S = 0.5
# r E[x'^2] / q: the filter forgets over about its inverse square root in samples, 0.6 s to 6 ms at 16 kHz. Less state
# noise is no random walk any more but recursive least squares that never forgets, which a stationary noise would always
# favour; the tonal study shows what it changes.
STATE_NOISE_GRID = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4)
STEP_SIZE_GRID = tuple((2.0 ** -np.arange(1.0, 15.0)).tolist())
# The diagonal filter learns as slowly as NLMS does, and asks for less state noise.
DIAGONAL_GRID = (1e-12, 1e-11, 1e-10, 1e-9, *STATE_NOISE_GRID)
FORGETTING_GRID = (1e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3)
PRICE_GRID = tuple((10.0 ** np.arange(-2.0, 3.1, 0.5)).tolist())  # a finer one follows around the best
PEAK_GRID = tuple((2.0 ** np.arange(-14.0, 4.1, 2.0)).tolist())

Setting = float | tuple[float, float]


@dataclass(frozen=True)
class Algorithm:
    """How an algorithm is made and tuned.

    `make` takes a scene, the first setting in the scene's units, the second as it stands, and the amplifier that the
    disturbance estimate knows.
    """

    make: Callable[[Scene, float, float, Amplifier | None], FilteredReferenceController]
    symbol: str  # what the first setting sets
    kind: str  # what the first setting is
    first: tuple[float, ...]
    second_kind: str = ""
    second: tuple[float, ...] = ()
    keeps_budget: bool = True
    sees_budget: bool = True  # whether it is made with the rated power; if not, runs serve for all rated powers
    knows_amplifier: bool = False
    may_refuse: bool = False  # whether it may find in a run that it cannot go on, which counts as divergence

    @property
    def grid(self) -> list[Setting]:
        """Settings that are tried."""
        if not self.second:
            return list(self.first)
        return [(one, two) for one in self.first for two in self.second]

    def finer(self, best: Setting) -> list[Setting]:
        """Settings around the best of the grid, where there is a second: that decides how the budget is spent."""
        if not isinstance(best, tuple):
            return []
        ratio = self.second[1] / self.second[0]
        near = [best[1] * ratio ** (k / 6) for k in range(-5, 6) if k]
        return [(one, two) for one in (best[0] / 2, best[0], 2 * best[0]) for two in near]


def _kalman(make: Any, constrained: bool = True, **more: Any) -> Callable[..., FilteredReferenceController]:
    def made(scene: Scene, r: float, _: float, amplifier: Amplifier | None) -> FilteredReferenceController:
        settings: dict[str, Any] = {
            "state_noise": r,
            "measurement_noise": scene.measurement_noise,
            "initial_variance": scene.initial_variance,
            "amplifier": amplifier,
        }
        if constrained:
            settings |= {"rated_power": scene.rated_power, "fs": scene.fs}
        return make(scene.n_taps, scene.known_secondary, **settings, **more)

    return made


def _rated(kind: Any, **more: Any) -> Callable[..., FilteredReferenceController]:
    def made(scene: Scene, mu: float, _: float, amplifier: Amplifier | None) -> FilteredReferenceController:
        return kind(
            scene.n_taps,
            scene.known_secondary,
            step_size=mu,
            rated_power=scene.rated_power,
            fs=scene.fs,
            power_memory=POWER_MEMORY_S,
            amplifier=amplifier,
            **more,
        )

    return made


def _plain(kind: Any) -> Callable[..., FilteredReferenceController]:
    return lambda scene, mu, _, amplifier: kind(scene.n_taps, scene.known_secondary, step_size=mu)


def _normalised(scene: Scene, mu: float, _: float, amplifier: Amplifier | None) -> FilteredReferenceController:
    energy = scene.n_taps * scene.filtered_power  # mu is that of FxLMS; the first rows are short, hence the bottom
    return FxNLMS(scene.n_taps, scene.known_secondary, step_size=mu * energy, regularization=0.01 * energy)


def _leaky(scene: Scene, mu: float, price: float, amplifier: Amplifier | None) -> FilteredReferenceController:
    leak = min(price * scene.filtered_power, 1.0 / mu)
    return LeakyFxLMS(scene.n_taps, scene.known_secondary, step_size=mu, leak=leak)


def _mov_fixed(scene: Scene, mu: float, price: float, amplifier: Amplifier | None) -> FilteredReferenceController:
    controller = MOVFxLMS(
        scene.n_taps,
        scene.known_secondary,
        step_size=mu,
        rated_power=scene.rated_power,
        fs=scene.fs,
        penalty_factor=price * scene.secondary_gain,
        amplifier=amplifier,
    )
    controller.name = "MOV-FxLMS fixed"
    return controller


def _peak(kind: Any) -> Callable[..., FilteredReferenceController]:
    def made(scene: Scene, mu: float, share: float, amplifier: Amplifier | None) -> FilteredReferenceController:
        limit = float(np.sqrt(share * scene.unconstrained_power))
        more = {"output_step_size": mu * scene.secondary_gain} if kind is TwoGradientFxLMS else {}
        return kind(scene.n_taps, scene.known_secondary, step_size=mu, amplitude_limit=limit, **more)

    return made


def _rls(scene: Scene, forgetting: float, _: float, amplifier: Amplifier | None) -> FilteredReferenceController:
    return fx_rls(
        scene.n_taps,
        scene.known_secondary,
        forgetting=1.0 - forgetting,
        initial_variance=scene.initial_variance / scene.measurement_noise,
        amplifier=amplifier,
    )


_RANDOM_WALK: dict[str, Any] = {
    "symbol": "r",
    "kind": "r E[x'^2]/q",
    "first": STATE_NOISE_GRID,
    "knows_amplifier": True,
}
_DIAGONAL = _RANDOM_WALK | {"first": DIAGONAL_GRID}
_STEP: dict[str, Any] = {"symbol": "mu", "kind": "mu L E[x'^2]", "first": STEP_SIZE_GRID}
_LEAST_FORGOTTEN: dict[str, Any] = {"symbol": "1 - lambda", "kind": "1 - lambda", "first": FORGETTING_GRID}
_PEAK: dict[str, Any] = _STEP | {
    "second_kind": "A^2 over the unconstrained power",
    "second": PEAK_GRID,
    "sees_budget": False,
}
_FREE: dict[str, Any] = {"keeps_budget": False, "sees_budget": False}
_KNOWS: dict[str, Any] = {"knows_amplifier": True}
REGISTRY: dict[str, Algorithm] = {
    "KF-ANC": Algorithm(_kalman(kf_anc, False), **_RANDOM_WALK, **_FREE),
    "KF-OPC": Algorithm(_kalman(kf_opc, power_memory=POWER_MEMORY_S), **_RANDOM_WALK),
    "KF-OPC repaired": Algorithm(_kalman(kf_opc_repaired, power_memory=POWER_MEMORY_S), **_RANDOM_WALK),
    "KF-PB": Algorithm(_kalman(kf_pb), **_RANDOM_WALK),
    "diagonal KF": Algorithm(_kalman(DiagonalKalman, False), **_DIAGONAL, **_FREE),
    "diagonal KF-OPC": Algorithm(_kalman(DiagonalKalman, power_memory=POWER_MEMORY_S), **_DIAGONAL),
    "FxRLS": Algorithm(_rls, may_refuse=True, **_LEAST_FORGOTTEN, **_FREE, **_KNOWS),
    "FxLMS": Algorithm(_plain(FxLMS), **_STEP, **_FREE),
    "FxNLMS": Algorithm(_normalised, **_STEP, **_FREE),
    "leaky FxLMS": Algorithm(_leaky, **_STEP, second_kind="leak over E[x'^2]", second=PRICE_GRID, sees_budget=False),
    "optimal leaky FxLMS": Algorithm(_rated(OptimalLeakyFxLMS), **_STEP, **_KNOWS),
    "MOV-FxLMS fixed": Algorithm(
        _mov_fixed, **_STEP, second_kind="penalty factor over G_s", second=PRICE_GRID, sees_budget=False, **_KNOWS
    ),
    "MOV-FxLMS": Algorithm(_rated(MOVFxLMS), **_STEP, **_KNOWS),
    "MOV-MFxLMS": Algorithm(_rated(MOVFxLMS, modified=True), **_STEP, **_KNOWS),
    "two-gradient FxLMS": Algorithm(_peak(TwoGradientFxLMS), **_PEAK),
    "re-scaling FxLMS": Algorithm(_peak(RescalingFxLMS), **_PEAK),
    "clipping FxLMS": Algorithm(_peak(ClippingFxLMS), **_PEAK),
}


def make_controller(
    scene: Scene, algorithm: str, setting: Setting, *, amplifier: Amplifier | None = None
) -> FilteredReferenceController:
    """A fresh controller of an algorithm of `REGISTRY`, with a setting of its grid or like it.

    `amplifier` is the one that the disturbance estimate knows, for algorithms that have one; by default the scene's
    known one.
    """
    second = setting[1] if isinstance(setting, tuple) else np.nan
    amplifier = scene.known_amplifier if amplifier is None else amplifier
    return REGISTRY[algorithm].make(scene, setting_value(scene, algorithm, setting), second, amplifier)


def setting_value(scene: Scene, algorithm: str, setting: Setting) -> float:
    """State noise r, step size mu or 1 - lambda of a setting, in the scene's units."""
    first, kind = (setting[0] if isinstance(setting, tuple) else setting), REGISTRY[algorithm].symbol
    if kind == "r":
        return first * scene.measurement_noise / scene.filtered_power
    return first if kind == "1 - lambda" else first / (scene.n_taps * scene.filtered_power)


def grid(algorithm: str) -> list[Setting]:
    """Settings that are tried for an algorithm."""
    return REGISTRY[algorithm].grid
