"""Many runs at the cost of one filter: scenarios with the same reference have the same Kalman gains."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_positive, as_signal
from ..controllers.base import NO_SOLUTION, FilteredReferenceController
from ..controllers.compiled_controller import CompiledController
from ..controllers.step import Compiled, Lines, looped_arrays
from ..core.running import DIVERGED, REFUSED_ERROR, RUNNING, Plant, Record, Signals
from ..kernels.compiling import compiled
from ..kernels.covariance import (
    CANCELLATION,
    Covariance,
    aligned_zeros,
    copy_covariance,
    correct_weights,
    covariance_matrix,
    downdate_carefully,
    downdate_covariance,
    kalman_step,
    predict_covariance,
    project_covariance,
)
from ..kernels.delay_lines import TAPS, newest, refill
from ..kernels.vectors import copy_into, dot
from ..paths.models import is_system, path_taps
from ..power.amplifiers import Amplifier, compiled_model
from ..power.constraint import DEFAULT_FS
from .inputs import DIVERGENCE_LIMIT, SensorNoise, disturbance_at_microphone, switch_on_sample
from .result import SimulationResult
from .simulation import POWERS, RECORDED

RESULTS = ("error", "control_signal", "amplifier_output", "anti_noise")
BLOCK = 512  # samples whose gains are stored at a time
VARIANCES = ("state_noise", "measurement_noise", "alpha_sq")
SAFE = 1e290  # a smaller correction cannot overflow finite weights


class SharedGains(NamedTuple):
    """The gains of a block of m samples, used instead of a covariance."""

    directions: np.ndarray  # (m, n or more) g_k = S_k K_k
    norms: np.ndarray  # (m,) of g_k, a bound on its elements
    variances: np.ndarray  # (m,) S_k
    taken: np.ndarray  # (1,) samples of the block that a scenario has processed


@kalman_step.register(SharedGains)
def shared_step(gains, w, h, scaled_measurement, state_noise, noise, alpha_sq):
    """Correct the weights with the gain of the sample (eq. 5, 9); return NaN as innovation if they would overflow."""
    k = gains.taken[0]
    S = gains.variances[k]
    y = scaled_measurement - dot(h, w)
    if not abs(y / S) * gains.norms[k] < SAFE:
        return np.nan, S
    correct_weights(w, gains.directions[k], y / S)
    gains.taken[0] = k + 1
    return y, S


@compiled(nogil=True)
def advance_gains(cov, filtered, state_noise, noise, alpha_sq, gains):
    """Set the gains of the samples of a block; return the number of samples before the first without a solution.

    `filtered` holds n - 1 + m samples of the filtered reference, newest first.
    """
    n, m = cov.product.size, gains.variances.size
    for k in range(m):
        h = filtered[m - 1 - k : m - 1 - k + n]
        predict_covariance(cov, alpha_sq, state_noise)
        S = project_covariance(cov, h) + noise
        if not 0.0 < S < np.inf:
            return k
        if S / noise > CANCELLATION and downdate_carefully(cov, h, noise):
            S = 1.0 / cov.owed[0].last_inverse_S
        else:
            downdate_covariance(cov, S)
        copy_into(gains.directions[k], cov.gain_direction)
        gains.variances[k], gains.norms[k] = S, np.sqrt(dot(cov.gain_direction, cov.gain_direction))
    return m


class _Scenario:
    """One of the runs: a copy of its controller's state, its plant and its signals."""

    def __init__(self, state: Any, plant: Plant, signals: Signals, recorded: dict[str, np.ndarray]) -> None:
        self.state = deepcopy(state)
        self._plant, self._signals, self._recorded = plant, signals, recorded
        self._code: Compiled | None = None
        self.status, self.done = RUNNING, 0

    def run(self, shared: SharedGains, begin: int, end: int) -> None:
        """Run from sample `begin` to `end` with the gains of the block, if it has not ended."""
        if self.status != RUNNING:
            return
        if self._code is None or self._code.held.state.gains is not shared:
            self._code = Compiled(self.state._replace(gains=shared))
        shared.taken[0] = 0
        _, sources = looped_arrays(self._code.held.state)
        records = [Record(sources[name], signal) for name, signal in self._recorded.items()]
        self.status, self.done = self._plant.run(self._code.steps, self._signals, records, begin, end)

    def give_back(self, state: Any) -> None:
        """Write the present state into the arrays of the controller's."""
        for own, theirs in zip(_arrays(self.state), _arrays(state._replace(gains=None)), strict=True):
            theirs[...] = own


