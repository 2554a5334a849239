"""Filtered-reference recursive least squares, which the fast-array Kalman filter computes in another way.

Without forgetting it is KF-ANC with r = 0 and P in units of the measurement noise q.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from oracles.signals import Controller


def correct_rls(w, P, x, d, forgetting=1.0):
    """Return w and P after one measurement; P is in units of the variance of the measurement noise."""
    # K = P x' / (lambda + x'^T P x')
    K = P @ x / (forgetting + x @ P @ x)
    # w <- w + K (d - x'^T w)
    w = w + K * (d - x @ w)
    # P <- (P - K x'^T P) / lambda
    P = (P - np.outer(K, x @ P)) / forgetting
    return w, P


@dataclass(kw_only=True)
class FxRLS(Controller):
    """Minimise sum_m lambda^(n-m) (d^(m) - w'x'(m))^2."""

    forgetting: float = 1.0  # lambda
    P0: float = 1.0  # variance of each weight at the start, in units of that of the measurement noise
    fast_array: bool = False  # start with the P that the fast array requires, and adapt while listening

    def __post_init__(self):
        super().__post_init__()
        # P(0) = P0 I; of the fast array P0 diag(lambda, lambda^2, ..., lambda^L)
        fading = self.forgetting ** (1.0 + np.arange(self.n_taps)) if self.fast_array else np.ones(self.n_taps)
        self.P = self.P0 * np.diag(np.tile(fading, self.w.size // self.n_taps))

    def adapt(self, e):
        """Correct the weights by the measurement, which eq. 9 scales."""
        alpha, w = self.alpha(), self.w.ravel()
        for d, x in zip(self.d, self.x_filtered, strict=True):
            w, self.P = correct_rls(w, self.P, x.ravel(), alpha * d, self.forgetting)
        self.w = w.reshape(self.w.shape)

    def follow(self):
        """Adapt before the control is switched on, too, as the fast array must."""
        if self.fast_array:
            self.adapt(self.d)
        else:
            self.alpha()


class GrowingMemory:
    """Least squares over all samples since the start, at weights that are known."""

    def __init__(self, w, P0, known):
        self.w, self.P, self.heard, self.known = w.copy(), P0 * np.eye(len(w)), 0, known

    def correct(self, x, d):
        """Take a sample; those before the start count as zeros."""
        self.heard += 1
        w, self.P = correct_rls(self.w, self.P, np.where(np.arange(len(x)) < self.heard, x, 0.0), d)
        if self.heard > self.known:  # the rows before are not complete, and d does not belong to them
            self.w = w


@dataclass(kw_only=True)
class FiniteMemoryRLS(Controller):
    """Two growing memories that take turns: the variance of their mixture is that of least squares over N samples."""

    N: int  # memory in samples
    P0: float = 1.0  # in units of the variance of the measurement noise

    def __post_init__(self):
        super().__post_init__()
        self.elder, self.younger = GrowingMemory(self.w.ravel(), self.P0, known=0), None

    def adapt(self, e):
        """Correct both, and mix them; for one channel."""
        x, d = self.x_filtered[0, 0, 0], self.alpha() * self.d[0]
        share = 0.0
        for one in filter(None, (self.elder, self.younger)):
            one.correct(x, d)
        # w = (1 - s) w_1 + s w_2,   s = a / N, when the younger one has heard a samples
        w = self.elder.w
        if self.younger is not None:
            share = self.younger.heard / self.N
            w = (1 - share) * w + share * self.younger.w
        self.w = w.reshape(self.w.shape)
        if self.elder.heard >= self.N and (self.younger is None or share >= 1):
            self.elder = self.younger or self.elder
            self.younger = GrowingMemory(w, self.P0, known=len(w) - 1)

    def follow(self):
        """Adapt before the control is switched on, too."""
        self.adapt(self.d)
