"""The compiled sample: what a controller and the plant do at one n, and the loop over a whole signal.

Sample-by-sample use (`controllers`, `simulation`) calls the same functions one at a time, so each equation stands
here once.

Small functions are inlined by force: called, each would be handed every array of a controller over again, which for a
short control filter takes longer than the arithmetic.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..controllers.array_steps import FastArrayState, correct_fast_array, fast_array_holds
from ..controllers.lms_rules import change_weights, correct_diagonal, hold_amplitude, lms_change
from ..controllers.repairs import RepairState, advance_repair, gain_samples, measurement_factor, output_gain
from ..kernels.block import leave_block, project_in_block, update_in_block
from ..kernels.compiling import compiled, part
from ..kernels.covariance import (
    CANCELLATION,
    DIAGONAL,
    INVERSE_S,
    SCALE,
    Covariance,
    copy_into,
    dot,
    predict_covariance,
    project_covariance,
    update_weights,
)
from ..kernels.delay_lines import latest, newest, push
from ..power.amplifiers import amplify
from ..power.budget import WEIGHT, BudgetState, advance_budget, take_correlations
from ..power.constraint import (
    FACTOR,
    GAIN,
    LAST,
    POWER,
    ConstraintState,
    advance_constraint,
    commit_constraint,
    preview_constraint,
)
from ..power.limiter import LimiterState, limit_sample

KALMAN, LMS, LISTENING = 0, 1, 2  # what a controller does with an error
STEP = 16000  # samples between two reports of progress, or chances to interrupt a run
RUNNING, DIVERGED, REFUSED = 0, 1, 2


class ControllerState(NamedTuple):
    """What every controller here keeps."""

    kind: int  # KALMAN or LMS; LISTENING, with zero weights, while the loudspeaker is silent
    weights: np.ndarray  # (L,) what is adapted, w
    control_filter: np.ndarray  # (L,) what makes y: the weights themselves, but for a power budget
    secondary_estimate: np.ndarray  # taps of s^
    reference: np.ndarray  # delay line of x
    filtered: np.ndarray  # delay line of x' = s^ * x
    output: np.ndarray  # delay line of y, through the amplifier model where one is known
    amplifier: np.ndarray  # (3,) parameters of that model; linear: d^ = e + s^ * y as published
    settings: np.ndarray  # Kalman: r, q, fading alpha squared; LMS: those of `lms_rules`
    covariance: Covariance  # Kalman
    constraint: ConstraintState  # powers, gain, factor
    last: np.ndarray  # (3,) disturbance estimate, residual and S of the last Kalman update; NaN: none in this run
    budget: BudgetState | None = None  # of a power-budgeted filter
    repair: RepairState | None = None  # of KF-OPC with its gain repaired
    limiter: LimiterState | None = None
    rules: np.ndarray | None = None  # the settings again, of LMS algorithms beyond FxLMS and MOV-FxLMS
    variances: np.ndarray | None = None  # (L,) of the weights, of a diagonal Kalman filter
    fast_array: FastArrayState | None = None


@part(forceinline=True)
def take_reference(controller, x):
    """x(n) into its delay line, and x'(n) = (s^ * x)(n) into the filtered one."""
    push(controller.reference, x)
    s = controller.secondary_estimate
    push(controller.filtered, dot(s, newest(controller.reference, s.size)))


@part(forceinline=True)
def control_signal(controller, x):
    """y(n) = w(n-1)' x(n), limited where there is a limiter, with the filtered reference brought up to date."""
    take_reference(controller, x)
    w = controller.control_filter
    y = output_gain(controller.repair) * dot(w, newest(controller.reference, w.size))
    y = hold_amplitude(controller.rules, w, y)
    y = limited(controller.limiter, y)
    model = controller.amplifier
    push(controller.output, amplify(model[0], model[1], model[2], y))
    return y


@part(forceinline=True)
def limited(limiter, y):
    """y after the limiter, if there is one."""
    if limiter is None:
        return y
    return limit_sample(limiter, y)


