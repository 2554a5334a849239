"""Many runs at the cost of one filter: scenarios with the same reference have the same Kalman gains."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._types import ChangingPaths, PathModels, Seed
from .._validate import as_positive, as_signal
from ..controllers.core_controller import RECORDED as IN_CONSTRAINT
from ..controllers.core_controller import CoreController
from ..controllers.power_budget import PowerBudgetController
from ..core.block import REASONS, Block, Shape
from ..core.run_loop import DIVERGED, REFUSED_REFERENCE, RUNNING, Plant, Record, Signals, Steps
from ..paths.models import is_system, path_taps, stacked
from ..power.amplifiers import Amplifier, compiled_model
from ..power.constraint import DEFAULT_FS, NUMBERS
from .inputs import DIVERGENCE_LIMIT, SensorNoise, disturbance_at_microphone, switch_on_sample
from .result import SimulationResult
from .schedule import steps
from .simulation import POWERS, RECORDED, STRETCH

RESULTS = ("error", "control_signal", "amplifier_output", "anti_noise")
# What scenarios that share gains must agree in, in words.
SHAPE_IN_WORDS = {
    "taps": "n_taps",
    "path_taps": "their estimated secondary path",
    "guard_taps": "their secondary-path uncertainty",
    "power_windows": "the length of the sliding windows of their powers",
    "limiter_windows": "the windows of their limiters",
}
IN_WORDS = {  # by the names of fields
    "secondary_path": "their estimated secondary path",
    "guard": "their secondary-path uncertainty",
    "reference": "the reference heard so far",
    "filtered_reference": "the reference heard so far",
    **dict.fromkeys(("owed", "triangle", "gain_direction"), "their covariance P"),
}


def simulate_scenarios(
    controllers: Sequence[Any],
    reference: ArrayLike,
    *,
    secondary_path: PathModels,
    primary_path: ChangingPaths | None = None,
    disturbance: ArrayLike | None = None,
    fs: float = DEFAULT_FS,
    amplifier: Amplifier | Sequence[Amplifier | None] | None = None,
    rated_power: float | None = None,
    sensor_noise_std: float | Sequence[float] = 0.0,
    rng: Seed | None = None,
    switch_on_s: float = 0.0,
    record_powers: bool = False,
    progress: Callable[[int], Any] | None = None,
) -> list[SimulationResult]:
    """Run controllers of one kind side by side; the results are those of `simulate` for each.

    The gain of a Kalman filter (eq. 6) depends on the reference and the filter's r, q and P(0|0), not on the
    measurements. Scenarios that differ in rated power, amplifier, disturbance, true secondary path or sensor noise
    therefore need the filter's O(L^2) only once, and O(L) each.

    Scenarios cannot share gains if they differ in the reference, the estimated secondary path, r, q or P(0|0). Acoustic
    feedback would give each scenario its own reference, so there is no `feedback_path` here.

    Parameters
    ----------
    controllers : sequence of CoreController
        Separate controllers of one channel, of `kf_anc` or `kf_opc` for example. They must agree in the algorithm and
        its settings, taps, estimated secondary path, covariance and the signals heard so far.
    reference : array_like
        (n_samples,) reference x, the same for all.
    secondary_path : array_like, control.TransferFunction or list of them
        True secondary path, one for all or a list with one each.
    primary_path : array_like or control.TransferFunction, optional
        Path from the reference to the error microphone, which gives the disturbance of all. It may be switched during
        the run, as in `simulate`; the other paths and the amplifiers stay the same here.
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
        `simulate` refuses. During a run: a signal that becomes too loud. The controllers are then unchanged, except for
        what they heard before they were switched on. The same holds after an interruption.
    TypeError
        A controller whose algorithm is not in the core, or an amplifier that is not one of the package's models.

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
    if isinstance(controllers, CoreController):
        raise TypeError("controllers must be a sequence of controllers: [controller] for one")
    for name, value in (("secondary_path", secondary_path), ("amplifier", amplifier)):
        if steps(value, name)[0][1] is not value:
            raise ValueError(f"{name} must stay the same for scenarios: use simulate for one that changes")
    controllers = list(controllers)
    blocks = _blocks_that_share(controllers, fs)
    count = len(controllers)
    d = _disturbances(x, primary_path, disturbance, fs, count)
    noises = [
        SensorNoise(std, seed)
        for std, seed in zip(_each(sensor_noise_std, count, "sensor_noise_std"), _seeds(rng, count), strict=True)
    ]
    rated = [c.rated_power if rated_power is None else as_positive(rated_power, "rated_power") for c in controllers]
    paths = _stacked_paths(secondary_path, fs, count)
    models = np.concatenate([_model(own) for own in _each(amplifier, count, "amplifier")])
    on = switch_on_sample(switch_on_s, fs, x.size)
    if on:
        for i, (controller, noise) in enumerate(zip(controllers, noises, strict=True)):
            controller.listen(x[:on], d[i if len(d) > 1 else 0, :on] + noise.take(on))
        x, d = x[on:], np.ascontiguousarray(d[:, on:])

    limits = DIVERGENCE_LIMIT * np.sqrt([1.0 if p is None else p for p in rated])
    plant = Plant(paths[:, None, None], np.zeros((1, 1, 0)), models.view(np.float64).reshape(count, -1), limits)
    results = {name: np.full((count, x.size), np.nan) for name in RESULTS}
    noisy = [noise.filled(row) is not None for noise, row in zip(noises, results["error"], strict=True)]
    results["error"][np.logical_not(noisy)] = 0.0
    # A copy, in which the disturbance of a diverged scenario is set to zero.
    present = np.array(np.broadcast_to(d, (count, x.size)), order="C")
    signals = Signals(x[None], present, results["error"] if any(noisy) else None, *results.values())
    recorded = {
        name: np.full((count, x.size), np.nan) for name in (RECORDED + POWERS[:2] if record_powers else RECORDED)
    }
    side_by_side = _SideBySide(blocks)
    side_by_side.run(plant, signals, recorded, progress)
    side_by_side.give_back()
    for i, end in side_by_side.diverged_at.items():
        for signal in (*results.values(), *recorded.values()):
            signal[i, end:] = np.nan
    return [
        SimulationResult(
            algorithm=controller.name,
            fs=fs,
            rated_power=rated[i],
            reference=x,
            disturbance=d[i if len(d) > 1 else 0],
            **{name: signal[i] for name, signal in (results | recorded).items()},
            diverged_at_s=side_by_side.diverged_at[i] / fs if i in side_by_side.diverged_at else None,
        )
        for i, controller in enumerate(controllers)
    ]


