"""A filterpy filter with a power budget: a random-walk Kalman filter, and the best control filter within the power."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..power.budget import DEFAULT_AVERAGING_S, DEFAULT_CORRELATION_MEMORY_S, PowerBudget
from ..power.constraint import DEFAULT_FS, OutputPowerConstraint
from .random_walk import RandomWalkKFOPC


class PowerBudgetKalmanFilter(RandomWalkKFOPC):
    r"""Kalman filter that spends a rated output power optimally and keeps to it; a filterpy `KalmanFilter`.

    The state `x` is the estimate of the unconstrained control filter (eq. 1-8, without KF-OPC's constraint factor).
    `control_filter` drives the actuator. Of all filters of its length within the rated power, it has the least error:
    it is the power-constrained Wiener solution for that estimate and the recent signals (`PowerBudget`).

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter, the state.
    state_noise, measurement_noise, initial_variance
        r, q and P(0|0) = initial_variance I, see `KFOPC.random_walk`.
    rated_power : float
        Rated output power (mean square of the control signal).
    fs, memory_s, averaging_s, guard
        See `PowerBudget`.

    Raises
    ------
    ValueError
        Arguments that `KFOPC.random_walk` or `PowerBudget` refuses.

    See Also
    --------
    kf_pb : the same filter in an active-noise-control controller.

    Notes
    -----
    A Kalman filter with a second observation per sample, a control signal of zero with variance ``q / lambda``, has the
    same fixed point. But after a change of lambda that filter must forget what it learnt before, which takes its whole
    memory. Here lambda takes effect at once.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.filters import PowerBudgetKalmanFilter
    >>> kf = PowerBudgetKalmanFilter(2, state_noise=1e-9, measurement_noise=0.01, rated_power=1.0)
    >>> row = np.zeros(2)
    >>> for x in np.random.default_rng(0).standard_normal(16000):
    ...     row = np.array([x, row[0]])  # the secondary path is a wire: the filtered reference is the reference
    ...     y = kf.control_signal(x)
    ...     kf.predict()
    ...     kf.update(3.0 * row[0] + row[1], H=row, reference=x)
    >>> kf.x.ravel().round(2)  # without a limit: power 10
    array([3., 1.])
    >>> kf.control_filter.round(1)
    array([0.9, 0.3])
    """

    _written_into = (*RandomWalkKFOPC._written_into, "_budget")

    if not TYPE_CHECKING:
        __slots__ = ("_budget",)

    def __init__(
        self,
        n_taps: int,
        *,
        state_noise: float,
        measurement_noise: float,
        rated_power: float,
        initial_variance: float = 1.0,
        fs: float = DEFAULT_FS,
        memory_s: float = DEFAULT_CORRELATION_MEMORY_S,
        averaging_s: float = DEFAULT_AVERAGING_S,
        guard: Any = None,
    ) -> None:
        self._budget: PowerBudget | None = None
        super().__init__(
            n_taps,
            state_noise=state_noise,
            measurement_noise=measurement_noise,
            initial_variance=initial_variance,
        )
        self._budget = PowerBudget(
            n_taps,
            rated_power,
            fs=fs,
            memory_s=memory_s,
            averaging_s=averaging_s,
            guard=guard,
        )

    @property
    def budget(self) -> PowerBudget:
        """Power budget that finds the control filter."""
        assert self._budget is not None
        return self._budget

    @property
    def rated_power(self) -> float | None:
        """Rated output power; can be assigned."""
        return None if self._budget is None else self._budget.rated_power

    @rated_power.setter
    def rated_power(self, value: float | None) -> None:
        if self._budget is not None:
            self._budget.rated_power = value  # type: ignore[assignment]  # None is refused there
        elif value is not None:
            raise ValueError("rated_power belongs to the power budget")

    @property
    def control_filter(self) -> np.ndarray:
        """Control filter v within the rated power, (L,), zero before the first sample; a copy."""
        return self.budget.control_filter

    @property
    def power_weight(self) -> float:
        """Weight lambda of the control power; 0: the estimate fits the budget as it is, Inf: it was scaled to fit."""
        return self.budget.power_weight

    @property
    def constraint_factor(self) -> float:
        """Always 1: the control filter keeps the power, the estimate is not scaled."""
        return 1.0

    @constraint_factor.setter
    def constraint_factor(self, value: float | None) -> None:
        if value not in (None, 1.0):
            raise ValueError(f"constraint_factor is 1 in a power budget, got {value!r}: assign rated_power instead")

    def control_signal(self, reference: float) -> float:
        """Return the control signal y(n) for the `reference` x(n); call it before `update` with the same x(n)."""
        return self.budget.control_signal(reference)

    def update(
        self,
        z: Any,
        R: Any = None,
        H: Any = None,
        *,
        reference: float | None = None,
        control_signal: float | None = None,
    ) -> None:
        """Correct the state with a measurement, then update the control filter.

        Parameters
        ----------
        z, R, H
            See `KFOPC.update`; H is the filtered reference x'(n), newest sample first. If z is None, a missed sample,
            nothing advances, and the power emitted in that sample is not accounted for.
        reference : float
            Newest reference x(n).
        control_signal : float, optional
            Emitted control signal, if it is not `control_filter` applied to the reference, for example after a limiter.

        Raises
        ------
        ValueError
            As `KFOPC.update`, or no reference. The filter is unchanged and can continue.
        """
        self._spend(lambda: super(PowerBudgetKalmanFilter, self).update(z, R, H), z, H, reference, control_signal)

    def update_steadystate(
        self, z: Any, *, reference: float | None = None, control_signal: float | None = None
    ) -> None:
        """Run filterpy's `update_steadystate`, then update the control filter; see `update`."""
        step = super().update_steadystate
        self._spend(lambda: step(z), z, None, reference, control_signal)

    def update_correlated(
        self,
        z: Any,
        R: Any = None,
        H: Any = None,
        *,
        reference: float | None = None,
        control_signal: float | None = None,
    ) -> None:
        """Run filterpy's `update_correlated`, then update the control filter; see `update`."""
        step = super().update_correlated
        self._spend(lambda: step(z, R, H), z, H, reference, control_signal)

    def update_sequential(
        self,
        start: int,
        z_i: Any,
        R_i: Any = None,
        H_i: Any = None,
        *,
        reference: float | None = None,
        control_signal: float | None = None,
    ) -> None:
        """Run filterpy's `update_sequential` (filterpy 2.0.0), then update the control filter; see `update`."""
        step = super().update_sequential
        self._spend(lambda: step(start, z_i, R_i, H_i), z_i, H_i, reference, control_signal)

    def _spend(
        self, step: Callable[[], None], z: Any, H: Any, reference: float | None, control_signal: float | None
    ) -> None:
        """Run filterpy's step, then give the sample to the budget unless it was missed."""
        reference = self._next_reference(z, reference)
        references, self._batch_references = self._batch_references, None  # the step must not draw another
        try:
            if z is None:
                step()
                return
            if reference is None:
                raise ValueError("reference is missing: pass reference=, the newest reference sample x(n)")
            row = np.asarray(self.H if H is None else H)
            newest = row.flat[0] if row.size == self.dim_x else 0.0  # the step refuses any other size
            emitted = self.budget.checked_sample(reference, newest, control_signal)
            step()
            self.budget.advance(reference, newest, self._weights().reshape(-1), emitted)
        finally:
            self._batch_references = references

    def _require_constraint(self, name: str) -> OutputPowerConstraint:
        raise ValueError(f"{name} is not used by a power budget, which uses the correlations of the signals")