def _arrays(value: Any) -> Iterator[np.ndarray]:
    """Yield the arrays of a state."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from _arrays(item)


def simulate_scenarios(
    controllers: Sequence[Any],
    reference: Any,
    *,
    secondary_path: Any,
    primary_path: Any = None,
    disturbance: Any = None,
    fs: float = DEFAULT_FS,
    amplifier: Amplifier | Sequence[Amplifier | None] | None = None,
    rated_power: float | None = None,
    sensor_noise_std: float | Sequence[float] = 0.0,
    rng: Any = None,
    switch_on_s: float = 0.0,
    record_powers: bool = False,
    progress: Callable[[int], Any] | None = None,
) -> list[SimulationResult]:
    """Run Kalman controllers that share one gain sequence; to rounding, the results are those of `simulate` for each.

    The gain (eq. 6) depends on the reference and the filter's r, q and P(0|0), not on the measurements. Scenarios that
    differ in rated power, amplifier, disturbance, true secondary path or sensor noise therefore need the filter's
    O(L^2) only once, and O(L) each. The scenarios run side by side, and only the gains of one block are stored.

    Scenarios cannot share gains if they differ in the reference, the estimated secondary path, r, q or P(0|0). Acoustic
    feedback would give each scenario its own reference, so there is no `feedback_path` here. A second observation that
    depends on the control signal would give each scenario its own row, so it is not supported either.

    Parameters
    ----------
    controllers : sequence of KalmanController
        Separate objects with `kf_anc` or `kf_opc` filters. They must agree in taps, estimated secondary path, state and
        measurement noise, fading memory, covariance and the signals heard so far.
    reference : array_like
        (n_samples,) reference x, the same for all.
    secondary_path : array_like, control.TransferFunction or list of them
        True secondary path, one for all or a list with one each.
    primary_path : array_like or control.TransferFunction, optional
        Path from the reference to the error microphone, which gives the disturbance of all.
    disturbance : array_like, optional
        (n_samples,) disturbance of all, or (n_scenarios, n_samples), in place of `primary_path`.
    fs : float, default 16000
        Sample rate in Hz.
    amplifier : callable or sequence, optional
        One of the package's amplifier models for all, or one each; by default linear.
    rated_power : float, optional
        Scale of the divergence limit, one for all; by default each controller's own rated power.
    sensor_noise_std : float or sequence of float, default 0
        Standard deviation of the sensor noise, one for all or one each.
    rng : int, numpy.random.Generator or sequence, optional
        Seed of the sensor noise. With one seed, each scenario has the same noise, as separate runs with that seed
        would. Otherwise one seed each. Generators must be given one each.
    switch_on_s : float, default 0
        See `simulate`.
    record_powers : bool, default False
        See `simulate`.
    progress : callable, optional
        Called with the number of samples done since its last call.

    Returns
    -------
    list of SimulationResult
        One for each controller. Their signals are views of shared arrays, which stay in memory as long as any of the
        results: copy the signals you want to keep alone. Each controller continues from the end of its run; one that
        diverged has the covariance of the end of the whole run.

    Raises
    ------
    ValueError
        Controllers that cannot share gains (the message says which and why), lists of another length, or arguments that
        `simulate` refuses. During a run: weights that would overflow, or an update without a solution. The controllers
        are then unchanged, except for what they heard before they were switched on. The same holds after an
        interruption.
    TypeError
        An object that is not a `KalmanController`, or an amplifier that is not one of the package's models.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import kf_opc, output_power, simulate_scenarios
    >>> x = np.random.default_rng(0).standard_normal(16000)
    >>> budgets = [0.1, 0.2, 0.4]
    >>> filters = [
    ...     kf_opc(16, [0.0, 1.0], rated_power=p, state_noise=1e-9, measurement_noise=1e-3) for p in budgets
    ... ]
    >>> results = simulate_scenarios(filters, x, secondary_path=[0.0, 1.0], primary_path=[0.0, 0.0, 0.0, 1.0])
    >>> [round(output_power(r.control_signal), 1) for r in results]
    [0.1, 0.2, 0.4]
    """
    fs = as_positive(fs, "fs", unit="Hz")
    x = as_signal(reference, "reference").copy()  # the results keep it, read-only
    if isinstance(controllers, FilteredReferenceController):
        raise TypeError("controllers must be a sequence of controllers: [controller] for one")
    controllers = list(controllers)
    states = _states_that_share(controllers, fs)
    count = len(controllers)
    d = _disturbances(x, primary_path, disturbance, fs, count)
    noises = [
        SensorNoise(std, seed)
        for std, seed in zip(_each(sensor_noise_std, count, "sensor_noise_std"), _seeds(rng, count), strict=True)
    ]
    rated = [c.rated_power if rated_power is None else as_positive(rated_power, "rated_power") for c in controllers]
    paths = _stacked_paths(secondary_path, fs, count)
    models = [_model(own) for own in _each(amplifier, count, "amplifier")]
    on = switch_on_sample(switch_on_s, fs, x.size)
    if on:
        for i, (controller, noise) in enumerate(zip(controllers, noises, strict=True)):
            controller.listen(x[:on], d[i if len(d) > 1 else 0, :on] + noise.take(on))
        x, d = x[on:], np.ascontiguousarray(d[:, on:])

    limits = DIVERGENCE_LIMIT * np.sqrt([1.0 if p is None else p for p in rated])
    gains = _GainSequence(states[0], x)
    names = RECORDED + POWERS[:2] if record_powers else RECORDED
    recorded = {name: np.full((count, x.size), np.nan) for name in (*RESULTS, *names)}
    scenarios = []
    for i, state in enumerate(states):
        own = {name: signal[i : i + 1] for name, signal in recorded.items()}
        signals = Signals(
            x[None],
            d[i : i + 1] if len(d) > 1 else d,
            noises[i].filled(own["error"]),
            *(own.pop(name) for name in RESULTS),
        )
        plant = Plant(
            paths[i, None, None], np.zeros((1, 1, 0)), models[i].view(np.float64).reshape(1, -1), limits[i : i + 1]
        )
        scenarios.append(_Scenario(state._replace(gains=None), plant, signals, own))
    for first, shared, solved in gains.blocks():
        for scenario in scenarios:
            scenario.run(shared, first, first + solved)
        _raise_if_refused(scenarios, first + solved if solved < shared.variances.size else None)
        if progress:
            progress(count * solved)
    for signal in recorded.values():
        for i, scenario in enumerate(scenarios):
            signal[i, scenario.done :] = np.nan
    for controller, state, scenario in zip(controllers, states, scenarios, strict=True):
        scenario.give_back(state)
        gains.refill(state.lines)  # a scenario that diverged has not heard the end
        if scenario.status == DIVERGED:
            refill(state.lines.output, np.zeros(state.lines.output.size))  # its loudspeaker was switched off
        controller.after_compiled(state._replace(gains=gains.covariance), shared=True)
    return [
        SimulationResult(
            algorithm=controller.name,
            fs=fs,
            rated_power=rated[i],
            reference=x,
            disturbance=d[i if len(d) > 1 else 0],
            **{name: signal[i] for name, signal in recorded.items()},
            diverged_at_s=scenarios[i].done / fs if scenarios[i].status == DIVERGED else None,
        )
        for i, controller in enumerate(controllers)
    ]


def _states_that_share(controllers: list[Any], fs: float) -> list[Any]:
    """Return the controllers' states for the compiled loop, or raise an error that names a difference."""
    if not controllers:
        raise ValueError("controllers must hold one controller at least")
    states = []
    for i, controller in enumerate(controllers):
        if not isinstance(controller, CompiledController) or not controller.has_gains:
            raise TypeError(f"controllers[{i}] must be a KalmanController, of one channel, got {controller!r}")
        if any(controller is other or _filter(controller) is _filter(other) for other in controllers[:i]):
            raise ValueError(f"controllers[{i}] is in the list twice: each scenario needs its own controller")
        controller.require_sample_rate(fs)
        state = controller.compiled_state(to_step=False)
        if state is None:
            raise ValueError(
                f"controllers[{i}] takes filterpy's own equations or steps of its own; scenarios share the gains of "
                "KalmanControllers of filters from KFOPC.random_walk"
            )
        parts = {"limiter": state.lines.limiter, "secondary-path uncertainty": state.lines.guard}
        for what in (controller.unshared, *(name for name, part in parts.items() if part is not None)):
            if what:
                raise ValueError(f"controllers[{i}] has a {what}, which scenarios do not run: use simulate for it")
        states.append(state)
    for i, state in enumerate(states[1:], 1):
        difference = _difference(states[0], state)
        if difference:
            raise ValueError(f"controllers[0] and controllers[{i}] must agree in {difference} to share gains")
    return states