@part(forceinline=True)
def disturbance_estimate(controller, error):
    """d^(n) = e(n) + (s^ * y)(n)."""
    s = controller.secondary_estimate
    return error + dot(s, newest(controller.output, s.size))


@part(forceinline=True)
def adapt_kalman(controller, error, y_emitted, block):
    """Eq. 2-9 with the factor of eq. 10-13; False, with nothing changed, where the estimator would refuse the step.

    `y_emitted` is the control signal of the sample; `block` is None, or open for the samples to come (see `block`).
    """
    d = disturbance_estimate(controller, error)
    w, x = controller.weights, latest(controller.reference)
    h = newest(controller.filtered, w.size)
    if not squares_are_finite(d, h[0], x):
        return False
    seen = gain_samples(controller.repair, h[0], x, error, d, y_emitted)
    previewed = preview_constraint(controller.constraint, d, seen[0], seen[1])
    scaled = measurement_factor(controller.repair, previewed[0]) * d
    r, q, alpha_sq = controller.settings[0], controller.settings[1], controller.settings[2]
    cov = controller.covariance
    S, y = np.nan, np.nan
    if block is not None and block.taken[1] > 0:
        projected, before = project_in_block(cov, block, h, r)
        S = projected + q
        if S > 0.0 and before + q <= CANCELLATION * q:
            y = update_in_block(cov, block, w, h, scaled, S)
            if not np.isfinite(y):
                return False
        else:
            leave_block(cov, block, r)
    if np.isnan(y):
        scale, diagonal, inverse_S = cov.owed[SCALE], cov.owed[DIAGONAL], cov.owed[INVERSE_S]
        predict_covariance(cov, alpha_sq, r)
        S = project_covariance(cov, h) + q
        if 0.0 < S < np.inf:
            y = update_weights(cov, w, h, scaled, S, q)
        if not np.isfinite(y):
            take_back(cov, scale, diagonal, inverse_S, alpha_sq, r)
            return False
    commit_constraint(controller.constraint, previewed, d, seen[0], seen[1])
    advance_repair(controller.repair, controller.constraint, y_emitted)
    spend(controller.budget, w, x, h[0], y_emitted)
    controller.last[0], controller.last[1], controller.last[2] = d, y, S
    return True


@part(forceinline=True)
def spend(budget, w, x, filtered, y):
    """Let the power budget, if there is one, follow the sample."""
    if budget is not None:
        advance_budget(budget, w, x, filtered, y)


@part(forceinline=True)
def hear(budget, x, filtered):
    """Let the power budget, if there is one, follow the signals only."""
    if budget is not None:
        take_correlations(budget, x, filtered)


@part(forceinline=True)
def squares_are_finite(d, filtered, x):
    """Whether the running powers can take this sample: an infinite power would never be forgotten."""
    return np.isfinite(d * d) and np.isfinite(filtered * filtered) and np.isfinite(x * x)


@part()
def take_back(cov, scale, diagonal, inverse_S, alpha_sq, r):
    """Undo, to rounding, the prediction and projection of a step that cannot be completed."""
    T, g = cov.triangle, cov.gain_direction
    for i in range(g.size):
        T[i, i] -= alpha_sq * diagonal + r
        for j in range(i + 1):
            T[i, j] = T[i, j] / (alpha_sq * scale) + inverse_S * g[i] * g[j]
    cov.owed[SCALE], cov.owed[DIAGONAL], cov.owed[INVERSE_S] = scale, diagonal, inverse_S


