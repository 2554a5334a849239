"""The filter of eq. 1-8, F = I, Q = r I, R = q, one measurement: KFOPC stepped in O(L^2)."""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite, log, nan, pi, sqrt
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_count, as_nonnegative, as_number
from ..core.block import LOUD_STEP, NO_SOLUTION
from ..core.calls import covariance_update
from ..power.constraint import OutputPowerConstraint
from . import checked_steps
from .covariance import RandomWalkCovariance, require_covariance
from .kfopc import KFOPC

# A filter's variances, and the results of its last update.
NUMBERS = np.dtype(
    [(name, np.float64) for name in ("state_noise", "measurement_noise", "measurement", "residual", "variance")]
)


def _made_when_read(name: str, make: Callable[[Any], np.ndarray], description: str) -> Any:
    """Return a property that is computed from the last update's results, unless it was assigned since."""

    def get(kf: Any) -> Any:
        if name not in kf._made:
            assign(kf, make(kf))
        return kf._made[name]

    def assign(kf: Any, value: Any) -> None:
        kf._made = {**kf._made, name: value}  # another dictionary: the one before may be kept, to undo a step

    return property(get, assign, doc=description)


class _Identity:
    """filterpy's `_I`: an identity matrix that is made when it is used, since it is large at many taps."""

    def __get__(self, kf: Any, owner: Any = None) -> Any:
        return self if kf is None else np.eye(kf.dim_x)

    def __set__(self, kf: Any, value: Any) -> None:
        """Ignore the value."""


