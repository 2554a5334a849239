"""State covariance of the random-walk filter: stored as one triangle, expanded to full arrays when they are read."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_real_array
from ..core.calls import covariance_predict
from ..core.library import at_cache_line
from ..core.triangle import Covariance, full_covariance
from .checked_steps import require_matrix, require_semidefinite

ASYMMETRY_LIMIT = 1e-8  # of the largest element: more than rounding can cause
LARGEST = float(np.finfo(np.float64).max)


# P since the last pass over the triangle T, as (scale, diagonal, weight): P = scale T + weight u u' + diagonal I.
Moment = tuple[float, float, float]
TRIANGLE: Moment = (1.0, 0.0, 0.0)  # P is T itself


class Seen(NamedTuple):
    """What an update of the core needs of a covariance."""

    owed: np.ndarray  # record of what is pending
    weights: np.ndarray  # (n,) room for the weights
    row: np.ndarray  # (n,) room for H
    places: tuple[int, int, int, int]  # the first arguments of `covariance_update`
    result: int  # its last one


class RandomWalkCovariance(Covariance):
    """P, P_prior and P_post of a random-walk filter, each expanded to a full array when read.

    The core updates `memory`. `prior` and `posterior` say how to compute P_prior and P_post from it, or are full arrays
    if that is no longer possible.
    """

    _seen: Seen | None = None  # what `seen` has found
    passes = 0  # over the triangle, so far

    def __init__(self, P: np.ndarray) -> None:
        super().__init__(0.5 * (P + P.T))
        self.prior: Moment | np.ndarray = TRIANGLE
        self.posterior: Moment | np.ndarray = TRIANGLE
        # Arrays that `show` returned since the last step, newest last, each with a copy of what it held.
        self._shown: list[tuple[np.ndarray, np.ndarray]] = []

    @property
    def seen(self) -> Seen:
        """Views and addresses, which are looked up once: that takes as long as a sample of a short filter."""
        if self._seen is None:
            weights, row = np.zeros((2, self.n))
            memory, result = self.memory.ctypes.data, self.result.ctypes.data
            places = memory, self.n, weights.ctypes.data, row.ctypes.data
            self._seen = Seen(self.owed, weights, row, places, result)
        return self._seen

    @property
    def now(self) -> Moment:
        """P at present."""
        scale, diagonal, pending, *_ = self.seen.owed.item()
        return scale, diagonal, -scale * pending

    def full(self, moment: Moment | np.ndarray) -> np.ndarray:
        """Return P at a moment, as a new full symmetric array."""
        if isinstance(moment, np.ndarray):
            return moment.copy()
        return full_covariance(self.triangle, self.direction, *moment)

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
        return {name: value for name, value in vars(self).items() if name != "_seen"}

    def __deepcopy__(self, memo: dict[int, Any]) -> RandomWalkCovariance:
        other = memo[id(self)] = object.__new__(type(self))
        other.__dict__.update(deepcopy(self.__getstate__() | {"memory": None}, memo))
        other.memory = at_cache_line(self.memory.nbytes).view(np.float64)
        other.memory[:] = self.memory
        return other

    def replaced(self, P: np.ndarray) -> RandomWalkCovariance:
        """Return a covariance that continues from another P and keeps P_prior and P_post."""
        other = RandomWalkCovariance(P)
        other.prior, other.posterior = self.full(self.prior), self.full(self.posterior)
        return other

    def predict(self, alpha_sq: float, state_noise: float) -> None:
        """Record eq. 4, P(n|n-1) = alpha^2 P(n-1|n-1) + r I, as pending for the next pass over the triangle."""
        scale, diagonal, *_ = self.seen.owed.item()
        if not alpha_sq * max(scale, diagonal) + state_noise < LARGEST:
            raise ValueError(f"P would overflow with Q = {state_noise:g}, alpha^2 = {alpha_sq:g}. Nothing was changed")
        self._shown = []
        covariance_predict(*self.seen.places[:2], state_noise, alpha_sq)
        self.prior = self.now

    def undoing(self) -> Callable[[], None]:
        """Return a function that takes back predictions from now on, unless a pass has applied them."""
        owed, prior, shown, passes = self.seen.owed.copy(), self.prior, self._shown, self.passes

        def take_back() -> None:
            if self.passes == passes:
                self.seen.owed[:], self.prior, self._shown = owed, prior, shown

        return take_back

    def before_update(self) -> tuple[Moment, Moment | np.ndarray]:
        """Return P now, and P_prior in a form that an update keeps."""
        now, prior = self.now, self.prior
        if isinstance(prior, tuple) and prior != now:  # a second update since the prediction
            prior = self.full(prior)
        return now, prior

    def projected(self, before: Moment, prior: Moment | np.ndarray) -> None:
        """Record the pass of an update, refused or not: P is still what it was `before`, but nothing is pending."""
        self.passes += 1
        self.prior = prior
        self._shown = []
        if isinstance(self.prior, tuple):
            self.prior = TRIANGLE
        if isinstance(self.posterior, tuple):  # the same P_post, computed from the triangle as it is now
            ratio = self.posterior[0] / before[0]
            self.posterior = ratio, self.posterior[1] - ratio * before[1], 0.0

    def updated(self) -> None:
        """Record an update: P is P_post, and P_prior, if it was the triangle, is P + u u'."""
        scale, diagonal, pending, *_ = self.seen.owed.item()
        if isinstance(self.prior, tuple):
            self.prior = 1.0, 0.0, 1.0 - pending
        self.posterior = scale, diagonal, -scale * pending

    def missed(self) -> None:
        """Record a missed sample: P is P_post."""
        self.posterior = self.now


def require_covariance(P: np.ndarray, name: str = "P") -> None:
    """Raise ValueError unless P is symmetric and positive semidefinite, to rounding."""
    if np.diagonal(P).min() < 0:
        raise ValueError(f"{name} must not have negative variances on its diagonal")
    difference = np.abs(P - P.T)
    if difference.max() > ASYMMETRY_LIMIT * np.abs(P).max():
        i, j = np.unravel_index(np.argmax(difference), P.shape)
        raise ValueError(f"{name} must be symmetric, but [{i}, {j}] holds {P[i, j]:g} and [{j}, {i}] {P[j, i]:g}")
    require_semidefinite(P, name)


def as_semidefinite(value: Any, size: int, name: str) -> np.ndarray:
    """Return a symmetric, positive semidefinite matrix (size, size), or raise a clear error."""
    matrix = as_real_array(value, name)
    require_matrix(matrix, (size, size), name)
    try:
        require_covariance(matrix, name)
    except ValueError as error:
        raise ValueError(f"{name} must be symmetric and positive semidefinite: {error}") from None
    return 0.5 * (matrix + matrix.T)
