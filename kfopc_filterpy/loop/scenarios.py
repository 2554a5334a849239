"""Many runs at the price of one filter: scenarios of one reference, whose Kalman gains are the same."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from .._validate import as_choice, as_positive, as_signal
from ..controllers.base import NO_SOLUTION
from ..controllers.kalman import KalmanController
from ..kernels.block import Block
from ..kernels.covariance import INVERSE_S, aligned_zeros, copy_covariance, covariance_matrix
from ..kernels.delay_lines import TAPS, newest, refill
from ..paths.models import is_system, path_taps
from ..power.amplifiers import Amplifier, compiled_parameters
from ..power.constraint import DEFAULT_FS
from .lockstep import DONE, LANES, LAST_UPDATE, STATUS, TABLE, Scenarios, SharedBlock, of_lanes, run_block, stacked
from .result import SimulationResult
from .run import DIVERGED, REFUSED, ControllerState
from .simulation import DIVERGENCE_LIMIT, SensorNoise, disturbance_at_microphone, switch_on_sample

BLOCK = 256
ADVANCE = {"streaming": "advance_by_steps", "block": "advance", "pairs": "advance_in_pairs"}


def simulate_scenarios(
    controllers: Sequence[KalmanController],
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
    kernel: str = "pairs",
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
    kernel : {"pairs", "streaming", "block"}, default "pairs"
        How the gains are made: two samples at a time, sample by sample (as float32 filters and fading memories are in
        any case), or in matrix products. Equal to rounding; which is fastest is the machine's matter
        (``python -m comparisons speed``).

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
    as_choice(kernel, "kernel", tuple(ADVANCE))
    fs = as_positive(fs, "fs", unit="Hz")
    x = as_signal(reference, "reference").copy()  # the results keep it, read-only
    if isinstance(controllers, KalmanController):
        raise TypeError("controllers must be a sequence of controllers: [controller] for one")
    controllers = list(controllers)
    states = _states_that_share(controllers, fs)
    if kernel == "block" and states[0].covariance.triangle.dtype != np.float64:
        raise ValueError('kernel="block" needs filters of dtype float64: its products cancel too much in float32')
    count = len(controllers)
    d = _disturbances(x, primary_path, disturbance, fs, count)
    noises = [
        SensorNoise(std, seed)
        for std, seed in zip(_each(sensor_noise_std, count, "sensor_noise_std"), _seeds(rng, count), strict=True)
    ]
    rated = [c.rated_power if rated_power is None else as_positive(rated_power, "rated_power") for c in controllers]
    paths = _stacked_paths(secondary_path, fs, count)
    amplifiers = np.array([_parameters(a) for a in _each(amplifier, count, "amplifier")])
    on = switch_on_sample(switch_on_s, fs, x.size)
    if on:
        for i, (controller, noise) in enumerate(zip(controllers, noises, strict=True)):
            controller.listen(x[:on], d[i if len(d) > 1 else 0, :on] + noise.take(on))
        x, d = x[on:], np.ascontiguousarray(d[:, on:])

    limits = DIVERGENCE_LIMIT * np.sqrt([1.0 if p is None else p for p in rated])
    scenarios = stacked(states, paths, amplifiers, limits, BLOCK)
    gains = _SharedGains(states[0], x, kernel)
    # An odd number of cache lines (8 values) to a row: at a power of two all rows would fall on the same places of the
    # cache, which as many scenarios write in turn.
    recorded = np.empty((count, 7 if record_powers else 5, (-(-x.size // 8) | 1) * 8))
    noisy = any(noise.std for noise in noises)
    for first, shared in gains.blocks():
        length = len(shared.variances)
        if noisy:
            sensed = np.array([np.broadcast_to(noise.take(length), (length,)) for noise in noises])
        else:
            sensed = np.zeros((1, length))
        solved = length if np.isfinite(shared.variances[-1]) else int(np.isnan(shared.variances).argmax())
        run_block(scenarios, shared, d, sensed, recorded, first, solved)
        _raise_where_refused(scenarios, first + solved if solved < length else None)
        if progress:
            progress(count * length)
    gains.hand_back(controllers, states, scenarios)
    diverged, done = of_lanes(scenarios, STATUS) == DIVERGED, of_lanes(scenarios, DONE).astype(int)
    return [
        _result(c, fs, rated[i], x, d[i if len(d) > 1 else 0], recorded[i], int(done[i, 0]), bool(diverged[i, 0]))
        for i, c in enumerate(controllers)
    ]


def _result(
    controller: KalmanController,
    fs: float,
    rated_power: float | None,
    x: np.ndarray,
    d: np.ndarray,
    recorded: np.ndarray,
    end: int,
    diverged: bool,
) -> SimulationResult:
    recorded = recorded[:, : x.size]
    recorded[:, end:] = np.nan
    e, y, y_amplified, a, factor, *powers = recorded
    return SimulationResult(
        algorithm=controller.name,
        fs=fs,
        rated_power=rated_power,
        reference=x,
        disturbance=d,
        error=e,
        control_signal=y,
        amplifier_output=y_amplified,
        anti_noise=a,
        constraint_factor=factor,
        disturbance_power=powers[0] if powers else None,
        secondary_path_gain=powers[1] if powers else None,
        diverged_at_s=end / fs if diverged else None,
    )


def _states_that_share(controllers: list[Any], fs: float) -> list[ControllerState]:
    """States of the controllers for the compiled loop, or an error that says which one differs in what."""
    if not controllers:
        raise ValueError("controllers must hold one controller at least")
    states = []
    for i, controller in enumerate(controllers):
        if not isinstance(controller, KalmanController):
            raise TypeError(f"controllers[{i}] must be a KalmanController, got {controller!r}")
        if any(controller is other or controller.estimator is other.estimator for other in controllers[:i]):
            raise ValueError(f"controllers[{i}] is in the list twice: each scenario needs a controller of its own")
        controller.require_sample_rate(fs)
        state = controller.compiled_state(to_step=False)
        if state is None:
            raise ValueError(
                f"controllers[{i}] takes filterpy's own equations or steps of its own; scenarios share the gains of "
                "KalmanControllers of filters from KFOPC.random_walk"
            )
        own = {"power budget": state.budget, "repaired gain": state.repair, "limiter": state.limiter}
        for what, present in own.items():
            if present is not None:
                raise ValueError(f"controllers[{i}] has a {what}, which scenarios do not run: use simulate for it")
        states.append(state)
    for i, state in enumerate(states[1:], 1):
        difference = _difference(states[0], state)
        if difference:
            raise ValueError(f"controllers[0] and controllers[{i}] must agree in {difference} to share gains")
    return states


def _difference(one: ControllerState, other: ControllerState) -> str | None:
    """In what two states do not share, in words."""
    if one.weights.size != other.weights.size:
        return "n_taps"
    if one.covariance.triangle.dtype != other.covariance.triangle.dtype:
        return "dtype"
    if not np.array_equal(one.secondary_estimate, other.secondary_estimate):
        return "their estimated secondary path"
    if not np.array_equal(one.settings, other.settings):
        return "state noise, measurement noise and fading memory"
    if one.constraint.window.shape != other.constraint.window.shape:
        return "the length of the sliding windows of their powers"
    for mine, theirs in ((one.reference, other.reference), (one.filtered, other.filtered)):
        if not np.array_equal(newest(mine, int(mine[TAPS])), newest(theirs, int(theirs[TAPS]))):
            return "the reference heard so far"
    a, b = one.covariance, other.covariance
    if a.triangle is b.triangle:  # they ran together
        return None
    if a.owed[INVERSE_S] == b.owed[INVERSE_S] == 0.0:
        same = np.array_equal(a.owed[:2], b.owed[:2]) and np.array_equal(a.triangle, b.triangle)
    else:
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


def _parameters(amplifier: Amplifier | None) -> np.ndarray:
    parameters = compiled_parameters(amplifier)
    if parameters is None:
        raise TypeError(
            f"amplifier must be one of the package's models or None, got {amplifier!r}; use simulate for it"
        )
    return parameters


class _SharedGains:
    """The gains of a run, a block at a time in the same arrays, from a copy of the covariance."""

    def __init__(self, state: ControllerState, x: np.ndarray, kernel: str) -> None:
        n, s = state.weights.size, state.secondary_estimate
        self.state, self.kernel = state._replace(covariance=copy_covariance(state.covariance)), kernel
        heard = newest(state.reference, int(state.reference[TAPS]))[::-1]
        self.heard, self.n_samples = heard.size, x.size
        self.reference = np.concatenate((heard, x))
        self.filtered = np.convolve(self.reference, s)[: self.reference.size]
        self.filtered[self.heard - n : self.heard] = newest(state.filtered, n)[::-1]
        # Newest first, so that each row is a slice.
        self.reference, self.filtered = self.reference[::-1].copy(), self.filtered[::-1].copy()
        self._reference_rows, self._filtered_rows = (
            sliding_window_view(signal, n)[::-1] for signal in (self.reference, self.filtered)
        )

    def blocks(self) -> Iterator[tuple[int, SharedBlock]]:
        """First sample and gains of each block."""
        n = self.state.weights.size
        for first in range(0, self.n_samples, BLOCK):
            size = min(BLOCK, self.n_samples - first)
            if size < BLOCK or first == 0:
                block, references = Block(n, size), aligned_zeros(size, n)
            rows = slice(first + self.heard - n + 1, first + self.heard - n + 1 + size)
            references[:, :n] = self._reference_rows[rows]
            block.rows[:, :n] = self._filtered_rows[rows]
            advance = getattr(block, ADVANCE[self.kernel])
            variances = advance(self.state.covariance, *self.state.settings.tolist())
            norms = np.sqrt(np.einsum("ij,ij->i", block.directions, block.directions))
            yield first, SharedBlock(references, block.rows, block.directions, norms, variances)

    def hand_back(
        self, controllers: list[KalmanController], states: list[ControllerState], scenarios: Scenarios
    ) -> None:
        """Leave each controller as its scenario left it; all read one covariance until they step."""
        last, tables = of_lanes(scenarios, LAST_UPDATE, 3), scenarios.table
        if tables is None:
            tables = of_lanes(scenarios, TABLE, 18).reshape(-1, 6, 3)
        taps = scenarios.secondary_estimate.shape[1]  # past samples at the beginning of a line
        heard = scenarios.output[:, taps - 1 :: -1].swapaxes(1, 2).reshape(-1, taps)
        for i, (controller, state) in enumerate(zip(controllers, states, strict=True)):
            refill(state.reference, self.reference)
            refill(state.filtered, self.filtered)
            refill(state.output, heard[i])
            state.weights[:] = scenarios.weights[i, : state.weights.size]
            state.constraint.table[:] = tables[i]
            if scenarios.window is not None:
                state.constraint.window[:] = scenarios.window[i]
            state.last[:] = last[i]
            controller.after_compiled(state._replace(covariance=self.state.covariance), shared=True)


def _raise_where_refused(scenarios: Scenarios, unsolved: int | None) -> None:
    for i in np.flatnonzero(scenarios.lanes[:, STATUS : STATUS + LANES] == REFUSED):
        raise ValueError(
            f"the weights of controllers[{i}] would overflow in sample {of_lanes(scenarios, DONE)[i, 0]:.0f} of the run: "
            "its disturbance estimate or residual is too large"
        )
    if unsolved is not None:
        raise ValueError(f"{NO_SOLUTION} (sample {unsolved} of the run)")
