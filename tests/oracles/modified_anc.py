"""The modified ANC loop in plain Python, written from the paper alone: slow, and free of the package.

Each sum over a path is written out from the whole history, the running powers keep every sample, and the Kalman
filter is filterpy's own. Sign convention: e = d - s * amp(y), d^ = e + s^ * y.
"""

from __future__ import annotations

import math

import numpy as np
from filterpy.kalman import KalmanFilter


def linear(y):
    return y


def hard_clip(limit):
    return lambda y: math.copysign(limit, y) if abs(y) > limit else y


def rapp(limit, sharpness):
    return lambda y: y / (1 + (abs(y) / limit) ** (2 * sharpness)) ** (1 / (2 * sharpness))


def at(path, history, n):
    """(path * history)(n), nothing before the first sample."""
    return sum(path[k] * history[n - k] for k in range(min(len(path), n + 1)))


def newest_first(history, n, length):
    return np.array([history[n - k] if n >= k else 0.0 for k in range(length)])


class MeanSquare:
    """Exponential: weights 1 - lambda and lambda, a plain mean until that weight is reached. Sliding: the last m."""

    def __init__(self, memory_s, fs, window):
        self.new = 1 - math.exp(-1 / (memory_s * fs))
        self.m = round(memory_s * fs) if window == "sliding" else None
        self.samples, self.mean = [], 0.0

    def take(self, value):
        self.samples.append(value * value)
        if self.m is not None:
            newest = self.samples[-self.m :]
            self.mean = math.fsum(newest) / len(newest)
        else:
            share = max(self.new, 1 / len(self.samples))
            self.mean = (1 - share) * self.mean + share * value * value
        return self.mean


class Factor:
    """Eq. 10-13."""

    def __init__(self, rated_power, gain=None, memory_s=0.5, fs=16000, window="exponential"):
        self.rated_power, self.fixed_gain = rated_power, gain
        self.d, self.xf, self.x = (MeanSquare(memory_s, fs, window) for _ in range(3))
        self.power, self.gain, self.alpha = 0.0, math.nan, 1.0

    def take(self, d, xf, x):
        self.power, filtered, reference = self.d.take(d), self.xf.take(xf), self.x.take(x)
        if reference > 0:
            self.gain = filtered / reference
        if self.fixed_gain is not None:
            self.gain = self.fixed_gain
        self.alpha = 1.0
        if self.rated_power is not None and self.power > 0 and not math.isnan(self.gain):
            self.alpha = min(math.sqrt(self.rated_power * self.gain / self.power), 1.0)
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
        factor, gamma = self.factor, 0.0
        factor.take(d, xf[0], x[0])
        if factor.rated_power is not None and factor.gain > 0:
            gamma = max(
                factor.gain * (math.sqrt(factor.power / (factor.rated_power * factor.gain)) - 1),
                0.0,
            )
        self.weights = self.weights + self.mu * (e * xf - gamma * y * x)


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
        row = (e, y, amplified[n], anti_noise, factor.alpha, factor.power, factor.gain, algorithm.weights.copy())
        for key, value in zip(rows, row, strict=True):
            rows[key].append(value)
    return {key: np.array(values) for key, values in rows.items()}
