"""The scene of every oracle: delay lines, newest sample first, and the loop over the samples.

K microphones, J loudspeakers, I references, L taps. Secondary paths are (K, J, M), control filters (J, I, L). One channel
is K = J = I = 1. Sums over channels are written as `np.einsum`, whose letters are the indices of the equations: k
microphone, j loudspeaker, i reference, l or m tap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from oracles.powers import Constraint, least_factor, loudspeaker_factors


def push(line, sample):
    """Move the delay lines, (..., taps), by one sample, and put the newest one, (...), first."""
    line[..., 1:] = line[..., :-1].copy()
    line[..., 0] = sample


def linear(y):
    """Return y."""
    return y


def hard_clip(limit):
    """Return an amplifier that clips."""
    return lambda y: min(max(y, -limit), limit)


def rapp(limit, sharpness):
    """Return an amplifier that saturates smoothly, Rapp's model."""
    return lambda y: y / (1 + (abs(y) / limit) ** (2 * sharpness)) ** (1 / (2 * sharpness))


@dataclass(kw_only=True)
class Controller:
    """Keep the signals that a controller knows; an algorithm adds `adapt`, and can replace `output`."""

    s_hat: np.ndarray  # (K, J, M) estimated secondary paths
    n_taps: int  # L
    n_references: int = 1  # I
    constraints: Sequence[Constraint] = ()  # of the loudspeakers; none: alpha = 1
    amplifiers: Sequence[Callable] | None = None  # known models of the loudspeakers' amplifiers
    limiters: Sequence[Callable] | None = None  # of the control signals
    guard: np.ndarray | None = None  # taps of W, against uncertain secondary paths

    def __post_init__(self):
        K, J, M = self.s_hat.shape
        I, L, G = self.n_references, self.n_taps, 0 if self.guard is None else len(self.guard)  # noqa: E741
        self.w = np.zeros((J, I, L))
        self.reference_line = np.zeros((I, max(L, M)))
        self.filtered_line = np.zeros((K, J, I, max(L, G)))
        self.guarded_line = np.zeros((K, J, I, L))
        self.output_line = np.zeros((J, M))
        self.x = self.reference_line[:, :L]  # these two show the L newest samples of the lines
        self.x_filtered = self.filtered_line[..., :L]
        self.y, self.d, self.alphas = np.zeros(J), np.zeros(K), np.ones(J)

    def control_signal(self, x):
        """Return y(n), (J,), for the newest references, (I,)."""
        self.hear(x)
        self.play(self.output())
        return self.y

    def hear(self, x):
        """Take the newest references."""
        push(self.reference_line, x)
        # x'_kji(n) = (s^_kj * x_i)(n)
        M = self.s_hat.shape[2]
        push(self.filtered_line, np.einsum("kjm,im->kji", self.s_hat, self.reference_line[:, :M]))
        if self.guard is not None:
            # x''_kji(n) = (W * x'_kji)(n)
            push(self.guarded_line, self.filtered_line[..., : len(self.guard)] @ self.guard)

    def output(self):
        """Return the control signals before any limiter."""
        # y_j(n) = sum_i w_ji'(n-1) x_i(n)
        return np.einsum("jil,il->j", self.w, self.x)

    def play(self, y):
        """Send the control signals to the loudspeakers."""
        self.y = y if self.limiters is None else np.array([limit(v) for limit, v in zip(self.limiters, y, strict=True)])
        push(self.output_line, amplified(self.amplifiers, self.y))

    def update(self, e):
        """Adapt to the errors, (K,), that the last control signals left."""
        # d^_k(n) = e_k(n) + sum_j (s^_kj * y_j)(n)
        self.d = e + np.einsum("kjm,jm->k", self.s_hat, self.output_line)
        self.adapt(e)

    def listen(self, x, e):
        """Take a sample before the control is switched on: the loudspeakers are silent, the powers follow."""
        self.hear(x)
        self.play(np.zeros(len(self.y)))
        self.d = e  # d^ = e, because y = 0
        self.follow()

    def follow(self):
        """Add the sample to the powers."""
        self.alpha()

    def alpha(self):
        """Return the constraint factor of all loudspeakers with this sample, eq. 13; 1 without a rated power."""
        if not self.constraints:
            return 1.0
        self.alphas = loudspeaker_factors(self.constraints, self.d, self.x_filtered, self.x)
        return least_factor(self.constraints)


def amplified(amplifiers, y):
    """Return the outputs of the amplifiers."""
    return y if amplifiers is None else np.array([amplifier(v) for amplifier, v in zip(amplifiers, y, strict=True)])


class Run(NamedTuple):
    """The signals of a run."""

    y: np.ndarray  # (J, n)
    e: np.ndarray  # (K, n)
    alphas: np.ndarray  # (J, n)
    w: np.ndarray  # (J, I, L) at the end


def run(controller, x, d, s, *, amplifiers=None, on=0):
    """Run a controller over references (I, n) and disturbances (K, n), with true secondary paths (K, J, M).

    The control is switched on at sample `on`; the signals of the run begin there.
    """
    line = np.zeros(s.shape[1:])
    ys, es, alphas = [], [], []
    for n in range(on):
        controller.listen(x[:, n], d[:, n])
    for n in range(on, x.shape[1]):
        y = controller.control_signal(x[:, n])
        push(line, amplified(amplifiers, y))
        # e_k(n) = d_k(n) - sum_j (s_kj * y_amp,j)(n)
        e = d[:, n] - np.einsum("kjm,jm->k", s, line)
        controller.update(e)
        ys.append(y), es.append(e), alphas.append(controller.alphas)
    return Run(np.array(ys).T, np.array(es).T, np.array(alphas).T, controller.w.copy())