def _filter(controller: Any) -> Any:
    return controller.estimator


def _difference(one: Any, other: Any) -> str | None:
    """Return what prevents two states from sharing gains, in words; None if nothing does."""
    if one.weights.size != other.weights.size:
        return "n_taps"
    if one.gains.triangle.dtype != other.gains.triangle.dtype:
        return "dtype"
    if not np.array_equal(one.lines.secondary_estimate, other.lines.secondary_estimate):
        return "their estimated secondary path"
    if any(one.numbers[name][0] != other.numbers[name][0] for name in VARIANCES):
        return "state noise, measurement noise and fading memory"
    if one.constraint.window.shape != other.constraint.window.shape:
        return "the length of the sliding windows of their powers"
    for mine, theirs in ((one.lines.reference, other.lines.reference), (one.lines.filtered, other.lines.filtered)):
        if not np.array_equal(newest(mine, int(mine[TAPS])), newest(theirs, int(theirs[TAPS]))):
            return "the reference heard so far"
    a, b = one.gains, other.gains
    if a.triangle is b.triangle:  # they ran together
        return None
    same = np.array_equal(a.triangle, b.triangle) and np.array_equal(a.owed, b.owed) and not a.owed["inverse_S"][0]
    if not same:
        same = np.array_equal(covariance_matrix(a), covariance_matrix(b))
    return None if same else "their covariance P"


