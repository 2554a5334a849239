"""KF-PB: a Kalman filter, with the control filter of least error within the rated power."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_choice, as_number
from ..bounds.settings import SuggestedSettings
from ..filters.power_budget import PowerBudgetKalmanFilter
from ..filters.random_walk import new_numbers
from ..kernels.covariance import Covariance, kalman_step, new_covariance
from ..kernels.delay_lines import latest, newest
from ..paths.uncertainty import GUARD_TAPS, ONE_SAMPLE, as_uncertainty, guard_filter
from ..power.amplifiers import Amplifier
from ..power.budget import BudgetState, advance_budget, follow_noise, note_sample, take_noted
from ..power.constraint import (
    ConstraintState,
    advance_constraint,
    commit_constraint,
    preview_constraint,
    squares_are_finite,
)
from ..power.limiter import OutputLimiter
from .base import NO_SOLUTION, calls_of
from .compiled_controller import CompiledController
from .direct_budget import DirectPowerBudget
from .frequency_domain import FrequencyDomainKalman
from .kalman import at_suggested_rate, is_multichannel, with_suggested
from .primary_paths import PrimaryPathController
from .shared_gain import SharedGainKalman
from .step import (
    Lines,
    adapt,
    control_filter,
    disturbance_estimate,
    emitted,
    estimate_once,
    follow,
    power_weight,
    skip,
    unheard,
)


class PowerBudgetState(NamedTuple):
    """State of KF-PB."""

    lines: Lines
    weights: np.ndarray
    constraint: ConstraintState  # computes the powers; its factor is fixed at 1
    gains: Covariance
    numbers: np.ndarray  # record: the filter's variances and the results of the last update
    budget: BudgetState


@adapt.register(PowerBudgetState)
def adapt_power_budget(state, error, control_signal):
    """Apply eq. 2-8, then let the budget find the control filter for the estimate."""
    d, filtered, x = (
        disturbance_estimate(state.lines, error),
        latest(state.lines.filtered),
        latest(state.lines.reference),
    )
    if not squares_are_finite(d, filtered, x):
        return False
    preview_constraint(state.constraint, d, filtered, x)
    w, numbers = state.weights, state.numbers[0]
    h = newest(state.lines.filtered, w.size)
    y, S = kalman_step(state.gains, w, h, d, numbers.state_noise, numbers.measurement_noise, numbers.alpha_sq)
    if not np.isfinite(y):
        return False
    numbers.measurement, numbers.residual, numbers.variance = d, y, S
    commit_constraint(state.constraint, d, filtered, x)
    advance_budget(state.budget, state.weights, x, filtered, control_signal)
    return True


@emitted.register(PowerBudgetState)
def note_emitted(state, y):
    """Note what was played: power is spent whether the estimate adapts to the sample or not."""
    note_sample(state.budget, latest(state.lines.reference), latest(state.lines.filtered), y)


@skip.register(PowerBudgetState)
def skip_power_budget(state):
    """Let the budget process what was played."""
    take_noted(state.budget)


@unheard.register(PowerBudgetState)
def unheard_by_power_budget(state):
    """Add the sample to the correlations."""
    follow_noise(state.budget, latest(state.lines.reference), latest(state.lines.filtered))


@follow.register(PowerBudgetState)
def follow_power_budget(state, error):
    """Add the sample to the powers and the correlations."""
    d, filtered, x = (
        disturbance_estimate(state.lines, error),
        latest(state.lines.filtered),
        latest(state.lines.reference),
    )
    advance_constraint(state.constraint, d, filtered, x)
    follow_noise(state.budget, x, filtered)
    return True


@control_filter.register(PowerBudgetState)
def filter_of_power_budget(state):
    """Return the budget's control filter."""
    return state.budget.control_filter


@power_weight.register(PowerBudgetState)
def weight_of_power_budget(state: PowerBudgetState) -> np.ndarray:
    """Return lambda, (1,)."""
    weight: np.ndarray = state.budget.numbers["weight"]
    return weight


