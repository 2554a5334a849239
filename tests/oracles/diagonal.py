"""The Kalman filter with only the diagonal p of its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from oracles.guard import guarded_correction
from oracles.kalman import Kalman


def correct_diagonal(w, p, x, d, q):
    """Return w and p after one measurement d = x'w + e_o."""
    # S = sum_i p_i x'_i^2 + q,   K_i = p_i x'_i / S
    K = p * x / (np.sum(p * x**2) + q)
    # w <- w + K (d - x'^T w),   p_i <- (1 - K_i x'_i) p_i
    return w + K * (d - x @ w), (1 - K * x) * p


@dataclass(kw_only=True)
class DiagonalKalman(Kalman):
    """KF-ANC or KF-OPC whose P has no other elements than those of its diagonal: NLMS with a step size for each tap."""

    def __post_init__(self):
        super().__post_init__()
        self.p = np.diag(self.P)

    def adapt(self, e):
        """Apply eq. 2-13 to the diagonal."""
        alpha = self.alpha()
        w, p = self.w.ravel(), self.p + self.r
        for k, x in enumerate(self.x_filtered):
            w, p = correct_diagonal(w, p, x.ravel(), alpha * self.d[k], self.q[k])
        if self.guard is not None:
            w, p = guarded_correction(correct_diagonal, w, p, self.guarded_line, self.q)
        self.w, self.p = w.reshape(self.w.shape), p
