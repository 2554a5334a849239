"""The filtered-reference LMS algorithms. In all, x' = s^ * x, and sums over microphones make one step of the filters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from oracles.guard import guarded_step
from oracles.powers import loudspeaker_factors
from oracles.signals import Controller


def each(values):
    """Return a value of each loudspeaker, (J,), or one for all, so that it multiplies control filters (J, I, L)."""
    return np.reshape(values, (-1, 1, 1))


@dataclass(kw_only=True)
class LMS(Controller):
    """Common parts."""

    mu: float  # step size

    def gradient(self, e):
        """Return sum_k e_k(n) x'_kji(n): minus half the gradient of the squared errors."""
        return np.einsum("k,kjil->jil", e, self.x_filtered)

    def guarded(self, mu):
        """Return w, after a step towards w'x'' = 0 if there is a guard."""
        return self.w if self.guard is None else guarded_step(self.w, self.guarded_line, each(mu))


class FxLMS(LMS):
    """Descend the gradient of the squared errors."""

    def adapt(self, e):
        """Apply the multiple-error LMS."""
        # w_ji(n+1) = w_ji(n) + mu sum_k e_k(n) x'_kji(n)
        self.w = self.guarded(self.mu) + self.mu * self.gradient(e)


@dataclass(kw_only=True)
class FxNLMS(LMS):
    """Divide the step by the energy of all filtered references."""

    epsilon: float = 1e-10  # regularization

    def adapt(self, e):
        """Apply FxLMS with a normalised step."""
        # w_ji(n+1) = w_ji(n) + mu sum_k e_k(n) x'_kji(n) / (epsilon + sum_kji x'_kji'(n) x'_kji(n))
        energy = np.sum(self.x_filtered**2) + np.sum(self.guarded_line**2)  # x'' is zero without a guard
        mu = self.mu / (self.epsilon + energy)
        self.w = self.guarded(mu) + mu * self.gradient(e)


@dataclass(kw_only=True)
class LeakyFxLMS(LMS):
    """Minimise E[e^2] + gamma w'w."""

    gamma: float | Sequence[float]  # leak of all loudspeakers, or of each

    def adapt(self, e):
        """Apply FxLMS with a leak."""
        # w_ji(n+1) = (1 - mu gamma_j) w_ji(n) + mu sum_k e_k(n) x'_kji(n)
        self.w = (1 - self.mu * each(self.gamma)) * self.guarded(self.mu) + self.mu * self.gradient(e)


class OptimalLeakyFxLMS(LMS):
    """Compute the leak for a rated power from the running powers."""

    def adapt(self, e):
        """Apply leaky FxLMS with the leak of this sample."""
        # gamma_j(n) = E[x^2] max{sqrt(G_j delta_d^2 / rho_j) - G_j, 0}
        self.alphas = loudspeaker_factors(self.constraints, self.d, self.x_filtered, self.x)
        gamma = [one.reference_power * one.penalty for one in self.constraints]
        # w_ji(n+1) = (1 - mu gamma_j(n)) w_ji(n) + mu sum_k e_k(n) x'_kji(n)
        self.w = (1 - self.mu * each(gamma)) * self.guarded(self.mu) + self.mu * self.gradient(e)


@dataclass(kw_only=True)
class MOVFxLMS(LMS):
    """Minimise E[e^2] + gamma E[y^2]."""

    gamma: float | Sequence[float] | None = None  # fixed penalty; None: it follows the running powers
    modified: bool = False  # adapt to d^ - w'x' instead of e

    def adapt(self, e):
        """Apply FxLMS with a penalty on the control signal."""
        self.alphas = loudspeaker_factors(self.constraints, self.d, self.x_filtered, self.x)
        # gamma_j(n) = max{sqrt(G_j delta_d^2 / rho_j) - G_j, 0}
        gamma = [one.penalty for one in self.constraints] if self.gamma is None else self.gamma
        if self.modified:
            # e_k(n) = d^_k(n) - sum_ji w_ji'(n) x'_kji(n)
            e = self.d - np.einsum("jil,kjil->k", self.w, self.x_filtered)
        # w_ji(n+1) = w_ji(n) + mu [sum_k e_k(n) x'_kji(n) - gamma_j y_j(n) x_i(n)]
        penalised = each(gamma) * each(self.y) * self.x
        self.w = self.guarded(self.mu) + self.mu * (self.gradient(e) - penalised)


@dataclass(kw_only=True)
class TwoGradientFxLMS(LMS):
    """Reduce the errors within an amplitude limit, and the control power beyond it."""

    A: float | Sequence[float]  # amplitude limit of all loudspeakers, or of each
    mu_y: float  # step size beyond it

    def adapt(self, e):
        """Let each loudspeaker choose its direction."""
        # |y_j(n)| <= A_j:  w_ji(n+1) = w_ji(n) + mu sum_k e_k(n) x'_kji(n)
        # |y_j(n)| >  A_j:  w_ji(n+1) = w_ji(n) - mu_y y_j(n) x_i(n)
        within = self.guarded(self.mu) + self.mu * self.gradient(e)
        beyond = self.w - self.mu_y * each(self.y) * self.x
        self.w = np.where(each(np.abs(self.y) <= self.A), within, beyond)


@dataclass(kw_only=True)
class ClippingFxLMS(FxLMS):
    """Clip the control signals; the weights adapt as in FxLMS."""

    A: float | Sequence[float]  # amplitude limit of all loudspeakers, or of each

    def output(self):
        """Return the clipped control signals."""
        # y_j(n) = max{min{sum_i w_ji'(n-1) x_i(n), A_j}, -A_j}
        return np.clip(super().output(), -np.asarray(self.A), self.A)


@dataclass(kw_only=True)
class RescalingFxLMS(FxLMS):
    """Clip the control signals and scale the control filters by the same ratio; then FxLMS."""

    A: float | Sequence[float]  # amplitude limit of all loudspeakers, or of each

    def output(self):
        """Return the control signals of the scaled filters."""
        # |y_j(n)| > A_j:  w_ji <- w_ji A_j / |y_j(n)|,  y_j(n) <- y_j(n) A_j / |y_j(n)|
        y = super().output()
        ratio = self.A / np.maximum(np.abs(y), self.A)
        self.w = each(ratio) * self.w
        return ratio * y