def _blocks_that_share(controllers: list[Any], fs: float) -> list[Block]:
    """Return the controllers' blocks, or raise an error that names a difference."""
    if not controllers:
        raise ValueError("controllers must hold one controller at least")
    blocks: list[Block] = []
    for i, controller in enumerate(controllers):
        if not isinstance(controller, CoreController) or controller.multichannel:
            raise TypeError(f"controllers[{i}] must be a controller of the core, of one channel, got {controller!r}")
        if any(controller is other for other in controllers[:i]):
            raise ValueError(f"controllers[{i}] is in the list twice: each scenario needs its own controller")
        controller.require_sample_rate(fs)
        looped = controller.looped()
        if looped is None:
            raise ValueError(
                f"controllers[{i}] has steps of its own in Python: scenarios share the gains of kf_anc, kf_opc and "
                "others whose steps are in the core"
            )
        if controller.internal_model:
            raise ValueError(
                f"controllers[{i}] has an internal model, whose reference differs from scenario to scenario: use simulate"
            )
        if isinstance(controller, PowerBudgetController):
            raise ValueError(
                f"controllers[{i}], {controller.name}, learns the plant, which differs from scenario to scenario: use simulate"
            )
        blocks.append(looped.owner)
    for i, block in enumerate(blocks[1:], 1):
        difference = _difference(blocks[0], block)
        if difference:
            raise ValueError(f"controllers[0] and controllers[{i}] must agree in {difference} to share gains")
    return blocks


def _difference(one: Block, other: Block) -> str | None:
    """Return what prevents two blocks from sharing gains, in words; None if nothing does."""
    if one.algorithm.name != other.algorithm.name:
        return "the algorithm"
    for name, words in SHAPE_IN_WORDS.items():
        if getattr(one.shape, name) != getattr(other.shape, name):
            return words
    own = own_fields(one)
    for name in one.fields:
        if name in own or name in one.scratch or name.endswith("_at"):
            continue
        if not np.array_equal(one.latest(name), other.latest(name), equal_nan=True):
            return IN_WORDS.get(name, name)
    return None


