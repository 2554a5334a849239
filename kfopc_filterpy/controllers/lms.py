"""Common parts of the filtered-reference LMS algorithms."""

from __future__ import annotations

from collections.abc import Sequence

from ..kernels.compiling import by_type, inlined, part
from ..kernels.delay_lines import newest
from ..kernels.vectors import FAST, add_scaled, dot
from ..power.limiter import OutputLimiter
from .base import FilteredReferenceController
from .channels import ChannelLines
from .step import loudspeakers

Limiters = OutputLimiter | Sequence[OutputLimiter] | None


class LMSController(FilteredReferenceController):
    """A filtered-reference controller whose state has a `step_size`."""

    @property
    def step_size(self) -> float:
        """Step size mu."""
        return self._state.step_size

    def _takes_guard(self) -> bool:
        return True


@inlined
def change_weights(lines, weights, keep, mu, error, penalty):
    """Set w(n+1) = keep w(n) + mu e(n) x'(n) - penalty x(n), alike for all loudspeakers."""
    for j in range(loudspeakers(lines)):
        change_filter(lines, weights, j, keep, mu, error, penalty)


@by_type
def change_filter(lines, weights, j, keep, mu, error, penalty):
    """Set w(n+1) = keep w(n) + mu e(n) x'(n) - penalty x(n) for loudspeaker j, with e x' summed over microphones."""
    filtered, x = newest(lines.filtered, weights.size), newest(lines.reference, weights.size)
    leak_guarded(lines.guard, weights, mu)
    change(weights, filtered, x, keep, mu * error, penalty)


@change_filter.register(ChannelLines)
def change_channel(lines, weights, j, keep, mu, error, penalty):
    """Change the weights of loudspeaker j, one reference after the other."""
    taps = weights.shape[2]
    leak_channel_guarded(lines.guard, weights, j, mu)
    for i in range(weights.shape[1]):
        w, x = weights[j, i], newest(lines.reference[i], taps)
        change(w, newest(lines.filtered[0, j, i], taps), x, keep, mu * error[0], penalty)
        for k in range(1, lines.filtered.shape[0]):
            add_scaled(w, mu * error[k], newest(lines.filtered[k, j, i], taps), 0, taps)


@part()
def leak_guarded(guard, w, mu):
    """Subtract mu (w'x'') x'' with x'' = W * x', if there is a guard: a leak where the secondary path is uncertain."""
    if guard is not None:
        row = newest(guard.filtered, w.size)
        add_scaled(w, -mu * dot(w, row), row, 0, w.size)


@part()
def leak_channel_guarded(guard, weights, j, mu):
    """Subtract mu sum_k (sum_ji w_ji'x''_kji) x''_kji from the weights of loudspeaker j, if there is a guard.

    The sums are computed for the first loudspeaker, before any weight changes.
    """
    if guard is not None:
        taps = weights.shape[2]
        for k in range(guard.output.size if j == 0 else 0):
            guard.output[k] = heard_output(guard.filtered, weights, k)
        for i in range(weights.shape[1]):
            for k in range(guard.output.size):
                add_scaled(weights[j, i], -mu * guard.output[k], newest(guard.filtered[k, j, i], taps), 0, taps)


@part()
def heard_output(filtered, weights, k):
    """Return the sum of w_ji' x'_kji for microphone k, with the delay lines of x', (K, J, I, size)."""
    total = 0.0
    for j in range(weights.shape[0]):
        for i in range(weights.shape[1]):
            total += dot(weights[j, i], newest(filtered[k, j, i], weights.shape[2]))
    return total


@part(fastmath=FAST)
def change(w, filtered, x, keep, correction, penalty):
    """Set w = keep w + correction x' - penalty x."""
    for i in range(w.size):
        w[i] = keep * w[i] + correction * filtered[i] - penalty * x[i]


@part()
def penalty_of_constraint(constraint, factor):
    """Return gamma = G_s (1/alpha - 1): zero if the rated power is enough.

    Until a signal has passed the estimated path, G_s = 0 and gamma = sqrt(G_s delta_d^2 / rho_o) - G_s is 0 too.
    """
    gain = constraint.numbers[0].gain
    return gain * (1.0 / factor - 1.0) if factor < 1.0 and gain > 0.0 else 0.0
