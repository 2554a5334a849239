"""KF-ANC (eq. 2-8) and KF-OPC (eq. 9-13): a Kalman filter as the adaptation of the control filter."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter

from .._validate import as_count, as_number
from ..filters.kfopc import KFOPC
from ..filters.power_budget import PowerBudgetKalmanFilter
from ..filters.random_walk import RandomWalkKFOPC
from ..kernels.block import CausalBlock, OpenBlock
from ..kernels.delay_lines import latest, newest
from ..loop.run import KALMAN, ControllerState, control_signal, disturbance_estimate
from ..power.amplifiers import Amplifier
from ..power.budget import PowerBudget
from ..power.constraint import OutputPowerConstraint
from ..power.limiter import OutputLimiter
from .base import FilteredReferenceController


class KalmanController(FilteredReferenceController):
    """The modified ANC structure around a Kalman filter: any filterpy `KalmanFilter` of one measurement.

    Each sample the estimator is given the disturbance estimate as z and the filtered reference as H. With a rated
    power the estimator is KF-OPC or KF-PB, without one KF-ANC. `kf_anc`, `kf_opc` and `kf_pb` make the estimator too.

    Parameters
    ----------
    estimator : filterpy.kalman.KalmanFilter
        Filter whose state is the control filter, ``dim_z = 1``; a `KFOPC`, or filterpy's own. One from
        `KFOPC.random_walk` runs whole signals at compiled speed.
    secondary_path : array_like or control.TransferFunction
        Estimated secondary path, taps or an FIR system.
    amplifier : callable, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.
    name : str, optional
        Name in results and legends; by default KF-PB with a power budget, KF-OPC with a rated power, else KF-ANC.
    block_size : int, optional
        Samples to a block of the block kernel: the same filter to rounding, causal, its work on the covariance put off
        to the block's end, a burst of 3 L^2 block_size flops. By default sample by sample. It counts in compiled runs
        of a filter from `KFOPC.random_walk` without fading memory; whether it is faster is the machine's matter
        (``python -m comparisons speed``).
    limiter : OutputLimiter, optional
        Limiter of its own that the control signal goes through: no window of it passes the limiter's rated power.

    Raises
    ------
    TypeError
        An estimator that is no filterpy KalmanFilter.
    ValueError
        An estimator of several measurements; a block size below 1, or one with a float32 estimator.

    Examples
    --------
    >>> from filterpy.kalman import KalmanFilter
    >>> from kfopc_filterpy import KalmanController
    >>> controller = KalmanController(KalmanFilter(dim_x=4, dim_z=1), secondary_path=[1.0])
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)
    >>> float(controller.weights[0])  # K z = P / (P + R) z with P = I + Q = 2, R = 1
    1.3333333333333333
    """

    def __init__(
        self,
        estimator: KalmanFilter,
        secondary_path: Any,
        *,
        amplifier: Amplifier | None = None,
        name: str | None = None,
        block_size: int | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        if not isinstance(estimator, KalmanFilter):
            raise TypeError(f"estimator must be a filterpy KalmanFilter, got {type(estimator).__name__}")
        if estimator.dim_z != 1:
            raise ValueError(f"estimator must have one measurement, dim_z = 1, got dim_z = {estimator.dim_z}")
        super().__init__(KALMAN, estimator.dim_x, secondary_path, [0.0, 0.0, 1.0], amplifier, limiter=limiter)
        self.estimator = estimator
        self.name = name or self._usual_name()
        size = None if block_size is None else as_count(block_size, "block_size")
        if size is not None and getattr(estimator, "dtype", np.float64) != np.float64:
            raise ValueError("block_size needs an estimator of dtype float64: its products cancel too much in float32")
        self._block = None if size is None else CausalBlock(estimator.dim_x, size)

    @property
    def _budget(self) -> PowerBudget | None:
        """The estimator's power budget, if it has one."""
        return self.estimator.budget if isinstance(self.estimator, PowerBudgetKalmanFilter) else None

    def _usual_name(self) -> str:
        if self._budget is not None:
            return "KF-PB"
        return "KF-ANC" if self.rated_power is None else "KF-OPC"

    @property
    def rated_power(self) -> float | None:
        """Rated output power of the estimator; None for KF-ANC."""
        return getattr(self.estimator, "rated_power", None)

    @property
    def weights(self) -> np.ndarray:
        """Estimator's state w, (L,), the control filter but for a power budget; a copy."""
        return np.array(self.estimator.x, dtype=np.float64).reshape(-1)

    @property
    def control_filter(self) -> np.ndarray:
        """Control filter that makes y, (L,); a copy."""
        return self.weights if self._budget is None else self._budget.control_filter

    @property
    def power_weight(self) -> float:
        """Weight lambda of the control power in a power budget; NaN without one."""
        return np.nan if self._budget is None else self._budget.power_weight

    @property
    def _powers_fs(self) -> float:
        return self.constraint.fs if self._budget is None else self._budget.fs

    @property
    def constraint(self) -> OutputPowerConstraint:
        """What keeps the powers: the estimator's constraint, or one of our own with the estimator's factor held."""
        theirs = self.estimator.constraint if isinstance(self.estimator, KFOPC) else None
        if theirs is not None:
            return theirs
        self._own_constraint.factor = self.constraint_factor
        return self._own_constraint

    @property
    def constraint_factor(self) -> float:
        """Constraint factor of the last sample."""
        return getattr(self.estimator, "constraint_factor", 1.0)

    def control_signal(self, reference: float) -> float:
        """Control signal y(n) for the newest reference sample x(n), from the weights of the last sample."""
        reference = as_number(reference, "reference")
        self._y = float(control_signal(self._state_with_estimator(), reference))
        return self._y

    def _state_with_estimator(self) -> ControllerState:
        """State that sees what the estimator has now: its weights, and the arrays of its powers and budget."""
        self._state.weights[:] = self.weights
        state = self._state._replace(constraint=self.constraint.state)
        if self._budget is not None:
            budget = self._budget.state
            state = state._replace(budget=budget, control_filter=budget.control_filter)
        return state

    def update(self, error: float) -> None:
        """Adapt to the error e(n) that the last control signal left (eq. 2-9)."""
        d = disturbance_estimate(self._state, as_number(error, "error"))
        h = newest(self._state.filtered, self.estimator.dim_x).reshape(1, -1).copy()
        x, powers = latest(self._state.reference), self.constraint
        powers.preview(d, h[0, 0], x)  # refuses what would overflow before anything changes
        self.estimator.predict()
        if self._budget is not None:
            self.estimator.update(d, H=h, reference=x, control_signal=self._y)
        elif isinstance(self.estimator, KFOPC):
            self.estimator.update(d, H=h, reference=x)
        else:
            self.estimator.update(np.full((1,) * np.ndim(self.estimator.x), d), H=h)
        if powers is self._own_constraint:
            powers.advance(d, h[0, 0], x)

    def _family(self) -> type:
        """Class whose two calls a sample the compiled loop knows."""
        return KalmanController

    def compiled_state(self, to_step: bool = True) -> ControllerState | None:
        """State for the compiled loop, `to_step` it or to read only; None where filterpy's own equations step."""
        estimator = self.estimator
        if type(estimator) not in (RandomWalkKFOPC, PowerBudgetKalmanFilter) or not self.steps_of(self._family()):
            return None
        compiled = estimator.compiled_state(to_step)
        if compiled is None:
            return None
        covariance, settings = compiled
        self._state.settings[:] = settings
        self._state.last[:] = np.nan
        return self._state_with_estimator()._replace(covariance=covariance)

    def listen(self, references: np.ndarray, errors: np.ndarray) -> None:
        """Follow the noise before the control is switched on; see `FilteredReferenceController.listen`."""
        self._state = self._state_with_estimator()
        super().listen(references, errors)

    @property
    def open_block(self) -> OpenBlock | None:
        """Block under way, for the compiled loop; None without a block size."""
        return None if self._block is None else self._block.state

    def blocks(self, state: ControllerState, n_samples: int) -> Iterator[tuple[int, int]]:
        """Begin and end of the blocks of `n_samples` that the loop may run on `state`, opened and closed around each."""
        _, _, alpha_sq = state.settings
        if self._block is None or alpha_sq != 1.0:
            yield from super().blocks(state, n_samples)
            return
        self.estimator.settle_covariance()
        for begin in range(0, n_samples, self._block.size):
            self._block.open(state.covariance, newest(state.filtered, state.weights.size))
            yield begin, min(begin + self._block.size, n_samples)
            self._block.close(state.covariance, state.settings[0])

    def after_compiled(self, state: ControllerState, shared: bool = False) -> None:
        """Give the estimator what the last sample run left in `state`; `shared` where other filters go on from it too."""
        if self._block is not None:
            self._block.close(state.covariance, state.settings[0])
        d, y, S = state.last.tolist()
        arrays = state.covariance if shared else None
        if not np.isnan(S):
            self.estimator.after_compiled(state.weights, d, y, S, arrays)
        elif arrays is not None:  # it diverged before its first update
            self.estimator.go_on_from(arrays)


