"""The algorithms that studies compare: how each is made for a scene, and the settings that are tried to tune it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from kfopc_filterpy import OutputPowerConstraint
from kfopc_filterpy.controllers import Controller, penalty_factor
from kfopc_filterpy.controllers.table import MAKERS
from kfopc_filterpy.power.amplifiers import Amplifier
from kfopc_filterpy.verdict.candidates import DIAGONAL_STATE_NOISES, FORGOTTEN, STEP_SIZES

from ..rivals import PowerLimitedFxLMS
from .scene import Scene

# r E[x'^2] / q: the filter forgets over about its inverse square root in samples, 0.6 s to 6 ms at 16 kHz. Less state
# noise makes it recursive least squares that never forgets, which would always be best for stationary noise.
STATE_NOISE_GRID = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4)
PRICE_GRID = tuple((10.0 ** np.arange(-2.0, 3.1, 0.5)).tolist())  # a finer grid around the best value follows
BLOCK_STEP_GRID = (0.02, 0.05, 0.1, 0.2, 0.4)  # divided by the power in each bin, so it needs no units
PEAK_GRID = tuple((2.0 ** np.arange(-14.0, 4.1, 2.0)).tolist())

Setting = float | tuple[float, float]
Settings = Callable[[Scene, float, float], dict[str, Any]]


@dataclass(frozen=True)
class Algorithm:
    """One algorithm of the registry: how it is made and tuned.

    Parameters
    ----------
    make : callable
        Function that makes a controller: of the number of taps, the secondary path and keyword arguments.
    settings : callable
        Function of a scene, the first setting in the scene's units, and the second setting, which returns these keyword
        arguments; those that all algorithms share are left out.
    symbol : str
        Parameter that the first setting sets: "r", "mu", "mu of a block", "1 - lambda" or "averaging_s".
    kind : str
        The first setting as a formula, without units.
    first : tuple of float
        Values of the first setting that are tried.
    second : tuple of float, default ()
        Values of the second setting that are tried.
    of_paper : bool, default False
        Whether the paper compares it.
    keeps_budget : bool, default True
        Whether it is meant to keep the rated power.
    shares_gains : bool, default False
        Whether its gain depends on the reference alone, so that several runs on one noise share it.
    knows_amplifier : bool, default False
        Whether its disturbance estimate can know the amplifier.
    may_refuse : bool, default False
        Whether it may stop during a run because it cannot continue, which counts as divergence.
    several_channels : bool, default False
        Whether the studies of several channels compare it; those of one channel compare all.
    """

    make: Callable[..., Controller]
    settings: Settings
    symbol: str
    kind: str
    first: tuple[float, ...]
    second: tuple[float, ...] = ()
    of_paper: bool = False
    keeps_budget: bool = True
    shares_gains: bool = False
    knows_amplifier: bool = False
    may_refuse: bool = False
    several_channels: bool = False

    @property
    def sees_budget(self) -> bool:
        """Whether it is made with the rated power, not tuned to it; if not, its runs serve for all rated powers."""
        return self.keeps_budget and not self.second

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
        if self.symbol == "averaging_s":
            return first * scene.averaging_s
        return first / (scene.n_taps * scene.filtered_power) if self.symbol == "mu" else first


def _random_walk(scene: Scene, r: float, _: float) -> dict[str, Any]:
    return {"state_noise": r, "measurement_noise": scene.measurement_noise, "initial_variance": scene.initial_variance}


def _power_budget(scene: Scene, averaging_s: float, _: float) -> dict[str, Any]:
    return {
        "rated_power": scene.rated_power,
        "secondary_path_uncertainty": scene.secondary_path_uncertainty,
        "fs": scene.fs,
        "averaging_s": averaging_s,
    }


def _forgetting(scene: Scene, forgotten: float, _: float) -> dict[str, Any]:
    return {"forgetting": 1.0 - forgotten, "initial_variance": scene.initial_variance / scene.measurement_noise}


def _step(scene: Scene, mu: float, _: float) -> dict[str, Any]:
    return {"step_size": mu}


def _normalised(scene: Scene, mu: float, _: float) -> dict[str, Any]:
    energy = scene.n_taps * scene.filtered_power  # mu compares with FxLMS; the ridge is for the start-up
    return {"step_size": mu * energy, "regularization": 0.01 * energy}


def _leak(scene: Scene, mu: float, price: float) -> dict[str, Any]:
    return {"step_size": mu, "leak": min(price * scene.filtered_power, 1.0 / mu)}


def _penalty(scene: Scene, mu: float, price: float) -> dict[str, Any]:
    return {"step_size": mu, "penalty_factor": price * scene.secondary_gain}


def _penalty_by_variance(scene: Scene, mu: float, _: float) -> dict[str, Any]:
    """Take the penalty from the variance of the whole disturbance, as the public code of its authors does.

    They use the secondary path's gain for the disturbance, from an inverse model of the path; here the gain is that of
    eq. 11, as for all algorithms. The penalty hardly depends on it if the noise needs about four times the rated power.
    """
    variance = float(np.var(scene.settled[1]))
    gamma = penalty_factor(scene.rated_power, disturbance_power=variance, secondary_path_gain=scene.secondary_gain)
    return {"step_size": mu, "penalty_factor": gamma}


def _peak(scene: Scene, mu: float, share: float) -> dict[str, Any]:
    return {"step_size": mu, "amplitude_limit": np.sqrt(share * scene.unconstrained_power)}


def _two_gradients(scene: Scene, mu: float, share: float) -> dict[str, Any]:
    return _peak(scene, mu, share) | {"output_step_size": mu * scene.secondary_gain}


def block_of(scene: Scene) -> int:
    """Return a quarter of the control filter; in blocks of less than 16 samples, calls would take most time."""
    return max(-(-scene.n_taps // 4), 16)


def _in_blocks(scene: Scene, mu: float, _: float) -> dict[str, Any]:
    """Return one partition, for fine bins, of four blocks."""
    return {"step_size": mu, "block_size": block_of(scene), "partition_size": 4 * block_of(scene)}


def _within_power(scene: Scene, mu: float, _: float) -> dict[str, Any]:
    return {"step_size": mu, "block_size": block_of(scene), "rated_power": scene.rated_power}


def _constrained(settings: Settings) -> Settings:
    """Return a function that adds the scene's constraint, or one for each loudspeaker, to `settings`."""

    def constrained(scene: Scene, first: float, second: float) -> dict[str, Any]:
        each = [
            OutputPowerConstraint(power, fs=scene.fs, memory_s=scene.power_memory_s, window=scene.power_window)
            for power in np.ravel(scene.rated_power)
        ]
        return settings(scene, first, second) | {"constraint": each if np.ndim(scene.rated_power) else each[0]}

    return constrained


