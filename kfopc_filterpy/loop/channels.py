"""The control loop of several loudspeakers and microphones; `simulate` calls it if there is more than one channel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import fftconvolve

from .._validate import as_channels, as_count, as_positive, per_loudspeaker
from ..controllers.base import FilteredReferenceController
from ..controllers.channels import amplifier_models, delay_lines
from ..controllers.step import Compiled, adapt_step, emit_step
from ..kernels.borrowing import borrowed
from ..kernels.compiling import compiled, inlined, part
from ..kernels.delay_lines import newest, push
from ..kernels.vectors import copy_into, dot
from ..paths.channels import is_path_matrix, path_matrix, primary_paths, secondary_paths
from ..power.amplifiers import amplify, compiled_model
from .inputs import (
    DIVERGENCE_LIMIT,
    SensorNoise,
    listen_first,
    naming_sample,
    require_one_source,
    switch_on_sample,
)
from .result import SimulationResult
from .run import DIVERGED, REFUSED, RUNNING, STEP


class ChannelPlant(NamedTuple):
    """The true amplifiers and paths."""

    secondary: np.ndarray  # (K, J, taps) of s
    feedback: np.ndarray  # (I, J, taps) from loudspeaker j to reference microphone i; 0 taps: none
    output: np.ndarray  # (J, size) delay lines of y after the amplifiers
    amplifiers: np.ndarray  # (J, 1) records of kind, limit and sharpness


class ChannelSignals(NamedTuple):
    """Signals of a run: three inputs, then the results of the loop."""

    reference: np.ndarray  # (I, n)
    disturbance: np.ndarray  # (K, n)
    sensor_noise: np.ndarray  # (K, n)
    error: np.ndarray  # (K, n)
    anti_noise: np.ndarray  # (K, n)
    control_signal: np.ndarray  # (J, n)
    amplifier_output: np.ndarray  # (J, n)
    constraint_factor: np.ndarray  # (J, n)


@inlined
def hear(plant, signals, n, x):
    """Set x to the references: the noise, plus the loudspeakers' feedback, at least a sample late."""
    f = plant.feedback
    for i in range(x.size):
        x[i] = signals.reference[i, n]
        if f.shape[2] > 1:
            for j in range(f.shape[1]):
                x[i] += dot(f[i, j, 1:], newest(plant.output[j], f.shape[2] - 1))


@inlined
def play(plant, y, signals, n):
    """Send the control signals through amplifiers and paths; note them, the anti-noise and the errors of sample n."""
    for j in range(y.size):
        amplified = amplify(plant.amplifiers[j], y[j])
        push(plant.output[j], amplified)
        signals.control_signal[j, n], signals.amplifier_output[j, n] = y[j], amplified
    s = plant.secondary
    for k in range(s.shape[0]):
        a = 0.0
        for j in range(s.shape[1]):
            a += dot(s[k, j], newest(plant.output[j], s.shape[2]))
        signals.anti_noise[k, n] = a
        signals.error[k, n] = signals.disturbance[k, n] - a + signals.sensor_noise[k, n]


@part()
def note_channel_weights(rows, row, weights):
    """Store the control filters, (J, I, L), by loops for the reason given in `copy_into`."""
    for j in range(weights.shape[0]):
        for i in range(weights.shape[1]):
            copy_into(rows[row, j, i], weights[j, i])