def kf_anc(
    n_taps: int,
    secondary_path: Any,
    *,
    state_noise: float,
    measurement_noise: float,
    initial_variance: float = 1.0,
    amplifier: Amplifier | None = None,
    block_size: int | None = None,
    limiter: OutputLimiter | None = None,
    dtype: Any = np.float64,
) -> KalmanController:
    """KF-ANC: the Kalman filter of eq. 2-8 without a constraint.

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter.
    secondary_path : array_like or control.TransferFunction
        Estimated secondary path.
    state_noise, measurement_noise, initial_variance
        r, q and P(0|0), see `KFOPC.random_walk`.
    amplifier : callable, optional
    block_size : int, optional
    limiter : OutputLimiter, optional
        See `KalmanController`.
    dtype : {numpy.float64, numpy.float32}, default numpy.float64
        See `KFOPC.random_walk`.

    Returns
    -------
    KalmanController
        A controller named KF-ANC.

    Examples
    --------
    >>> from kfopc_filterpy import kf_anc
    >>> kf_anc(8, [1.0], state_noise=1e-6, measurement_noise=0.1).name
    'KF-ANC'
    """
    estimator = KFOPC.random_walk(
        n_taps,
        state_noise=state_noise,
        measurement_noise=measurement_noise,
        initial_variance=initial_variance,
        dtype=dtype,
    )
    return KalmanController(estimator, secondary_path, amplifier=amplifier, block_size=block_size, limiter=limiter)