class PowerBudgetController(CompiledController):
    """The modified ANC structure around a filter with a power budget; `kf_pb` also makes the filter.

    Parameters
    ----------
    estimator : PowerBudgetKalmanFilter
        Filter whose state is the estimate of the unconstrained control filter.
    secondary_path, amplifier, name, limiter
        As for `KalmanController`; the default name is KF-PB.
    secondary_path_uncertainty : PathTolerance, float or array_like, optional
        What the guard of the estimator's budget was made for, see `paths.path_uncertainty`. A new secondary path then
        gets a guard of its own. By default the guard of the budget stays.

    Raises
    ------
    TypeError
        An estimator without a power budget.
    ValueError
        An uncertainty that needs a guard, and a budget whose guard `paths.guard_filter` did not make.

    Examples
    --------
    >>> from kfopc_filterpy.controllers import PowerBudgetController
    >>> from kfopc_filterpy.filters import PowerBudgetKalmanFilter
    >>> kf = PowerBudgetKalmanFilter(4, state_noise=1e-6, measurement_noise=0.1, rated_power=0.5)
    >>> controller = PowerBudgetController(kf, secondary_path=[1.0])
    >>> controller.name, controller.rated_power, controller.power_weight
    ('KF-PB', 0.5, 0.0)
    """

    def __init__(
        self,
        estimator: PowerBudgetKalmanFilter,
        secondary_path: Any,
        *,
        amplifier: Amplifier | None = None,
        name: str | None = None,
        limiter: OutputLimiter | None = None,
        secondary_path_uncertainty: Any = None,
    ) -> None:
        if not isinstance(estimator, PowerBudgetKalmanFilter):
            raise TypeError(f"estimator must be a PowerBudgetKalmanFilter, got {type(estimator).__name__}")
        super().__init__(estimator.dim_x, secondary_path, amplifier=amplifier, limiter=limiter)
        self.estimator = estimator
        gains = new_covariance(np.zeros((1, 1)))
        self._state = PowerBudgetState(*self._common(), gains, new_numbers(), estimator.budget.state)
        self.name = name or "KF-PB"
        present = estimator.budget.state.guard.size
        if guard_filter(secondary_path_uncertainty, self.secondary_path) is not None and present != GUARD_TAPS:
            raise ValueError(
                f"secondary_path_uncertainty needs a guard of {GUARD_TAPS} taps in the estimator's budget, got {present}: "
                "make it with paths.guard_filter, or both with kf_pb"
            )
        self._uncertainty = as_uncertainty(secondary_path_uncertainty)

    def _read_rated_power(self) -> float | None:
        return self.estimator.rated_power

    def _take_rated_power(self, value: float) -> None:
        self.estimator.rated_power = value

    @property
    def weights(self) -> np.ndarray:
        """Estimate of the unconstrained control filter w, (L,); a copy."""
        return np.array(self.estimator.x, dtype=np.float64).reshape(-1)

    @property
    def control_filter(self) -> np.ndarray:
        """Control filter within the rated power, which generates y, (L,); a copy."""
        return self.estimator.control_filter

    @property
    def power_weight(self) -> float:
        """Weight lambda of the control power."""
        return self.estimator.power_weight

    @property
    def _powers_fs(self) -> float:
        return self.estimator.budget.fs

    def _after_new_path(self, before: np.ndarray) -> None:
        """Let P grow; measured paths, for example, have another distance from the new path, and so another guard."""
        variance = self._variance_by_new_path(before)
        if variance > 0.0:
            self.estimator.P = self.estimator.P + variance * np.eye(self.n_taps)
        if self._uncertainty is not None:
            self.estimator.budget.use_guard(guard_filter(self._uncertainty, self.secondary_path))

    def control_signal(self, reference: float) -> float:
        """Return the control signal y(n) for the newest reference sample x(n), from the weights of the last sample."""
        reference = as_number(reference, "reference")
        self._see_weights()
        return float(self._emit(reference))

    def _see_weights(self) -> None:
        """Copy the estimator's weights into the state."""
        self._state.weights[:] = np.reshape(self.estimator.x, -1)

    def update(self, error: float) -> None:
        """Adapt to the error e(n) that the last control signal left (eq. 2-9)."""
        error = as_number(error, "error")
        state = self._steppable_state()
        if state is None:
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
        self.estimator.update(d, H=h, reference=x, control_signal=self._y)
        powers.advance(d, h[0, 0], x)

    def _steppable_state(self) -> Any:
        """Return the state with the estimator's covariance; None if the estimator's step is not compiled."""
        estimator = self.estimator
        if type(estimator) is not PowerBudgetKalmanFilter or not estimator.steps_compiled():
            return None
        arrays, numbers = estimator.compiled_arrays()
        self._see_weights()
        if arrays is not self._state.gains or numbers is not self._state.numbers:
            self._state = self._state._replace(gains=arrays, numbers=numbers)
        return self._state

    def compiled_state(self) -> Any:
        """Return the state for the compiled steps; None if Python must call the steps."""
        state = self._steppable_state() if calls_of(type(self)) == calls_of(PowerBudgetController) else None
        if state is not None:
            state.numbers["variance"] = np.nan  # NaN until the first update
        return state

    def after_compiled(self, state: Any) -> None:
        """Give the estimator the results in `state`."""
        if not np.isnan(state.numbers["variance"][0]):
            self.estimator.after_compiled(state.weights.copy())

    def listen(self, references: np.ndarray, errors: np.ndarray, *, adapt: Any = True) -> None:
        """Follow the noise before the control is switched on; see `FilteredReferenceController.listen`."""
        self._see_weights()
        super().listen(references, errors, adapt=adapt)


FORMS = ("direct", "shared gain", "frequency domain")
PRIMARY_PATH_FORMS: dict[str, Any] = {"shared gain": SharedGainKalman, "frequency domain": FrequencyDomainKalman}


