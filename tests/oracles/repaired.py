"""KF-OPC repaired, for one channel: the gain of the control signal, a trim by the measured power, the factor at the output.

Each of the three can be left out; without all of them it is KF-OPC.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from oracles.kalman import Kalman


@dataclass(kw_only=True)
class RepairedKFOPC(Kalman):
    """KF-OPC that keeps the rated power on secondary paths that are not flat."""

    gain_of_control: bool = True  # G_s = E[(s^ * y)^2] / E[y^2] instead of E[x'^2] / E[x^2]
    trim_rate: float = 0.0  # 1 / (trim_s fs), per sample; 0: no trim
    factor_at_output: bool = True  # y = alpha w'x instead of alpha d^
    trim: float = 0.0  # its logarithm

    def output(self):
        """Return the control signal, which the last factor scales."""
        # y(n) = alpha(n-1) w'(n-1) x(n)
        return (self.alphas if self.factor_at_output else 1.0) * super().output()

    def adapt(self, e):
        """Apply eq. 2-13, and trim the next factor."""
        self.e = e
        super().adapt(e)
        # ln trim <- ln trim + (1 - y^2(n) / rho_o) / (trim_s fs); while alpha = 1, it does not rise
        change = self.trim_rate * (1 - self.y[0] ** 2 / self.constraints[0].rated_power)
        if change < 0 or self.alphas[0] < 1:
            self.trim = float(np.clip(self.trim + change, -math.log(10), math.log(10)))

    def follow(self):
        """Add a sample before the control is switched on to the powers: there is only the gain of the reference yet."""
        self.constraints[0].take(self.d[0] ** 2, self.x_filtered[0, 0, 0, 0] ** 2, self.x[0, 0] ** 2)

    def alpha(self):
        """Return the factor of the measurement."""
        # (s^ * y)(n) = d^(n) - e(n)
        seen = (self.d - self.e, self.y) if self.gain_of_control else (self.x_filtered[0, 0, :, 0], self.x[:, 0])
        # alpha(n) = min{trim(n) min{sqrt(rho_o G_s / delta_d^2), 1}, 1}
        alpha = self.constraints[0].take(self.d[0] ** 2, *(float(one[0] ** 2) for one in seen))
        self.alphas = np.array([min(math.exp(self.trim) * alpha, 1.0)])
        return 1.0 if self.factor_at_output else self.alphas[0]
