"""The filter of eq. 1-8, F = I, Q = r I, R = q, one measurement: KFOPC stepped in O(L^2) by two functions of BLAS."""

from __future__ import annotations

from functools import cached_property
from math import inf, isfinite, sqrt
from sys import float_info
from typing import Any, ClassVar

import numpy as np
from numpy.linalg import inv
from numpy.typing import ArrayLike
from scipy.linalg.blas import dasum, daxpy, ddot, dsymv, dsyr

from .._validate import as_count, as_finite_array, as_nonnegative, as_number, require_finite
from ..power.constraint import OutputPowerConstraint
from . import checked_steps
from .checked_steps import FLOAT
from .kfopc import KFOPC, Assigned

# In rounding errors of the largest variance. For an h of energy 1, an h'P h below BLUR is nothing but rounding. From then
# on the state noise is at least LEAST_NOISE: without it, rounding would make P indefinite, and each step more so.
BLUR, LEAST_NOISE = 16 * float_info.epsilon, 2 * float_info.epsilon
MADE_BY_UPDATE = ("P", "P_post", "K", "S", "SI", "y", "z")


def _as_state(kf: Any, value: ArrayLike, name: str) -> np.ndarray:
    """Return x as a real array, (n,) or (n, 1)."""
    x, n = as_finite_array(value, name), kf.dim_x
    if x.shape not in ((n,), (n, 1)):
        raise ValueError(f"{name} would become {x.shape}, for {n} states")
    return x


def _as_multiple(kf: Any, value: ArrayLike, name: str) -> np.ndarray:
    """Return F, Q or R as a matrix, and note whether it is a multiple of the identity; then it cannot be written into."""
    n, given = 1 if name == "R" else kf.dim_x, as_finite_array(value, name)
    matrix = given * np.eye(n) if given.ndim == 0 or given.size == n == 1 else np.array(given)
    checked_steps.require_matrix(matrix, (n, n), name)
    if name != "F":
        checked_steps.require_variance(matrix, n, name)
    elif kf._constraint is not None:
        kf._require_random_walk(matrix)
    multiple = float(matrix[0, 0]) if name != "F" else 1.0
    plain = np.array_equal(matrix, multiple * np.eye(n))
    matrix.flags.writeable = not plain
    kf.__dict__[f"_{name}"] = multiple if plain else None
    return matrix


class _Covariance(cached_property[np.ndarray]):
    """P: made when it is read after a step, and checked when it is assigned."""

    def __set__(self, kf: Any, value: ArrayLike) -> None:
        P, n = as_finite_array(value, "P"), kf.dim_x
        P = P * np.eye(n) if P.ndim == 0 else P  # a number is the variance of every state, as in filterpy's equations
        checked_steps.require_matrix(P, (n, n), "P")
        kf.__dict__["P"] = P


