"""KF-OPC with the gain of its constraint repaired (see `repairs`)."""

from __future__ import annotations

from typing import Any

from .._validate import as_choice, as_number, as_positive
from ..filters.kfopc import KFOPC
from ..filters.random_walk import RandomWalkKFOPC
from ..kernels.delay_lines import latest, newest
from ..loop.run import ControllerState, disturbance_estimate
from ..power.amplifiers import Amplifier
from ..power.constraint import DEFAULT_FS, DEFAULT_MEMORY_S, OutputPowerConstraint
from ..power.limiter import OutputLimiter
from .kalman import KalmanController
from .repairs import advance_repair, gain_samples, measurement_factor, new_repair

DEFAULT_TRIM_S = 1.0


class RepairedKFOPC(KalmanController):
    """KF-OPC whose constraint factor keeps the rated power on more paths than the published one's.

    Made by `kf_opc_repaired`. The estimator has no constraint of its own: the controller gives it the factor.

    Parameters
    ----------
    estimator : RandomWalkKFOPC
        Filter without a rated power.
    secondary_path, amplifier, name, limiter
        As for `KalmanController`.
    constraint : OutputPowerConstraint
        What keeps the powers and the factor.
    gain_of, trim_s, factor_at
        As for `kf_opc_repaired`.

    Raises
    ------
    ValueError
        An estimator of another kind or with a rated power; another gain or place; a time not positive.

    Examples
    --------
    >>> from kfopc_filterpy import kf_opc_repaired
    >>> controller = kf_opc_repaired(8, [1.0], rated_power=0.5, state_noise=1e-6, measurement_noise=0.1)
    >>> type(controller).__name__, controller.rated_power
    ('RepairedKFOPC', 0.5)
    """

    estimator: RandomWalkKFOPC

    def __init__(
        self,
        estimator: RandomWalkKFOPC,
        secondary_path: Any,
        constraint: OutputPowerConstraint,
        *,
        gain_of: str = "control",
        trim_s: float | None = DEFAULT_TRIM_S,
        factor_at: str = "output",
        amplifier: Amplifier | None = None,
        name: str | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        if not isinstance(estimator, RandomWalkKFOPC) or estimator.rated_power is not None:
            raise ValueError("estimator must be a filter of KFOPC.random_walk without a rated power of its own")
        self.gain_of = as_choice(gain_of, "gain_of", ("reference", "control"))
        self.trim_s = None if trim_s is None else as_positive(trim_s, "trim_s", unit="s")
        self.factor_at = as_choice(factor_at, "factor_at", ("measurement", "output"))
        super().__init__(estimator, secondary_path, amplifier=amplifier, name=name, limiter=limiter)
        self._own_constraint = constraint
        rate = 0.0 if self.trim_s is None else 1.0 / (self.trim_s * constraint.fs)
        self._state = self._state._replace(
            repair=new_repair(self.gain_of == "control", rate, self.factor_at == "output")
        )

    def _usual_name(self) -> str:
        return "KF-OPC repaired"

    def _family(self) -> type:
        return RepairedKFOPC

    @property
    def rated_power(self) -> float:
        """Rated output power."""
        return self._own_constraint.rated_power

    @property
    def constraint(self) -> OutputPowerConstraint:
        """What keeps the powers and the factor."""
        return self._own_constraint

    @property
    def constraint_factor(self) -> float:
        """Constraint factor of the last sample, trimmed."""
        return self._own_constraint.factor

    def update(self, error: float) -> None:
        """Adapt to the error e(n) that the last control signal left."""
        error, repair = as_number(error, "error"), self._state.repair
        d = float(disturbance_estimate(self._state, error))
        h = newest(self._state.filtered, self.estimator.dim_x).reshape(1, -1).copy()
        seen = gain_samples(repair, h[0, 0], latest(self._state.reference), error, d, self._y)
        factor = self.constraint.preview(d, *seen)  # refuses what would overflow before anything changes
        self.estimator.constraint_factor = measurement_factor(repair, factor)
        self.estimator.predict()
        self.estimator.update(d, H=h)
        self.constraint.advance(d, *seen)
        advance_repair(repair, self.constraint.state, self._y)

    def after_compiled(self, state: ControllerState, shared: bool = False) -> None:
        """See `KalmanController.after_compiled`, `state` and `shared`; the estimator holds the last sample's factor."""
        super().after_compiled(state, shared)
        self.estimator.constraint_factor = 1.0 if self.factor_at == "output" else self.constraint_factor


def kf_opc_repaired(
    n_taps: int,
    secondary_path: Any,
    *,
    rated_power: float,
    state_noise: float,
    measurement_noise: float,
    initial_variance: float = 1.0,
    gain_of: str = "control",
    trim_s: float | None = DEFAULT_TRIM_S,
    factor_at: str = "output",
    fs: float = DEFAULT_FS,
    power_memory: float = DEFAULT_MEMORY_S,
    power_window: str = "exponential",
    amplifier: Amplifier | None = None,
    limiter: OutputLimiter | None = None,
) -> RepairedKFOPC:
    r"""KF-OPC with its gain repaired: eq. 13 made to hold on paths that are not flat.

    Three repairs, each on its own or together. With ``gain_of="reference", trim_s=None, factor_at="measurement"`` it is
    KF-OPC as published. It still scales the control filter as a whole, which is a poor way to spend the power where
    the secondary path is not flat: `kf_pb` reaches more.

    Parameters
    ----------
    n_taps, secondary_path, state_noise, measurement_noise, initial_variance, amplifier, limiter
        As for `kf_anc`.
    rated_power : float
        Rated output power.
    gain_of : {"control", "reference"}, default "control"
        Signal whose gain through the secondary path is G_s: the control signal's, :math:`E[(\hat s * y)^2] / E[y^2]`,
        or the reference's, :math:`E[x'^2] / E[x^2]` (eq. 11).
    trim_s : float or None, default 1
        Integration time in seconds of a closed loop that trims the factor until the output power measured is the rated
        one; it settles in half of it. None: no trim.
    factor_at : {"output", "measurement"}, default "output"
        Where the factor is applied: to the control signal, where it acts at once, or to the measurement (eq. 9),
        where it acts as fast as the filter adapts.
    fs, power_memory, power_window
        As `fs`, `memory`, `window` of `OutputPowerConstraint`.

    Returns
    -------
    RepairedKFOPC
        A controller named "KF-OPC repaired".

    Raises
    ------
    ValueError
        What `KFOPC.random_walk` and `OutputPowerConstraint` refuse; another gain or place; a time not positive.

    Examples
    --------
    >>> from kfopc_filterpy import kf_opc_repaired
    >>> kf_opc_repaired(8, [1.0], rated_power=0.5, state_noise=1e-6, measurement_noise=0.1).factor_at
    'output'
    """
    estimator = KFOPC.random_walk(
        n_taps,
        state_noise=state_noise,
        measurement_noise=measurement_noise,
        initial_variance=initial_variance,
    )
    constraint = OutputPowerConstraint(rated_power, fs=fs, memory=power_memory, window=power_window)
    return RepairedKFOPC(
        estimator,
        secondary_path,
        constraint,
        gain_of=gain_of,
        trim_s=trim_s,
        factor_at=factor_at,
        amplifier=amplifier,
        limiter=limiter,
    )
