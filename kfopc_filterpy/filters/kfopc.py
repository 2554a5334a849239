"""KFOPC: filterpy's KalmanFilter with a time-varying observation row and a scaled measurement (eq. 9-13)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from math import sqrt
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import ArrayLike

from .._validate import as_count, as_finite_array, as_number, require_finite
from ..checkpoint import Checkpointed
from . import checked_steps

if TYPE_CHECKING:
    from ..power.constraint import OutputPowerConstraint
    from .random_walk import RandomWalkKFOPC

ONE_CHANNEL = "kf_opc takes several loudspeakers and microphones"
EQUAL_ROWS = 10  # steps in which H may be the same: the reference of noise control changes from sample to sample
TRACKER = (
    "a rated power scales what weights drive an actuator with, and H has the newest reference samples. This filter tracks "
    "a state, which a scaled measurement would only make wrong. For an estimate within limits use "
    "kfopc_filterpy.filters.constrained; if a sensor saturates, mask its samples; if an actuator does, pass predict the "
    "input u that it delivered"
)


class Assigned:
    """An attribute of filterpy that is checked, and converted, when it is assigned: `check(kf, value, name)` returns it.

    It is no property, because filterpy's `Saver` would record a property twice. Without `__get__`, Python reads the
    attribute from the filter's `__dict__`.
    """

    def __init__(self, check: Callable[[Any, Any, str], Any]) -> None:
        self.check = check

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __set__(self, kf: Any, value: Any) -> None:
        kf.__dict__[self.name] = self.check(kf, value, self.name)


def _as_transition(kf: Any, value: Any, name: str) -> Any:
    """Return F as an array; with a rated power it must be the identity."""
    F = checked_steps.as_matrix(value, name)
    if kf._constraint is not None:
        kf._require_random_walk(F)
    return F


class KFOPC(KalmanFilter, Checkpointed):
    r"""Kalman filter with output power constraint, a drop-in `filterpy.kalman.KalmanFilter`.

    The measurement is scaled by the constraint factor before it corrects the state (eq. 9),

    .. math::

       \hat w(n|n) &= \hat w(n|n-1) \\
       &\ + K(n) [\alpha \hat d(n) - x'^T(n) \hat w(n|n-1)]

    With ``rated_power=None`` it is filterpy's filter bit for bit, except that arguments that would corrupt that filter
    (NaN, Inf, complex numbers, a wrong shape, a negative variance, a P that is not positive semidefinite) raise an error
    before anything changes. The page "What differs from filterpy" lists them.
    `F` and `H` may be nested lists, which are stored as arrays.

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
    fs : float, optional
        Sample rate in Hz, which a rated power needs, also one that is assigned later: its power estimates remember 0.5 s.
    constraint : OutputPowerConstraint, optional
        Given instead of `rated_power` and `fs` to set also the memory of the power estimates or a known secondary-path
        gain. The filter keeps a copy. By default the gain is estimated from the newest sample of H and
        the `reference` given to `update` (eq. 11).

    Attributes
    ----------
    z : ndarray
        Last measurement as given, unscaled.
    y : ndarray
        Residual of the scaled measurement, alpha z - H x. `S`, `K` and the likelihoods are those of the scaled
        measurement too.

    Raises
    ------
    TypeError
        A dimension that is not a whole number.
    ValueError
        A dimension out of range, a power or a rate that is not positive, a rated power without a rate or with several
        measurements, a constraint beside one of them.

    See Also
    --------
    KFOPC.random_walk : the filter of eq. 1-8 in O(L^2) per sample.
    kf_opc : the controller, for any number of loudspeakers, microphones and references.

    Notes
    -----
    filterpy's ``alpha`` is its fading memory; the paper's :math:`\alpha` is `constraint_factor` here.

    References
    ----------
    J. Ji, D. Shi, B. Wang, X. Shen, Z. Luo, W.-S. Gan, "Preventing output saturation in active noise control:
    An output-constrained Kalman filter approach", ICASSP 2025, pp. 1-5, eq. 1-13.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import KFOPC, OutputPowerConstraint
    >>> kf = KFOPC(dim_x=2, constraint=OutputPowerConstraint(rated_power=1.0, fs=16000, secondary_path_gain=1.0))
    >>> kf.predict()
    >>> kf.update(4.0, H=np.array([1.0, 0.5]))
    >>> kf.constraint_factor  # sqrt(1 * 1 / 4**2)
    0.25
    >>> kf.y  # 0.25 * 4 - 0
    array([[1.]])
    """

    _in_place: ClassVar[tuple[str, ...]] = ("_constraint",)  # attributes that steps write into

    x: Any  # assigned by filterpy, like the others
    y: Any
    z: Any
    K: Any
    _mahalanobis: Any
    F: Any = Assigned(_as_transition)
    H: Any = Assigned(lambda _, value, name: checked_steps.as_matrix(value, name))

    def __init__(
        self,
        dim_x: int,
        dim_z: int = 1,
        dim_u: int = 0,
        *,
        rated_power: float | None = None,
        fs: float | None = None,
        constraint: OutputPowerConstraint | None = None,
    ) -> None:
        self._constraint: Any = None
        self._settings: Any = None  # those of the next constraint: of `fs`, or of the constraint that was lifted
        self._moved = False  # by a control input
        dim_x, dim_z = as_count(dim_x, "dim_x"), as_count(dim_z, "dim_z")
        self._row = np.zeros(dim_x)  # the last H with a rated power,
        self._equal_rows = 0  # in how many steps it has been the same, and -1 once it has changed
        super().__init__(dim_x, dim_z, dim_u)
        if constraint is not None:
            if rated_power is not None or fs is not None:
                raise ValueError("give either rated_power= and fs=, or constraint=, which has both")
            self.constraint = constraint
            return
        if fs is not None:
            from ..power.constraint import OutputPowerConstraint

            self._settings = OutputPowerConstraint(1.0, fs=fs)
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
        fs: float | None = None,
        constraint: OutputPowerConstraint | None = None,
    ) -> RandomWalkKFOPC:
        """Return the filter of eq. 1-8 for a random-walk control filter: F = I, Q = r I, R = q, in O(L^2) per sample.

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
        fs, constraint : optional
            As for `KFOPC`: a rated power needs the sample rate `fs`.

        Returns
        -------
        RandomWalkKFOPC
            A KFOPC whose `predict` and `update` cost O(L^2); subclass that class to extend it. To change a noise, assign
            it, ``kf.Q = 2 * kf.Q``: numpy refuses ``kf.Q *= 2``, because the array is read-only.

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
            fs=fs,
            constraint=constraint,
        )

    # The steps.

    def predict(
        self,
        u: ArrayLike | None = None,
        B: ArrayLike | None = None,
        F: ArrayLike | None = None,
        Q: ArrayLike | None = None,
    ) -> None:
        """Run filterpy's `predict`; arguments that would corrupt the filter raise an error before anything changes."""
        if not checked_steps.is_usual_prediction(self, F, Q):
            u, B, F, Q = checked_steps.checked_prediction(self, u, B, F, Q)
        elif u is not None:
            checked_steps.require_control(self, u, B)
        if self._constraint is not None:
            self._require_random_walk(self.F if F is None else F)
        self._all_or_nothing(super().predict, checked_steps.checked_prediction, u, B, F, Q)
        self._moved = self._moved or self._has_input(u, B)

    def update(
        self,
        z: ArrayLike | None,
        R: ArrayLike | None = None,
        H: ArrayLike | None = None,
        *,
        reference: float | None = None,
    ) -> None:
        """Correct the state with a measurement, scaled by the constraint factor (eq. 9).

        Parameters
        ----------
        z : float, array_like or None
            Measurement, (dim_z, 1) or what converts to it. None is a missed sample: nothing is corrected and no power
            estimate advances. Masked components of a masked array, and None among others, are missing: the state is
            corrected by the others, with their rows of H and R. `z` is NaN there, `y` and the column of `K` are 0, and
            the likelihoods are those of the others. All masked is None.
        R : float or array_like, optional
            Measurement noise variance of this step; by default `self.R`.
        H : array_like, optional
            Observation of this step, (n,) or (dim_z, n); by default `self.H`. With a rated power, its first element is
            the newest filtered reference x'(n).
        reference : float, optional
            Newest reference x(n), which with x'(n) gives the secondary-path gain (eq. 11).

        Raises
        ------
        ValueError
            NaN or Inf, a wrong shape, a negative variance, a P that is not positive semidefinite, a silent reference
            with R = 0, or a rated power with neither a reference nor a secondary-path gain. The filter is unchanged and
            can continue.
        TypeError
            A measurement that is not a real number.

        Examples
        --------
        >>> import numpy as np
        >>> from kfopc_filterpy import KFOPC
        >>> kf = KFOPC(dim_x=2, dim_z=2)
        >>> kf.H = np.eye(2)
        >>> kf.update(np.ma.masked_invalid([4.0, np.nan]))  # the second component is missing
        >>> kf.x.ravel(), kf.z.ravel()
        (array([2., 0.]), array([ 4., nan]))
        """
        missing, z = None, checked_steps.with_masks(z)
        if isinstance(z, np.ma.MaskedArray):
            z, R, H, missing = checked_steps.without_masked(self, z, R, H)
        if z is None:
            super().update(None)
        elif self._constraint is None and reference is None and checked_steps.is_usual_measurement(self, z, R, H):
            self._all_or_nothing(super().update, checked_steps.checked_measurement, z, R, H)
        else:
            z, R, H = checked_steps.checked_measurement(self, z, R, H)
            self._scaled_step(super().update, z, R, H, H=H, reference=reference)
        if missing is not None:
            self.z[missing] = np.nan

    def predict_steadystate(self, u: ArrayLike = 0, B: ArrayLike | None = None) -> None:
        """Run filterpy's `predict_steadystate`; arguments that would corrupt the filter raise an error first."""
        if self._constraint is not None:
            self._require_random_walk(self.F)
        checked_steps.require_control(self, u, B)
        self._all_or_nothing(super().predict_steadystate, None, u, B)
        self._moved = self._moved or self._has_input(u, B)

    def update_steadystate(self, z: ArrayLike | None, *, reference: float | None = None) -> None:
        """Run filterpy's `update_steadystate` with the measurement scaled; see `update`."""
        if z is None:
            super().update_steadystate(None)
            return
        checked_steps.require_matrix(self.K, (self.dim_x, self.dim_z), "K")
        z, _, _ = checked_steps.checked_measurement(self, z, None, None)
        self._scaled_step(super().update_steadystate, z, H=None, reference=reference)

    def update_correlated(
        self,
        z: ArrayLike | None,
        R: ArrayLike | None = None,
        H: ArrayLike | None = None,
        *,
        reference: float | None = None,
    ) -> None:
        """Run filterpy's `update_correlated` with the measurement scaled; see `update`. `M` is (dim_x, dim_z)."""
        if z is None:
            super().update_correlated(None)
            return
        checked_steps.require_matrix(self.M, (self.dim_x, self.dim_z), "M")
        z, R, H = checked_steps.checked_measurement(self, z, R, H)
        self._scaled_step(super().update_correlated, z, R, H, H=H, reference=reference)

    def update_sequential(
        self,
        start: int,
        z_i: ArrayLike,
        R_i: ArrayLike | None = None,
        H_i: ArrayLike | None = None,
        *,
        reference: float | None = None,
    ) -> None:
        """Run filterpy's `update_sequential` (filterpy 2.0.0) with the measurement scaled; see `update`."""
        if not hasattr(KalmanFilter, "update_sequential"):
            raise AttributeError("this filterpy has no update_sequential: it needs filterpy 2.0.0 or later")
        length = np.size(z_i)
        if not 0 <= start <= start + length <= self.dim_z:
            raise ValueError(
                f"z_i must stay within the dim_z = {self.dim_z} measurements, got {length} from start = {start} on"
            )
        checked_steps.require_measurement(z_i, length)
        rows = self.H[start : start + length] if H_i is None else np.reshape(H_i, (length, self.dim_x))
        require_finite(rows, "H_i")
        noise = self.R[start : start + length, start : start + length] if R_i is None else R_i
        checked_steps.require_variance(noise, length, "R_i")
        if not np.any(rows) and not np.any(noise):
            raise ValueError(checked_steps.SILENT_REFERENCE)

        def update_sequential(scaled: Any, R_i: Any, H_i: Any) -> None:
            # filterpy writes into these four in place: give it copies, so that the step can be undone
            self.x, self.y, self.K = self.x.copy(), self.y.copy(), self.K.copy()
            self.z = np.array(self.z).reshape(self.dim_z, 1)
            KalmanFilter.update_sequential(self, start, scaled, R_i, H_i)

        self._scaled_step(update_sequential, z_i, R_i, H_i, H=rows, reference=reference)

    def _scaled_step(self, step: Callable[..., None], z: Any, *others: Any, H: Any, reference: Any) -> None:
        """Run a step on the scaled measurement (eq. 9), then accept its powers; an error leaves the filter unchanged."""
        factor = 1.0
        reference = None if reference is None else as_number(reference, "reference")
        if self._constraint is not None:
            if np.size(z) != 1:
                raise ValueError(f"a rated power needs one measurement, got {np.size(z)}; {ONE_CHANNEL}")
            row = np.ravel(self.H if H is None else H)
            self._require_random_walk(self.F)
            self._require_other_row(row)
            factor = self._constraint.preview(float(np.asarray(z).item()), row[0], reference)
        self._all_or_nothing(step, None, self._scaled(z, factor), *others)
        if factor != 1.0:  # store z as given, not scaled, in filterpy's shape
            self.z = np.reshape(z, np.shape(self.z)).copy()
        if self._constraint is not None:
            self._constraint.accept()
            self._note_row(row)

    # The constraint: its values can be read, or supplied by the caller.

    @property
    def rated_power(self) -> float | None:
        """Rated output power; assign another, or None to lift the constraint."""
        return None if self._constraint is None else self._constraint.rated_power

    @rated_power.setter
    def rated_power(self, value: float | None) -> None:
        if value is None:
            self._settings, self._constraint = self._constraint or self._settings, None
        elif self._constraint is not None:
            self._constraint.rated_power = value
        elif self._settings is None:
            raise ValueError(
                "a rated power needs the sample rate, for its power estimates: give fs= where the filter is made, or "
                "assign kf.constraint = OutputPowerConstraint(rated_power, fs=...)"
            )
        else:
            self.constraint = self._settings.fresh(value)

    @property
    def constraint(self) -> Any:
        """Constraint that computes the powers and the factor; None without a rated power. Assignment stores a copy."""
        return self._constraint

    @constraint.setter
    def constraint(self, value: OutputPowerConstraint | None) -> None:
        from ..power.constraint import OutputPowerConstraint

        if value is None:
            self.rated_power = None
            return
        if not isinstance(value, OutputPowerConstraint):
            raise TypeError(f"constraint must be an OutputPowerConstraint or None, got {value!r}; {ONE_CHANNEL}")
        if self.dim_z != 1:
            raise ValueError(f"a rated power needs one measurement, dim_z = 1, got dim_z = {self.dim_z}; {ONE_CHANNEL}")
        self._require_random_walk(self.F)
        self._constraint = deepcopy(value)

    @property
    def constraint_factor(self) -> float:
        """Factor that scales the measurement; assign a value from 0 to 1 to fix it, None to follow eq. 13 again."""
        return 1.0 if self._constraint is None else self._constraint.factor

    @constraint_factor.setter
    def constraint_factor(self, value: float | None) -> None:
        self._require_constraint("constraint_factor").factor = value

    @property
    def disturbance_power(self) -> float | None:
        """Disturbance power delta_d^2 last used (eq. 10), None without a rated power; can be supplied."""
        return None if self._constraint is None else self._constraint.disturbance_power

    @disturbance_power.setter
    def disturbance_power(self, value: float | None) -> None:
        self._require_constraint("disturbance_power").disturbance_power = value

    @property
    def secondary_path_gain(self) -> float | None:
        """Secondary-path power gain G_s last used (eq. 11), None before any is known; can be supplied."""
        return None if self._constraint is None else self._constraint.secondary_path_gain

    @secondary_path_gain.setter
    def secondary_path_gain(self, value: float | None) -> None:
        self._require_constraint("secondary_path_gain").secondary_path_gain = value

    def _require_constraint(self, name: str) -> Any:
        if self._constraint is None:
            raise ValueError(f"{name} needs a constraint: set rated_power first")
        return self._constraint

    # A rated power is for weights that drive an actuator, not for a state that is tracked.

    def _require_random_walk(self, F: Any) -> None:
        """Raise an error if F is not the identity."""
        if not np.array_equal(F, self._I if np.ndim(F) else 1.0):
            raise ValueError(f"with a rated power, F must be the identity: {TRACKER}")

    def _require_other_row(self, H: Any) -> None:
        """Raise an error if H does not change."""
        if self._equal_rows >= EQUAL_ROWS and np.any(H) and np.array_equal(H, self._row):
            raise ValueError(
                f"with a rated power, H must change, but was the same in {EQUAL_ROWS} steps. Is the reference sensor "
                f"connected? Otherwise: {TRACKER}"
            )

    def _note_row(self, H: Any) -> None:
        """Count the steps with the same H, until there is another."""
        if self._equal_rows >= 0:
            row = np.array(H, dtype=np.float64)
            same = self._equal_rows == 0 or np.array_equal(row, self._row)
            self._row, self._equal_rows = row, self._equal_rows + 1 if same else -1

    # Batches, the smoother, and what changes nothing.

    def batch_filter(
        self,
        zs: Sequence[Any] | np.ndarray,
        Fs: Sequence[Any] | np.ndarray | None = None,
        Qs: Sequence[Any] | np.ndarray | None = None,
        Hs: Sequence[Any] | np.ndarray | None = None,
        Rs: Sequence[Any] | np.ndarray | None = None,
        Bs: Sequence[Any] | np.ndarray | None = None,
        us: Sequence[Any] | np.ndarray | None = None,
        update_first: bool = False,
        saver: Any = None,
        *,
        references: ArrayLike | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Run filterpy's `batch_filter`, with the newest reference sample of each step in `references`.

        Parameters
        ----------
        zs : sequence or numpy.ma.MaskedArray
            As in filterpy: a sample of None is missing. So are masked components, and None among others, as in `update`.
        Fs, Qs, Hs, Rs, Bs, us, update_first, saver
            As in filterpy; each step of `Hs` may be (n,).
        references : array_like, optional
            (len(zs),) reference samples x(n), for a filter with a rated power.

        Returns
        -------
        means, covariances, means_predictions, covariances_predictions : ndarray
            As in filterpy.

        Raises
        ------
        ValueError
            As `predict` and `update`; the filter is then as it was before the batch.

        Examples
        --------
        >>> import numpy as np
        >>> from kfopc_filterpy import KFOPC
        >>> kf = KFOPC(dim_x=1)
        >>> kf.H = [[1.0]]
        >>> zs = np.ma.masked_invalid([1.0, np.nan, 1.0])
        >>> kf.batch_filter(zs)[0].ravel().round(2)  # the second sample is missing
        array([0.67, 0.67, 0.91])
        """
        n = len(zs)
        # filterpy's batch, unlike its steps, takes a number in Q and R as a multiple of the identity
        Qs, Rs = (
            [own] * n if given is None and np.ndim(own) == 0 else given for given, own in ((Qs, self.Q), (Rs, self.R))
        )
        lists = {"Fs": Fs, "Qs": Qs, "Hs": Hs, "Rs": Rs, "Bs": Bs, "us": us}
        for name, given in lists.items():
            if given is not None and len(given) < n:  # filterpy would stop there and leave zeros
                raise ValueError(f"{name} must have one value for each of the {n} of zs, got {len(given)}")
        steps = zip(zs, *([None] * n if given is None else given for given in lists.values()), strict=False)
        samples: Any = [None] * n if references is None else as_finite_array(references, "references")
        if np.shape(samples)[:1] != (n,):
            raise ValueError(f"references must have {n} values, got shape {np.shape(samples)}")
        means, means_p = np.zeros((2, n, *np.shape(self.x)))
        covariances, covariances_p = np.zeros((2, n, self.dim_x, self.dim_x))
        before = self._snapshot()
        try:
            for i, (z, F, Q, H, R, B, u) in enumerate(steps):
                for updates in (update_first, not update_first):
                    if updates:
                        self.update(z, R, H, reference=samples[i])
                        means[i], covariances[i] = self.x, self.P
                    else:
                        self.predict(u, B, F, Q)
                        means_p[i], covariances_p[i] = self.x, self.P
                if saver is not None:
                    saver.save()
        except BaseException as error:
            self._go_back(before)
            if not isinstance(error, ValueError | TypeError):
                raise
            kind = TypeError if isinstance(error, TypeError) else ValueError
            raise kind(f"step {i} of the batch: {error}") from error
        return means, covariances, means_p, covariances_p

    def rts_smoother(
        self,
        Xs: ArrayLike,
        Ps: ArrayLike,
        Fs: Sequence[Any] | np.ndarray | None = None,
        Qs: Sequence[Any] | np.ndarray | None = None,
        inv: Callable[[np.ndarray], np.ndarray] = np.linalg.inv,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Run filterpy's `rts_smoother`; what it leaves out is refused.

        Parameters
        ----------
        Xs, Ps : array_like, shapes (n_samples, dim_x[, 1]) and (n_samples, dim_x, dim_x)
            Means and covariances that `batch_filter` returned, without `update_first`.
        Fs, Qs : sequence, optional
            Those that `batch_filter` got.
        inv : callable, optional
            As in filterpy.

        Returns
        -------
        x, P, K, Pp : ndarray
            As in filterpy.

        Raises
        ------
        ValueError
            NaN or Inf, wrong shapes, a fading memory (``alpha``), or a filter that control inputs have moved.

        Examples
        --------
        >>> import numpy as np
        >>> from kfopc_filterpy import KFOPC
        >>> kf = KFOPC(dim_x=1)
        >>> kf.H = [[1.0]]
        >>> means, covariances, _, _ = kf.batch_filter([0.0, 5.0, 10.0])
        >>> print(kf.rts_smoother(means, covariances)[0].ravel().round(2))
        [1.9  4.76 7.38]
        """
        n, size = len(Xs), self.dim_x  # type: ignore[arg-type]
        x, P = as_finite_array(Xs, "Xs"), as_finite_array(Ps, "Ps")
        if x.shape not in ((n, size, 1), (n, size)) or P.shape != (n, size, size):
            raise ValueError(f"Xs must be (n, {size}[, 1]) and Ps (n, {size}, {size}), got {x.shape} and {P.shape}")
        if self.alpha != 1.0:
            raise ValueError(f"alpha must be 1, got {self.alpha:g}: filterpy's smoother leaves the fading memory out")
        if self._moved:
            raise ValueError(
                "control inputs moved this filter, and filterpy's smoother leaves them out: make what drives the state a "
                "part of it, or smooth the samples of a filter that had no inputs"
            )
        for name, given in (("Fs", Fs), ("Qs", Qs)):
            if given is not None:
                checked_steps.require_matrix(given, (n, size, size), name)
        return super().rts_smoother(x, P, Fs, Qs, inv)

    def get_prediction(
        self,
        u: ArrayLike | None = None,
        B: ArrayLike | None = None,
        F: ArrayLike | None = None,
        Q: ArrayLike | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return x and P as `predict` would leave them, or raise its error; nothing changes."""
        before = self.__dict__.copy()  # predictions write into no array
        try:
            self.predict(u, B, F, Q)
            return self.x, self.P
        finally:
            self._go_back(before)

    def get_update(self, z: ArrayLike | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return filterpy's `get_update` of the measurement scaled by the present factor; nothing changes."""
        return super().get_update(None if z is None else self._presently_scaled(z, self.dim_z))

    def residual_of(self, z: ArrayLike) -> np.ndarray:
        """Return the residual of the measurement scaled by the present factor; nothing changes."""
        return super().residual_of(self._presently_scaled(z, self.dim_z))

    def log_likelihood_of(self, z: ArrayLike | None) -> float:
        """Return the log-likelihood of the measurement scaled by the present factor; nothing changes."""
        return super().log_likelihood_of(None if z is None else self._presently_scaled(z, len(self.S)))

    def _presently_scaled(self, z: Any, size: int) -> Any:
        checked_steps.require_unmasked(z)
        if np.size(z) != size:
            raise ValueError(f"z must have {size} value(s), got shape {np.shape(z)}")
        return self._scaled(z, self.constraint_factor)

    @staticmethod
    def _scaled(z: Any, factor: float) -> Any:
        return z if factor == 1.0 else np.float64(factor) * np.asarray(z)  # a float32 in double precision, too

    @property
    def alpha(self) -> float:
        """filterpy's fading memory, 1 or above; not the constraint factor."""
        return super().alpha

    @alpha.setter
    def alpha(self, value: float) -> None:
        as_number(as_number(value, "alpha") * value, "the square of alpha")
        KalmanFilter.alpha.fset(self, value)

    @property
    def mahalanobis(self) -> float:
        """Mahalanobis distance of the scaled measurement (filterpy 1.4.5's own fails on numpy 2)."""
        if self._mahalanobis is None:
            self._mahalanobis = sqrt(np.dot(np.dot(self.y.T, self.SI), self.y).item())
        return self._mahalanobis

    # All or nothing: a step is checked first, and undone if it fails.

    def _all_or_nothing(self, step: Callable[..., None], checks: checked_steps.Checks | None, *arguments: Any) -> None:
        self._take_in_edits()
        checked_steps.run_or_undo(self, step, arguments, checks)

    def _take_in_edits(self) -> None:
        """Check P if it was assigned or written into since the last step, so that other steps do not pay for it."""
        P = np.asarray(self.P).tobytes()
        known = P in (np.asarray(self.P_post).tobytes(), np.asarray(self.P_prior).tobytes())
        if not known or type(self.P) is not np.ndarray:
            self._require_covariance()

    def _require_covariance(self) -> None:
        checked_steps.require_semidefinite(self.P, "P")

    def _has_input(self, u: Any, B: Any) -> bool:
        """Return whether a control input moves the state."""
        given = u is not None and (self.B if B is None else B) is not None
        return given and (np.ma.is_masked(u) or bool(np.any(u)))  # a masked input is refused, not left out

    def _snapshot(self) -> dict[str, Any]:
        """Return the attributes, with copies of what steps write in place."""
        return self.__dict__ | {name: deepcopy(self.__dict__[name]) for name in self._in_place}

    def _go_back(self, attributes: dict[str, Any]) -> None:
        """Put back the attributes of a snapshot."""
        self.__dict__.clear()
        self.__dict__.update(attributes)

    def __repr__(self) -> str:
        own = ("rated_power", "constraint_factor", "disturbance_power", "secondary_path_gain")
        parts = [super().__repr__().replace("KalmanFilter object", f"{type(self).__name__} object")]
        return "\n".join([*parts, *(f"{name} = {getattr(self, name)}" for name in own)])
