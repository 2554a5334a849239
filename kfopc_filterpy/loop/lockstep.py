"""Many scenarios of the loop side by side, with the gains of one filter: those depend on the reference alone.

What each scenario does is what `loop.run` does with a Kalman controller. What it keeps, but for the weights, lies in
lanes: `LANES` scenarios side by side, so that one instruction serves eight of them. A group's lanes are one array, row
after row of a constant length: so the compiler sees that rows do not overlap, and needs no test of it at run time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..kernels.compiling import compiled, part
from ..kernels.covariance import FAST, aligned_zeros, copy_into, correct_weights
from ..kernels.delay_lines import newest
from ..power.amplifiers import amplify
from ..power.constraint import (
    FORGETTING,
    LAST,
    MEAN,
    RATED_POWER,
    SETTINGS,
    SUPPLIED,
    TAKEN,
    ConstraintState,
    advance_constraint,
    constraint_factor,
    forgetting_mean,
    power_gain,
    preview_constraint,
)
from .run import DIVERGED, REFUSED, RUNNING, ControllerState, squares_are_finite

LANES = 32  # scenarios of a group
FOUR = 4  # taps of a path that go together
# Rows of what is recorded.
KEPT_ERROR, KEPT_CONTROL, KEPT_AMPLIFIED, KEPT_ANTI_NOISE, KEPT_FACTOR, KEPT_POWER, KEPT_GAIN = range(7)
SAFE = 1e290  # a correction below does not overflow weights that are finite

# Where the rows of the lanes begin, three that belong together in consecutive rows; numpy's integers, since numba
# compiles a function anew for each plain one.
(
    STATUS,  # RUNNING, DIVERGED or REFUSED
    DONE,  # samples done
    LIMIT,  # control signal that counts as divergence
    CONTROL,  # y = w'x
    PREDICTED,  # w'x'
    ANTI_NOISE,
    NOISE,  # of the sensor
    ERROR,
    ESTIMATE,  # d^
    OWED,  # innovation / S by which the weights have still to be corrected
    GOES_ON,  # 1 where the sample is taken, 0 elsewhere
    *NEXT,  # factor, disturbance power, gain and three mean squares with the sample
) = np.arange(17) * LANES
LAST_UPDATE, AMPLIFIER, MODEL, TABLE = np.array((17, 20, 23, 26)) * LANES
# disturbance estimate, residual and S of the last update; the parameters of the amplifier, and of the one known to the
# disturbance estimate; the constraint's table
ROWS = 26 + 18
NEXT_FACTOR, NEXT_POWER, NEXT_GAIN, NEXT_D, NEXT_H, NEXT_X = NEXT
LAST_ESTIMATE, LAST_RESIDUAL, LAST_VARIANCE = LAST_UPDATE + np.arange(3) * LANES
_TABLE = TABLE + np.arange(18).reshape(6, 3) * LANES
MEAN_D, MEAN_H, MEAN_X = _TABLE[MEAN]
TAKEN_D, TAKEN_H, TAKEN_X = _TABLE[TAKEN]
SUPPLIED_FACTOR, SUPPLIED_POWER, SUPPLIED_GAIN = _TABLE[SUPPLIED]
LAST_FACTOR, LAST_POWER, LAST_GAIN = _TABLE[LAST]
RATED, RATE = _TABLE[SETTINGS, RATED_POWER], _TABLE[SETTINGS, FORGETTING]


class SharedBlock(NamedTuple):
    """What all scenarios have in common in a block of m samples."""

    references: np.ndarray  # (m, n or more) rows x(k), newest sample first
    rows: np.ndarray  # (m, n or more) rows x'(k)
    directions: np.ndarray  # (m, n or more) g_k = S_k K_k
    norms: np.ndarray  # (m,) of g_k, which no magnitude in it exceeds
    variances: np.ndarray  # (m,) S_k


class Scenarios(NamedTuple):
    """N scenarios in groups of lanes; past N there are silent ones."""

    weights: np.ndarray  # (N or more, n or more), zero past N and n
    lanes: np.ndarray  # (groups, ROWS LANES)
    table: np.ndarray | None  # (N, 6, 3) and (N, 3, k), constraints of sliding windows; None where they forget: then
    window: np.ndarray | None  # they are in the lanes
    output: np.ndarray  # (groups, taps + block, LANES) y through the amplifier model, oldest first: the past, the block
    emitted: np.ndarray  # the same of y after the amplifier
    secondary_estimate: np.ndarray  # (groups, taps, LANES) s^, last tap first, in fours
    secondary: np.ndarray  # (groups, taps, LANES) true paths


@compiled(nogil=True)
def run_block(scenarios, shared, disturbance, sensor_noise, recorded, first, count):
    """The first `count` samples of a block for all scenarios, from sample `first` of the run on.

    `disturbance` (N or 1, n_samples), `sensor_noise` (N or 1, m), `recorded` (N, 5 or 7, n_samples).
    """
    taps, true_taps = scenarios.secondary_estimate.shape[1], scenarios.secondary.shape[1]
    for group in range(len(scenarios.lanes)):
        lanes, output, emitted = scenarios.lanes[group], scenarios.output[group], scenarios.emitted[group]
        begin, end = group * LANES, min((group + 1) * LANES, len(recorded))
        for k in range(count):
            emit(scenarios.weights, lanes, shared, begin, end, k)
            through_amplifiers(lanes, output[taps + k], MODEL)
            through_amplifiers(lanes, emitted[true_taps + k], AMPLIFIER)
            convolve(scenarios.secondary[group], emitted, lanes, ANTI_NOISE, k + 1)
            convolve(scenarios.secondary_estimate[group], output, lanes, ESTIMATE, k + 1)
            receive(lanes, disturbance, sensor_noise, begin, end, first + k, k)
            adapt(lanes, scenarios.table, scenarios.window, shared, begin, end, k)
            record(recorded, lanes, emitted[true_taps + k], begin, end, first + k)
        for i in range(begin, end):
            correct_weights(scenarios.weights[i], shared.directions[count - 1], lanes[OWED + i - begin])
        for i in range(LANES):
            lanes[OWED + i] = 0.0
        for k in range(taps):
            copy_into(output[k], output[count + k])
        for k in range(true_taps):
            copy_into(emitted[k], emitted[count + k])


@part(forceinline=True)
def emit(weights, lanes, shared, begin, end, k):
    """Eq. 5 of the sample before, y(n) = w(n-1)' x(n) and w(n-1)' x'(n), in one pass over the weights."""
    g, x, h = shared.directions[max(k - 1, 0)], shared.references[k], shared.rows[k]
    for i in range(0, end - begin, 2):
        w, v, a, b = weights[begin + i], weights[begin + i + 1], lanes[OWED + i], lanes[OWED + i + 1]
        wx, wh, vx, vh = correct_two(w, v, a, b, g, x, h)
        lanes[CONTROL + i], lanes[CONTROL + i + 1] = wx, vx
        lanes[PREDICTED + i], lanes[PREDICTED + i + 1] = wh, vh
    for i in range(LANES):
        if lanes[STATUS + i] == RUNNING and not abs(lanes[CONTROL + i]) <= lanes[LIMIT + i]:
            lanes[STATUS + i] = DIVERGED


