"""State covariance of the random-walk filter: one triangle inside, full arrays only when they are read."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np

from ..kernels.covariance import Covariance, copy_covariance, full_covariance, new_covariance

ASYMMETRY_LIMIT = 1e-8  # of the largest element: what rounding leaves; more is a mistake


# P at a moment since the last pass over the triangle T, as (scale, diagonal, weight): scale T + weight g g' + diagonal I.
Moment = tuple[float, float, float]
TRIANGLE: Moment = (1.0, 0.0, 0.0)  # P is T itself


class RandomWalkCovariance:
    """P, P_prior and P_post of a random-walk filter, each made full when read.

    `arrays` is what the compiled functions advance. `prior` and `posterior` say how to make P_prior and P_post from it,
    or are arrays if that is no longer possible.
    """

    def __init__(self, P: np.ndarray, dtype: Any = np.float64) -> None:
        self.arrays: Covariance = new_covariance(0.5 * (P + P.T), dtype)
        self.prior: Moment | np.ndarray = TRIANGLE
        self.posterior: Moment | np.ndarray = TRIANGLE
        # What P showed since the last step, newest last: each array, and a copy of it as it was shown.
        self._shown: list[tuple[np.ndarray, np.ndarray]] = []
        self._largest = float(np.finfo(dtype).max)
        self._others_read = False  # the arrays are another's too

    def share(self, arrays: Covariance) -> None:
        """Go on from arrays that others go on from too: whoever steps first takes a copy."""
        self.arrays, self._others_read, self._shown = arrays, True, []

    def own(self) -> Covariance:
        """The arrays, which nobody else reads."""
        if self._others_read:
            self.arrays, self._others_read = copy_covariance(self.arrays), False
        return self.arrays

    @property
    def now(self) -> Moment:
        """P at present."""
        scale, diagonal, inverse_S, _ = self.arrays.owed.item()
        return scale, diagonal, -scale * inverse_S

    def full(self, moment: Moment | np.ndarray) -> np.ndarray:
        """P at a moment, as a full symmetric array of its own."""
        if isinstance(moment, np.ndarray):
            return moment.copy()
        if moment == TRIANGLE and not self.arrays.owed["last_inverse_S"][0]:  # a new filter: nothing to compile yet
            n = self.arrays.product.size
            lower = np.tril(self.arrays.triangle[:n, :n].astype(np.float64))
            return lower + np.tril(lower, -1).T
        return full_covariance(self.arrays.triangle, self.arrays.gain_direction, *moment)

    def show(self) -> np.ndarray:
        """Return P as a full array of its own; what is written into it counts at the next step (`edited`)."""
        P = self._shown[-1][0].copy() if self._shown else self.full(self.now)
        self._shown.append((P, P.copy()))
        return P

    def edited(self) -> np.ndarray | None:
        """Return the newest shown array that was written into, None if none was."""
        return next((P for P, shown in reversed(self._shown) if not np.array_equal(P, shown)), None)

    def __deepcopy__(self, memo: dict[int, Any]) -> RandomWalkCovariance:
        other = memo[id(self)] = object.__new__(type(self))
        other.__dict__.update(deepcopy({k: v for k, v in vars(self).items() if k != "arrays"}, memo))
        other.arrays = copy_covariance(self.arrays)
        return other

    def replaced(self, P: np.ndarray) -> RandomWalkCovariance:
        """A covariance that goes on from another P and remembers P_prior and P_post."""
        other = RandomWalkCovariance(P, self.arrays.triangle.dtype)
        other.prior, other.posterior = self.full(self.prior), self.full(self.posterior)
        return other

    def predict(self, alpha_sq: float, state_noise: float) -> None:
        """Apply eq. 4, P(n|n-1) = alpha^2 P(n-1|n-1) + r I; the next pass over the triangle pays for it."""
        owed = self.own().owed
        scale, diagonal, inverse_S, _ = owed.item()
        if not alpha_sq * max(scale, diagonal) + state_noise < self._largest:
            raise ValueError(f"P would overflow with Q = {state_noise:g}, alpha^2 = {alpha_sq:g}. Nothing was changed")
        self._shown = []
        scale, diagonal = alpha_sq * scale, alpha_sq * diagonal + state_noise
        owed["scale"], owed["diagonal"] = scale, diagonal
        self.prior = scale, diagonal, -scale * inverse_S

    def before_update(self) -> tuple[Covariance, Moment, Moment | np.ndarray]:
        """Return the arrays for a compiled update, P now, and P_prior in a form that the update leaves as it is."""
        now = self.now
        if isinstance(self.prior, tuple) and self.prior != now:  # a second update since the prediction
            return self.own(), now, self.full(self.prior)
        return self.own(), now, self.prior

    def projected(self, before: Moment, prior: Moment | np.ndarray) -> None:
        """Go on after the pass of an update, refused or not: P is still what it was `before`, but nothing is owed."""
        self.prior = prior
        self._shown = []
        if isinstance(self.prior, tuple):
            self.prior = TRIANGLE
        if isinstance(self.posterior, tuple):  # the same P_post, seen from the triangle now
            ratio = self.posterior[0] / before[0]
            self.posterior = ratio, self.posterior[1] - ratio * before[1], 0.0

    def updated(self) -> None:
        """Go on after an update: P is P_post, and P_prior, if it was the triangle, is P + g g'/S."""
        scale, diagonal, inverse_S, last_inverse_S = self.arrays.owed.item()
        if isinstance(self.prior, tuple):
            self.prior = 1.0, 0.0, last_inverse_S - inverse_S
        self.posterior = scale, diagonal, -scale * inverse_S

    def missed(self) -> None:
        """Go on after a missed sample: P is P_post."""
        self.posterior = self.now

    def after_compiled(self) -> None:
        """Go on after the compiled loop advanced `arrays`: what is owed is one downdate at most."""
        self._shown = []
        self.prior = TRIANGLE
        self.updated()


def require_covariance(P: np.ndarray) -> None:
    """Raise ValueError unless P is symmetric, to rounding, with no negative variance."""
    if np.diagonal(P).min() < 0:
        raise ValueError("P must not have negative variances on its diagonal")
    difference = np.abs(P - P.T)
    if difference.max() > ASYMMETRY_LIMIT * np.abs(P).max():
        i, j = np.unravel_index(np.argmax(difference), P.shape)
        raise ValueError(f"P must be symmetric, but P[{i}, {j}] = {P[i, j]:g} and P[{j}, {i}] = {P[j, i]:g}")
