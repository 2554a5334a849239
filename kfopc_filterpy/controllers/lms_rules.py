"""What the filtered-reference LMS family adds to the control filter at a sample, one rule an algorithm.

All are of one form,

.. math:: w(n+1) = k\\, w(n) + c\\, x'(n) - p\\, x(n)

with numbers `keep` k, `correction` c and `penalty` p that `lms_change` gives; an amplitude limit acts on the control
signal itself, in `hold_amplitude`.
"""

from __future__ import annotations

import numpy as np

from ..kernels.compiling import part
from ..kernels.covariance import FAST, dot
from ..kernels.delay_lines import newest
from ..power.constraint import GAIN, LAST, MEAN, REFERENCE

# Rules. From TWO_GRADIENT on they have an amplitude limit, from RESCALING on they hold the control signal to it.
PLAIN, NORMALISED, LEAK, RATED_LEAK, PENALTY, RATED_PENALTY, TWO_GRADIENT, RESCALING, CLIPPING = range(9)
STEP_SIZE, RULE, FACTOR, LIMIT, MODIFIED = range(5)  # settings of an LMS controller
MEASUREMENT_NOISE, STATE_NOISE = (
    STEP_SIZE,
    FACTOR,
)  # of the diagonal Kalman filter, which is LMS with a step for each tap


def further_rules(settings: np.ndarray) -> np.ndarray | None:
    """The settings as `lms_change` takes them: None where FxLMS's and MOV-FxLMS's own step is all there is to do."""
    plain = settings[RULE] in (PLAIN, RATED_PENALTY) and not settings[MODIFIED]
    return None if plain else settings


def lms_settings(rule: int, step_size: float, *, factor: float = 0.0, limit: float = np.inf) -> list[float]:
    """Settings of a rule.

    `factor` is the regularisation, the leak, the penalty factor or the step size of the second gradient, of the rules
    that have one. MODIFIED, which MOV-FxLMS sets, replaces the error by the disturbance estimate less ``w' x'``.
    """
    return [step_size, rule, factor, limit, 0.0]


@part(forceinline=True)
def penalty_of_budget(constraint, factor):
    """gamma = G_s (1/alpha - 1): zero where the rated power is enough.

    While nothing has come through the estimated path, G_s = 0 and gamma = sqrt(G_s delta_d^2 / rho_o) - G_s is 0 too.
    """
    gain = constraint.table[LAST, GAIN]
    return gain * (1.0 / factor - 1.0) if factor < 1.0 and gain > 0.0 else 0.0


@part(forceinline=True)
def lms_change(rules, controller, disturbance, error, y, factor):
    """k, c and p of this sample; `factor` is the constraint factor, `y` the control signal that was emitted.

    `rules` are the settings of an algorithm beyond FxLMS and MOV-FxLMS, None for those two: they are what most runs need,
    and the rest is another type to the compiler, made when it is first used. (FxLMS is MOV-FxLMS with a factor of 1.)
    """
    if rules is None:
        mu = controller.settings[STEP_SIZE]
        return 1.0, mu * error, mu * penalty_of_budget(controller.constraint, factor) * y
    return further_change(rules, controller, disturbance, error, y, factor)


@part(forceinline=True)
def further_change(rules, controller, disturbance, error, y, factor):
    """`lms_change` of the other algorithms."""
    mu, rule, second, w = rules[STEP_SIZE], rules[RULE], rules[FACTOR], controller.weights
    if rules[MODIFIED] != 0.0:
        error = disturbance - dot(w, newest(controller.filtered, w.size))
    if rule == NORMALISED:
        xf = newest(controller.filtered, w.size)
        return 1.0, mu * error / (second + dot(xf, xf)), 0.0
    if rule == LEAK:
        return 1.0 - mu * second, mu * error, 0.0
    if rule == RATED_LEAK:
        gamma = penalty_of_budget(controller.constraint, factor) * controller.constraint.table[MEAN, REFERENCE]
        return 1.0 - mu * gamma, mu * error, 0.0
    if rule == PENALTY:
        return 1.0, mu * error, mu * second * y
    if rule == RATED_PENALTY:
        return 1.0, mu * error, mu * penalty_of_budget(controller.constraint, factor) * y
    if rule == TWO_GRADIENT and abs(y) > rules[LIMIT]:
        return 1.0, 0.0, second * y
    return 1.0, mu * error, 0.0


@part(fastmath=FAST, forceinline=True)
def change_weights(w, x, xf, keep, correction, penalty):
    """w = k w + c x' - p x."""
    for i in range(w.size):
        w[i] = keep * w[i] + correction * xf[i] - penalty * x[i]


@part(fastmath=FAST, forceinline=True)
def correct_diagonal(variances, w, xf, d, settings):
    """Eq. 3-8 with P = diag(p): p += r, S = sum p x'^2 + q, K = p x' / S, w += K (d - w'x'), p -= K x' p.

    False for a controller that has no variances.
    """
    if variances is None:
        return False
    r, S, residual = settings[STATE_NOISE], settings[MEASUREMENT_NOISE], d
    for i in range(w.size):
        variances[i] += r
        S += variances[i] * xf[i] * xf[i]
        residual -= w[i] * xf[i]
    if S > 0.0:  # q = 0 and a silent reference tell nothing
        for i in range(w.size):
            gain = variances[i] * xf[i] / S
            w[i] += gain * residual
            variances[i] *= max(1.0 - gain * xf[i], 0.0)  # rounding of S may put the share above 1
    return True


@part(forceinline=True)
def hold_amplitude(rules, w, y):
    """y held to its limit, by the rules that hold it; re-scaling takes the weights along."""
    if rules is None:
        return y
    if rules[RULE] < RESCALING or not rules[LIMIT] < abs(y) < np.inf:  # Inf and NaN: the loop sees a divergence
        return y
    if rules[RULE] == RESCALING:
        ratio = rules[LIMIT] / abs(y)
        for i in range(w.size):
            w[i] *= ratio
    return rules[LIMIT] if y > 0.0 else -rules[LIMIT]