@part(fastmath=FAST, forceinline=True, disjoint=True)
def correct_two(w, v, a, b, g, x, h):
    """w += a g and v += b g; returns w'x, w'h, v'x, v'h. Each load of g, x and h serves two scenarios."""
    wx = wh = vx = vh = 0.0
    for j in range(w.size):
        p, q = w[j] + a * g[j], v[j] + b * g[j]
        w[j], v[j] = p, q
        wx += p * x[j]
        wh += p * h[j]
        vx += q * x[j]
        vh += q * h[j]
    return wx, wh, vx, vh


@part(forceinline=True)
def through_amplifiers(lanes, out, parameters):
    """y(n) through the amplifiers whose three rows of parameters begin there."""
    for i in range(LANES):
        p = parameters + i
        out[i] = amplify(lanes[p], lanes[p + LANES], lanes[p + 2 * LANES], lanes[CONTROL + i])


@part(forceinline=True)
def convolve(path, line, lanes, row, first):
    """A row of (s * y)(n), where the oldest sample of y that counts is in row `first` of its line."""
    for i in range(LANES):
        lanes[row + i] = 0.0
    for j in range(0, len(path), FOUR):
        k = first + j
        s0, s1, s2, s3 = path[j], path[j + 1], path[j + 2], path[j + 3]
        add_four_taps(lanes, row, s0, s1, s2, s3, line[k], line[k + 1], line[k + 2], line[k + 3])


