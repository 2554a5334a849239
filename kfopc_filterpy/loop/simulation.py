"""The modified ANC structure of the paper's block diagrams: simulate a controller, amplifiers and paths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .._types import ChangingPaths, PerLoudspeaker, Seed
from .._validate import as_channels, as_count, as_positive, as_signal, per_loudspeaker
from ..controllers.base import Controller, Looped, checked_controller, differing_counts, listening
from ..controllers.channels import Channels
from ..controllers.core_controller import NO_SOLUTION, CoreController
from ..controllers.frequency_domain import runs_in_blocks
from ..controllers.processing import takes_none
from ..core.block import LOUDEST, LOUDEST_LEARNT
from ..core.run_loop import DIVERGED, REFUSED_ERROR, REFUSED_REFERENCE, RUNNING, Plant, Record, Signals
from ..paths.models import path_taps, sampling_rate
from ..paths.path_matrix import feedback_paths, is_path_matrix, secondary_paths
from ..power.amplifiers import Amplifiers, amplifier_models, amplifier_of_each, compiled_model
from ..power.constraint import DEFAULT_FS
from ..signals.recordings import Recording
from .inputs import (
    DIVERGENCE_LIMIT,
    SensorNoise,
    channel_disturbances,
    disturbance_at_microphone,
    naming_sample,
    noise_gain,
    switch_on_sample,
)
from .result import SimulationResult
from .schedule import Schedule, as_schedule, path_schedule, steps

STRETCH = 1600  # samples between two reports of progress, or two opportunities to interrupt a run: 0.1 s at 16 kHz
RECORDED = ("constraint_factor",)
POWERS = ("disturbance_power", "secondary_path_gain", "power_weight")  # recorded on request, for one channel

ChangingAmplifiers: TypeAlias = Amplifiers | Sequence[tuple[float, Amplifiers]]


def simulate(
    controller: Controller,
    reference: ArrayLike | None,
    *,
    secondary_path: ChangingPaths,
    primary_path: ChangingPaths | None = None,
    disturbance: ArrayLike | None = None,
    fs: float = DEFAULT_FS,
    amplifier: ChangingAmplifiers = None,
    rated_power: PerLoudspeaker | None = None,
    sensor_noise_std: float = 0.0,
    rng: Seed | None = None,
    switch_on_s: float = 0.0,
    feedback_path: ChangingPaths | None = None,
    noise_level_db: float | Sequence[tuple[float, float]] = 0.0,
    crossfade_s: float = 0.0,
    record_weights_every: int | None = None,
    record_powers: bool = False,
    progress: Callable[[int], Any] | None = None,
    compiled: bool = True,
) -> SimulationResult:
    """Run a controller in the modified ANC structure.

    For each sample, compute the control signal from the last weights, the amplifier's output and the error
    e = d - s*y_amp, then update the controller. Built-in controllers run at compiled speed, or block by block if they
    adapt once per block; a user-defined controller is called sample by sample.

    With several channels, the channel is the leading axis: I references, J loudspeakers, K error microphones. A
    user-defined controller then gets and returns arrays: ``control_signal(reference)``, (I,), returns (J,), and
    ``update(error)`` gets (K,).

    Paths, amplifiers and the level of the noise may change during the run. Give pairs (time in s, value) in place of a
    value, such as ``secondary_path=[(0.0, closed), (3.5, opened)]``. The times count from the start of `reference`,
    begin with 0 and rise; the value holds from the sample ``round(time * fs)`` on. The delay lines go on: sound that
    is on its way when a path changes arrives through the new one.

    Parameters
    ----------
    controller : Controller
        Controller. It continues from its present state, while the paths start silent: make a new one for a fresh run.
    reference : array_like
        (n_samples,) reference x, or (I, n_samples). Signals and paths may be a `Recording`, whose rate must be `fs`. None
        for a feedback controller, see `controllers.with_internal_model`.
    secondary_path : array_like or control.TransferFunction
        True secondary path s, loudspeaker amplifier to error microphone. With several channels (K, J, n_taps), or a
        matrix of systems: nested lists, or a system of several inputs and outputs.
    primary_path : array_like or control.TransferFunction, optional
        Path from the reference to the error microphone, which gives the disturbance p*x; (K, I, n_taps) or a matrix of
        systems; with one reference also (K, n_taps).
    disturbance : array_like, optional
        (n_samples,) disturbance d, or (K, n_samples), in place of `primary_path`.
    fs : float, default 16000
        Sample rate in Hz; paths given as systems must have the same.
    amplifier : callable, optional
        Amplifier model, or any function of a sample that returns a finite number; by default linear. With several
        loudspeakers one for all, or a sequence with one for each.
    rated_power : float or array_like, optional
        Rated power, which sets the scale of the divergence limit, of all loudspeakers or of each, (J,); by default the
        controller's, or 1 if it has none.
    sensor_noise_std : float, default 0
        Standard deviation of white noise at the error microphone.
    rng : int or numpy.random.Generator, optional
        Seed of the sensor noise; required if there is any.
    switch_on_s : float, default 0
        Time at which the control is switched on. Until then the loudspeaker is silent and the controller listens
        (`listen`): its delay lines and power estimates follow the noise, its weights stay. The result starts at that
        time.
    feedback_path : array_like or control.TransferFunction, optional
        Acoustic feedback from the amplifier to the reference microphone, (I, J, n_taps) with several; its first tap must
        be 0. By default none.
    noise_level_db : float, default 0
        Gain in dB of `reference`, and so of the disturbance that `primary_path` makes; not together with `disturbance`.
    crossfade_s : float, default 0
        Duration in s of a change of the paths or the level, at most the shortest time between two changes. Meanwhile the
        taps, or the gains, are interpolated linearly between the old and the new, for each sample. 0 switches at once;
        amplifiers are always switched.
    record_weights_every : int, optional
        Record the control filter (a controller's `control_filter`, or else its `weights`) every so many samples.
    record_powers : bool, default False
        Record the disturbance power, the secondary-path gain and the weight of a power budget; for one channel.
    progress : callable, optional
        Called with the number of samples done since its last call, such as `tqdm.update`.
    compiled : bool, default True
        False: call the controller sample by sample even if it has a faster way; the results are equal.

    Returns
    -------
    SimulationResult
        Record of the run. If the control signal exceeds ``1e6 sqrt(rated_power)``, the run stops without an error, and
        `diverged_at_s` is the time.

    Raises
    ------
    ValueError
        Signals that are empty, not finite or of different lengths; sample rates that differ; both or neither of
        `primary_path` and `disturbance`; a feedback path without delay; times that do not begin with 0, do not rise or
        are beyond the run. Nothing was changed. During a run: an amplifier that returns NaN, or an update without a
        solution (a covariance that is too large).
    TypeError
        A controller without `control_signal` and `update`, or an amplifier that is not a function.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import kf_opc, simulate
    >>> x = np.random.default_rng(0).standard_normal(16000)
    >>> controller = kf_opc(16, [0.0, 1.0], rated_power=0.25, state_noise=1e-9, measurement_noise=1e-3)
    >>> result = simulate(controller, x, secondary_path=[0.0, 1.0], primary_path=[0.0, 0.0, 0.0, 1.0])
    >>> bool(np.mean(result.control_signal[8000:] ** 2) < 1.02 * 0.25)  # unconstrained it would be 1
    True

    The primary path is five samples longer after half a second:

    >>> later = simulate(
    ...     controller, x, secondary_path=[0.0, 1.0], primary_path=[(0.0, np.eye(4)[3]), (0.5, np.eye(9)[8])]
    ... )
    >>> bool(np.all(later.disturbance[8000:] == x[7992:-8]))
    True
    """
    checked_controller(controller)
    fs = as_positive(fs, "fs", unit="Hz")
    for name, signal in (("reference", reference), ("disturbance", disturbance)):
        if isinstance(signal, Recording):
            sampling_rate(signal, fs, name=name)
    several = is_multichannel(controller, reference, secondary_path, disturbance)
    given: Any = reference
    none = takes_none(controller, reference)
    x, d, secondary = _read_signals(
        reference, noise_level_db, primary_path, disturbance, secondary_path, fs, crossfade_s, several
    )
    K, J, _ = secondary.values[0].shape
    _require_fit(controller, len(x), J, K, several)
    noise = SensorNoise(sensor_noise_std, rng)
    rated: Any = getattr(controller, "rated_power", None) if rated_power is None else rated_power
    if rated is not None:
        rated = per_loudspeaker(rated, J, "rated_power") if several else as_positive(rated, "rated_power")
    every = None if record_weights_every is None else as_count(record_weights_every, "record_weights_every")
    n_samples = x.shape[1]
    on = switch_on_sample(switch_on_s, fs, n_samples)
    amplifiers = as_schedule(amplifier, "amplifier", lambda one: _amplifiers(one, J), n_samples, fs)
    feedback = _feedback(feedback_path, fs, len(x), J, several, n_samples, crossfade_s)
    if hasattr(controller, "require_sample_rate"):
        controller.require_sample_rate(fs)
    weights = _weight_rows(n_samples - on, controller, every, several)
    if on:
        heard = x[:, :on].copy(), d[:, :on] + noise.take(K, on)
        signals_heard = heard if several else (signal[0] if len(signal) else None for signal in heard)
        listening(controller).listen(*signals_heard)
        x, d = x[:, on:], d[:, on:]

    plant = Plant(
        secondary.values[0][None],
        feedback.values[0],
        amplifiers.values[0][1],
        DIVERGENCE_LIMIT * np.sqrt(np.ones(J) if rated is None else np.broadcast_to(rated, J)),
    )
    n_samples = x.shape[1]
    results = [np.full((channels, n_samples), np.nan) for channels in (K, J, J, K)]
    signals = Signals(np.ascontiguousarray(x), np.ascontiguousarray(d), noise.filled(results[0]), *results)
    wanted = RECORDED + (POWERS if record_powers and not several else ())
    recorded = {name: np.full((J, n_samples), np.nan) for name in wanted}
    run = _Run(
        controller,
        plant,
        secondary,
        feedback,
        amplifiers,
        on,
        signals,
        recorded,
        weights,
        every or 1,
        several,
        progress,
    )
    compiled = compiled and not any(any(own) for own, _ in amplifiers.values)
    looped = controller.looped() if compiled and isinstance(controller, CoreController) else None
    each = feedback.values[0].size or any(hasattr(controller, name) for name in recorded)  # sample counts
    in_blocks = compiled and runs_in_blocks(controller) and not each
    with getattr(controller, "in_use", nullcontext()):
        diverged, end = run.loop(looped) if looped else run.blocks(x) if in_blocks else run.steps(x)
    for signal in (*results, *recorded.values()):
        signal[:, end:] = np.nan
    weights[-(-end // (every or 1)) :] = np.nan
    names = ("error", "control_signal", "amplifier_output", "anti_noise")
    found = {name: getattr(signals, name) for name in names} | recorded
    if not hasattr(controller, "power_weight"):
        found.pop("power_weight", None)
    if not several or (np.ndim(given) == 1 and J == K == 1):  # one channel drops its axis, as it was given
        x, d, found = x if none else x[0], d[0], {name: signal[0] for name, signal in found.items()}
        rated = None if rated is None else float(np.ravel(rated)[0])
    return SimulationResult(
        algorithm=str(getattr(controller, "name", type(controller).__name__)),
        fs=fs,
        rated_power=rated,
        reference=x.copy(),
        disturbance=d.copy(),
        **found,
        weights=weights if every else None,
        weights_time_s=np.arange(len(weights)) * every / fs if every else None,
        diverged_at_s=end / fs if diverged else None,
    )


@dataclass
class _Run:
    """A run: the controller, the plant, and what is recorded."""

    controller: Any
    plant: Plant
    secondary: Schedule  # of (K, J, taps)
    feedback: Schedule  # of (I, J, taps)
    amplifiers: Schedule  # of what `_amplifiers` returns
    on: int  # first sample of the run in the times of the schedules
    signals: Signals
    recorded: dict[str, np.ndarray]  # (J, n_samples)
    weights: np.ndarray  # (rows, ...)
    every: int
    several: bool
    progress: Callable[[int], Any] | None
    functions: list[Any] = field(init=False)  # for each loudspeaker: an amplifier that is not a model, or None

    def set_plant(self, n: int) -> int:
        """Make the plant what it is at sample n; return the first sample after it at which it may be another one."""
        self.plant.secondary[0], one = self.secondary.at(n + self.on)
        self.plant.feedback[:], other = self.feedback.at(n + self.on)
        (self.functions, self.plant.amplifiers[:]), last = self.amplifiers.at(n + self.on)
        return min(one, other, last) - self.on

    def loop(self, looped: Looped) -> tuple[bool, int]:
        """Run in the core, stretch by stretch: a run can be interrupted between them."""
        sources = looped.recorded
        records = [Record(sources[name], signal) for name, signal in self.recorded.items() if name in sources]
        if len(self.weights):
            rows = self.weights.reshape(len(self.weights), -1)
            records.append(Record(looped.control_filter.reshape(-1), rows, self.every, in_rows=True))
        status, begin, n_samples = RUNNING, 0, self.signals.error.shape[1]
        while begin < n_samples and status == RUNNING:
            end = min(begin + STRETCH, self.set_plant(begin), n_samples)
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

    def steps(self, x: np.ndarray) -> tuple[bool, int]:
        """Call the controller for each sample; return whether it diverged, and the first sample not completed."""
        changes = 0
        for n in range(x.shape[1]):
            if n == changes:
                changes = self.set_plant(n)
            with naming_sample(n):
                y = self._control_signal(self.plant.hear(self.signals, n))
                if not np.all(np.abs(y) <= self.plant.limit):
                    return True, n
                self.controller.update(self._sample(self._errors(y[:, None], n)[:, 0]))
            for name, signal in self.recorded.items():
                signal[:, n] = getattr(self.controller, name, np.nan)
            if len(self.weights) and n % self.every == 0:
                self.weights[n // self.every] = np.reshape(filters_of(self.controller), self.weights.shape[1:])
            if self.progress:
                self.progress(1)
        return False, x.shape[1]

    def blocks(self, x: np.ndarray) -> tuple[bool, int]:
        """Do what `steps` does for a controller that keeps its control filter for a block, in stretches within its blocks."""
        begin, changes, n_samples, limit = 0, 0, x.shape[1], self.plant.limit[:, None]
        # The first sample that the controller refuses begins a stretch, so that those before it are run.
        loud = np.any(np.abs(x) > LOUDEST_LEARNT, axis=0) | np.any(np.abs(self.signals.disturbance) > LOUDEST, axis=0)
        refused = int(np.argmax(loud)) if loud.any() else n_samples
        while begin < n_samples:
            if begin == changes:
                changes = self.set_plant(begin)
            row = -(-begin // self.every)  # of the next weights that are recorded
            noted = row * self.every + 1 if len(self.weights) else n_samples + 1
            end = min(begin + self.controller.samples_left, changes, noted, max(refused, begin + 1))
            with naming_sample(begin):
                y = self.controller.emit(x[:, begin:end], limit)
                if not np.all(np.abs(y[:, 0]) <= limit[:, 0]):
                    return True, begin
                self.controller.take(self._errors(y, begin))
            end = begin + y.shape[1]
            if end == noted:
                self.weights[row] = np.reshape(filters_of(self.controller), self.weights.shape[1:])
            if self.progress:
                self.progress(end - begin)
            begin = end
        return False, n_samples

    def _sample(self, values: np.ndarray) -> Any:
        """Return a sample as the controller takes it: a number, an array of several channels, or None of no channel."""
        if not values.size:
            return None
        return values.copy() if self.several else float(values[0])

    def _control_signal(self, references: np.ndarray) -> np.ndarray:
        y = self.controller.control_signal(self._sample(references))
        if not self.several:
            return np.array([_as_sample(y, "control_signal")])
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
                amplified[j] = _as_sample(function(float(y[j, 0])), "amplifier")
                if not np.isfinite(amplified[j, 0]):
                    raise ValueError(f"amplifier must return a finite number, got {amplified[j, 0]} for {y[j, 0]}")
        self.signals.amplifier_output[:, n:end] = amplified
        errors = self.plant.play(self.signals, n, end)
        self.signals.control_signal[:, n:end] = y
        return errors


def is_multichannel(
    controller: object, reference: Any, secondary_path: ChangingPaths, disturbance: ArrayLike | None
) -> bool:
    """Return whether a run has several channels: its controller, one of its signals or its secondary paths say so."""
    own = isinstance(controller, Channels) and controller.multichannel
    heard: Any = disturbance
    return (
        own
        or np.ndim(reference) == 2
        or np.ndim(heard) == 2
        or any(is_path_matrix(path) for _, path in steps(secondary_path, "secondary_path"))
    )


def filters_of(controller: object) -> Any:
    """Return the control filters of a controller."""
    return getattr(controller, "control_filter", getattr(controller, "weights", None))


def _as_sample(value: Any, source: str) -> float:
    """Return the result of a user's function, NaN included, as a float."""
    try:
        return float(np.asarray(value).reshape(()))
    except (TypeError, ValueError) as error:
        raise TypeError(f"{source} must return one number, got {value!r}") from error


def _read_signals(
    reference: Any,
    noise_level_db: Any,
    primary_path: Any,
    disturbance: Any,
    secondary_path: Any,
    fs: float,
    crossfade_s: float,
    several: bool,
) -> tuple[np.ndarray, np.ndarray, Schedule]:
    """Return references (I, n), disturbances (K, n) and secondary paths (K, J, taps)."""
    if reference is None and (disturbance is None or primary_path is not None):
        raise ValueError(
            "without a reference give disturbance=, not primary_path=: the path would begin at the reference"
        )
    heard = ("disturbance", disturbance) if reference is None else ("reference", reference)
    signal = np.atleast_2d((as_channels if several else as_signal)(heard[1], heard[0]))
    x = signal[:0] if reference is None else signal
    louder = not np.array_equal(noise_level_db, 0.0)
    if disturbance is not None and louder:
        raise ValueError(
            "noise_level_db needs primary_path=, so that the disturbance follows; if you give the disturbance, scale "
            "both signals yourself, with signals.level_jump for example"
        )
    if louder:
        x = x * noise_gain(noise_level_db, x.shape[1], fs, crossfade_s)

    def read(paths: Any) -> np.ndarray:
        if several:
            return secondary_paths(paths, fs=fs)[0]
        return path_taps(paths, fs=fs, name="secondary_path").reshape(1, 1, -1)

    secondary = path_schedule(secondary_path, "secondary_path", read, x.shape[1], fs, crossfade_s)
    if several:
        K = len(secondary.values[0])
        return x, channel_disturbances(x, primary_path, disturbance, fs, K, crossfade_s), secondary
    if reference is None:
        return x, signal, secondary
    return x, disturbance_at_microphone(x[0], primary_path, disturbance, fs, crossfade_s)[None], secondary


def _feedback(
    feedback_path: Any, fs: float, n_references: int, J: int, several: bool, n_samples: int, crossfade_s: float
) -> Schedule:
    """Return the feedback paths, (I, J, taps); 0 taps without any."""

    def read(paths: Any) -> np.ndarray:
        if paths is None:
            return np.zeros((n_references, J, 0))
        feedback, _ = feedback_paths(paths, several, fs)
        if feedback.shape[:2] != (n_references, J):
            raise ValueError(
                f"feedback_path must be (I references, J loudspeakers, taps) with I = {n_references}, J = {J}, "
                f"got {feedback.shape}"
            )
        return feedback

    return path_schedule(feedback_path, "feedback_path", read, n_samples, fs, crossfade_s)


def _amplifiers(amplifier: Any, J: int) -> tuple[list[Any], np.ndarray]:
    """Return for each loudspeaker an amplifier that is a user's function, or None, and the models, (J, 3)."""
    each = amplifier_of_each(amplifier, J)
    functions: list[Any] = [one if one is not None and compiled_model(one) is None else None for one in each]
    models = amplifier_models([None if function else one for one, function in zip(each, functions, strict=True)], J)
    return functions, models.view(np.float64).reshape(J, -1)


def _require_fit(controller: Any, n_references: int, n_loudspeakers: int, n_microphones: int, several: bool) -> None:
    """Raise ValueError if a controller says that it is made for other numbers of channels."""
    if not several:
        return
    if isinstance(controller, Channels) and not controller.multichannel:
        raise ValueError("controller has one channel: give it secondary paths (K microphones, J loudspeakers, taps)")
    run = {"n_references": n_references, "n_loudspeakers": n_loudspeakers, "n_microphones": n_microphones}
    for name, own in differing_counts(controller, **run):
        what = name.removeprefix("n_")
        raise ValueError(
            f"the controller is made for {own} {what}, but reference and paths of the run have {run[name]}"
        )


def _weight_rows(n_samples: int, controller: Any, every: int | None, several: bool) -> np.ndarray:
    """Return room for the control filters at every `every`-th sample, (rows, L) or (rows, J, I, L)."""
    if every is None:
        return np.empty((0, 0))
    filters = filters_of(controller)
    if filters is None or (several and np.ndim(filters) != 3):
        raise ValueError(
            f"record_weights_every needs a controller with an attribute weights, {'(J, I, L)' if several else '(L,)'}"
        )
    return np.empty((-(-n_samples // every), *(np.shape(filters) if several else (np.size(filters),))))
