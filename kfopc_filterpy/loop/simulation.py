"""The modified ANC structure of the paper's block diagrams: run one controller or several on a plant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from .._types import Seed
from .._validate import as_count, as_returned
from ..controllers.base import Controller, Looped, checked_controller, differing_counts, listening
from ..controllers.core_controller import NO_SOLUTION, CoreController
from ..controllers.frequency_domain import runs_in_blocks
from ..controllers.processing import takes_none
from ..core.block import LOUDEST, LOUDEST_LEARNT
from ..core.run_loop import DIVERGED, REFUSED_ERROR, REFUSED_REFERENCE, RUNNING, Record, Signals
from ..core.run_loop import Plant as CompiledPlant
from ..plant import Plant, as_plant, checked_signals, has_one_channel, schedule_of
from ..power.amplifiers import amplified_sample, amplifier_models, compiled_model
from .inputs import RECORDED, RESULTS, STRETCH, SensorNoise, divergence_limits, naming_sample, switch_on_sample
from .result import SimulationResult
from .sharing import run_together, runs_that_share


@overload
def simulate(
    controllers: Controller,
    reference: ArrayLike | None,
    plant: Plant,
    *,
    disturbance: ArrayLike | None = ...,
    switch_on_s: float = ...,
    rng: Seed | None = ...,
    record_weights_every: int | None = ...,
    progress: Callable[[int], Any] | None = ...,
) -> SimulationResult: ...


@overload
def simulate(
    controllers: Sequence[Controller],
    reference: ArrayLike | None,
    plant: Plant | Sequence[Plant],
    *,
    disturbance: ArrayLike | Sequence[ArrayLike] | None = ...,
    switch_on_s: float = ...,
    rng: Any = ...,
    record_weights_every: int | None = ...,
    progress: Callable[[int], Any] | None = ...,
) -> list[SimulationResult]: ...


def simulate(
    controllers: Any,
    reference: ArrayLike | None,
    plant: Any,
    *,
    disturbance: Any = None,
    switch_on_s: float = 0.0,
    rng: Any = None,
    record_weights_every: int | None = None,
    progress: Callable[[int], Any] | None = None,
) -> Any:
    """Run a controller on a plant, or several.

    For each sample, compute the control signal from the last weights, the amplifier's output and the error
    e = d - s*y_amp, then update the controller. Built-in controllers run at compiled speed, or block by block if they
    adapt once per block; a user-defined controller is called sample by sample.

    With several channels, the channel is the leading axis: I references, J loudspeakers, K error microphones. A
    user-defined controller then gets and returns arrays: ``control_signal(reference)``, (I,), returns (J,), and
    ``update(error)`` gets (K,). With one of each, signals have no channel axis, and samples are floats.

    Of several controllers, those with the same Kalman gains share them: the gain (eq. 6) depends on the reference and
    the filter's r, q and P(0|0), not on the measurements. Runs that differ in rated power, amplifier, disturbance,
    true secondary path or sensor noise therefore need the filter's O(L^2) only once, and O(L) each. The results are
    those of single runs.

    Parameters
    ----------
    controllers : Controller or sequence of them
        Controller, or several separate ones. Each continues from its present state, while the paths start silent: make
        a new one for a fresh run.
    reference : array_like, shape (n_samples,) or (I, n_samples), or None
        Reference x; a `Recording` must have the plant's sample rate. None for a feedback controller, see
        `controllers.with_internal_model`.
    plant : Plant or sequence of them
        Plant; for several controllers one for all, or one each. It may change during the run, see `Plant.changed_at`.
    disturbance : array_like, shape (n_samples,) or (K, n_samples), optional
        Disturbance d, if it was measured, in place of the plant's primary path; for several controllers one for all, or
        a list with one each.
    switch_on_s : float, default 0
        Time in seconds at which the control is switched on. Until then the loudspeakers are silent and the controller
        listens (`listen`): its delay lines and power estimates follow the noise, its weights stay. The result starts at
        that time.
    rng : int or numpy.random.Generator, optional
        Seed of the sensor noise; required if there is any. For several controllers one seed, with which all have the
        same noise, or a list with one each.
    record_weights_every : int, optional
        Record the control filter (a controller's `control_filter`, or else its `weights`) every so many samples.
    progress : callable, optional
        Called with the number of samples done since its last call, such as `tqdm.update`.

    Returns
    -------
    SimulationResult or list of SimulationResult
        Record of the run, or of each run. If the control signal exceeds 1e6 times the square root of the controller's
        rated power, or 1e6 if it has none, the run stops without an error, and `diverged_at_s` is the time.

    Raises
    ------
    ValueError
        Signals that are empty, not finite, of different lengths or with other channels than plant and controller;
        sample rates that differ; both or neither of a primary path and a disturbance; a plant that changes after the
        end of the run; a list of another length than the controllers. Nothing was changed. During a run: an amplifier
        that returns NaN, or an update without a solution (a covariance that is too large).
    TypeError
        A controller without `control_signal` and `update`, or a plant that is no `Plant`.

    Notes
    -----
    Runs that share gains are one run to the controllers: after a divergence of one, its covariance is that of the end
    of the whole run; after a refused sample all of them are unchanged, except for what they heard before they were
    switched on.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import Plant, kf_opc, simulate
    >>> plant = Plant([0.0, 1.0], [0.0, 0.0, 0.0, 1.0], fs=16000)
    >>> x = np.random.default_rng(0).standard_normal(16000)
    >>> controller = kf_opc(16, plant, rated_power=0.25, state_noise=1e-9, measurement_noise=1e-3)
    >>> simulate(controller, x, plant)  # without a constraint, the output power would be 1
    <SimulationResult KF-OPC: 1 s at 16000 Hz, noise reduction 6.0 dB, output power 0.247 (rated 0.25)>

    Three rated powers:

    >>> settings = {"state_noise": 1e-9, "measurement_noise": 1e-3}
    >>> several = [kf_opc(16, plant, rated_power=power, **settings) for power in (0.1, 0.2, 0.4)]
    >>> [round(run.output_power, 1) for run in simulate(several, x, plant)]
    [0.1, 0.2, 0.4]
    """
    one = not isinstance(controllers, list | tuple)
    every = None if record_weights_every is None else as_count(record_weights_every, "record_weights_every")
    each = [controllers] if one else list(controllers)
    if not each:
        raise ValueError("controllers must hold one controller at least")
    plants = _one_each(plant, len(each), "plant")
    disturbances = [disturbance] if one else _one_each(disturbance, len(each), "disturbance")
    seeds = [rng] if one else _one_each(rng, len(each), "rng")
    generators = [id(seed) for seed in seeds if isinstance(seed, np.random.Generator)]
    if len(set(generators)) < len(generators):
        raise ValueError("rng is one Generator for several controllers: give each its own, or seeds")
    for i, controller in enumerate(each):
        if any(controller is other for other in each[:i]):
            raise ValueError(f"controllers[{i}] is in the list twice: each run needs its own controller")
    runs = [
        _Run(controller, reference, as_plant(own), d, switch_on_s, seed, every)
        for controller, own, d, seed in zip(each, plants, disturbances, seeds, strict=True)
    ]
    groups = runs_that_share(runs) if len(runs) > 1 else []
    together = [run for group in groups for run in group]
    for group in groups:
        run_together(group, progress)
    for run in runs:
        if run not in together:
            run.go(progress)
    results = [run.result() for run in runs]
    return results[0] if one else results


def _one_each(value: Any, count: int, name: str) -> list[Any]:
    """Return one value for each controller: those of a list, or one for all."""
    if not isinstance(value, list | tuple):
        return [value] * count
    if len(value) != count:
        raise ValueError(f"{name} must be one for all controllers, or a list of {count}, one each, got {len(value)}")
    return list(value)


@dataclass(eq=False)
class _Run:
    """A run: the controller, the plant, the signals, and what is recorded."""

    controller: Any
    given: Any  # reference
    true: Plant
    disturbance: Any
    switch_on_s: float
    seed: Any
    every: int | None  # samples between two rows of `weights`
    functions: list[Any] = field(init=False)  # for each loudspeaker: an amplifier that is not a model, or None

    def __post_init__(self) -> None:
        """Check everything before anything changes."""
        controller, plant = checked_controller(self.controller), self.true
        if plant.primary is not None and self.given is not None and self.disturbance is not None:
            raise ValueError(
                "the plant's primary path gives the disturbance, and so does disturbance=: give one of them"
            )
        self.without_reference = takes_none(controller, self.given)
        self.x, self.d = checked_signals(plant, self.given, self.disturbance)
        self.several = not has_one_channel(plant, self.x)
        K, J, _ = plant.secondary.shape
        counts = {"n_references": len(self.x), "n_loudspeakers": J, "n_microphones": K}
        for name, own in differing_counts(controller, **counts):
            raise ValueError(
                f"the controller is made for {own} {name.removeprefix('n_')}, but reference and plant have {counts[name]}"
            )
        self.noise = SensorNoise(plant.sensor_noise_std, self.seed)
        self.fs = plant.fs
        self.on = switch_on_sample(self.switch_on_s, self.fs, self.x.shape[1])
        self.secondary, self.feedback, self.amplifiers = (
            schedule_of(plant, name) for name in ("secondary", "feedback", "amplifier")
        )
        if (last := max(s.begins[-1] for s in (self.secondary, self.feedback, self.amplifiers))) >= self.x.shape[1]:
            raise ValueError(
                f"the plant changes {last / self.fs:g} s after the start, but the run has only "
                f"{self.x.shape[1] / self.fs:g} s"
            )
        if hasattr(controller, "require_sample_rate"):
            controller.require_sample_rate(self.fs)
        if self.on:
            listening(controller)
        self.weights = self._weight_rows(self.x.shape[1] - self.on)
        self.rated_power = getattr(controller, "rated_power", None)

    def _weight_rows(self, n_samples: int) -> np.ndarray:
        """Return room for the control filters at every `every`-th sample, (rows, ...)."""
        if self.every is None:
            return np.empty((0, 0))
        filters = filters_of(self.controller)
        if filters is None:
            raise ValueError("record_weights_every needs a controller with an attribute weights, (L,) or (J, I, L)")
        shape = np.shape(filters) if self.several else (np.size(filters),)
        return np.full((-(-n_samples // self.every), *shape), np.nan)

    def begin(self) -> None:
        """Let the controller listen until it is switched on, and make room for the results."""
        if self.on:
            heard = self.x[:, : self.on].copy(), self.d[:, : self.on] + self.noise.take(len(self.d), self.on)
            self.controller.listen(
                *(heard if self.several else (signal[0] if len(signal) else None for signal in heard))
            )
        # Copies, which the result keeps; what was given may change later.
        self.x, self.d = (np.array(signal[:, self.on :], order="C") for signal in (self.x, self.d))
        K, J, _ = self.true.secondary.shape
        n_samples = self.x.shape[1]
        feedback = self.feedback.values[0]
        self.plant = CompiledPlant(
            self.secondary.values[0][None],
            np.zeros((len(self.x), J, 0)) if feedback is None else feedback,
            amplifier_models(None, J),
            divergence_limits(self.rated_power, J),
        )
        results = [np.full((channels, n_samples), np.nan) for channels in (K, J, J, K)]
        self.signals = Signals(self.x, self.d, self.noise.filled(results[0]), *results)
        stated = [name for name in RECORDED if name == RECORDED[0] or hasattr(self.controller, name)]
        self.recorded = {name: np.full((J, n_samples), np.nan) for name in stated}

    def go(self, progress: Callable[[int], Any] | None) -> None:
        """Run from the start to the end."""
        self.begin()
        self.progress = progress
        controller = self.controller
        models = all(compiled_model(one) is not None for each in self.amplifiers.values for one in each)
        looped = controller.looped() if models and isinstance(controller, CoreController) else None
        # What is heard depends on the sample before, or something is recorded of each sample.
        stepwise = self.feedback.values[0] is not None or any(hasattr(controller, name) for name in self.recorded)
        in_blocks = models and runs_in_blocks(controller) and not stepwise
        with getattr(controller, "in_use", nullcontext()):
            diverged, end = self._loop(looped) if looped else self._blocks() if in_blocks else self._steps()
        self.end(end, diverged)

    def end(self, end: int, diverged: bool) -> None:
        """Note where the run ended; what comes after it is NaN."""
        for signal in (*(getattr(self.signals, name) for name in RESULTS), *self.recorded.values()):
            signal[:, end:] = np.nan
        self.diverged_at_s = end / self.fs if diverged else None
        self.weights[-(-end // (self.every or 1)) :] = np.nan

    def result(self) -> SimulationResult:
        """Return the record; one channel has no channel axis."""
        found = {name: getattr(self.signals, name) for name in RESULTS} | self.recorded
        x, d, rated = self.x, self.d, self.rated_power
        if not self.several:
            x, d = (x if self.without_reference else x[0]), d[0]
            found = {name: signal[0] for name, signal in found.items()}
            rated = None if rated is None else float(np.ravel(rated)[0])
        return SimulationResult(
            algorithm=str(getattr(self.controller, "name", type(self.controller).__name__)),
            fs=self.fs,
            rated_power=rated,
            reference=x,
            disturbance=d,
            **found,
            weights=self.weights if self.every else None,
            weights_time_s=np.arange(len(self.weights)) * self.every / self.fs if self.every else None,
            diverged_at_s=self.diverged_at_s,
        )

    def _set_plant(self, n: int) -> int:
        """Make the plant what it is at sample n; return the first sample after it at which it may be another one."""
        self.plant.secondary[0], one = self.secondary.at(n + self.on)
        feedback, other = self.feedback.at(n + self.on)
        if feedback is not None:
            self.plant.feedback[:] = feedback
        each, last = self.amplifiers.at(n + self.on)
        self.functions = [amplifier if compiled_model(amplifier) is None else None for amplifier in each]
        models = [None if function else one for one, function in zip(each, self.functions, strict=True)]
        self.plant.amplifiers[:] = amplifier_models(models, len(models))
        return min(one, other, last) - self.on

    def _loop(self, looped: Looped) -> tuple[bool, int]:
        """Run in the core, stretch by stretch: a run can be interrupted between them."""
        sources = looped.recorded
        records = [Record(sources[name], signal) for name, signal in self.recorded.items() if name in sources]
        if len(self.weights):
            rows = self.weights.reshape(len(self.weights), -1)
            records.append(Record(looped.control_filter.reshape(-1), rows, self.every or 1, in_rows=True))
        status, begin, n_samples = RUNNING, 0, self.x.shape[1]
        while begin < n_samples and status == RUNNING:
            end = min(begin + STRETCH, self._set_plant(begin), n_samples)
            status, done = self.plant.run(looped.steps, self.signals, records, begin, end)
            if self.progress:
                self.progress(done - begin)
            begin = done
        if status in (REFUSED_REFERENCE, REFUSED_ERROR):
            with naming_sample(begin):  # the step has changed nothing; called again, it says why
                if status == REFUSED_REFERENCE:
                    self.controller.control_signal(self._sample(self.plant.reference))
                self.controller.update(self._sample(self.plant.error))
                raise ValueError(NO_SOLUTION)
        return status == DIVERGED, begin

    def _steps(self) -> tuple[bool, int]:
        """Call the controller for each sample; return whether it diverged, and the first sample not completed."""
        changes, n_samples = 0, self.x.shape[1]
        for n in range(n_samples):
            if n == changes:
                changes = self._set_plant(n)
            with naming_sample(n):
                y = self._control_signal(self.plant.hear(self.signals, n))
                if not np.all(np.abs(y) <= self.plant.limit):
                    return True, n
                self.controller.update(self._sample(self._errors(y[:, None], n)[:, 0]))
            for name, signal in self.recorded.items():
                signal[:, n] = getattr(self.controller, name, np.nan)
            if len(self.weights) and n % (self.every or 1) == 0:
                self._note_weights(n // (self.every or 1))
            if self.progress:
                self.progress(1)
        return False, n_samples

    def _blocks(self) -> tuple[bool, int]:
        """Do what `_steps` does, in stretches, for a controller that keeps its control filter for a block."""
        x, every = self.x, self.every or 1
        begin, changes, n_samples, limit = 0, 0, x.shape[1], self.plant.limit[:, None]
        # The first sample that the controller refuses begins a stretch, so that those before it are run.
        loud = np.any(np.abs(x) > LOUDEST_LEARNT, axis=0) | np.any(np.abs(self.d) > LOUDEST, axis=0)
        refused = int(np.argmax(loud)) if loud.any() else n_samples
        while begin < n_samples:
            if begin == changes:
                changes = self._set_plant(begin)
            row = -(-begin // every)  # of the next weights that are recorded
            noted = row * every + 1 if len(self.weights) else n_samples + 1
            end = min(begin + self.controller.samples_left, changes, noted, max(refused, begin + 1))
            with naming_sample(begin):
                y = self.controller.emit(x[:, begin:end], limit)
                if not np.all(np.abs(y[:, 0]) <= limit[:, 0]):
                    return True, begin
                self.controller.take(self._errors(y, begin))
            end = begin + y.shape[1]
            if end == noted:
                self._note_weights(row)
            if self.progress:
                self.progress(end - begin)
            begin = end
        return False, n_samples

    def _note_weights(self, row: int) -> None:
        self.weights[row] = np.reshape(filters_of(self.controller), self.weights.shape[1:])

    def _sample(self, values: np.ndarray) -> Any:
        """Return a sample as the controller takes it: a number, an array of several channels, or None of no channel."""
        if not values.size:
            return None
        return values.copy() if self.several else float(values[0])

    def _control_signal(self, references: np.ndarray) -> np.ndarray:
        y = self.controller.control_signal(self._sample(references))
        if not self.several:
            return np.array([as_returned(y, "control_signal")])
        y = np.asarray(y, dtype=np.float64).reshape(-1)
        if y.size != self.plant.limit.size:
            raise ValueError(
                f"control_signal must return a value for each of the {self.plant.limit.size} loudspeakers, got {y.size}"
            )
        return y

    def _errors(self, y: np.ndarray, n: int) -> np.ndarray:
        """Return the errors (K, samples) that control signals (J, samples) leave from sample n on."""
        amplified, end = self.plant.amplified(y), n + y.shape[1]
        for j, function in enumerate(self.functions):
            if function is not None:  # then y is one sample
                amplified[j] = amplified_sample(function, float(y[j, 0]))
        self.signals.amplifier_output[:, n:end] = amplified
        errors = self.plant.play(self.signals, n, end)
        self.signals.control_signal[:, n:end] = y
        return errors


def filters_of(controller: object) -> Any:
    """Return the control filters of a controller."""
    return getattr(controller, "control_filter", getattr(controller, "weights", None))