@part(fastmath=FAST, forceinline=True, disjoint=True)
def add_four_taps(lanes, row, s0, s1, s2, s3, y0, y1, y2, y3):
    """Four taps go together, or each sum would wait for the one before to come out of memory."""
    for i in range(LANES):
        lanes[row + i] += s0[i] * y0[i] + s1[i] * y1[i] + s2[i] * y2[i] + s3[i] * y3[i]


@part(forceinline=True)
def receive(lanes, disturbance, sensor_noise, begin, end, n, k):
    """e = d - s * y_amp, and the sensor's noise; d^ = e + s^ * y, to which ESTIMATE has the second part."""
    for i in range(begin, end):
        lanes[ERROR + i - begin] = disturbance[i if len(disturbance) > 1 else 0, n]
        lanes[NOISE + i - begin] = sensor_noise[i if len(sensor_noise) > 1 else 0, k]
    for i in range(LANES):
        lanes[ERROR + i] = lanes[ERROR + i] - lanes[ANTI_NOISE + i] + lanes[NOISE + i]
        lanes[ESTIMATE + i] += lanes[ERROR + i]


@part(forceinline=True)
def adapt(lanes, table, window, shared, begin, end, k):
    """Eq. 9-13 for the scenarios that run, as `loop.adapt_kalman`; their weights are corrected in the next pass."""
    x, h, S, norm = shared.references[k, 0], shared.rows[k, 0], shared.variances[k], shared.norms[k]
    if window is None:
        preview_lanes(lanes, h, x)
        decide(lanes, h, x, S, norm)
        commit_lanes(lanes)
    else:
        for i in range(end - begin):
            constraint = ConstraintState(table[begin + i], window[begin + i])
            lanes[NEXT_FACTOR + i] = preview_constraint(constraint, lanes[ESTIMATE + i], h, x)[0]
        decide(lanes, h, x, S, norm)
        for i in range(end - begin):
            if lanes[GOES_ON + i] > 0.0:
                constraint = ConstraintState(table[begin + i], window[begin + i])
                advance_constraint(constraint, lanes[ESTIMATE + i], h, x)
                for j in range(3):
                    lanes[LAST_FACTOR + j * LANES + i] = constraint.table[LAST, j]


@part(forceinline=True)
def preview_lanes(lanes, h, x):
    """`preview_constraint` of powers of exponential memory, without branches: eight scenarios at once."""
    for i in range(LANES):
        d, rate = lanes[ESTIMATE + i], lanes[RATE + i]
        mean_d = forgetting_mean(lanes[MEAN_D + i], lanes[TAKEN_D + i], rate, d * d)
        mean_h = forgetting_mean(lanes[MEAN_H + i], lanes[TAKEN_H + i], rate, h * h)
        mean_x = forgetting_mean(lanes[MEAN_X + i], lanes[TAKEN_X + i], rate, x * x)
        gain = power_gain(lanes[SUPPLIED_GAIN + i], lanes[LAST_GAIN + i], mean_h, mean_x)
        power = mean_d if np.isnan(lanes[SUPPLIED_POWER + i]) else lanes[SUPPLIED_POWER + i]
        lanes[NEXT_FACTOR + i] = constraint_factor(lanes[SUPPLIED_FACTOR + i], lanes[RATED + i], power, gain)
        lanes[NEXT_POWER + i], lanes[NEXT_GAIN + i] = power, gain
        lanes[NEXT_D + i], lanes[NEXT_H + i], lanes[NEXT_X + i] = mean_d, mean_h, mean_x


@part(forceinline=True)
def decide(lanes, h, x, S, norm):
    """Which scenarios run and can take the sample, what their weights are owed, and what is kept of it."""
    for i in range(LANES):
        d = lanes[ESTIMATE + i]
        y = lanes[NEXT_FACTOR + i] * d - lanes[PREDICTED + i]
        step = y / S
        running = lanes[STATUS + i] == RUNNING
        safe = squares_are_finite(d, h, x) and abs(step) * norm < SAFE
        if running and not safe:
            lanes[STATUS + i] = REFUSED
        on = running and safe
        lanes[OWED + i] = step if on else 0.0
        lanes[GOES_ON + i] = 1.0 if on else 0.0
        lanes[DONE + i] += lanes[GOES_ON + i]
        if on:
            lanes[LAST_ESTIMATE + i], lanes[LAST_RESIDUAL + i], lanes[LAST_VARIANCE + i] = d, y, S


