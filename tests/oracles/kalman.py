"""KF-ANC (eq. 2-8), and with rated powers KF-OPC (eq. 9-13). The state w has the control filters of all loudspeakers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from oracles.guard import guarded_correction
from oracles.signals import Controller


def correct(w, P, x, d, q):
    """Return w and P after one measurement d = x'w + e_o."""
    # eq. 6: K(n) = P(n|n-1) x'(n) [x'^T(n) P(n|n-1) x'(n) + q(n)]^-1
    K = P @ x / (x @ P @ x + q)
    # eq. 5: w(n|n) = w(n|n-1) + K(n) [d(n) - x'^T(n) w(n|n-1)]
    w = w + K * (d - x @ w)
    # eq. 8: P(n|n) = [I - K(n) x'^T(n)] P(n|n-1)
    P = (np.eye(len(x)) - np.outer(K, x)) @ P
    return w, P


@dataclass(kw_only=True)
class Kalman(Controller):
    """The Kalman filter of the paper; the measurements of several microphones correct the state one after the other."""

    r: float  # variance of the state noise
    q: Sequence[float]  # (K,) variances of the measurement noises
    P0: float = 1.0  # variance of each weight at the start

    def __post_init__(self):
        super().__post_init__()
        self.P = self.P0 * np.eye(self.w.size)

    def adapt(self, e):
        """Apply eq. 2-13."""
        alpha = self.alpha()  # eq. 10-13; 1 without a rated power
        # eq. 2: w(n|n-1) = w(n-1|n-1)
        w = self.w.ravel()
        # eq. 4: P(n|n-1) = P(n-1|n-1) + r(n) I
        P = self.P + self.r * np.eye(w.size)
        for k, x in enumerate(self.x_filtered):
            # eq. 9: w(n|n) = w(n|n-1) + K(n) [alpha d^(n) - x'^T(n) w(n|n-1)]
            w, P = correct(w, P, x.ravel(), alpha * self.d[k], self.q[k])
        if self.guard is not None:
            w, P = guarded_correction(correct, w, P, self.guarded_line, self.q)
        self.w, self.P = w.reshape(self.w.shape), P
