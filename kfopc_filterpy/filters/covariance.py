"""State covariance of the random-walk filter: stored as one triangle, expanded to full arrays when they are read."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np

from ..kernels.covariance import Covariance, copy_covariance, full_covariance, new_covariance
from ..kernels.holding import Held
from ..power.constraint import ConstraintState
from .guards import INDEFINITE_LIMIT, require_semidefinite

ASYMMETRY_LIMIT = 1e-8  # of the largest element: more than rounding can cause


# P since the last pass over the triangle T, as (scale, diagonal, weight): P = scale T + weight g g' + diagonal I.
Moment = tuple[float, float, float]
TRIANGLE: Moment = (1.0, 0.0, 0.0)  # P is T itself


class FilterArrays(NamedTuple):
    """Arrays that an update changes, beside the weights."""

    covariance: Covariance
    constraint: ConstraintState | None  # None in a filter without a rated power


class RandomWalkCovariance:
    """P, P_prior and P_post of a random-walk filter, each expanded to a full array when read.

    The compiled functions update `arrays`. `prior` and `posterior` say how to compute P_prior and P_post from it, or
    are full arrays if that is no longer possible.
    """

    _held: Held | None = None

    def __init__(self, P: np.ndarray, dtype: Any = np.float64) -> None:
        self.arrays: Covariance = new_covariance(0.5 * (P + P.T), dtype)
        self.prior: Moment | np.ndarray = TRIANGLE
        self.posterior: Moment | np.ndarray = TRIANGLE
        # Arrays that `show` returned since the last step, newest last, each with a copy of what it held.
        self._shown: list[tuple[np.ndarray, np.ndarray]] = []
        self._largest = float(np.finfo(dtype).max)
        self._others_read = False  # other filters share the arrays

    def share(self, arrays: Covariance) -> None:
        """Continue from arrays that other filters share; a filter copies them before its first step."""
        self.arrays, self._others_read, self._shown = arrays, True, []

    def own(self) -> Covariance:
        """Return the arrays for writing, copied first if other filters share them."""
        if self._others_read:
            self.arrays, self._others_read = copy_covariance(self.arrays), False
        return self.arrays

    @property
    def now(self) -> Moment:
        """P at present."""
        scale, diagonal, inverse_S, *_ = self.arrays.owed.item()
        return scale, diagonal, -scale * inverse_S

    def full(self, moment: Moment | np.ndarray) -> np.ndarray:
        """Return P at a moment, as a new full symmetric array."""
        if isinstance(moment, np.ndarray):
            return moment.copy()
        if moment == TRIANGLE and not self.arrays.owed["last_inverse_S"][0]:  # a new filter: nothing to compile yet
            n = self.arrays.product.size
            lower = np.tril(self.arrays.triangle[:n, :n].astype(np.float64))
            return lower + np.tril(lower, -1).T
        return full_covariance(self.arrays.triangle, self.arrays.gain_direction, *moment)

    def show(self) -> np.ndarray:
        """Return P as a new full array; values written into it take effect at the next step (see `edited`)."""
        P = self._shown[-1][0].copy() if self._shown else self.full(self.now)
        self._shown.append((P, P.copy()))
        return P

    def edited(self) -> np.ndarray | None:
        """Return the newest array from `show` that was written into, None if none was."""
        for P, shown in reversed(self._shown):
            if not np.array_equal(P, shown):
                return P
        return None

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for a copy or a file, which holds arrays of its own."""
        return {name: value for name, value in vars(self).items() if name != "_held"}

    def __deepcopy__(self, memo: dict[int, Any]) -> RandomWalkCovariance:
        other = memo[id(self)] = object.__new__(type(self))
        other.__dict__.update(deepcopy(self.__getstate__() | {"arrays": None}, memo))
        other.arrays = copy_covariance(self.arrays)
        return other

    def replaced(self, P: np.ndarray) -> RandomWalkCovariance:
        """Return a covariance that continues from another P and keeps P_prior and P_post."""
        other = RandomWalkCovariance(P, self.arrays.triangle.dtype)
        other.prior, other.posterior = self.full(self.prior), self.full(self.posterior)
        return other

    def predict(self, alpha_sq: float, state_noise: float) -> None:
        """Record eq. 4, P(n|n-1) = alpha^2 P(n-1|n-1) + r I, as pending for the next pass over the triangle."""
        owed = self.own().owed
        scale, diagonal, inverse_S, *_ = owed.item()
        if not alpha_sq * max(scale, diagonal) + state_noise < self._largest:
            raise ValueError(f"P would overflow with Q = {state_noise:g}, alpha^2 = {alpha_sq:g}. Nothing was changed")
        self._shown = []
        scale, diagonal = alpha_sq * scale, alpha_sq * diagonal + state_noise
        owed["scale"], owed["diagonal"] = scale, diagonal
        self.prior = scale, diagonal, -scale * inverse_S

    def before_update(self, constraint: ConstraintState | None) -> tuple[Held, Moment, Moment | np.ndarray]:
        """Return held `FilterArrays` for a compiled update, P now, and P_prior in a form that the update keeps."""
        now, prior = self.now, self.prior
        if isinstance(prior, tuple) and prior != now:  # a second update since the prediction
            prior = self.full(prior)
        return self._hold(self.own(), constraint), now, prior

    def _hold(self, arrays: Covariance, constraint: ConstraintState | None) -> Held:
        held = self._held
        if held is None or held.state.covariance is not arrays or held.state.constraint is not constraint:
            self._held = held = Held(FilterArrays(arrays, constraint))
        return held

    def projected(self, before: Moment, prior: Moment | np.ndarray) -> None:
        """Record the pass of an update, refused or not: P is still what it was `before`, but nothing is pending."""
        self.prior = prior
        self._shown = []
        if isinstance(self.prior, tuple):
            self.prior = TRIANGLE
        if isinstance(self.posterior, tuple):  # the same P_post, computed from the triangle as it is now
            ratio = self.posterior[0] / before[0]
            self.posterior = ratio, self.posterior[1] - ratio * before[1], 0.0

    def updated(self) -> None:
        """Record an update: P is P_post, and P_prior, if it was the triangle, is P + g g'/S."""
        scale, diagonal, inverse_S, last_inverse_S, *_ = self.arrays.owed.item()
        if isinstance(self.prior, tuple):
            self.prior = 1.0, 0.0, last_inverse_S - inverse_S
        self.posterior = scale, diagonal, -scale * inverse_S

    def missed(self) -> None:
        """Record a missed sample: P is P_post."""
        self.posterior = self.now

    def after_compiled(self) -> None:
        """Record that the compiled loop updated `arrays`: at most one downdate is pending."""
        self._shown = []
        self.prior = TRIANGLE
        self.updated()


def require_covariance(P: np.ndarray, dtype: np.dtype) -> None:
    """Raise ValueError unless P is symmetric and positive semidefinite, to the rounding of `dtype`."""
    if np.diagonal(P).min() < 0:
        raise ValueError("P must not have negative variances on its diagonal")
    difference = np.abs(P - P.T)
    if difference.max() > ASYMMETRY_LIMIT * np.abs(P).max():
        i, j = np.unravel_index(np.argmax(difference), P.shape)
        raise ValueError(f"P must be symmetric, but P[{i}, {j}] = {P[i, j]:g} and P[{j}, {i}] = {P[j, i]:g}")
    require_semidefinite(P, "P", max(INDEFINITE_LIMIT, 100 * float(np.finfo(dtype).eps)))