@part(forceinline=True)
def commit_lanes(lanes):
    """`commit_constraint` of what `preview_lanes` found, where the scenario goes on."""
    for row in range(0, 3 * LANES, LANES):  # three each of means, samples taken, and what was last used
        for i in range(row, row + LANES):
            if lanes[GOES_ON - row + i] > 0.0:
                lanes[MEAN_D + i] = lanes[NEXT_D + i]
                lanes[TAKEN_D + i] += 1.0
                lanes[LAST_FACTOR + i] = lanes[NEXT_FACTOR + i]


@part(forceinline=True)
def record(recorded, lanes, amplified, begin, end, n):
    """Keep sample n of each signal."""
    for i in range(begin, end):
        lane = i - begin
        recorded[i, KEPT_ERROR, n], recorded[i, KEPT_CONTROL, n] = lanes[ERROR + lane], lanes[CONTROL + lane]
        recorded[i, KEPT_AMPLIFIED, n], recorded[i, KEPT_ANTI_NOISE, n] = amplified[lane], lanes[ANTI_NOISE + lane]
        recorded[i, KEPT_FACTOR, n] = lanes[LAST_FACTOR + lane]
        if recorded.shape[1] > KEPT_POWER:
            recorded[i, KEPT_POWER, n] = lanes[LAST_POWER + lane]
            recorded[i, KEPT_GAIN, n] = lanes[LAST_GAIN + lane]


def stacked(
    states: list[ControllerState], paths: np.ndarray, amplifiers: np.ndarray, limits: np.ndarray, block: int
) -> Scenarios:
    """Scenarios of controllers: true paths (N, taps), amplifiers (N, 3), limits (N,), samples in a block at most."""
    s, n, count = states[0].secondary_estimate, states[0].weights.size, len(states)
    tables, windows = (np.array(arrays) for arrays in zip(*[state.constraint for state in states], strict=True))
    lanes = np.zeros((count, ROWS))
    for row, values in (
        (LIMIT, limits[:, None]),
        (AMPLIFIER, amplifiers),
        (MODEL, [state.amplifier for state in states]),
        (LAST_UPDATE, np.full((count, 3), np.nan)),
        (TABLE, tables.reshape(count, -1)),
    ):
        lanes[:, row // LANES : row // LANES + np.shape(values)[1]] = values
    estimate, true = in_fours(np.tile(s, (count, 1))), in_fours(paths)
    output, emitted = np.zeros((count, estimate.shape[1] + block)), np.zeros((count, true.shape[1] + block))
    for line, state in zip(output, states, strict=True):
        line[estimate.shape[1] - s.size : estimate.shape[1]] = newest(state.output, s.size)[::-1]
    stacked_lanes = in_lanes(lanes)
    groups = len(stacked_lanes)
    weights = aligned_zeros(groups * LANES, n)
    for own, state in zip(weights, states, strict=False):
        own[:n] = state.weights
    return Scenarios(
        weights=weights,
        lanes=stacked_lanes.reshape(groups, ROWS * LANES),
        table=tables if windows.size else None,
        window=windows if windows.size else None,
        output=in_lanes(output),
        emitted=in_lanes(emitted),
        secondary_estimate=in_lanes(estimate),
        secondary=in_lanes(true),
    )


def in_fours(paths: np.ndarray) -> np.ndarray:
    """Paths (N, taps), last tap first, behind zeros that make their number one of fours."""
    return np.pad(paths[:, ::-1], ((0, 0), (-paths.shape[1] % FOUR, 0)))


def in_lanes(values: np.ndarray) -> np.ndarray:
    """(N, rows) as (groups, rows, LANES)."""
    count, rows = values.shape
    groups = -(-count // LANES)
    padded = np.zeros((groups * LANES, rows))
    padded[:count] = values
    lanes = aligned_zeros(groups, rows, LANES)
    lanes[:] = padded.reshape(groups, LANES, rows).swapaxes(1, 2)
    return lanes


def of_lanes(scenarios: Scenarios, row: np.integer, rows: int = 1) -> np.ndarray:
    """(N or more, rows) of the lanes from a row on."""
    rows_of = scenarios.lanes.reshape(len(scenarios.lanes), ROWS, LANES)[:, row // LANES : row // LANES + rows]
    return rows_of.swapaxes(1, 2).reshape(-1, rows)
