"""The running powers and the constraint factor, eq. 10-13."""

from __future__ import annotations

import math
from collections import deque

import numpy as np


class ExponentialMean:
    """Average with an exponential window: a plain mean until the weight of a new value has fallen to `rate`."""

    def __init__(self, memory_s, fs):
        # rate = 1 - exp(-1 / (memory_s fs))
        self.rate, self.count, self.mean = 1 - math.exp(-1 / (memory_s * fs)), 0, 0.0

    def take(self, value):
        """Return the average with one more value."""
        self.count += 1
        # mean(n) = (1 - share) mean(n-1) + share value(n)
        share = max(self.rate, 1 / self.count)
        self.mean = (1 - share) * self.mean + share * value
        return self.mean


class SlidingMean:
    """Average over the newest memory_s fs values; all of them, as long as there are fewer."""

    def __init__(self, memory_s, fs):
        self.values = deque(maxlen=max(round(memory_s * fs), 1))

    def take(self, value):
        """Return the average with one more value."""
        self.values.append(value)
        return math.fsum(self.values) / len(self.values)


MEANS = {"exponential": ExponentialMean, "sliding": SlidingMean}


class Constraint:
    """Estimate the constraint factor of a loudspeaker from squares, or from sums of squares over channels."""

    def __init__(self, rated_power, *, gain=None, memory_s=0.5, fs=16000.0, window="exponential"):
        self.rated_power, self.known_gain = rated_power, gain
        self.d2, self.xf2, self.x2 = (MEANS[window](memory_s, fs) for _ in range(3))
        self.disturbance_power, self.reference_power, self.gain, self.alpha = 0.0, 0.0, math.nan, 1.0

    def take(self, d2, xf2, x2):
        """Return the factor with one more sample."""
        # eq. 10: delta_d^2 = E[d^2]
        self.disturbance_power = self.d2.take(d2)
        # eq. 11: G_s = E[x'^2] / E[x^2]
        filtered_power, self.reference_power = self.xf2.take(xf2), self.x2.take(x2)
        if self.reference_power > 0:
            self.gain = filtered_power / self.reference_power
        if self.known_gain is not None:
            self.gain = self.known_gain
        # eq. 12: rho_o G_s = delta_d^2 alpha^2
        # eq. 13: alpha = min{sqrt(rho_o G_s / delta_d^2), 1}
        self.alpha = 1.0
        if self.disturbance_power > 0 and not math.isnan(self.gain):
            self.alpha = min(math.sqrt(self.rated_power * self.gain / self.disturbance_power), 1.0)
        return self.alpha

    @property
    def penalty(self):
        """Penalty of MOV-FxLMS for which a flat secondary path leaves the rated power, G_s (1 / alpha - 1)."""
        # gamma = max{sqrt(G_s delta_d^2 / rho_o) - G_s, 0}
        if math.isnan(self.gain):
            return 0.0
        return max(math.sqrt(self.gain * self.disturbance_power / self.rated_power) - self.gain, 0.0)


def loudspeaker_factors(constraints, d, x_filtered, x):
    """Return each loudspeaker's factor, (J,), as if it were alone: squares are summed over microphones and references."""
    # delta_d^2 = sum_k E[d_k^2],   G_j = sum_ki E[x'_kji^2] / sum_i E[x_i^2]
    d2, x2 = np.sum(d**2), np.sum(x[:, 0] ** 2)
    xf2 = np.sum(x_filtered[..., 0] ** 2, axis=(0, 2))
    return np.array([one.take(d2, xf2[j], x2) for j, one in enumerate(constraints)])


def least_factor(constraints):
    """Return the smallest factor; a loudspeaker that no microphone hears, G_j = 0, is left out if another is heard."""
    # alpha = min_j alpha_j
    heard = [one.alpha for one in constraints if one.gain != 0]
    return min(heard or [one.alpha for one in constraints])
