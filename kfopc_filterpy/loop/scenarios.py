"""Many runs at the price of one filter: scenarios of one reference, whose Kalman gains are the same."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_positive, as_signal
from ..controllers.base import NO_SOLUTION, FilteredReferenceController
from ..controllers.step import Lines
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
from ..kernels.delay_lines import TAPS, delay_line, newest, refill
from ..kernels.stacking import member, stacked, unstack
from ..kernels.vectors import copy_into, dot
from ..paths.models import is_system, path_taps
from ..power.amplifiers import Amplifier, compiled_model
from ..power.constraint import DEFAULT_FS
from .result import SimulationResult
from .run import DIVERGED, REFUSED, RUNNING, Plant, Stretch, part_of, run_kept
from .simulation import (
    DIVERGENCE_LIMIT,
    POWERS,
    RECORDED,
    SensorNoise,
    disturbance_at_microphone,
    switch_on_sample,
)

BLOCK = 512  # samples for which the gains are kept
VARIANCES = ("state_noise", "measurement_noise", "alpha_sq")
SAFE = 1e290  # a correction below does not overflow weights that are finite


class SharedGains(NamedTuple):
    """The gains of a block of m samples, in place of a covariance."""

    directions: np.ndarray  # (m, n or more) g_k = S_k K_k
    norms: np.ndarray  # (m,) of g_k, which no magnitude in it exceeds
    variances: np.ndarray  # (m,) S_k
    taken: np.ndarray  # (1,) samples of the block that a scenario has taken


@kalman_step.register(SharedGains)
def shared_step(gains, w, h, scaled_measurement, state_noise, noise, alpha_sq):
    """Correct the weights with the gain of the sample (eq. 5, 9); the innovation is NaN if they would overflow."""
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
    """Fill `gains` for the rows that end with each sample of a block; return how many have a solution.

    `filtered` is the filtered reference, newest sample first: n - 1 + m of them.
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