def kf_opc(
    n_taps: int,
    secondary_path: Any,
    *,
    rated_power: float,
    state_noise: float,
    measurement_noise: float,
    initial_variance: float = 1.0,
    amplifier: Amplifier | None = None,
    block_size: int | None = None,
    limiter: OutputLimiter | None = None,
    dtype: Any = np.float64,
    **constraint: Any,
) -> KalmanController:
    """KF-OPC: the Kalman filter with output power constraint, eq. 9-13.

    Parameters
    ----------
    n_taps, secondary_path, state_noise, measurement_noise, initial_variance, amplifier, block_size, limiter, dtype
        As for `kf_anc`.
    rated_power : float
        Rated output power rho_o.
    **constraint
        `fs`, `power_memory`, `power_window`, `secondary_path_gain`, see `KFOPC`.

    Returns
    -------
    KalmanController
        A controller named KF-OPC.

    Examples
    --------
    >>> from kfopc_filterpy import kf_opc
    >>> kf_opc(8, [1.0], rated_power=0.5, state_noise=1e-6, measurement_noise=0.1).rated_power
    0.5
    """
    estimator = KFOPC.random_walk(
        n_taps,
        state_noise=state_noise,
        measurement_noise=measurement_noise,
        initial_variance=initial_variance,
        rated_power=rated_power,
        dtype=dtype,
        **constraint,
    )
    return KalmanController(estimator, secondary_path, amplifier=amplifier, block_size=block_size, limiter=limiter)


def kf_pb(
    n_taps: int,
    secondary_path: Any,
    *,
    rated_power: float,
    state_noise: float,
    measurement_noise: float,
    initial_variance: float = 1.0,
    amplifier: Amplifier | None = None,
    block_size: int | None = None,
    limiter: OutputLimiter | None = None,
    dtype: Any = np.float64,
    **budget: Any,
) -> KalmanController:
    """KF-PB: the power-budgeted Kalman filter, the least error within the rated power.

    Parameters
    ----------
    n_taps, secondary_path, state_noise, measurement_noise, initial_variance, amplifier, block_size, limiter, dtype
        As for `kf_anc`.
    rated_power : float
        Rated output power.
    **budget
        `fs`, `memory_s`, `credit_s`, see `PowerBudget`.

    Returns
    -------
    KalmanController
        A controller named KF-PB; its `control_filter` makes the control signal, its `weights` are the estimate of the
        unconstrained one.

    Examples
    --------
    >>> from kfopc_filterpy import kf_pb
    >>> kf_pb(8, [1.0], rated_power=0.5, state_noise=1e-6, measurement_noise=0.1).name
    'KF-PB'
    """
    estimator = PowerBudgetKalmanFilter(
        n_taps,
        state_noise=state_noise,
        measurement_noise=measurement_noise,
        rated_power=rated_power,
        initial_variance=initial_variance,
        dtype=dtype,
        **budget,
    )
    return KalmanController(estimator, secondary_path, amplifier=amplifier, block_size=block_size, limiter=limiter)
