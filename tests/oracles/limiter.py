"""The output limiter: the mean square of its output over any window of N samples never exceeds the rated power.

All energies are sums over the newest samples, in units of the budget N rho_o. The settings were found by a search, see
`kfopc_filterpy/power/limiter.py`.
"""

from __future__ import annotations

import math

import numpy as np

RESERVE = 0.02  # of the power
MEAN, LOUD, RELEASE, MEMORY = 1 / 40, 1 / 5, 1 / 8, 20.0  # time constants in windows
OVERSHOOT, LOUDEST, FLOOR = 1.1, 100.0, 1e-200


class Limiter:
    """Scale a signal by the largest gain that keeps the budget in all windows to come, and clip what still exceeds it."""

    def __init__(self, rated_power, *, fs=16000.0, window_s=0.1, amplitude_limit=math.inf):
        N = self.N = round(window_s * fs)
        self.peak = math.sqrt(N * rated_power)  # the one sample that spends the budget
        self.A = min(amplitude_limit, 2 * self.peak)
        self.h = np.arange(1, min(16, N) + 1) * N // min(16, N)  # horizons
        # Room for output in the next h samples: the peak rating allows sines only, the budget all but its reserve.
        sine = (self.A / self.peak) ** 2 / 2 if amplitude_limit < math.inf else math.inf
        self.room = np.minimum(np.append(sine * (self.h[:-1] + N / 16), sine * N), 1.0)
        self.room[-1] = min(self.room[-1], 1 - RESERVE)
        self.arrived, self.spent = np.zeros(N), np.zeros(N)  # energies of the newest inputs and outputs, newest first
        self.held, self.known = np.full(len(self.h), FLOOR), 0.0  # largest energies of h inputs, and of a window
        self.average, self.loud, self.gain, self.n = FLOOR, FLOOR, 1.0, 0

    def decay(self, windows):
        """Return the factor per sample of a decay whose time constant is a number of windows."""
        return math.exp(-1 / (windows * self.N))

    def __call__(self, u):
        """Return the output for the next input."""
        energy = (min(abs(u), LOUDEST * min(self.A, self.peak)) / self.peak) ** 2
        self.arrived = np.append(energy, self.arrived[:-1])
        self.average = max(self.average + (1 - self.decay(MEAN)) * (energy - self.average), FLOOR)
        self.loud = max(self.decay(LOUD) * self.loud, self.average)
        aim = self.aim()
        # The gain falls at once and rises slowly.
        self.gain = min(aim, self.gain + (1 - self.decay(RELEASE)) * max(OVERSHOOT * aim - self.gain, 0.0))
        y = min(max(self.gain * u, -self.A), self.A)
        # y^2(n) <= N rho_o - sum_{m=1}^{N-1} y^2(n-m)
        left = 1 - (self.N + 16) * 2.0**-52 - np.sum(self.spent[: self.N - 1])
        if (y / self.peak) ** 2 > left:
            y = math.copysign(self.peak * math.sqrt(max(left, 0.0)), u)
        self.spent = np.append((y / self.peak) ** 2, self.spent[:-1])
        self.n += 1
        if self.n % self.N == 0:
            self.known = self.held[-1]
        return y

    def aim(self):
        """Return the largest constant gain that keeps to the budget over every horizon, for the worst input expected."""
        arrived = np.append(0.0, np.cumsum(self.arrived))  # at [m], of the newest m inputs
        spent = np.append(0.0, np.cumsum(self.spent))
        known = (1 + RESERVE) * self.known
        if arrived[self.N] > known:
            known = math.inf
        # P_h: what the next h samples bring. The least of three: the most that h samples have brought, h samples as loud
        # as now, and what makes the window as loud as the loudest one known.
        self.held = np.maximum(np.maximum(self.decay(MEMORY) * self.held, arrived[self.h]), FLOOR)
        coming = np.minimum(np.minimum(self.held, self.h * self.loud), known - arrived[self.N - self.h + 1])
        # B_h: what the outputs that are still in the window h samples from now leave of the budget
        left = np.minimum(1 - spent[self.N - self.h], self.room)
        # gain = min_h sqrt(B_h / P_h), at most 1
        return math.sqrt(max(min(np.min(left / np.maximum(coming, FLOOR)), 1.0), 0.0))
