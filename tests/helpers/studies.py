"""Studies beyond the paper on a small scale, away from the measured data."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest

from comparisons.bench import Runs, Scene, StudyReport, make_controller
from comparisons.bench.registry import REGISTRY
from comparisons.studies import cases
from kfopc_filterpy import Plant, SimulationResult, simulate
from kfopc_filterpy.controllers.table import CORE


@contextmanager
def smaller(*studies: Any, **constants: Any) -> Iterator[None]:
    """Give studies other constants, and take the measured data away, for a while."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("KFOPC_DATA", "/no/such/folder")
        for study in studies:
            for name, value in constants.items():
                patch.setattr(study, name, value)
        cases.measured_data.cache_clear()
        yield
    cases.measured_data.cache_clear()


@contextmanager
def few_settings(several_channels: Any = None) -> Iterator[None]:
    """Leave three of each algorithm's settings, or one; only the named algorithms run with several channels, if any are named."""
    with pytest.MonkeyPatch.context() as patch:
        for name, own in REGISTRY.items():
            kept = slice(1, 8, 3) if own.make in CORE.values() else slice(1, 2)  # those in Python take seconds
            few = replace(own, first=own.first[kept] or own.first, second=own.second[kept])
            if several_channels is not None:
                few = replace(few, several_channels=name in several_channels)
            patch.setitem(REGISTRY, name, few)
        yield


def run_study(study: Any) -> StudyReport:
    """Run a study as it is now; it must take the runs that it plans."""
    runs = Runs()
    report = study.main(runs)
    assert runs.done == study.planned_runs() > 0
    return report


def row_of(report: StudyReport, **values: Any) -> dict[str, Any]:
    """Return the one row of a report that has these values."""
    (row,) = (row for row in report.extra["rows"] if values.items() <= row.items())
    return row


def plain_run(
    scene: Scene, algorithm: str, setting: Any, *, amplifier: Any = None, known: Any = None, **options: Any
) -> SimulationResult:
    """Run a scene's first seed as a user would; `known` is an amplifier that the controller knows."""
    controller = make_controller(scene, algorithm, setting, amplifier=known)
    plant = Plant(scene.secondary, amplifier=amplifier, fs=scene.fs, sensor_noise_std=scene.sensor_noise_std)
    run = {"disturbance": scene.disturbances[0], "switch_on_s": scene.switch_on_s, "rng": 1000 + scene.seeds[0]}
    return simulate(controller, scene.references[0], plant, **run, **options)


def short_duct() -> dict[str, Plant]:
    """Return the modelled duct, its paths cut short."""
    duct = cases.modelled_plants()["duct"]
    return {"duct": Plant(duct.secondary[..., :200], duct.primary[..., :200], fs=duct.fs)}