@compiled(nogil=True)
def run_scenarios(states, plants, signals, limits, status, done, begin, end):
    """Run each scenario from sample `begin` to `end`, unless it has ended; all but the gains is stacked."""
    no_weights = np.empty((0, 0))
    for i in range(limits.size):
        if status[i] == RUNNING:
            states.gains.taken[0] = 0
            state, plant = member(states, i), member(plants, i)
            block = part_of(member(signals, i), begin, end)
            status[i], taken = run_kept(state, plant, block, no_weights, limits[i], 1, 0)
            done[i] += taken


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
    """Run Kalman controllers that share one gain sequence, as `simulate` would run each, to rounding.

    The gain (eq. 6) follows from the reference and the filter's r, q and P(0|0), not from what is measured. Scenarios
    that differ in rated power, amplifier, disturbance, true secondary path or sensor noise therefore need the filter's
    O(L^2) once, and O(L) each. The scenarios go on side by side and the gains are kept for one block only.

    What breaks the sharing: another reference (acoustic feedback makes one for each scenario: there is no
    `feedback_path` here), estimated secondary path, r, q or P(0|0), and any observation beside the disturbance that
    depends on the control signal, since its row would be each scenario's own.

    Parameters
    ----------
    controllers : sequence of KalmanController
        Of `kf_anc` and `kf_opc` filters, each its own object, that agree in taps, estimated secondary path, state and
        measurement noise, fading memory, covariance and the signals they have heard so far.
    reference : array_like
        (n_samples,) reference x of all.
    secondary_path : array_like, control.TransferFunction or list of them
        True secondary path, one for all or a list with one each.
    primary_path : array_like or control.TransferFunction, optional
        Path that makes the disturbance of all.
    disturbance : array_like, optional
        (n_samples,) disturbance of all, or (n_scenarios, n_samples), in place of `primary_path`.
    fs : float, default 16000
        Sample rate in Hz.
    amplifier : callable or sequence, optional
        One of the package's amplifier models for all, or one each; by default linear.
    rated_power : float, optional
        One for all, which sets the scale of the divergence limit only; by default each controller's own.
    sensor_noise_std : float or sequence of float, default 0
        Standard deviation of the sensor noise, one for all or one each.
    rng : int, numpy.random.Generator or sequence, optional
        Seed of the sensor noise: one (each scenario then hears the same noise, as runs with that seed would) or one
        each; Generators only one each.
    switch_on_s : float, default 0
        See `simulate`.
    record_powers : bool, default False
        See `simulate`.
    progress : callable, optional
        Called with the number of samples done since its last call.

    Returns
    -------
    list of SimulationResult
        One for each controller. Their signals lie in one array, which any of them keeps: copy what is to be kept alone.
        Each controller goes on from where its run ended; one that diverged, with the covariance of the end of the run.

    Raises
    ------
    ValueError
        Controllers that do not share, saying which and in what; lists of another length; what `simulate` refuses. In
        the midst of a run: weights that would overflow, an update without a solution. The controllers are then as they
        were, but for what they heard before they were switched on; so are they after an interruption.
    TypeError
        Something that is no `KalmanController`, or an amplifier that is none of the models.

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
    taps = paths.shape[1]
    plants = stacked([Plant(s, np.zeros(0), delay_line(taps), model) for s, model in zip(paths, models, strict=True)])
    gains = _GainSequence(states[0], x)
    own = [state._replace(gains=None) for state in states]
    scenarios = stacked(own)
    names = RECORDED + POWERS[:2] if record_powers else RECORDED
    recorded = {name: np.empty((count, x.size)) for name in names}
    signals = _signals(x, d, noises, recorded)
    status, done = np.full(count, RUNNING), np.zeros(count, np.int64)
    for first, shared, solved in gains.blocks():
        run_scenarios(scenarios._replace(gains=shared), plants, signals, limits, status, done, first, first + solved)
        _raise_if_refused(status, done, first + solved if solved < shared.variances.size else None)
        if progress:
            progress(count * solved)
    for signal in recorded.values():
        for i, end in enumerate(done):
            signal[i, end:] = np.nan
    for i, (controller, state) in enumerate(zip(controllers, states, strict=True)):
        unstack(scenarios, i, own[i])
        gains.refill(state.lines)  # one that diverged has not heard the end
        controller.after_compiled(state._replace(gains=gains.covariance), shared=True)
    return [
        SimulationResult(
            algorithm=controller.name,
            fs=fs,
            rated_power=rated[i],
            reference=x,
            disturbance=d[i if len(d) > 1 else 0],
            **{name: signal[i] for name, signal in recorded.items()},
            diverged_at_s=done[i] / fs if status[i] == DIVERGED else None,
        )
        for i, controller in enumerate(controllers)
    ]


def _signals(x: np.ndarray, d: np.ndarray, noises: list[SensorNoise], recorded: dict[str, np.ndarray]) -> Stretch:
    """Return the stacked signals of the run; one row serves all scenarios, also for what is not recorded."""
    silent = np.zeros((1, x.size))
    noisy = any(noise.std for noise in noises)
    sensed = np.array([np.zeros(x.size) + noise.take(x.size) for noise in noises]) if noisy else silent
    left = (recorded.get(name, np.empty((1, x.size))) for name in RECORDED + POWERS)
    return Stretch(x[None], d, sensed, *left)


def _states_that_share(controllers: list[Any], fs: float) -> list[Any]:
    """States of the controllers for the compiled loop, or an error that says which one differs in what."""
    if not controllers:
        raise ValueError("controllers must hold one controller at least")
    states = []
    for i, controller in enumerate(controllers):
        if not isinstance(controller, FilteredReferenceController) or not controller.has_gains:
            raise TypeError(f"controllers[{i}] must be a KalmanController, got {controller!r}")
        if any(controller is other or _filter(controller) is _filter(other) for other in controllers[:i]):
            raise ValueError(f"controllers[{i}] is in the list twice: each scenario needs a controller of its own")
        controller.require_sample_rate(fs)
        state = controller.compiled_state(to_step=False)
        if state is None:
            raise ValueError(
                f"controllers[{i}] takes filterpy's own equations or steps of its own; scenarios share the gains of "
                "KalmanControllers of filters from KFOPC.random_walk"
            )
        for what in (controller.unshared, "limiter" if state.lines.limiter is not None else ""):
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
    """In what two states do not share, in words."""
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
    """One for each scenario: a list, tuple or array as it is, anything else for all."""
    if not isinstance(value, list | tuple) and np.ndim(value) == 0:
        return [value] * count
    if len(value) != count:
        raise ValueError(f"{name} must be one value or {count}, one for each controller, got {len(value)}")
    return list(value)


def _several(value: Any) -> bool:
    """Whether it is a list of signals or paths, and not one of them."""
    if isinstance(value, np.ndarray):
        return value.ndim > 1
    return isinstance(value, list | tuple) and len(value) > 0 and (is_system(value[0]) or np.ndim(value[0]) > 0)


def _seeds(rng: Any, count: int) -> list[Any]:
    """Seeds or generators; a generator serves one scenario, or they would draw from it in turns."""
    each = _each(rng, count, "rng")
    generators = [id(one) for one in each if isinstance(one, np.random.Generator)]
    if len(set(generators)) < len(generators):
        raise ValueError("rng holds one Generator for several controllers: give each its own, or seeds")
    return each


def _disturbances(x: np.ndarray, primary_path: Any, disturbance: Any, fs: float, count: int) -> np.ndarray:
    """(count, n_samples), one row where one serves all; an array of its own."""
    if not _several(disturbance):
        return disturbance_at_microphone(x, primary_path, disturbance, fs)[None].copy()
    each = _each(disturbance, count, "disturbance")
    return np.array([disturbance_at_microphone(x, primary_path, own, fs) for own in each])


def _stacked_paths(secondary_path: Any, fs: float, count: int) -> np.ndarray:
    """(count, taps), shorter ones with zeros at the end."""
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
    """The gains of a run, a block at a time in the same arrays, from a copy of the covariance."""

    def __init__(self, state: Any, x: np.ndarray) -> None:
        self.covariance: Covariance = copy_covariance(state.gains)
        self._settings = [float(state.numbers[name][0]) for name in VARIANCES]
        n, lines = state.weights.size, state.lines
        heard = newest(lines.reference, int(lines.reference[TAPS]))[::-1]
        self._reference = np.concatenate((heard, x))
        filtered = np.convolve(self._reference, lines.secondary_estimate)[heard.size : heard.size + x.size]
        self.n_taps, self.n_samples = n, x.size
        self._filtered = np.concatenate(
            (newest(lines.filtered, n - 1)[::-1], filtered)
        )  # n - 1 samples before the first

    def refill(self, lines: Lines) -> None:
        """Make the end of the run what the delay lines hold."""
        refill(lines.reference, self._reference[::-1])
        refill(lines.filtered, self._filtered[::-1])

    def blocks(self) -> Iterator[tuple[int, SharedGains, int]]:
        """Yield the first sample of each block, its gains, and how many of them have a solution."""
        n = self.n_taps
        for first in range(0, self.n_samples, BLOCK):
            m = min(BLOCK, self.n_samples - first)
            if m < BLOCK or first == 0:
                gains = SharedGains(aligned_zeros(m, n), np.zeros(m), np.full(m, np.nan), np.zeros(1, np.int64))
            rows = self._filtered[first : first + n - 1 + m][::-1].copy()
            yield first, gains, advance_gains(self.covariance, rows, *self._settings, gains)


def _raise_if_refused(status: np.ndarray, done: np.ndarray, unsolved: int | None) -> None:
    for i in np.flatnonzero(status == REFUSED):
        raise ValueError(
            f"the weights of controllers[{i}] would overflow in sample {done[i]} of the run: "
            "its disturbance estimate or residual is too large"
        )
    if unsolved is not None:
        raise ValueError(f"{NO_SOLUTION} (sample {unsolved} of the run)")
