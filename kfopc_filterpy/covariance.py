"""State covariance of the random-walk filter: one triangle inside, full arrays only when they are read."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .kernels import (
    DIAGONAL,
    INVERSE_S,
    SCALE,
    Covariance,
    full_covariance,
    new_covariance,
    predict_covariance,
    project_covariance,
)

ASYMMETRY_LIMIT = 1e-8  # of the largest element: what rounding leaves; more is a mistake


class Owed(NamedTuple):
    """P at a moment since the last pass over the triangle: the scale and diagonal owed then."""

    scale: float
    diagonal: float


TRIANGLE = "triangle"  # P(n|n-1) of the last update: the pass wrote it, only the downdate is owed


class RandomWalkCovariance:
    """P, P_prior, P_post and the gain of a random-walk filter, each made full when read.

    `arrays` is what the compiled functions advance. `prior` and `posterior` say how to make P_prior and
    P_post from it: an `Owed` moment, `TRIANGLE`, or an array where that is no longer possible.
    """

    def __init__(self, P: np.ndarray) -> None:
        self.arrays: Covariance = new_covariance((P + P.T) / 2)
        self.prior: Owed | np.ndarray | str = Owed(1.0, 0.0)
        self.posterior: Owed | np.ndarray | str = Owed(1.0, 0.0)
        self._shown: np.ndarray | None = None

    @property
    def now(self) -> Owed:
        """What is owed at present."""
        return Owed(float(self.arrays.owed[SCALE]), float(self.arrays.owed[DIAGONAL]))

    def full(self, moment: Owed | np.ndarray | str) -> np.ndarray:
        """P at a moment, as a full symmetric array of its own."""
        if isinstance(moment, np.ndarray):
            return moment.copy()
        T, g, owed = self.arrays.triangle, self.arrays.gain_direction, self.arrays.owed
        if isinstance(moment, str):
            return full_covariance(T, g, 1.0, 0.0, 0.0)
        return full_covariance(T, g, moment.scale, moment.diagonal, -moment.scale * owed[INVERSE_S])

    def show(self) -> np.ndarray:
        """P as a full array; what is written into it counts at the next step (`edited`)."""
        if self._shown is None:
            self._shown = self.full(self.now)
        return self._shown

    def edited(self) -> np.ndarray | None:
        """The shown array if it was written into, None otherwise."""
        if self._shown is None or np.array_equal(self._shown, self.full(self.now)):
            return None
        return self._shown

    def replaced(self, P: np.ndarray) -> RandomWalkCovariance:
        """A covariance that goes on from another P and remembers P_prior and P_post."""
        other = RandomWalkCovariance(P)
        other.prior, other.posterior = self.full(self.prior), self.full(self.posterior)
        return other

    def predict(self, alpha_sq: float, state_noise: float) -> None:
        """Eq. 4."""
        if not np.isfinite(alpha_sq * max(self.now) + state_noise):
            raise ValueError(f"P would overflow with Q = {state_noise:g}, alpha^2 = {alpha_sq:g}. Nothing was changed")
        self._shown = None
        predict_covariance(self.arrays, alpha_sq, state_noise)
        self.prior = self.now

    def project(self, h: np.ndarray) -> float:
        """h' P h, with P h left in the arrays for the update; the value of P does not change."""
        self._shown = None
        if isinstance(self.prior, str):  # a second update since the last prediction
            self.prior = self.full(self.prior)
        now = self.now
        hPh = float(project_covariance(self.arrays, h))
        if isinstance(self.prior, Owed):
            self.prior = TRIANGLE
        if isinstance(self.posterior, Owed):  # the same P_post, seen from the triangle as it is now
            ratio = self.posterior.scale / now.scale
            self.posterior = Owed(ratio, self.posterior.diagonal - ratio * now.diagonal)
        return hPh

    def settle(self) -> None:
        """An update is over, or its sample was missed: P is P_post."""
        self.posterior = self.now

    def after_compiled(self) -> float:
        """After the compiled loop advanced `arrays`: what is owed is one downdate; return its S."""
        self._shown = None
        self.prior = TRIANGLE
        self.settle()
        return 1.0 / float(self.arrays.owed[INVERSE_S])


def require_covariance(P: np.ndarray) -> None:
    """Raise ValueError unless P is symmetric, to rounding, with no negative variance."""
    if np.diagonal(P).min() < 0:
        raise ValueError("P must not have negative variances on its diagonal")
    difference = np.abs(P - P.T)
    if difference.max() > ASYMMETRY_LIMIT * np.abs(P).max():
        i, j = np.unravel_index(np.argmax(difference), P.shape)
        raise ValueError(f"P must be symmetric, but P[{i}, {j}] = {P[i, j]:g} and P[{j}, {i}] = {P[j, i]:g}")