ABOUT = {
    "KF-ANC": "a Kalman filter that learns the control filter and knows no rated power",
    "KF-OPC": "KF-ANC with the disturbance scaled by a constraint factor, which is meant to keep the rated power",
    "KF-PB": "a Kalman filter that learns the paths, keeps the rated power, and spends it where it reduces the noise most",
    "diagonal KF": "KF-ANC that leaves out how the weights' errors depend on each other; it computes and learns less",
    "diagonal KF-OPC": "the diagonal KF with KF-OPC's constraint factor",
    "FxRLS": "recursive least squares with exponential forgetting; it knows no rated power",
    "FxLMS": "the usual gradient descent on the squared error; it knows no rated power",
    "FxNLMS": "FxLMS with a step size relative to the power of the filtered reference",
    "leaky FxLMS": "FxLMS whose weights decay all the time, by a leak that was tuned to the rated power",
    "optimal leaky FxLMS": "leaky FxLMS that computes its leak from the rated power as it runs",
    "MOV-FxLMS fixed": "MOV-FxLMS with a fixed penalty that was tuned to the rated power",
    "MOV-FxLMS by variance": "MOV-FxLMS with a fixed penalty, from the variance of the whole disturbance",
    "MOV-FxLMS": "FxLMS with a penalty on the output power, computed from the rated power as it runs",
    "MOV-MFxLMS": "MOV-FxLMS without the delay of the secondary path in its loop",
    "two-gradient FxLMS": "FxLMS that descends on the output power instead while a sample is beyond an amplitude limit",
    "re-scaling FxLMS": "FxLMS that scales its weights down when a sample is beyond an amplitude limit",
    "clipping FxLMS": "FxLMS whose control signal is clipped at an amplitude limit",
    "frequency-domain FxLMS": "FxLMS that adapts once per block, each frequency at its own rate; it knows no rated power",
    "power-limited FxLMS": "frequency-domain FxLMS with a price on the output power that follows the measured power",
}
OF_PAPER = ("KF-ANC", "KF-OPC", "FxLMS", "MOV-FxLMS")
WITHOUT_BUDGET = ("KF-ANC", "diagonal KF", "FxRLS", "FxLMS", "FxNLMS", "frequency-domain FxLMS")
KNOW_AN_AMPLIFIER = (
    *("KF-ANC", "KF-OPC", "KF-PB", "diagonal KF", "diagonal KF-OPC", "FxRLS"),
    *("optimal leaky FxLMS", "MOV-FxLMS fixed", "MOV-FxLMS by variance", "MOV-FxLMS", "MOV-MFxLMS"),
)
ONE_CHANNEL = (
    *("diagonal KF", "diagonal KF-OPC", "FxRLS"),
    *("MOV-FxLMS by variance", "frequency-domain FxLMS", "power-limited FxLMS"),
)

Tried = tuple[str, str, tuple[float, ...], tuple[float, ...]]  # symbol and kind of the first setting, and both grids
_RANDOM_WALK: Tried = ("r", "r E[x'^2]/q", STATE_NOISE_GRID, ())
_DIAGONAL: Tried = ("r", "r E[x'^2]/q", DIAGONAL_STATE_NOISES, ())
_BUDGET: Tried = ("averaging_s", "averaging time over the scene's", (1.0,), ())
_LEAST_FORGOTTEN: Tried = ("1 - lambda", "1 - lambda", FORGOTTEN, ())
_STEP: Tried = ("mu", "mu L E[x'^2]", STEP_SIZES[::-1], ())
_STEP_AND_PRICE: Tried = (*_STEP[:3], PRICE_GRID)  # leak over E[x'^2], or penalty factor over G_s
_STEP_AND_PEAK: Tried = (*_STEP[:3], PEAK_GRID)  # A^2 over the unconstrained power
_BLOCKS: Tried = ("mu of a block", "mu of a block", BLOCK_STEP_GRID, ())


