"""KF-ANC (eq. 2-8) and KF-OPC (eq. 9-13): a Kalman filter as the adaptation of the control filter."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np
from filterpy.kalman import KalmanFilter

from .._validate import as_count, as_number
from ..bounds.settings import SuggestedSettings
from ..filters.kfopc import KFOPC
from ..filters.power_budget import PowerBudgetKalmanFilter
from ..filters.random_walk import RandomWalkKFOPC, new_numbers
from ..kernels.compiling import inlined, part
from ..kernels.covariance import Covariance, kalman_step, new_covariance
from ..kernels.delay_lines import latest, newest
from ..paths.channels import is_path_matrix
from ..power.amplifiers import Amplifier
from ..power.constraint import (
    ConstraintState,
    OutputPowerConstraint,
    commit_constraint,
    preview_constraint,
    squares_are_finite,
)
from ..power.limiter import OutputLimiter
from .base import NO_SOLUTION, calls_of, constraint_for
from .compiled_controller import CompiledController
from .direct import DirectKalman
from .step import Lines, adapt, disturbance_estimate, estimate_once


class KalmanState(NamedTuple):
    """State of KF-ANC and KF-OPC."""

    lines: Lines
    weights: np.ndarray
    constraint: ConstraintState
    gains: Covariance  # or another source of gains for which `kalman_step` has a body
    numbers: np.ndarray  # record: the filter's variances and the results of the last update


@adapt.register(KalmanState)
def adapt_kalman(state, error, control_signal):
    """Apply eq. 2-13."""
    return correct_constrained(state, error)


@inlined
def correct_constrained(state, error):
    """Apply eq. 2-9 with the factor of eq. 10-13; return False, with nothing changed, if that fails."""
    d, h0, x = disturbance_estimate(state.lines, error), latest(state.lines.filtered), latest(state.lines.reference)
    if not squares_are_finite(d, h0, x):
        return False
    factor, _, _ = preview_constraint(state.constraint, d, h0, x)
    if not correct(state, d, factor * d):
        return False
    commit_constraint(state.constraint, d, h0, x)
    return True


@inlined
def correct(state, measurement, scaled):
    """Correct the weights with the scaled measurement (eq. 2-9); return False, with nothing changed, if that fails."""
    w, numbers = state.weights, state.numbers[0]
    h = newest(state.lines.filtered, w.size)
    y, S = kalman_step(state.gains, w, h, scaled, numbers.state_noise, numbers.measurement_noise, numbers.alpha_sq)
    if not np.isfinite(y):
        return False
    numbers.measurement, numbers.residual, numbers.variance = measurement, y, S
    observe_guarded(state.lines.guard, state.gains, w, numbers.measurement_noise)
    return True


@part()
def observe_guarded(guard, gains, w, noise):
    """Correct w as if w'x'' with x'' = W * x' had been measured as zero, if there is a guard.

    A Kalman filter then minimises E[(d - w'x')^2] + E[(w'x'')^2].
    """
    if guard is not None:
        kalman_step(gains, w, newest(guard.filtered, w.size), 0.0, 0.0, noise, 1.0)


class KalmanController(CompiledController):
    """The modified ANC structure around a Kalman filter: any filterpy `KalmanFilter` of one measurement.

    In each sample, the estimator gets the disturbance estimate as z and the filtered reference as H. With a rated
    power this is KF-OPC, without one KF-ANC. `kf_anc` and `kf_opc` also make the estimator.

    Parameters
    ----------
    estimator : filterpy.kalman.KalmanFilter
        Filter whose state is the control filter, ``dim_z = 1``; a `KFOPC`, or filterpy's own. One from
        `KFOPC.random_walk` runs at compiled speed.
    secondary_path : array_like or control.TransferFunction
        Estimated secondary path, taps or an FIR system.
    amplifier : callable, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.
    name : str, optional
        Name in results and legends; by default KF-OPC with a rated power, else KF-ANC.
    limiter : OutputLimiter, optional
        Limiter of the control signal, not shared with another controller. No window of the control signal then exceeds
        the limiter's rated power.

    Raises
    ------
    TypeError
        An estimator that is not a filterpy KalmanFilter, or that has a power budget (use `PowerBudgetController`).
    ValueError
        An estimator of several measurements.

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

    has_gains = True
    _filter_type: Any = RandomWalkKFOPC  # type of the filters whose steps are compiled

    def __init__(
        self,
        estimator: KalmanFilter,
        secondary_path: Any,
        *,
        amplifier: Amplifier | None = None,
        name: str | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        self._require_filter(estimator)
        super().__init__(estimator.dim_x, secondary_path, amplifier=amplifier, limiter=limiter)
        self.estimator = estimator
        self._state = self._new_state(new_covariance(np.zeros((1, 1))), new_numbers())
        self._calls_are_ours = calls_of(type(self)) == calls_of(self._family())
        self.name = name or self._usual_name()

    def _require_filter(self, estimator: Any) -> None:
        if not isinstance(estimator, KalmanFilter):
            raise TypeError(f"estimator must be a filterpy KalmanFilter, got {type(estimator).__name__}")
        if estimator.dim_z != 1:
            raise ValueError(
                f"estimator must have one measurement, dim_z = 1, got dim_z = {estimator.dim_z}; "
                "kf_anc and kf_opc take several microphones"
            )
        if isinstance(estimator, PowerBudgetKalmanFilter):
            raise TypeError("estimator has a power budget: use PowerBudgetController, or kf_pb")

    def _new_state(self, gains: Covariance, numbers: np.ndarray) -> Any:
        return KalmanState(*self._common(), gains, numbers)

    def _family(self) -> type[KalmanController]:
        """Return the class whose `control_signal` and `update` the compiled step implements."""
        return KalmanController

    def _takes_guard(self) -> bool:
        return type(self.estimator) is self._filter_type  # their steps are compiled

    def _usual_name(self) -> str:
        return "KF-ANC" if self.rated_power is None else "KF-OPC"

    def _read_rated_power(self) -> float | None:
        return getattr(self.estimator, "rated_power", None)

    def _take_rated_power(self, value: float) -> None:
        self.estimator.rated_power = value

    @property
    def weights(self) -> np.ndarray:
        """Estimator's state w, (L,); a copy."""
        return np.array(self.estimator.x, dtype=np.float64).reshape(-1)

    @property
    def control_filter(self) -> np.ndarray:
        """Control filter that generates y, (L,); a copy."""
        return self.weights

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

    # Two calls per sample. A random-walk filter uses the compiled step; any other filter uses its own `update`.

    def control_signal(self, reference: float) -> float:
        """Return the control signal y(n) for the newest reference sample x(n), from the weights of the last sample."""
        reference = as_number(reference, "reference")
        self._see_weights()
        return self._emit(reference)

    def _see_weights(self) -> None:
        """Copy the estimator's weights into the state."""
        x = self.estimator.x
        self._state.weights[:] = x.reshape(-1) if isinstance(x, np.ndarray) else np.reshape(x, -1)

    def update(self, error: float) -> None:
        """Adapt to the error e(n) that the last control signal left (eq. 2-9)."""
        error = as_number(error, "error")
        state = self._steppable_state()
        if state is None:
            if self._state.lines.guard is not None:
                raise ValueError(
                    "secondary_path_uncertainty needs the estimator's own step, and its F, Q, P or inv was replaced by "
                    "something else than that of a random walk: assign None to secondary_path_uncertainty, or make a new "
                    "controller"
                )
            self._update_through_estimator(error)
        elif self._adapt(error):
            self.estimator.after_compiled(state.weights.copy())
        else:
            # This raises, with the reason. On a copy, because its prediction would stay.
            deepcopy(self)._update_through_estimator(error)
            raise ValueError(NO_SOLUTION)

    def _update_through_estimator(self, error: float) -> None:
        """Call the estimator's `predict` and `update`."""
        d = estimate_once(self._state.lines, error)
        h = newest(self._state.lines.filtered, self.n_taps).reshape(1, -1).copy()
        x, powers = latest(self._state.lines.reference), self.constraint
        powers.preview(d, h[0, 0], x)  # raises if a square overflows, before anything changes
        self.estimator.predict()
        if isinstance(self.estimator, KFOPC):
            self._update_estimator(d, h, x)
        else:
            self.estimator.update(np.full((1,) * np.ndim(self.estimator.x), d), H=h)
        if powers is self._own_constraint:
            powers.advance(d, h[0, 0], x)

    def _update_estimator(self, d: float, h: np.ndarray, x: float) -> None:
        self.estimator.update(d, H=h, reference=x)

    def _state_with_estimator(self) -> Any:
        """Return the state with the estimator's present weights and power arrays."""
        self._see_weights()
        constraint = self.constraint.state
        if constraint is not self._state.constraint:
            self._state = self._state._replace(constraint=constraint)
        return self._state

    def _steppable_state(self, to_step: bool = True) -> Any:
        """Return the state with the estimator's covariance; None if the estimator's step is not compiled.

        `to_step` says if the caller will change the state, or only read it.
        """
        estimator: Any = self.estimator
        if type(estimator) is not self._filter_type or not estimator.steps_compiled():
            return None
        arrays, numbers = estimator.compiled_arrays(to_step)
        state = self._state_with_estimator()
        if arrays is not state.gains or numbers is not state.numbers:
            self._state = state = state._replace(gains=arrays, numbers=numbers)
        return state

    # A whole signal at compiled speed.

    def compiled_state(self, to_step: bool = True) -> Any:
        """Return the state for the compiled loop; None if Python must call the steps.

        `to_step` says if the caller will change the state, or only read it.
        """
        state = self._steppable_state(to_step) if self._calls_are_ours else None
        if state is not None:
            state.numbers["variance"] = np.nan  # NaN until the first update
        return state

    def after_compiled(self, state: Any, shared: bool = False) -> None:
        """Give the estimator the results in `state`; `shared` if other filters continue from its covariance too."""
        arrays = state.gains if shared else None
        if not np.isnan(state.numbers["variance"][0]):
            self.estimator.after_compiled(state.weights.copy(), arrays)
        elif arrays is not None:  # it diverged before its first update
            self.estimator.go_on_from(arrays)

    def listen(self, references: np.ndarray, errors: np.ndarray, *, adapt: Any = True) -> None:
        """Follow the noise before the control is switched on; see `FilteredReferenceController.listen`."""
        self._state_with_estimator()
        super().listen(references, errors, adapt=adapt)


def kf_anc(
    n_taps: int | SuggestedSettings,
    secondary_path: Any,
    *,
    state_noise: float | None = None,
    measurement_noise: Any = None,
    initial_variance: float | None = None,
    n_references: int = 1,
    amplifier: Any = None,
    limiter: Any = None,
    dtype: Any = np.float64,
) -> KalmanController | DirectKalman:
    """Return KF-ANC, the Kalman filter of eq. 2-8 without a constraint.

    Parameters
    ----------
    n_taps : int or SuggestedSettings
        Taps L of the control filter, or of each of them. Or pass the result of `suggest_settings`, which also supplies
        the defaults of the next three settings.
    secondary_path : array_like, shape (n_path,) or (K, J, n_path), or control system
        Estimated secondary path, or those from J loudspeakers to K microphones.
    state_noise : float, optional
        r, see `KFOPC.random_walk`; by default the suggested one.
    measurement_noise : float or array_like, shape (K,), optional
        q of all microphones, or of each; by default the suggested one.
    initial_variance : float, optional
        P(0|0) of each tap; by default the suggested one, or 1. It has the unit of a squared weight, so 1 may be far too
        much.
    n_references : int, default 1
        Number of references I.
    amplifier, limiter : optional
        See `KalmanController`; with several loudspeakers, a sequence with one for each.
    dtype : {numpy.float64, numpy.float32}, default numpy.float64
        See `KFOPC.random_walk`.

    Returns
    -------
    KalmanController or DirectKalman
        A controller named KF-ANC. With several channels it is a `DirectKalman`, whose signals and weights have channel
        axes.

    Raises
    ------
    ValueError, TypeError
        Neither suggested settings nor state noise and measurement noise; a setting that is out of range, or that does not
        fit the number of channels; another sample rate than that of the suggested settings.

    Examples
    --------
    >>> from kfopc_filterpy import kf_anc
    >>> kf_anc(8, [1.0], state_noise=1e-6, measurement_noise=0.1).name
    'KF-ANC'

    With settings from a silent run:

    >>> import numpy as np
    >>> from kfopc_filterpy import suggest_settings
    >>> x = np.random.default_rng(0).standard_normal(16000)
    >>> kf_anc(suggest_settings(x, np.roll(x, 9), [1.0]), [1.0]).n_taps
    16
    """
    return _kalman(
        n_taps,
        secondary_path,
        n_references,
        amplifier,
        limiter,
        state_noise=state_noise,
        measurement_noise=measurement_noise,
        initial_variance=initial_variance,
        dtype=dtype,
    )


def kf_opc(
    n_taps: int | SuggestedSettings,
    secondary_path: Any,
    *,
    rated_power: Any = None,
    constraint: Any = None,
    state_noise: float | None = None,
    measurement_noise: Any = None,
    initial_variance: float | None = None,
    n_references: int = 1,
    amplifier: Any = None,
    limiter: Any = None,
    dtype: Any = np.float64,
) -> KalmanController | DirectKalman:
    """Return KF-OPC, the Kalman filter with output power constraint (eq. 9-13).

    Parameters
    ----------
    n_taps, secondary_path, state_noise, measurement_noise, initial_variance, n_references, amplifier, limiter, dtype
        As for `kf_anc`.
    rated_power : float or array_like, shape (J,), optional
        Rated output power rho_o of all loudspeakers, or of each.
    constraint : OutputPowerConstraint or sequence of J of them, optional
        Alternative to `rated_power`: a rated power with the settings of its power estimates, for example the sample
        rate. A copy is kept. With `rated_power`, the sample rate is that of the suggested settings, or 16 kHz.

    Returns
    -------
    KalmanController or DirectKalman
        A controller named KF-OPC. With several channels it is a `DirectKalman`, which scales all measurements by the
        smallest of the loudspeakers' factors.

    Raises
    ------
    ValueError, TypeError
        Neither a rated power nor a constraint, or both; neither suggested settings nor state noise and measurement noise;
        a setting that is out of range, or that does not fit the number of channels; another sample rate than that of the
        suggested settings.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import kf_opc
    >>> kf_opc(8, [1.0], rated_power=0.5, state_noise=1e-6, measurement_noise=0.1).rated_power
    0.5
    >>> paths = np.zeros((2, 2, 8))  # two loudspeakers, two microphones
    >>> paths[:, :, 1] = [[1.0, 0.3], [0.2, 1.0]]
    >>> kf_opc(8, paths, rated_power=[0.5, 0.2], state_noise=1e-6, measurement_noise=0.1).rated_power
    array([0.5, 0.2])
    """
    return _kalman(
        n_taps,
        secondary_path,
        n_references,
        amplifier,
        limiter,
        constraint=suggested_constraint(n_taps, rated_power, constraint),
        state_noise=state_noise,
        measurement_noise=measurement_noise,
        initial_variance=initial_variance,
        dtype=dtype,
    )


def _kalman(
    n_taps: int | SuggestedSettings,
    secondary_path: Any,
    n_references: int,
    amplifier: Any,
    limiter: Any,
    **settings: Any,
) -> KalmanController | DirectKalman:
    """Return the controller for one channel or for several."""
    taps, settings = with_suggested(n_taps, settings)
    outside = {"amplifier": amplifier, "limiter": limiter}
    controller = (
        DirectKalman(taps, secondary_path, n_references=n_references, **outside, **settings)
        if is_multichannel(secondary_path, n_references)
        else KalmanController(KFOPC.random_walk(taps, **settings), secondary_path, **outside)
    )
    return at_suggested_rate(controller, n_taps)


def with_suggested(n_taps: Any, settings: dict[str, Any], instead: str = "") -> tuple[Any, dict[str, Any]]:
    """Return the taps and the settings; the suggested ones, if there are any, replace those that are None.

    A noise that is still missing raises TypeError; the message says how to find it, or what to give `instead`.
    """
    suggested: dict[str, Any] = {"initial_variance": 1.0}
    if isinstance(n_taps, SuggestedSettings):
        n_taps, suggested = n_taps.n_taps, n_taps.settings
    settings = suggested | {name: value for name, value in settings.items() if value is not None}
    if not {"state_noise", "measurement_noise"} <= settings.keys():
        raise TypeError(
            f"give state_noise and measurement_noise{instead}, or pass the result of suggest_settings(reference, "
            "disturbance, secondary_path), from a run with a silent loudspeaker, as n_taps"
        )
    return n_taps, settings


def suggested_constraint(n_taps: Any, rated_power: Any, constraint: Any) -> Any:
    """Return `constraint_for`, for the sample rate of suggested settings if `n_taps` are such."""
    if not isinstance(n_taps, SuggestedSettings):
        return constraint_for(rated_power, constraint)
    return constraint_for(rated_power, constraint, n_taps.fs)


def at_suggested_rate(controller: Any, n_taps: Any) -> Any:
    """Return the controller, or raise ValueError if a part of it has another sample rate than suggested settings."""
    if isinstance(n_taps, SuggestedSettings):
        try:
            controller.require_sample_rate(n_taps.fs)
        except ValueError as error:
            raise ValueError(f"in the suggested settings, {error}") from None
    return controller


def is_multichannel(secondary_path: Any, n_references: int) -> bool:
    """Return whether signals have a channel axis: if the secondary path has, or if there are several references."""
    return is_path_matrix(secondary_path) or as_count(n_references, "n_references") > 1
