"""Common parts of the filtered-reference LMS algorithms."""

from __future__ import annotations

from ..kernels.compiling import inlined, part
from ..kernels.delay_lines import latest, newest
from ..kernels.vectors import FAST
from ..power.constraint import advance_constraint, squares_are_finite
from .base import FilteredReferenceController
from .step import disturbance_estimate


class LMSController(FilteredReferenceController):
    """A filtered-reference controller whose state has a `step_size`."""

    @property
    def step_size(self) -> float:
        """Step size mu."""
        return self._state.step_size


@inlined
def advance_powers(state, error):
    """Add a sample to the running powers; return whether the squares are finite, d^(n) and the constraint factor.

    If they are not finite, nothing was changed.
    """
    d = disturbance_estimate(state.lines, error)
    filtered, x = latest(state.lines.filtered), latest(state.lines.reference)
    if not squares_are_finite(d, filtered, x):
        return False, d, 1.0
    return True, d, advance_constraint(state.constraint, d, filtered, x)


@inlined
def change_weights(w, lines, keep, correction, penalty):
    """Set w(n+1) = keep w(n) + correction x'(n) - penalty x(n)."""
    _change(w, newest(lines.filtered, w.size), newest(lines.reference, w.size), keep, correction, penalty)


@part(fastmath=FAST)
def _change(w, filtered, x, keep, correction, penalty):
    for i in range(w.size):
        w[i] = keep * w[i] + correction * filtered[i] - penalty * x[i]


@part()
def penalty_of_constraint(constraint, factor):
    """Return gamma = G_s (1/alpha - 1): zero if the rated power is enough.

    Until a signal has passed the estimated path, G_s = 0 and gamma = sqrt(G_s delta_d^2 / rho_o) - G_s is 0 too.
    """
    gain = constraint.numbers[0].gain
    return gain * (1.0 / factor - 1.0) if factor < 1.0 and gain > 0.0 else 0.0