@part(forceinline=True)
def adapt_lms(controller, error, y):
    """One step of the filtered-reference LMS family (see `lms_rules`); `y` is the control signal that was emitted.

    False, with nothing changed, where the controller cannot go on.
    """
    if not fast_array_holds(controller.fast_array, newest(controller.filtered, controller.weights.size + 1)):
        return False
    d = disturbance_estimate(controller, error)
    w = controller.weights
    xf, x = newest(controller.filtered, w.size), newest(controller.reference, w.size)
    if not squares_are_finite(d, xf[0], x[0]):
        return False
    factor = advance_constraint(controller.constraint, d, xf[0], x[0])
    if correct_diagonal(controller.variances, w, xf, factor * d, controller.settings):
        return True
    if correct_fast_array(controller.fast_array, w, newest(controller.filtered, w.size + 1), factor * d):
        return True
    keep, correction, penalty = lms_change(controller.rules, controller, d, error, y, factor)
    change_weights(w, x, xf, keep, correction, penalty)
    return True


@part(forceinline=True)
def follow(controller, error):
    """Take the sample into the powers only."""
    d, filtered, x = disturbance_estimate(controller, error), latest(controller.filtered), latest(controller.reference)
    advance_constraint(controller.constraint, d, filtered, x)
    hear(controller.budget, x, filtered)


class Plant(NamedTuple):
    """The true amplifier and paths."""

    secondary: np.ndarray  # taps of s
    feedback: np.ndarray  # taps from the amplifier to the reference microphone; size 0: none
    output: np.ndarray  # delay line of y after the amplifier
    amplifier: np.ndarray  # (3,)


@part(forceinline=True)
def measured_reference(plant, x):
    """Reference microphone: the noise, and what comes back from the loudspeaker (one sample late at the least)."""
    taps = plant.feedback.size
    return x if taps < 2 else x + dot(plant.feedback[1:], newest(plant.output, taps - 1))


@part(forceinline=True)
def anti_noise(plant, y_amplified):
    """(s * y_amp)(n)."""
    push(plant.output, y_amplified)
    return dot(plant.secondary, newest(plant.output, plant.secondary.size))


# Rows of a stretch of signals: what goes in, and what the loop leaves.
(
    REFERENCE_IN,
    DISTURBANCE_IN,
    SENSOR_NOISE,
    ERROR,
    CONTROL,
    AMPLIFIED,
    ANTI_NOISE,
    USED_FACTOR,
    USED_POWER,
    USED_GAIN,
    USED_WEIGHT,
) = range(11)
ROWS = 11


@part(forceinline=True)
def note_weights(rows, weights, every, n):
    """Keep the weights of sample n where it is one of the recorded; without rows none is."""
    if rows.shape[0] > 0 and n % every == 0:
        copy_into(rows[n // every], weights)


@part(forceinline=True)
def note_power_weight(budget, signals, k):
    """Keep the lambda of a power budget."""
    if budget is not None:
        signals[USED_WEIGHT, k] = budget.table[WEIGHT]


@compiled(nogil=True)
def run(controller, block, plant, signals, weights, limit, every, first, begin, end):
    """Columns `begin` to `end` of a stretch of signals (ROWS, k), whose first is sample `first` of the run.

    Returns the status and the column after the last one done.
    """
    model = plant.amplifier
    for k in range(begin, end):
        y = control_signal(controller, measured_reference(plant, signals[REFERENCE_IN, k]))
        if not abs(y) <= limit:
            return DIVERGED, k
        y_amplified = amplify(model[0], model[1], model[2], y)
        a = anti_noise(plant, y_amplified)
        e = signals[DISTURBANCE_IN, k] - a + signals[SENSOR_NOISE, k]
        signals[ERROR, k], signals[CONTROL, k] = e, y
        if controller.kind == LMS:
            if not adapt_lms(controller, e, y):
                return REFUSED, k
        elif controller.kind == LISTENING:
            follow(controller, e)
        elif not adapt_kalman(controller, e, y, block):
            return REFUSED, k
        signals[AMPLIFIED, k], signals[ANTI_NOISE, k] = y_amplified, a
        used = controller.constraint.table[LAST]
        signals[USED_FACTOR, k], signals[USED_POWER, k], signals[USED_GAIN, k] = used[FACTOR], used[POWER], used[GAIN]
        note_power_weight(controller.budget, signals, k)
        note_weights(weights, controller.control_filter, every, first + k)
    return RUNNING, end
