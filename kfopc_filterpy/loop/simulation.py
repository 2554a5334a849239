"""The modified ANC structure of the paper's block diagrams: simulate a controller, an amplifier and the paths."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from .._validate import as_count, as_positive, as_signal
from ..controllers.base import NO_SOLUTION, Controller, FilteredReferenceController
from ..controllers.step import Compiled
from ..kernels.delay_lines import delay_line
from ..paths.models import path_taps
from ..power.amplifiers import Amplifier, LinearAmplifier, compiled_model
from ..power.constraint import DEFAULT_FS
from .channels import is_multichannel, simulate_channels
from .inputs import (
    DIVERGENCE_LIMIT,
    SensorNoise,
    disturbance_at_microphone,
    listen_first,
    naming_sample,
    switch_on_sample,
)
from .result import SimulationResult
from .run import DIVERGED, REFUSED, RUNNING, STEP, Plant, Stretch, anti_noise_once, reference_once, run

RECORDED = ("error", "control_signal", "amplifier_output", "anti_noise", "constraint_factor")
POWERS = ("disturbance_power", "secondary_path_gain", "power_weight")  # recorded on request


def simulate(
    controller: Controller,
    reference: Any,
    *,
    secondary_path: Any,
    primary_path: Any = None,
    disturbance: Any = None,
    fs: float = DEFAULT_FS,
    amplifier: Amplifier | None = None,
    rated_power: Any = None,
    sensor_noise_std: float = 0.0,
    rng: Any = None,
    switch_on_s: float = 0.0,
    feedback_path: Any = None,
    record_weights_every: int | None = None,
    record_powers: bool = False,
    progress: Callable[[int], Any] | None = None,
    compiled: bool = True,
) -> SimulationResult:
    """Run a controller in the modified ANC structure.

    For each sample, compute the control signal from the last weights, the amplifier's output and the error
    e = d - s*y_amp, then update the controller. Built-in controllers run at compiled speed; a user-defined controller is
    called sample by sample.

    With several channels, the channel is the leading axis: I references, J loudspeakers, K error microphones. A
    user-defined controller then gets and returns arrays: ``control_signal(reference)``, (I,), returns (J,), and
    ``update(error)`` gets (K,).

    Parameters
    ----------
    controller : Controller
        Controller. It continues from its present state, while the paths start silent: make a new one for a fresh run.
    reference : array_like
        (n_samples,) reference x, or (I, n_samples).
    secondary_path : array_like or control.TransferFunction
        True secondary path s, loudspeaker amplifier to error microphone. With several channels (K, J, n_taps), or a
        matrix of systems: nested lists, or a system of several inputs and outputs.
    primary_path : array_like or control.TransferFunction, optional
        Path from the reference to the error microphone, which gives the disturbance p*x; (K, I, n_taps) or a matrix of
        systems.
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
    record_weights_every : int, optional
        Record the control filter (a controller's `control_filter`, or else its `weights`) every so many samples.
    record_powers : bool, default False
        Record the disturbance power, the secondary-path gain and the weight of a power budget; for one channel.
    progress : callable, optional
        Called with the number of samples done since its last call, such as `tqdm.update`.
    compiled : bool, default True
        False: call the controller sample by sample even if it has a compiled loop; the results are equal.

    Returns
    -------
    SimulationResult
        Record of the run. If the control signal exceeds ``1e6 sqrt(rated_power)``, the run stops without an error, and
        `diverged_at_s` is the time.

    Raises
    ------
    ValueError
        Signals that are empty, not finite or of different lengths; sample rates that differ; both or neither of
        `primary_path` and `disturbance`; a feedback path without delay. Nothing was changed. During a run: an amplifier
        that returns NaN, or an update without a solution (a silent reference with q = 0).
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
    """
    if isinstance(controller, type) or not isinstance(controller, Controller):
        raise TypeError(f"controller must have control_signal(reference) and update(error), got {controller!r}")
    if is_multichannel(controller, reference, secondary_path, disturbance):
        return simulate_channels(
            controller,
            reference,
            secondary_path=secondary_path,
            primary_path=primary_path,
            disturbance=disturbance,
            fs=fs,
            amplifier=amplifier,
            rated_power=rated_power,
            noise=SensorNoise(sensor_noise_std, rng),
            switch_on_s=switch_on_s,
            feedback_path=feedback_path,
            record_weights_every=record_weights_every,
            progress=progress,
            compiled=compiled,
        )
    if amplifier is not None and not callable(amplifier):
        raise TypeError(f"amplifier must be a function of a sample, or None, got {amplifier!r}")
    fs = as_positive(fs, "fs", unit="Hz")
    x = as_signal(reference, "reference")
    d = disturbance_at_microphone(x, primary_path, disturbance, fs)
    noise = SensorNoise(sensor_noise_std, rng)
    if rated_power is None:
        rated_power = getattr(controller, "rated_power", None)
    rated_power = None if rated_power is None else as_positive(rated_power, "rated_power")
    limit = DIVERGENCE_LIMIT * np.sqrt(1.0 if rated_power is None else rated_power)
    every = None if record_weights_every is None else as_count(record_weights_every, "record_weights_every")
    on = switch_on_sample(switch_on_s, fs, x.size)
    plant = _plant(secondary_path, feedback_path, amplifier, fs)
    if hasattr(controller, "require_sample_rate"):
        controller.require_sample_rate(fs)
    weights = _weight_rows(x.size - on, controller, every)
    if on:
        listen_first(controller, x[:on], d[:on] + noise.take(on))
        x, d = x[on:], d[on:]

    run_stretch = partial(_run_steps, controller, plant, amplifier)
    if compiled and isinstance(controller, FilteredReferenceController) and compiled_model(amplifier) is not None:
        state = controller.compiled_state()
        if state is not None:
            run_stretch = partial(_run_compiled, controller, state, plant)
    names = RECORDED + POWERS if record_powers else RECORDED
    recorded = {name: np.empty(x.size) for name in names}
    status, end = RUNNING, 0
    for first in range(0, x.size, STEP):
        stretch = _stretch(x[first : first + STEP], d[first : first + STEP], noise)
        status, done = run_stretch(stretch, weights, limit, every or 1, first, progress)
        end = first + done
        for name, signal in recorded.items():
            signal[first:end] = getattr(stretch, name)[:done]
        if status != RUNNING:
            break
    for signal in recorded.values():
        signal[end:] = np.nan
    weights[-(-end // (every or 1)) :] = np.nan
    if not hasattr(controller, "power_weight"):
        recorded.pop("power_weight", None)
    return SimulationResult(
        algorithm=str(getattr(controller, "name", type(controller).__name__)),
        fs=fs,
        rated_power=rated_power,
        reference=x.copy(),
        disturbance=d.copy(),
        **recorded,
        weights=weights if every else None,
        weights_time_s=np.arange(len(weights)) * every / fs if every else None,
        diverged_at_s=end / fs if status == DIVERGED else None,
    )


def _stretch(x: np.ndarray, d: np.ndarray, noise: SensorNoise) -> Stretch:
    """Return the signals of a stretch: the inputs, and room for the results of the loop."""
    left = np.full((len(RECORDED + POWERS), x.size), np.nan)
    return Stretch(x, d, np.zeros(x.size) + noise.take(x.size), *left)


def _run_compiled(
    controller: FilteredReferenceController,
    state: Any,
    plant: Plant,
    stretch: Stretch,
    weights: np.ndarray,
    limit: float,
    every: int,
    first: int,
    progress: Callable[[int], Any] | None,
) -> tuple[int, int]:
    """Run a stretch by `run.run`."""
    code = Compiled(state)  # named, so that it outlives the run
    try:
        status, done = run(code.steps, plant, stretch, weights, limit, every, first)
    finally:  # even if interrupted, the controller must have the state of its last sample
        controller.after_compiled(state)
    if progress:
        progress(done)
    if status == REFUSED:
        with naming_sample(first + done):
            controller.update(float(stretch.error[done]))  # raises, with the reason
            raise ValueError(NO_SOLUTION)
    return status, done


def _run_steps(
    controller: Controller,
    plant: Plant,
    amplifier: Amplifier | None,
    stretch: Stretch,
    weights: np.ndarray,
    limit: float,
    every: int,
    first: int,
    progress: Callable[[int], Any] | None,
) -> tuple[int, int]:
    """Run a stretch like `run.run`, but call the controller for each sample."""
    for k in range(stretch.reference.size):
        with naming_sample(first + k):
            x = reference_once(plant, stretch.reference[k])
            y = _as_sample(controller.control_signal(x), "control_signal")
            if not abs(y) <= limit:
                return DIVERGED, k
            y_amplified = y if amplifier is None else _as_sample(amplifier(y), "amplifier")
            if not np.isfinite(y_amplified):
                raise ValueError(f"amplifier must return a finite number, got {y_amplified} for {y}")
            a = anti_noise_once(plant, y_amplified)
            e = float(stretch.disturbance[k] - a + stretch.sensor_noise[k])
            controller.update(e)
        stretch.error[k], stretch.control_signal[k] = e, y
        stretch.amplifier_output[k], stretch.anti_noise[k] = y_amplified, a
        for name in ("constraint_factor", *POWERS):
            getattr(stretch, name)[k] = getattr(controller, name, np.nan)
        if weights.shape[0] > 0 and (first + k) % every == 0:
            now = getattr(controller, "control_filter", getattr(controller, "weights", None))
            weights[(first + k) // every] = np.array(now, dtype=np.float64).reshape(-1)
        if progress:
            progress(1)
    return RUNNING, stretch.reference.size


def _as_sample(value: Any, source: str) -> float:
    """Return the result of a user's function, NaN included, as a float."""
    try:
        return float(np.asarray(value).reshape(()))
    except (TypeError, ValueError) as error:
        raise TypeError(f"{source} must return one number, got {value!r}") from error


def _plant(secondary_path: Any, feedback_path: Any, amplifier: Amplifier | None, fs: float) -> Plant:
    secondary = path_taps(secondary_path, fs=fs, name="secondary_path")
    feedback = np.zeros(0)
    if feedback_path is not None:
        feedback = path_taps(feedback_path, fs=fs, name="feedback_path")
        if feedback[0] != 0:
            raise ValueError(
                f"feedback_path must have a delay of a sample at least: its first tap is {feedback[0]:g}, not 0"
            )
    model = compiled_model(amplifier)
    if model is None:  # a user's function: `_run_steps` applies it
        model = LinearAmplifier().model
    return Plant(secondary, feedback, delay_line(max(secondary.size, feedback.size)), model)


def _weight_rows(n_samples: int, controller: Controller, every: int | None) -> np.ndarray:
    if every is None:
        return np.empty((0, 0))
    if not hasattr(controller, "weights"):
        raise ValueError("record_weights_every needs a controller with an attribute weights, (L,)")
    return np.empty((-(-n_samples // every), np.size(controller.weights)))
