"""KFOPC: filterpy's KalmanFilter with a time-varying observation row and a scaled measurement (eq. 9-13)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from math import sqrt
from typing import TYPE_CHECKING, Any

import numpy as np
from filterpy.kalman import KalmanFilter

from ._validate import as_nonnegative, as_signal, require_finite

if TYPE_CHECKING:
    from .constraint import OutputPowerConstraint
    from .random_walk import RandomWalkKFOPC


class KFOPC(KalmanFilter):
    r"""Kalman filter with output power constraint, a drop-in `filterpy.kalman.KalmanFilter`.

    The measurement is scaled by the constraint factor before it corrects the state (eq. 9),

    .. math:: \hat w(n|n) = \hat w(n|n-1) + K(n) [\alpha \hat d(n) - x'^T(n) \hat w(n|n-1)]

    With ``rated_power=None`` and ``constraint_factor`` left at 1 it is filterpy's filter bit for bit, except that
    what would poison or break that filter (NaN, Inf, a wrong shape, a negative variance) raises before any change.

    Parameters
    ----------
    dim_x : int
        Number of states; for active noise control the taps of the control filter.
    dim_z : int, default 1
        Number of measurements; 1 with a rated power.
    dim_u : int, default 0
        Number of control inputs.
    rated_power : float, optional
        Rated output power (mean square of the control signal). None: no constraint.
    secondary_path_gain : float, optional
        Power gain G_s of the secondary path; by default it is estimated from the newest sample of H and the
        `reference` given to `update` (eq. 11).
    fs : float, default 16000
        Sample rate in Hz, which turns `power_memory` into samples.
    power_memory : float, default 0.5
        Memory of the power estimates in seconds.
    power_window : {"exponential", "sliding"}, default "exponential"
        Window of the power estimates.

    Attributes
    ----------
    z : ndarray
        Last measurement as given, unscaled.
    y : ndarray
        Residual of the scaled measurement, alpha z - H x; `S`, `K` and the likelihoods belong to it too.

    Raises
    ------
    ValueError
        A dimension out of range, a rated power with ``dim_z > 1``, a power or gain that is not positive.

    See Also
    --------
    KFOPC.random_walk : the filter of eq. 1-8 at O(L^2) a sample.

    Notes
    -----
    filterpy's ``alpha`` is its fading memory; the paper's :math:`\alpha` is `constraint_factor` here.

    References
    ----------
    J. Ji, D. Shi, B. Wang, X. Shen, Z. Luo, W.-S. Gan, "Preventing output saturation in active noise control: An
    output-constrained Kalman filter approach", eq. 1-13.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import KFOPC
    >>> kf = KFOPC(dim_x=2, rated_power=1.0, secondary_path_gain=1.0)
    >>> kf.predict()
    >>> kf.update(4.0, H=np.array([1.0, 0.5]))
    >>> kf.constraint_factor  # sqrt(1 * 1 / 4**2)
    0.25
    >>> kf.y  # 0.25 * 4 - 0
    array([[1.]])
    """

    def __init__(
        self,
        dim_x: int,
        dim_z: int = 1,
        dim_u: int = 0,
        *,
        rated_power: float | None = None,
        secondary_path_gain: float | None = None,
        fs: float | None = None,
        power_memory: float | None = None,
        power_window: str = "exponential",
    ) -> None:
        self._constraint: OutputPowerConstraint | None = None
        self._unconstrained_factor = 1.0
        self._batch_references: Iterator[float] | None = None
        settings = {"fs": fs, "memory": power_memory, "secondary_path_gain": secondary_path_gain}
        self._constraint_settings = {k: v for k, v in settings.items() if v is not None} | {"window": power_window}
        super().__init__(dim_x, dim_z, dim_u)
        self.rated_power = rated_power

    @classmethod
    def random_walk(
        cls,
        n_taps: int,
        *,
        state_noise: float,
        measurement_noise: float,
        initial_variance: float = 1.0,
        rated_power: float | None = None,
        **constraint: Any,
    ) -> RandomWalkKFOPC:
        """Filter of eq. 1-8 for a control filter that is a random walk: F = I, Q = r I, R = q, O(L^2) a sample.

        Parameters
        ----------
        n_taps : int
            Taps L of the control filter, the state.
        state_noise : float
            State noise variance r (eq. 4), zero or above.
        measurement_noise : float
            Measurement noise variance q (eq. 7), zero or above.
        initial_variance : float, default 1
            Variance of each tap before the first sample: P(0|0) = initial_variance I.
        rated_power : float, optional
            Rated output power; None: the unconstrained filter, KF-ANC.
        **constraint
            `secondary_path_gain`, `fs`, `power_memory`, `power_window`, as for `KFOPC`.

        Returns
        -------
        RandomWalkKFOPC
            A KFOPC whose `predict` and `update` cost O(L^2); subclass that class to extend it.

        Raises
        ------
        ValueError
            A negative variance, fewer than one tap, or a constraint argument out of range.

        Examples
        --------
        >>> import numpy as np
        >>> from kfopc_filterpy import KFOPC
        >>> kf = KFOPC.random_walk(4, state_noise=1e-6, measurement_noise=0.1)
        >>> kf.predict()
        >>> kf.update(1.0, H=np.array([1.0, 0.0, 0.0, 0.0]))
        >>> print(round(float(kf.x[0, 0]), 6))  # P h / (h P h + q) = 1.000001 / 1.100001
        0.909091
        """
        from .random_walk import RandomWalkKFOPC

        return RandomWalkKFOPC(
            n_taps,
            state_noise=state_noise,
            measurement_noise=measurement_noise,
            initial_variance=initial_variance,
            rated_power=rated_power,
            **constraint,
        )

    # The constraint: what can be read, and supplied by the caller instead.

    @property
    def rated_power(self) -> float | None:
        """Rated output power; assign another, or None to lift the constraint."""
        return None if self._constraint is None else self._constraint.rated_power

    @rated_power.setter
    def rated_power(self, value: float | None) -> None:
        if value is None:
            self._constraint = None
        elif self._constraint is not None:
            self._constraint.rated_power = value
        else:
            if self.dim_z != 1:
                raise ValueError(f"a rated power needs one measurement, dim_z = 1, got dim_z = {self.dim_z}")
            from .constraint import OutputPowerConstraint

            self._constraint = OutputPowerConstraint(value, **self._constraint_settings)

    @property
    def constraint(self) -> OutputPowerConstraint | None:
        """The object that keeps the powers and the factor; None without a rated power."""
        return self._constraint

    @property
    def constraint_factor(self) -> float:
        """Factor that scales the measurement; assign a value to hold it, None to follow eq. 13 again."""
        return self._unconstrained_factor if self._constraint is None else self._constraint.factor

    @constraint_factor.setter
    def constraint_factor(self, value: float | None) -> None:
        if self._constraint is not None:
            self._constraint.factor = value  # type: ignore[assignment]
        else:
            self._unconstrained_factor = 1.0 if value is None else as_nonnegative(value, "constraint_factor")

    @property
    def disturbance_power(self) -> float | None:
        """Disturbance power delta_d^2 last used (eq. 10), None without a rated power; can be supplied."""
        return None if self._constraint is None else self._constraint.disturbance_power

    @disturbance_power.setter
    def disturbance_power(self, value: float | None) -> None:
        self._require_constraint("disturbance_power").disturbance_power = value  # type: ignore[assignment]

    @property
    def secondary_path_gain(self) -> float | None:
        """Secondary-path power gain G_s last used (eq. 11), None before any is known; can be supplied."""
        return None if self._constraint is None else self._constraint.secondary_path_gain

    @secondary_path_gain.setter
    def secondary_path_gain(self, value: float | None) -> None:
        self._require_constraint("secondary_path_gain").secondary_path_gain = value

    def _require_constraint(self, name: str) -> OutputPowerConstraint:
        if self._constraint is None:
            raise ValueError(f"{name} takes part only in a constraint: set rated_power first")
        return self._constraint

    # filterpy's steps.

    def predict(self, u: Any = None, B: Any = None, F: Any = None, Q: Any = None) -> None:
        """filterpy's `predict`; arguments that would poison the filter raise before any change."""
        n = self.dim_x
        _require_matrix(self.F if F is None else F, (n, n), "F")
        _require_variance(self.Q if Q is None else Q, n, "Q")
        with self._all_or_nothing("predict", u=u, B=self.B if B is None else B):
            super().predict(u, B, F, Q)

    def predict_steadystate(self, u: Any = 0, B: Any = None) -> None:
        """filterpy's `predict_steadystate`; arguments that would poison the filter raise before any change."""
        with self._all_or_nothing("predict_steadystate", u=u, B=self.B if B is None else B):
            super().predict_steadystate(u, B)

    def update(self, z: Any, R: Any = None, H: Any = None, *, reference: float | None = None) -> None:
        """Correct the state with a measurement, scaled by the constraint factor (eq. 9).

        Parameters
        ----------
        z : float, array_like or None
            Measurement, (dim_z, 1) or what converts to it. None is a missed sample: nothing is corrected and no
            power estimate advances.
        R : float or array_like, optional
            Measurement noise variance of this step; by default `self.R`.
        H : array_like, optional
            Observation of this step, (n,) or (dim_z, n); by default `self.H`. With a rated power its first
            element is the newest filtered reference x'(n).
        reference : float, optional
            Newest reference x(n), which with x'(n) gives the secondary-path gain (eq. 11).

        Raises
        ------
        ValueError
            NaN or Inf, a wrong shape, a negative variance, a silent reference with R = 0, or a rated power with
            neither a reference nor a secondary-path gain. The filter is as it was and can go on.
        """
        reference = self._next_reference(reference)
        if z is None:
            super().update(None)
            return
        z, R, H = self._checked_measurement(z, R, H)
        self._scaled_step("update", lambda scaled: KalmanFilter.update(self, scaled, R, H), z, H, reference)

    def update_steadystate(self, z: Any, *, reference: float | None = None) -> None:
        """filterpy's `update_steadystate` with the measurement scaled; see `update`."""
        if z is None:
            super().update_steadystate(None)
            return
        z, _, _ = self._checked_measurement(z, None, None)
        step = super().update_steadystate
        self._scaled_step("update_steadystate", step, z, None, reference)

    def update_correlated(self, z: Any, R: Any = None, H: Any = None, *, reference: float | None = None) -> None:
        """filterpy's `update_correlated` with the measurement scaled; see `update`."""
        if z is None:
            super().update_correlated(None)
            return
        z, R, H = self._checked_measurement(z, R, H)
        step = super().update_correlated
        self._scaled_step("update_correlated", lambda scaled: step(scaled, R, H), z, H, reference)

    def update_sequential(
        self, start: int, z_i: Any, R_i: Any = None, H_i: Any = None, *, reference: float | None = None
    ) -> None:
        """filterpy's `update_sequential` (filterpy 2.0.0) with the measurement scaled; see `update`."""
        if not hasattr(KalmanFilter, "update_sequential"):
            raise AttributeError("this filterpy has no update_sequential: it needs filterpy 2.0.0 or later")
        require_finite(np.asarray(z_i, dtype=np.float64), "z_i")
        if H_i is not None:
            require_finite(np.asarray(H_i, dtype=np.float64), "H_i")
        length = np.size(z_i)
        _require_variance(self.R[start : start + length, start : start + length] if R_i is None else R_i, length, "R_i")

        def step(scaled: Any) -> None:
            # filterpy writes into these four in place: let it write into copies, so that all can be undone
            self.x, self.y, self.K, self.z = self.x.copy(), self.y.copy(), self.K.copy(), self.z.copy()
            KalmanFilter.update_sequential(self, start, scaled, R_i, H_i)

        rows = (self.H[start : start + length] if H_i is None else np.reshape(H_i, (length, self.dim_x)))
        self._scaled_step("update_sequential", step, z_i, rows, reference, start)

    def batch_filter(
        self,
        zs: Sequence[Any],
        Fs: Any = None,
        Qs: Any = None,
        Hs: Any = None,
        Rs: Any = None,
        Bs: Any = None,
        us: Any = None,
        update_first: bool = False,
        saver: Any = None,
        *,
        references: Any = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """filterpy's `batch_filter`, with the newest reference sample of each step in `references`.

        Parameters
        ----------
        zs, Fs, Qs, Hs, Rs, Bs, us, update_first, saver
            As in filterpy; each step of `Hs` may be (n,).
        references : array_like, optional
            (len(zs),) reference samples x(n), for a filter with a rated power.

        Returns
        -------
        means, covariances, means_predictions, covariances_predictions : ndarray
            As in filterpy.
        """
        if references is not None:
            self._batch_references = iter(as_signal(references, "references", length=len(zs)).tolist())
        try:
            return super().batch_filter(zs, Fs, Qs, Hs, Rs, Bs, us, update_first, saver)
        finally:
            self._batch_references = None

    def get_update(self, z: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """filterpy's `get_update` of the measurement scaled by the present factor; nothing changes."""
        return super().get_update(None if z is None else self._scaled(z, self.constraint_factor))

    def residual_of(self, z: Any) -> np.ndarray:
        """Residual of the measurement scaled by the present factor; nothing changes."""
        return super().residual_of(self._scaled(z, self.constraint_factor))

    def log_likelihood_of(self, z: Any) -> float:
        """Log-likelihood of the measurement scaled by the present factor; nothing changes."""
        return super().log_likelihood_of(None if z is None else self._scaled(z, self.constraint_factor))

    @property
    def mahalanobis(self) -> float:
        """Mahalanobis distance of the scaled measurement (filterpy 1.4.5's own fails on numpy 2)."""
        if self._mahalanobis is None:
            self._mahalanobis = sqrt(np.dot(np.dot(self.y.T, self.SI), self.y).item())
        return self._mahalanobis

    def __repr__(self) -> str:
        constraint = [
            f"{name} = {getattr(self, name)}"
            for name in ("rated_power", "constraint_factor", "disturbance_power", "secondary_path_gain")
        ]
        return "\n".join([super().__repr__().replace("KalmanFilter object", f"{type(self).__name__} object"), *constraint])

    # All or nothing: what a step needs checked, and how it is undone.

    def _next_reference(self, reference: float | None) -> float | None:
        if reference is None and self._batch_references is not None:
            return next(self._batch_references)
        return reference

    @staticmethod
    def _scaled(z: Any, factor: float) -> Any:
        return z if factor == 1.0 else factor * np.asarray(z)

    def _scaled_step(
        self,
        name: str,
        step: Callable[[Any], None],
        z: Any,
        H: np.ndarray | None,
        reference: float | None,
        start: int | None = None,
    ) -> None:
        """Run `step` on the scaled measurement, then let the powers advance; an error leaves all as it was."""
        sample, factor = None, self.constraint_factor
        if self._constraint is not None:
            newest = np.asarray(self.H if H is None else H).flat[0]
            sample = (np.asarray(z).reshape(()), newest, reference)
            factor = self._constraint.preview(*sample)
        with self._all_or_nothing(name):
            step(self._scaled(z, factor))
        if factor != 1.0:  # z is kept as given, in the shape that filterpy keeps it
            if start is None:
                self.z = np.reshape(z, np.shape(self.z)).copy()
            else:
                self.z[start : start + np.size(z)] = np.reshape(z, (-1, 1))
        if sample is not None and self._constraint is not None:
            self._constraint.advance(*sample)

    @contextmanager
    def _all_or_nothing(self, name: str, **arguments: Any) -> Iterator[None]:
        for argument, value in arguments.items():
            if value is not None:
                require_finite(np.asarray(value, dtype=np.float64), argument)
        before = dict(self.__dict__)
        try:
            yield
            self._require_sound(name)
        except (ValueError, TypeError) as error:
            self.__dict__.clear()
            self.__dict__.update(before)
            if isinstance(error, np.linalg.LinAlgError):
                raise ValueError(
                    f"{name}: S = H P H' + R cannot be inverted ({error}); a silent reference (H = 0) with R = 0 "
                    "tells nothing: give R > 0, or z=None for a missed sample. Nothing was changed"
                ) from error
            shapes = {key: np.shape(value) for key, value in {"x": self.x, "P": self.P, **arguments}.items()}
            raise type(error)(f"{name}: {error} (shapes: {shapes}). Nothing was changed") from error

    def _require_sound(self, name: str) -> None:
        """A step must leave x and P of their size, and finite."""
        n = self.dim_x
        if np.size(self.x) != n or np.shape(self.P) != (n, n):
            raise ValueError(f"x would become {np.shape(self.x)} and P {np.shape(self.P)}, for dim_x = {n}")
        for key in ("x", "P"):
            if not np.all(np.isfinite(getattr(self, key))):
                raise ValueError(f"{key} would hold NaN or Inf: look for them in x, P, F, Q, R, H, K before this step")

    def _checked_measurement(self, z: Any, R: Any, H: Any) -> tuple[Any, Any, np.ndarray | None]:
        """z, R and H as filterpy handles them, or a clear error."""
        n = self.dim_x
        given = self.H if H is None else H
        if H is not None or np.ndim(given) == 1:
            H = np.asarray(given)
            H = H.reshape(1, -1) if H.ndim == 1 else H
            given = H
        if np.ndim(given) != 2 or np.shape(given)[1] != n:
            raise ValueError(f"H must have shape ({n},) or (dim_z, {n}), got {np.shape(given)}")
        require_finite(given, "H")
        rows = np.shape(given)[0]
        noise = self.R if R is None else R
        _require_variance(noise, rows, "R")
        if np.shape(noise) == (1,):
            R = np.reshape(noise, (1, 1))
        return self._checked_z(z, rows, given_row=H is not None), R, H

    def _checked_z(self, z: Any, rows: int, *, given_row: bool) -> Any:
        values = np.asarray(z)
        if values.dtype.kind not in "biufc":
            raise TypeError(f"z must be a number or an array of numbers, or None for a missed sample, got {z!r}")
        shape = values.shape
        if values.size != rows or shape not in ((), (rows,), (rows, 1), (1, rows)):
            raise ValueError(f"z must have {rows} value(s), shape ({rows}, 1) or what converts to it, got shape {shape}")
        require_finite(values, "z")
        if not given_row or not shape:
            return z  # filterpy brings it into shape
        # filterpy 2.0.0 takes z as it comes where H is given: (rows,) against a column would broadcast
        wanted = (rows, 1) if np.ndim(self.x) == 2 else (rows,)
        return z if shape == wanted or (rows == 1 and len(wanted) == 2) else values.reshape(wanted)


def _require_matrix(value: Any, shape: tuple[int, int], name: str) -> None:
    if np.shape(value) != shape:
        raise ValueError(f"{name} must have shape {shape}, got {np.shape(value)}")
    require_finite(value, name)


def _require_variance(value: Any, size: int, name: str) -> None:
    """A variance: a number, or (size, size) with no negative value on its diagonal; finite."""
    if np.ndim(value) > 0 and np.size(value) > 1:
        _require_matrix(value, (size, size), name)
    else:
        require_finite(np.asarray(value, dtype=np.float64), name)
    if np.min(np.diagonal(value) if np.ndim(value) == 2 else value) < 0:
        raise ValueError(f"{name} must not be negative: it is a variance, got {value!r}")
