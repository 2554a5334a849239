"""Filtered-reference recursive least squares.

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

    def __post_init__(self):
        super().__post_init__()
        self.P = self.P0 * np.eye(self.w.size)

    def adapt(self, e):
        """Correct the weights by the measurement, which eq. 9 scales."""
        alpha, w = self.alpha(), self.w.ravel()
        for d, x in zip(self.d, self.x_filtered, strict=True):
            w, self.P = correct_rls(w, self.P, x.ravel(), alpha * d, self.forgetting)
        self.w = w.reshape(self.w.shape)
