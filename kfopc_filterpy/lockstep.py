"""Many scenarios of the loop side by side, with the gains of one filter: those depend on the reference alone.

A few scenarios take turns within a sample, so that the processor overlaps what one of them alone would wait for. What
each does is what `loop.run` does with a Kalman controller, of the same functions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ._compile import borrowed, compiled, part
from .amplifiers import amplify
from .constraint import FACTOR, GAIN, LAST, POWER, ConstraintState, commit_constraint, preview_constraint
from .delay_lines import newest, push
from .kernels import FAST, correct_weights, dot
from .loop import DIVERGED, REFUSED, RUNNING, squares_are_finite

GROUP = 8  # scenarios that take turns: their weights stay in the first cache
# Rows of what is recorded.
KEPT_ERROR, KEPT_CONTROL, KEPT_AMPLIFIED, KEPT_ANTI_NOISE, KEPT_FACTOR, KEPT_POWER, KEPT_GAIN = range(7)
SAFE = 1e290  # a correction below does not overflow weights that are finite


class SharedBlock(NamedTuple):
    """What all scenarios have in common in a block of m samples."""

    references: np.ndarray  # (m, n or more) rows x(k), newest sample first
    rows: np.ndarray  # (m, n or more) rows x'(k)
    directions: np.ndarray  # (m, n or more) g_k = S_k K_k
    largest: np.ndarray  # (m,) largest magnitude in g_k
    variances: np.ndarray  # (m,) S_k
    secondary_estimate: np.ndarray  # taps of s^


class Scenarios(NamedTuple):
    """N scenarios, the first dimension of each array."""

    weights: np.ndarray  # (N, n or more), zero past n
    output: np.ndarray  # delay lines of y through the amplifier model
    model: np.ndarray  # (N, 3) amplifier known to the disturbance estimate
    emitted: np.ndarray  # delay lines of y after the amplifier
    amplifier: np.ndarray  # (N, 3)
    secondary: np.ndarray  # (N, taps) true secondary paths
    table: np.ndarray  # (N, 6, 3) constraints
    window: np.ndarray  # (N, 3, k)
    last: np.ndarray  # (N, 3) disturbance estimate, residual (h'w until it is known) and S of the last update
    limit: np.ndarray  # (N,) control signal that counts as divergence
    done: np.ndarray  # (N,) samples done
    status: np.ndarray  # (N,) RUNNING, DIVERGED or REFUSED


@compiled(nogil=True)
def run_block(scenarios, shared, disturbance, sensor_noise, recorded, first, count):
    """The first `count` samples of a block for all scenarios, from sample `first` of the run on.

    `disturbance` (N or 1, n_samples), `sensor_noise` (N, m), `recorded` (N, 5 or 7, n_samples).
    """
    scenarios, shared, recorded = borrowed(scenarios), borrowed(shared), borrowed(recorded)
    disturbance, sensor_noise = borrowed(disturbance), borrowed(sensor_noise)
    for begin in range(0, len(scenarios.status), GROUP):
        end = min(begin + GROUP, len(scenarios.status))
        for k in range(count):
            emit(scenarios, shared, recorded, begin, end, k, first + k)
            for i in range(begin, end):
                d = disturbance[i if len(disturbance) > 1 else 0, first + k]
                receive(scenarios, recorded, d, sensor_noise[i, k], i, first + k)
            correct(scenarios, shared, recorded, begin, end, k, first + k)


@part(forceinline=True)
def emit(scenarios, shared, recorded, begin, end, k, n):
    """y(n) = w(n-1)' x(n), through the amplifiers; a scenario whose y passes its limit has diverged."""
    x, h = shared.references[k], shared.rows[k]
    for i in range(begin, end):
        y, scenarios.last[i, 1] = two_dots(scenarios.weights[i], x, h)
        if scenarios.status[i] == RUNNING and not abs(y) <= scenarios.limit[i]:
            scenarios.status[i] = DIVERGED
        model, amplifier = scenarios.model[i], scenarios.amplifier[i]
        push(scenarios.output[i], amplify(model[0], model[1], model[2], y))
        y_amplified = amplify(amplifier[0], amplifier[1], amplifier[2], y)
        push(scenarios.emitted[i], y_amplified)
        recorded[i, KEPT_CONTROL, n], recorded[i, KEPT_AMPLIFIED, n] = y, y_amplified


@part(fastmath=FAST, forceinline=True)
def two_dots(w, x, h):
    """w'x and w'h in one pass."""
    wx = wh = 0.0
    for i in range(w.size):
        wx += w[i] * x[i]
        wh += w[i] * h[i]
    return wx, wh


@part(forceinline=True)
def receive(scenarios, recorded, d, noise, i, n):
    """e = d - s * y_amp, and the sensor's noise."""
    a = dot(scenarios.secondary[i], newest(scenarios.emitted[i], scenarios.secondary.shape[1]))
    recorded[i, KEPT_ANTI_NOISE, n], recorded[i, KEPT_ERROR, n] = a, d - a + noise


@part(forceinline=True)
def correct(scenarios, shared, recorded, begin, end, k, n):
    """Eq. 5, 9-13 for the scenarios that run, as `loop.adapt_kalman`."""
    x, h = shared.references[k, 0], shared.rows[k, 0]
    g, S, taps = shared.directions[k], shared.variances[k], shared.secondary_estimate.size
    for i in range(begin, end):
        if scenarios.status[i] != RUNNING:
            continue
        constraint = ConstraintState(scenarios.table[i], scenarios.window[i])
        d = recorded[i, KEPT_ERROR, n] + dot(shared.secondary_estimate, newest(scenarios.output[i], taps))
        previewed = preview_constraint(constraint, d, h, x)
        y = previewed[0] * d - scenarios.last[i, 1]
        if not (squares_are_finite(d, h, x) and abs(y / S) * shared.largest[k] < SAFE):
            scenarios.status[i] = REFUSED
            continue
        correct_weights(scenarios.weights[i], g, y / S)
        commit_constraint(constraint, previewed, d, h, x)
        scenarios.last[i, 0], scenarios.last[i, 1], scenarios.last[i, 2] = d, y, S
        used = constraint.table[LAST]
        recorded[i, KEPT_FACTOR, n] = used[FACTOR]
        if recorded.shape[1] > KEPT_POWER:
            recorded[i, KEPT_POWER, n], recorded[i, KEPT_GAIN, n] = used[POWER], used[GAIN]
        scenarios.done[i] += 1
