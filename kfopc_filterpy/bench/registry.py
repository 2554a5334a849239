"""The algorithms that studies compare: how each is made for a scene, and the settings that are tried to tune it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from kfopc_filterpy import (
    ClippingFxLMS,
    DiagonalKalman,
    FxLMS,
    FxNLMS,
    LeakyFxLMS,
    MOVFxLMS,
    OptimalLeakyFxLMS,
    OutputPowerConstraint,
    RescalingFxLMS,
    TwoGradientFxLMS,
    fx_rls,
    kf_anc,
    kf_opc,
    kf_opc_repaired,
    kf_pb,
)
from kfopc_filterpy.controllers import Controller, penalty_factor
from kfopc_filterpy.controllers.power_budget import DEFAULT_AVERAGING_S
from kfopc_filterpy.power.amplifiers import Amplifier

from .scene import Scene

# r E[x'^2] / q: the filter forgets over about its inverse square root in samples, 0.6 s to 6 ms at 16 kHz. Less state
# noise makes it recursive least squares that never forgets, which would always be best for stationary noise; the tonal
# study shows the difference.
STATE_NOISE_GRID = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4)
STEP_SIZE_GRID = tuple((2.0 ** -np.arange(1.0, 15.0)).tolist())
# The diagonal filter learns as slowly as NLMS, and needs less state noise.
DIAGONAL_GRID = (1e-12, 1e-11, 1e-10, 1e-9, *STATE_NOISE_GRID)
FORGETTING_GRID = (1e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3)
PRICE_GRID = tuple((10.0 ** np.arange(-2.0, 3.1, 0.5)).tolist())  # a finer grid around the best value follows
PEAK_GRID = tuple((2.0 ** np.arange(-14.0, 4.1, 2.0)).tolist())

Setting = float | tuple[float, float]


@dataclass(frozen=True)
class Algorithm:
    """One algorithm of the registry: how it is made and tuned.

    Parameters
    ----------
    make : callable
        Function of a scene, the first setting in the scene's units, the second setting, and the amplifier known to the
        disturbance estimate. It returns a fresh controller.
    symbol : str
        Parameter that the first setting sets: "r", "mu", "1 - lambda" or "averaging_s".
    kind : str
        The first setting as a formula, without units.
    first : tuple of float
        Values of the first setting that are tried.
    second_kind : str, default ""
        The second setting as a formula, "" if there is none.
    second : tuple of float, default ()
        Values of the second setting that are tried.
    of_paper : bool, default False
        Whether the paper compares it.
    keeps_budget : bool, default True
        Whether it is meant to keep the rated power.
    sees_budget : bool, default True
        Whether it is made with the rated power. If not, its runs serve for all rated powers.
    shares_gains : bool, default False
        Whether its gain depends on the reference alone, so that several runs on one noise share it.
    knows_amplifier : bool, default False
        Whether its disturbance estimate can know the amplifier.
    may_refuse : bool, default False
        Whether it may stop during a run because it cannot continue, which counts as divergence.
    one_channel, several_channels : bool, default True, False
        Whether the studies of one channel, or of several channels, compare it.
    """

    make: Callable[[Scene, float, float, Amplifier | Sequence[Amplifier] | None], Controller]
    symbol: str
    kind: str
    first: tuple[float, ...]
    second_kind: str = ""
    second: tuple[float, ...] = ()
    of_paper: bool = False
    keeps_budget: bool = True
    sees_budget: bool = True
    shares_gains: bool = False
    knows_amplifier: bool = False
    may_refuse: bool = False
    one_channel: bool = True
    several_channels: bool = False

    @property
    def grid(self) -> list[Setting]:
        """Settings that are tried: numbers, or pairs if there is a second setting."""
        if not self.second:
            return list(self.first)
        return [(one, two) for one in self.first for two in self.second]

    def finer(self, best: Setting) -> list[Setting]:
        """Return settings around `best`, the best of the grid; none unless there is a second setting.

        The second setting decides how the budget is spent, so it needs the finer steps.
        """
        if not isinstance(best, tuple):
            return []
        ratio = self.second[1] / self.second[0]
        near = [best[1] * ratio ** (k / 6) for k in range(-5, 6) if k]
        return [(one, two) for one in (best[0] / 2, best[0], 2 * best[0]) for two in near]

    def value(self, scene: Scene, setting: Setting) -> float:
        """Return the r, mu, 1 - lambda or averaging time in s that a `setting` stands for, in the units of a `scene`."""
        first = setting[0] if isinstance(setting, tuple) else setting
        if self.symbol == "r":
            return first * scene.measurement_noise / scene.filtered_power
        return first / (scene.n_taps * scene.filtered_power) if self.symbol == "mu" else first


def _constraint(scene: Scene) -> Any:
    """Return the constraint of the scene, or one for each loudspeaker."""
    if np.ndim(scene.rated_power):
        return [OutputPowerConstraint(p, fs=scene.fs, memory_s=scene.power_memory_s) for p in scene.rated_power]
    return OutputPowerConstraint(scene.rated_power, fs=scene.fs, memory_s=scene.power_memory_s)


def _references(scene: Scene) -> dict[str, Any]:
    """Return the number of references as a keyword argument if there are several channels, else none."""
    return {"n_references": len(scene.references[0])} if scene.secondary.ndim == 3 else {}


def _kalman(make: Any, *, free: bool = False) -> Callable[..., Controller]:
    """Return a function that makes Kalman filters: with a constraint, or `free` of one."""

    def made(scene: Scene, r: float, _: float, amplifier: Amplifier | Sequence[Amplifier] | None) -> Controller:
        settings: dict[str, Any] = {
            "state_noise": r,
            "measurement_noise": scene.measurement_noise,
            "initial_variance": scene.initial_variance,
            "amplifier": amplifier,
            **_references(scene),
        }
        if not free:
            settings |= {"constraint": _constraint(scene)}
        return make(scene.n_taps, scene.known_secondary, **settings)

    return made


def _power_budget(
    scene: Scene, averaging_s: float, _: float, amplifier: Amplifier | Sequence[Amplifier] | None
) -> Controller:
    return kf_pb(
        scene.n_taps,
        scene.known_secondary,
        rated_power=scene.rated_power,
        secondary_path_uncertainty=scene.secondary_path_uncertainty,
        fs=scene.fs,
        averaging_s=averaging_s,
        amplifier=amplifier,
        **_references(scene),
    )


def _rated(kind: Any, **more: Any) -> Callable[..., Controller]:
    def made(scene: Scene, mu: float, _: float, amplifier: Amplifier | Sequence[Amplifier] | None) -> Controller:
        own: dict[str, Any] = {"constraint": _constraint(scene), "amplifier": amplifier, **_references(scene), **more}
        return kind(scene.n_taps, scene.known_secondary, step_size=mu, **own)

    return made


def _plain(kind: Any) -> Callable[..., Controller]:
    return lambda scene, mu, _, amplifier: kind(scene.n_taps, scene.known_secondary, step_size=mu, **_references(scene))


def _normalised(scene: Scene, mu: float, _: float, amplifier: Amplifier | Sequence[Amplifier] | None) -> Controller:
    energy = scene.n_taps * scene.filtered_power  # mu compares with FxLMS; the ridge is for the start-up
    settings: dict[str, Any] = {"step_size": mu * energy, "regularization": 0.01 * energy, **_references(scene)}
    return FxNLMS(scene.n_taps, scene.known_secondary, **settings)


def _leaky(scene: Scene, mu: float, price: float, amplifier: Amplifier | Sequence[Amplifier] | None) -> Controller:
    leak = min(price * scene.filtered_power, 1.0 / mu)
    return LeakyFxLMS(scene.n_taps, scene.known_secondary, step_size=mu, leak=leak, **_references(scene))


def _mov_fixed(scene: Scene, mu: float, price: float, amplifier: Amplifier | Sequence[Amplifier] | None) -> Controller:
    return _mov(scene, mu, price * scene.secondary_gain, amplifier, "MOV-FxLMS fixed")


def _mov_by_variance(
    scene: Scene, mu: float, _: float, amplifier: Amplifier | Sequence[Amplifier] | None
) -> Controller:
    """Take the penalty from the variance of the whole disturbance, as the public code of its authors does.

    They use the secondary path's gain for the disturbance, from an inverse model of the path; here the gain is that of
    eq. 11, as for all algorithms. The penalty hardly depends on it if the noise needs about four times the rated power.
    """
    variance = float(np.var(scene.settled[1]))
    gamma = penalty_factor(scene.rated_power, disturbance_power=variance, secondary_path_gain=scene.secondary_gain)
    return _mov(scene, mu, gamma, amplifier, "MOV-FxLMS by variance")


def _mov(
    scene: Scene, mu: float, gamma: float, amplifier: Amplifier | Sequence[Amplifier] | None, name: str
) -> Controller:
    """Return an MOV-FxLMS with a fixed penalty, named differently from the one whose penalty follows the powers."""
    controller = MOVFxLMS(
        scene.n_taps,
        scene.known_secondary,
        step_size=mu,
        constraint=_constraint(scene),
        penalty_factor=gamma,
        amplifier=amplifier,
        **_references(scene),
    )
    controller.name = name
    return controller


def _peak(kind: Any) -> Callable[..., Controller]:
    def made(scene: Scene, mu: float, share: float, amplifier: Amplifier | Sequence[Amplifier] | None) -> Controller:
        limit = np.sqrt(share * scene.unconstrained_power)
        more: dict[str, Any] = {"output_step_size": mu * scene.secondary_gain} if kind is TwoGradientFxLMS else {}
        return kind(
            scene.n_taps, scene.known_secondary, step_size=mu, amplitude_limit=limit, **_references(scene), **more
        )

    return made


def _rls(scene: Scene, forgetting: float, _: float, amplifier: Amplifier | Sequence[Amplifier] | None) -> Controller:
    return fx_rls(
        scene.n_taps,
        scene.known_secondary,
        forgetting=1.0 - forgetting,
        initial_variance=scene.initial_variance / scene.measurement_noise,
        amplifier=cast("Amplifier | None", amplifier),
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
_CHANNELS: dict[str, Any] = {"several_channels": True}
REGISTRY: dict[str, Algorithm] = {
    "KF-ANC": Algorithm(
        _kalman(kf_anc, free=True), of_paper=True, shares_gains=True, **_RANDOM_WALK, **_FREE, **_CHANNELS
    ),
    "KF-OPC": Algorithm(_kalman(kf_opc), of_paper=True, shares_gains=True, **_RANDOM_WALK, **_CHANNELS),
    "KF-OPC repaired": Algorithm(_kalman(kf_opc_repaired), **_RANDOM_WALK),
    "KF-PB": Algorithm(
        _power_budget,
        symbol="averaging_s",
        kind="averaging time in s",
        first=(DEFAULT_AVERAGING_S,),
        **_KNOWS,
        **_CHANNELS,
    ),
    "diagonal KF": Algorithm(_kalman(DiagonalKalman, free=True), **_DIAGONAL, **_FREE),
    "diagonal KF-OPC": Algorithm(_kalman(DiagonalKalman), **_DIAGONAL),
    "FxRLS": Algorithm(_rls, may_refuse=True, **_LEAST_FORGOTTEN, **_FREE, **_KNOWS),
    "FxLMS": Algorithm(_plain(FxLMS), of_paper=True, **_STEP, **_FREE, **_CHANNELS),
    "FxNLMS": Algorithm(_normalised, **_STEP, **_FREE, **_CHANNELS),
    "leaky FxLMS": Algorithm(
        _leaky, **_STEP, second_kind="leak over E[x'^2]", second=PRICE_GRID, sees_budget=False, **_CHANNELS
    ),
    "optimal leaky FxLMS": Algorithm(_rated(OptimalLeakyFxLMS), **_STEP, **_KNOWS, **_CHANNELS),
    "MOV-FxLMS fixed": Algorithm(
        _mov_fixed,
        **_STEP,
        second_kind="penalty factor over G_s",
        second=PRICE_GRID,
        sees_budget=False,
        **_KNOWS,
        **_CHANNELS,
    ),
    "MOV-FxLMS by variance": Algorithm(_mov_by_variance, **_STEP, **_KNOWS),
    "MOV-FxLMS": Algorithm(_rated(MOVFxLMS), of_paper=True, **_STEP, **_KNOWS, **_CHANNELS),
    "MOV-MFxLMS": Algorithm(_rated(MOVFxLMS, modified=True), **_STEP, **_KNOWS, **_CHANNELS),
    "two-gradient FxLMS": Algorithm(_peak(TwoGradientFxLMS), **_PEAK, **_CHANNELS),
    "re-scaling FxLMS": Algorithm(_peak(RescalingFxLMS), **_PEAK, **_CHANNELS),
    "clipping FxLMS": Algorithm(_peak(ClippingFxLMS), **_PEAK, **_CHANNELS),
}


def algorithms(*, several_channels: bool = False) -> Mapping[str, Algorithm]:
    """Return the registry of the algorithms that studies and sweeps compare, by name.

    Parameters
    ----------
    several_channels : bool, default False
        Whether to return the algorithms that are compared with several loudspeakers and microphones, or those compared
        with one of each.

    Returns
    -------
    mapping of str to Algorithm
        A view that cannot be changed, in the order of the tables.

    Examples
    --------
    >>> from kfopc_filterpy.bench import algorithms
    >>> [name for name, algorithm in algorithms().items() if algorithm.of_paper]
    ['KF-ANC', 'KF-OPC', 'FxLMS', 'MOV-FxLMS']
    >>> algorithms()["KF-OPC"].grid
    [1e-08, 1e-07, 1e-06, 1e-05, 0.0001]
    >>> "FxRLS" in algorithms(), "FxRLS" in algorithms(several_channels=True)
    (True, False)
    """
    wanted = "several_channels" if several_channels else "one_channel"
    return MappingProxyType({name: own for name, own in REGISTRY.items() if getattr(own, wanted)})


def make_controller(
    scene: Scene, algorithm: str, setting: Setting, *, amplifier: Amplifier | Sequence[Amplifier] | None = None
) -> Any:
    """Return a fresh controller for a scene.

    Parameters
    ----------
    scene : Scene
        Scene that gives the taps, the known secondary path, q, P0 and the rated power.
    algorithm : str
        Name in the registry, see `algorithms`.
    setting : float or tuple of float
        A setting from its grid, or one of the same kind.
    amplifier : amplifier, optional
        Amplifier that the disturbance estimate knows, for algorithms that can; by default the scene's known one.

    Returns
    -------
    Controller
        The controller, with all weights zero.

    Examples
    --------
    >>> from kfopc_filterpy.bench import make_controller, make_scene
    >>> from kfopc_filterpy.signals import tone
    >>> scene = make_scene({0: tone(400.0, 1.0, fs=8000)}, [0, 0, 1.0], [0, 1.0], fs=8000, rated_power=1.0,
    ...                    power_multiple=2.0, n_taps=8)
    >>> make_controller(scene, "KF-OPC", 1e-6).rated_power
    1.0
    """
    several = scene.secondary.ndim == 3
    if algorithm not in algorithms(several_channels=several):
        channels = "several channels" if several else "one channel"
        raise ValueError(f"{algorithm} is not compared with {channels}: see algorithms(several_channels={several})")
    second = setting[1] if isinstance(setting, tuple) else np.nan
    amplifier = scene.known_amplifier if amplifier is None else amplifier
    own = REGISTRY[algorithm]
    return own.make(scene, own.value(scene, setting), second, amplifier)
