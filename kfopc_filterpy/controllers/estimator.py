"""Any Kalman filter of filterpy as the adaptation of the control filter."""

from __future__ import annotations

import numpy as np
from filterpy.kalman import KalmanFilter

from ..filters.kfopc import KFOPC
from ..plant import Secondary
from ..power.amplifiers import Amplifier
from ..power.constraint import OutputPowerConstraint
from ..power.limiter import OutputLimiter
from .core_controller import CoreController


class KalmanController(CoreController):
    """The modified ANC structure around a filterpy filter: any `KalmanFilter` of one measurement.

    In each sample, the estimator gets the disturbance estimate as z and the filtered reference as H. With a rated
    power this is KF-OPC, without one KF-ANC. `kf_anc` and `kf_opc` return the same in C, which is much faster.

    Parameters
    ----------
    estimator : filterpy.kalman.KalmanFilter
        Filter whose state is the control filter, ``dim_z = 1``; a `KFOPC`, or filterpy's own.
    secondary : array_like, shape (n_taps,), control system, Recording or Plant
        Estimated secondary path.
    amplifier : amplifier model, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.
    name : str, optional
        Name in results and legends; by default KF-OPC with a rated power, else KF-ANC.
    limiter : OutputLimiter, optional
        Limiter of the control signal, not shared with another controller. No window of the control signal then exceeds
        the limiter's rated power.

    Raises
    ------
    TypeError
        An estimator that is not a filterpy KalmanFilter.
    ValueError
        An estimator of several measurements.

    Examples
    --------
    >>> from filterpy.kalman import KalmanFilter
    >>> from kfopc_filterpy import KalmanController
    >>> controller = KalmanController(KalmanFilter(dim_x=4, dim_z=1), [1.0])
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)
    >>> float(controller.weights[0])  # K z = P / (P + R) z with P = I + Q = 2, R = 1
    1.3333333333333333
    """

    takes_guard = False  # the estimator gets one measurement in a sample

    def __init__(
        self,
        estimator: KalmanFilter,
        secondary: Secondary,
        *,
        amplifier: Amplifier | None = None,
        name: str | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        if not isinstance(estimator, KalmanFilter):
            raise TypeError(f"estimator must be a filterpy KalmanFilter, got {type(estimator).__name__}")
        if estimator.dim_z != 1:
            raise ValueError(
                f"estimator must have one measurement, dim_z = 1, got dim_z = {estimator.dim_z}; "
                "kf_anc and kf_opc take several microphones"
            )
        self.estimator = estimator
        super().__init__(
            name or ("KF-ANC" if getattr(estimator, "rated_power", None) is None else "KF-OPC"),
            "signals_alone",
            estimator.dim_x,
            secondary,
            settings={},
            n_references=None,
            amplifier=amplifier,
            limiter=limiter,
        )

    def _read_rated_power(self) -> float | None:
        return getattr(self.estimator, "rated_power", None)

    def _take_rated_power(self, value: np.ndarray) -> None:
        self.estimator.rated_power = value.item()  # a user's filter may keep it as it comes

    @property
    def weights(self) -> np.ndarray:
        """Estimator's state w, (L,); a copy."""
        return np.array(self.estimator.x, dtype=np.float64).reshape(-1)

    @property
    def constraint(self) -> OutputPowerConstraint:
        """Constraint of the estimator, or else one that computes the powers, its factor fixed at the estimator's."""
        theirs = self.estimator.constraint if isinstance(self.estimator, KFOPC) else None
        if theirs is not None:
            return theirs
        if self._own_constraint.factor != self.constraint_factor:
            self._own_constraint.factor = self.constraint_factor
        return self._own_constraint

    @property
    def constraint_factor(self) -> float:
        """Constraint factor of the last sample."""
        return getattr(self.estimator, "constraint_factor", 1.0)

    def _after_new_path(self, before: np.ndarray) -> None:
        """Let P grow by the variance that the new path gives to the weights."""
        variance = self._variance_by_new_path(before)
        if variance > 0.0:
            self.estimator.P = self.estimator.P + variance * np.eye(self.n_taps)

    def control_signal(self, reference: float | None) -> float:
        """Return the control signal y(n) for the newest reference sample x(n), from the weights of the last sample."""
        weights = self._by_channel("weights")
        before = weights.copy()
        weights[:] = np.reshape(self.estimator.x, -1)
        try:
            return super().control_signal(reference)
        except BaseException:
            weights[:] = before
            raise

    def update(self, error: float) -> None:
        """Let the estimator predict and update (eq. 2-9) with the error e(n) that the last control signal left."""
        super().update(error)
        block, estimator = self._block, self.estimator
        d, x = float(block.fields["disturbance"].item()), float(block.latest("reference").flat[0])
        h, powers = block.latest("filtered_reference").reshape(1, -1)[:, : self.n_taps].copy(), self.constraint
        before = estimator.__dict__.copy()  # predictions write into no array
        try:
            estimator.predict()
            if isinstance(estimator, KFOPC):
                estimator.update(d, H=h, reference=x)
            else:
                estimator.update(np.full((1,) * np.ndim(estimator.x), d), H=h)
        except BaseException:  # the prediction must not stay
            estimator.__dict__.clear()
            estimator.__dict__.update(before)
            raise
        if powers is self._own_constraint:
            powers.advance(d, h[0, 0], x)

    def _listen(self, references: np.ndarray, errors: np.ndarray, adapting: np.ndarray) -> None:
        if self.constraint is self._own_constraint:
            super()._listen(references, errors, adapting)
            return
        block = self._block
        for n, e in enumerate(errors):
            super()._listen(references[n : n + 1], errors[n : n + 1], adapting[n : n + 1])
            if adapting[n]:
                filtered = float(block.latest("filtered_reference").flat[0])
                reference = float(block.latest("reference").flat[0])
                self.constraint.advance(float(e), filtered, reference)  # silent: d^ = e