def _entry(name: str, settings: Settings, tried: Tried, make: Callable[..., Controller] | None = None) -> Algorithm:
    """Return the entry of an algorithm, by default of the package's of this name."""
    return Algorithm(
        MAKERS[name] if make is None else make,
        settings,
        *tried,
        of_paper=name in OF_PAPER,
        keeps_budget=name not in WITHOUT_BUDGET,
        shares_gains=name in ("KF-ANC", "KF-OPC"),
        knows_amplifier=name in KNOW_AN_AMPLIFIER,
        may_refuse=name == "FxRLS",
        several_channels=name not in ONE_CHANNEL,
    )


_MADE: dict[str, tuple[Any, ...]] = {  # settings, what is tried, and the maker of another name
    "KF-ANC": (_random_walk, _RANDOM_WALK),
    "KF-OPC": (_constrained(_random_walk), _RANDOM_WALK),
    "KF-PB": (_power_budget, _BUDGET),
    "diagonal KF": (_random_walk, _DIAGONAL),
    "diagonal KF-OPC": (_constrained(_random_walk), _DIAGONAL, MAKERS["diagonal KF"]),
    "FxRLS": (_forgetting, _LEAST_FORGOTTEN),
    "FxLMS": (_step, _STEP),
    "FxNLMS": (_normalised, _STEP),
    "leaky FxLMS": (_leak, _STEP_AND_PRICE),
    "optimal leaky FxLMS": (_constrained(_step), _STEP),
    "MOV-FxLMS fixed": (_penalty, _STEP_AND_PRICE, MAKERS["MOV-FxLMS"]),
    "MOV-FxLMS by variance": (_penalty_by_variance, _STEP, MAKERS["MOV-FxLMS"]),
    "MOV-FxLMS": (_constrained(_step), _STEP),
    "MOV-MFxLMS": (_constrained(_step), _STEP),
    "two-gradient FxLMS": (_two_gradients, _STEP_AND_PEAK),
    "re-scaling FxLMS": (_peak, _STEP_AND_PEAK),
    "clipping FxLMS": (_peak, _STEP_AND_PEAK),
    "frequency-domain FxLMS": (_in_blocks, _BLOCKS),
    "power-limited FxLMS": (_within_power, _BLOCKS, PowerLimitedFxLMS),
}
REGISTRY = {name: _entry(name, *own) for name, own in _MADE.items()}


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
    >>> from comparisons.bench import algorithms
    >>> [name for name, algorithm in algorithms().items() if algorithm.of_paper]
    ['KF-ANC', 'KF-OPC', 'FxLMS', 'MOV-FxLMS']
    >>> algorithms()["KF-OPC"].grid
    [1e-08, 1e-07, 1e-06, 1e-05, 0.0001]
    >>> "FxRLS" in algorithms(), "FxRLS" in algorithms(several_channels=True)
    (True, False)
    """
    return MappingProxyType(
        {name: own for name, own in REGISTRY.items() if own.several_channels or not several_channels}
    )


@contextmanager
def registered(entries: Mapping[str, Algorithm]) -> Iterator[None]:
    """Let `tune` and others know further algorithms by name for a while; those of the registry stay as they are."""
    further = {name: own for name, own in entries.items() if name not in REGISTRY}
    REGISTRY.update(further)
    try:
        yield
    finally:
        for name in further:
            del REGISTRY[name]


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
    >>> from comparisons.bench import make_controller, make_scene
    >>> from kfopc_filterpy import Plant
    >>> from kfopc_filterpy.signals import tone
    >>> plant = Plant([0, 1.0], [0, 0, 1.0], fs=8000)
    >>> scene = make_scene({0: tone(400.0, 1.0, fs=8000)}, plant, rated_power=1.0, power_multiple=2.0, n_taps=8)
    >>> make_controller(scene, "KF-OPC", 1e-6).rated_power
    1.0
    """
    several = scene.secondary.ndim == 3
    if algorithm not in algorithms(several_channels=several):
        channels = "several channels" if several else "one channel"
        raise ValueError(f"{algorithm} is not compared with {channels}: see algorithms(several_channels={several})")
    own, second = REGISTRY[algorithm], setting[1] if isinstance(setting, tuple) else np.nan
    settings = own.settings(scene, own.value(scene, setting), second)
    if own.knows_amplifier:
        settings["amplifier"] = scene.known_amplifier if amplifier is None else amplifier
    if several:
        settings["n_references"] = len(scene.references[0])
    controller: Any = own.make(scene.n_taps, scene.known_secondary, **settings)
    controller.name = algorithm  # the registry tells apart what one algorithm does with different settings
    return controller
