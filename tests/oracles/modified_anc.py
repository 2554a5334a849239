"""The modified ANC loop in plain Python, written from the paper alone: slow, and free of the package.

Each sum over a path is written out from the whole history, and the Kalman filter is filterpy's own. Sign convention:
e = d - s * amp(y), d^ = e + s^ * y.
"""

from __future__ import annotations

import math

import numpy as np
from filterpy.kalman import KalmanFilter
from oracles.powers import Constraint
from oracles.signals import linear


def at(path, history, n):
    """(path * history)(n), nothing before the first sample."""
    return sum(path[k] * history[n - k] for k in range(min(len(path), n + 1)))


def newest_first(history, n, length):
    return np.array([history[n - k] if n >= k else 0.0 for k in range(length)])


class Factor(Constraint):
    """Eq. 10-13 for one channel; without a rated power the factor is 1."""

    def __init__(self, rated_power, gain=None, memory_s=0.5, fs=16000, window="exponential"):
        super().__init__(
            math.inf if rated_power is None else rated_power, gain=gain, memory_s=memory_s, fs=fs, window=window
        )

    def take(self, d, xf, x):
        alpha = super().take(d * d, xf * xf, x * x)
        self.alpha = 1.0 if self.rated_power == math.inf else alpha
        return self.alpha


class Kalman:
    """KF-ANC and KF-OPC: filterpy's own filter, its measurement scaled by alpha."""

    def __init__(self, n_taps, factor, *, r, q, p0):
        self.filter, self.factor = KalmanFilter(dim_x=n_taps, dim_z=1), factor
        self.filter.Q, self.filter.R, self.filter.P = r * np.eye(n_taps), np.array([[q]]), p0 * np.eye(n_taps)

    @property
    def weights(self):
        return self.filter.x[:, 0]

    def adapt(self, e, d, y, xf, x):
        alpha = self.factor.take(d, xf[0], x[0])
        self.filter.predict()
        self.filter.update(np.array([[alpha * d]]), H=xf.reshape(1, -1))


class LMS:
    """FxLMS, and with a rated power MOV-FxLMS: gamma = max(G_s (sqrt(delta_d^2 / (rho_o G_s)) - 1), 0)."""

    def __init__(self, n_taps, factor, *, mu):
        self.weights, self.factor, self.mu = np.zeros(n_taps), factor, mu

    def adapt(self, e, d, y, xf, x):
        self.factor.take(d, xf[0], x[0])
        self.weights = self.weights + self.mu * (e * xf - self.factor.penalty * y * x)


def modified_anc(
    algorithm, x, d, s, s_hat, *, noise=None, amplifier=linear, known_amplifier=linear, feedback=(0.0,), on=0, limit=1e6
):
    """Run it; returns a dict of the signals from sample `on` to the end, or to the sample before a divergence."""
    n_taps = len(algorithm.weights)
    noise = np.zeros(len(x)) if noise is None else noise
    heard, filtered, modelled, amplified = [], [], [], []
    rows = {key: [] for key in ("error", "control_signal", "amplifier_output", "anti_noise", "constraint_factor")}
    rows |= {"disturbance_power": [], "secondary_path_gain": [], "weights": []}
    for n in range(len(x)):
        heard.append(x[n] + sum(feedback[k] * amplified[n - k] for k in range(1, min(len(feedback), n + 1))))
        filtered.append(at(s_hat, heard, n))
        x_row, xf_row = newest_first(heard, n, n_taps), newest_first(filtered, n, n_taps)
        y = float(algorithm.weights @ x_row) if n >= on else 0.0
        if not abs(y) <= limit:
            break
        modelled.append(known_amplifier(y))
        amplified.append(amplifier(y))
        anti_noise = at(s, amplified, n)
        e = d[n] - anti_noise + noise[n]
        d_hat = e + at(s_hat, modelled, n)
        if n < on:
            algorithm.factor.take(d_hat, xf_row[0], x_row[0])
            continue
        algorithm.adapt(e, d_hat, y, xf_row, x_row)
        factor = algorithm.factor
        row = (
            e,
            y,
            amplified[n],
            anti_noise,
            factor.alpha,
            factor.disturbance_power,
            factor.gain,
            algorithm.weights.copy(),
        )
        for key, value in zip(rows, row, strict=True):
            rows[key].append(value)
    return {key: np.array(values) for key, values in rows.items()}
