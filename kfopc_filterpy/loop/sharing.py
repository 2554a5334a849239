"""Runs at the cost of one filter: runs with the same reference have the same Kalman gains."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np

from .._taps import lengthened
from ..controllers.core_controller import RECORDED as IN_CONSTRAINT
from ..controllers.core_controller import CoreController
from ..core.block import REASONS, Block, Shape
from ..core.run_loop import DIVERGED, REFUSED_REFERENCE, RUNNING, Plant, Record, Signals, Steps
from ..power.amplifiers import amplifier_models, compiled_model
from ..power.constraint import NUMBERS
from .inputs import RESULTS, STRETCH, divergence_limits


def runs_that_share(runs: Sequence[Any]) -> list[list[Any]]:
    """Return the runs that can share gains, in groups of two at least."""
    groups: list[list[Any]] = []
    for run in runs:
        if not _can_share(run):
            continue
        own = _block(run)
        group = next((group for group in groups if group[0].fs == run.fs and _share(_block(group[0]), own)), None)
        if group is None:
            groups.append([run])
        else:
            group.append(run)
    return [group for group in groups if len(group) > 1]


def _can_share(run: Any) -> bool:
    """Return whether a run's controller has gains that do not depend on what it measures, and steps in the core."""
    controller, plant = run.controller, run.true
    return (
        isinstance(controller, CoreController)
        and controller.shares_gains
        and controller.looped() is not None
        and not run.several
        and not run.every
        and not plant.changes
        and plant.feedback is None
        and all(compiled_model(one) is not None for one in plant.amplifiers)
    )


def _block(run: Any) -> Block:
    block: Block = run.controller.looped().owner
    return block


def _share(one: Block, other: Block) -> bool:
    """Return whether two blocks agree in everything but what each run has for itself."""
    if one.algorithm.name != other.algorithm.name or one.shape != other.shape:
        return False
    own = own_fields(one)
    return all(
        np.array_equal(one.latest(name), other.latest(name), equal_nan=True)
        for name in one.fields
        if name not in own and name not in one.scratch and not name.endswith("_at")
    )


def run_together(runs: Sequence[Any], progress: Callable[[int], Any] | None) -> None:
    """Run controllers side by side; each run gets its part of the signals, and its end."""
    for run in runs:
        run.begin()
    first = runs[0]
    paths = [run.true.secondary for run in runs]
    longest = max(path.shape[2] for path in paths)
    secondary = np.array([lengthened(path, longest) for path in paths])
    models = np.concatenate([amplifier_models(run.true.amplifiers, 1) for run in runs])
    limits = np.concatenate([divergence_limits(run.rated_power, 1) for run in runs])
    plant = Plant(secondary, np.zeros((1, 1, 0)), models, limits)
    results = {name: np.concatenate([getattr(run.signals, name) for run in runs]) for name in RESULTS}
    noisy = any(run.signals.sensor_noise is not None for run in runs)
    for run, error in zip(runs, results["error"], strict=True):
        if run.signals.sensor_noise is None:
            error[:] = 0.0
    # A copy, in which the disturbance of a diverged run is set to zero.
    present = np.concatenate([run.d for run in runs])
    signals = Signals(first.x, present, results["error"] if noisy else None, *results.values())
    recorded = {name: np.concatenate([run.recorded[name] for run in runs]) for name in first.recorded}
    with ExitStack() as in_use:  # until the controllers have their state back
        for run in runs:
            in_use.enter_context(run.controller.in_use)
        side_by_side = _SideBySide([_block(run) for run in runs])
        side_by_side.run(plant, signals, recorded, progress)
        side_by_side.give_back()
    for i, run in enumerate(runs):
        own = slice(i, i + 1)
        run.signals = Signals(run.x, run.d, None, *(results[name][own] for name in RESULTS))
        run.recorded = {name: signal[own] for name, signal in recorded.items()}
        end = side_by_side.diverged_at.get(i, first.x.shape[1])
        run.end(end, i in side_by_side.diverged_at)


class _SideBySide:
    """Several controllers as the scenarios of one block: gains once, and weights, signals and powers for each.

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
        raise ValueError(f"{REASONS[self._block.update()]} ({where}, the loudest error is that of run {loudest})")

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