class RandomWalkKFOPC(KFOPC):
    """Kalman filter of a random-walk control filter (eq. 1-8) with output power constraint, O(L^2) per sample.

    Made by `KFOPC.random_walk`. To rounding, it behaves like a filterpy `KalmanFilter` with F = I, Q = r I and R = q:

    - `F`, `Q` and `R` are returned as read-only arrays. Assign a number to `Q` or `R` to change the noise.
    - What is written into `P` counts at the next step, as in filterpy. A `P` that is not symmetric and positive
      semidefinite is refused then, which costs O(L^3), but only after `P` was assigned or written into.
    - The default `H` is zeros, as in filterpy, and corrects nothing: pass another one to `update`, or assign it.
    - If another F or a full Q is assigned or passed, or with `B` and `u`, or an H of several rows, the step uses
      filterpy's own equations, in O(L^3).

    Parameters
    ----------
    n_taps, state_noise, measurement_noise, initial_variance, rated_power, fs, constraint
        As for `KFOPC.random_walk`.

    Examples
    --------
    >>> from kfopc_filterpy import KFOPC
    >>> kf = KFOPC.random_walk(2, state_noise=0.5, measurement_noise=1.0)
    >>> kf.predict()
    >>> kf.P
    array([[1.5, 0. ],
           [0. , 1.5]])
    >>> kf.P *= 10
    >>> kf.update(1.0, H=[1.0, 0.0])
    >>> kf.S  # 15 + 1
    array([[16.]])
    """

    _in_place: ClassVar[tuple[str, ...]] = (*KFOPC._in_place, "_triangle")

    x: Any = Assigned(_as_state)
    F: Any = Assigned(_as_multiple)
    Q: Any = Assigned(_as_multiple)
    R: Any = Assigned(_as_multiple)

    def __init__(
        self,
        n_taps: int,
        *,
        state_noise: float,
        measurement_noise: float,
        initial_variance: float = 1.0,
        rated_power: float | None = None,
        fs: float | None = None,
        constraint: OutputPowerConstraint | None = None,
    ) -> None:
        n_taps = as_count(n_taps, "n_taps")
        super().__init__(n_taps, 1, rated_power=rated_power, fs=fs, constraint=constraint)
        self.Q = as_nonnegative(state_noise, "state_noise")
        self.R = as_nonnegative(measurement_noise, "measurement_noise")
        variance = as_nonnegative(initial_variance, "initial_variance")
        # P = scale T + diagonal I, of which T is a symmetric matrix with only its lower triangle
        self._triangle, self._scale, self._diagonal = variance * np.eye(n_taps), 1.0, 0.0
        self._bound = variance  # at least the largest variance in P
        self._blurred = False  # h'P h was nothing but rounding
        self._predicted = False  # P is P_prior
        self._gain, self._last = np.zeros(n_taps), (0.0, 0.0, 0.0)  # K of the last update; its z, y and S
        del self.__dict__["P"]

    # The steps.

    def predict(
        self,
        u: ArrayLike | None = None,
        B: ArrayLike | None = None,
        F: ArrayLike | None = None,
        Q: ArrayLike | None = None,
    ) -> None:
        """Apply eq. 2 and 4; a full F or Q, or B with u, uses filterpy's own equations. See `KFOPC.predict`."""
        self._look_at_copies()
        noise = self._Q if Q is None else as_nonnegative(Q, "Q") if np.ndim(Q) == 0 else None
        if noise is None or F is not None or self._F is None or self._has_input(u, B):
            super().predict(u, B, F, Q)
            return
        self._take_in_edits()
        if not isfinite(dasum(self.x)):
            require_finite(self.x, "x")
        fading, bound = self._alpha_sq, self._bound
        if not isfinite(fading * bound + noise):
            bound = self._largest_variance()
            if not isfinite(fading * bound + noise):
                raise ValueError(f"P would overflow with Q = {noise:g}, alpha^2 = {fading:g}. Nothing was changed")
        # eq. 4: P(n|n-1) = P(n-1|n-1) + r I, which the update applies; the fading memory is filterpy's
        self._scale, self._diagonal = fading * self._scale, fading * self._diagonal + noise
        self._bound, self._predicted = fading * bound + noise, True
        self._forget("P", "P_prior")
        self.__dict__["x"] = self.x.copy()  # eq. 2
        self.x_prior = self.x.copy()

    def update(
        self,
        z: ArrayLike | None,
        R: ArrayLike | None = None,
        H: ArrayLike | None = None,
        *,
        reference: float | None = None,
    ) -> None:
        """Apply eq. 5-9; an H of several rows, or another `inv`, uses filterpy's own equations. See `KFOPC.update`."""
        plain = self._plain(z, R, H)
        if plain is None:
            super().update(z, R, H, reference=reference)
            return
        d, noise, h = plain
        self._take_in_edits()
        T, x, constraint = self._triangle, self.x, self._constraint
        energy = ddot(h, h)
        if not isfinite(d + energy):
            checked_steps.checked_measurement(self, d, None, h)  # raises unless only the energy overflows
        factor = 1.0
        if constraint is not None:  # eq. 10-13
            self._require_other_row(h)
            factor = constraint.preview(d, h[0], reference)
        elif reference is not None:
            as_number(reference, "reference")
        diagonal, bound, blurred = self._diagonal, self._bound, self._blurred
        if blurred:
            diagonal = max(diagonal, LEAST_NOISE * self._largest_variance())
        u = dsymv(self._scale, T.T, h, diagonal, h)  # P(n|n-1) x'
        variance = ddot(h, u)
        if variance < BLUR * energy * bound < inf:
            bound = self._largest_variance()  # which `bound` may exceed by far
            lost = BLUR * energy * bound
            blurred = blurred or variance < lost
            if variance < 0.0 or variance + noise < lost:  # the sample tells nothing
                u, variance = np.zeros_like(h), max(lost - noise, 0.0)
        S = variance + noise  # eq. 7
        if not float_info.min <= S < inf:
            if noise == 0.0 and not h.any():
                raise ValueError(checked_steps.SILENT_REFERENCE)
            cause = "P is not positive definite on H, or 1/S overflows" if S < 1.0 else "it overflows"
            raise ValueError(f"S = H P H' + R must be positive, got {S:g}: {cause}. Nothing was changed")
        y = factor * d - ddot(h, x)  # eq. 9
        K = u / S  # eq. 6
        weights = daxpy(K, x.copy(), a=y)  # eq. 5
        if not isfinite(dasum(weights)) and not np.isfinite(weights).all():
            require_finite(x, "x")
            raise ValueError(f"the weights would overflow: x = {x!r}, z = {d:g}, S = {S:g}. Nothing was changed")
        if not self._predicted:
            _ = self.P_prior  # of which P is another one by now: kept as it is
        if self._scale != 1.0:
            T *= self._scale
        T.reshape(-1)[:: self.dim_x + 1] += diagonal
        self._triangle = dsyr(-1.0 / S, u, a=T.T, overwrite_a=1).T  # eq. 8
        if constraint is not None:
            constraint.accept()
            self._note_row(h)
        self._forget(*MADE_BY_UPDATE)
        if self._predicted:
            self._forget("P_prior")
        self._scale, self._diagonal, self._bound, self._blurred, self._predicted = 1.0, 0.0, bound, blurred, False
        self._gain, self._last = K, (d, y, S)
        self.__dict__["x"], self.x_post = weights, weights.copy()
        self._log_likelihood = self._likelihood = self._mahalanobis = None

    def _plain(self, z: Any, R: Any, H: Any) -> tuple[float, float, np.ndarray] | None:
        """Return z, R and H as numbers and (n,); None for a missed sample, several rows of H or another `inv`."""
        n, row = self.dim_x, self.H if H is None else H
        self._look_at_copies()
        if isinstance(z, np.ma.MaskedArray) and z.size == 1:
            z = None if np.ma.is_masked(z) else z.data
        if z is None or self.inv is not inv or np.size(row) != n:
            return None
        usual_z = isinstance(z, float) or (type(z) is np.ndarray and z.dtype == FLOAT and z.shape in ((), (1,), (1, 1)))
        usual_H = type(row) is np.ndarray and row.dtype == FLOAT and row.shape in ((n,), (1, n))
        if not usual_z or not usual_H or R is not None:
            z, _, _ = checked_steps.checked_measurement(self, z, R, row)
        noise = self._R if R is None else as_nonnegative(R, "R")
        return float(np.asarray(z).item()), noise, np.ascontiguousarray(row, FLOAT).reshape(n)

    # What follows from T and the last update: made when it is read, and then kept until the next step.

    def _full(self, scale: float, diagonal: float) -> np.ndarray:
        """Return scale T + diagonal I as a full symmetric array."""
        P = np.tril(self._triangle)
        P += np.tril(P, -1).T
        P *= scale
        P.reshape(-1)[:: self.dim_x + 1] += diagonal
        return P

    def _largest_variance(self) -> float:
        return self._scale * float(self._triangle.reshape(-1)[:: self.dim_x + 1].max()) + self._diagonal

    P: Any = _Covariance(lambda kf: kf._full(kf._scale, kf._diagonal))

    @cached_property
    def P_prior(self) -> np.ndarray:
        """P(n|n-1) of the last prediction."""
        if self._predicted:
            return self._full(self._scale, self._diagonal)
        u = self._gain * sqrt(self._last[2])
        return self._full(1.0, 0.0) + np.outer(u, u)

    @cached_property
    def P_post(self) -> np.ndarray:
        """P(n|n) of the last update."""
        return self._full(1.0, 0.0)

    @cached_property
    def K(self) -> np.ndarray:
        """Kalman gain of the last update, (n, 1) (eq. 6)."""
        return self._gain.reshape(-1, 1).copy()

    z = cached_property(lambda kf: np.full((1,) * kf.x_post.ndim, kf._last[0]))
    y = cached_property(lambda kf: np.full((1,) * kf.x_post.ndim, kf._last[1]))
    S = cached_property(lambda kf: np.full((1, 1), kf._last[2]))
    SI = cached_property(lambda kf: 1.0 / kf.S)

    @property
    def _read(self) -> None:
        """Make all of them: filterpy's `Saver` reads the properties for that before it copies the attributes."""
        for name in ("P_prior", *MADE_BY_UPDATE):
            getattr(self, name)

    def _forget(self, *names: str) -> None:
        for name in names:
            self.__dict__.pop(name, None)

    def _take_in_edits(self) -> None:
        """Take over a P that was written into or assigned since the last step."""
        P = self.__dict__.get("P")
        if P is not None and not np.array_equal(P, self._full(self._scale, self._diagonal)):
            super()._take_in_edits()  # reads, and so makes, P_prior and P_post of the P before
            self._triangle, self._scale, self._diagonal = np.array(P), 1.0, 0.0
            self._bound, self._predicted = self._largest_variance(), False

    def _require_covariance(self) -> None:
        checked_steps.as_covariance(self.P, self.dim_x, "P")

    def _look_at_copies(self) -> None:
        """Take F, Q and R anew from matrices that can be written into: those of a copy of the filter."""
        for name in ("F", "Q", "R"):
            if self.__dict__[name].flags.writeable:
                setattr(self, name, self.__dict__[name])