def kf_pb(
    n_taps: int | SuggestedSettings,
    secondary_path: Any,
    *,
    rated_power: Any,
    state_noise: float | None = None,
    measurement_noise: Any = None,
    initial_variance: float | None = None,
    n_references: int = 1,
    amplifier: Any = None,
    limiter: Any = None,
    secondary_path_uncertainty: Any = ONE_SAMPLE,
    form: str | None = None,
    **settings: Any,
) -> PowerBudgetController | DirectPowerBudget | PrimaryPathController:
    """Return KF-PB, the power-budgeted Kalman filter, which has the least error within the rated power.

    Parameters
    ----------
    n_taps : int or SuggestedSettings
        Taps L of a control filter. Or pass the result of `suggest_settings`, which also supplies the defaults of the
        sample rate and of the noises.
    secondary_path : array_like, shape (n_path,) or (K, J, n_path), or control system
        Estimated secondary path, or those from J loudspeakers to K microphones.
    rated_power : float or array_like, shape (J,)
        Rated output power, of all loudspeakers or of each.
    state_noise, measurement_noise, initial_variance
        As for `kf_anc`, for the direct form only.
    n_references, amplifier, limiter
        As for `kf_anc`. Behind its limiter, the direct form for one channel asks for more power only if that lowers the
        error (see `PowerBudget`).
    secondary_path_uncertainty : PathTolerance, float or array_like, optional
        How far the true secondary path may differ from the estimate, see `paths.path_uncertainty`; by default a
        sample of delay. The control filter is weaker where the path is less certain, and almost zero where control
        could make the noise much louder (with a sample of delay, above three eighths of the sample rate; with several
        loudspeakers above a quarter; with more microphones than loudspeakers above a sixth). If you have identified the
        path, pass the `uncertainty` of the result, which costs next to nothing. None: the path is exact.
    form : {"direct", "shared gain", "frequency domain"}, optional
        "direct" estimates the control filters (the paper's equations), in O(K (J I L)^2) per sample. "shared gain"
        estimates the primary paths (`SharedGainKalman`); "frequency domain" does the same for long paths
        (`FrequencyDomainKalman`). By default direct for one channel, shared gain for several.
    **settings
        Further settings. The direct form takes `fs`, `memory_s` and `averaging_s`, see `PowerBudget` for one channel and
        `DirectPowerBudget` for several. For the other forms, see their classes.

    Returns
    -------
    PowerBudgetController, DirectPowerBudget, SharedGainKalman or FrequencyDomainKalman
        The controller. Its `control_filter` generates the control signal. In the direct form, `weights` is the estimate
        of the unconstrained control filter.

    Raises
    ------
    ValueError, TypeError
        The direct form without suggested settings or `state_noise` and `measurement_noise`, another form with a setting
        of the direct form, another sample rate than that of the suggested settings, or a setting that the class refuses.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import kf_pb
    >>> kf_pb(8, [1.0], rated_power=0.5, state_noise=1e-6, measurement_noise=0.1).name
    'KF-PB'
    >>> paths = np.zeros((2, 2, 8))  # two loudspeakers, two microphones
    >>> paths[:, :, 1] = [[1.0, 0.3], [0.2, 1.0]]
    >>> kf_pb(32, paths, rated_power=[0.5, 0.2])
    <KF-PB (shared gain): 2 microphones, 2 loudspeakers, 1 reference, 32 taps, rated power 0.5, 0.2>
    """
    controller: PowerBudgetController | DirectPowerBudget | SharedGainKalman | FrequencyDomainKalman
    several = is_multichannel(secondary_path, n_references)
    form = as_choice(form or ("shared gain" if several else "direct"), "form", FORMS)
    common = {"rated_power": rated_power, "amplifier": amplifier, "limiter": limiter}
    channels = {"n_references": n_references, "secondary_path_uncertainty": secondary_path_uncertainty}
    noises = {
        "state_noise": state_noise,
        "measurement_noise": measurement_noise,
        "initial_variance": initial_variance,
    }
    if isinstance(n_taps, SuggestedSettings):
        settings = {"fs": n_taps.fs} | settings
    if form in PRIMARY_PATH_FORMS:
        given = [name for name, value in noises.items() if value is not None]
        if given:
            raise TypeError(f"the {form} form takes path_memory_s instead of {', '.join(given)}")
        taps = n_taps.n_taps if isinstance(n_taps, SuggestedSettings) else n_taps
        controller = PRIMARY_PATH_FORMS[form](taps, secondary_path, **channels, **common, **settings)
    else:
        taps, noises = with_suggested(n_taps, noises, ", or form='shared gain', which does not need them")
        settings |= noises
        if several:
            controller = DirectPowerBudget(taps, secondary_path, **channels, **common, **settings)
        else:
            guard = guard_filter(secondary_path_uncertainty, secondary_path)
            estimator = PowerBudgetKalmanFilter(taps, rated_power=rated_power, guard=guard, **settings)
            controller = PowerBudgetController(
                estimator,
                secondary_path,
                amplifier=amplifier,
                limiter=limiter,
                secondary_path_uncertainty=secondary_path_uncertainty,
            )
    return at_suggested_rate(controller, n_taps)
