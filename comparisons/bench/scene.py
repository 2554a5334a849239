"""A scene to run controllers in, and the jobs that run there."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from kfopc_filterpy import HardClipAmplifier, Plant, SimulationResult, simulate
from kfopc_filterpy._types import Counter, NumberOrArray
from kfopc_filterpy.bounds import (
    WienerSolution,
    power_constrained_solution,
    wiener_solution,
)
from kfopc_filterpy.bounds.wiener import full_stretch
from kfopc_filterpy.controllers import Controller
from kfopc_filterpy.controllers.kf_pb import DEFAULT_AVERAGING_S
from kfopc_filterpy.plant import checked_references, has_one_channel
from kfopc_filterpy.power.amplifiers import Amplifier
from kfopc_filterpy.verdict.candidates import filtered_power
from kfopc_filterpy.verdict.runs import one_blas_thread

SENSOR_NOISE_SEED = 1000  # added to the noise's seed
CHANNEL_RIDGE = 1e-6  # over the filtered power: directions with less energy need weights that no controller reaches

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


class Runs:
    """Jobs on all cores, with one progress bar for all of them.

    Threads are enough, because the compiled loop releases Python's global interpreter lock.

    Parameters
    ----------
    bar : tqdm bar, optional
        Bar that advances as jobs end.
    workers : int, optional
        Threads; by default one for each core.

    Examples
    --------
    >>> from comparisons.bench import Runs
    >>> runs = Runs()
    >>> runs.map(lambda x: x**2, [1, 2, 3]), runs.done
    ([1, 4, 9], 3)
    """

    def __init__(self, bar: Counter | None = None, workers: int | None = None) -> None:
        self.bar = bar
        self.done = 0
        self._pool = ThreadPoolExecutor(max_workers=workers or os.cpu_count())

    def map(
        self, job: Callable[[Item], Outcome], items: Iterable[Item], worth: Callable[[Item], int] = lambda item: 1
    ) -> list[Outcome]:
        """Return the results of `job` for each of the `items`, in their order.

        `worth` gives the number of planned runs that an item counts for.
        """
        items, outcomes = list(items), []
        with one_blas_thread():
            for item, outcome in zip(items, self._pool.map(job, items), strict=True):
                outcomes.append(outcome)
                self.done += worth(item)
                if self.bar is not None:
                    self.bar.update(worth(item))
        return outcomes


@dataclass(frozen=True)
class Scene:
    """Noise, paths and amplifier of a study, and what its controllers know of them.

    `make_scene` makes one. There is one reference and one disturbance for each seed, all of equal length. With several
    channels, the first axis of a signal is the channel, and the powers of loudspeakers are (J,).

    Parameters
    ----------
    fs : float
        Sample rate in Hz.
    secondary : ndarray, shape (n_path_taps,) or (K, J, n_path_taps)
        True secondary path; one of one channel has no channel axes.
    references, disturbances : list of ndarray, shape (n_samples,), or (I, n_samples) and (K, n_samples)
        One for each seed.
    rated_power : float or ndarray, shape (J,)
        Rated output power, a mean square.
    n_taps : int
        Taps of the control filter.
    sensor_noise_std : float
        Standard deviation of the noise that is added to the error.
    switch_on_s : float
        Time in seconds for which the noise runs before the control is switched on.
    nse_window_s : float
        Window of the normalised squared error in seconds.
    amplifier : amplifier, optional
        Amplifier; linear by default.
    measurement_noise : float
        q of the Kalman filters.
    initial_variance : float
        P0 of the Kalman filters.
    unconstrained_power : float or ndarray, shape (J,)
        Output power that the noise would need without a constraint.
    wiener_noise_reduction_db : float
        Noise reduction of that solution in dB.
    seeds : list of int
        Seeds of the noises.
    secondary_estimate : ndarray, optional
        Secondary path that controllers know; by default the true one.
    secondary_path_uncertainty : PathTolerance, float or array_like, optional
        Uncertainty of that path that KF-PB takes account of, see `paths.path_uncertainty`; by default none.
    known_amplifier : amplifier, optional
        Amplifier that disturbance estimates know; by default they take it to be linear.
    power_memory_s : float, default 0.5
        Memory in seconds of the power estimates of the constrained algorithms.
    power_window : {"exponential", "sliding"}, default "exponential"
        Window of these estimates.
    averaging_s : float, default 10
        Time in seconds over which KF-PB keeps the rated power as a mean.
    """

    fs: float
    secondary: np.ndarray
    references: list[np.ndarray]
    disturbances: list[np.ndarray]
    rated_power: Any
    n_taps: int
    sensor_noise_std: float
    switch_on_s: float
    nse_window_s: float
    amplifier: Amplifier | Sequence[Amplifier] | None = None
    measurement_noise: float = 0.0
    initial_variance: float = 0.0
    unconstrained_power: Any = 1.0
    wiener_noise_reduction_db: float = 0.0
    seeds: list[int] = field(default_factory=list)
    secondary_estimate: np.ndarray | None = None
    secondary_path_uncertainty: Any = None
    known_amplifier: Amplifier | Sequence[Amplifier] | None = None
    power_memory_s: float = 0.5
    power_window: str = "exponential"
    averaging_s: float = DEFAULT_AVERAGING_S

    @property
    def sensor_noise_seeds(self) -> list[int]:
        """Seeds of the sensor noise, apart from those of the noises."""
        return [SENSOR_NOISE_SEED + seed for seed in self.seeds]

    @property
    def amplitude_limit(self) -> NumberOrArray:
        """Limit of a clipping amplifier, or of each: the peak of a sine at rated power."""
        limit = np.sqrt(2 * self.rated_power)
        return limit if np.ndim(limit) else float(limit)

    @property
    def settled(self) -> tuple[np.ndarray, np.ndarray]:
        """First reference and disturbance from switch-on, after the start-up of the primary path."""
        start = int(self.switch_on_s * self.fs)
        return self.references[0][..., start:], self.disturbances[0][..., start:]

    @property
    def known_secondary(self) -> np.ndarray:
        """Secondary path that the controllers know."""
        return self.secondary if self.secondary_estimate is None else self.secondary_estimate

    @property
    def filtered_power(self) -> float:
        """Power of the filtered reference; it makes step sizes and state noises comparable."""
        return filtered_power(self.references[0], self.known_secondary)

    @property
    def secondary_gain(self) -> float:
        """Power gain G_s of the known secondary path for the reference (eq. 11)."""
        return self.filtered_power / _power(self.references[0])

    @property
    def plant(self) -> Plant:
        """Plant of the runs, whose disturbances are those of the scene."""
        return Plant(self.secondary, amplifier=self.amplifier, fs=self.fs, sensor_noise_std=self.sensor_noise_std)

    def plant_of(self, controller: Controller) -> Plant:
        """Return the plant that a controller is run on; here the same for all."""
        return self.plant

    def run(self, controller: Controller, seed_index: int = 0, **options: Any) -> SimulationResult:
        """Run a `controller` on the noise of one seed, of index `seed_index`; `options` go to `simulate`."""
        return self.run_together([controller], seed_index, **options)[0]

    def run_together(
        self,
        controllers: Sequence[Controller],
        seed_index: int = 0,
        plants: Sequence[Plant] | None = None,
        **options: Any,
    ) -> list[SimulationResult]:
        """Run `controllers` like `run`, at the cost of one filter if they share their gains; `plants` has other plants."""
        return simulate(
            list(controllers),
            self.references[seed_index],
            [self.plant_of(controller) for controller in controllers] if plants is None else plants,
            disturbance=self.disturbances[seed_index],
            switch_on_s=self.switch_on_s,
            rng=self.sensor_noise_seeds[seed_index],
            **options,
        )


def make_scene(
    references: Mapping[int, np.ndarray],
    plant: Plant,
    *,
    rated_power: NumberOrArray,
    power_multiple: float | None,
    n_taps: int,
    switch_on_s: float = 0.5,
    sensor_noise_db: float = -60.0,
    nse_window_s: float = 0.005,
) -> Scene:
    """Return a scene whose noises need a multiple of the rated power.

    The references get the power at which the unconstrained Wiener control filter of the first one needs
    `power_multiple` times the rated power. q is the estimate of eq. 7 from the first noise without control. P0 is the
    Wiener control power divided by the number of taps and by the reference power. None of these takes account of
    directions of the weights in which the reference has hardly any energy (see `wiener_solution`), because no
    controller reaches the weights needed there.

    Parameters
    ----------
    references : mapping of int to ndarray, shape (n_samples,) or (I, n_samples)
        Noise for each seed.
    plant : Plant
        Plant with a primary path; its sensor noise is replaced by that of `sensor_noise_db`.
    rated_power : float or ndarray, shape (J,)
        Rated output power, a mean square; of all loudspeakers or of each.
    power_multiple : float or None
        Unconstrained control power over the rated power, each summed over the loudspeakers; None leaves the noises as
        loud as they are.
    n_taps : int
        Taps of the control filter.
    switch_on_s : float, default 0.5
        Time in seconds for which the noise runs before the control is switched on.
    sensor_noise_db : float, default -60.0
        Power of the sensor noise over that of the disturbance in dB.
    nse_window_s : float, default 0.005
        Window of the normalised squared error in seconds.

    Returns
    -------
    Scene
        The scene, which is not changed by runs.

    Raises
    ------
    ValueError, TypeError
        A noise whose channels are not those of the plant.

    Examples
    --------
    >>> from comparisons.bench import make_scene
    >>> from kfopc_filterpy import Plant
    >>> from kfopc_filterpy.signals import tone
    >>> plant = Plant([0, 1.0], [0, 0, 1.0], fs=8000)
    >>> scene = make_scene({0: tone(400.0, 1.0, fs=8000)}, plant, rated_power=1.0, power_multiple=2.0, n_taps=8)
    >>> round(float((scene.references[0] ** 2).mean()), 3)  # the path has a gain of 1
    2.0
    """
    signals = [checked_references(plant, x) for x in references.values()]
    several = not has_one_channel(plant, signals[0])
    signals = signals if several else [x[0] for x in signals]
    first = signals[0]
    settled = (..., slice(int(switch_on_s * plant.fs), None))  # after the start-up of the primary path
    wiener = reachable_solution(first[settled], plant.disturbance(first)[settled], plant, n_taps)
    asked = np.sum(wiener.control_power)
    if power_multiple is not None:
        asked = power_multiple * np.sum(rated_power * np.ones(np.shape(wiener.control_power)))
    share = wiener.control_power / np.sum(wiener.control_power)
    power = _power(first) * asked / np.sum(wiener.control_power)
    scaled = [np.sqrt(power / _power(x)) * x for x in signals]
    disturbances = [plant.disturbance(x) for x in scaled]
    std = float(np.sqrt(np.mean(disturbances[0][settled] ** 2)) * 10 ** (sensor_noise_db / 20))
    recorded = disturbances[0][settled]
    recorded = recorded + std * np.random.default_rng(0).standard_normal(recorded.shape)
    return Scene(
        fs=plant.fs,
        secondary=plant.secondary if several else plant.secondary[0, 0],
        references=scaled,
        disturbances=disturbances,
        rated_power=rated_power,
        n_taps=n_taps,
        sensor_noise_std=std,
        switch_on_s=switch_on_s,
        nse_window_s=nse_window_s,
        amplifier=plant.amplifiers if several else plant.amplifiers[0],
        measurement_noise=_unexplained(scaled[0][settled], recorded, plant, n_taps),
        initial_variance=float(asked / (n_taps * power * np.size(share))),
        unconstrained_power=asked * share,
        wiener_noise_reduction_db=wiener.noise_reduction_db,
        seeds=list(references),
    )


def with_clipping(scene: Scene) -> Scene:
    """Return a scene of one channel with an amplifier that clips, and the q of eq. 7 with it.

    The amplifier clips at the peak of a sine of rated power. The measurement is then d + s * (y - clip(y)), so e_o of
    eq. 1b contains what is clipped off. It is estimated from the best control signal of rated power, as a batch fit's
    residual: a control filter can take over the part of it that is proportional to y.

    Parameters
    ----------
    scene : Scene
        Scene with a linear amplifier.

    Returns
    -------
    Scene
        The same scene with the amplifier and its q.

    Examples
    --------
    >>> from comparisons.bench import make_scene, with_clipping
    >>> from kfopc_filterpy import Plant
    >>> x = np.random.default_rng(0).standard_normal(8000)
    >>> plant = Plant([0, 1.0], [0, 0, 1.0], fs=8000)
    >>> scene = make_scene({0: x}, plant, rated_power=0.5, power_multiple=4.0, n_taps=8)
    >>> clipped = with_clipping(scene)
    >>> clipped.amplifier.limit, bool(clipped.measurement_noise > 100 * scene.measurement_noise)
    (1.0, True)
    """
    amplifier = HardClipAmplifier(scene.amplitude_limit)
    (x, d), n_taps = scene.settled, scene.n_taps
    with reachable_weights():
        bound = power_constrained_solution(x, scene.plant, n_taps=n_taps, rated_power=scene.rated_power, disturbance=d)
    y = np.convolve(x, bound.weights)[: x.size]
    lost = np.convolve(y - amplifier(y), scene.secondary)[: x.size]
    q = scene.measurement_noise
    if np.any(lost):  # else the rating is ample
        q += _unexplained(x, lost, scene.plant, n_taps)
    return replace(scene, amplifier=amplifier, measurement_noise=q)


def louder(scene: Scene, gain: float) -> Scene:
    """Return the scene with all signals times a gain, and the measurement noise with them."""
    return replace(
        scene,
        references=[gain * x for x in scene.references],
        disturbances=[gain * d for d in scene.disturbances],
        sensor_noise_std=gain * scene.sensor_noise_std,
        measurement_noise=gain**2 * scene.measurement_noise,
        unconstrained_power=gain**2 * scene.unconstrained_power,
    )


def _power(x: np.ndarray) -> float:
    """Return the mean square of a reference, or the sum of those of several."""
    return float(np.mean(x**2, axis=-1).sum())


def reachable_solution(x: np.ndarray, d: np.ndarray, plant: Plant, n_taps: int) -> WienerSolution:
    """Return the unconstrained Wiener solution whose weights a controller can reach."""
    if x.ndim == 1:
        with reachable_weights():
            return wiener_solution(x, plant, n_taps=n_taps, disturbance=d)
    record = full_stretch(x, d, plant.secondary, n_taps)
    return record.solution(record.correlations().weights(ridge=CHANNEL_RIDGE * record.filtered_power))


def _unexplained(x: np.ndarray, d: np.ndarray, plant: Plant, n_taps: int) -> float:
    """Return q, the power that no control filter explains (eq. 7), per microphone."""
    error_power = float(reachable_solution(x, d, plant, n_taps).error_power)
    if x.ndim > 1:
        return error_power
    n_samples = x.size - (n_taps + plant.secondary.shape[2] - 2)  # with full delay lines
    return error_power * n_samples / (n_samples - n_taps)  # each weight fits by chance, too


@contextmanager
def reachable_weights() -> Iterator[None]:
    """Silence the warning that very large weights in directions without energy would do better.

    Level and q should belong to weights that a controller with the scene's P0 reaches, and none reaches such weights.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", np.exceptions.RankWarning)
        yield