def _each(value: Any, count: int, name: str) -> list[Any]:
    """Return a list of one value per scenario: from a list, tuple or array, or the same value for all."""
    if not isinstance(value, list | tuple) and np.ndim(value) == 0:
        return [value] * count
    if len(value) != count:
        raise ValueError(f"{name} must be one value or {count}, one for each controller, got {len(value)}")
    return list(value)


def _several(value: Any) -> bool:
    """Return whether `value` is a list of signals or paths, and not a single one."""
    if isinstance(value, np.ndarray):
        return value.ndim > 1
    return isinstance(value, list | tuple) and len(value) > 0 and (is_system(value[0]) or np.ndim(value[0]) > 0)


def _seeds(rng: Any, count: int) -> list[Any]:
    """Return seeds or Generators, one each. A Generator must not be shared: scenarios would draw from it in turns."""
    each = _each(rng, count, "rng")
    generators = [id(one) for one in each if isinstance(one, np.random.Generator)]
    if len(set(generators)) < len(generators):
        raise ValueError("rng holds one Generator for several controllers: give each its own, or seeds")
    return each


def _disturbances(x: np.ndarray, primary_path: Any, disturbance: Any, fs: float, count: int) -> np.ndarray:
    """Return the disturbances as a new array (count, n_samples), or (1, n_samples) if all have the same one."""
    if not _several(disturbance):
        return disturbance_at_microphone(x, primary_path, disturbance, fs)[None].copy()
    each = _each(disturbance, count, "disturbance")
    return np.array([disturbance_at_microphone(x, primary_path, own, fs) for own in each])


def _stacked_paths(secondary_path: Any, fs: float, count: int) -> np.ndarray:
    """Return the paths as an array (count, taps), shorter ones padded with zeros."""
    paths = _each(secondary_path, count, "secondary_path") if _several(secondary_path) else [secondary_path] * count
    taps = [path_taps(path, fs=fs, name="secondary_path") for path in paths]
    stacked = np.zeros((count, max(t.size for t in taps)))
    for row, own in zip(stacked, taps, strict=True):
        row[: own.size] = own
    return stacked


def _model(amplifier: Amplifier | None) -> np.ndarray:
    model = compiled_model(amplifier)
    if model is None:
        raise TypeError(
            f"amplifier must be one of the package's models or None, got {amplifier!r}; use simulate for it"
        )
    return model


class _GainSequence:
    """The gains of a run, computed block by block in the same arrays, from a copy of the covariance."""

    def __init__(self, state: Any, x: np.ndarray) -> None:
        self.covariance: Covariance = copy_covariance(state.gains)
        self._settings = [float(state.numbers[name][0]) for name in VARIANCES]
        n, lines = state.weights.size, state.lines
        heard = newest(lines.reference, int(lines.reference[TAPS]))[::-1]
        self._reference = np.concatenate((heard, x))
        filtered = np.convolve(self._reference, lines.secondary_estimate)[heard.size : heard.size + x.size]
        self.n_taps, self.n_samples = n, x.size
        older = newest(lines.filtered, int(lines.filtered[TAPS]))[::-1]
        self._all_filtered = np.concatenate((older, filtered))
        self._filtered = self._all_filtered[older.size - (n - 1) :]  # from n - 1 samples before the first on

    def refill(self, lines: Lines) -> None:
        """Fill the delay lines with the end of the run."""
        refill(lines.reference, self._reference[::-1])
        refill(lines.filtered, self._all_filtered[::-1])

    def blocks(self) -> Iterator[tuple[int, SharedGains, int]]:
        """Yield the first sample of each block, its gains, and how many of them were computed before a failure."""
        n = self.n_taps
        for first in range(0, self.n_samples, BLOCK):
            m = min(BLOCK, self.n_samples - first)
            if m < BLOCK or first == 0:
                gains = SharedGains(aligned_zeros(m, n), np.zeros(m), np.full(m, np.nan), np.zeros(1, np.int64))
            rows = self._filtered[first : first + n - 1 + m][::-1].copy()
            yield first, gains, advance_gains(self.covariance, rows, *self._settings, gains)


def _raise_if_refused(scenarios: list[_Scenario], unsolved: int | None) -> None:
    for i, scenario in enumerate(scenarios):
        if scenario.status == REFUSED_ERROR:
            raise ValueError(
                f"the weights of controllers[{i}] would overflow in sample {scenario.done} of the run: "
                "its disturbance estimate or residual is too large"
            )
    if unsolved is not None:
        raise ValueError(f"{NO_SOLUTION} (sample {unsolved} of the run)")