@compiled(nogil=True)
def run_channels(steps, plant, signals, weights, limit, every, begin, end):
    """Run a controller, given by its `ChannelSteps`, over the samples from `begin` to `end` of a run.

    Return the status and the first sample not done. The control filters are stored in `weights`, (rows, J, I, L), at
    every `every`-th sample.
    """
    steps, plant, signals = borrowed(steps), borrowed(plant), borrowed(signals)
    x, e = np.empty(signals.reference.shape[0]), np.empty(signals.error.shape[0])
    for n in range(begin, end):
        hear(plant, signals, n, x)
        y = emit_step(steps, x)
        for j in range(y.size):
            if not abs(y[j]) <= limit[j]:
                return DIVERGED, n
        play(plant, y, signals, n)
        for k in range(e.size):
            e[k] = signals.error[k, n]
        if not adapt_step(steps, e, y, True):
            return REFUSED, n
        for j in range(y.size):
            signals.constraint_factor[j, n] = steps.constraint_factor[j]
        if weights.shape[0] > 0 and n % every == 0:
            note_channel_weights(weights, n // every, steps.control_filter)
    return RUNNING, end


@compiled()
def hear_once(plant, signals, n, x):
    """Call `hear` from Python."""
    hear(plant, signals, n, x)


@compiled()
def play_once(plant, y, signals, n):
    """Call `play` from Python."""
    play(plant, y, signals, n)


@dataclass
class ChannelRun:
    """A run of several channels: the controller, the plant, and what is recorded."""

    controller: Any
    plant: ChannelPlant
    limit: np.ndarray
    weights: np.ndarray
    every: int
    amplifiers: list[Any]  # functions of a sample that have no compiled model, or None
    progress: Callable[[int], Any] | None

    def over(self, signals: ChannelSignals, compiled: bool) -> tuple[int, int]:
        """Run over all samples; return the status and the first sample not done."""
        own = isinstance(self.controller, FilteredReferenceController) and not any(self.amplifiers)
        state = self.controller.compiled_state() if compiled and own else None
        return self._steps(signals) if state is None else self._blocks(state, signals)

    def _blocks(self, state: Any, signals: ChannelSignals) -> tuple[int, int]:
        """Run in compiled code, block by block: a run can be interrupted between blocks, and the controller may work."""
        code, status, begin, n_samples = Compiled(state), RUNNING, 0, signals.error.shape[1]
        while begin < n_samples and status == RUNNING:
            end = min(begin + (self.controller.samples_to_block() or STEP), n_samples)
            try:
                status, done = run_channels(
                    code.steps, self.plant, signals, self.weights, self.limit, self.every, begin, end
                )
            finally:  # even if interrupted, the controller must have the state of its last sample
                self.controller.after_compiled(state)
            if self.progress:
                self.progress(done - begin)
            begin = done
        if status == REFUSED:
            with naming_sample(begin):
                self.controller.update(signals.error[:, begin])  # raises, with the reason
                raise ValueError("the controller refused the errors")
        return status, begin

    def _steps(self, signals: ChannelSignals) -> tuple[int, int]:
        """Call the controller for each sample."""
        x = np.empty(signals.reference.shape[0])
        for n in range(signals.error.shape[1]):
            with naming_sample(n):
                hear_once(self.plant, signals, n, x)
                y = self._control_signal(x)
                if not np.all(np.abs(y) <= self.limit):
                    return DIVERGED, n
                self._play(y, signals, n)
                self.controller.update(signals.error[:, n].copy())
            signals.constraint_factor[:, n] = getattr(self.controller, "constraint_factor", np.nan)
            if self.weights.shape[0] > 0 and n % self.every == 0:
                self.weights[n // self.every] = filters_of(self.controller)
            if self.progress:
                self.progress(1)
        return RUNNING, signals.error.shape[1]

    def _control_signal(self, x: np.ndarray) -> np.ndarray:
        y = np.asarray(self.controller.control_signal(x.copy()), dtype=np.float64).reshape(-1)
        if y.size != self.limit.size:
            raise ValueError(
                f"control_signal must return a value for each of the {self.limit.size} loudspeakers, got {y.size}"
            )
        return np.ascontiguousarray(y)

    def _play(self, y: np.ndarray, signals: ChannelSignals, n: int) -> None:
        if not any(self.amplifiers):
            play_once(self.plant, y, signals, n)
            return
        amplified = np.array(
            [float(amplifier(v)) if amplifier else v for amplifier, v in zip(self.amplifiers, y, strict=True)]
        )
        if not np.isfinite(amplified).all():
            raise ValueError(f"amplifier must return finite numbers, got {amplified} for {y}")
        play_once(self.plant, amplified, signals, n)
        signals.control_signal[:, n] = y


def is_multichannel(controller: Any, reference: Any, secondary_path: Any, disturbance: Any) -> bool:
    """Return whether a run has several channels: its controller, one of its signals or its secondary paths say so."""
    own = isinstance(controller, FilteredReferenceController) and controller.multichannel
    return own or np.ndim(reference) == 2 or np.ndim(disturbance) == 2 or is_path_matrix(secondary_path)


def filters_of(controller: Any) -> Any:
    """Return the control filters of a controller."""
    return getattr(controller, "control_filter", getattr(controller, "weights", None))


def simulate_channels(
    controller: Any,
    reference: Any,
    *,
    secondary_path: Any,
    primary_path: Any,
    disturbance: Any,
    fs: float,
    amplifier: Any,
    rated_power: Any,
    noise: SensorNoise,
    switch_on_s: float,
    feedback_path: Any,
    record_weights_every: int | None,
    progress: Callable[[int], Any] | None,
    compiled: bool,
) -> SimulationResult:
    """Run a controller of several channels; the arguments are those of `simulate`, with channels as leading axes."""
    fs = as_positive(fs, "fs", unit="Hz")
    x = np.atleast_2d(as_channels(reference, "reference"))
    secondary, _ = secondary_paths(secondary_path, fs=fs)
    K, J, _ = secondary.shape
    d = channel_disturbances(x, primary_path, disturbance, fs, K)
    _require_fit(controller, len(x), J, K)
    rated = getattr(controller, "rated_power", None) if rated_power is None else rated_power
    rated = None if rated is None else per_loudspeaker(rated, J, "rated_power")
    every = None if record_weights_every is None else as_count(record_weights_every, "record_weights_every")
    on = switch_on_sample(switch_on_s, fs, x.shape[1])
    if hasattr(controller, "require_sample_rate"):
        controller.require_sample_rate(fs)
    if on:
        listen_first(controller, x[:, :on].copy(), d[:, :on] + noise.take(K, on))
        x, d = x[:, on:], d[:, on:]
    plant, functions = _plant(secondary, feedback_path, amplifier, fs, len(x))
    weights = _weight_rows(x.shape[1], controller, every)
    limit = DIVERGENCE_LIMIT * np.sqrt(np.ones(J) if rated is None else rated)
    run = ChannelRun(controller, plant, limit, weights, every or 1, functions, progress)
    signals = ChannelSignals(
        *(np.ascontiguousarray(s) for s in (x, d, np.zeros(d.shape) + noise.take(K, d.shape[1]))),
        *np.full((2, *d.shape), np.nan),
        *np.full((3, J, d.shape[1]), np.nan),
    )
    status, end = run.over(signals, compiled)
    if status == DIVERGED:
        for signal in signals[3:]:
            signal[:, end:] = np.nan
    weights[-(-end // (every or 1)) :] = np.nan
    if np.ndim(reference) == 1 and J == K == 1:
        signals = ChannelSignals(*(signal[0] for signal in signals))  # one channel drops its axis, as it was given
        rated = None if rated is None else float(rated[0])
    return SimulationResult(
        algorithm=str(getattr(controller, "name", type(controller).__name__)),
        fs=fs,
        rated_power=rated,
        reference=signals.reference,
        disturbance=signals.disturbance,
        error=signals.error,
        control_signal=signals.control_signal,
        amplifier_output=signals.amplifier_output,
        anti_noise=signals.anti_noise,
        constraint_factor=signals.constraint_factor,
        weights=weights if every else None,
        weights_time_s=np.arange(len(weights)) * every / fs if every else None,
        diverged_at_s=end / fs if status == DIVERGED else None,
    )


def channel_disturbances(
    x: np.ndarray, primary_path: Any, disturbance: Any, fs: float, n_microphones: int
) -> np.ndarray:
    """Return the disturbances, (K, n_samples), as given or as the sum of p_ki * x_i."""
    require_one_source(primary_path, disturbance)
    if primary_path is not None:
        primary, _ = primary_paths(primary_path, fs=fs)
        if primary.shape[:2] != (n_microphones, len(x)):
            raise ValueError(
                f"primary_path must be (K microphones, I references, taps) with K = {n_microphones} of secondary_path "
                f"and I = {len(x)} of reference, got {primary.shape}"
            )
        return np.array([fftconvolve(x, p, axes=-1).sum(axis=0)[: x.shape[1]] for p in primary])
    d = np.atleast_2d(as_channels(disturbance, "disturbance"))
    if d.shape != (n_microphones, x.shape[1]):
        raise ValueError(
            f"disturbance must be (K microphones, n_samples) = {(n_microphones, x.shape[1])}, got {d.shape}"
        )
    return d


def _require_fit(controller: Any, n_references: int, n_loudspeakers: int, n_microphones: int) -> None:
    """Raise ValueError if a built-in controller is made for other numbers of channels."""
    if not isinstance(controller, FilteredReferenceController):
        return
    if not controller.multichannel:
        raise ValueError("controller has one channel: give it secondary paths (K microphones, J loudspeakers, taps)")
    counts = {
        "references": (controller.n_references, n_references),
        "loudspeakers": (controller.n_loudspeakers, n_loudspeakers),
        "microphones": (controller.n_microphones, n_microphones),
    }
    for name, (own, run) in counts.items():
        if own != run:
            raise ValueError(f"the controller is made for {own} {name}, but reference and paths of the run have {run}")


def _plant(
    secondary: np.ndarray, feedback_path: Any, amplifier: Any, fs: float, n_references: int
) -> tuple[ChannelPlant, list[Any]]:
    """Return the plant, and the amplifiers that have no compiled model, as functions."""
    J = secondary.shape[1]
    feedback = np.zeros((n_references, J, 0))
    if feedback_path is not None:
        feedback, _ = path_matrix(feedback_path, fs=fs, name="feedback_path")
        if feedback.shape[:2] != (n_references, J):
            raise ValueError(
                f"feedback_path must be (I references, J loudspeakers, taps) with I = {n_references}, J = {J}, "
                f"got {feedback.shape}"
            )
        if np.any(feedback[..., 0]):
            raise ValueError("feedback_path must have a delay of a sample at least: a first tap is not 0")
    each = list(amplifier) if isinstance(amplifier, Sequence) else [amplifier] * J
    if len(each) != J or not all(one is None or callable(one) for one in each):
        raise TypeError(f"amplifier must be a function of a sample, or one for each of the {J} loudspeakers, or None")
    functions = [one if one is not None and compiled_model(one) is None else None for one in each]
    models = amplifier_models([None if function else one for one, function in zip(each, functions, strict=True)], J)
    return ChannelPlant(
        secondary, feedback, delay_lines(J, max(secondary.shape[2], feedback.shape[2])), models
    ), functions


def _weight_rows(n_samples: int, controller: Any, every: int | None) -> np.ndarray:
    shape = np.shape(filters_of(controller)) if every else (0, 0, 0)
    if len(shape) != 3:
        raise ValueError("record_weights_every needs a controller with an attribute weights, (J, I, L)")
    return np.empty((-(-n_samples // every) if every else 0, *shape))
