"""The filter of eq. 1-8, F = I, Q = r I, R = q, one measurement: KFOPC stepped in O(L^2)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from math import isfinite
from typing import Any

import numpy as np

from .._validate import as_count, as_nonnegative, require_finite
from ..kernels.covariance import Covariance, update_weights
from .covariance import RandomWalkCovariance, require_covariance
from .guards import SILENT_REFERENCE, checked_measurement
from .kfopc import KFOPC
from .read_only import ReadOnlyMatrix


class RandomWalkKFOPC(KFOPC):
    """Kalman filter of a random-walk control filter (eq. 1-8) with output power constraint, O(L^2) a sample.

    Made by `KFOPC.random_walk`. It answers as a filterpy `KalmanFilter` with
    F = I, Q = r I and R = q does, to rounding:

    - `F`, `Q` and `R` read as read-only arrays. Assign a number to `Q` or `R` to change the noise.
    - `P` reads as a full array; editing it in place counts at the next step, as in filterpy.
    - Another F or a full Q, assigned or passed, `B` with `u`, and an H of several rows hand the step to
      filterpy's own equations, at their O(L^3).
    - filterpy's fading memory ``alpha`` stays fast.
    - `dtype` is the precision that P is kept in, float64 unless float32 was asked for.

    Parameters
    ----------
    n_taps, state_noise, measurement_noise, initial_variance, rated_power, dtype, **constraint
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

    def __init__(
        self,
        n_taps: int,
        *,
        state_noise: float,
        measurement_noise: float,
        initial_variance: float = 1.0,
        rated_power: float | None = None,
        dtype: Any = np.float64,
        **constraint: Any,
    ) -> None:
        n_taps = as_count(n_taps, "n_taps")
        self.dtype = _precision(dtype)
        self._F: np.ndarray | None = None  # None: the identity
        self._Q: np.ndarray | None = None  # None: state_noise I
        self._views: dict[str, np.ndarray] = {}  # read-only F, Q, R, made when read
        self._covariance = RandomWalkCovariance(np.eye(n_taps))
        self._K: np.ndarray | None = np.zeros((n_taps, 1))  # None: derived from the last update when read
        self._delegating = False
        super().__init__(n_taps, 1, rated_power=rated_power, **constraint)
        self.state_noise = state_noise
        self.measurement_noise = measurement_noise
        variance = as_nonnegative(initial_variance, "initial_variance")
        self._covariance = RandomWalkCovariance(variance * np.eye(n_taps), self.dtype)

    def __getstate__(self) -> dict[str, Any]:
        """A copy makes its own read-only views (copied arrays are writeable) and steps its own covariance."""
        return super().__getstate__() | {"_views": {}, "_covariance": deepcopy(self._covariance)}

    # F, Q, R: numbers, read as matrices.

    @property
    def state_noise(self) -> float | None:
        """State noise variance r of eq. 4; None where a full `Q` was assigned."""
        return self._state_noise if self._Q is None else None

    @state_noise.setter
    def state_noise(self, value: float) -> None:
        self._state_noise = as_nonnegative(value, "state_noise")
        self._Q = None
        self._views.pop("Q", None)

    @property
    def measurement_noise(self) -> float:
        """Measurement noise variance q of eq. 7."""
        return self._measurement_noise

    @measurement_noise.setter
    def measurement_noise(self, value: float) -> None:
        self._measurement_noise = as_nonnegative(value, "measurement_noise")
        self._views.pop("R", None)

    @property
    def F(self) -> np.ndarray:
        """State transition, the identity (read-only) unless another was assigned."""
        return self._view("F", 1.0) if self._F is None else self._F

    @F.setter
    def F(self, value: Any) -> None:
        F = self._matrix(value, "F")
        self._F = None if np.array_equal(F, np.eye(self.dim_x)) else F

    @property
    def Q(self) -> np.ndarray:
        """State noise covariance r I, read-only unless a full one was assigned; assign a number for r."""
        return self._view("Q", self._state_noise) if self._Q is None else self._Q

    @Q.setter
    def Q(self, value: Any) -> None:
        if np.ndim(value) == 0:
            self.state_noise = as_nonnegative(value, "Q")
            return
        Q = self._matrix(value, "Q")
        if np.diagonal(Q).min() < 0:
            raise ValueError("Q must not have negative variances on its diagonal")
        if np.array_equal(Q, Q[0, 0] * np.eye(self.dim_x)):
            self.state_noise = Q[0, 0]
        else:
            self._Q = Q

    @property
    def R(self) -> np.ndarray:
        """Measurement noise variance q as (1, 1), read-only; assign a number to change it."""
        return self._view("R", self._measurement_noise, size=1)

    @R.setter
    def R(self, value: Any) -> None:
        if np.size(value) != 1:
            raise ValueError(f"R must be one variance, got shape {np.shape(value)}")
        self.measurement_noise = as_nonnegative(value, "R")

    def _view(self, name: str, value: float, size: int | None = None) -> np.ndarray:
        if name not in self._views:
            array = value * np.eye(self.dim_x if size is None else size)
            self._views[name] = ReadOnlyMatrix.of(array, name)
        return self._views[name]

    def _matrix(self, value: Any, name: str) -> np.ndarray:
        matrix = np.array(value, dtype=np.float64)
        if matrix.shape != (self.dim_x, self.dim_x):
            raise ValueError(f"{name} must have shape ({self.dim_x}, {self.dim_x}), got {matrix.shape}")
        require_finite(matrix, name)
        return matrix

    @property
    def _I(self) -> np.ndarray:
        return np.eye(self.dim_x)

    @_I.setter
    def _I(self, value: np.ndarray) -> None:
        """filterpy stores an identity; at many taps it is worth its memory only when used."""

    # P and what follows from it, made full when read.

    @property
    def P(self) -> np.ndarray:
        """State covariance, a full symmetric array; what is written into it counts at the next step."""
        return self._covariance.show()

    @P.setter
    def P(self, value: Any) -> None:
        # to filterpy's equations a number is that variance for every state
        P = self._matrix(value * np.eye(self.dim_x) if np.ndim(value) == 0 else value, "P")
        if not self._delegating:  # filterpy's own equations leave rounding, which need not be small beside P
            require_covariance(P)
        self._replace_covariance(P)

    def _replace_covariance(self, P: np.ndarray) -> None:
        self._K = self.K  # it may still be derived from the arrays to be replaced
        self._covariance = self._covariance.replaced(P)

    @property
    def P_prior(self) -> np.ndarray:
        """P(n|n-1) of the last prediction, a fresh array."""
        return self._covariance.full(self._covariance.prior)

    @P_prior.setter
    def P_prior(self, value: np.ndarray) -> None:
        self._covariance.prior = np.array(value, dtype=np.float64)

    @property
    def P_post(self) -> np.ndarray:
        """P(n|n) of the last update, a fresh array."""
        return self._covariance.full(self._covariance.posterior)

    @P_post.setter
    def P_post(self, value: np.ndarray) -> None:
        self._covariance.posterior = np.array(value, dtype=np.float64)

    @property
    def K(self) -> np.ndarray:
        """Kalman gain of the last update, (n, 1)."""
        if self._K is None:  # eq. 6, K = P x' / S
            self._K = (self._covariance.arrays.gain_direction / self.S[0, 0]).reshape(-1, 1)
        return self._K

    @K.setter
    def K(self, value: np.ndarray) -> None:
        self._K = value

    def _take_in_edits(self) -> None:
        """Take in what was written into the array that `P` showed."""
        edited = self._covariance.edited()
        if edited is not None:
            self.P = edited

    # The steps.

    @contextmanager
    def _all_or_nothing(self, name: str, **arguments: Any) -> Iterator[None]:
        """Around filterpy's own equations, which see P, F, Q as full arrays."""
        self._take_in_edits()
        with super()._all_or_nothing(name, **arguments):
            self._replace_covariance(self._covariance.full(self._covariance.now))
            self._delegating = True
            yield
            self._delegating = False

    def predict(self, u: Any = None, B: Any = None, F: Any = None, Q: Any = None) -> None:
        """Eq. 2 and 4; a full F or Q, or B with u, takes filterpy's own equations. See `KFOPC.predict`."""
        # batch_filter passes F and Q as they are read
        F = self._F if F is None or F is self._views.get("F") else F
        Q = self._Q if Q is None or Q is self._views.get("Q") else Q
        if Q is None:
            Q = self._state_noise
        moved = u is not None and (self.B if B is None else B) is not None
        if moved or F is not None or np.ndim(Q) != 0:
            super().predict(u, B, F, Q)
            return
        state_noise = Q if Q is self._state_noise else as_nonnegative(Q, "Q")
        self._take_in_edits()
        x = self._weights().reshape(np.shape(self.x))
        self._covariance.predict(self._alpha_sq, state_noise)
        self.x = x
        self.x_prior = self.x.copy()

    def update(self, z: Any, R: Any = None, H: Any = None, *, reference: float | None = None) -> None:
        """Eq. 5-9; an H of several rows, or another `inv`, takes filterpy's own equations. See `KFOPC.update`."""
        row = self.H if H is None else H
        own_inverse = self.inv is not np.linalg.inv
        if z is not None and (own_inverse or np.size(row) != self.dim_x):
            super().update(z, R, H, reference=reference)
            return
        reference = self._next_reference(z, reference)
        self._take_in_edits()
        if z is None:
            self._record(self.x, np.zeros((1, 1)))
            self.z = np.array([[None]])
            return
        R = None if R is self._views.get("R") else R
        weights, y, S = self._corrected(*self._checked(z, R, row), reference)
        self.S, self.SI, self._K = np.array([[S]]), np.array([[1.0 / S]]), None
        self._record(weights.reshape(np.shape(self.x)), np.full((1,) * np.ndim(self.x), y))
        self.z = np.array(z).reshape(self.y.shape)

    def _checked(self, z: Any, R: Any, row: Any) -> tuple[float, float, np.ndarray]:
        """z, R and H as numbers and (n,), or a clear error. The plain case, of every sample, goes first."""
        if R is None and isinstance(z, float) and isinstance(row, np.ndarray) and row.dtype == np.float64:
            h = np.ascontiguousarray(row).reshape(-1)
            if row.shape in ((self.dim_x,), (1, self.dim_x)) and isfinite(z) and isfinite(h @ h):
                return float(z), self._measurement_noise, h
        z, _, _ = checked_measurement(self, z, R, row)
        noise = self._measurement_noise if R is None else as_nonnegative(R, "R")
        return float(np.asarray(z).reshape(())), noise, np.array(row, dtype=np.float64).reshape(-1)

    def _corrected(self, z: float, noise: float, h: np.ndarray, reference: float | None) -> tuple[Any, float, float]:
        """Eq. 5-9 on the arrays: the new weights, the residual and S. Refusals come before any change."""
        constraint = self._constraint
        factor = self.constraint_factor if constraint is None else constraint.preview(z, h[0], reference)
        weights = self._weights()
        if noise == 0 and not h.any():
            raise ValueError(SILENT_REFERENCE)
        S = self._covariance.project(h) + noise
        if not 0 < S < np.inf:
            cause = "P is not positive definite on H" if S <= 0 else f"it overflows {self.dtype.name}"
            raise ValueError(f"S = H P H' + R must be positive, got {S:g}: {cause}. Nothing was changed")
        y = float(update_weights(self._covariance.arrays, weights, h, factor * z, S, noise))
        if not np.isfinite(y):
            raise ValueError(f"the weights would overflow: x = {self.x!r}, z = {z:g}, S = {S:g}. Nothing was changed")
        self._covariance.updated()
        if constraint is not None:
            constraint.advance(z, h[0], reference)
        return weights, y, S

    def _weights(self) -> np.ndarray:
        """x as an array of its own, (n,)."""
        weights = np.array(self.x, dtype=np.float64).reshape(-1)
        if weights.size != self.dim_x or not np.isfinite(weights).all():
            raise ValueError(f"x must have {self.dim_x} finite values, got shape {np.shape(self.x)}: {self.x!r}")
        return weights

    def _record(self, x: np.ndarray, y: np.ndarray) -> None:
        self._log_likelihood = self._likelihood = self._mahalanobis = None
        self.x, self.y = x, y
        self.x_post = self.x.copy()
        self._covariance.settle()

    # A whole signal at compiled speed: the arrays go out, and come back advanced.

    def compiled_state(self, to_step: bool = True) -> tuple[Covariance, tuple[float, float, float]] | None:
        """The covariance arrays, `to_step` or to read, and (r, q, fading alpha squared); None where filterpy steps."""
        if self._F is not None or self._Q is not None or self.inv is not np.linalg.inv:
            return None
        self._take_in_edits()
        arrays = self._covariance.own() if to_step else self._covariance.arrays
        return arrays, (self._state_noise, self._measurement_noise, self._alpha_sq)

    def settle_covariance(self) -> None:
        """Make P the triangle, for a block; what `P_prior` and `P_post` show stays."""
        self._K = self.K  # it may still be derived from the last update
        self._covariance.project(np.zeros(self.dim_x))

    def go_on_from(self, shared: Covariance) -> None:
        """Take the covariance `shared` with other filters without an update of one's own."""
        self._K, prior = self.K, self.P_prior
        self._covariance.share(shared)
        self._covariance.prior = prior
        self._covariance.settle()

    def after_compiled(
        self, weights: np.ndarray, z: float, y: float, S: float, shared: Covariance | None = None
    ) -> None:
        """Take back the arrays after one sample or more: `weights`, the last measurement `z`, its residual `y`, and `S`.

        `shared` are the arrays where other filters go on from them too.
        """
        if shared is not None:
            self._covariance.share(shared)
        self._covariance.after_compiled()
        self._K = None
        self.S, self.SI = np.array([[S]]), np.array([[1.0 / S]])
        shape = np.shape(self.x)
        self._record(weights.reshape(shape).copy(), np.full((1,) * len(shape), y))
        self.x_prior = self.x - (self.K * y).reshape(shape)
        self.z = np.full((1,) * len(shape), z)


def _precision(dtype: Any) -> np.dtype:
    try:
        precision = np.dtype(dtype)
    except TypeError as error:
        raise TypeError(f"dtype must be numpy.float64 or numpy.float32, got {dtype!r}") from error
    if precision not in (np.float64, np.float32):
        raise ValueError(f"dtype must be numpy.float64 or numpy.float32, got {precision}")
    return precision
