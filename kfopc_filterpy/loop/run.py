"""The compiled loop: a controller and the plant, sample by sample over a stretch of signals, for any algorithm."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..controllers.step import adapt_step, emit_step
from ..kernels.borrowing import borrowed
from ..kernels.compiling import compiled, inlined
from ..kernels.delay_lines import newest, push
from ..kernels.vectors import copy_into, dot
from ..power.amplifiers import amplify

STEP = 16000  # samples between two reports of progress, or two opportunities to interrupt a run
RUNNING, DIVERGED, REFUSED = 0, 1, 2


class Plant(NamedTuple):
    """The true amplifier and paths."""

    secondary: np.ndarray  # taps of s
    feedback: np.ndarray  # taps from the amplifier to the reference microphone; size 0: none
    output: np.ndarray  # delay line of y after the amplifier
    amplifier: np.ndarray  # record of kind, limit and sharpness


class Stretch(NamedTuple):
    """Signals of a stretch of a run, (n,) each: three inputs, then the results of the loop."""

    reference: np.ndarray
    disturbance: np.ndarray
    sensor_noise: np.ndarray
    error: np.ndarray
    control_signal: np.ndarray
    amplifier_output: np.ndarray
    anti_noise: np.ndarray
    constraint_factor: np.ndarray
    disturbance_power: np.ndarray
    secondary_path_gain: np.ndarray
    power_weight: np.ndarray


@inlined
def part_of(signals, begin, end):
    """Return the samples from `begin` to `end` of all signals, as views."""
    part = slice(begin, end)
    return Stretch(
        signals.reference[part],
        signals.disturbance[part],
        signals.sensor_noise[part],
        signals.error[part],
        signals.control_signal[part],
        signals.amplifier_output[part],
        signals.anti_noise[part],
        signals.constraint_factor[part],
        signals.disturbance_power[part],
        signals.secondary_path_gain[part],
        signals.power_weight[part],
    )


@inlined
def measured_reference(plant, x):
    """Return the reference microphone's signal: the noise, plus the loudspeaker's feedback, at least a sample late."""
    taps = plant.feedback.size
    return x if taps < 2 else x + dot(plant.feedback[1:], newest(plant.output, taps - 1))


@inlined
def anti_noise(plant, y_amplified):
    """Return (s * y_amp)(n)."""
    push(plant.output, y_amplified)
    return dot(plant.secondary, newest(plant.output, plant.secondary.size))


@inlined
def note_weights(rows, weights, every, n):
    """Store the weights if sample n is one that is recorded; without rows, none is."""
    if rows.shape[0] > 0 and n % every == 0:
        copy_into(rows[n // every], weights)


@compiled(nogil=True)
def run(steps, plant, signals, weights, limit, every, first):
    """Run a controller, given by its `Steps`, over a stretch, whose first sample is sample `first` of the run.

    Return the status and the number of samples done. The control filter is stored in `weights`, (rows, L), at every
    `every`-th sample.
    """
    steps, plant, signals = borrowed(steps), borrowed(plant), borrowed(signals)
    used = steps.used[0]
    for k in range(signals.reference.size):
        y = emit_step(steps, measured_reference(plant, signals.reference[k]))
        if not abs(y) <= limit:
            return DIVERGED, k
        y_amplified = amplify(plant.amplifier, y)
        a = anti_noise(plant, y_amplified)
        e = signals.disturbance[k] - a + signals.sensor_noise[k]
        signals.error[k], signals.control_signal[k] = e, y
        if not adapt_step(steps, e, y, True):
            return REFUSED, k
        signals.amplifier_output[k], signals.anti_noise[k] = y_amplified, a
        signals.constraint_factor[k], signals.disturbance_power[k] = used.factor, used.power
        signals.secondary_path_gain[k], signals.power_weight[k] = used.gain, steps.power_weight[0]
        note_weights(weights, steps.control_filter, every, first + k)
    return RUNNING, signals.reference.size


@compiled()
def reference_once(plant, x):
    """Call `measured_reference` from Python."""
    return measured_reference(plant, x)


@compiled()
def anti_noise_once(plant, y_amplified):
    """Call `anti_noise` from Python."""
    return anti_noise(plant, y_amplified)