class RandomWalkKFOPC(KFOPC):
    """Kalman filter of a random-walk control filter (eq. 1-8) with output power constraint, O(L^2) per sample.

    Made by `KFOPC.random_walk`. To rounding, it behaves like a filterpy `KalmanFilter` with F = I, Q = r I and R = q:

    - `F`, `Q` and `R` are returned as read-only arrays. Assign a number to `Q` or `R` to change the noise.
    - `P` is returned as a full array; editing it in place takes effect at the next step, as in filterpy. A P that is
      not positive semidefinite is refused, which costs O(L^3), but only when P is assigned or edited.
    - If another F or a full Q is assigned or passed, or with `B` and `u`, or an H of several rows, the step uses
      filterpy's own equations, in O(L^3).
    - filterpy's fading memory ``alpha`` stays fast.

    Parameters
    ----------
    n_taps, state_noise, measurement_noise, initial_variance, rated_power, constraint
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

    _written_into = (*KFOPC._written_into, "_covariance", "_numbers")
    _log_likelihood: Any

    if not TYPE_CHECKING:  # Out of `Saver`'s records, filterpy's own private attributes included.
        __slots__ = (
            *("_F", "_K", "_Q", "_alpha_sq", "_covariance", "_delegating", "_likelihood", "_log_likelihood", "_made"),
            *("_mahalanobis", "_numbers", "_views"),
        )

    def __init__(
        self,
        n_taps: int,
        *,
        state_noise: float,
        measurement_noise: float,
        initial_variance: float = 1.0,
        rated_power: float | None = None,
        constraint: OutputPowerConstraint | None = None,
    ) -> None:
        n_taps = as_count(n_taps, "n_taps")
        self._F: np.ndarray | None = None  # None: the identity
        self._Q: np.ndarray | None = None  # None: state_noise I
        self._views: dict[str, np.ndarray] = {}  # read-only F, Q, R, made when read
        self._covariance = RandomWalkCovariance(np.eye(n_taps))
        self._K: np.ndarray | None = np.zeros((n_taps, 1))  # None: derived from the last update when read
        self._delegating = False
        self._numbers = np.array([(0.0, 0.0, 0.0, 0.0, nan)], NUMBERS)
        self._made: dict[str, Any] = {}  # those of y, z, S, SI and x_prior read or assigned since the last update
        super().__init__(n_taps, 1, rated_power=rated_power, constraint=constraint)
        self.state_noise = state_noise
        self.measurement_noise = measurement_noise
        variance = as_nonnegative(initial_variance, "initial_variance")
        self._covariance = RandomWalkCovariance(variance * np.eye(n_taps))

    def __getstate__(self) -> checked_steps.State:
        """Return the state for a deep copy or a file, without views (copied views would be writeable)."""
        attributes, private = super().__getstate__()
        return attributes, private | {"_views": {}}

    def _noises(self) -> list[str]:
        state_noise = "full Q" if self.state_noise is None else f"state noise {self.state_noise:g}"
        return [state_noise, f"measurement noise {self.measurement_noise:g}"]

    # F, Q, R: numbers, read as matrices.

    @property
    def state_noise(self) -> float | None:
        """State noise variance r of eq. 4; None if a full `Q` was assigned."""
        return float(self._numbers["state_noise"][0]) if self._Q is None else None

    @state_noise.setter
    def state_noise(self, value: float) -> None:
        self._numbers["state_noise"] = as_nonnegative(value, "state_noise")
        self._Q = None
        self._views.pop("Q", None)

    @property
    def measurement_noise(self) -> float:
        """Measurement noise variance q of eq. 7."""
        return float(self._numbers["measurement_noise"][0])

    @measurement_noise.setter
    def measurement_noise(self, value: float) -> None:
        self._numbers["measurement_noise"] = as_nonnegative(value, "measurement_noise")
        self._views.pop("R", None)

    @property
    def F(self) -> np.ndarray:
        """State transition, the identity (read-only) unless another was assigned."""
        return self._view("F", 1.0) if self._F is None else self._F

    @F.setter
    def F(self, value: ArrayLike) -> None:
        F = self._matrix(value, "F")
        self._F = None if np.array_equal(F, np.eye(self.dim_x)) else F

    @property
    def Q(self) -> np.ndarray:
        """State noise covariance r I, read-only unless a full one was assigned; assign a number for r."""
        return self._view("Q", self._numbers["state_noise"][0]) if self._Q is None else self._Q

    @Q.setter
    def Q(self, value: ArrayLike) -> None:
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
        return self._view("R", self._numbers["measurement_noise"][0], size=1)

    @R.setter
    def R(self, value: ArrayLike) -> None:
        if np.size(value) != 1:
            raise ValueError(f"R must be one variance, got shape {np.shape(value)}")
        self.measurement_noise = as_nonnegative(value, "R")

    def _view(self, name: str, value: float, size: int | None = None) -> np.ndarray:
        if name not in self._views:
            self._views[name] = value * np.eye(self.dim_x if size is None else size)
            self._views[name].flags.writeable = False
        return self._views[name]

    def _matrix(self, value: Any, name: str) -> np.ndarray:
        matrix = np.array(value, dtype=np.float64)
        checked_steps.require_matrix(matrix, (self.dim_x, self.dim_x), name)
        return matrix

    _I = _Identity()

    # P and the values that follow from it, computed when read.

    @property
    def P(self) -> np.ndarray:
        """State covariance, a full symmetric array; values written into it take effect at the next step."""
        return self._covariance.show()

    @P.setter
    def P(self, value: ArrayLike) -> None:
        # as in filterpy's equations, a number is the variance of every state
        given: Any = value
        P = self._matrix(given * np.eye(self.dim_x) if np.ndim(given) == 0 else given, "P")
        if not self._delegating:  # the rounding of filterpy's own equations need not be small beside P
            require_covariance(P)
        self._replace_covariance(P)

    def _replace_covariance(self, P: np.ndarray) -> None:
        self._K = self.K  # compute it before the arrays that it derives from are replaced
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
            u, S = self._covariance.direction, self._numbers["variance"][0]
            self._K = (u / sqrt(S) if S > 0 else np.zeros_like(u)).reshape(-1, 1)
        return self._K

    @K.setter
    def K(self, value: np.ndarray) -> None:
        self._K = value

    y = _made_when_read("y", lambda kf: kf._as_measured("residual"), "Residual of the last update, alpha z - H x.")
    z = _made_when_read("z", lambda kf: kf._as_measured("measurement"), "Measurement of the last update, unscaled.")
    S = _made_when_read("S", lambda kf: kf._numbers["variance"].reshape(1, 1).copy(), "Innovation variance, (1, 1).")
    SI = _made_when_read("SI", lambda kf: 1.0 / kf.S, "Inverse of S.")
    x_prior = _made_when_read("x_prior", lambda kf: kf._before_update(), "State before the last update.")

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of the last measurement; of a single one in closed form."""
        if self._log_likelihood is None and self.S.shape == (1, 1) and self.S[0, 0] > 0:
            y, S = self.y.item(), self.S.item()
            self._log_likelihood = -0.5 * (log(2.0 * pi * S) + y * y / S)
        return super().log_likelihood

    def _as_measured(self, name: str) -> np.ndarray:
        value = self._numbers[name]
        return value.reshape((1,) * np.ndim(self.x)).copy()

    def _before_update(self) -> np.ndarray:
        return self.x_post - (self.K * self._numbers["residual"][0]).reshape(np.shape(self.x_post))

    def _take_in_edits(self) -> None:
        """Apply what was written into an array that `P` returned."""
        edited = self._covariance.edited()
        if edited is not None:
            self.P = edited

    # The steps.

    def _all_or_nothing(self, step: Callable[..., None], checks: checked_steps.Checks | None, *arguments: Any) -> None:
        """Run filterpy's own equations, which see P, F, Q as full arrays."""
        self._take_in_edits()
        before = checked_steps.state_of(self)
        try:
            self._replace_covariance(self._covariance.full(self._covariance.now))
            self._delegating = True
            checked_steps.run_or_undo(self, step, arguments, checks)
            self._delegating = False
        except BaseException:
            checked_steps.restore(self, before)
            raise

    def predict(
        self,
        u: ArrayLike | None = None,
        B: ArrayLike | None = None,
        F: ArrayLike | None = None,
        Q: ArrayLike | None = None,
    ) -> None:
        """Apply eq. 2 and 4; a full F or Q, or B with u, uses filterpy's own equations. See `KFOPC.predict`."""
        # batch_filter passes F and Q as they are read
        F = self._F if F is None or F is self._views.get("F") else F
        Q = self._Q if Q is None or Q is self._views.get("Q") else Q
        moved = u is not None and (self.B if B is None else B) is not None
        if moved or F is not None or (Q is not None and np.ndim(Q) != 0):
            super().predict(u, B, F, self._numbers["state_noise"][0] if Q is None else Q)
            return
        state_noise = self._numbers["state_noise"][0] if Q is None else as_nonnegative(Q, "Q")
        self._take_in_edits()
        x = self._weights()
        self._covariance.predict(self._alpha_sq, state_noise)
        self.x, self.x_prior = x, x.copy()

    def update(
        self,
        z: ArrayLike | None,
        R: ArrayLike | None = None,
        H: ArrayLike | None = None,
        *,
        reference: ArrayLike | None = None,
    ) -> None:
        """Apply eq. 5-9; an H of several rows, or another `inv`, uses filterpy's own equations. See `KFOPC.update`."""
        if isinstance(z, np.ma.MaskedArray) and z.size == 1:  # several are left to `KFOPC.update`
            z, R, H, _ = checked_steps.without_masked(self, z, R, H)
        row: Any = self.H if H is None else H
        measurement: Any
        own_inverse = self.inv is not np.linalg.inv
        if z is not None and (own_inverse or np.size(row) != self.dim_x):
            super().update(z, R, H, reference=reference)
            return
        reference = self._next_reference(z, reference)
        self._take_in_edits()
        if z is None:
            self._covariance.missed()
            self._record(self.x)
            self.y, self.z = np.zeros((1, 1)), np.array([[None]])
            return
        plain = R is None and type(z) is float and type(row) is np.ndarray and row.dtype == np.float64
        if plain and row.shape in ((self.dim_x,), (1, self.dim_x)):  # fast path: the usual types in a loop over samples
            measurement, noise, h = z, self._numbers["measurement_noise"][0], np.ascontiguousarray(row).reshape(-1)
        else:
            measurement, noise, h = self._checked(z, R, row)
        weights = self._corrected(measurement, noise, h, reference)
        self._record(weights)
        if measurement is not z:
            self.z = np.array(z).reshape(self.y.shape)

    def _checked(self, z: Any, R: Any, row: Any) -> tuple[float, float, np.ndarray]:
        """Return z, R and H as numbers and (n,), or raise a clear error."""
        R = None if R is self._views.get("R") else R
        z, _, _ = checked_steps.checked_measurement(self, z, R, row)
        noise = self.measurement_noise if R is None else as_nonnegative(R, "R")
        return float(np.asarray(z).reshape(())), noise, np.array(row, dtype=np.float64).reshape(-1)

    def _corrected(self, z: float, noise: float, h: np.ndarray, reference: Any) -> np.ndarray:
        """Apply eq. 5-9; return the new weights. A refused update raises before anything changes."""
        constraint, covariance = self._constraint, self._covariance
        seen = covariance.seen
        x = np.asarray(self.x)
        if x.size != self.dim_x:
            self._weights()  # raises
        seen.weights[:], seen.row[:] = x.reshape(-1), h
        if not isfinite(z + np.vdot(h, h) + np.vdot(seen.weights, seen.weights)):
            self._weights()  # raises if one of them is not finite
            checked_steps.checked_measurement(self, z, None, h)
        factor = self._unconstrained_factor if constraint is None else constraint.preview(z, h[0], reference)
        if noise == 0.0 and not h.any():
            raise ValueError(checked_steps.SILENT_REFERENCE)
        before, prior = covariance.before_update()
        result = covariance.result
        result[1] = nan
        answer = covariance_update(*seen.places, factor * z, noise, seen.result)
        y, S = result.tolist()
        if S == S:  # the pass over P has begun
            covariance.projected(before, prior)
        if answer == LOUD_STEP:
            raise ValueError(f"the weights would overflow: x = {self.x!r}, z = {z:g}, S = {S:g}. Nothing was changed")
        if answer == NO_SOLUTION:
            cause = "P is not positive definite on H" if S <= 0 else "it overflows"
            raise ValueError(f"S = H P H' + R must be positive, got {S:g}: {cause}. Nothing was changed")
        if constraint is not None:
            constraint.advance(z, h[0], reference)
        covariance.updated()
        self._K, self._made = None, {name: value for name, value in self._made.items() if name == "x_prior"}
        self._numbers["measurement"], self._numbers["residual"], self._numbers["variance"] = z, y, S
        return seen.weights.reshape(x.shape).copy()

    def _own_constraint(self, value: Any) -> OutputPowerConstraint:
        """Return a copy of a constraint; there is one loudspeaker."""
        if isinstance(value, list | tuple):
            raise TypeError(
                "this filter has one loudspeaker, so its rated power or constraint must be one, not a sequence of "
                f"{len(value)}: for several, use KFOPC(dim_x, dim_z), or kf_opc with secondary paths (K, J, taps)"
            )
        return super()._own_constraint(value)

    def _checked_reference(self, reference: Any) -> float:
        """Return a reference as a number; there is one."""
        return as_number(reference, "reference")

    def _weights(self) -> np.ndarray:
        """Return x as a new array of its shape."""
        weights = np.array(self.x, dtype=np.float64)
        # A finite sum of squares is quick to compute and implies finite weights. If it overflows, check each weight.
        if weights.size != self.dim_x or not (isfinite(np.vdot(weights, weights)) or np.isfinite(weights).all()):
            raise ValueError(f"x must have {self.dim_x} finite values, got shape {np.shape(self.x)}: {self.x!r}")
        return weights

    def _record(self, x: np.ndarray) -> None:
        self._log_likelihood = self._likelihood = self._mahalanobis = None
        self.x, self.x_post = x, x.copy()