class _SideBySide:
    """Controllers in one block that has their scenarios.

    Attributes
    ----------
    diverged_at : dict of int to int
        The sample in which a scenario diverged, by its number.
    """

    def __init__(self, blocks: list[Block]) -> None:
        self._blocks, first = blocks, blocks[0]
        self._own = own_fields(first)
        self._block = first.remade(_shape_for(first, len(blocks)), first.fields["guard"].ravel())
        self.diverged_at: dict[int, int] = {}
        self._at_divergence: dict[int, dict[str, np.ndarray]] = {}
        at, length = self._block.fields["output_at"].item(), self._block.fields["output"].shape[-1]
        for scenario, block in enumerate(blocks):
            rows = self._rows(scenario)
            for name in rows.keys() - {"output"}:
                rows[name][:] = block.fields[name].ravel()
            latest = block.latest("output").reshape(-1, block.shape.path_taps)
            rows["output"].reshape(-1, length)[:, at : at + block.shape.path_taps] = latest

    def _rows(self, scenario: int) -> dict[str, np.ndarray]:
        """Return a scenario's own fields, flat, as views."""
        fields = {name: self._block.fields[name] for name in self._own}
        return {name: field.reshape(len(self._blocks), -1)[scenario] for name, field in fields.items()}

    def run(
        self,
        plant: Plant,
        signals: Signals,
        recorded: dict[str, np.ndarray],
        progress: Callable[[int], Any] | None,
    ) -> None:
        """Run all scenarios; one that diverges is silenced, and the others go on."""
        block, count = self._block, len(self._blocks)
        steps = Steps(block.address, *block.algorithm.steps)
        constraint = block.fields["constraint"].view(NUMBERS).reshape(count)
        records = [Record(constraint[IN_CONSTRAINT[name]], signal) for name, signal in recorded.items()]
        status, done, n_samples = RUNNING, 0, signals.error.shape[1]
        while done < n_samples and len(self.diverged_at) < count:
            begin, end = done, min(done + STRETCH, n_samples)
            with block.in_use:
                status, done = plant.run(steps, signals, records, begin, end, status)
            if status == DIVERGED:
                for scenario in np.flatnonzero(~(np.abs(plant.control) <= plant.limit)):
                    self._silence(int(scenario), done, plant, signals)
            elif status != RUNNING:
                self._raise_refusal(plant, status, done)
            if progress:
                progress(count * (done - begin))

    def _silence(self, scenario: int, sample: int, plant: Plant, signals: Signals) -> None:
        """Switch a scenario off: its signals are zero from now on, and so are its weights."""
        rows = self._rows(scenario)
        rows["output"][:] = 0.0
        if scenario not in self.diverged_at:
            self.diverged_at[scenario] = sample
            self._at_divergence[scenario] = {name: field.copy() for name, field in rows.items()}
        rows["weights"][:] = rows["control_signal"][:] = 0.0  # MOV-FxLMS adapts to both
        plant.silence(scenario)
        for signal in (signals.disturbance, signals.sensor_noise):
            if signal is not None:
                signal[scenario, sample:] = 0.0

    def _raise_refusal(self, plant: Plant, status: int, sample: int) -> None:
        """Raise ValueError with the reason for which the core refused a sample: called again, the step says it."""
        where = f"sample {sample} of the run"
        if status == REFUSED_REFERENCE:
            self._block.reference[:] = plant.reference
            raise ValueError(f"{REASONS[self._block.emit()]} ({where})")
        self._block.error[:] = plant.error
        loudest = int(np.argmax(np.abs(plant.error)))
        raise ValueError(f"{REASONS[self._block.update()]} ({where}, the loudest error is controllers[{loudest}]'s)")

    def give_back(self) -> None:
        """Write the present state into the blocks of the controllers."""
        for scenario, block in enumerate(self._blocks):
            rows = self._rows(scenario) | self._at_divergence.get(scenario, {})
            for name, field in block.fields.items():
                if name in rows:
                    field[...] = rows[name].reshape(field.shape)
                elif name not in self._own:
                    field[...] = self._block.fields[name]


def own_fields(block: Block) -> list[str]:
    """Return the names of the fields that each scenario has for itself."""
    return [
        name
        for name, shape in block.algorithm.shapes(_shape_for(block, 2)).items()
        if shape != block.fields[name].shape
    ]


def _shape_for(block: Block, scenarios: int) -> Shape:
    """Return the shape of a block with so many scenarios that are like this one."""
    shape = block.shape
    return replace(
        shape,
        scenarios=scenarios,
        power_windows=shape.power_windows * scenarios,
        limiter_windows=shape.limiter_windows * scenarios,
    )


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
    return stacked([path_taps(path, fs=fs, name="secondary_path") for path in paths])


def _model(amplifier: Amplifier | None) -> np.ndarray:
    model = compiled_model(amplifier)
    if model is None:
        raise TypeError(
            f"amplifier must be one of the package's models or None, got {amplifier!r}; use simulate for it"
        )
    return model
